# SPDX-License-Identifier: Apache-2.0
"""Publish torques as a ROS 2 node
===============================

A square wave of torque on the first actuator, ten commands a second. A simulator must
be running::

    python examples/push.py

Without a new command for half a second the simulator applies zero torque.
"""

import itertools

import rclpy
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from std_msgs.msg import Float64MultiArray

rclpy.init()
node = Node("push")
commands = node.create_publisher(Float64MultiArray, "sst_simulator/commands", 10)
torques = itertools.cycle([[0.5, 0.0, 0.0]] * 5 + [[-0.5, 0.0, 0.0]] * 5)  # N m
node.create_timer(0.1, lambda: commands.publish(Float64MultiArray(data=next(torques))))
try:
    rclpy.spin(node)
except (KeyboardInterrupt, ExternalShutdownException):
    pass
finally:
    node.destroy_node()
    rclpy.try_shutdown()
