# SPDX-License-Identifier: Apache-2.0
"""What a study of accuracy solves: a scene, its own torques, the time to its end, and the answer.

Torques are continuous functions of time, not held over ticks: zero where the scene has none. The
run is compared up to its first stop or impact. Elastic ends and limits of torque have kinks; there
`Simulation`, which finds them, is the reference.
"""

from __future__ import annotations

import contextlib
import dataclasses
import math
import time
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from sst_ros.control.torque_profiles import sine
from sst_ros.dynamics.traced_dynamics import Dynamics
from sst_ros.errors import InputError, Problem, RunStopped
from sst_ros.integration.compiled_method import Machine
from sst_ros.integration.methods import DOP853
from sst_ros.integration.ode import System
from sst_ros.mechanism import kinematics
from sst_ros.mechanism.frames import rotation_matrix
from sst_ros.mechanism.geometry import Array, Geometry
from sst_ros.report import states
from sst_ros.scene.scene import Scene
from sst_ros.simulation import NANOSECONDS, Simulation, Torque
from sst_ros.studies.high_precision import EXTENDED, Long, Precise

INTERVALS = 20
"""A run is compared at this many instants or more."""

PATIENCE_S = 20.0
"""The reference stays in double precision where the longer one would take more than this [s]."""

WHOLE_RUN_S = 1.0
"""Length of the run of a scene that names none [s]."""


@dataclass(frozen=True)
class Error:
    """Distance from the reference: orientation [rad], gamma [rad], gamma_dot [rad/s]."""

    orientation: float
    gamma: float
    gamma_dot: float


@dataclass(frozen=True)
class Reference:
    """The answer: states at the instants, its own error, and how it was found."""

    states: Long
    own: Error
    how: str


class Trial:
    """A scene made ready to be solved in many ways.

    Args:
        scene: what is solved.
        like: a trial whose instants are taken.

    Attributes:
        system: derivative by time, torques and work included.
        drive: constant inputs of it, all zero.
        start: state at time zero.
        interval_ns: time between the instants of comparison [ns].
        count: number of intervals.
        ends: why the run ends before the scene's duration; empty where it does not.

    Raises:
        AssemblyError: the initial gamma has no unique admissible assembly.
        InputError: the scene cannot start, or stops at once.

    """

    def __init__(self, scene: Scene, like: Trial | None = None) -> None:
        self.scene = scene
        self.geometry = Geometry.of(scene)
        self.dynamics = Dynamics.of(scene)
        self.system = System(self.dynamics, scene.torque, work=True)
        self.drive = (0.0,) * len(self.system.drive)
        self.start = (*states.initial(scene), 0.0)
        self.torque: Torque = sine(scene.torque) if scene.torque else (0.0, 0.0, 0.0)
        limit = scene.actuators.torque_limit if scene.actuators else None
        asked = max(map(abs, scene.torque.amplitude)) if scene.torque else 0.0
        self.clamped = limit is not None and asked > limit
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
        """Time over which the run is compared [s]."""
        return self.count * self.interval_ns / NANOSECONDS

    def errors(self, solution: Array | Long, reference: Long) -> tuple[Error, Error]:
        """Distances of states (count + 1, n) at the end, and the largest; nan where unknown."""
        turn = np.minimum(
            np.linalg.norm(solution[:, :4] - reference[:, :4], axis=1),
            np.linalg.norm(solution[:, :4] + reference[:, :4], axis=1),
        )
        angle = 4.0 * np.arcsin(np.minimum(0.5 * turn, 1.0))
        joints = np.abs(self.joints(solution) - self.joints(reference))
        gamma, rate = joints[:, :3].max(axis=1), joints[:, 9:12].max(axis=1)
        whole = tuple(float(values.max()) for values in (angle, gamma, rate))
        return Error(float(angle[-1]), float(gamma[-1]), float(rate[-1])), Error(*whole)

    def joints(self, solution: Array | Long) -> Array:
        """Nine angles and nine rates of states, shape (n, 18)."""
        result = np.full((len(solution), 18), np.nan)
        for row, y in enumerate(solution[:, :7].astype(float).tolist()):
            if all(map(math.isfinite, y)):
                with contextlib.suppress(ArithmeticError, ValueError):
                    result[row] = self.dynamics.joints(*y)
        return result

    def residuals(self, y: Array) -> tuple[float, float]:
        """Energy [J] that nobody has put in, and the largest abs(r_k . t_k), at a final state."""
        stored = []
        for state in (self.start, y.tolist()):
            size = len(self.dynamics.state)
            zero = (0.0,) * len(self.dynamics.drive)
            stored.append(sum(self.dynamics.energies(*state[:size], *zero)[:2]))
        joints = self.joints(y[None])[0]
        r = kinematics.carriage_directions(self.geometry, joints[:3])
        t = self.geometry.e @ rotation_matrix(y[:4]).T
        closure = float(np.abs(np.sum(r * t, axis=1)).max())
        return float(stored[1] - stored[0] - y[-1]), closure

    def reference(self, kind: str = EXTENDED, *, compiled: bool) -> Reference:
        """Solve it as well as can be.

        Args:
            kind: precise.EXTENDED or precise.MPMATH.
            compiled: search for the step size under numba.

        """
        return self._by_simulation() if self.kinked else self._by_steps(kind, compiled)

    @cached_property
    def _machine(self) -> Machine:
        return Machine(self.system, DOP853, compiled=False)

    def marched(self, machine: Machine, steps: int) -> Array:
        """States at the instants by so many steps an interval; nan after the last finite one."""
        result = np.full((self.count + 1, len(self.start)), np.nan)
        y = list(self.start)
        result[0] = y
        h = self.interval / steps
        try:
            with np.errstate(all="ignore"):
                for k in range(self.count):
                    y = machine.march(k * self.interval, h, steps, y, self.drive)
                    result[k + 1] = y
        except (ArithmeticError, ValueError):
            pass
        return result

    def _by_steps(self, kind: str, compiled: bool) -> Reference:
        machine = Machine(self.system, DOP853, compiled=True) if compiled else self._machine
        found: list[tuple[float, int, Array]] = []
        before = self.marched(machine, 1)
        for power in range(1, 14):
            after = self.marched(machine, 2**power)
            apart = self.errors(before, after.astype(np.longdouble))[1].orientation
            if math.isfinite(apart):
                found.append((apart, 2**power, after))
            done = len(found) > 1 and (apart < 1e-13 or apart > found[-2][0] < 1e-9)
            if done or self.count * 2**power > 200_000:
                break
            before = after
        if not found:
            raise InputError(self.scene.name, [Problem("duration", self.scene.duration,
                             "the reference finds no finite motion")])  # fmt: skip
        best = min(found, key=lambda row: row[0])
        precise = Precise(self.system.program, kind, self.drive)
        began = time.perf_counter()
        for _ in range(3):
            precise.evaluate(self.start)
        cost = (time.perf_counter() - began) / 3 * 1.5 * 12 * self.count
        steps = (3 * best[1] // 2, 2 * best[1])
        if kind != EXTENDED or cost * sum(steps) < PATIENCE_S:
            rough, fine = (precise.solve(self.start, self.interval, self.count, n) for n in steps)
            how = f"DOP853, {self.interval / steps[1]:.3g} s steps, {precise.numbers.name}"
        else:
            fine = best[2].astype(np.longdouble)
            rough = self.marched(machine, best[1] // 2).astype(np.longdouble)
            how = f"DOP853, {self.interval / best[1]:.3g} s steps, double precision"
        return Reference(fine, self._own(rough, fine), how)

    def _by_simulation(self) -> Reference:
        rough, fine = (self.simulated("dop853", eps)[0].astype(np.longdouble)
                       for eps in (1e-13, 1e-14))  # fmt: skip
        return Reference(fine, self._own(rough, fine), "Simulation, dop853, tolerance 1e-14")

    def _own(self, rough: Long, fine: Long) -> Error:
        """Tell twice what two step sizes differ by, but not less than what doubles can tell."""
        apart, joints = self.errors(rough, fine)[1], np.abs(self.joints(fine))
        gamma, rate = (2.3e-16 * float(joints[:, i : i + 3].max()) for i in (0, 9))
        return Error(max(2.0 * apart.orientation, 1e-17), max(2.0 * apart.gamma, gamma),
                     max(2.0 * apart.gamma_dot, rate))  # fmt: skip

    def simulated(self, method: str, tolerance: float) -> tuple[Array, Simulation]:
        """States at the instants by a `Simulation`, which runs as it does for everybody.

        Raises:
            RunStopped: it comes to an end before the others.

        """
        simulation = Simulation(self.scene, method, tolerance=tolerance)
        rows = [np.array(self.start)]
        for _ in range(self.count):
            now = simulation.step(self.torque, self.interval_ns)
            padding = (math.nan,) * (len(self.start) - 7)
            rows.append(np.array([*now.quaternion, *now.body_rate, *padding]))
        return np.array(rows), simulation

    def _horizon(self) -> tuple[int, int, str]:
        whole = self.scene.duration or WHOLE_RUN_S
        stopping = self.scene
        if self.scene.stroke.at_end == "impact":
            stroke = dataclasses.replace(self.scene.stroke, at_end="stop", restitution=None)
            stopping = dataclasses.replace(self.scene, stroke=stroke)
        simulation, ends = Simulation(stopping, tolerance=1e-9), ""
        try:
            for _ in range(100):
                simulation.step(self.torque, round(whole / 100 * NANOSECONDS))
        except RunStopped as stopped:
            what = "impact" if stopping is not self.scene else "stop"
            ends = f"{what} at {stopped.time:.6f} s, {stopped.reason}"
            whole = stopped.time
        if whole * NANOSECONDS < 1000 * INTERVALS:
            allowed = f"the run is over before it can be studied: {ends or f'{whole} s'}"
            raise InputError(self.scene.name, [Problem("initial", whole, allowed)])
        tick = 10.0 ** math.floor(math.log10(whole / INTERVALS) + 1e-9)
        tick *= max(f for f in (1, 2, 5) if f * tick * INTERVALS <= whole * (1 + 1e-9))
        interval_ns = round(tick * NANOSECONDS)
        return interval_ns, math.floor(whole * NANOSECONDS * (1 + 1e-9) / interval_ns), ends
