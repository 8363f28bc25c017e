# SPDX-License-Identifier: Apache-2.0
"""Own controller as a ROS 2 node, free running and in lockstep
============================================================

A PD controller that holds three angles. The tutorial *Your own controller in 30 lines*
runs it.
"""

import rclpy
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from sensor_msgs.msg import JointState

GOAL = (0.9, 0.7, 0.8)  # rad
STIFFNESS, DAMPING = 40.0, 6.0  # N m/rad, N m s/rad


class Controller(Node):
    """Answers every state with torques, by name and with the state's own stamp."""

    def __init__(self) -> None:
        super().__init__("controller")
        self.commands = self.create_publisher(
            JointState, "sst_simulator/commands_stamped", 10
        )
        self.create_subscription(JointState, "joint_states", self.answer, 10)

    def answer(self, state: JointState) -> None:
        """Pull each actuator to its goal like a spring and a damper."""
        measured = zip(GOAL, state.position[:3], state.velocity[:3], strict=True)
        torque = [
            STIFFNESS * (goal - gamma) - DAMPING * rate
            for goal, gamma, rate in measured
        ]
        command = JointState(name=["gamma_1", "gamma_2", "gamma_3"], effort=torque)
        command.header.stamp = state.header.stamp
        self.commands.publish(command)


rclpy.init()
node = Controller()
try:
    rclpy.spin(node)
except (KeyboardInterrupt, ExternalShutdownException):
    pass
finally:
    node.destroy_node()
    rclpy.try_shutdown()
