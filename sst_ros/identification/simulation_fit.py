# SPDX-License-Identifier: Apache-2.0
"""Identification by simulation: the motion that fits measured angles, by any constant of a scene.

Gauss-Newton steps of SciPy's `least_squares` with the sensitivities S = dy/dp of the motion
y' = f(y, t, p), which obey the variational equation

    S' = (df/dy) S + df/dp,  S(0) = dy(0)/dp

(Hairer, Norsett and Wanner, Solving Ordinary Differential Equations I, section I.14). Both
derivatives are those of the traced equation of motion, exact to rounding, and one error control
holds for S and the motion. Where an elastic stop is met or left f is continuous, and so is S (Leine
and Nijmeijer, Dynamics and Bifurcations of Non-Smooth Mechanical Systems, Springer 2004, 7.2).

In sizes of the parameters, the singular values of the sensitivities over the measuring errors show
which combinations are known and how well: often fewer than there are parameters.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache, partial
from typing import Any

import numpy as np
from scipy.integrate import solve_ivp
from scipy.optimize import least_squares

from sst_ros.control.actuator_space import ActuatorSpaceMap
from sst_ros.dynamics import kernel
from sst_ros.dynamics.expression import compile_for_arrays, compile_program, mark_present, trace
from sst_ros.dynamics.initial_state import initial_state
from sst_ros.dynamics.model import damping_of
from sst_ros.dynamics.traced_dynamics import LAG, QUATERNION, RATE, TORQUE
from sst_ros.errors import InputError, Problem
from sst_ros.identification import parameters
from sst_ros.identification.measured_motion import Measured, Readings, take_readings
from sst_ros.identification.parameters import Identification, value_of, with_parameters
from sst_ros.mechanism.generic_math import atan2, quaternion_rate, rotation_rows, sqrt
from sst_ros.mechanism.geometry import Array, Geometry
from sst_ros.scene.scene import Scene
from sst_ros.scene.schema import build_unchecked
from sst_ros.scene.torque_profile import TorqueProfile, torque_at
from sst_ros.scene.yaml_document import plain, replace_values
from sst_ros.state import ZERO

NOT_DETERMINED = 1.0  # relative standard deviation of a combination that counts as such
POSITIVE = re.compile(r"(friction|actuators|stroke|springs)(?!.*\.rest$)|.*\.(mass|xx|yy|zz)$")
TOLERANCE = 1e-12  # of a step, relative and absolute; the latter over the size of a parameter
AT_STOPS = 0.1  # of it where stops are elastic: a step across a jump of derivatives loses its order
GEOMETRY = ("base", "star.alpha_deg", "star.radius", "workspace", "stroke.at_end")
RESTITUTION = "stroke.restitution"


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

    def _notes(self) -> Iterator[str]:
        yield f"root of the mean square of the residuals {self.error:.3g}"
        for deviation, row in zip(self.relative, self.directions, strict=True):
            known = f"known to {deviation:.2g}" if deviation < NOT_DETERMINED else "not determined"
            yield f"{known}: {describe_combination(row, self.names)}"


def fit_simulation(data: Measured, scene: Scene, requested: Iterable[str] | None) -> SimulationFit:
    """Identify by simulation; arguments as for `identify`."""
    names = (requested,) if isinstance(requested, str) else tuple(requested or ())
    if not names:
        allowed = "must be keys of numbers of the scene, with method simulation"
        raise InputError("identify", [Problem("parameters", requested, allowed)])
    torque, read = take_readings(data, scene)
    motion = Sensitivities(scene, names, torque)
    given = np.array([value_of(scene, name) for name in names], dtype=float)
    size = np.abs(given) + (given == 0.0)

    @lru_cache(maxsize=1)  # SciPy asks for residuals and slopes one after the other
    def compare(*x: float) -> tuple[Array, Array]:
        return motion.compare(np.array(x) * size, read)

    found = least_squares(
        lambda x: compare(*x)[0],
        given / size,
        lambda x: compare(*x)[1] * size,
        bounds=(np.where([bool(POSITIVE.match(name)) for name in names], 1e-3, -np.inf), np.inf),
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


class Sensitivities:
    """Motions of a scene under torques over time, and their derivatives by parameters.

    Those are numbers of the scene by key, as "friction.gamma.smoothing", "initial.gamma_dot[0]" or
    "actuators.time_constant", but not of its geometry; a list without index means all its entries.
    """

    def __init__(self, scene: Scene, names: Sequence[str], torque: TorqueProfile) -> None:
        self.scene, self.names = scene, tuple(names)
        self._torque, self._geometry = torque, Geometry.of(scene)
        for name in self.names:
            allowed = "is geometry, which is taken as known" if name.startswith(GEOMETRY) else ""
            if value_of(scene, name) is None:
                allowed = "must be the key of a number that the scene has"
            if allowed:
                raise InputError("identify", [Problem("parameters", name, allowed)])
        self._state = (*QUATERNION, *RATE, *(LAG if scene.lags else ()))

    def compare(self, values: Array, read: Readings) -> tuple[Array, Array]:
        """Return computed less read numbers, in standard deviations, and how they change.

        Of r readings with values of p parameters these are residuals, shape (r,), and slopes, shape
        (r, p), in order of time; those of a time follow each other.
        """
        t, given, deviation = read
        count, times = len(t), t if t[-1] > 0.0 else np.append(t, 1e-9)
        states, slopes = (part[:count] for part in self.run(values, times))
        found = self._observables(*states[:, :4].T)
        rows = np.stack([np.broadcast_to(row, count) for row in found]).reshape(5, -1, count)
        off = rows[0].T - given
        off[:, :6] = np.angle(np.exp(1j * off[:, :6]))
        unit = np.ones_like(off) if deviation is None else deviation
        changes = np.einsum("qcn,nqp->ncp", rows[1:], slopes[:, :4])
        there = np.isfinite(given)
        return (off / unit)[there], (changes / unit[:, :, None])[there]

    def run(self, values: Array, t: Array) -> tuple[Array, Array]:
        """Integrate the motion and its sensitivities with values of the parameters, shape (p,).

        Returns states (q, W and lagged torques) at times t [s], shape (n,), ascending from 0 on, of
        shape (n, m), and their derivatives, (n, m, p); raises InputError where there is no motion.
        """
        # Inertias between iterations of a fit need not be those of bodies that can exist.
        outer = zip(self.names, values.tolist(), strict=True)
        scene = self.scene.with_values(
            {name: value for name, value in outer if name.startswith(("initial", "stroke"))}
        )
        given, chain = values.tolist(), np.ones(len(values))
        if RESTITUTION in self.names:
            place = self.names.index(RESTITUTION)
            chain[place], given[place] = differentiate_damping(scene), damping_of(scene.stroke)
        state, slopes = self._start(scene)
        size, y = len(state), np.concatenate([state, slopes.ravel()])
        derivatives, torque = self._derivatives, self._torque

        def rates(time: float, y: Array, acting: Callable[[float], Any]) -> Array:
            found = np.array(derivatives(*y[:size].tolist(), *acting(time), *given))
            rate, by_state, by_parameter = np.split(found.reshape(-1, size), [1, 1 + size])
            flow = by_state.T @ y[size:].reshape(size, -1) + by_parameter.T * chain
            return np.concatenate([rate[0], flow.ravel()])

        tolerance = TOLERANCE * (AT_STOPS if scene.stroke.at_end == "elastic" else 1.0)
        least = np.append(np.ones(size), np.tile(1.0 / (np.abs(values) + (values == 0.0)), size))
        breaks = torque.kinks()
        inside = breaks[(breaks > 0.0) & (breaks < t[-1])]
        rows, begin = np.empty((len(t), len(y))), 0.0
        rows[t <= 0.0] = y
        for end in np.unique(np.append(inside, t[-1])).tolist():
            here = (t > begin) & (t <= end)
            acting = torque.acting(begin, end)
            try:
                run = solve_ivp(
                    rates, (begin, end), y, "DOP853", np.union1d(t[here], end),
                    rtol=tolerance, atol=tolerance * least, args=(partial(torque_at, acting),),
                )  # fmt: skip
            except (ArithmeticError, ValueError):
                run = None
            if run is None or run.status != 0:
                problem = Problem("parameters", values.tolist(), "leave no motion to the last time")
                raise InputError("identify", [problem])
            rows[here], y, begin = run.y.T[: int(here.sum())], run.y[:, -1], end
        return rows[:, :size], rows[:, size:].reshape(len(t), size, -1)

    @cached_property
    def _derivatives(self) -> Callable[..., tuple[float, ...]]:
        """y', then its derivatives by each component of y and by each parameter."""
        size = len(self._state)

        def derivative(*inputs: Any) -> tuple[Any, ...]:
            symbols = dict(zip(self.names, map(mark_present, inputs[size + 3 :]), strict=True))
            if RESTITUTION in symbols:  # its number is that of the damping
                symbols |= {"stroke.damping": symbols[RESTITUTION], RESTITUTION: None}
            opened = build_unchecked(Scene, replace_values(plain(self.scene), symbols))
            model = kernel.model_of(opened, self._geometry)
            return kernel.derivative(model, inputs[:size], inputs[size : size + 3])

        varied = tuple(f"p{i}" for i in range(len(self.names)))
        inputs, by = (*self._state, *TORQUE, *varied), (*self._state, *varied)
        return compile_program(trace(derivative, inputs, by))

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

    def _start(self, scene: Scene) -> tuple[Array, Array]:
        """Return the initial state, and its derivatives by the parameters, shape (m, p)."""
        state = np.zeros(len(self._state))
        state[:7] = initial_state(scene, self._geometry)
        slopes = np.zeros((len(state), len(self.names)))
        quaternion, rate = state[:4], np.array(scene.initial.gamma_dot)
        to_star = ActuatorSpaceMap(self._geometry).star_rates

        def body_rate(q: Array, gamma_dot: Array) -> Array:
            return np.array(to_star(*q, *gamma_dot, 0.0, 0.0, 0.0)[:3])

        for column, name in enumerate(self.names):
            if name.startswith("initial"):
                unit = np.eye(3)[int(name[-2])] if name.endswith("]") else np.ones(3)
                turn = body_rate(quaternion, unit)
                if name.startswith("initial.gamma_dot"):
                    slopes[4:7, column] = turn
                    continue
                along: Any = np.array(quaternion_rate(tuple(quaternion), tuple(turn)))
                slopes[:4, column] = along
                # Complex step: exact to rounding, as the map is rational.
                slopes[4:7, column] = body_rate(quaternion + 1e-30j * along, rate).imag / 1e-30
        return state, slopes


def differentiate_damping(scene: Scene) -> float:
    """Return the derivative of the damping of elastic stops by the restitution [s/rad].

    By d (1 + e) = ln((1 + d) / (1 - d e)), see `damping_of`, with s = d (1 + e): ds/de =
    d / (1 - e - e d), which is -3 where e = 1.
    """
    e, v = scene.stroke.restitution, scene.stroke.impact_rate
    assert e is not None and v is not None
    d = float(damping_of(scene.stroke) * v)
    change = d / (1.0 - e - e * d) if d else -3.0
    return (change - d) / ((1.0 + e) * v)
