# SPDX-License-Identifier: Apache-2.0
"""What the simulator publishes: its topics, and when something goes to them.

Publishing happens in the thread of the run, after the step, in the slack before the
next deadline; a topic without subscribers is left out. rclpy holds the interpreter's
lock while it publishes (measured: 200 publications beside a busy thread are never
interrupted), so a thread of its own could not work beside the next step; it would only
add switches between threads.

`publish` serialises a message before it returns, so one object of each kind serves a
whole run: to make new ones would take longer than to publish them.
"""

from __future__ import annotations

import math
import time
from array import array
from collections.abc import Sequence
from typing import Any

from builtin_interfaces.msg import Duration, Time
from geometry_msgs.msg import QuaternionStamped, Vector3Stamped
from rclpy.node import Node
from rclpy.publisher import Publisher
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import JointState
from std_msgs.msg import String
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from sst_ros.description.robot import ACTUATED_LINKS, INTERMEDIATE, urdf
from sst_ros.dynamics.reactions import reaction_at
from sst_ros.errors import refuse_unless
from sst_ros.nodes import topics
from sst_ros.nodes.sensors import (
    ImuMessage,
    MeasuredJointStateMessage,
    Numbers,
    ReactionMessage,
    StateMessages,
)
from sst_ros.runtime.settings import SimulatorParameters
from sst_ros.scene.loads import ACTUATED_JOINTS, JOINTS, MOMENTS, PASSIVE_JOINTS
from sst_ros.scene.scene import Scene
from sst_ros.scene.yaml_document import dump
from sst_ros.simulation.simulation import Simulation
from sst_ros.state import BASE_FRAME, IDLE_FRAME_ID, NANOSECONDS, ZERO, State, Vector3

LOG_NS = 50_000_000
"""Torques are published once for about this time, not with each sample."""
_HISTORY_S = 10
"""Time of which messages are kept for slow readers."""
_FAST = 10
"""Real-time factor that the history of a run without deadlines is made for."""
_LEAST_DEPTH = 10
_MOST_DEPTH = 20_000
"""Messages that are kept at least, and at most: they take memory."""
_AT_REST = (0.0,) * len(JOINTS)
_PASSIVE = (0.0,) * len(PASSIVE_JOINTS)
_SENSORS = ("imu", "reaction")
"""Topics of samples only, for which the acceleration of the star is computed."""


class _Stateless:
    """A message that depends on the present numbers only."""

    def restart(self) -> None:
        """Begin anew at the first sample of a run: there is nothing to forget."""


def time_of(nanoseconds: int) -> Time:
    """Return a stamp."""
    seconds, nanosec = divmod(nanoseconds, NANOSECONDS)
    return Time(sec=seconds, nanosec=nanosec)


class JointStateMessage(_Stateless):
    """joint_states: all nine joints.

    The effort is the torque over the step that ended.
    """

    def __init__(self, frame_id: str = "") -> None:
        self._message = JointState(name=list(JOINTS))
        self._message.header.frame_id = frame_id

    def fill(self, stamp: Time, numbers: Numbers) -> JointState:
        """Return the message."""
        message = self._message
        message.header.stamp = stamp
        message.position = array("d", numbers.angles)
        message.velocity = array("d", numbers.rates)
        message.effort = array("d", (*numbers.torque, *_PASSIVE))
        return message


class OrientationMessage(_Stateless):
    """~/orientation: the quaternion of {E} in {B}."""

    def __init__(self, base_frame: str = BASE_FRAME) -> None:
        self._message = QuaternionStamped()
        self._message.header.frame_id = base_frame

    def fill(self, stamp: Time, numbers: Numbers) -> QuaternionStamped:
        """Return the message."""
        self._message.header.stamp = stamp
        quaternion = self._message.quaternion
        quaternion.x, quaternion.y, quaternion.z, quaternion.w = numbers.quaternion
        return self._message


class EulerMessage(_Stateless):
    """~/euler_zyz: theta, phi and psi as x, y and z of a vector."""

    def __init__(self, base_frame: str = BASE_FRAME) -> None:
        self._message = Vector3Stamped()
        self._message.header.frame_id = base_frame

    def fill(self, stamp: Time, numbers: Numbers) -> Vector3Stamped:
        """Return the message."""
        self._message.header.stamp = stamp
        angles = self._message.vector
        angles.x, angles.y, angles.z = zyz_angles(numbers.quaternion)
        return self._message


def zyz_angles(quaternion: Sequence[float]) -> tuple[float, float, float]:
    """Return ZYZ angles theta, phi, psi [rad] of a quaternion (x, y, z, w).

    They are those of `geometry.zyz_angles`: z / w is tan((theta + psi) / 2), -x / y is
    tan((theta - psi) / 2).
    """
    x, y, z, w = quaternion
    sine = math.hypot(x, y)  # of phi / 2
    cosine = math.hypot(z, w)
    half_sum = math.atan2(z, w) if cosine else 0.0  # (theta + psi) / 2
    half_difference = math.atan2(-x, y) if sine else 0.0  # (theta - psi) / 2
    theta = half_sum + half_difference
    psi = half_sum - half_difference
    if not (sine and cosine):  # only one of the two is determined
        theta = 0.0
        psi = 2.0 * (half_sum - half_difference)
    full_turn = 2.0 * math.pi
    phi = 2.0 * math.atan2(sine, cosine)
    return math.remainder(theta, full_turn), phi, math.remainder(psi, full_turn)


class TorqueLog:
    """applied_torques: torque and moment of every tick since the last publication.

    Point i holds over tick i; its time is the end of that tick, relative to the
    header's stamp.
    """

    def __init__(
        self, period_ns: int, *, moments: bool = False, base_frame: str = BASE_FRAME
    ) -> None:
        self._period_ns = period_ns
        self._moments = moments
        names = (*ACTUATED_JOINTS, *MOMENTS) if moments else ACTUATED_JOINTS
        self._message = JointTrajectory(joint_names=list(names))
        self._message.header.frame_id = base_frame
        self._points: list[JointTrajectoryPoint] = []  # those of the longest log
        self.clear()

    def __len__(self) -> int:
        return len(self._rows)

    def clear(self) -> None:
        """Forget the rows."""
        self._rows: list[tuple[float, ...]] = []

    def append(self, torque: Vector3, moment: Sequence[float], ticks: int = 1) -> None:
        """Log the torque [N m] and the moment [N m] of some ticks."""
        self._rows += [(*torque, *moment) if self._moments else torque] * ticks

    def take(self, stamp_ns: int) -> JointTrajectory:
        """Return the message of the ticks logged since stamp_ns and clear the log."""
        for tick in range(len(self._points) + 1, len(self) + 1):
            seconds, nanosec = divmod(tick * self._period_ns, NANOSECONDS)
            end = Duration(sec=seconds, nanosec=nanosec)
            self._points.append(JointTrajectoryPoint(time_from_start=end))
        points = self._points[: len(self)]
        for point, row in zip(points, self._rows, strict=True):
            point.effort = array("d", row)
        self._message.points = points
        self._message.header.stamp = time_of(stamp_ns)
        self.clear()
        return self._message


def state_messages(frame_id: str = "", base_frame: str = BASE_FRAME) -> StateMessages:
    """Return the messages that each state has; the frame_id is that of joint_states."""
    return {
        "joint_states": JointStateMessage(frame_id),
        "orientation": OrientationMessage(base_frame),
        "euler_zyz": EulerMessage(base_frame),
    }


def follows_clock(node: Node) -> bool:
    """Whether use_sim_time is set."""
    return bool(node.get_parameter("use_sim_time").value)


def sensor_messages(scene: Scene, settings: SimulatorParameters) -> StateMessages:
    """Return the messages of the sensors that the parameters ask for."""
    messages: StateMessages = {}
    if settings.imu:
        gravity = None if scene.gravity is None else scene.gravity.acceleration
        messages["imu"] = ImuMessage(settings, gravity)
    if settings.reaction != "none":
        joint, _, number = settings.reaction.partition("_")
        leg = int(number) - 1
        link = ACTUATED_LINKS[leg] if joint == "actuated" else INTERMEDIATE[leg]
        prefix = ""  # that robot_state_publisher puts before all frames
        if settings.base_frame.endswith(BASE_FRAME):
            prefix = settings.base_frame.removesuffix(BASE_FRAME)
        wrench = reaction_at(scene, joint, leg)
        messages["reaction"] = ReactionMessage(prefix + link, wrench)
    return messages


class SimulatorTopics:
    """Publishers of the simulator: the `RunOutput` of its run."""

    def __init__(self, node: Node, scene: Scene, settings: SimulatorParameters) -> None:
        self._node = node
        own = topics.SIMULATOR
        self._clock: Publisher[Clock] | None = None
        if settings.publish_clock:
            self._clock = own["clock"].publisher(node)
        self._time_ns = 0  # of the clock that it publishes
        self._samples = state_messages("", settings.base_frame)
        self._idles = state_messages(IDLE_FRAME_ID, settings.base_frame)
        if settings.channel is not None:
            self._samples["joint_states"] = MeasuredJointStateMessage(
                settings, self._samples["joint_states"]
            )
            self._samples["true_joint_states"] = JointStateMessage()
            self._idles["true_joint_states"] = JointStateMessage(IDLE_FRAME_ID)
        self._samples |= sensor_messages(scene, settings)
        depth = _history_depth(settings)
        self._states = {key: own[key].publisher(node, depth) for key in self._samples}
        self._torques = own["applied_torques"].publisher(node, depth)
        self._read: dict[str, Publisher[Any]] = {}  # states that have subscribers
        self._are_torques_read = False
        self._counted_ns = 0
        self._phase = own["phase"].publisher(node)
        own["scene"].publisher(node).publish(String(data=dump(scene)))
        if settings.publish_description:
            _publish_description(node, scene, settings)
        self.diagnostics = own["diagnostics"].publisher(node)
        self._awaited = self._find_awaited(settings)
        if self._clock is not None:
            self._time_ns = self.now_ns()
        run = settings.run
        sample_ns = run.ticks_per_sample * run.period_ns
        self._log_ticks = math.ceil(LOG_NS / sample_ns) * run.ticks_per_sample
        self._log = TorqueLog(
            run.period_ns,
            moments=scene.moment is not None and scene.moment.topic,
            base_frame=settings.base_frame,
        )
        self._log_from_ns = 0

    def _find_awaited(self, settings: SimulatorParameters) -> list[Publisher[Any]]:
        """Return the publishers that wait for subscribers.

        Raises InputError for unknown ones, and for a /clock that the node follows, too.
        """
        publishers = {
            publisher.topic_name: publisher for publisher in self._node.publishers
        }
        names = [
            self._node.resolve_topic_name(name)
            for name in settings.wait_for_subscribers
            if name
        ]
        unknown = [name for name in names if name not in publishers]
        listed = ", ".join(sorted(publishers))
        follows = self._clock is not None and follows_clock(self._node)
        published = f"must be topics that the node publishes: {listed}"
        no_source = "a node with use_sim_time follows /clock and cannot be its source"
        refuse_unless(
            self._node.get_fully_qualified_name(),
            ("wait_for_subscribers", unknown, not unknown, published),
            ("publish_clock", True, not follows, no_source),
        )
        return [publishers[name] for name in names]

    def now_ns(self) -> int:
        """Return the ROS time [ns]; 0 as long as a followed clock has none."""
        return self._time_ns or int(self._node.get_clock().now().nanoseconds)

    def missing_subscribers(self) -> list[str]:
        """Return the topics of wait_for_subscribers that have no subscriber."""
        return [
            publisher.topic_name
            for publisher in self._awaited
            if not publisher.get_subscription_count()
        ]

    @property
    def unread(self) -> bool:
        """Whether nothing receives samples: only the last of several has to be made."""
        self._count_subscribers(topics.COUNT_NS)
        return not (self._read or self._are_torques_read or self._clock)

    def ticks(self, torque: Vector3, moment: Vector3, count: int) -> None:
        """Log the torque [N m] and external moment [N m] of some ticks."""
        self._log.append(torque, moment, count)

    def sample(self, simulation: Simulation, stamp_ns: int) -> None:
        """Publish a sample of the run, and now and then the torques up to it."""
        logged = len(self._log)
        if logged:
            self._count_subscribers(topics.COUNT_NS)
        else:  # the first sample of a run, which goes to all
            self._count_subscribers(0)
            for message in self._samples.values():
                message.restart()
        if self._clock is not None:
            self._publish_clock(stamp_ns)
        if not 0 < logged < self._log_ticks or not self._are_torques_read:
            self.flush()
            self._log_from_ns = stamp_ns
        stamp = time_of(stamp_ns)
        numbers = self._numbers_of(simulation)
        for key, publisher in self._read.items():
            message = self._samples[key].fill(stamp, numbers)
            if message is not None:
                publisher.publish(message)

    def _numbers_of(self, simulation: Simulation) -> Numbers:
        motion, joints, torque = simulation.sample
        x, y, z, w, rate_x, rate_y, rate_z, *_ = motion
        angles = joints[: len(JOINTS)]
        rates = joints[len(JOINTS) :]
        numbers = Numbers((x, y, z, w), angles, rates, torque)
        if any(sensor in self._read for sensor in _SENSORS):
            numbers = numbers._replace(
                body_rate=(rate_x, rate_y, rate_z),
                body_acceleration=simulation.body_acceleration,
            )
        return numbers

    def flush(self) -> None:
        """Publish the torques that have been logged, if any and if they are read."""
        if len(self._log) and self._are_torques_read:
            self._torques.publish(self._log.take(self._log_from_ns))
        self._log.clear()

    def idle(
        self, state: State, stamp_ns: int, *, at_rest: bool, moves: bool = False
    ) -> None:
        """Publish a state that is no sample; `at_rest` with zero rates and efforts.

        joint_states has this stamp and IDLE_FRAME_ID, the other topics the stamp zero;
        where it `moves`, our clock goes on to the stamp. Sensors have no message.
        """
        if self._clock is not None:  # again, for late subscribers
            self._publish_clock(stamp_ns if moves else self._time_ns)
        self.flush()
        self._torques.publish(self._log.take(0))
        joints = state.joints
        angles = joints.gamma + joints.mu + joints.beta
        rates = joints.gamma_dot + joints.mu_dot + joints.beta_dot
        numbers = Numbers(state.quaternion, angles, rates, state.torque)
        if at_rest:
            numbers = numbers._replace(rates=_AT_REST, torque=ZERO)
        self._count_subscribers(0)
        for key, publisher in self._read.items():
            if key in self._idles:
                stamp = time_of(stamp_ns if key.endswith("joint_states") else 0)
                publisher.publish(self._idles[key].fill(stamp, numbers))

    def publish_phase(self, phase: str) -> None:
        """Publish and log the phase, with the reason of a fault."""
        self._phase.publish(String(data=phase))
        log = self._node.get_logger()
        if phase.startswith("fault"):
            log.error(f"{phase}; the last valid state is held until ~/reset")
        else:
            log.info(phase)

    def _publish_clock(self, time_ns: int) -> None:
        assert self._clock is not None
        self._time_ns = time_ns
        self._clock.publish(Clock(clock=time_of(time_ns)))

    def _count_subscribers(self, age_ns: int) -> None:
        """Find the topics that are read, unless that was done so long ago [ns]."""
        now_ns = time.monotonic_ns()
        if now_ns - self._counted_ns < age_ns:
            return
        self._counted_ns = now_ns
        self._read = {
            key: publisher
            for key, publisher in self._states.items()
            if publisher.get_subscription_count()
        }
        self._are_torques_read = self._torques.get_subscription_count() > 0


def _publish_description(
    node: Node, scene: Scene, settings: SimulatorParameters
) -> None:
    """Publish the scene as URDF, with the frame of the IMU where there is one."""
    mounts: dict[str, Vector3] = {}
    if settings.imu:
        mounts[settings.imu_frame] = settings.imu_position
    document = String(data=urdf(scene, mounts=mounts))
    topics.SIMULATOR["robot_description"].publisher(node).publish(document)


def _history_depth(settings: SimulatorParameters) -> int:
    """Return how many messages are kept for slow readers: ten seconds of them."""
    rate = settings.publish_rate * (settings.real_time_factor or _FAST)
    return round(min(max(_HISTORY_S * rate, _LEAST_DEPTH), _MOST_DEPTH))
