# SPDX-License-Identifier: Apache-2.0
"""A recorded run as arrays: what the nodes published between the start and the last sample."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from sst_ros import document
from sst_ros.mechanism.geometry import Array
from sst_ros.report.bag import Bag, Topic, refused
from sst_ros.report.rows import NANOSECONDS, Integers, Rows, aligned, nanoseconds, usual
from sst_ros.scene import Scene

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


@dataclass(frozen=True)
class Ticks:
    """Applied torques by tick, in order of time.

    Attributes:
        start_ns, end_ns: the tick, relative to the start of the run [ns], shape (m,).
        torque: actuator torques held over the tick [N m], shape (m, 3).
        moment: external moment on the star in {B} held over the tick [N m], shape (m, 3); None
            where it was not recorded.

    """

    start_ns: Integers
    end_ns: Integers
    torque: Array
    moment: Array | None = None

    @property
    def period_ns(self) -> int:
        """The usual length of a tick [ns]."""
        return usual(self.end_ns - self.start_ns)

    @property
    def gaps(self) -> int:
        """How often a tick does not begin where the one before ended."""
        return int(np.count_nonzero(self.start_ns[1:] != self.end_ns[:-1]))


@dataclass(frozen=True)
class Recording:
    """A run from its bag. Samples are in order of time; rows belong to samples.

    Attributes:
        path: where the bag is.
        scene: what was simulated.
        start_ns: stamp of the start of the run [ns]; all other times but `received_ns` are
            relative to it.
        time_ns, received_ns: instant of each sample, and when the recorder got it by its own
            clock [ns], shape (n,).
        gamma, mu, beta: joint angles [rad], shape (n, 3).
        gamma_dot, mu_dot, beta_dot: joint rates [rad/s], shape (n, 3).
        effort: actuator torques of the tick that ends at the sample [N m], shape (n, 3).
        quaternion: orientation of {E} in {B}, (x, y, z, w), shape (n, 4); nan where it was lost.
        euler: ZYZ angles (theta, phi, psi) [rad], shape (n, 3); nan where they were lost.
        ticks: applied torques.
        previews: number of samples before the start (stamp zero), which are not in the arrays.
        commands: number of recorded commands.
        diagnostics: the last word of the simulator about its run, key to text; may be empty.
        topics: names of the topics by key.
        missing: keys of the topics that are not in the bag.

    """

    path: Path
    scene: Scene
    start_ns: int
    time_ns: Integers
    received_ns: Integers
    gamma: Array
    mu: Array
    beta: Array
    gamma_dot: Array
    mu_dot: Array
    beta_dot: Array
    effort: Array
    quaternion: Array
    euler: Array
    ticks: Ticks
    previews: int
    commands: int
    diagnostics: dict[str, str]
    topics: dict[str, str]
    missing: tuple[str, ...]

    @property
    def period_ns(self) -> int:
        """The usual time between two samples [ns]; the last one may come early."""
        spacing = np.diff(self.time_ns)
        return usual(spacing[:-1] if len(spacing) > 1 else spacing)

    @property
    def seconds(self) -> Array:
        """Time of each sample since the start of the run [s], shape (n,)."""
        return np.asarray(self.time_ns / NANOSECONDS)


def read(path: Path) -> Recording:
    """Read a rosbag2 recording of a run.

    Raises:
        InputError: it is no recording of a run, or a damaged one; the error names what is wrong.

    """
    reader = _Reader(path)
    with Bag(path, TOPICS) as bag:
        for message in bag.messages():
            getattr(reader, message.key)(message.received_ns, message.content)
    return reader.recording(bag)


class _Reader:
    """Collects a run; the methods that take messages bear the keys of TOPICS."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._joints = Rows(path, "joint_states", 21)
        self._orientation = Rows(path, "orientation", 4)
        self._euler = Rows(path, "euler_zyz", 3)
        # Besides torque and moment the end of the tick, as its distance to the start: exact in a
        # double.
        self._ticks = Rows(path, "applied_torques", 7)
        self._moved = True
        self._order: tuple[list[str], list[int]] = ([], [])
        self._scenes: set[str] = set()
        self._diagnostics: dict[str, str] = {}
        self._previews = self._commands = 0

    def joint_states(self, received_ns: int, message: Any) -> None:
        stamp = nanoseconds(message.header.stamp)
        if stamp == 0:
            self._previews += 1
            return
        if message.name != self._order[0]:
            self._order = (list(message.name), self._places(message.name, JOINTS, "joint_states"))
        sizes = {len(message.name), *map(len, (message.position, message.velocity, message.effort))}
        if len(sizes) > 1:
            allowed = "name, position, velocity and effort must be equally long"
            raise refused(self._path, "joint_states", sorted(sizes), allowed)
        places = self._order[1]
        row = [*message.position[places], *message.velocity[places], *message.effort[places[:3]]]
        self._joints.add(received_ns, stamp, row)

    def orientation(self, received_ns: int, message: Any) -> None:
        stamp, q = nanoseconds(message.header.stamp), message.quaternion
        if stamp:
            self._orientation.add(received_ns, stamp, (q.x, q.y, q.z, q.w))

    def euler_zyz(self, received_ns: int, message: Any) -> None:
        stamp, vector = nanoseconds(message.header.stamp), message.vector
        if stamp:
            self._euler.add(received_ns, stamp, (vector.x, vector.y, vector.z))

    def applied_torques(self, received_ns: int, message: Any) -> None:
        stamp = nanoseconds(message.header.stamp)
        if stamp == 0:
            return
        places, more = [0, 1, 2], [0.0, 0.0, 0.0]
        self._moved &= set(MOMENTS) <= set(message.joint_names)
        if message.joint_names:
            wanted = (*ACTUATED, *(MOMENTS if self._moved else ()))
            places = self._places(message.joint_names, wanted, "applied_torques")
        start = stamp
        for point in message.points:
            end = stamp + nanoseconds(point.time_from_start)
            if end <= start:
                allowed = f"ticks must have a length; one at stamp {start} ns has none"
                raise refused(self._path, "applied_torques", end - start, allowed)
            if len(point.effort) != max(3, len(message.joint_names)):
                allowed = f"must be a torque for each actuator (stamp {start} ns)"
                raise refused(self._path, "applied_torques", list(point.effort), allowed)
            row = [end - start, *point.effort[places], *([] if self._moved else more)]
            self._ticks.add(received_ns, start, row)
            start = end

    def scene(self, _: int, message: Any) -> None:
        self._scenes.add(message.data)

    def diagnostics(self, _: int, message: Any) -> None:
        for status in message.status:
            values = {entry.key: entry.value for entry in status.values}
            if status.name.endswith("run") and "phase" in values:
                self._diagnostics = values

    def commands(self, _: int, message: Any) -> None:
        self._commands += 1

    def recording(self, bag: Bag) -> Recording:
        """Put everything together once all messages are in."""
        stamps, received, rows = self._joints.sorted()
        if len(stamps) < 2:
            allowed = f"a run has two samples or more ({self._previews} lie before its start)"
            if fault := self._diagnostics.get("fault"):
                allowed += f"; the simulator says: {fault}"
            raise refused(self._path, "joint_states", len(stamps), allowed)
        starts, _, ticks = self._ticks.sorted()
        if not len(starts):
            raise refused(self._path, "applied_torques", 0, "the run has no recorded torque")
        if len(self._scenes) != 1:
            allowed = "the recording must hold one scene"
            raise refused(self._path, "scene", len(self._scenes), allowed)
        scene = document.read(Scene, self._scenes.pop(), f"{self._path}: {bag.topics['scene']}")
        begin = min(int(stamps[0]), int(starts[0]))
        ends = starts + ticks[:, 0].astype(np.int64)
        if np.any(starts[1:] < ends[:-1]):
            at = starts[1:][starts[1:] < ends[:-1]][0]
            allowed = f"ticks overlap at stamp {at} ns; record one simulator a bag"
            raise refused(self._path, "applied_torques", int(at), allowed)
        quaternion = aligned(stamps, *self._orientation.sorted())
        with np.errstate(over="ignore"):  # too long is refused just below
            length = np.linalg.norm(quaternion, axis=1)
        if np.any(np.abs(length - 1.0) > 1e-6):  # nan compares False: lost is not wrong
            worst = float(length[np.abs(length - 1.0) > 1e-6][0])
            raise refused(self._path, "orientation", worst, "quaternions must have length 1")
        gamma, mu, beta, gamma_dot, mu_dot, beta_dot, effort = np.split(rows, 7, axis=1)
        return Recording(
            path=self._path,
            scene=scene,
            start_ns=begin,
            time_ns=stamps - begin,
            received_ns=received,
            gamma=gamma,
            mu=mu,
            beta=beta,
            gamma_dot=gamma_dot,
            mu_dot=mu_dot,
            beta_dot=beta_dot,
            effort=effort,
            quaternion=quaternion,
            euler=aligned(stamps, *self._euler.sorted()),
            ticks=Ticks(
                starts - begin,
                ends - begin,
                ticks[:, 1:4],
                ticks[:, 4:] if self._moved else None,
            ),
            previews=self._previews,
            commands=self._commands,
            diagnostics=self._diagnostics,
            topics=bag.topics,
            missing=bag.missing,
        )

    def _places(self, names: Sequence[str], wanted: Sequence[str], topic: str) -> list[int]:
        absent = [name for name in wanted if name not in names]
        if absent:
            allowed = "joints are missing: " + ", ".join(absent)
            raise refused(self._path, topic, list(names), allowed)
        return [list(names).index(name) for name in wanted]
