# SPDX-License-Identifier: Apache-2.0
"""Identification by simulation: the motion that fits measured angles, by any constant of a scene.

Gauss-Newton steps of SciPy's `least_squares` with the sensitivities of the motion, exact to
rounding (see `sensitivities`).

In sizes of the parameters, the singular values of the sensitivities over the measuring errors show
which combinations are known and how well: often fewer than there are parameters.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any

import numpy as np
from scipy.optimize import least_squares

from sst_ros.dynamics import kernel
from sst_ros.dynamics.expression import compile_for_arrays, trace
from sst_ros.dynamics.traced_dynamics import QUATERNION
from sst_ros.dynamics.variational import VariationalEquations
from sst_ros.errors import InputError, refuse_unless
from sst_ros.identification import parameters
from sst_ros.identification.measured_motion import Measured, Readings, take_readings
from sst_ros.identification.parameters import Identification, with_parameters
from sst_ros.mechanism.generic_math import atan2, rotation_rows, sqrt
from sst_ros.mechanism.geometry import Array
from sst_ros.scene.scene import Scene
from sst_ros.scene.yaml_document import find_number
from sst_ros.state import ZERO

NOT_DETERMINED = 1.0  # relative standard deviation of a combination that counts as such
POSITIVE = re.compile(r"(friction|actuators|stroke|springs)(?!.*\.rest$)|.*\.(mass|xx|yy|zz)$")


@dataclass(frozen=True)
class SimulationFit(Identification):
    """Constants identified by simulation; `values` differ from estimates that no body has.

    Attributes:
        relative: relative standard deviations of the combinations `directions`, rising, (p,).
        directions: combinations as rows, relative changes of the parameters, shape (p, p).
        error: root of the mean square of the residuals in standard deviations, or in [rad], [m]
            where those were not given.

    """

    relative: Array
    directions: Array
    error: float

    @property
    def combinations(self) -> list[tuple[float, str]]:
        """The combinations as text, each with its relative standard deviation."""
        texts = [describe_combination(row, self.names) for row in self.directions]
        return list(zip(self.relative.tolist(), texts, strict=True))


def fit_simulation(data: Measured, scene: Scene, requested: Iterable[str] | None) -> SimulationFit:
    """Identify by simulation; arguments as for `identify`."""
    given = () if requested is None else requested
    names = (given,) if isinstance(given, str) else tuple(given)
    allowed = "must be keys of numbers of the scene, with method simulation"
    refuse_unless("identify", ("parameters", requested, bool(names), allowed))
    torque, read = take_readings(data, scene)
    motion = FittedMotion(scene, names, torque, caller="identify")
    given = np.array([find_number(scene, name) for name in names], dtype=float)
    least = np.where([bool(POSITIVE.match(name)) for name in names], 1e-3, -np.inf)
    allowed = "must not be 0 in the scene: it begins there, and must be > 0"
    begins = zip(names, given, (given > 0.0) | np.isinf(least), strict=True)
    refuse_unless("identify", *((name, x, bool(good), allowed) for name, x, good in begins))
    size = np.abs(given) + (given == 0.0)

    @lru_cache(maxsize=1)  # SciPy asks for residuals and slopes one after the other
    def compare(*x: float) -> tuple[Array, Array]:
        return motion.compare(np.array(x) * size, read)

    found = least_squares(
        lambda x: compare(*x)[0],
        given / size,
        lambda x: compare(*x)[1] * size,
        bounds=(least, np.inf),
        xtol=1e-13,
        ftol=1e-13,
        gtol=None,
        max_nfev=100,
    )
    off, slopes = compare(*found.x)
    fitted = found.x * size
    scale = np.where(fitted == 0.0, 1.0, fitted)  # changes of logarithms
    unit = 1.0
    if read[2] is None:  # estimated from the residuals
        unit = float(np.sqrt(np.sum(off**2) / max(len(off) - len(names), 1))) + 1e-300
    _, singular, rows = np.linalg.svd(slopes * scale / unit, full_matrices=True)
    relative = np.full(len(names), np.inf)
    some = singular > 1e-12 * max(float(singular[0]), 1e-300)
    relative[: len(singular)][some] = 1.0 / singular[some]
    spread = (rows.T * np.minimum(relative, 1e9) ** 2) @ rows * np.outer(scale, scale)
    vague = rows[relative >= NOT_DETERMINED]
    note, kept, warnings = "identified by simulation", names, tuple[str, ...]()
    try:
        adjusted = with_parameters(scene, names, fitted, note)
    except InputError:
        kept = tuple(name for name in names if ".inertia." not in name)
        if kept == names:
            raise
        chosen = [name in kept for name in names]
        adjusted = with_parameters(scene, kept, fitted[chosen], note)
        warnings = ("no bodies have the inertias that fit best: the scene keeps the given ones",)
    return SimulationFit(
        scene=adjusted,
        names=names,
        values=parameters.values(adjusted, names),
        labels=names,
        before=given,
        estimate=fitted,
        covariance=spread,
        undetermined=tuple(describe_combination(row, names) for row in vague),
        warnings=warnings,
        relative=relative,
        directions=rows,
        error=float(np.sqrt(np.mean(off**2))),
    )


def describe_combination(row: Array, names: tuple[str, ...]) -> str:
    """Write relative changes as a product of powers."""
    largest = float(row[int(np.argmax(np.abs(row)))])
    return " ".join(
        f"{name}^{np.sign(largest) * value:+.2f}"
        for name, value in zip(names, row, strict=True)
        if abs(value) > 0.05 * abs(largest)
    )


class FittedMotion(VariationalEquations):
    """Motions of a scene, their sensitivities, and how far they are from what was read."""

    def compare(self, values: Array, read: Readings) -> tuple[Array, Array]:
        """Return computed less read numbers, in standard deviations, and how they change.

        Of r readings with values of p parameters these are residuals, shape (r,), and slopes, shape
        (r, p), in order of time; those of a time follow each other.
        """
        t, given, deviation = read
        count, (states, slopes) = len(t), self.run(values, t)
        found = self._observables(*states[:, :4].T)
        rows = np.stack([np.broadcast_to(row, count) for row in found]).reshape(5, -1, count)
        off = rows[0].T - given
        off[:, :6] = np.angle(np.exp(1j * off[:, :6]))
        unit = np.ones_like(off) if deviation is None else deviation
        changes = np.einsum("qcn,nqp->ncp", rows[1:], slopes[:, :4])
        there = np.isfinite(given)
        return (off / unit)[there], (changes / unit[:, :, None])[there]

    @cached_property
    def _observables(self) -> Callable[..., tuple[Any, ...]]:
        """Nine `OBSERVABLES` of a quaternion, then their derivatives by it."""
        model, radius = kernel.model_of(self.scene, self._geometry), self.scene.star.radius

        def function(*q: Any) -> tuple[Any, ...]:
            rows = rotation_rows((q[0], q[1], q[2], q[3]))
            first, second, third = rows
            return (
                *(kernel.joint_angle(kernel.leg_motion(leg, rows, ZERO), 0) for leg in model.legs),
                atan2(second[2], first[2]),
                atan2(sqrt(first[2] * first[2] + second[2] * second[2]), third[2]),
                atan2(third[1], -third[0]),
                *(radius * row[2] for row in rows),
            )

        return compile_for_arrays(trace(function, QUATERNION, QUATERNION))
