# SPDX-License-Identifier: Apache-2.0
"""What the simulator publishes: numbers of a state as messages, and the topics they go to.

Messages are bytes, which `Publisher.publish` takes: CDR, little-endian (OMG DDS-XTypes,
XCDR1). Their layout is made once, afterwards only numbers are written: to convert a
message object each time costs three times as much as the rest of publishing it
(docs/nodes.md has the figures).

Publishing happens in the thread of the run, after the step, in the slack before the
next deadline; a topic without subscribers is left out. rclpy holds the interpreter's
lock while it publishes (measured: 200 publications beside a busy thread are never
interrupted), so a thread of its own could not work beside the next step; it would only
add switches between threads.
"""

from __future__ import annotations

import math
import struct
import time
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from rclpy.node import Node
from rclpy.publisher import Publisher
from std_msgs.msg import String

from sst_ros.control.controller import ChannelState
from sst_ros.control.law import ControlChannel
from sst_ros.description.robot import urdf
from sst_ros.errors import refuse_unless
from sst_ros.mechanism.generic_math import triple
from sst_ros.nodes import topics
from sst_ros.runtime.settings import SimulatorParameters
from sst_ros.runtime.torque_input import ACTUATORS
from sst_ros.scene.loads import JOINTS, MOMENTS
from sst_ros.scene.scene import Scene
from sst_ros.scene.yaml_document import dump
from sst_ros.simulation.simulation import Simulation
from sst_ros.state import BASE_FRAME, IDLE_FRAME_ID, NANOSECONDS, ZERO, State, Vector3

LOG_NS = 50_000_000
"""Torques are published once for about this time: with each sample they would take 16
us of the 180 of a wake.
"""
_HISTORY_S = 2
_FAST = 10
_LEAST_DEPTH, _MOST_DEPTH = 10, 20_000
_ENCAPSULATION = b"\x00\x01\x00\x00"
_STAMP = struct.Struct("<iI")
_AT_REST = (0.0,) * len(JOINTS)
_PASSIVE = (0.0,) * (len(JOINTS) - len(ACTUATORS))

Numbers = tuple[Sequence[float], Sequence[float], Sequence[float]]
"""Of a state: quaternion (x, y, z, w); nine angles [rad], then nine rates [rad/s], by
kind and leg; torques of the actuators [N m].
"""
Message = Callable[[bytes, Numbers], bytes]
"""Makes a message of the bytes of a stamp and the numbers of a state."""


def stamp(nanoseconds: int) -> bytes:
    """Return the bytes of a builtin_interfaces Time or Duration."""
    return _STAMP.pack(*divmod(nanoseconds, NANOSECONDS))


def clock_message(nanoseconds: int) -> bytes:
    """Return a rosgraph_msgs/Clock."""
    return _ENCAPSULATION + stamp(nanoseconds)


def _layout(*fields: str | int, align: int = 8) -> bytes:
    """Return what stands between the stamp of a header and doubles that follow the fields.

    A string is its length with the closing zero, its characters, zero; an int is the
    length of a sequence. Numbers lie at multiples of their size, counted from the end
    of the encapsulation.
    """
    data = bytearray(_STAMP.size)
    for field in fields:
        data += bytes(-len(data) % 4)
        if isinstance(field, int):
            data += struct.pack("<I", field)
        else:
            encoded = field.encode() + b"\x00"
            data += struct.pack("<I", len(encoded)) + encoded
    return bytes(data[_STAMP.size :]) + bytes(-len(data) % align)


def state_messages(
    frame_id: str = "", base_frame: str = BASE_FRAME
) -> tuple[Message, ...]:
    """Return what makes the messages joint_states, orientation and euler_zyz.

    The frame_id is that of joint_states, whose effort is the torque over the step that
    ended; the others are in the base frame. Each is one call of a struct: field by
    field takes 1.7 times as long.
    """
    count = len(JOINTS)
    names, base = _layout(frame_id, count, *JOINTS, count), _layout(base_frame)
    stamped = f"<{len(_ENCAPSULATION)}s{_STAMP.size}s"
    more = f"I4x{count}d"  # a sequence: its length, padding, the numbers
    pack_joints, pack_quaternion, pack_angles = (
        struct.Struct(stamped + form).pack
        for form in (
            f"{len(names)}s{count}d{more}{more}",
            f"{len(base)}s4d",
            f"{len(base)}s3d",
        )
    )

    def joint_states(at: bytes, numbers: Numbers) -> bytes:
        _, joints, torque = numbers
        sequences = *joints[:9], count, *joints[9:], count, *torque, *_PASSIVE
        return pack_joints(_ENCAPSULATION, at, names, *sequences)

    def orientation(at: bytes, numbers: Numbers) -> bytes:
        return pack_quaternion(_ENCAPSULATION, at, base, *numbers[0])

    def euler_zyz(at: bytes, numbers: Numbers) -> bytes:
        return pack_angles(_ENCAPSULATION, at, base, *zyz_angles(numbers[0]))

    return joint_states, orientation, euler_zyz


def zyz_angles(quaternion: Sequence[float]) -> tuple[float, float, float]:
    """ZYZ angles theta, phi, psi [rad] of a quaternion (x, y, z, w), as `geometry.zyz_angles`.

    z / w is tan((theta + psi) / 2), -x / y is tan((theta - psi) / 2).
    """
    x, y, z, w = quaternion
    sine, cosine = math.hypot(x, y), math.hypot(z, w)
    total = math.atan2(z, w) if cosine else 0.0
    difference = math.atan2(-x, y) if sine else 0.0
    if sine and cosine:
        theta, psi = total + difference, total - difference
    else:
        theta, psi = 0.0, 2.0 * (total - difference)
    theta, psi = (math.remainder(angle, 2.0 * math.pi) for angle in (theta, psi))
    return theta, 2.0 * math.atan2(sine, cosine), psi


class Measurements:
    """Messages joint_states as a robot gives them: all nine joints behind a channel.

    A sample that is dropped has no message, which is empty here.
    """

    def __init__(self, given: SimulatorParameters, exact: Message) -> None:
        self._given, self._exact = given, exact
        self.restart()

    def restart(self) -> None:
        """Begin anew at the first sample of a run: the same seed gives the same noise."""
        channel, seed = (
            self._given.channel or ControlChannel(),
            self._given.measurement_seed,
        )
        self._random = np.random.default_rng(seed)
        kinds = range(len(JOINTS) // 3)  # gamma, mu, beta
        self._angles = [ChannelState(channel, (seed, kind)) for kind in kinds]
        self._rates = [
            ChannelState(channel, 0) for kind in kinds
        ]  # only late, as the angles

    def message(self, at: bytes, numbers: Numbers) -> bytes:
        """Return the message of a sample."""
        quaternion, joints, torque = numbers
        found: list[list[float]] = [[], []]
        for kind, (angles, rates) in enumerate(
            zip(self._angles, self._rates, strict=True)
        ):
            first = 3 * kind
            triples = (
                triple(joints[first : first + 3]),
                triple(joints[9 + first : 12 + first]),
            )
            measured = angles.measure(*triples)
            found[0] += angles.transmit(measured.gamma)
            found[1] += rates.transmit(measured.gamma_dot)
        dropped = self._given.dropped_samples
        if dropped and self._random.random() < dropped:
            return b""
        return self._exact(at, (quaternion, [*found[0], *found[1]], torque))


class TorqueLog:
    """applied_torques: torque and moment of every tick since the last publication.

    Point i holds over tick i; its time is the end of that tick, relative to the
    header's stamp.
    """

    def __init__(
        self, period_ns: int, *, moments: bool = False, base_frame: str = BASE_FRAME
    ) -> None:
        self._base_frame = base_frame
        self._names = (*ACTUATORS, *(MOMENTS if moments else ()))
        self._period_ns, self._moments = period_ns, moments
        # Each point begins with no positions, velocities and accelerations and the
        # length of a row; the first beginning is part of what stands before the points.
        self._begin = 0, 0, 0, len(self._names)
        self._point = struct.Struct(f"<{len(self._names)}d2i{len(self._begin)}I")
        self.clear()

    def __len__(self) -> int:
        return len(self._rows)

    def clear(self) -> None:
        """Forget the rows."""
        self._rows: list[tuple[float, ...]] = []

    def append(self, torque: Vector3, moment: Sequence[float], ticks: int = 1) -> None:
        """Log the torque [N m] and the moment [N m] of some ticks."""
        self._rows += [(*torque, *moment) if self._moments else torque] * ticks

    def take(self, stamp_ns: int) -> bytes:
        """Return the message of the ticks logged since stamp_ns and clear the log."""
        named = self._base_frame, len(self._names), *self._names, len(self)
        head = _layout(*named, *self._begin) if self._rows else _layout(*named, align=1)
        ends = (
            divmod(tick * self._period_ns, NANOSECONDS)
            for tick in range(1, len(self) + 1)
        )
        points = b"".join(
            self._point.pack(*row, *end, *self._begin)
            for row, end in zip(self._rows, ends, strict=True)
        )
        self.clear()
        return _ENCAPSULATION + stamp(stamp_ns) + head + points[: -4 * len(self._begin)]


def follows_clock(node: Node) -> bool:
    """Whether use_sim_time is set."""
    return bool(node.get_parameter("use_sim_time").value)


class SimulatorTopics:
    """Publishers of the simulator: the `RunOutput` of its run."""

    def __init__(self, node: Node, scene: Scene, given: SimulatorParameters) -> None:
        self._node, own = node, topics.SIMULATOR
        self._clock = own["clock"].publisher(node) if given.publish_clock else None
        history = _HISTORY_S * given.publish_rate * (given.real_time_factor or _FAST)
        depth = round(min(max(history, _LEAST_DEPTH), _MOST_DEPTH))
        shown = ("joint_states", "orientation", "euler_zyz", "applied_torques")
        *self._shown, self._torques = (
            own[name].publisher(node, depth) for name in shown
        )
        self._samples = state_messages("", given.base_frame)
        self._idles = state_messages(IDLE_FRAME_ID, given.base_frame)
        self._measured: Measurements | None = None
        if given.channel is not None:
            exact, *others = self._samples
            self._measured = Measurements(given, exact)
            self._samples = (self._measured.message, *others, exact)
            self._idles = (*self._idles, self._idles[0])
            self._shown.append(own["true_joint_states"].publisher(node, depth))
        self._read: list[Publisher[Any]] = []
        self._states: list[tuple[Publisher[Any], Message]] = []
        self._counted_ns = 0
        self._phase = own["phase"].publisher(node)
        own["scene"].publisher(node).publish(String(data=dump(scene)))
        if given.publish_description:
            own["robot_description"].publisher(node).publish(String(data=urdf(scene)))
        self.diagnostics = own["diagnostics"].publisher(node)
        made = {publisher.topic_name: publisher for publisher in node.publishers}
        names = [
            node.resolve_topic_name(name) for name in given.wait_for_subscribers if name
        ]
        unknown = [name for name in names if name not in made]
        allowed = f"must be topics that the node publishes: {', '.join(sorted(made))}"
        follows = self._clock is not None and follows_clock(node)
        other = "a node with use_sim_time follows /clock and cannot be its source"
        refuse_unless(
            node.get_fully_qualified_name(),
            ("wait_for_subscribers", unknown, not unknown, allowed),
            ("publish_clock", True, not follows, other),
        )
        self._time_ns = 0  # of the clock that it publishes
        if self._clock is not None:
            self._time_ns = self.now_ns()
        self._awaited = [made[name] for name in names]
        moments = scene.moment is not None and scene.moment.topic
        ticks, period_ns = given.run.ticks_per_sample, given.run.period_ns
        self._log_ticks = math.ceil(LOG_NS / (ticks * period_ns)) * ticks
        self._log = TorqueLog(period_ns, moments=moments, base_frame=given.base_frame)
        self._log_from_ns = 0

    def now_ns(self) -> int:
        """Return the ROS time [ns]; 0 as long as a followed clock has none."""
        return self._time_ns or int(self._node.get_clock().now().nanoseconds)

    def missing_subscribers(self) -> list[str]:
        """Return the topics of wait_for_subscribers that have no subscriber."""
        return [
            one.topic_name for one in self._awaited if not one.get_subscription_count()
        ]

    @property
    def unread(self) -> bool:
        """Whether nothing receives samples, so that only the last of several has to be made."""
        self._count_subscribers(topics.COUNT_NS)
        return not self._read and self._clock is None

    def ticks(self, torque: Vector3, moment: Vector3, count: int) -> None:
        """Log the torque [N m] and external moment [N m] of some ticks."""
        self._log.append(torque, moment, count)

    def sample(self, simulation: Simulation, stamp_ns: int) -> None:
        """Publish a sample of the run, and from time to time the torques logged up to it."""
        logged = len(self._log)
        if self._measured is not None and not logged:  # the first sample of a run
            self._measured.restart()
        # the first of a run goes to all
        self._count_subscribers(topics.COUNT_NS if logged else 0)
        y, joints, torque = simulation.sample
        numbers = y[:4], joints, torque
        if self._clock is not None:
            self._time_ns = stamp_ns
            self._clock.publish(clock_message(stamp_ns))
        if logged >= self._log_ticks or not logged or self._torques not in self._read:
            self.flush()
            self._log_from_ns = stamp_ns
        at = stamp(stamp_ns)
        for publisher, message in self._states:
            if data := message(at, numbers):
                publisher.publish(data)

    def flush(self) -> None:
        """Publish the torques that have been logged, if any and if they are subscribed to."""
        if len(self._log) and self._torques in self._read:
            self._torques.publish(self._log.take(self._log_from_ns))
        self._log.clear()

    def idle(
        self, state: State, stamp_ns: int, *, at_rest: bool, moves: bool = False
    ) -> None:
        """Publish a state that is no sample; `at_rest` with zero rates and efforts.

        joint_states has this stamp and IDLE_FRAME_ID, the other topics the stamp zero;
        where it `moves`, our clock goes on to the stamp.
        """
        if self._clock is not None:
            self._time_ns = stamp_ns if moves else self._time_ns
            # again, for late subscribers
            self._clock.publish(clock_message(self._time_ns))
        self.flush()
        self._torques.publish(self._log.take(0))
        joints, torque = sum(state.joints, ()), state.torque
        if at_rest:
            joints, torque = (*joints[:9], *_AT_REST), ZERO
        self._count_subscribers(0)
        for publisher, message in self._messages(self._idles):
            at = stamp(stamp_ns if "joint_states" in publisher.topic_name else 0)
            publisher.publish(message(at, (state.quaternion, joints, torque)))

    def publish_phase(self, phase: str) -> None:
        """Publish and log the phase, with the reason of a fault."""
        self._phase.publish(String(data=phase))
        log = self._node.get_logger()
        if phase.startswith("fault"):
            log.error(f"{phase}; the last valid state is held until ~/reset")
        else:
            log.info(phase)

    def _count_subscribers(self, age_ns: int) -> None:
        """Find the topics that are subscribed to, unless that was done so long ago [ns]."""
        now = time.monotonic_ns()
        if now - self._counted_ns >= age_ns:
            self._counted_ns = now
            every = (*self._shown, self._torques)
            self._read = [topic for topic in every if topic.get_subscription_count()]
            self._states = self._messages(self._samples)

    def _messages(self, of: Sequence[Message]) -> list[tuple[Publisher[Any], Message]]:
        """Messages of a state whose topics have subscribers."""
        return [
            pair for pair in zip(self._shown, of, strict=True) if pair[0] in self._read
        ]
