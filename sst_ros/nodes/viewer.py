# SPDX-License-Identifier: Apache-2.0
"""The viewer node: a simulator's topics and services as a source of the page."""

from __future__ import annotations

import contextlib
import threading
from array import array
from collections import deque
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from rclpy.client import Client
from rclpy.publisher import Publisher
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray, String
from std_srvs.srv import SetBool, Trigger

from sst_ros.errors import InputError
from sst_ros.nodes import topics
from sst_ros.nodes.process import Worker, every
from sst_ros.runtime.settings import ViewerParameters
from sst_ros.scene import yaml_document
from sst_ros.scene.loads import JOINTS
from sst_ros.scene.scene import Scene
from sst_ros.state import NANOSECONDS, ZERO, Vector3, is_idle, nanoseconds
from sst_ros.view.page import Page
from sst_ros.view.source import RunStatus, ViewState

_REPLY_S = 5.0
"""Longest wait of a button for the reply of a service."""
_REPEAT_S = 0.05
"""Period of manual commands; the simulator drops those older than half a second."""
_LOOK_S = 0.5
"""Period of looks for another node that commands the run."""
_QUEUE = topics.VIEWER["joint_states"].depth
_GAMMA = slice(0, 3)
_MU = slice(3, 6)
_BETA = slice(6, 9)
"""Numbers of the nine joints that are those of a kind."""


class Viewer(Worker[ViewerParameters]):
    """Worker of the process `viewer`; a `RunControl` of the page."""

    def __init__(self) -> None:
        super().__init__("sst_viewer", ViewerParameters)
        parameters = self.parameters
        self.scene: Scene | None = None
        self._phase = ""
        self._status = RunStatus()
        self._start_ns = 0  # stamp of the first sample; 0 before
        self._sample_ns = 0  # stamp of the last sample
        self._states: deque[ViewState] = deque(maxlen=_QUEUE)
        self._torque: Vector3 = ZERO  # of the sliders [N m]
        self._driving = False  # the sliders command the run
        self._controller = ""  # another node that does
        self._commands: Publisher[Float64MultiArray] | None = None
        self._clients: dict[str, Client[Any, Any]] = {
            name: self.node.create_client(
                endpoint.kind,
                endpoint.name.format(simulator=parameters.simulator),
                qos_profile=topics.SERVICE_QOS,
            )
            for name, endpoint in topics.VIEWER.items()
            if endpoint.use == topics.CALLED_SERVICES
        }
        topics.subscribe(
            self.node,
            topics.VIEWER,
            parameters.simulator,
            joint_states=self._take_state,
            scene=self._take_scene,
            phase=self._take_phase,
            diagnostics=self._take_diagnostics,
        )
        every(self.node, _REPEAT_S, self._repeat)
        every(self.node, _LOOK_S, self._look)
        self._page = Page(self, parameters.host, parameters.port)
        self._page.announce(opened=parameters.open)

    def close(self) -> None:
        """Leave the actuators without torque; end the page."""
        self._page.close()
        if self._commands is not None:
            self._commands.publish(Float64MultiArray(data=array("d", ZERO)))

    def states(self) -> Sequence[ViewState]:
        """Return the joint states since the last call, the last _QUEUE of them."""
        return [self._states.popleft() for _ in range(len(self._states))]

    def status(self) -> RunStatus:
        """Return the phase and the latest diagnostics."""
        return replace(self._status, phase=self._phase)

    def ask(self, request: str) -> tuple[bool, str]:
        """Ask for pause, resume, step or reset; the node's thread takes the reply."""
        paused = {"pause": True, "resume": False}.get(request)
        client = self._clients[request if paused is None else "pause"]
        if not client.service_is_ready():
            return False, f"no service {client.srv_name}: is the simulator running?"
        message: Any = (
            Trigger.Request() if paused is None else SetBool.Request(data=paused)
        )
        future = client.call_async(message)
        answered = threading.Event()
        future.add_done_callback(lambda _: answered.set())
        if not answered.wait(_REPLY_S):
            return False, f"no reply within {_REPLY_S:g} s"
        reply: Any = future.result()
        if request == "reset" and reply.success:
            self._start_ns = 0  # time counts from the next sample
        return bool(reply.success), str(reply.message)

    def apply(self, torque: Vector3) -> None:
        """Hold torques from now on; the timer publishes them."""
        self._torque = torque
        self._driving = True

    def controller(self) -> str:
        """Name of another node that publishes commands; empty if there is none."""
        return self._controller

    def _take_state(self, message: JointState) -> None:
        """Queue a state; one that is idle keeps the time of the last sample."""
        if tuple(message.name) != JOINTS:
            return
        stamp_ns = nanoseconds(message.header.stamp)
        if not is_idle(stamp_ns, message.header.frame_id):
            self._start_ns = self._start_ns or stamp_ns
            self._sample_ns = stamp_ns
        time: float | None = None
        if self._start_ns:
            time = (self._sample_ns - self._start_ns) / NANOSECONDS
        angles = message.position
        self._states.append(
            ViewState(
                time,
                gamma=angles[_GAMMA],
                mu=angles[_MU],
                beta=angles[_BETA],
                gamma_dot=message.velocity[_GAMMA],
                torque=message.effort[_GAMMA],
            )
        )

    def _take_scene(self, message: String) -> None:
        with contextlib.suppress(InputError):  # a scene of another version
            self.scene = yaml_document.read(
                Scene, message.data, self.parameters.simulator
            )

    def _take_phase(self, message: String) -> None:
        # the first that is heard is no news
        if message.data == "waiting" and self._phase:
            self._start_ns = 0
        self._phase = message.data

    def _take_diagnostics(self, message: DiagnosticArray) -> None:
        name = f"{self.node.resolve_topic_name(self.parameters.simulator)}: run"
        for status in message.status:
            if status.name == name:
                values = {pair.key: pair.value for pair in status.values}
                level = min(int.from_bytes(status.level, "little"), 2)
                self._status = RunStatus("", level, status.message, values)

    def _look(self) -> None:
        """Look for another node that publishes commands, and leave the run to it."""
        own = self.node.get_fully_qualified_name()
        names: list[str] = []
        for topic in ("commands", "commands_stamped"):
            names += topics.publishers(
                self.node, f"{self.parameters.simulator}/{topic}"
            )
        self._controller = next((name for name in names if name != own), "")
        if self._controller:
            self._driving = False
            if self._commands is not None:
                self.node.destroy_publisher(self._commands)
                self._commands = None

    def _repeat(self) -> None:
        """Publish the torque before the simulator drops the last one as too old."""
        if self._driving and self._commands is None:
            self._look()
        if not self._driving:
            return
        if self._commands is None:
            self._commands = topics.VIEWER["commands"].publisher(
                self.node, simulator=self.parameters.simulator
            )
        self._commands.publish(Float64MultiArray(data=array("d", self._torque)))
