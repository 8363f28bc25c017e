# SPDX-License-Identifier: Apache-2.0
"""Motions by steps with error control: any torque, control periods, limits, stiff scenes.

A second solution goes through each step of a run by two of half the length, which costs twice a
step: its distance is the error at the end. No order is assumed, as none holds where a torque
jumps, a clamp or a contact bends the motion, or friction is sharp. The steps halve where the run's
own steps are, whatever chose them. Where the method has its order, the second solution is nearly
exact, and the distance is the error; where each step loses its order, the error halves, and the
distance is half of the error.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from sst_ros.host.output import Bar
from sst_ros.integration.adaptive_stepper import CannotStep, EvaluationBudget, Step
from sst_ros.integration.applied_torque import Torque
from sst_ros.integration.codegen import numba_version
from sst_ros.integration.compiled_method import CompiledMethod, Point, has_step_code
from sst_ros.integration.methods import DORMAND_PRINCE
from sst_ros.integration.propagator import LimitReached, Propagator, orientation_distance
from sst_ros.mechanism.geometry import Array, Geometry
from sst_ros.scene.scene import Scene
from sst_ros.simulation.simulation import WHOLE_MOTION_BUDGET, start_of, unresolved
from sst_ros.simulation.torque_profile import FeedbackTorque, TorqueProfile, TorqueTable
from sst_ros.simulation.trajectory import Trajectory
from sst_ros.state import NANOSECONDS, State, Vector3

SAMPLES = 200
"""Intervals of a motion without `t_eval`."""

MOST_PERIODS = WHOLE_MOTION_BUDGET // (7 * len(DORMAND_PRINCE.a))
"""Control periods that the budget of a motion reaches: a step and its check take 7 thirds."""

UNMET = 2
"""Status of a motion that reached its end with an error estimate above the tolerance."""

_WORTH_LOADING, _WORTH_COMPILING = 20_000, 100_000
"""Evaluations after which a run goes on with compiled code that is there, and makes it: in plain
Python they take one second and five; to compile the steps of a method takes four."""

_ATTEMPTS, _FINEST = 4, 1e-14
"""Runs until the error estimate is at most the tolerance, and the least tolerance of a step."""

_MARGIN, _FLOOR = 2.0, 8 * 2.220446049250313e-16
"""Of the distance: an error that halves with the steps is twice as large; of rounding, a step."""


@dataclass(frozen=True)
class Task:
    """What is simulated."""

    scene: Scene
    torque: TorqueProfile
    span: int  # length of the motion [ns]
    period: int | None  # of control [ns]; None where torques are not held
    method: str  # name, or auto
    tolerance: float  # largest error estimate at the end [rad]
    breaks: Array  # further times at which the torques jump [s], ascending
    max_step: float  # longest step [s]
    times: np.ndarray | None  # of the samples [ns]; None for those that suit the method


def integrate(task: Task, reason: str, progress: bool) -> Trajectory:
    """Run a motion by steps, again by smaller ones if its error estimate exceeds the tolerance.

    A function whose torques are held is called once a period and may have a memory: one run.
    `reason` says why this method was chosen, "" where the caller chose it.
    """
    local = tolerance = task.tolerance
    spent = 0
    for _ in range(_ATTEMPTS):
        motion = SteppedMotion(task, local, spent, progress).run()
        motion.method += reason
        motion.evaluations = spent = spent + motion.evaluations
        excess = motion.error_estimate / tolerance
        if task.period is not None or motion.status < 0 or not excess > 1.0:
            break
        local = max(local / (5.0 * excess), _FINEST)
    if excess > 1.0:
        unmet = f"the error estimate {motion.error_estimate:.1e} rad exceeds the tolerance"
        motion.message = f"{motion.message}; {unmet} {tolerance:g} rad"
        motion.status = motion.status or UNMET
    return motion


class SteppedMotion:
    """One run of a motion, after others with so many evaluations that have been `spent`."""

    def __init__(self, task: Task, tolerance: float, spent: int, progress: bool) -> None:
        self._task, self._scene = task, task.scene
        self._end = task.span / NANOSECONDS
        self._budget = EvaluationBudget(WHOLE_MOTION_BUDGET, whole_run=True)
        self._propagator = Propagator(
            task.scene, task.method, tolerance, compiled=False, budget=self._budget,
            max_step=task.max_step, observe=self._pass,
        )  # fmt: skip
        self._method = self._propagator.method
        self._start = self._at = self._propagator.begin(list(start_of(task.scene)))
        self._finer, self._steps = list(self._at.y), 0
        self._bar = Bar(f"{self._scene.name}, simulating", progress)
        self._held: list[tuple[float, Vector3]] = []
        self._rows: list[tuple[float, ...]] = []  # time, state, torques, joints
        self._wanted: list[float] = (self._times() / NANOSECONDS)[::-1].tolist()
        self._torque: Torque = (0.0, 0.0, 0.0)
        self._time, self._period = 0.0, (0.0, 0.0)
        known = numba_version() is not None
        self._spent, self._compile_after = spent, _WORTH_LOADING if known else math.inf

    def run(self) -> Trajectory:
        """Go to the end or a limit."""
        status, time, stop = 0, 0.0, ""
        moment = (0.0, 0.0, 0.0) if self._propagator.dynamics.has_moment_topic else ()
        if self._task.period is not None:
            self._take_first()
        try:
            for time, h, end, torque in self._periods():
                self._torque = self._propagator.torque.acting(torque)
                self._period = time, end
                self._take_first()
                self._propagator.advance(self._at, time, h, 1, self._torque, moment)
        except LimitReached as reached:
            status, time, stop = 1, reached.time, reached.limit.reason
            self._sample(math.floor(time * NANOSECONDS) / NANOSECONDS)
        except (CannotStep, ArithmeticError, ValueError) as error:
            status, time = -1, self._time
            stop = unresolved(error, Geometry.of(self._scene), self._state(time))
            self._take(time, self._at)
        message = f"stopped at t = {time:.12f} s: {stop}" if stop else "reached the end"
        return self._trajectory(status, message)

    def _times(self) -> Array:
        """Return the times of the samples [ns]."""
        span, period = self._task.span, self._task.period
        if self._task.times is not None:
            return self._task.times
        if period is not None:
            return np.append(np.arange(0, span, period, dtype=np.int64), span)
        return np.unique(np.rint(np.linspace(0, span, SAMPLES + 1)).astype(np.int64))

    def _periods(self) -> Iterator[tuple[float, float, float, Torque]]:
        """Yield begin, length and end of periods [s], and the torque, smooth in each."""
        span, period, law = self._task.span, self._task.period, self._task.torque
        if period is not None:
            for start in range(0, span, period):
                time, stop = start / NANOSECONDS, min(start + period, span)
                at = (self._state(time),) if isinstance(law, FeedbackTorque) else ()
                held = law(time, *at)
                self._held.append((time, held))
                yield time, (stop - start) / NANOSECONDS, stop / NANOSECONDS, held
            return
        kinks = law.kinks(self._scene.torque_limit, self._end)
        breaks = np.union1d(self._task.breaks, kinks)
        inside = breaks[(breaks > 0.0) & (breaks < self._end)].tolist()
        for time, end in pairwise([0.0, *inside, self._end]):
            yield time, end - time, end, law.acting(time, end, self._propagator.dynamics)

    def _pass(self, step: Step) -> None:
        """Go with the second solution through a step of the run, and take samples in it."""
        self._budget.charge(4 * step.method.pair_cost // 3)
        self._steps += 1
        h = (step.t + step.h) - step.t  # between its ends, which are rounded
        try:  # a step is itself a pair of steps
            self._finer = step.method.step_fixed(step.t, 0.25 * h, 4, self._finer, step.drive)
        except (ArithmeticError, ValueError):
            self._finer = [math.nan] * len(self._finer)
        if self._spent + self._budget.spent > self._compile_after:
            self._compile(step.method)
        self._last, self._last_begin = step, self._period[0] + step.t
        end = self._period[1] if step.last else self._last_begin + step.h
        while self._wanted and self._wanted[-1] < end:
            self._sample(self._wanted.pop())
        if self._wanted and self._wanted[-1] == end:
            self._take(self._wanted.pop(), step.end)
        self._time, self._at = end, step.end
        self._bar.draw(end / self._end)

    def _compile(self, method: CompiledMethod) -> None:
        """Take compiled steps from now on, if their code is there or the run is long.

        Under a function only the derivative is compiled, which takes a second.
        """
        there = callable(self._torque) or has_step_code(
            method.system, method.method, ("step_pair", "step_fixed")
        )
        if there or self._spent + self._budget.spent > _WORTH_COMPILING:
            self._propagator.compile()
            self._compile_after = math.inf
        else:
            self._compile_after = _WORTH_COMPILING

    def _sample(self, time: float) -> None:
        """Take a sample inside the last step, by a pair of shorter ones."""
        step, x = self._last, time - self._last_begin
        if x > 0.0:
            y = step.method.step_fixed(step.t, 0.5 * x, 2, step.begin.y, step.drive)
            self._take(time, self._propagator.begin(y))

    def _take_first(self) -> None:
        if self._wanted and self._wanted[-1] == 0.0:
            self._take(self._wanted.pop(), self._at)

    def _take(self, time: float, at: Point) -> None:
        if not self._rows or self._rows[-1][0] < time:
            acting = self._propagator.acting(self._torque, time, at)
            self._rows.append((time, *at.y[:7], *acting, *at.joints))

    def _state(self, time: float) -> State:
        acting = self._propagator.acting(self._torque, time, self._at)
        return State.of(round(time * NANOSECONDS), self._at.y, self._at.joints, acting)

    def _trajectory(self, status: int, message: str) -> Trajectory:
        propagator, y = self._propagator, self._at.y
        energy, floor = propagator.dynamics.total_energy, _FLOOR * math.sqrt(self._steps + 1.0)
        rows = np.array(self._rows).reshape(-1, 29)
        changes = [f"{to} from {at:g} s ({why})" for at, to, why in propagator.changes]
        return Trajectory(
            self._scene,
            rows[:, 0],
            rows[:, 1:5],
            rows[:, 5:8],
            rows[:, 8:11],
            joints=rows[:, 11:],
            status=status,
            message=message,
            method=", then ".join([self._method, *changes]),
            error_estimate=max(_MARGIN * orientation_distance(y, self._finer), floor),
            energy_residual=energy(y) - energy(self._start.y) - y[-1],
            evaluations=self._budget.spent,
            step=self._time / max(self._steps, 1),
            law=TorqueTable(*zip(*self._held, strict=True)) if self._held else self._task.torque,
        )
