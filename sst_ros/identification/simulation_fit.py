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

from sst_ros.dynamics.kernel import Model, joints, model_of
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
from sst_ros.state import STAR

# keys of numbers that must stay positive: of what has a size, not a direction
POSITIVE = re.compile(
    r"(friction|actuators|stroke|springs)(?!.*\.rest$)|.*\.(mass|xx|yy|zz)$"
)
LEAST_SHARE = 1e-3  # of its given value that a positive parameter may fall to
NOT_DETERMINED = 1.0  # relative standard deviation of a combination that counts as such
ROUNDED_SINGULAR_VALUE = 1e-12  # share of the largest one that is rounding
LARGEST_DEVIATION = 1e9  # relative, in the covariance of what nothing determines
SHOWN_POWER = 0.05  # of a combination, over its largest, that is written
LEAST_SQUARES_TOLERANCE = 1e-13  # relative: the iteration ends at rounding
MOST_EVALUATIONS = 100  # of the motion, by least squares


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
    names = _named(requested)
    notes = _check_simulated(data, scene)
    torque, times, gamma = take_angles(data, scene)
    motion = VariationalEquations(scene, names, torque, caller="identify")
    model = model_of(scene)
    start = np.array([find_number(scene, name) for name in names], dtype=float)
    least = _least_shares(names, start)
    size = np.abs(start) + (start == 0.0)

    @lru_cache(maxsize=1)  # SciPy asks for residuals and slopes one after the other
    def compare(*shares: float) -> tuple[Array, Array]:
        return _compare_angles(motion, model, np.array(shares) * size, times, gamma)

    solution = least_squares(
        lambda shares: compare(*shares)[0],
        start / size,
        lambda shares: compare(*shares)[1] * size,
        bounds=(least, np.inf),
        xtol=LEAST_SQUARES_TOLERANCE,
        ftol=LEAST_SQUARES_TOLERANCE,
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
    undetermined = combinations.directions[combinations.relative >= NOT_DETERMINED]
    return SimulationFit(
        scene=adjusted,
        names=names,
        values=parameters.values(adjusted, names),
        labels=names,
        before=start,
        estimate=fitted,
        covariance=combinations.covariance,
        undetermined=tuple(describe_combination(row, names) for row in undetermined),
        warnings=warnings,
        relative=combinations.relative,
        directions=combinations.directions,
        error=float(np.sqrt(np.mean(residuals**2))),
    )


def _named(requested: Iterable[str] | None) -> tuple[str, ...]:
    """Return the names of the parameters, of which there must be one or more."""
    names: tuple[str, ...] = ()
    if isinstance(requested, str):
        names = (requested,)
    elif requested is not None:
        names = tuple(requested)
    requirement = "must be keys of numbers of the scene, with method simulation"
    refuse_unless("identify", ("parameters", requested, bool(names), requirement))
    return names


def _least_shares(names: tuple[str, ...], start: Array) -> Array:
    """Return the least share of its given value that each parameter may have.

    Raises InputError where one that must be positive is not.
    """
    is_positive = [bool(POSITIVE.match(name)) for name in names]
    requirement = "must not be 0 in the scene: it begins there, and must be > 0"
    may_begin = (start > 0.0) | ~np.array(is_positive)
    checks = zip(names, start, may_begin.tolist(), strict=True)
    refuse_unless("identify", *((*check, requirement) for check in checks))
    return np.where(is_positive, LEAST_SHARE, -np.inf)


def _compare_angles(
    motion: VariationalEquations,
    model: Model,
    values: Array,
    times: Array,
    gamma: Array,
) -> tuple[Array, Array]:
    """Return computed less measured angles [rad], and their derivatives.

    The angles have the shape (3 n,), their derivatives by the p values (3 n, p).
    """
    states, state_slopes = motion.run(values, times)
    body_states = states[:, STAR].T  # without lagged torques
    computed = np.stack(joints(model, tuple(body_states)).gamma, axis=1)
    turned = np.exp(1j * (computed - gamma))  # without whole turns
    by_state = motion.differentiate_joints(body_states)
    gamma_by_state, _ = np.split(by_state, 2, axis=1)  # of gamma and of gamma_dot
    slopes = np.einsum("qcn,nqp->ncp", gamma_by_state, state_slopes[:, STAR])
    return np.angle(turned).ravel(), slopes.reshape(-1, len(values))


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
    regular = singular > ROUNDED_SINGULAR_VALUE * max(float(singular[0]), 1e-300)
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
