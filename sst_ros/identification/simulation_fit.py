# SPDX-License-Identifier: Apache-2.0
"""Constants identified by simulation: the motion that fits measured angles."""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from scipy.optimize import least_squares

from sst_ros.dynamics.kernel import joints, model_of
from sst_ros.dynamics.variational import VariationalEquations
from sst_ros.errors import InputError, refuse_unless
from sst_ros.identification import contradictions, parameters
from sst_ros.identification.measured_motion import (
    Measured,
    read_segments,
    take_angles,
)
from sst_ros.identification.parameters import Identification, Regressor
from sst_ros.identification.regression import RegressionEquations
from sst_ros.mechanism.geometry import Array
from sst_ros.scene.scene import Scene
from sst_ros.scene.yaml_document import find_number

POSITIVE = re.compile(
    r"(friction|actuators|stroke|springs)(?!.*\.rest$)|.*\.(mass|xx|yy|zz)$"
)
LEAST_SHARE = 1e-3  # of its given value that a positive parameter may fall to
NOT_DETERMINED = 1.0  # relative standard deviation of a combination that counts as such
SINGULAR = 1e-12  # share of the largest singular value that is rounding
LARGEST_DEVIATION = 1e9  # relative, in the covariance of what nothing determines
SHOWN_POWER = 0.05  # of a combination, over its largest, that is written
TOLERANCE = 1e-13  # of least squares, relative: they end at rounding
MOST_EVALUATIONS = 100


@dataclass(frozen=True)
class SimulationFit(Identification):
    """Constants identified by simulation.

    `values` differ from estimates that no body has.

    Attributes:
        relative: relative standard deviations of the combinations `directions`, rising,
            (p,).
        directions: combinations as rows, relative changes of the parameters, shape (p,
            p).
        error: root of the mean square of the residuals [rad].

    """

    relative: Array
    directions: Array
    error: float

    @property
    def combinations(self) -> list[tuple[float, str]]:
        """The combinations as text, each with its relative standard deviation."""
        texts = [describe_combination(row, self.names) for row in self.directions]
        return list(zip(self.relative.tolist(), texts, strict=True))


def fit_simulation(
    data: Measured, scene: Scene, requested: Iterable[str] | None
) -> SimulationFit:
    """Identify by simulation; arguments as for `identify`.

    Gauss-Newton steps take the sensitivities of the motion, exact to rounding. In sizes
    of the parameters, their singular values over the measuring errors show which
    combinations are known and how well: often fewer than there are parameters.
    """
    names: tuple[str, ...] = ()
    if isinstance(requested, str):
        names = (requested,)
    elif requested is not None:
        names = tuple(requested)
    requirement = "must be keys of numbers of the scene, with method simulation"
    refuse_unless("identify", ("parameters", requested, bool(names), requirement))
    notes = _check_simulated(data, scene)
    torque, t, gamma = take_angles(data, scene)
    motion = VariationalEquations(scene, names, torque, caller="identify")
    model = model_of(scene)
    start = np.array([find_number(scene, name) for name in names], dtype=float)
    positive = [bool(POSITIVE.match(name)) for name in names]
    least = np.where(positive, LEAST_SHARE, -np.inf)
    requirement = "must not be 0 in the scene: it begins there, and must be > 0"
    begins = (start > 0.0) | ~np.array(positive)
    checks = zip(names, start, begins.tolist(), strict=True)
    refuse_unless("identify", *((*check, requirement) for check in checks))
    size = np.abs(start) + (start == 0.0)

    @lru_cache(maxsize=1)  # SciPy asks for residuals and slopes one after the other
    def compare(*x: float) -> tuple[Array, Array]:
        """Return computed less measured angles [rad], and derivatives.

        The angles have the shape (3 n,), the derivatives (3 n, p).
        """
        states, slopes = motion.run(np.array(x) * size, t)
        rows = states[:, :7].T
        turned = np.exp(
            1j * (np.stack(joints(model, tuple(rows)).gamma, axis=1) - gamma)
        )
        by_state = motion.differentiate_joints(rows)[:, :3]
        changes = np.einsum("qcn,nqp->ncp", by_state, slopes[:, :7])
        return np.angle(turned).ravel(), changes.reshape(-1, len(names))

    solution = least_squares(
        lambda x: compare(*x)[0],
        start / size,
        lambda x: compare(*x)[1] * size,
        bounds=(least, np.inf),
        xtol=TOLERANCE,
        ftol=TOLERANCE,
        gtol=None,
        max_nfev=MOST_EVALUATIONS,
    )
    residuals, slopes = compare(*solution.x)
    fitted = solution.x * size
    combinations = _find_combinations(residuals, slopes, fitted)
    kept, adjusted = _adjust(scene, names, fitted)
    warnings = tuple(notes)
    if kept != names:
        warnings += (
            "no bodies have the inertias that fit best: the scene keeps the given ones",
        )
    vague = combinations.directions[combinations.relative >= NOT_DETERMINED]
    return SimulationFit(
        scene=adjusted,
        names=names,
        values=parameters.values(adjusted, names),
        labels=names,
        before=start,
        estimate=fitted,
        covariance=combinations.covariance,
        undetermined=tuple(describe_combination(row, names) for row in vague),
        warnings=warnings,
        relative=combinations.relative,
        directions=combinations.directions,
        error=float(np.sqrt(np.mean(residuals**2))),
    )


class _Combinations(NamedTuple):
    """Combinations of parameters that the residuals depend on, the best known first."""

    relative: Array  # relative standard deviations, shape (p,)
    directions: Array  # relative changes of the parameters as rows, shape (p, p)
    covariance: Array  # of the parameters, shape (p, p)


def _find_combinations(residuals: Array, slopes: Array, fitted: Array) -> _Combinations:
    """Find the combinations of slopes, shape (n, p), by their singular values."""
    count = len(fitted)
    scale = np.where(fitted == 0.0, 1.0, fitted)  # changes of logarithms
    freedom = max(len(residuals) - count, 1)
    noise = float(np.sqrt(np.sum(residuals**2) / freedom)) + 1e-300
    _, singular, rows = np.linalg.svd(slopes * scale / noise, full_matrices=True)
    relative = np.full(count, np.inf)
    regular = singular > SINGULAR * max(float(singular[0]), 1e-300)
    relative[: len(singular)][regular] = 1.0 / singular[regular]
    variances = np.minimum(relative, LARGEST_DEVIATION) ** 2
    covariance = (rows.T * variances) @ rows * np.outer(scale, scale)
    return _Combinations(relative, rows, covariance)


def _adjust(
    scene: Scene, names: tuple[str, ...], fitted: Array
) -> tuple[tuple[str, ...], Scene]:
    """Return the scene with fitted values, and the names of those that it has.

    It keeps its inertias where no bodies have the fitted ones.
    """
    note = "identified by simulation"
    try:
        return names, parameters.with_parameters(scene, names, fitted, note)
    except InputError:
        kept = tuple(name for name in names if ".inertia." not in name)
        if kept == names:
            raise
        chosen = [name in kept for name in names]
        return kept, parameters.with_parameters(scene, kept, fitted[chosen], note)


def _check_simulated(data: Measured, scene: Scene) -> list[str]:
    """Return notes on a motion that is to be simulated.

    Raises InputError where a torque opposes that of the scene along the motion; motions
    that are too short to be filtered are not checked.
    """
    segments = read_segments(data)
    notes = contradictions.check_angles(segments.motion)
    try:
        equations = RegressionEquations(segments.parts, Regressor(scene, ()), None)
        correlation = equations.correlate()
    except InputError:
        return notes
    leg = int(np.argmin(correlation))
    requirement = "must be > 0: the signs of torque and gamma contradict each other"
    key = f"correlation of torque_{leg + 1} with that of the scene"
    opposed = correlation[leg] < contradictions.OPPOSED
    refuse_unless(
        "identify", (key, round(float(correlation[leg]), 2), not opposed, requirement)
    )
    return notes


def describe_combination(row: Array, names: tuple[str, ...]) -> str:
    """Write relative changes as a product of powers."""
    largest = float(row[int(np.argmax(np.abs(row)))])
    return " ".join(
        f"{name}^{np.sign(largest) * value:+.2f}"
        for name, value in zip(names, row, strict=True)
        if abs(value) > SHOWN_POWER * abs(largest)
    )
