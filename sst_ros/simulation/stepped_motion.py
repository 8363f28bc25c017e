# SPDX-License-Identifier: Apache-2.0
"""A motion by steps with error control: any torque, control periods, limits, stiff scenes."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from itertools import pairwise

import numpy as np

from sst_ros.host.compiled_module import numba_version
from sst_ros.host.output import Bar
from sst_ros.integration.adaptive_stepper import (
    WHOLE_MOTION_BUDGET,
    CannotStep,
    EvaluationBudget,
    Step,
    orientation_distance,
)
from sst_ros.integration.applied_torque import Torque
from sst_ros.integration.compiled_method import CompiledMethod, has_step_code
from sst_ros.integration.propagator import LimitReached, Propagator
from sst_ros.mechanism.geometry import Array
from sst_ros.scene.scene import Scene
from sst_ros.simulation.torque_profile import TorqueProfile
from sst_ros.state import NANOSECONDS, State, Vector3

_WORTH_LOADING, _WORTH_COMPILING = 20_000, 100_000
"""Evaluations after which a run goes on with compiled code that is there, and makes it: in plain
Python they take one second and five; to compile the steps of a method takes four."""

_MANY, _WORST = 8, 0.07
"""Samples in a step from which on a polynomial costs less than a step for each; the share of the
step at which its error is largest."""


class SteppedMotion:
    """One run of a motion.

    Args:
        scene: what moves.
        law: torques that act.
        span: time at which the motion begins and ends [s].
        y: state at the begin; numbers that it lacks at its end are zero.
        times: of the samples [s], ascending, within the span.
        method, tolerance: as of `Propagator`.
        period: of control [ns], from time zero; None where torques are not held.
        breaks: further times at which the torques jump [s], ascending.
        max_step: longest step [s].
        limits: whether the limits of the scene end the motion.
        spent: evaluations of earlier runs of the same motion.
        progress: draw a bar on a terminal.

    Attributes:
        rows: of each sample time, quaternion, body rate, torques, angles and rates of the joints.
        held: times of control [s] and the torques from then on.
        start, at, time: first and last valid point, and time of the last [s].
        status, message: 0 at the end, 1 at a limit, -1 where no step resolves the motion; why.
        propagator: what made the steps.

    """

    def __init__(
        self,
        scene: Scene,
        law: TorqueProfile,
        span: tuple[float, float],
        y: Sequence[float] | Array,
        times: Array,
        *,
        method: str,
        tolerance: float,
        period: int | None = None,
        breaks: Sequence[float] | Array = (),
        max_step: float = math.inf,
        limits: bool = True,
        spent: int = 0,
        progress: bool = False,
    ) -> None:
        self._scene, self._law, self._span, self._period = scene, law, span, period
        self._breaks, self._tolerance, self._spent = breaks, tolerance, spent
        self._budget = EvaluationBudget(WHOLE_MOTION_BUDGET, whole_run=True)
        self.propagator = Propagator(
            scene, method, tolerance, compiled=False, budget=self._budget, limits=limits,
            max_step=max_step,
        )  # fmt: skip
        self.start = self.at = self.propagator.begin(list(y))
        self.time, self.status, self.message = span[0], 0, "reached the end"
        self.held: list[tuple[float, Vector3]] = []
        self.rows: list[tuple[float, ...]] = []
        self._wanted: list[float] = times[::-1].tolist()
        self._torque: Torque = (0.0, 0.0, 0.0)
        self._segment = span
        self._bar = Bar(f"{scene.name}, simulating", progress)
        self._compile_after = _WORTH_LOADING if numba_version() else math.inf

    @property
    def evaluations(self) -> int:
        """Evaluations of the derivative."""
        return self._budget.spent

    def run(self) -> SteppedMotion:
        """Go to the end or a limit: through segments of a smooth torque, by steps, to events."""
        moment = (0.0, 0.0, 0.0) if self.propagator.dynamics.has_moment_topic else ()
        try:
            for begin, h, end, torque in self._segments():
                self._segment = begin, end
                self._torque = self.propagator.torque.acting(torque)
                self._take_if_wanted(begin, self.at.y)
                with np.errstate(all="ignore"):
                    for step in self.propagator.steps(self.at, begin, h, self._torque, moment):
                        self._pass(step)
        except LimitReached as reached:
            self.status, stop = 1, reached.limit.reason
            self._take(math.floor(reached.time * NANOSECONDS) / NANOSECONDS, None)
            self.time = reached.time
        except (CannotStep, ArithmeticError, ValueError) as error:
            self.status, stop = -1, str(error) or "not finite"
            self._take(self.time, self.at.y)
        if self.status:
            self.message = f"stopped at t = {self.time:.12f} s: {stop}"
        return self

    def state(self) -> State:
        """Return the last valid state."""
        acting = self.propagator.acting(self._torque, self.time, self.at)
        return State.of(round(self.time * NANOSECONDS), self.at.y, self.at.joints, acting)

    def _segments(self) -> Iterator[tuple[float, float, float, Torque]]:
        """Yield begin, length and end of segments [s], and the torque, smooth in each."""
        begin, end = self._span
        if self._period is not None:
            last = round(end * NANOSECONDS)
            for start in range(0, last, self._period):
                time = start / NANOSECONDS
                self._take_if_wanted(time, self.at.y)
                given = (self.state(),) if self._law.feedback else ()
                held = self._law(time, *given)
                self.held.append((time, held))
                stop = min(start + self._period, last)
                yield time, (stop - start) / NANOSECONDS, stop / NANOSECONDS, held
            return
        kinks = np.union1d(self._breaks, self._law.kinks(self._scene.torque_limit, end))
        inside = kinks[(kinks > begin) & (kinks < end)].tolist()
        for start, stop in pairwise([begin, *inside, end]):
            yield start, stop - start, stop, self._law.acting(start, stop, self.propagator.dynamics)

    def _pass(self, step: Step) -> None:
        """Take samples in an accepted step."""
        if self._spent + self._budget.spent > self._compile_after:
            self._compile(step.machine)
        self._last, self._last_begin = step, self._segment[0] + step.t
        end = self._segment[1] if step.last else self._last_begin + step.h
        inside = []
        while self._wanted and self._wanted[-1] < end:
            inside.append(self._wanted.pop())
        polynomial = self._interpolate(step) if len(inside) >= _MANY else None
        for time in inside:
            y = None if polynomial is None else polynomial(time - self._last_begin)
            self._take(time, y)
        self.time, self.at = end, step.end
        self._take_if_wanted(end, step.end.y)
        self._bar.draw((end - self._span[0]) / (self._span[1] - self._span[0]))

    def _compile(self, machine: CompiledMethod) -> None:
        """Take compiled steps from now on, if their code is there or the run is long.

        Under a function only the derivative is compiled, which takes a second.
        """
        there = callable(self._torque) or has_step_code(
            machine.system, machine.method, ("step_pair", "step_fixed")
        )
        if there or self._spent + self._budget.spent > _WORTH_COMPILING:
            self.propagator.compile()
            self._compile_after = math.inf
        else:
            self._compile_after = _WORTH_COMPILING

    def _interpolate(self, step: Step) -> Callable[[float], Array] | None:
        """Return a polynomial of the time in a step, through states and slopes at its quarters.

        None where it misses the state by more than the tolerance, where its error is largest.
        """
        from scipy.interpolate import KroghInterpolator  # many runs have few samples

        times = [0.25 * k * step.h for k in range(5)]
        states = [step.begin.y, *map(step.state, times[1:-1]), step.end.y]
        slopes = [
            step.machine.slope(step.t + x, y, step.drive)
            for x, y in zip(times, states, strict=True)
        ]
        data = [row for pair in zip(states, slopes, strict=True) for row in pair]
        polynomial = KroghInterpolator(np.repeat(times, 2), data)
        worst = _WORST * step.h
        found, exact = polynomial(worst).tolist(), step.state(worst)
        speed = max(1.0, math.hypot(*exact[4:7]))
        missed = orientation_distance(found, exact), math.dist(found[4:], exact[4:]) / speed
        self._budget.charge(4 * step.machine.cost + len(times))
        return polynomial if max(missed) <= self._tolerance else None

    def _take_if_wanted(self, time: float, y: Sequence[float]) -> None:
        if self._wanted and self._wanted[-1] == time:
            self._take(self._wanted.pop(), y)

    def _take(self, time: float, y: Sequence[float] | Array | None) -> None:
        """Take a sample at a time; a state that is not given is stepped to."""
        if self.rows and self.rows[-1][0] >= time:
            return
        if y is None:
            x = time - self._last_begin
            self._budget.charge(self._last.machine.cost)
            y = self._last.state(x) if x > 0.0 else self._last.begin.y
        at = self.propagator.begin(list(y))
        acting = self.propagator.acting(self._torque, time, at)
        self.rows.append((time, *at.y[:7], *acting, *at.joints))
