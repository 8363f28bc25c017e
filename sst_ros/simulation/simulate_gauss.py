# SPDX-License-Identifier: Apache-2.0
"""Motions by Gauss collocation: whole and smooth, under a profile that can be traced."""

from __future__ import annotations

import math
import threading
from bisect import bisect_left
from functools import lru_cache, partial

import numpy as np

from sst_ros.dynamics.expression import number_constants, trace
from sst_ros.dynamics.initial_state import start_of
from sst_ros.dynamics.model import Limit, limits_of
from sst_ros.dynamics.traced_dynamics import ODE, QUATERNION, RATE, Dynamics, limit_distances
from sst_ros.integration.events import first_event
from sst_ros.integration.gauss import Collocation, PreparedMotion
from sst_ros.integration.point import estimate_error, orientation_distance, state_distance
from sst_ros.mechanism.geometry import Array, Geometry
from sst_ros.scene.torque_profile import ConstantTorque, SineTorque
from sst_ros.simulation.stepped_motion import Task
from sst_ros.simulation.trajectory import Trajectory, check_error
from sst_ros.state import clamp

GAUSS = "gauss"

NODES = 8
"""Of a step, two registers of AVX2; the order is 16."""

_NEAR = 0.05
"""Distance above which no limit is met between nodes that resolve the motion to the tolerance."""

_HOPELESS, _SLOW = 128, 4.0
"""Steps from which on doubling them must bring two solutions of `auto` nearer by this factor:
smooth motions gain far more, those with kinks a factor of two."""
_FINEST_PER_SECOND, _FINEST = 1024, 4096
"""Steps a second beyond which `auto` turns to methods with error control, and the most of all."""
_ITERATIONS, _MOST_ITERATIONS = (5, 6, 8), 10
_ROUNDING = 1e-14
"""Least distance in the search."""


class NotSmooth(ArithmeticError):
    """Collocation does not reach the tolerance with steps worth taking."""


class CollocatedMotion:
    """The motion of a task by collocation, prepared once, for several threads.

    Where the task names the method it is compiled, tries hard, and keeps the finest motion if the
    tolerance is not met. The error of the orientation at the end is twice the distance of a
    solution by steps of half the length, at least rounding.

    Raises:
        NotSmooth: the motion is not one for collocation; gives the reason.

    """

    def __init__(self, task: Task) -> None:
        self._sine, held = _choose_torque(task)
        self._task, self._asked, scene = task, task.method == GAUSS, task.scene
        self._dynamics, self._lock = Dynamics.of(scene), threading.Lock()
        self._limits = tuple(limits_of(scene, Geometry.of(scene)))
        self._method = _collocation(self._dynamics, self._sine, self._limits, self._asked or None)
        self._start = [*start_of(scene), *(0.0 for _ in self._dynamics.state[7:])]
        self._drive = [*held, *(0.0 for _ in self._dynamics.drive[3:])]
        self._end = task.span[1]
        self._count, self._iterations, self._error = self._choose_steps(task.tolerance)
        self._h = self._end / self._count
        self._grid: Array = np.append(np.arange(float(self._count)) * self._h, self._end)
        self._motion = self._prepare(self._method, self._count, self._iterations)
        self._single = self._prepare(self._method, 1, self._iterations + 1)
        self._states = self.compute()
        self._met, times = self._find_limit(), task.times
        if self._met:
            times = np.append(times[times < self._end], self._end)
        self._repeat = self._trajectory(times).repeater()

    def compute(self) -> Array:
        """Compute the states at the ends of the steps, shape (steps + 1, numbers of the state)."""
        with self._lock:
            self._motion.run()
            y: Array = self._motion.states.copy()
            return y

    def run(self, _progress: bool = False) -> Trajectory:
        """Compute the motion, too short for a bar; its samples when they are first asked for."""
        return self._repeat(partial(self.at, self.compute()))

    def at(self, ends: Array, times: Array) -> Array:
        """States at times [s], each by one step from the beginning of its step: (m, numbers).

        `ends` are the states at the ends of the steps.
        """
        steps = np.searchsorted(self._grid, times, side="right") - 1
        pairs = zip(steps.tolist(), (times - self._grid[steps]).tolist(), strict=True)
        with self._lock:  # all of them use the same arrays
            rows = [self._inside(ends, k, x) for k, x in pairs]
        return np.array(rows).reshape(len(times), -1)

    def _inside(self, ends: Array, k: int, x: float) -> list[float]:
        """State x [s] after step k began; that of the run itself where it begins, or all end."""
        begin: list[float] = ends[k].tolist()
        if x == 0.0:
            return begin
        self._single.begin(float(self._grid[k]), x, begin, self._drive)
        self._single.run()
        end: list[float] = self._single.states[-1].tolist()
        return end

    def _find_limit(self) -> Limit | None:
        """Return the first limit that is met, if there is one; the motion ends there."""

        def joints(k: int, x: float) -> tuple[float, ...]:
            return self._dynamics.joints(*self._inside(self._states, k, x)[:7])

        if self._limits and self._motion.least.min() <= _NEAR:
            for k, begin in enumerate(self._grid[:-1].tolist()):
                if met := first_event(self._limits, partial(joints, k), self._h):
                    self._end = begin + met[0]
                    return met[1]
        return None

    def _trajectory(self, t: Array) -> Trajectory:
        task, status, message = self._task, 0, "reached the end"
        if self._met:
            status, message = 1, f"stopped at t = {self._end:.12f} s: {self._met.reason}"
        status, message = check_error(self._error, task.tolerance, status, message)
        return Trajectory(
            task.scene,
            t,
            status=status,
            message=message,
            method=f"gauss, order {2 * NODES}: {self._count} steps of {self._h:.3g} s, "
            f"{self._iterations} iterations"
            + ("" if self._asked else " (auto: a smooth motion under a profile)"),
            error_estimate=self._error,
            energy_residual=self._balance_energy,
            evaluations=self._count * self._iterations * NODES,
            step=self._h,
            law=task.torque,
            dense=partial(self.at, self._states),
            parameters=task.parameters,
        )

    def _balance_energy(self) -> float:
        """Energy at the end, less that at the start, less the work done by another motion [J]."""
        method = Collocation(ODE(self._dynamics, self._sine, work=True), NODES, compiled=False)
        motion = self._prepare(method, self._count, self._iterations)
        motion.run()
        end = self.at(self._states, np.array([self._end]))[0].tolist()
        energy = self._dynamics.total_energy
        return energy(end) - energy(self._start) - float(motion.states[-1, -1])

    def _choose_steps(self, tolerance: float) -> tuple[int, int, float]:
        """Choose steps and iterations of least cost for the tolerance, and estimate their error."""
        most = _FINEST if self._asked else min(_FINEST, 16 + _FINEST_PER_SECOND * self._end)
        count, iterations, distance = 1, _MOST_ITERATIONS, math.inf
        y, z = self._solve(1), self._solve(2)
        while True:
            last, distance = distance, state_distance(y, z)
            if distance < max(_ROUNDING, 0.01 * tolerance):
                near = max(0.45 * tolerance, _ROUNDING)
                count, iterations = self._save(2 * count, z, near)
                y, z = self._solve(count, iterations), self._solve(2 * count)
                break
            slow = count >= _HOPELESS and not _SLOW * distance < last
            if 4 * count > most or (slow and not self._asked):
                break
            count, y, z = 2 * count, z, self._solve(4 * count)
        error = estimate_error(orientation_distance(y, z), count)
        if error <= tolerance or (self._asked and error < math.inf):
            return count, iterations, error
        raise NotSmooth(f"{count} steps of collocation do not reach {tolerance:g} rad")

    def _save(self, count: int, end: list[float], near: float) -> tuple[int, int]:
        """Choose the cheapest steps, fewer than `count`, and iterations that end `near` the end."""
        ladder, best, cost = [count], (count, _MOST_ITERATIONS), math.inf
        while ladder[0] > 1:
            ladder.insert(0, min(ladder[0] - 1, int(0.82 * ladder[0])))

        def reaches(steps: int, iterations: int) -> bool:
            return state_distance(self._solve(steps, iterations), end) <= near

        for iterations in _ITERATIONS:
            cheaper = [steps for steps in ladder if steps * iterations < cost]
            found = bisect_left(cheaper, True, key=partial(reaches, iterations=iterations))
            if found < len(cheaper):
                best, cost = (cheaper[found], iterations), cheaper[found] * iterations
        return best

    def _solve(self, count: int, iterations: int = _MOST_ITERATIONS) -> list[float]:
        """Return quaternion and body rate at the end, infinite where they are not finite."""
        motion = self._prepare(self._method, count, iterations)
        try:
            change = motion.run()
        except (ArithmeticError, ValueError):
            change = math.inf
        return motion.states[-1, :7].tolist() if math.isfinite(change) else [math.inf] * 7

    def _prepare(self, method: Collocation, count: int, iterations: int) -> PreparedMotion:
        y = [*self._start, *(0.0 for _ in range(len(self._start), method.size))]
        motion = PreparedMotion(method, count, iterations)
        motion.begin(0.0, self._end / count, y, self._drive)
        return motion


@lru_cache(maxsize=32)
def _collocation(
    dynamics: Dynamics, sine: SineTorque | None, limits: tuple[Limit, ...], compiled: bool | None
) -> Collocation:
    program = None
    if limits:
        pairs = tuple((math.cos(limit.end), math.sin(limit.end)) for limit in limits)
        ends = number_constants(pairs, ("ends",))
        program = trace(
            lambda *state: limit_distances(limits, ends, dynamics.numbers, state)[: len(limits)],
            (*QUATERNION, *RATE),
        )
    return Collocation(ODE(dynamics, sine), NODES, limits=program, compiled=compiled)


def _choose_torque(task: Task) -> tuple[SineTorque | None, tuple[float, ...]]:
    """Return the sine that is traced into the code, and the torques that are constant."""
    law, stroke, limit = task.torque, task.scene.stroke.at_end, task.scene.torque_limit
    if len(task.breaks) or task.max_step < task.span[1]:
        raise NotSmooth("collocation takes no breaks and no max_step")
    if task.period is not None or not isinstance(law, (SineTorque, ConstantTorque)):
        raise NotSmooth("collocation takes constant torques and sines only")
    if stroke not in ("stop", "ignore"):
        raise NotSmooth(f"collocation does not take a stroke with at_end: {stroke}")
    if isinstance(law, ConstantTorque):
        return None, clamp(law.torque, limit)
    if limit is not None and max(map(abs, law.amplitude)) > limit:
        raise NotSmooth("collocation does not take a sine that the torque limit cuts")
    return law, ()
