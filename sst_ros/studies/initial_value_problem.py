# SPDX-License-Identifier: Apache-2.0
"""The initial value problem of a work-precision study: a scene, its torques, its time span.

Torques are continuous functions of time, not held over control periods: zero where the scene has
none. The span ends at the first limit that stops the run. Compliant stops and torque limits have
kinks; there `Simulation`, which locates them, is the reference.
"""

from __future__ import annotations

import contextlib
import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sst_ros.dynamics.traced_dynamics import ODE, Dynamics
from sst_ros.errors import InputError, Problem, RunStopped
from sst_ros.integration.compiled_method import CompiledMethod
from sst_ros.mechanism import kinematics
from sst_ros.mechanism.frames import rotation_matrix
from sst_ros.mechanism.geometry import Array, Geometry
from sst_ros.report import states
from sst_ros.scene.scene import Scene
from sst_ros.simulation.simulation import NANOSECONDS, WHOLE_MOTION_BUDGET, Simulation
from sst_ros.state import TorqueFunction, Vector3

INTERVALS = 20
"""Solutions are compared at this many instants or more."""

WHOLE_RUN_S = 1.0
"""Time span of a scene that names no duration [s]."""


@dataclass(frozen=True)
class StateError:
    """Distance from the reference: orientation [rad], gamma [rad], gamma_dot [rad/s]."""

    orientation: float
    gamma: float
    gamma_dot: float


class InitialValueProblem:
    """A scene as an initial value problem.

    Args:
        scene: the scene.
        like: a problem whose instants of comparison are taken.

    Attributes:
        system: right-hand side, torques and work included.
        drive: its constant inputs, all zero.
        start: state at time zero, shape (n,).
        interval_ns: time between the instants of comparison [ns].
        count: number of intervals.
        ends: why the span ends before the scene's duration; empty where it does not.
        clamped: the torques exceed the limit of the actuators.
        kinked: the right-hand side has kinks.

    Raises:
        AssemblyError: the initial gamma has no unique admissible assembly.
        InputError: the scene cannot start, or stops at once.

    """

    def __init__(self, scene: Scene, like: InitialValueProblem | None = None) -> None:
        self.scene = scene
        self.geometry = Geometry.of(scene)
        self.dynamics = Dynamics.of(scene)
        self.system = ODE(self.dynamics, scene.torque, work=True)
        self.drive = (0.0,) * len(self.system.drive)
        self.start = (*states.initial(scene), 0.0)
        self.torque: Vector3 | TorqueFunction = scene.torque.at if scene.torque else (0.0, 0.0, 0.0)
        limit = scene.actuators.torque_limit if scene.actuators else None
        largest = max(map(abs, scene.torque.amplitude)) if scene.torque else 0.0
        self.clamped = limit is not None and largest > limit
        self.kinked = self.clamped or scene.stroke.at_end == "elastic"
        horizon = self._horizon() if like is None else (like.interval_ns, like.count, like.ends)
        self.interval_ns: int = horizon[0]
        self.count: int = horizon[1]
        self.ends: str = horizon[2]

    @property
    def interval(self) -> float:
        """Time between the instants of comparison [s]."""
        return self.interval_ns / NANOSECONDS

    @property
    def seconds(self) -> float:
        """Time span [s]."""
        return self.count * self.interval_ns / NANOSECONDS

    def errors(
        self, solution: Array | NDArray[np.longdouble], reference: NDArray[np.longdouble]
    ) -> tuple[StateError, StateError]:
        """Distances of states (count + 1, n) at the end, and the largest; nan where unknown."""
        chord = np.minimum(
            np.linalg.norm(solution[:, :4] - reference[:, :4], axis=1),
            np.linalg.norm(solution[:, :4] + reference[:, :4], axis=1),
        )
        angle = 4.0 * np.arcsin(np.minimum(0.5 * chord, 1.0))
        joints = np.abs(self.joints(solution) - self.joints(reference))
        gamma, rate = joints[:, :3].max(axis=1), joints[:, 9:12].max(axis=1)
        whole = tuple(float(values.max()) for values in (angle, gamma, rate))
        return StateError(float(angle[-1]), float(gamma[-1]), float(rate[-1])), StateError(*whole)

    def joints(self, solution: Array | NDArray[np.longdouble]) -> Array:
        """Nine angles [rad] and nine rates [rad/s] of states, shape (n, 18)."""
        result = np.full((len(solution), 18), np.nan)
        for row, y in enumerate(solution[:, :7].astype(float).tolist()):
            if all(map(math.isfinite, y)):
                with contextlib.suppress(ArithmeticError, ValueError):
                    result[row] = self.dynamics.joints(*y)
        return result

    def residuals(self, y: Array) -> tuple[float, float]:
        """Energy residual [J] and the largest abs(r_k . t_k) at a final state, shape (n,)."""
        size, zero = len(self.dynamics.state), (0.0,) * len(self.dynamics.drive)
        before, after = (
            sum(self.dynamics.energies(*state[:size], *zero)[:2])
            for state in (self.start, y.tolist())
        )
        r = kinematics.carriage_directions(self.geometry, self.joints(y[None])[0, :3])
        t = self.geometry.e @ rotation_matrix(y[:4]).T
        closure = float(np.abs(np.sum(r * t, axis=1)).max())
        return float(after - before - y[-1]), closure

    def fixed_steps(self, machine: CompiledMethod, steps: int) -> Array:
        """States at the instants with `steps` steps an interval; nan after the last finite one."""
        result = np.full((self.count + 1, len(self.start)), np.nan)
        y = list(self.start)
        result[0] = y
        h = self.interval / steps
        with contextlib.suppress(ArithmeticError, ValueError), np.errstate(all="ignore"):
            for k in range(self.count):
                y = machine.step_fixed(k * self.interval, h, steps, y, self.drive)
                result[k + 1] = y
        return result

    def simulated(self, method: str, tolerance: float, substeps: int = 1) -> Array:
        """States at the instants from `Simulation` with `substeps` control periods an interval.

        Raises:
            RunStopped: a limit is met.

        """
        simulation = Simulation(
            self.scene, method, tolerance=tolerance, step_budget=WHOLE_MOTION_BUDGET
        )
        rows = [np.array(self.start)]
        padding = (math.nan,) * (len(self.start) - 7)
        for k in range(self.count):
            for part in range(substeps):
                begin, end = (self.interval_ns * (part + n) // substeps for n in (0, 1))
                simulation.step(self.torque, end - begin)
            assert simulation.time_ns == (k + 1) * self.interval_ns
            state = simulation.state
            rows.append(np.array([*state.quaternion, *state.body_rate, *padding]))
        return np.array(rows)

    def _horizon(self) -> tuple[int, int, str]:
        whole = self.scene.duration or WHOLE_RUN_S
        simulation = Simulation(self.scene, tolerance=1e-9, step_budget=WHOLE_MOTION_BUDGET)
        ends = ""
        try:
            for _ in range(100):
                simulation.step(self.torque, round(whole / 100 * NANOSECONDS))
        except RunStopped as stopped:
            ends = f"stop at {stopped.time:.6f} s, {stopped.reason}"
            whole = stopped.time
        if whole * NANOSECONDS < 1000 * INTERVALS:
            allowed = f"the run is over before it can be studied: {ends or f'{whole} s'}"
            raise InputError(self.scene.name, [Problem("initial", whole, allowed)])
        interval = 10.0 ** math.floor(math.log10(whole / INTERVALS) + 1e-9)
        interval *= max(f for f in (1, 2, 5) if f * interval * INTERVALS <= whole * (1 + 1e-9))
        interval_ns = round(interval * NANOSECONDS)
        return interval_ns, math.floor(whole * NANOSECONDS * (1 + 1e-9) / interval_ns), ends
