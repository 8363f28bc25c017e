# SPDX-License-Identifier: Apache-2.0
"""What the messages of a run hold, collected topic by topic as rows of numbers."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from sst_ros.mechanism.geometry import Array
from sst_ros.recording import cdr_fields
from sst_ros.recording.bag_reader import Bag, Topic, refused
from sst_ros.recording.cdr_fields import Columns
from sst_ros.recording.mcap_blocks import Block
from sst_ros.recording.time_series import Integers, Rows

KINDS = ("gamma", "mu", "beta")
JOINTS = tuple(f"{kind}_{leg}" for kind in KINDS for leg in (1, 2, 3))
ACTUATED = JOINTS[:3]
MOMENTS = ("moment_x", "moment_y", "moment_z")

TOPICS = (
    Topic("joint_states", "/joint_states", "sensor_msgs/msg/JointState", True),
    Topic("orientation", "/orientation", "geometry_msgs/msg/QuaternionStamped", True),
    Topic("applied_torques", "/applied_torques", "trajectory_msgs/msg/JointTrajectory", True),
    Topic("scene", "/scene", "std_msgs/msg/String", True),
    Topic("euler_zyz", "/euler_zyz", "geometry_msgs/msg/Vector3Stamped", False),
    Topic("diagnostics", "/diagnostics", "diagnostic_msgs/msg/DiagnosticArray", False, False),
    Topic("commands", "/commands", "std_msgs/msg/Float64MultiArray", False),
)
STAMPED = Topic("commands_stamped", "/commands_stamped", "sensor_msgs/msg/JointState", False)
"""Recorded only where the simulator runs in lockstep, and not missed elsewhere."""


class Commands(NamedTuple):
    """Recorded commands in order of their reception.

    Attributes:
        received_ns: by the recorder's clock [ns], shape (c,).
        stamp_ns: stamp of the sample that is answered [ns]; 0 where commands have none, shape (c,).
        torque: what is asked for [N m], shape (c, 3).

    """

    received_ns: Integers
    stamp_ns: Integers
    torque: Array


class Trajectory(NamedTuple):
    """Fields of JointTrajectory messages; of each point its efforts and time_from_start [ns]."""

    stamp: Integers
    names: tuple[str, ...]
    efforts: list[Array]
    ends: list[Integers]


class Collector:
    """Collects a run; the methods that take blocks are named by the keys of topics."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self.joints = Rows(path, "joint_states", 21, received=True)
        self.turns = Rows(path, "orientation", 4)
        self.angles = Rows(path, "euler_zyz", 3)
        # Besides torque and moment the end of the tick, as its distance to the start: exact in a
        # double.
        self.ticks = Rows(path, "applied_torques", 4)
        self.moments = Rows(path, "applied_torques", 3)
        self.moved = True
        self.scenes: set[str] = set()
        self.reports: list[tuple[int, dict[str, str]]] = []
        self.previews = 0
        self._asked = Rows(path, "commands", 3, received=True)

    def collect(self, bag: Bag) -> None:
        """Take everything.

        Raises:
            InputError: the bag is damaged, or a message holds what cannot be.

        """
        for block in bag.blocks():
            try:
                getattr(self, f"_{block.topic}")(bag, block)
            except cdr_fields.Malformed as error:
                raise bag.damaged(error, f" in {block.topic}") from None

    def asked(self) -> Commands:
        """Return the commands of both topics, in order of their reception."""
        stamps, received, torque = self._asked.unsorted()
        if np.any(received[1:] < received[:-1]):
            order = np.argsort(received, kind="stable")
            stamps, received, torque = stamps[order], received[order], torque[order]
        return Commands(received, stamps, torque)

    def _joint_states(self, _: Bag, block: Block) -> None:
        for received, (stamp, names, fields) in cdr_fields.read(*block[1:], joint_state):
            begun = stamp != 0
            self.previews += int(np.count_nonzero(~begun))
            if not begun.any():
                continue
            sizes = {len(names), *(field.shape[1] for field in fields)}
            if len(sizes) > 1:
                allowed = "name, position, velocity and effort must be equally long"
                raise refused(self._path, "joint_states", sorted(sizes), allowed)
            at = self._places(names, JOINTS, "joint_states")
            position, velocity, effort = fields
            rows = np.hstack([position[:, at], velocity[:, at], effort[:, at[:3]]])
            self.joints.add(received[begun], stamp[begun], rows[begun])

    def _orientation(self, _: Bag, block: Block) -> None:
        _stamped(self.turns, block, 4)

    def _euler_zyz(self, _: Bag, block: Block) -> None:
        _stamped(self.angles, block, 3)

    def _applied_torques(self, _: Bag, block: Block) -> None:
        for received, found in cdr_fields.read(*block[1:], trajectory):
            begun = found.stamp != 0
            if not begun.any():
                continue
            at, moved = [0, 1, 2], set(MOMENTS) <= set(found.names)
            self.moved &= moved
            if found.names:
                wanted = (*ACTUATED, *(MOMENTS if moved else ()))
                at = self._places(found.names, wanted, "applied_torques")
            start = found.stamp[begun]
            for effort, after in zip(found.efforts, found.ends, strict=True):
                end = found.stamp[begun] + after[begun]
                length = end - start
                if (length <= 0).any():
                    first = start[length <= 0][0]
                    allowed = f"ticks must have a length; one at stamp {first} ns has none"
                    value = int(length.min())
                    raise refused(self._path, "applied_torques", value, allowed)
                if effort.shape[1] != max(3, len(found.names)):
                    allowed = f"must be a torque for each actuator (stamp {start[0]} ns)"
                    raise refused(self._path, "applied_torques", effort[0].tolist(), allowed)
                acting = effort[begun][:, at]
                row = np.hstack([length[:, None], acting[:, :3]])
                self.ticks.add(received[begun], start, row)
                if self.moved:
                    self.moments.add(received[begun], start, acting[:, 3:])
                start = end

    def _scene(self, bag: Bag, block: Block) -> None:
        self.scenes |= {message.data for message in bag.content(block)}

    def _diagnostics(self, bag: Bag, block: Block) -> None:
        for received, message in zip(block.received.tolist(), bag.content(block), strict=True):
            for status in message.status:
                values = {entry.key: entry.value for entry in status.values}
                if status.name.endswith("run") and "phase" in values:
                    self.reports.append((received, values))

    def _commands(self, _: Bag, block: Block) -> None:
        for received, torque in cdr_fields.read(*block[1:], multi_array):
            if torque.shape[1] == 3:  # others are dropped by the simulator too
                self._asked.add(received, np.zeros_like(received), torque)

    def _commands_stamped(self, _: Bag, block: Block) -> None:
        for received, (stamp, names, fields) in cdr_fields.read(*block[1:], joint_state):
            effort = fields[2]
            if sorted(names) == sorted(ACTUATED) and effort.shape[1] == 3:
                at = [names.index(name) for name in ACTUATED]
                self._asked.add(received, stamp, effort[:, at])

    def _places(self, names: Sequence[str], wanted: Sequence[str], topic: str) -> list[int]:
        absent = [name for name in wanted if name not in names]
        if absent:
            allowed = "joints are missing: " + ", ".join(absent)
            raise refused(self._path, topic, list(names), allowed)
        return [list(names).index(name) for name in wanted]


def joint_state(message: Columns) -> tuple[Integers, tuple[str, ...], tuple[Array, ...]]:
    """Read JointState messages: stamps, names, and position, velocity and effort."""
    stamp, names = message.stamp(), message.texts()
    return stamp, names, (message.sequence(), message.sequence(), message.sequence())


def trajectory(message: Columns) -> Trajectory:
    """Read JointTrajectory messages, the efforts of their points alone."""
    found = Trajectory(message.stamp(), message.texts(), [], [])
    for _ in range(message.length()):
        for _unused in ("positions", "velocities", "accelerations"):
            message.sequence()
        found.efforts.append(message.sequence())
        found.ends.append(message.nanoseconds())
    return found


def multi_array(message: Columns) -> Array:
    """Read Float64MultiArray messages; how they are laid out is passed over."""
    for _ in range(message.length()):
        message.text(), message.numbers("u4", 2)
    message.numbers("u4")
    return message.sequence()


def _stamped(rows: Rows, block: Block, count: int) -> None:
    def fields(message: Columns) -> tuple[Any, Any]:
        return message.stamp(), message.numbers("f8", count)

    for received, (stamp, values) in cdr_fields.read(*block[1:], fields):
        begun = stamp != 0
        rows.add(received[begun], stamp[begun], values[begun])
