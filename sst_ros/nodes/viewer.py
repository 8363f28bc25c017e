# SPDX-License-Identifier: Apache-2.0
"""The viewer node: a simulator's topics and services as a source of the page."""

from __future__ import annotations

import contextlib
import dataclasses
import sys
import threading
from array import array
from collections.abc import Sequence
from functools import partial
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile
from std_msgs.msg import Float64MultiArray, String
from std_srvs.srv import SetBool, Trigger

from sst_ros.errors import InputError
from sst_ros.nodes import parameters, process, topics
from sst_ros.nodes.clocks import STEADY
from sst_ros.nodes.messages import nanoseconds
from sst_ros.nodes.raw_readers import reader
from sst_ros.runtime.settings import ViewerParameters
from sst_ros.runtime.torque_input import ZERO
from sst_ros.scene import yaml_document
from sst_ros.scene.loads import JOINTS
from sst_ros.scene.scene import Scene
from sst_ros.simulation import NANOSECONDS, Triple
from sst_ros.view.page import Page
from sst_ros.view.source import Health, Sample

_ANSWER_S = 5.0
_REPEAT_S = 0.05
_LOOK_S = 0.5
_QUEUE = 64


class Viewer:
    """Worker of the process `viewer`; it is a `Source` of the page and its own `Controls`."""

    def __init__(self) -> None:
        self.node = Node("sst_viewer")
        self.done = threading.Event()
        self._parameters = given = parameters.declare(self.node, ViewerParameters)
        self.scene: Scene | None = None
        self._phase, self._status = "", Health()
        self._start_ns, self._driver = 0, ""
        self._now: float | None = None
        self._torque: Triple = ZERO
        self._driving = False
        self._commands: Any = None
        simulator = given.simulator
        self._names = {
            one: one.name.replace("~", simulator)
            for one in (topics.PAUSE, topics.STEP, topics.RESET, topics.COMMANDS)
        }
        self._clients = {
            one: self.node.create_client(one.kind, self._names[one])
            for one in (topics.PAUSE, topics.STEP, topics.RESET)
        }
        latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        for one, hear in ((topics.SCENE, self._hear_scene), (topics.PHASE, self._hear_phase)):
            name = one.name.replace("~", simulator)
            self.node.create_subscription(one.kind, name, hear, latched)
        self.node.create_subscription(DiagnosticArray, "/diagnostics", self._hear_health, 10)
        self._take = reader(self.node, dataclasses.replace(topics.JOINT_STATES, depth=_QUEUE))
        self.node.create_timer(_REPEAT_S, self._repeat, clock=STEADY)
        self.node.create_timer(_LOOK_S, self._look, clock=STEADY)
        self._page = Page(self, given.host, given.port)
        self._page.announce(opened=given.open)

    def close(self) -> None:
        """Leave the actuators without torque; end the page."""
        self._page.close()
        if self._commands is not None:
            self._commands.publish(Float64MultiArray(data=array("d", ZERO)))

    def controls(self) -> Viewer:
        """Give itself: it can be held and driven."""
        return self

    def samples(self) -> Sequence[Sample]:
        """Give the joint states that came since the last call, at most a queue full."""
        found = []
        while len(found) < _QUEUE and (message := self._take()) is not None:
            if tuple(message.name) == JOINTS:
                found.append(self._sample(message))
        return found

    def health(self) -> Health:
        """Give the phase and the last diagnostics."""
        status = self._status
        return Health(self._phase, status.level, status.said, status.values)

    def pause(self, paused: bool) -> tuple[bool, str]:
        """Hold the run, or let it go on."""
        return self._ask(topics.PAUSE, SetBool.Request(data=paused))

    def step(self) -> tuple[bool, str]:
        """Advance a held run by one sample."""
        return self._ask(topics.STEP, Trigger.Request())

    def reset(self) -> tuple[bool, str]:
        """Go back to the initial state."""
        reply = self._ask(topics.RESET, Trigger.Request())
        if reply[0]:
            self._begin()
        return reply

    def drive(self, torque: Triple) -> None:
        """Hold torques from now on; the timer sends them."""
        self._torque, self._driving = torque, True

    def driven_by(self) -> str:
        """Name the other node that publishes commands."""
        return self._driver

    def _sample(self, message: Any) -> Sample:
        stamp_ns = nanoseconds(message.header.stamp)
        if stamp_ns and not self._start_ns:
            self._start_ns = stamp_ns
        if stamp_ns:  # a state that is held keeps its time
            self._now = (stamp_ns - self._start_ns) / NANOSECONDS
        q, v = message.position, message.velocity
        return Sample(self._now, q[:3], q[3:6], q[6:9], v[:3], message.effort[:3])

    def _hear_scene(self, message: String) -> None:
        with contextlib.suppress(InputError):  # another version's scene
            self.scene = yaml_document.read(Scene, message.data, self._parameters.simulator)

    def _hear_phase(self, message: String) -> None:
        if message.data == "waiting":
            self._begin()
        self._phase = message.data

    def _begin(self) -> None:
        """Count time from the next sample."""
        self._start_ns, self._now = 0, None

    def _hear_health(self, message: DiagnosticArray) -> None:
        wanted = self.node.resolve_topic_name(self._parameters.simulator)
        for status in message.status:
            if status.name == f"{wanted}: run":
                values = {pair.key: pair.value for pair in status.values}
                level = min(int.from_bytes(status.level, "little"), 2)
                self._status = Health("", level, status.message, values)

    def _look(self) -> None:
        """See whether another node publishes commands; then leave the run to it."""
        own = self.node.get_fully_qualified_name()
        found = ""
        for one in (topics.COMMANDS, topics.COMMANDS_STAMPED):
            topic = self.node.resolve_topic_name(one.name.replace("~", self._parameters.simulator))
            for info in self.node.get_publishers_info_by_topic(topic):
                name = f"{info.node_namespace.rstrip('/')}/{info.node_name}"
                found = found or (name if name != own else "")
        self._driver = found
        if found:
            self._driving = False
            if self._commands is not None:
                self.node.destroy_publisher(self._commands)
                self._commands = None

    def _repeat(self) -> None:
        """Send the torque, again and again before the simulator takes it for too old."""
        if self._driving and self._commands is None:
            self._look()
        if not self._driving:
            return
        if self._commands is None:
            topic = self._names[topics.COMMANDS]
            self._commands = self.node.create_publisher(Float64MultiArray, topic, 10)
        self._commands.publish(Float64MultiArray(data=array("d", self._torque)))

    def _ask(self, one: topics.Endpoint, request: Any) -> tuple[bool, str]:
        """Call a service from a thread of the page; the node's own takes the reply."""
        client, answered = self._clients[one], threading.Event()
        if not client.service_is_ready():
            return False, f"no service {self._names[one]}: is the simulator running?"
        future = client.call_async(request)
        future.add_done_callback(partial(_set, answered))
        if not answered.wait(_ANSWER_S):
            return False, f"no reply within {_ANSWER_S:g} s"
        reply = future.result()
        return bool(reply.success), str(reply.message)


def _set(event: threading.Event, _: Any) -> None:
    event.set()


def main(args: list[str] | None = None) -> int:
    """Entry point of `viewer`."""
    return process.run("viewer", Viewer, args)


if __name__ == "__main__":
    sys.exit(main())
