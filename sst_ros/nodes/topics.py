# SPDX-License-Identifier: Apache-2.0
"""Topics, services and actions of the nodes in one table.

The nodes, the docs and the security policies follow that table. Behind it: who is at
the other end of a topic, subscriptions whose owner takes the messages when they are
needed, and goals of actions that end later than they are accepted.
"""

from __future__ import annotations

import importlib
import importlib.util
import math
import time
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.serialization import deserialize_message
from rclpy.subscription import Subscription
from rclpy.task import Future
from rclpy.topic_endpoint_info import TopicEndpointInfo
from rclpy.type_support import check_for_type_support

from sst_ros.runtime.torque_input import MOST_WAITING

PUBLISHES = "publishes"
SUBSCRIBES = "subscribes"
SERVES = "serves"
CALLED_SERVICES = "calls"
EXECUTES = "executes"

SERVICE_QOS = QoSProfile(depth=1000)
"""Of services and of our clients: with ten, the default, the eleventh request that
waits displaces the first, and so does the eleventh reply. All clients of a service
receive all of its replies.
"""
COUNT_NS = 20_000_000
"""A run counts the other ends of its topics this often, not at each tick: to count the
subscribers of four topics takes as long as a tick.
"""
UNNAMED = "a node whose name is not known yet"


class Endpoint(NamedTuple):
    """One topic, service or action of a node."""

    # PUBLISHES, SUBSCRIBES, SERVES, CALLED_SERVICES or EXECUTES, the last of an action
    use: str
    name: str
    type_name: str
    doc: str
    depth: int = 10  # messages kept for slow readers; 0 for ten seconds of them
    latched: bool = False  # the last message is kept for late joiners
    when: str = ""  # condition under which it exists; always where empty

    @property
    def kind(self) -> Any:
        """Type of its messages."""
        return message_type(self.type_name)

    def at(self, node: str) -> str:
        """Return its full name at the node of this full name."""
        name = self.name.replace("~", node)
        return name if name.startswith("/") else f"{node.rpartition('/')[0]}/{name}"

    def publisher(
        self, node: Node, depth: int = 10, *, simulator: str = ""
    ) -> Publisher[Any]:
        """Create its publisher; the depth is for a topic that has none of its own."""
        topic = self.name.format(simulator=simulator)
        return node.create_publisher(self.kind, topic, self.qos(depth))

    def qos(self, depth: int = 10) -> QoSProfile:
        """Return its QoS; the depth is for a topic that has none of its own."""
        durability = (
            DurabilityPolicy.TRANSIENT_LOCAL
            if self.latched
            else DurabilityPolicy.VOLATILE
        )
        return QoSProfile(depth=self.depth or depth, durability=durability)


# In names ~ stands for the name of the node, {simulator} for the parameter. The keys
# are the last parts of the names, but for a topic and a service of one name.

SIMULATOR: dict[str, Endpoint] = {
    "joint_states": Endpoint(
        PUBLISHES,
        "joint_states",
        "sensor_msgs/msg/JointState",
        "gamma_1..3, mu_1..3, beta_1..3: position [rad], velocity [rad/s];"
        " effort: torque over the step that ended [N m]; frame_id `idle` where"
        " it is no sample of a run",
        depth=0,
    ),
    "true_joint_states": Endpoint(
        PUBLISHES,
        "~/true_joint_states",
        "sensor_msgs/msg/JointState",
        "joint_states without noise, delay and gaps",
        depth=0,
        when="encoder_counts, angle_noise, rate_noise, measurement_delay or"
        " dropped_samples is set",
    ),
    "orientation": Endpoint(
        PUBLISHES,
        "~/orientation",
        "geometry_msgs/msg/QuaternionStamped",
        "orientation of {E} in {B}, the frame_id is base_frame",
        depth=0,
    ),
    "euler_zyz": Endpoint(
        PUBLISHES,
        "~/euler_zyz",
        "geometry_msgs/msg/Vector3Stamped",
        "the same as ZYZ angles theta, phi, psi [rad]",
        depth=0,
    ),
    "applied_torques": Endpoint(
        PUBLISHES,
        "~/applied_torques",
        "trajectory_msgs/msg/JointTrajectory",
        "torques of every step since the last message [N m], with the sample"
        " after 50 ms of simulated time and when the run pauses or ends; where"
        " the scene takes a moment from a topic also moment_x, moment_y,"
        " moment_z in {B}",
        depth=0,
    ),
    "imu": Endpoint(
        PUBLISHES,
        "~/imu",
        "sensor_msgs/msg/Imu",
        "inertial measurement unit on the star: orientation in {B}, angular"
        " velocity [rad/s], specific force [m/s^2] in its own frame (REP 145);"
        " samples of a run only",
        depth=0,
        when="imu is true",
    ),
    "reaction": Endpoint(
        PUBLISHES,
        "~/reaction",
        "geometry_msgs/msg/WrenchStamped",
        "force through O [N] and moment about O [N m] that a joint exerts on"
        " the link nearer the star, in the joint's frame; samples of a run only",
        depth=0,
        when="reaction names a joint",
    ),
    "scene": Endpoint(
        PUBLISHES,
        "~/scene",
        "std_msgs/msg/String",
        "the scene, as YAML",
        depth=1,
        latched=True,
    ),
    "phase": Endpoint(
        PUBLISHES,
        "~/phase",
        "std_msgs/msg/String",
        "waiting, running, paused, finished, or `fault: ` with the reason",
        depth=1,
        latched=True,
    ),
    "diagnostics": Endpoint(
        PUBLISHES,
        "/diagnostics",
        "diagnostic_msgs/msg/DiagnosticArray",
        "diagnostics of the run, at 1 Hz",
    ),
    "clock": Endpoint(
        PUBLISHES,
        "/clock",
        "rosgraph_msgs/msg/Clock",
        "simulated time",
        depth=1,
        when="publish_clock is true",
    ),
    "robot_description": Endpoint(
        PUBLISHES,
        "robot_description",
        "std_msgs/msg/String",
        "the scene as URDF",
        depth=1,
        latched=True,
        when="publish_description is true, the default",
    ),
    "commands": Endpoint(
        SUBSCRIBES,
        "~/commands",
        "std_msgs/msg/Float64MultiArray",
        "torques of gamma_1..3 [N m], held until the next",
        depth=MOST_WAITING,
    ),
    "commands_stamped": Endpoint(
        SUBSCRIBES,
        "~/commands_stamped",
        "sensor_msgs/msg/JointState",
        "the same by name, in effort [N m]; the stamp is that of the"
        " joint_states it answers",
        depth=MOST_WAITING,
    ),
    "external_moment": Endpoint(
        SUBSCRIBES,
        "~/external_moment",
        "geometry_msgs/msg/WrenchStamped",
        "moment on the star, torque in {B} [N m]; the force is not used",
        depth=MOST_WAITING,
        when="the scene has moment: {topic: true}, or external_moment is true",
    ),
    "set_state_topic": Endpoint(
        SUBSCRIBES,
        "~/set_state",
        "sensor_msgs/msg/JointState",
        "as the service ~/set_state, which answers: position [rad] and velocity"
        " [rad/s] (none for zero) of gamma_1..3; the log has the reply;"
        " deprecated",
    ),
    "pause": Endpoint(
        SERVES,
        "~/pause",
        "std_srvs/srv/SetBool",
        "pause the run, or resume it; idempotent",
    ),
    "step": Endpoint(
        SERVES,
        "~/step",
        "std_srvs/srv/Trigger",
        "advance a paused run by one sample; refused while running",
    ),
    "reset": Endpoint(
        SERVES,
        "~/reset",
        "std_srvs/srv/Trigger",
        "back to the initial state, also out of a fault; stamps continue",
    ),
    "set_state": Endpoint(
        SERVES,
        "~/set_state",
        "std_srvs/srv/Trigger",
        "put a run that waits or is paused into the state of the parameters"
        " state_gamma and state_gamma_dot; refused while running, in fault, and"
        " where it is not admissible",
    ),
}

_COMMAND_TOPICS: dict[str, Endpoint] = {
    "commands": Endpoint(
        PUBLISHES,
        "{simulator}/commands",
        "std_msgs/msg/Float64MultiArray",
        "torques [N m] that answer each joint_states",
        depth=1000,
        when="stamped is false",
    ),
    "commands_stamped": Endpoint(
        PUBLISHES,
        "{simulator}/commands_stamped",
        "sensor_msgs/msg/JointState",
        "the same, by name and stamp",
        depth=1000,
        when="stamped is true",
    ),
    "get_parameters": Endpoint(
        CALLED_SERVICES,
        "{simulator}/get_parameters",
        "rcl_interfaces/srv/GetParameters",
        "whether it runs in lockstep, where a command without a stamp is of no"
        " use: then the node ends",
        when="stamped is false",
    ),
}

PLAYER: dict[str, Endpoint] = {
    **_COMMAND_TOPICS,
    "joint_states": Endpoint(
        SUBSCRIBES,
        "joint_states",
        "sensor_msgs/msg/JointState",
        "samples that are answered, from the first on",
        depth=1000,
    ),
    "phase": Endpoint(
        SUBSCRIBES,
        "{simulator}/phase",
        "std_msgs/msg/String",
        "ends the player at a fault and at the end of the run",
        latched=True,
    ),
}

CONTROLLER: dict[str, Endpoint] = {
    **_COMMAND_TOPICS,
    "reference": Endpoint(
        PUBLISHES,
        "~/reference",
        "sensor_msgs/msg/JointState",
        "desired gamma [rad] and gamma_dot [rad/s]; effort: feedforward [N m];"
        " the stamp is that of the joint_states it belongs to",
        depth=1000,
    ),
    "tracking_error": Endpoint(
        PUBLISHES,
        "~/tracking_error",
        "sensor_msgs/msg/JointState",
        "desired - measured [rad], [rad/s]; effort: feedback [N m]; stamp as of"
        " ~/reference",
        depth=1000,
    ),
    "diagnostics": Endpoint(
        PUBLISHES,
        "/diagnostics",
        "diagnostic_msgs/msg/DiagnosticArray",
        "diagnostics of the control, at 1 Hz",
    ),
    "joint_states": Endpoint(
        SUBSCRIBES,
        "joint_states",
        "sensor_msgs/msg/JointState",
        "samples that are answered; the newest counts",
        depth=1,
    ),
    "phase": Endpoint(
        SUBSCRIBES,
        "{simulator}/phase",
        "std_msgs/msg/String",
        "begins anew at a reset, ends at a fault and at the end of the run",
        latched=True,
    ),
    "joint_trajectory": Endpoint(
        SUBSCRIBES,
        "~/joint_trajectory",
        "trajectory_msgs/msg/JointTrajectory",
        "motion to follow, from its stamp on or at once and in place of the"
        " present one; refused as a whole where it cannot be followed, and where"
        " motion is not topic",
    ),
    "follow_joint_trajectory": Endpoint(
        EXECUTES,
        "~/follow_joint_trajectory",
        "control_msgs/action/FollowJointTrajectory",
        "the same with tolerances, feedback and a result",
        when="control_msgs is installed",
    ),
}

VIEWER: dict[str, Endpoint] = {
    "joint_states": Endpoint(
        SUBSCRIBES,
        "joint_states",
        "sensor_msgs/msg/JointState",
        "states that are shown",
        depth=64,
    ),
    "scene": Endpoint(
        SUBSCRIBES,
        "{simulator}/scene",
        "std_msgs/msg/String",
        "manipulator that is drawn",
        depth=1,
        latched=True,
    ),
    "phase": Endpoint(
        SUBSCRIBES,
        "{simulator}/phase",
        "std_msgs/msg/String",
        "phase of the run",
        depth=1,
        latched=True,
    ),
    "diagnostics": Endpoint(
        SUBSCRIBES,
        "/diagnostics",
        "diagnostic_msgs/msg/DiagnosticArray",
        "diagnostics of the run",
    ),
    "commands": Endpoint(
        PUBLISHES,
        "{simulator}/commands",
        "std_msgs/msg/Float64MultiArray",
        "torques of the page's sliders [N m], 20 times a second",
        when="a slider was moved and no other node publishes commands",
    ),
    "pause": Endpoint(
        CALLED_SERVICES,
        "{simulator}/pause",
        "std_srvs/srv/SetBool",
        "the button Pause, or Resume",
    ),
    "step": Endpoint(
        CALLED_SERVICES,
        "{simulator}/step",
        "std_srvs/srv/Trigger",
        "the button Step",
    ),
    "reset": Endpoint(
        CALLED_SERVICES,
        "{simulator}/reset",
        "std_srvs/srv/Trigger",
        "the button Reset",
    ),
}

NODE_TOPICS = {
    "simulator": SIMULATOR,
    "torque_player": PLAYER,
    "inverse_dynamics": CONTROLLER,
    "recorder": {},
    "viewer": VIEWER,
}
"""Topics, services and actions of each node but those that the user names."""
SAMPLED = tuple(
    endpoint.name
    for endpoint in SIMULATOR.values()
    if endpoint.use == PUBLISHES and not endpoint.when
)
"""Topics that a simulator publishes in every run."""


def message_type(type_name: str) -> Any:
    """Import a type of messages, services or actions."""
    package, form, name = type_name.split("/")
    return getattr(importlib.import_module(f"{package}.{form}"), name)


def optional_types(node: Node, type_names: Sequence[str]) -> dict[str, Any] | None:
    """Import the types of an optional package, by the last part of their names.

    None is returned where the package is not installed, and with a warning where its
    installation is incomplete: a type is missing, or cannot be used by this middleware.
    """
    package = type_names[0].partition("/")[0]
    if importlib.util.find_spec(package) is None:
        return None
    types = {}
    try:
        for type_name in type_names:
            message_class = message_type(type_name)
            check_for_type_support(message_class)
            _, _, name = type_name.rpartition("/")
            types[name] = message_class
    except Exception as error:
        reason = f"{type(error).__name__}: {error}"
        node.get_logger().warning(
            f"{package} is installed but incomplete, not used ({reason})"
        )
        return None
    return types


def subscribe(
    node: Node,
    own: dict[str, Endpoint],
    simulator: str = "",
    **callbacks: Callable[[Any], None],
) -> None:
    """Create a node's subscriptions to topics of its own table, by the names there."""
    for name, callback in callbacks.items():
        endpoint = own[name]
        topic = endpoint.name.format(simulator=simulator)
        node.create_subscription(endpoint.kind, topic, callback, endpoint.qos())


def publishers(node: Node, topic: str, *, best_effort: bool = False) -> list[str]:
    """Return full names of the nodes that publish a topic.

    There is one for each publisher, or for each best-effort publisher.
    """
    return [
        _name_of(info)
        for info in node.get_publishers_info_by_topic(topic)
        if not best_effort
        or info.qos_profile.reliability == ReliabilityPolicy.BEST_EFFORT
    ]


def _name_of(info: TopicEndpointInfo) -> str:
    """Return the full name of the node of a publisher or subscription."""
    if "_UNKNOWN_" in info.node_name:  # to DDS, until its discovery is finished
        return UNNAMED
    return f"{info.node_namespace.rstrip('/')}/{info.node_name}"


def other_types(node: Node, topic: Endpoint, *, simulator: str = "") -> list[str]:
    """Return who publishes a topic of ours with another type.

    Such messages never arrive.
    """
    name = node.resolve_topic_name(topic.name.format(simulator=simulator))
    return [
        f"{name} of {_name_of(info)} is {info.topic_type} and not received: must be "
        f"{topic.type_name}"
        for info in node.get_publishers_info_by_topic(name)
        if info.topic_type != topic.type_name
    ]


def diagnostics(
    node: Node, subject: str, level: int, text: str, values: dict[str, Any]
) -> DiagnosticArray:
    """Build a DiagnosticArray of one status of a node.

    The level is 0, 1 or 2 for an error.
    """
    name = node.get_fully_qualified_name()
    status = DiagnosticStatus(level=bytes([level]), message=text)
    status.name = f"{name}: {subject}"
    status.hardware_id = name
    status.values = [KeyValue(key=key, value=str(x)) for key, x in values.items()]
    message = DiagnosticArray(status=[status])
    message.header.stamp = node.get_clock().now().to_msg()
    return message


class NeverSpun(MutuallyExclusiveCallbackGroup):
    """Keeps subscriptions out of the executor, and their events.

    Their owner takes the messages.

    An executor wakes a thread for each message, which costs far more than taking it. In
    a wait for an event of a subscription of Fast DDS, each message that has not been
    taken ends the wait.
    """

    def can_execute(self, entity: object) -> bool:
        """Refuse."""
        return False


def take(subscription: Subscription[Any]) -> tuple[bytes, dict[str, Any]] | None:
    """Take the bytes of the next message and its information, or None.

    rclpy has no public call that takes a message; this is what its executors do.
    """
    handle: Any = subscription.handle
    with handle:
        taken: tuple[bytes, dict[str, Any]] | None = handle.take_message(
            subscription.msg_type, True
        )
    return taken


class Reader:
    """Messages of a topic, each as soon as it has arrived.

    One is `waiting` that is known and arrived after the time last given to `read`.
    """

    def __init__(self, node: Node, topic: Endpoint) -> None:
        self._subscription = node.create_subscription(
            topic.kind,
            topic.name,
            lambda _: None,
            topic.depth,
            callback_group=NeverSpun(),
        )
        self._next: tuple[Any, int] | None = None
        self._count_ns = 0.0
        self._published = True
        self.waiting = False

    def read(self, until_ns: float) -> Sequence[Any]:
        """Return the next messages that arrived until this monotonic time [ns].

        They are MOST_WAITING at most. A topic without publishers is looked at every 20
        ms, because a look costs 5 us in a run that wakes for each sample, with cold
        caches; at once where the time is infinite.
        """
        if self._count_ns <= until_ns < math.inf:
            self._count_ns = until_ns + COUNT_NS
            self._published = self._subscription.get_publisher_count() > 0
        elif not self._published and until_ns < math.inf:
            return ()
        messages: list[Any] = []
        while len(messages) < MOST_WAITING:
            following = self._next or self._take()
            if following is None:
                break
            message, arrived_ns = following
            self.waiting = arrived_ns > until_ns
            self._next = following if self.waiting else None
            if self.waiting:
                break
            messages.append(message)
        return messages

    def _take(self) -> tuple[Any, int] | None:
        """Take the next message and find when it arrived; None if there is none."""
        # As bytes: otherwise an empty message is made each time that there is none.
        taken = take(self._subscription)
        if taken is None:
            return None
        data, information = taken
        message = deserialize_message(data, self._subscription.msg_type)
        ago = max(0, time.time_ns() - information["received_timestamp"])
        return message, time.monotonic_ns() - ago


class ActionGoal:
    """An accepted goal of an action, by its handle.

    It runs until `end`, in any thread.
    """

    def __init__(self, handle: Any) -> None:
        self.handle = handle
        self._result: Future[Any] = Future()
        handle.execute(self._wait)

    @staticmethod
    def serve(
        node: Node,
        action_type: Any,
        name: str,
        begin: Callable[[Any], None],
        **extra_callbacks: Any,
    ) -> None:
        """Serve an action whose goals `begin` makes, from handles of rclpy."""
        # most nodes have no action
        from rclpy.action.server import ActionServer, CancelResponse

        callbacks = {
            "cancel_callback": lambda _: CancelResponse.ACCEPT,
            **extra_callbacks,
        }
        ActionServer(
            node,
            action_type,
            name,
            lambda _: None,
            handle_accepted_callback=begin,
            **callbacks,
        )

    async def _wait(self, _: Any) -> Any:
        return await self._result

    def end(self, result: Any, *, success: bool) -> None:
        """End the goal with a result.

        It is canceled where that was requested, else it ends as `success` is.
        """
        if self.handle.is_cancel_requested:
            self.handle.canceled()
        elif success:
            self.handle.succeed()
        else:
            self.handle.abort()
        self._result.set_result(result)
