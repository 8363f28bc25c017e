# SPDX-License-Identifier: Apache-2.0
"""Trajectory following: the motion, when it began, its commands and its tracking error."""

from __future__ import annotations

import dataclasses
from array import array
from enum import Enum
from typing import Any

import numpy as np

from sst_ros.control.actuator_space import ActuatorSpaceMap
from sst_ros.control.controller import Command, Controller, Measurement
from sst_ros.control.plan import check
from sst_ros.control.reference import Reference, ReferenceMotion, StoppingMotion
from sst_ros.control.reference_motions import reference_motion
from sst_ros.control.tracking import TrackingMetrics, TrackingRecord, TrackingSums
from sst_ros.errors import InputError, Problem, SingularConfiguration, SstError
from sst_ros.mechanism import kinematics
from sst_ros.mechanism.frames import quaternion_of, rotation_matrix
from sst_ros.mechanism.generic_math import ZERO, axpy
from sst_ros.mechanism.geometry import Geometry
from sst_ros.runtime.settings import ControllerNodeParameters
from sst_ros.runtime.trajectory_goal import motion_of
from sst_ros.scene.scene import Actuators, Scene
from sst_ros.simulation.simulation import NANOSECONDS
from sst_ros.simulation.trajectory import Trajectory

_COLUMNS = 22
"""Numbers of a sample of a `TrackingRecord`."""
_ROWS = 256
"""Samples that are added to the tracking metrics at once."""


class Stage(Enum):
    """Stage of a motion."""

    WAITING = "waiting for a trajectory"
    READY = "ready"
    FOLLOWING = "following"
    HOLDING = "holding the end"
    ENDED = "ended"


class TrajectoryFollower:
    """Follows the scene's motion once, or one trajectory after the other.

    Attributes:
        stage: present stage.
        samples, irregular: samples answered, and those that came at another period.
        limited: samples of the motion in which a torque was limited.
        refused, last_refusal: trajectories that were refused, and the reason of the last one.

    Raises:
        InputError, AssemblyError, SingularConfiguration: the scene's motion is refused.

    """

    def __init__(self, model: Scene, settings: ControllerNodeParameters) -> None:
        self._model, self._settings = _limit(model, settings.torque_limit), settings
        self._geometry = Geometry.of(model)
        self._period_ns = NANOSECONDS // settings.rate
        self._planned: ReferenceMotion | None = None
        if settings.motion == "scene":
            self._planned = reference_motion(model, _read_motion)
            check(self._planned, self._model)
        self.samples = self.irregular = self.limited = self.refused = 0
        self.last_refusal = ""
        self._start_ns: int | None = None
        self.restart()

    def restart(self) -> None:
        """Forget the run, as after a reset of the simulator, and all trajectories."""
        self.stage, self._last_ns = Stage.WAITING, 0
        self._rows, self._sums = array("d"), TrackingSums()
        self._last: Command | None = None
        if self._planned is not None:
            self._prepare(self._planned)

    def take(self, message: Any, seen: Measurement | None) -> None:
        """Take a trajectory_msgs/JointTrajectory in place of what is followed now.

        It goes on from the reference of the last sample; before there was one, from where the
        manipulator is, at rest. A reference that moves is replaced in lockstep only.

        Raises:
            InputError, AssemblyError, SingularConfiguration: it is refused; nothing has changed.

        """
        if self._settings.motion != "topic":
            allowed = "must be topic, for trajectories to be taken"
            raise InputError("joint_trajectory", [Problem("motion", "scene", allowed)])
        begin = self._reference_at_rest(seen) if self._last is None else self._last.desired
        moving = any(begin.gamma_dot) or any(begin.gamma_ddot)
        if moving and not self._settings.stamped:
            # The check takes longer than a control period; in lockstep the plant waits.
            allowed = "must come when the motion has ended, outside lockstep"
            raise InputError("joint_trajectory", [Problem("points", "", allowed)])
        motion = motion_of(message, self._geometry, begin)
        check(motion, self._model)
        if self._last is None:
            self._prepare(motion)
            return
        self._controller.follow(motion)
        self._begin(motion, self._last_ns if moving else None)
        self.stage = Stage.FOLLOWING

    def refuse(self, error: SstError) -> None:
        """Count a trajectory that is refused."""
        self.refused, self.last_refusal = self.refused + 1, str(error)

    def stop(self) -> None:
        """Come to rest on the path in `stop_time`, and hold; before the run, forget the motion."""
        if self.stage is Stage.READY:
            self.restart()
        elif self.stage is Stage.FOLLOWING and self._start_ns is not None:
            motion = StoppingMotion(self._motion, self.time, self._settings.stop_time)
            self._controller.follow(motion)
            self._begin(motion, self._last_ns)

    def preview(self, measured: Measurement) -> Command | None:
        """Answer a sample before the run; None as long as there is nothing to follow."""
        if self.stage is not Stage.READY:
            return None
        self._refuse_elsewhere(measured)
        command = self._controller.command(0.0, measured)
        self._controller.reset()
        return command

    def answer(self, stamp_ns: int, measured: Measurement) -> Command | None:
        """Answer a sample of the run; None where there is nothing to answer.

        The end of the scene's motion is answered with zero torque: then the work is done.

        Raises:
            InputError: the manipulator is not where the motion begins.
            ControlStopped: see `Controller.command`.

        """
        if stamp_ns <= self._last_ns or self.stage in (Stage.WAITING, Stage.ENDED):
            return None
        if self.stage is Stage.READY:
            self._refuse_elsewhere(measured)
            self.stage = Stage.FOLLOWING
        else:
            self.irregular += stamp_ns - self._last_ns != self._period_ns
        if self._start_ns is None:
            self._start_ns = stamp_ns
        passed_ns = stamp_ns - self._start_ns
        time = passed_ns / NANOSECONDS
        command = self._controller.command(time, measured)
        end_ns = round((self._motion.duration + self._settings.hold) * NANOSECONDS)
        if time >= self._motion.duration:
            self.stage = Stage.HOLDING
        if passed_ns >= end_ns and self._planned is not None:
            self.stage = Stage.ENDED
            command = dataclasses.replace(command, torque=ZERO)
        if passed_ns <= end_ns:
            self._log(time, measured, command)
        self.samples += 1
        self.limited += command.saturated
        self._last, self._last_ns = command, stamp_ns
        return command

    def tracking(self) -> TrackingMetrics | None:
        """Return the tracking errors of the motion; None before two samples of it."""
        self._add_rows()
        return self._sums.metrics(self.limited) if self._sums.samples > 1 else None

    @property
    def time(self) -> float:
        """Time of the motion at the last sample [s]; 0 before its first one."""
        return (self._last_ns - (self._start_ns or self._last_ns)) / NANOSECONDS

    @property
    def errors(self) -> tuple[float, float]:
        """Root of the mean square and largest of all errors of the motion up to now [rad]."""
        self._add_rows()
        return self._sums.rms, self._sums.largest

    def _prepare(self, motion: ReferenceMotion) -> None:
        period_s = self._period_ns / NANOSECONDS
        self._controller = Controller(self._model, motion, self._settings, period_s)
        self._begin(motion, None)
        self.stage = Stage.READY

    def _begin(self, motion: ReferenceMotion, start_ns: int | None) -> None:
        """Follow a motion from an instant on; None for the next sample."""
        self._motion, self._start_ns = motion, start_ns
        self._rows, self._sums = array("d"), TrackingSums()
        self.limited = 0

    def _log(self, time: float, measured: Measurement, command: Command) -> None:
        desired = command.desired
        error = axpy(1.0, desired.gamma, -1.0, measured.gamma)
        error_rate = axpy(1.0, desired.gamma_dot, -1.0, measured.gamma_dot)
        torques = command.feedforward, command.feedback, command.torque
        self._rows.append(time)
        for triple in (desired.gamma, desired.gamma_dot, error, error_rate, *torques):
            self._rows.extend(triple)
        if len(self._rows) >= _ROWS * _COLUMNS:
            self._add_rows()

    def _add_rows(self) -> None:
        """Add the samples since the last call to the metrics."""
        if self._rows:
            rows = np.array(self._rows).reshape(-1, _COLUMNS)
            time, *columns = np.split(rows, range(1, _COLUMNS, 3), axis=1)
            self._sums.add(TrackingRecord(time[:, 0], *columns))
            self._rows = array("d")

    def _reference_at_rest(self, seen: Measurement | None) -> Reference:
        """Return the reference at rest at the measured angles."""
        if seen is None:
            allowed = "must come first: a trajectory begins there"
            raise InputError("joint_trajectory", [Problem("joint_states", None, allowed)])
        named = self._model.initial.orientation
        meant = None if named is None else rotation_matrix(named)
        assembly = kinematics.admissible(self._geometry, seen.gamma, meant)
        x, y, z, w = quaternion_of(assembly.rotation).tolist()
        try:
            return ActuatorSpaceMap(self._geometry).of_actuators(
                (x, y, z, w), seen.gamma, ZERO, ZERO
            )
        except ArithmeticError:
            raise SingularConfiguration("the manipulator is singular, det J2", 0.0) from None

    def _refuse_elsewhere(self, measured: Measurement) -> None:
        begin, tolerance = self._motion.at(0.0).gamma, self._settings.start_tolerance
        off = axpy(1.0, begin, -1.0, measured.gamma)
        if not max(map(abs, off)) <= tolerance:
            said = ", ".join(f"{angle:.6f}" for angle in begin)
            allowed = f"must be within {tolerance:g} rad of ({said}), where the motion begins"
            raise InputError("joint_states", [Problem("position", measured.gamma, allowed)])


def _read_motion(bag: str) -> Trajectory:
    from sst_ros.recording.recording import read_motion  # needs rosbags, which others do not

    return read_motion(bag)


def _limit(model: Scene, limit: float) -> Scene:
    """Return the model with a torque limit, unless its own is smaller."""
    if not limit:
        return model
    own = model.actuators or Actuators(torque_limit=limit)
    least = min(limit, own.torque_limit or limit)
    return dataclasses.replace(model, actuators=dataclasses.replace(own, torque_limit=least))
