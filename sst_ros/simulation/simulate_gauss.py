# SPDX-License-Identifier: Apache-2.0
"""Motions by Gauss collocation: whole and smooth, under a profile that can be traced."""

from __future__ import annotations

import math
import threading
from collections.abc import Sequence
from functools import cached_property, lru_cache, partial
from typing import Any

import numpy as np

from sst_ros.dynamics import kernel
from sst_ros.dynamics.expression import Program, number_constants, trace
from sst_ros.dynamics.model import Limit, limits_of
from sst_ros.dynamics.traced_dynamics import ODE, QUATERNION, RATE, Dynamics
from sst_ros.integration.events import first_event, limit_distances
from sst_ros.integration.gauss import NODES, Collocation, PreparedMotion, tables
from sst_ros.integration.propagator import orientation_distance
from sst_ros.mechanism.geometry import Array, Geometry
from sst_ros.scene.loads import SineTorque
from sst_ros.scene.scene import Scene
from sst_ros.simulation.simulate_steps import Task
from sst_ros.simulation.simulation import start_of
from sst_ros.simulation.torque_profile import ConstantTorque, SineProfile
from sst_ros.simulation.trajectory import Trajectory
from sst_ros.state import NANOSECONDS, clamp

GAUSS = "gauss"

NEAR = 0.05
"""Distance above which no limit is met between nodes that resolve the motion to the tolerance."""

_ROUNDING = 1e-14
_HOPELESS, _SLOW = 128, 4.0
"""Steps from which on doubling them must bring two solutions nearer by this factor: a motion that
is smooth enough gains far more, one with kinks a factor of two."""
_FINEST_PER_SECOND, _FINEST = 1024, 4096
"""Steps a second beyond which `auto` turns to methods with error control, and the most of all."""
_ITERATIONS = (5, 6, 8)
_MOST_ITERATIONS = 10


class NotSmooth(ArithmeticError):
    """Collocation does not reach the tolerance with steps worth taking."""


class GaussMotion:
    """A motion over a span of time, prepared for a tolerance.

    Args:
        scene: what moves, without contacts.
        torque: the sine that acts, or three constant torques within the actuators' limit [N m].
        y: state at t = 0.
        duration: [s].
        tolerance: largest error estimate of the orientation at the end [rad].
        compiled: by numba; None where its machine code is there already.
        finest: most steps that are tried.

    Attributes:
        count, iterations, h: steps, evaluations of all nodes in a step, length of a step [s].
        error: estimated error of the orientation at the end [rad], from a finer solution.
        samples: states at the times of `grid`, shape (count + 1, numbers of the state).

    Raises:
        NotSmooth: the tolerance is not reached.

    """

    def __init__(
        self,
        scene: Scene,
        torque: SineTorque | tuple[float, float, float],
        y: Sequence[float],
        duration: float,
        tolerance: float,
        *,
        compiled: bool | None = True,
        finest: int = _FINEST,
    ) -> None:
        self._torque = torque
        self._dynamics = Dynamics.of(scene)
        self._limits = tuple(limits_of(scene, Geometry.of(scene)))
        sine = torque if isinstance(torque, SineTorque) else None
        held = () if isinstance(torque, SineTorque) else torque
        self._drive = (*held, *(0.0,) * (len(self._dynamics.drive) - 3))
        parts = self._dynamics, sine, self._limits
        self._method = _compile_collocation(*parts) if compiled else _collocation(*parts, compiled)
        self._y, self._duration, self._finest = list(y), duration, finest
        self.count, self.iterations, self.error = self._settings(tolerance)
        self.h = duration / self.count
        self._motion = self._prepare(self.count, self.iterations)
        self._single = self._prepare(1, self.iterations + 1)
        self._lock = threading.Lock()
        self.samples = self.run()

    def run(self) -> Array:
        """Compute the states at the times of `grid`, shape (count + 1, numbers of the state)."""
        with self._lock:
            self._motion.run()
            return self._motion.states

    @property
    def evaluations(self) -> int:
        """Evaluations of the derivative in a run."""
        return self.count * self.iterations * NODES

    @cached_property
    def grid(self) -> Array:
        """Times at which steps begin and the last one ends [s], shape (count + 1,)."""
        times: Array = self.h * np.arange(self.count + 1.0)
        times[-1] = self._duration
        return times

    @cached_property
    def ending(self) -> tuple[float, Limit] | None:
        """Time at which the first limit is met [s], and the limit; None where none is."""
        if not self._limits or self._motion.least_distances.min() > NEAR:
            return None
        for k in range(self.count):
            met = first_event(self._limits, lambda x: self._joints(k, x), self.h)  # noqa: B023
            if met is not None:
                return float(self.grid[k]) + met[0], met[1]
        return None

    def at(self, times: Array) -> Array:
        """States at times [s], each by one step from the beginning of its step: (m, numbers)."""
        steps = np.clip(np.searchsorted(self.grid, times, side="right") - 1, 0, self.count - 1)
        with self._lock:  # all of them use the same arrays
            ends = [
                self._inside(int(k), float(t) - float(self.grid[k]))
                for k, t in zip(steps, times, strict=True)
            ]
        return np.array(ends).reshape(len(times), -1)

    def energy_residual(self, end: float) -> float:
        """Energy at `end` [s], less that at 0, less the work done, by Gauss quadrature [J]."""
        model, rows = self._dynamics.model, tables(NODES)
        last = max(1, math.ceil(end / self.h - 1e-9))
        begins = self.grid[:last]
        lengths = np.minimum(self.grid[1 : last + 1], end) - begins
        times = (begins[:, None] + lengths[:, None] * rows[0]).ravel()
        weights = (lengths[:, None] * rows[1]).ravel()
        y = tuple(self.at(times).T)
        torque: Any = tuple(self.torque(times).T)
        work = float(np.sum(weights * kernel.power(model, y, torque)))
        start, stop = map(self._dynamics.total_energy, self.at(np.array([0.0, end])).tolist())
        return stop - start - work

    def torque(self, times: Array) -> Array:
        """Torques that are commanded at times [s], shape (m, 3) [N m]."""
        if isinstance(self._torque, SineTorque):
            return self._torque.values(times)
        return np.tile(self._torque, (len(times), 1))

    def _inside(self, k: int, x: float) -> Sequence[float]:
        """State x [s] after step k began."""
        begin: list[float] = self.samples[k].tolist()
        if x == 0.0:
            return begin
        self._single.begin(float(self.grid[k]), begin, self._drive)
        self._single.set_step(x)
        self._single.run()
        return self._single.end

    def _joints(self, k: int, x: float) -> tuple[float, ...]:
        return self._dynamics.joints(*self._inside(k, x)[:7])

    def _prepare(self, count: int, iterations: int) -> PreparedMotion:
        return self._method.prepare(
            0.0, self._duration / count, count, self._y, self._drive, iterations=iterations
        )

    def _settings(self, tolerance: float) -> tuple[int, int, float]:
        """Choose steps and iterations that reach the tolerance at the least cost; their error."""
        fine = max(_ROUNDING, 0.01 * tolerance)
        count, end = self._converge(tolerance, fine)
        cost, best = math.inf, (count, _MOST_ITERATIONS, fine)
        for iterations in _ITERATIONS:
            steps = count
            while steps > 0:
                if steps * iterations < cost:
                    error = _apart(self._end(steps, iterations), end)
                    if not error <= 0.5 * max(tolerance, 2.0 * _ROUNDING):
                        break
                    cost, best = steps * iterations, (steps, iterations, max(error, _ROUNDING))
                steps = min(steps - 1, int(0.82 * steps))
        return best

    def _converge(self, tolerance: float, fine: float) -> tuple[int, list[float]]:
        """Double the steps until two ends are the same to `fine`; return them and the last end."""
        count, before, distance = 1, [math.nan] * 7, math.inf
        while count <= self._finest:
            end = self._end(count, _MOST_ITERATIONS)
            apart = _apart(before, end)
            if apart < fine:
                return count, end
            if count > _HOPELESS and not _SLOW * apart < distance:
                break
            count, before, distance = 2 * count, end, apart
        raise NotSmooth(f"{count} steps of collocation do not reach {tolerance:g} rad")

    def _end(self, count: int, iterations: int) -> list[float]:
        """State at the end by so many steps and iterations, nan where it is not finite."""
        motion = self._prepare(count, iterations)
        try:
            change = motion.run()
        except (ArithmeticError, ValueError):
            change = math.inf
        return motion.end if math.isfinite(change) else [math.nan] * 7


def _apart(one: Sequence[float], other: Sequence[float]) -> float:
    """Angle between two orientations, or the distance of the body rates where it is larger."""
    speed = max(1.0, math.hypot(*other[4:7]))
    distance = max(orientation_distance(one, other), math.dist(one[4:7], other[4:7]) / speed)
    return distance if math.isfinite(distance) else math.inf


@lru_cache(maxsize=32)
def _collocation(
    dynamics: Dynamics, sine: SineTorque | None, limits: tuple[Limit, ...], compiled: bool | None
) -> Collocation:
    program: Program | None = None
    if limits:
        pairs = tuple((math.cos(limit.end), math.sin(limit.end)) for limit in limits)
        ends = number_constants(pairs, ("ends",))
        program = trace(
            lambda *state: limit_distances(limits, ends, dynamics.numbers, state)[: len(limits)],
            (*QUATERNION, *RATE),
        )
    return Collocation(ODE(dynamics, sine), limits=program, compiled=compiled)


@lru_cache(maxsize=32)
def _compile_collocation(
    dynamics: Dynamics, sine: SineTorque | None, limits: tuple[Limit, ...]
) -> Collocation:
    found = _collocation(dynamics, sine, limits, compiled=True)
    # Those that run in plain Python, as there was no code, find it from now on.
    _collocation.cache_clear()
    return found


class CollocatedMotion:
    """The motion of a task by collocation, prepared once.

    Where the caller has chosen this method it is compiled, and tries hard.

    Raises:
        NotSmooth: the motion is not one for collocation; gives the reason.

    """

    def __init__(self, task: Task) -> None:
        torque = _choose_torque(task)
        self._task, asked = task, task.method == GAUSS
        start = [*start_of(task.scene), *((0.0,) * 3 if task.scene.lags else ())]
        duration = task.span / NANOSECONDS
        finest = _FINEST if asked else min(_FINEST, round(16 + _FINEST_PER_SECOND * duration))
        how: Any = {"compiled": asked or None, "finest": finest}
        self._motion = motion = GaussMotion(
            task.scene, torque, start, duration, task.tolerance, **how
        )
        self._end, status, message = duration, 0, "reached the end"
        if motion.ending is not None:
            self._end, limit = motion.ending
            status, message = 1, f"stopped at t = {self._end:.12f} s: {limit.reason}"
        chosen = "" if asked else " (auto: a smooth motion under a profile)"
        self._of_the_run: dict[str, Any] = {
            "status": status,
            "message": message,
            "method": f"gauss, order {2 * NODES}: {motion.count} steps of {motion.h:.3g} s, "
            f"{motion.iterations} iterations{chosen}",
            "error_estimate": motion.error,
            "evaluations": motion.evaluations,
            "step": motion.h,
            "law": task.torque,
            "energy_residual": partial(motion.energy_residual, self._end),
            "dense": motion.at,
        }
        self._whole = None if status else self._trajectory(motion.grid, motion.samples)

    def run(self, _progress: bool) -> Trajectory:
        """Compute the motion; it is too short for a bar."""
        times = self._task.times
        if times is None and self._whole is not None:
            y = self._motion.run()
            y.flags.writeable = False
            return self._whole.with_states(y)
        t = self._motion.grid if times is None else times / NANOSECONDS
        if self._whole is None:
            t = np.append(t[t < self._end], self._end)
        return self._trajectory(t, self._motion.at(t))

    def _trajectory(self, t: Array, y: Array) -> Trajectory:
        torque = y[:, 7:10] if self._task.scene.lags else self._motion.torque(t)
        return Trajectory(self._task.scene, t, y[:, :4], y[:, 4:7], torque, **self._of_the_run)


def _choose_torque(task: Task) -> SineTorque | tuple[float, float, float]:
    """Return the torque that is traced into the code, or three that are constant.

    Raises:
        NotSmooth: there is none, or the scene has jumps.

    """
    law, stroke, limit = task.torque, task.scene.stroke.at_end, task.scene.torque_limit
    if len(task.breaks) or task.max_step < task.span / NANOSECONDS:
        raise NotSmooth("collocation takes no breaks and no max_step")
    if task.period is not None or not isinstance(law, (SineProfile, ConstantTorque)):
        raise NotSmooth("collocation takes constant torques and sines only")
    if stroke not in ("stop", "ignore"):
        raise NotSmooth(f"collocation does not take a stroke with at_end: {stroke}")
    if isinstance(law, ConstantTorque):
        return clamp(law.torque, limit)
    if limit is not None and max(map(abs, law.sine.amplitude)) > limit:
        raise NotSmooth("collocation does not take a sine that the torque limit cuts")
    return law.sine
