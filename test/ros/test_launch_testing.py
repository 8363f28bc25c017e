# SPDX-License-Identifier: Apache-2.0
"""Every launch file, started and ended by launch_testing where a ROS installation has it."""

import os
import tempfile
import time
import unittest
from pathlib import Path

import pytest

launch_testing = pytest.importorskip(
    "launch_testing", reason="needs launch_testing of a ROS installation"
)
pytest.importorskip("launch_ros", reason="needs launch_ros of a ROS installation")

from ament_index_python.packages import (  # noqa: E402
    PackageNotFoundError,
    get_package_prefix,
    get_package_share_directory,
)
from launch import LaunchDescription  # noqa: E402
from launch.actions import IncludeLaunchDescription  # noqa: E402
from launch.launch_description_sources import PythonLaunchDescriptionSource  # noqa: E402

from sst_ros.host import child_process  # noqa: E402

LAUNCHES = {
    "simulate.launch.py": ({"scene": "swing", "duration": "0.0"}, "running", "stderr"),
    "view.launch.py": ({"browser": "false"}, "running", "stderr"),
    "feedforward.launch.py": ({"record": "false", "hold": "100.0"}, "running", "stderr"),
    "record.launch.py": ({"bag": "sst", "output": "bag"}, "ready", "stdout"),
    "ros2_control.launch.py": ({}, "running", "stderr"),
}
"""Arguments, and what is printed when the nodes work: the run of ros2_control by its commands."""

FOLDER = Path(get_package_share_directory("sst_ros")) / "launch"
PREFIXES, BEGAN_IN = os.environ["AMENT_PREFIX_PATH"], Path.cwd()
CONTROLLER_MANAGER = """#!/usr/bin/env python3
import rclpy
from sensor_msgs.msg import JointState
rclpy.init()
node = rclpy.create_node("controller_manager")
commands = node.create_publisher(JointState, "/sst_simulator/commands_stamped", 10)
def write(states):
    command = JointState(name=states.name[:3], effort=[0.0] * 3)
    command.header.stamp = node.get_clock().now().to_msg()
    commands.publish(command)
node.create_subscription(JointState, "/joint_states", write, 10)
try:
    rclpy.spin(node)
except (KeyboardInterrupt, rclpy.executors.ExternalShutdownException):
    pass
"""
"""Stands in for the real one, with the messages of its plug-in for an effort controller."""


def stand_in_for_ros2_control(prefix):
    """Make the packages that ros2_control.launch.py needs, unless they are installed."""
    try:
        get_package_prefix("controller_manager")
        return
    except PackageNotFoundError:
        pass
    index = prefix / "share" / "ament_index" / "resource_index" / "packages"
    index.mkdir(parents=True)
    packages = ("controller_manager", "joint_state_broadcaster")
    for package in (*packages, "joint_state_topic_hardware_interface"):
        (index / package).touch()
    programs = prefix / "lib" / "controller_manager"
    programs.mkdir(parents=True)
    for name, text in (("ros2_control_node", CONTROLLER_MANAGER), ("spawner", "#!/bin/true\n")):
        (programs / name).write_text(text)
        (programs / name).chmod(0o755)
    os.environ["AMENT_PREFIX_PATH"] = f"{prefix}:{os.environ['AMENT_PREFIX_PATH']}"


@pytest.mark.launch_test
@launch_testing.parametrize("name", LAUNCHES)
def generate_test_description(name):
    child_process.keep_domain()
    os.chdir(tempfile.mkdtemp())
    if name == "ros2_control.launch.py":
        stand_in_for_ros2_control(Path(tempfile.mkdtemp()))
    names = ["record.launch.py", "simulate.launch.py"] if name == "record.launch.py" else [name]
    included = [
        IncludeLaunchDescription(
            PythonLaunchDescriptionSource(str(FOLDER / one)),
            launch_arguments=LAUNCHES[one][0].items(),
        )
        for one in names
    ]
    return LaunchDescription([*included, launch_testing.actions.ReadyToTest()])


class Started(unittest.TestCase):
    def test_a_node_works(self, proc_output, proc_info, name):
        _, text, stream = LAUNCHES[name]
        proc_output.assertWaitFor(text, timeout=60, stream=stream)
        if name == "ros2_control.launch.py":  # interrupted while it ends the spawner has a failure
            proc_info.assertWaitForShutdown("spawner", timeout=60)
        if name == "record.launch.py":  # the slowest topic has one message a second
            end = time.monotonic() + 60.0
            while sum(path.stat().st_size for path in Path("bag").glob("*.mcap")) < 1_000_000:
                self.assertLess(time.monotonic(), end, "the recording does not grow")
                time.sleep(0.1)

    def test_no_launch_file_is_left_out(self):
        self.assertEqual(set(LAUNCHES), {path.name for path in FOLDER.glob("*.launch.py")})


@launch_testing.post_shutdown_test()
class Ended(unittest.TestCase):
    def test_exit_codes(self, proc_info, name):
        launch_testing.asserts.assertExitCodes(proc_info)

    @classmethod
    def tearDownClass(cls):
        """Later tests of this process have the packages and the folder that it began with."""
        os.environ["AMENT_PREFIX_PATH"] = PREFIXES
        os.chdir(BEGAN_IN)
