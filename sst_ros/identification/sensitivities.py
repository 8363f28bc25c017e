# SPDX-License-Identifier: Apache-2.0
"""Sensitivities of a motion to constants of its scene and to its initial rates.

With y' = f(y, t, p) the sensitivity S = dy/dp obeys the variational equation

    S' = (df/dy) S + df/dp,  S(0) = dy(0)/dp

(Hairer, Norsett and Wanner, Solving Ordinary Differential Equations I, section I.14). Both
derivatives are those of the traced equation of motion, exact to rounding, and are integrated with
the motion, so that one error control holds for both.

Where an elastic stop is met or left its torque is zero on both sides: f is continuous, and S as
well. A jump (saltation) would follow from a jump of f alone (Leine and Nijmeijer, Dynamics and
Bifurcations of Non-Smooth Mechanical Systems, Springer 2004, section 7.2).
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from functools import cached_property
from typing import Any

import numpy as np
from scipy.integrate import solve_ivp

from sst_ros.control.actuator_space import ActuatorSpaceMap
from sst_ros.dynamics import kernel
from sst_ros.dynamics.expression import with_jacobian
from sst_ros.dynamics.initial_state import initial_state
from sst_ros.dynamics.model import damping_of
from sst_ros.dynamics.traced_dynamics import LAG, QUATERNION, RATE, TORQUE, compile_program
from sst_ros.errors import InputError, Problem
from sst_ros.identification import parameters
from sst_ros.identification.regressor import present
from sst_ros.identification.scene_numbers import value_of
from sst_ros.mechanism.generic_math import quaternion_rate
from sst_ros.mechanism.geometry import Array, Geometry
from sst_ros.scene.scene import Scene
from sst_ros.simulation.torque_profile import TorqueProfile

TOLERANCE = 1e-12
"""Relative and absolute, of a step; the latter over the size of a parameter for its column."""

AT_STOPS = 0.1
"""Of the tolerance where stops are elastic: derivatives jump there, and a step across loses its
order."""

GEOMETRY = ("base", "star.alpha_deg", "star.radius", "workspace", "stroke.at_end")
RESTITUTION = "stroke.restitution"


class Sensitivities:
    """Motions of a scene and their derivatives by parameters.

    Args:
        scene: what moves.
        names: numbers of the scene by key, as "friction.gamma.smoothing", "initial.gamma_dot[0]"
            or "actuators.time_constant"; a list without index means all of its entries.
        torque: torques over time.

    Raises:
        InputError: a key is not a number of the scene, or one of its geometry.

    """

    def __init__(self, scene: Scene, names: Sequence[str], torque: TorqueProfile) -> None:
        self.scene, self.names = scene, tuple(names)
        self._torque, self._geometry = torque, Geometry.of(scene)
        problems = []
        for name in self.names:
            value = value_of(scene, name)
            if value is None:
                allowed = "must be the key of a number that the scene has"
                problems.append(Problem("parameters", name, allowed))
            elif name.startswith(GEOMETRY):
                allowed = "is geometry, which is taken as known"
                problems.append(Problem("parameters", name, allowed))
        if problems:
            raise InputError("identify", problems)
        self._inner = [i for i, name in enumerate(self.names) if not name.startswith("initial")]
        lag = scene.actuators is not None and scene.actuators.time_constant is not None
        self._state = (*QUATERNION, *RATE, *(LAG if lag else ()))

    def run(self, values: Array, t: Array) -> tuple[Array, Array]:
        """Integrate the motion and its sensitivities.

        Args:
            values: of the parameters, shape (p,).
            t: times [s], ascending from 0 on, shape (n,).

        Returns:
            States (q, W and lagged torques), shape (n, m), and their derivatives, (n, m, p).

        Raises:
            InputError: the motion cannot be integrated with these values.

        """
        # Inertias between iterations of a fit need not be those of bodies that can exist.
        outer = [i for i, name in enumerate(self.names) if name.startswith(("initial", "stroke"))]
        scene = self.scene.with_values({self.names[i]: float(values[i]) for i in outer})
        inner = values[self._inner].copy()
        chain = np.ones(len(values))
        if RESTITUTION in self.names:
            chain[self.names.index(RESTITUTION)] = damping_slope(scene)
            inner[self._inner.index(self.names.index(RESTITUTION))] = damping_of(scene.stroke)
        state, slopes = self._start(scene)
        size, count = len(self._state), len(values)
        scale = np.abs(values) + (values == 0.0)
        y = np.concatenate([state, (slopes * scale).ravel()])
        slope, torque = self._slope, self._torque
        given = inner.tolist()

        def rates(time: float, y: Array, acting: Callable[[float], Any]) -> Array:
            found = np.array(slope(*y[:size].tolist(), *acting(time), *given))
            derivative = found.reshape(-1, size)
            into = np.zeros((size, count))
            into[:, self._inner] = derivative[1 + size :].T
            flow = derivative[1 : 1 + size].T @ y[size:].reshape(size, count)
            return np.concatenate([derivative[0], (flow + into * (chain * scale)).ravel()])

        tolerance = TOLERANCE * (AT_STOPS if scene.stroke.at_end == "elastic" else 1.0)
        breaks = torque.breaks()
        inside = breaks[(breaks > 0.0) & (breaks < t[-1])]
        ends = np.unique(np.concatenate([inside, [t[-1]]]))
        rows, begin = np.empty((len(t), len(y))), 0.0
        rows[t <= 0.0] = y
        for end in ends.tolist():
            here = (t > begin) & (t <= end)
            try:
                run = solve_ivp(
                    rates, (begin, end), y, "DOP853", np.union1d(t[here], end),
                    rtol=tolerance, atol=tolerance, args=(torque.between(begin, end),),
                )  # fmt: skip
            except (ArithmeticError, ValueError):
                run = None
            if run is None or run.status != 0:
                problem = Problem("parameters", values.tolist(), "leave no motion to the last time")
                raise InputError("identify", [problem])
            rows[here], y, begin = run.y.T[: int(here.sum())], run.y[:, -1], end
        sensitivity = rows[:, size:].reshape(len(t), size, count) / scale
        return rows[:, :size], sensitivity

    @cached_property
    def _slope(self) -> Callable[..., tuple[float, ...]]:
        symbols = tuple(f"p{i}" for i in range(len(self._inner)))
        program = with_jacobian(
            self._derivative, (*self._state, *TORQUE, *symbols), (*self._state, *symbols)
        )
        return compile_program(program)

    def _derivative(self, *inputs: Any) -> tuple[Any, ...]:
        size = len(self._state)
        names = [self.names[i] for i in self._inner]
        symbols = dict(zip(names, map(present, inputs[size + 3 :]), strict=True))
        damping = symbols.pop(RESTITUTION, None)
        opened = parameters.with_symbols(self.scene, symbols)
        if damping is not None:
            opened.stroke.restitution, opened.stroke.damping = None, damping
        model = kernel.model_of(opened, self._geometry)
        return kernel.derivative(model, inputs[:size], inputs[size : size + 3])

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
            if not name.startswith("initial"):
                continue
            index = re.search(r"\[(\d)\]", name)
            unit = np.ones(3) if index is None else np.eye(3)[int(index[1])]
            turn = body_rate(quaternion, unit)
            if name.startswith("initial.gamma_dot"):
                slopes[4:7, column] = turn
                continue
            along: Any = np.array(quaternion_rate(tuple(quaternion), tuple(turn)))
            slopes[:4, column] = along
            # Complex step: exact to rounding, as the map is rational.
            slopes[4:7, column] = body_rate(quaternion + 1e-30j * along, rate).imag / 1e-30
        return state, slopes


def damping_slope(scene: Scene) -> float:
    """Return the derivative of the damping of elastic stops by the restitution [s/rad].

    From s = d (1 + e), L(s/2) = (1 - e) / (1 + e) with Langevin's function L, see
    `damping_of`: ds/de = -4 / ((1 + e)^2 L'(s/2)), L'(x) = 1/x^2 - 1/sinh(x)^2.
    """
    e, v = scene.stroke.restitution, scene.stroke.impact_rate
    assert e is not None and v is not None
    d = damping_of(scene.stroke) * v
    x = 0.5 * d * (1.0 + e)
    if x < 0.05:  # the difference would cancel
        slope = 1.0 / 3.0 - x * x / 15.0 + 2.0 * x**4 / 189.0 - x**6 / 675.0
    else:
        slope = 1.0 / x**2 - 1.0 / np.sinh(min(x, 300.0)) ** 2
    return float((-4.0 / ((1.0 + e) ** 2 * slope) - d) / ((1.0 + e) * v))
