# SPDX-License-Identifier: Apache-2.0
"""Following trajectories of messages: planning, beginning, stages, end of each."""

from __future__ import annotations

import dataclasses
import math
from array import array
from concurrent.futures import Future
from enum import Enum
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from sst_ros.control.actuator_space import Reference, ReferenceMotion, slow_down
from sst_ros.control.controller import (
    Controller,
    TrackingMetrics,
    track_of,
)
from sst_ros.control.law import Command, Measurement, command_limit
from sst_ros.control.plan import check_motion
from sst_ros.control.reference_motions import reference_motion
from sst_ros.errors import SstError, refusal, refuse_unless
from sst_ros.mechanism import kinematics
from sst_ros.mechanism.generic_math import axpy
from sst_ros.mechanism.geometry import Geometry, quaternion_of, rotation_matrix
from sst_ros.runtime.assistant import Assistant
from sst_ros.runtime.settings import ControllerNodeParameters
from sst_ros.runtime.trajectory_messages import Points, plan, read_points
from sst_ros.scene.scene import Scene
from sst_ros.simulation.trajectory import Trajectory
from sst_ros.state import NANOSECONDS, ZERO, Vector3

_FIRST_PERIODS_AHEAD = 25
"""Control periods that the first check may take where the reference moves.

Later ones may take twice as long as the last.
"""
_MOST_CHECKS = 5
"""Checks of one trajectory, after which it is refused: the machine is too busy."""
_ROWS_AT_ONCE = 256
"""Samples that are added to the tracking metrics at once."""


class Order:
    """A trajectory between its message and its motion.

    Attributes:
        outcome: a result where the trajectory is accepted, else the SstError that says
            why not; cancelled where a newer one came before this was checked.
        passed: time of the trajectory at which its motion begins [s].

    """

    def __init__(
        self, points: Points, measured: Measurement | None, seen_ns: int
    ) -> None:
        self.points = points
        self.measured = measured
        self.seen_ns = seen_ns  # stamp of what was measured
        self.outcome: Future[None] = Future()
        self.passed = 0.0
        self.checks = 0  # that are done
        self.asked_ns = 0  # stamp of the sample at which the last was asked for
        self.begin: Reference | None = None  # the reference from which it was planned
        # stamp of that; None where it stands still until then
        self.begin_ns: int | None = None


class _Upcoming(NamedTuple):
    """A motion that is followed from a stamp on [ns]."""

    begin_ns: int
    motion: ReferenceMotion
    order: Order


class Stage(Enum):
    """Stage of a motion."""

    WAITING = "waiting for a trajectory"
    READY = "ready"
    FOLLOWING = "following"
    HOLDING = "holding the end"
    ENDED = "ended"


class TrajectoryFollower:
    """Follows the scene's motion once, or one trajectory after the other.

    A trajectory replaces what is followed, from a reference a little ahead, where it
    will have been checked by a process beside the control; in lockstep, where the plant
    waits, at once. Raises InputError, AssemblyError or SingularConfiguration where the
    scene's motion is refused.

    Attributes:
        stage: present stage.
        order: that of the trajectory that is followed.
        finished: tracking errors of the motion before this one, if it came to rest.
        samples: samples answered.
        irregular: those of them that came at another period.
        limited: samples of the motion in which a torque was limited.

    """

    def __init__(self, model: Scene, settings: ControllerNodeParameters) -> None:
        self._model = model
        self._settings = settings
        self._geometry = Geometry.of(model)
        limit = float(command_limit(settings.torque_limit, model))
        if math.isfinite(limit):  # for the check of motions, too
            self._model = model.with_values({"actuators.torque_limit": limit})
        self._planned: ReferenceMotion | None = None
        if settings.motion == "scene":
            self._planned = reference_motion(model, _read_motion)
            check_motion(self._planned, self._model)
        self._plan = partial(plan, self._model)
        self._assistant: Assistant | None = None
        # from a sample to the instant from which a trajectory is planned
        self._ahead_ns = 0
        if settings.motion == "topic" and not settings.stamped:
            self._assistant = Assistant(self._plan)
            self._ahead_ns = _FIRST_PERIODS_AHEAD * settings.period_ns
        self._checked: Order | None = None  # the assistant checks it now
        self._waiting: Order | None = None  # is checked next
        self.samples = 0
        self.irregular = 0
        self.limited = 0
        self._start_ns: int | None = None  # stamp at which the motion begins
        self._record_ns = 0  # stamp at which the record of tracking errors begins
        self.restart()

    def close(self) -> None:
        """End the process that checks trajectories."""
        if self._assistant is not None:
            self._assistant.close()

    def restart(self) -> None:
        """Forget the run, as after a reset of the simulator, and all trajectories."""
        for order in filter(None, (self._checked, self._waiting)):
            order.outcome.cancel()
        self.stage = Stage.WAITING
        self._waiting = None
        self._forget_record()
        self._last: Command | None = None
        self._last_ns = 0  # stamp of the last sample that was answered
        self.order: Order | None = None
        self.finished: TrackingMetrics | None = None
        self._upcoming: list[_Upcoming] = []  # in the order in which they begin
        if self._planned is not None:
            self._prepare(self._planned)

    def take(
        self, message: Any, measured: Measurement | None, seen_ns: int = 0
    ) -> Order:
        """Take a trajectory_msgs/JointTrajectory in place of what is followed now.

        It goes on from the reference that is followed then; before the first sample
        from where the manipulator was `measured` last, at rest. Where it is refused,
        nothing changes.
        """
        motion = self._settings.motion
        requirement = "must be topic, for trajectories to be taken"
        refuse_unless(
            "joint_trajectory", ("motion", motion, motion == "topic", requirement)
        )
        is_partial_allowed = self._settings.allow_partial_joints_goal
        points = read_points(message, is_partial_allowed=is_partial_allowed)
        order = Order(points, measured, seen_ns)
        if self._waiting is not None:
            self._waiting.outcome.cancel()
        self._waiting = order
        self.proceed()
        return order

    def tune(self, settings: ControllerNodeParameters) -> None:
        """Take other gains from the next sample on.

        Raises InputError, and changes nothing, where the controller refuses them;
        before the first motion they are checked when it is taken.
        """
        if self.stage is not Stage.WAITING:
            self._controller.tune(settings)
        self._settings = settings

    def proceed(self) -> None:
        """Have the newest trajectory checked, and follow it once it has been."""
        while self._checked or self._waiting:
            if self._checked is None:
                order = self._waiting
                self._waiting = None
                assert order is not None
                try:
                    arguments = (order.points, *self._place(order))
                    if self._assistant is None:
                        self._follow(order, self._plan(*arguments))
                        continue
                except SstError as error:
                    order.outcome.set_exception(error)
                    continue
                self._assistant.call(*arguments)
                self._checked = order
            assert self._assistant is not None
            result = self._assistant.result()
            if result is None:
                return
            order = self._checked
            self._checked = None
            self._settle(order, result)

    def _place(self, order: Order) -> tuple[Reference, float, Vector3]:
        """Find where a trajectory begins.

        Returns the reference, the time of the trajectory then [s], and the torques that
        are added then [N m].
        """
        stamp_ns = order.points.stamp_ns
        order.asked_ns = self._last_ns
        order.begin_ns = None
        now_ns = self._last_ns + self._settings.period_ns
        effort: Vector3 | None = None
        if self._last is None:
            order.begin = self._reference_at_rest(order.measured)
            now_ns = order.seen_ns
        elif stamp_ns == 0 and self._rests():
            order.begin = self._motion.at(math.inf)
            effort = self._motion.effort_at(math.inf)
        else:
            now_ns = order.begin_ns = max(self._last_ns + self._ahead_ns, stamp_ns)
            motion, time = self._motion_at(now_ns)
            order.begin = motion.at(time)
            effort = motion.effort_at(time)
        order.passed = 0.0
        if stamp_ns:
            order.passed = max(0, now_ns - stamp_ns) / NANOSECONDS
        return order.begin, order.passed, effort or ZERO

    def _settle(self, order: Order, result: Any) -> None:
        """Follow what was checked, or have the check repeated.

        It is repeated where the reference is another one by now.
        """
        order.checks += 1
        if order.outcome.done():  # by a reset
            return
        if order.asked_ns:
            took_ns = self._last_ns - order.asked_ns
            period_ns = self._settings.period_ns
            self._ahead_ns = max(2 * (took_ns + period_ns), self._ahead_ns - period_ns)
        if isinstance(result, ReferenceMotion) and self._is_timely(order):
            try:
                self._follow(order, result)
            except SstError as error:  # of the gains, with the first motion
                order.outcome.set_exception(error)
        elif isinstance(result, SstError):
            order.outcome.set_exception(result)
        elif self._waiting is not None:
            order.outcome.cancel()
        elif order.checks == _MOST_CHECKS:
            late = f"checked too late {_MOST_CHECKS} times, on a busy machine"
            order.outcome.set_exception(SstError(late))
        else:
            self._waiting = order

    def _is_timely(self, order: Order) -> bool:
        """Return whether the reference still is the one from which it was planned."""
        if self._last is None:
            return True
        if order.begin_ns is None:
            return self._rests() and order.begin == self._motion.at(math.inf)
        motion, time = self._motion_at(order.begin_ns)
        return order.begin_ns >= self._last_ns and order.begin == motion.at(time)

    def has(self, order: Order) -> bool:
        """Whether the trajectory is followed, or will be at its stamp."""
        orders = [self.order, *(upcoming.order for upcoming in self._upcoming)]
        return any(order is followed for followed in orders)

    def _rests(self) -> bool:
        """Whether the reference stands still from now on."""
        return not self._upcoming and self.time >= self._motion.duration

    def _motion_at(self, stamp_ns: int) -> tuple[ReferenceMotion, float]:
        """Return what is followed at a stamp to come, and its time then [s]."""
        motion = self._motion
        start_ns = self._start_ns or self._last_ns
        for upcoming in self._upcoming:
            if upcoming.begin_ns <= stamp_ns:
                motion = upcoming.motion
                start_ns = upcoming.begin_ns
        return motion, (stamp_ns - start_ns) / NANOSECONDS

    def _follow(self, order: Order, motion: ReferenceMotion) -> None:
        """Follow a motion from its stamp on, and until then what is followed now."""
        stamp_ns = order.points.stamp_ns
        start = motion.at(0.0)
        if self._last is not None:
            start_ns = order.begin_ns or self._last_ns + self._settings.period_ns
            self._upcoming = [
                upcoming for upcoming in self._upcoming if upcoming.begin_ns < start_ns
            ]
            self._upcoming.append(_Upcoming(start_ns, motion, order))
        elif stamp_ns > order.seen_ns:  # stands at its start until then
            self._upcoming = [_Upcoming(stamp_ns, motion, order)]
            self._prepare(ReferenceMotion(lambda _: start, (0.0,)))
        else:
            self._upcoming = []
            self._prepare(motion, order)
        order.outcome.set_result(None)

    def stop(self) -> None:
        """Come to rest on the path in `stop_time`, and hold.

        Before the run, forget the motion.
        """
        if self.stage is Stage.READY:
            self.restart()
        elif self._start_ns is not None:
            self._upcoming.clear()
            if self.stage is Stage.FOLLOWING:
                motion = slow_down(self._motion, self.time, self._settings.stop_time)
                self._controller.follow(motion)
                self._begin(motion, self._last_ns)

    def preview(self, measured: Measurement) -> Command | None:
        """Answer a sample before the run.

        None as long as there is nothing to follow.
        """
        if self.stage is not Stage.READY:
            return None
        self._refuse_elsewhere(measured)
        command = self._controller.command(0.0, measured)
        self._controller.reset()
        return command

    def answer(self, stamp_ns: int, measured: Measurement) -> Command | None:
        """Answer a sample of the run; None where there is nothing to answer.

        The end of the scene's motion is answered with zero torque: then the work is
        done. An InputError says that the manipulator is not where the motion begins;
        ControlStopped is the controller's.
        """
        if stamp_ns <= self._last_ns or self.stage in (Stage.WAITING, Stage.ENDED):
            return None
        if self.stage is Stage.READY:
            self._refuse_elsewhere(measured)
            self.stage = Stage.FOLLOWING
        elif stamp_ns - self._last_ns != self._settings.period_ns:
            self.irregular += 1
        while self._upcoming and self._upcoming[0].begin_ns <= stamp_ns:
            begin_ns, motion, order = self._upcoming.pop(0)
            self._controller.follow(motion)
            self._begin(motion, begin_ns, order)
            self.stage = Stage.FOLLOWING
        if self._start_ns is None:
            self._start_ns = stamp_ns
            self._record_ns = stamp_ns
        passed_ns = stamp_ns - self._start_ns
        time = passed_ns / NANOSECONDS
        command = self._controller.command(time, measured)
        if command.saturated:
            self.limited += 1
        if time >= self._motion.duration:
            self.stage = Stage.HOLDING
        end_ns = round((self._motion.duration + self._settings.hold) * NANOSECONDS)
        if passed_ns >= end_ns and self._planned is not None:
            self.stage = Stage.ENDED
            command = dataclasses.replace(command, torque=ZERO)
        if passed_ns <= end_ns:
            self._record(stamp_ns, command)
        self.samples += 1
        self._last = command
        self._last_ns = stamp_ns
        return command

    def _record(self, stamp_ns: int, command: Command) -> None:
        """Add a sample to the record of the tracking errors, as `track_of` reads it."""
        row = (
            (stamp_ns - self._record_ns) / NANOSECONDS,
            *command.desired.gamma,
            *command.desired.gamma_dot,
            *command.error,
            *command.feedforward,
            *command.feedback,
            *command.torque,
        )
        self._rows.extend(row)
        if len(self._rows) >= _ROWS_AT_ONCE * len(row):
            self._add_rows()

    def tracking(self) -> TrackingMetrics | None:
        """Return the tracking errors of the motion; None before two samples of it."""
        self._add_rows()
        self._metrics.limited = self.limited
        return self._metrics if self._metrics.samples > 1 else None

    @property
    def time(self) -> float:
        """Time of the motion at the last sample [s]; 0 before its first one."""
        return (self._last_ns - (self._start_ns or self._last_ns)) / NANOSECONDS

    @property
    def errors(self) -> tuple[float, float]:
        """Root mean square and largest of all errors of the motion up to now [rad]."""
        self._add_rows()
        rms_of_all = np.sqrt(np.mean(self._metrics.rms**2))
        return float(rms_of_all), float(self._metrics.largest.max())

    def _prepare(self, motion: ReferenceMotion, order: Order | None = None) -> None:
        """Make a controller for a motion that begins with the next sample."""
        period = self._settings.period_ns / NANOSECONDS
        self._controller = Controller(self._model, motion, self._settings, period)
        self._begin(motion, None, order)
        self.stage = Stage.READY

    def _begin(
        self, motion: ReferenceMotion, start_ns: int | None, order: Order | None = None
    ) -> None:
        """Follow a motion from an instant on, None for the next sample.

        The record of the tracking errors goes on where the reference was moving.
        """
        self._motion = motion
        self._start_ns = start_ns
        self.order = order
        if self.stage is not Stage.FOLLOWING:
            self.finished = self.tracking()
            self._forget_record()
            self.limited = 0
            self._record_ns = start_ns or 0

    def _forget_record(self) -> None:
        """Forget the tracking errors."""
        self._rows = array("d")  # of samples that the metrics do not have yet
        self._metrics = TrackingMetrics()

    def _add_rows(self) -> None:
        """Add the samples since the last call to the metrics."""
        if self._rows:
            self._metrics.add(track_of(self._rows))
            self._rows = array("d")

    def _reference_at_rest(self, measured: Measurement | None) -> Reference:
        """Return the reference at rest at the measured angles."""
        if measured is None:
            requirement = "must come first: a trajectory begins there"
            raise refusal("joint_trajectory", "joint_states", None, requirement)
        rotation = None  # that names the assembly, where the scene does
        if self._model.initial.orientation is not None:
            rotation = rotation_matrix(self._model.initial.orientation)
        assembly = kinematics.admissible(self._geometry, measured.gamma, rotation)
        x, y, z, w = quaternion_of(assembly.rotation).tolist()
        return Reference((x, y, z, w), ZERO, ZERO, measured.gamma, ZERO, ZERO)

    def _refuse_elsewhere(self, measured: Measurement) -> None:
        """Raise InputError where the manipulator is not where the motion begins."""
        begin = self._motion.at(0.0).gamma
        tolerance = self._settings.start_tolerance
        distances = map(abs, axpy(1.0, begin, -1.0, measured.gamma))
        is_near = max(distances) <= tolerance
        begin_text = ", ".join(f"{angle:.6f}" for angle in begin)
        requirement = (
            f"must be within {tolerance:g} rad of ({begin_text}), where the motion"
            " begins"
        )
        refuse_unless(
            "joint_states", ("position", measured.gamma, is_near, requirement)
        )


def _read_motion(bag: str, namespace: str | None) -> Trajectory:
    # needs rosbags, which others do not
    from sst_ros.recording.recording import read_run_motion

    return read_run_motion(bag, namespace)
