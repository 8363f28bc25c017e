# SPDX-License-Identifier: Apache-2.0
"""Topics, services and actions of the nodes: one table that they, the docs and the policies follow.

Who is at the other end of a topic, subscriptions whose owner takes the messages when he
needs them, and goals of actions that end later than they are accepted.
"""

from __future__ import annotations

import importlib
import importlib.util
import math
import re
import time
from collections import defaultdict
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

PUBLISHES, SUBSCRIBES, SERVES, CALLS = "publishes", "subscribes", "serves", "calls"
EXECUTES = "executes"

# Use, name, type; how many messages are kept for slow readers, 0 for two seconds of
# them; `latched` where the last one is kept for late joiners. Then what it carries, and
# the condition under which it exists. In names ~ stands for the name of the node,
# {simulator} for the parameter.
_TABLE = """
[simulator]
publishes joint_states sensor_msgs/msg/JointState 0
    gamma_1..3, mu_1..3, beta_1..3: position [rad], velocity [rad/s]; effort: torque over the step
    that ended [N m]; frame_id `idle` where it is no sample of a run
publishes ~/true_joint_states sensor_msgs/msg/JointState 0
    joint_states without noise, delay and gaps
    if encoder_counts, angle_noise, rate_noise, measurement_delay or dropped_samples is set
publishes ~/orientation geometry_msgs/msg/QuaternionStamped 0
    orientation of {E} in {B}, the frame_id is base_frame
publishes ~/euler_zyz geometry_msgs/msg/Vector3Stamped 0
    the same as ZYZ angles theta, phi, psi [rad]
publishes ~/applied_torques trajectory_msgs/msg/JointTrajectory 0
    torques of every step since the last message [N m], with the sample after 50 ms of simulated
    time and when the run pauses or ends; where the scene takes a moment from a topic also moment_x,
    moment_y, moment_z in {B}
publishes ~/scene std_msgs/msg/String 1 latched
    the scene, as YAML
publishes ~/phase std_msgs/msg/String 1 latched
    waiting, running, paused, finished, or `fault: ` with the reason
publishes /diagnostics diagnostic_msgs/msg/DiagnosticArray 10
    diagnostics of the run, at 1 Hz
publishes /clock rosgraph_msgs/msg/Clock 1
    simulated time
    if publish_clock is true
publishes robot_description std_msgs/msg/String 1 latched
    the scene as URDF
    if publish_description is true, the default
subscribes ~/commands std_msgs/msg/Float64MultiArray MOST_WAITING
    torques of gamma_1..3 [N m], held until the next
subscribes ~/commands_stamped sensor_msgs/msg/JointState MOST_WAITING
    the same by name, in effort [N m]; the stamp is that of the joint_states it answers
subscribes ~/external_moment geometry_msgs/msg/WrenchStamped MOST_WAITING
    moment on the star, torque in {B} [N m]; the force is not used
    if the scene has moment: {topic: true}
subscribes ~/set_state sensor_msgs/msg/JointState 10
    state to continue from: position [rad] and velocity [rad/s] (none for zero) of gamma_1..3;
    refused while running, in fault, and where it is not admissible
serves ~/pause std_srvs/srv/SetBool
    pause the run, or resume it; idempotent
serves ~/step std_srvs/srv/Trigger
    advance a paused run by one sample; refused while running
serves ~/reset std_srvs/srv/Trigger
    back to the initial state, also out of a fault; stamps continue

[torque_player inverse_dynamics]
publishes {simulator}/commands std_msgs/msg/Float64MultiArray 1000
    torques [N m] that answer each joint_states
    if stamped is false
publishes {simulator}/commands_stamped sensor_msgs/msg/JointState 1000
    the same, by name and stamp
    if stamped is true
calls {simulator}/get_parameters rcl_interfaces/srv/GetParameters
    whether it runs in lockstep, where a command without a stamp is of no use: then the node ends
    if stamped is false

[torque_player]
subscribes joint_states sensor_msgs/msg/JointState 1000
    samples that are answered, from the first on
subscribes {simulator}/phase std_msgs/msg/String 10 latched
    ends the player at a fault and at the end of the run

[inverse_dynamics]
publishes ~/reference sensor_msgs/msg/JointState 1000
    desired gamma [rad] and gamma_dot [rad/s]; effort: feedforward [N m]; the stamp is that of the
    joint_states it belongs to
publishes ~/tracking_error sensor_msgs/msg/JointState 1000
    desired - measured [rad], [rad/s]; effort: feedback [N m]; stamp as of ~/reference
publishes /diagnostics diagnostic_msgs/msg/DiagnosticArray 10
    diagnostics of the control, at 1 Hz
subscribes joint_states sensor_msgs/msg/JointState 1
    samples that are answered; the newest counts
subscribes {simulator}/phase std_msgs/msg/String 10 latched
    begins anew at a reset, ends at a fault and at the end of the run
subscribes ~/joint_trajectory trajectory_msgs/msg/JointTrajectory 10
    motion to follow, from its stamp on or at once and in place of the present one; refused as a
    whole where it cannot be followed, and where motion is not topic
executes ~/follow_joint_trajectory control_msgs/action/FollowJointTrajectory
    the same with tolerances, feedback and a result
    if control_msgs is installed

[viewer]
subscribes joint_states sensor_msgs/msg/JointState 64
    states that are shown
subscribes {simulator}/scene std_msgs/msg/String 1 latched
    manipulator that is drawn
subscribes {simulator}/phase std_msgs/msg/String 1 latched
    phase of the run
subscribes /diagnostics diagnostic_msgs/msg/DiagnosticArray 10
    diagnostics of the run
publishes {simulator}/commands std_msgs/msg/Float64MultiArray 10
    torques of the page's sliders [N m], 20 times a second
    if a slider was moved and no other node publishes commands
calls {simulator}/pause std_srvs/srv/SetBool
    the button Pause, or Resume
calls {simulator}/step std_srvs/srv/Trigger
    the button Step
calls {simulator}/reset std_srvs/srv/Trigger
    the button Reset
"""

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
    """One topic, service or action of a node: a row of the table."""

    use: str  # PUBLISHES, SUBSCRIBES, SERVES, CALLS or EXECUTES, the last of an action
    name: str
    type_name: str
    depth: int  # messages kept for slow readers; 0 for two seconds of them
    latched: bool  # the last message is kept for late joiners
    when: str  # condition under which it exists; always where empty
    doc: str

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


_ROW = re.compile(
    r"(\w+) (\S+) (\S+) ?(\w*)( latched)?\n((?:    (?!if ).*\n)*)(?:    if (.*)\n)?"
)


def _read(table: str) -> dict[str, dict[str, Endpoint]]:
    """Return the endpoints by node and by the last part of their names."""
    nodes: dict[str, dict[str, Endpoint]] = defaultdict(dict)
    for part in table.replace("MOST_WAITING", str(MOST_WAITING)).split("\n[")[1:]:
        sharing, _, rows = part.partition("]\n")
        for use, name, kind, depth, latched, doc, when in _ROW.findall(rows):
            text = " ".join(doc.split())
            one = Endpoint(use, name, kind, int(depth or 10), bool(latched), when, text)
            for node in sharing.split():
                nodes[node][name.rpartition("/")[2]] = one
    return nodes


NODES = _read(_TABLE)
SIMULATOR, PLAYER = NODES["simulator"], NODES["torque_player"]
CONTROLLER, VIEWER = NODES["inverse_dynamics"], NODES["viewer"]
SAMPLED = tuple(
    one.name for one in SIMULATOR.values() if one.use == PUBLISHES and not one.when
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
    kinds = {}
    try:
        for type_name in type_names:
            kind = message_type(type_name)
            check_for_type_support(kind)
            kinds[type_name.rpartition("/")[2]] = kind
    except Exception as error:
        reason = f"{type(error).__name__}: {error}"
        node.get_logger().warning(
            f"{package} is installed but incomplete, not used ({reason})"
        )
        return None
    return kinds


def subscribe(
    node: Node,
    own: dict[str, Endpoint],
    simulator: str = "",
    **callbacks: Callable[[Any], None],
) -> None:
    """Create the subscriptions of a node to topics of its own table, by the names there."""
    for name, callback in callbacks.items():
        one, topic = own[name], own[name].name.format(simulator=simulator)
        node.create_subscription(one.kind, topic, callback, one.qos())


def publishers(node: Node, topic: str, *, best_effort: bool = False) -> list[str]:
    """Full names of the nodes that publish a topic, one for each (best-effort) publisher."""
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
    """Say who publishes a topic of ours with another type, whose messages never arrive."""
    name = node.resolve_topic_name(topic.name.format(simulator=simulator))
    return [
        f"{name} of {_name_of(info)} is {info.topic_type} and not received: must be "
        f"{topic.type_name}"
        for info in node.get_publishers_info_by_topic(name)
        if info.topic_type != topic.type_name
    ]


def diagnostics(
    node: Node, what: str, level: int, text: str, values: dict[str, Any]
) -> DiagnosticArray:
    """Build a DiagnosticArray of one status of a node.

    The level is 0, 1 or 2 for an error.
    """
    status = DiagnosticStatus(level=bytes([level]), message=text)
    name = node.get_fully_qualified_name()
    status.name, status.hardware_id = f"{name}: {what}", name
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
        one: tuple[bytes, dict[str, Any]] | None = handle.take_message(
            subscription.msg_type, True
        )
    return one


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
        found: list[Any] = []
        while len(found) < MOST_WAITING and (following := self._next or self._take()):
            message, arrived_ns = following
            self.waiting = arrived_ns > until_ns
            self._next = following if self.waiting else None
            if self.waiting:
                break
            found.append(message)
        return found

    def _take(self) -> tuple[Any, int] | None:
        """Take the next message and find when it arrived; None if there is none."""
        # As bytes: otherwise an empty message is made each time that there is none.
        if (taken := take(self._subscription)) is None:
            return None
        data, information = taken
        message = deserialize_message(data, self._subscription.msg_type)
        ago = max(0, time.time_ns() - information["received_timestamp"])
        return message, time.monotonic_ns() - ago


class ActionGoal:
    """An accepted goal of an action, by its handle: it runs until `end`, in any thread."""

    def __init__(self, handle: Any) -> None:
        self.handle = handle
        self._result: Future[Any] = Future()
        handle.execute(self._wait)

    @staticmethod
    def serve(
        node: Node, kind: Any, name: str, begin: Callable[[Any], None], **more: Any
    ) -> None:
        """Serve an action whose goals `begin` makes, from handles of rclpy."""
        # most nodes have no action
        from rclpy.action.server import ActionServer, CancelResponse

        given = {"cancel_callback": lambda _: CancelResponse.ACCEPT, **more}
        ActionServer(
            node, kind, name, lambda _: None, handle_accepted_callback=begin, **given
        )

    async def _wait(self, _: Any) -> Any:
        return await self._result

    def end(self, result: Any, *, success: bool) -> None:
        """End the goal with a result: canceled where that was requested, else as `success` is."""
        if self.handle.is_cancel_requested:
            self.handle.canceled()
        elif success:
            self.handle.succeed()
        else:
            self.handle.abort()
        self._result.set_result(result)
