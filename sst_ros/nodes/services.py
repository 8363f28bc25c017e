# SPDX-License-Identifier: Apache-2.0
"""Services of the run: pause, step, reset; and the topic set_state. The run loop decides."""

from __future__ import annotations

from functools import partial

from rclpy.node import Node
from sensor_msgs.msg import JointState
from std_srvs.srv import SetBool, Trigger

from sst_ros.nodes import topics
from sst_ros.runtime.run_loop import RunLoop
from sst_ros.runtime.torque_input import ZERO, MessageRefused, by_name


class Services:
    """The services and the topic by which a run is controlled."""

    def __init__(self, node: Node, loop: RunLoop) -> None:
        self._node, self._loop = node, loop
        for endpoint, answer in (
            (topics.PAUSE, self._pause),
            (topics.STEP, self._step),
            (topics.RESET, self._reset),
        ):
            qos = topics.SERVICE_QOS
            node.create_service(endpoint.kind, endpoint.name, answer, qos_profile=qos)
        topics.SET_STATE.subscription(node, self._set_state)

    def _pause(self, request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
        reply = self._loop.ask(partial(self._loop.pause, request.data))
        response.success, response.message = reply
        return response

    def _step(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        response.success, response.message = self._loop.ask(self._loop.step)
        return response

    def _reset(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        response.success, response.message = self._loop.ask(self._loop.reset)
        return response

    def _set_state(self, message: JointState) -> None:
        """Take the angles and rates of the actuators; the log has the reply."""
        try:
            gamma = by_name(message.name, message.position, "angles [rad] in position")
            gamma_dot = ZERO
            if len(message.velocity):
                gamma_dot = by_name(message.name, message.velocity, "rates [rad/s] in velocity")
        except MessageRefused as refused:
            self._node.get_logger().warning(f"set_state refused: {refused}")
            return
        reply = self._loop.ask(partial(self._loop.set_state, gamma, gamma_dot))
        text = f"set_state: {reply.message}"
        if reply.success:  # rclpy refuses two severities from one line
            self._node.get_logger().info(text)
        else:
            self._node.get_logger().warning(text)
