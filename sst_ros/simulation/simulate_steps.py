# SPDX-License-Identifier: Apache-2.0
"""Motions by the steps of `Simulation`: any torque, control periods, limits, stiff scenes."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np

from sst_ros.errors import Diverged, RunStopped
from sst_ros.host.output import slices
from sst_ros.integration.applied_torque import StateFeedback
from sst_ros.integration.methods import RK4, RODAS4
from sst_ros.scene.scene import Scene
from sst_ros.simulation.simulation import WHOLE_MOTION_BUDGET, Simulation
from sst_ros.simulation.torque import TorqueTable
from sst_ros.simulation.torque_profile import FeedbackFunction, SineProfile, TorqueProfile, three
from sst_ros.simulation.trajectory import Trajectory
from sst_ros.state import NANOSECONDS, State, Vector3, clamp

SAMPLES = 200
"""Intervals of a motion without `t_eval`."""


_ATTEMPTS, _FINEST = 3, 1e-14
"""Runs until the error estimate is at most the tolerance, and the least tolerance of a step."""


def stepped(
    scene: Scene,
    law: TorqueProfile | FeedbackFunction,
    method: str,
    tolerance: float,
    span: int,
    period: int | None,
    reason: str,
    times: np.ndarray | None,
    progress: bool,
) -> Trajectory:
    """Run a motion by steps, again by smaller ones if its error estimate exceeds the tolerance.

    A function whose torques are held is called once a period and may have a memory: one run.

    Arguments are those of `Simulation`, of `SteppedMotion` and of its `run`; `reason`, why this
    method was chosen ("" where the caller chose it), ends the method of the trajectory.
    """
    local, once, spent = tolerance, period is not None or method == RK4.name, 0
    for attempt in range(1, _ATTEMPTS + 1):
        simulation = Simulation(scene, method, tolerance=local, step_budget=WHOLE_MOTION_BUDGET)
        motion = SteppedMotion(simulation, law, span, period).run(times, progress)
        motion.method += reason
        motion.evaluations = spent = spent + motion.evaluations
        excess = motion.error_estimate / tolerance
        if once or attempt == _ATTEMPTS or motion.status < 0 or not excess > 1.0:
            break
        local = max(local / (5.0 * excess), _FINEST)
    return motion


class SteppedMotion:
    """A motion by the steps of `Simulation`.

    Args:
        simulation: of what moves, at its start.
        law: torques that act.
        span: length of the motion [ns].
        period: control period [ns]; None where torques are not held.

    """

    def __init__(
        self,
        simulation: Simulation,
        law: TorqueProfile | FeedbackFunction,
        span: int,
        period: int | None,
    ) -> None:
        self._simulation, self._law, self._span, self._period = simulation, law, span, period
        self._scene, self._method = simulation.scene, simulation.method
        if not isinstance(law, TorqueProfile):
            self._feedback = StateFeedback(_checked(law), self._simulation.dynamics)
        self._samples: list[State] = []
        self._held: list[tuple[int, Vector3]] = []

    def run(self, times: np.ndarray | None, progress: bool) -> Trajectory:
        """Go to the end or a limit; times [ns] of the samples, None for the ends of all steps."""
        simulation, status, message = self._simulation, 0, "reached the end"
        ends = self._ends(times)
        wanted = None if times is None else times.tolist()[::-1]
        if wanted is None or wanted[-1] == 0:
            self._samples.append(simulation.state)
            if wanted:
                wanted.pop()
        try:
            for part in slices(len(ends), 0, f"{self._scene.name}, simulating", progress):
                for end in ends[part]:
                    self._step(int(end), wanted)
        except RunStopped as stopped:
            status, message = (-1 if isinstance(stopped, Diverged) else 1), str(stopped)
            self._approach(math.floor(stopped.time * NANOSECONDS), wanted)
        return self._trajectory(status, message)

    def _ends(self, times: np.ndarray | None) -> np.ndarray:
        """Return the ends of the steps [ns]: control periods, breaks of the torque, samples."""
        if self._period is not None:
            ends = np.arange(self._period, self._span, self._period, dtype=np.int64)
            return np.append(ends, self._span)
        if times is None:
            times = np.rint(np.linspace(0, self._span, SAMPLES + 1)).astype(np.int64)
        breaks = self._law.breaks() if isinstance(self._law, TorqueProfile) else np.empty(0)
        found = np.union1d(times, np.rint(breaks * NANOSECONDS).astype(np.int64))
        return np.union1d(found[(found > 0) & (found < self._span)], self._span)

    def _step(self, end: int, wanted: list[int] | None) -> None:
        simulation = self._simulation
        begin = simulation.time_ns
        simulation.step(self._torque(begin, end), end - begin)
        if wanted is None:
            self._samples.append(simulation.state)
            return
        while wanted and wanted[-1] <= end:
            self._samples.append(simulation.within(wanted.pop()))

    def _approach(self, end: int, wanted: list[int] | None) -> None:
        """Add the last valid state before a limit, whose time is known to the nanosecond."""
        simulation = self._simulation
        begin = simulation.time_ns
        if end <= begin:
            return
        try:
            torque = self._held[-1][1] if self._held else self._torque(begin, end)
            simulation.step(torque, end - begin)
        except RunStopped:
            return
        while wanted and wanted[-1] < end:
            self._samples.append(simulation.within(wanted.pop()))
        self._samples.append(simulation.state)

    def _torque(self, begin: int, end: int) -> Any:
        """Torques of the step from begin to end [ns]: numbers, or a function of time."""
        law, start = self._law, begin / NANOSECONDS
        if self._period is None:
            if not isinstance(law, TorqueProfile):
                return self._feedback
            if isinstance(law, SineProfile) and self._method == RODAS4.name:
                return law.sine  # traced, which is slower here: the method needs its derivative
            piece = law.between(start, end / NANOSECONDS)
            return getattr(piece, "torque", piece)
        state = self._simulation.state
        torque = law(start) if isinstance(law, TorqueProfile) else _checked(law)(start, state)
        self._held.append((begin, torque))
        return torque

    def _trajectory(self, status: int, message: str) -> Trajectory:
        simulation, samples = self._simulation, self._samples
        law: Any = self._law
        if self._held:
            times, torques = zip(*self._held, strict=True)
            law = TorqueTable(np.array(times) / NANOSECONDS, torques)
        changes = [f"{to} from {at:g} s ({why})" for at, to, why in simulation.changes]
        torque = np.array([state.torque for state in samples]).reshape(-1, 3)
        if self._period is None and len(samples) and samples[0].time_ns == 0:
            torque[0] = self._first(law)
        return Trajectory(
            self._scene,
            np.array([state.time_ns for state in samples]) / NANOSECONDS,
            np.array([state.quaternion for state in samples]).reshape(-1, 4),
            np.array([state.body_rate for state in samples]).reshape(-1, 3),
            torque,
            joints=np.array([sum(state.joints, ()) for state in samples]).reshape(-1, 18),
            status=status,
            message=message,
            method=", then ".join([self._method, *changes]),
            error_estimate=simulation.error_estimate,
            energy_residual=simulation.energy_residual,
            evaluations=simulation.evaluations,
            step=simulation.time_ns / NANOSECONDS / max(simulation.accepted_steps, 1),
            law=law,
        )

    def _first(self, law: Any) -> Any:
        """Torques that act at t = 0; a state before the first step does not know them."""
        scene, lag = self._scene.actuators, 0.0
        if scene is not None and scene.time_constant is not None:
            return (lag,) * 3
        known = isinstance(law, TorqueProfile)
        torque = law(0.0) if known else law(0.0, self._samples[0])
        return clamp(torque, scene.torque_limit if scene else None)


def _checked(function: FeedbackFunction) -> Callable[[float, State], Vector3]:
    """Refuse anything but three finite torques by the time of the call."""
    return lambda t, state: three(function(t, state), f"torque({t:g})")
