# SPDX-License-Identifier: Apache-2.0
"""A node that answers each sample of a simulator with torques.

A subclass says with which: `answer` is called with each sample of the run, `preview`
before the run. `connect` begins; the methods `hear`, `see` and `watch` may be extended.
"""

from __future__ import annotations

from array import array
from collections.abc import Callable
from typing import Any, TypeVar

from rcl_interfaces.srv import GetParameters
from rclpy.client import Client
from rclpy.publisher import Publisher
from sensor_msgs.msg import JointState
from std_msgs.msg import String

from sst_ros.errors import SstError
from sst_ros.nodes import topics
from sst_ros.nodes.process import Worker, every
from sst_ros.runtime.settings import AnsweringParameters
from sst_ros.scene.loads import ACTUATED_JOINTS
from sst_ros.state import ZERO, Vector3, is_idle, nanoseconds

_WATCH_S = 0.25
"""Period of looks at the simulator."""
_LOG_PERIOD_S = 5.0
"""What a node waits for is not logged more often."""

A = TypeVar("A", bound=AnsweringParameters)


class AnsweringWorker(Worker[A]):
    """A node that answers the joint states of a simulator with torques.

    The phase and the joint states are two topics, whose messages come in any order.

    Attributes:
        begun: a sample of the run has been answered.
        commanded: a torque has been sent, or was about to be: the simulator is this
            node's concern.
        phase: what the simulator said last of its run; empty before.
        silent_looks: looks of `watch` since the last joint states of this robot. A node
            that was stopped itself reads before it looks twice.
        foreign_states: messages on joint_states of other robots, which are ignored.

    """

    _commands: Publisher[Any]  # made by `connect`

    def __init__(
        self, node: str, cls: type[A], own: dict[str, topics.Endpoint]
    ) -> None:
        super().__init__(node, cls)
        self._own = own
        self.begun = False
        self.commanded = False
        self.phase = ""
        self.silent_looks = 0
        self.foreign_states = 0
        self._client: Client[Any, Any] | None = None  # of the simulator's parameters
        self._sync_reply: Any = None  # the future of its parameter `sync`
        # One message for all commands, whose torques are set in place.
        torques = array("d", ZERO)
        if self.parameters.stamped:
            kind = own["commands_stamped"].kind
            self._message: Any = kind(name=list(ACTUATED_JOINTS), effort=torques)
            self._torques = self._message.effort
        else:
            self._message = own["commands"].kind(data=torques)
            self._torques = self._message.data

    def connect(self, **callbacks: Callable[[Any], None]) -> None:
        """Publish commands, and listen to topics of the node's own table.

        Call this as soon as the node can answer.
        """
        own = self._own
        stamped = self.parameters.stamped
        simulator = self.parameters.simulator
        self.silent_looks = 0
        topic = own["commands_stamped" if stamped else "commands"]
        self._commands = topic.publisher(self.node, simulator=simulator)
        handlers = {"phase": self.hear, "joint_states": self.receive, **callbacks}
        topics.subscribe(self.node, own, simulator, **handlers)
        if not stamped:
            service = own["get_parameters"]
            name = service.name.format(simulator=simulator)
            self._client = self.node.create_client(service.kind, name)
        every(self.node, _WATCH_S, self.watch)

    def close(self) -> None:
        """Leave the actuators without torque where the work is not done."""
        if self.commanded and not self.done.is_set():
            self._publish_torque(ZERO)

    def answer(self, state: JointState, stamp_ns: int) -> None:
        """Answer a sample of the run by `send`."""
        raise NotImplementedError

    def preview(self) -> Vector3 | None:
        """Return what answers a state before the run [N m], if anything does."""
        raise NotImplementedError

    def may_begin(self) -> bool:
        """Whether all have subscribed who are to receive the whole run."""
        return not self.missing_subscribers()

    def missing_subscribers(self) -> list[str]:
        """Return the topics with too few subscribers, with counts.

        The parameters say how many are needed.
        """
        count = self._commands.get_subscription_count()
        least = self.parameters.min_subscribers
        if count >= least:
            return []
        return [f"{self._commands.topic_name} has {count} of {least}"]

    def hear(self, phase: String) -> None:
        """Remember the phase; end with a simulator that stops by a fault.

        Raises:
            SstError: the simulator, which this node has commanded, is in a fault.

        """
        self.phase = phase.data
        self._end_at_fault()

    def receive(self, state: JointState) -> None:
        """Have a state of this robot answered: one of the run, or shown before it.

        Raises:
            SstError: some actuators are missing, or the simulator is in a fault.

        """
        absent = [name for name in ACTUATED_JOINTS if name not in state.name]
        if len(absent) == len(ACTUATED_JOINTS):
            self._ignore(state)
            return
        if absent:
            names = list(state.name)
            raise SstError(
                f"joint_states has no {', '.join(absent)}: its names are {names}"
            )
        self.silent_looks = 0
        self.see(state)
        # Once begun, the simulator may end before its last sample has arrived.
        if not (self.begun or self.may_begin()):
            return
        if self.parameters.stamped:
            self._message.header.stamp = state.header.stamp
        stamp_ns = nanoseconds(state.header.stamp)
        if not is_idle(stamp_ns, state.header.frame_id):
            self.answer(state, stamp_ns)
        elif not self.begun:
            torque = self.preview()
            if torque is not None:
                self.send(torque)

    def see(self, state: JointState) -> None:
        """Look at a state of this robot before it is answered, or where it is not."""

    def send(self, torque: Vector3) -> None:
        """Publish torques [N m], with the stamp of the state that they answer.

        Raises:
            SstError: the simulator is in a fault.

        """
        self.commanded = True
        self._end_at_fault()
        self._publish_torque(torque)

    def watch(self) -> None:
        """End with the run.

        Raises:
            SstError: joint_states are silent for too long, or no answer is taken.

        """
        if self.commanded and self.phase == "finished":
            self.done.set()
            return
        self._refuse_lockstep()
        silent_s = self.silent_looks * _WATCH_S
        self.silent_looks += 1
        if silent_s > self.parameters.timeout:
            reason = "is the simulator running?"
            if self.foreign_states:
                joints = ", ".join(ACTUATED_JOINTS)
                reason = f"{self.foreign_states} messages without {joints} were ignored"
            robots = topics.other_types(self.node, self._own["joint_states"])
            reasons = "; ".join([reason, *robots])
            raise SstError(f"no joint_states for {silent_s:.1f} s: {reasons}")
        if not self.commanded and silent_s < _WATCH_S and not self.may_begin():
            self.node.get_logger().info(
                f"waiting for subscribers: {', '.join(self.missing_subscribers())}",
                throttle_duration_sec=_LOG_PERIOD_S,
                skip_first=True,
            )

    def _refuse_lockstep(self) -> None:
        """Raise SstError where the simulator takes no command without a stamp."""
        if self._client is None:  # the commands have a stamp
            return
        if self._sync_reply is None:
            if self._client.service_is_ready():
                request = GetParameters.Request(names=["sync"])
                self._sync_reply = self._client.call_async(request)
        elif self._sync_reply.done():
            values = self._sync_reply.result().values
            if values and values[0].string_value == "lockstep":
                raise SstError(
                    "stamped = false: the simulator runs in lockstep and takes no"
                    " command without a stamp: give stamped:=true"
                )

    def _end_at_fault(self) -> None:
        """Raise SstError where the simulator, which was commanded, is in a fault."""
        if self.commanded and self.phase.startswith("fault"):
            raise SstError(f"the simulator stopped: {self.phase}")

    def _ignore(self, state: JointState) -> None:
        """Count a message of another robot; say so the first time."""
        if self.foreign_states == 0:
            self.node.get_logger().warning(
                f"joint_states without {', '.join(ACTUATED_JOINTS)} are ignored:"
                " another robot publishes there, too"
                f" (its names are {list(state.name)})"
            )
        self.foreign_states += 1

    def _publish_torque(self, torque: Vector3) -> None:
        self._torques[:] = array("d", torque)
        self._commands.publish(self._message)
