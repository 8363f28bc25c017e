# SPDX-License-Identifier: Apache-2.0
"""Launch files, started and ended by launch_testing where a ROS installation has it."""

import os
import tempfile
import unittest
from pathlib import Path

import pytest

launch_testing = pytest.importorskip(
    "launch_testing", reason="needs launch_testing of a ROS installation"
)
pytest.importorskip("launch_ros", reason="needs launch_ros of a ROS installation")

from ament_index_python.packages import get_package_share_directory  # noqa: E402
from launch import LaunchDescription  # noqa: E402
from launch.actions import IncludeLaunchDescription  # noqa: E402
from launch.launch_description_sources import PythonLaunchDescriptionSource  # noqa: E402

LAUNCHES = {
    "simulate.launch.py": {"scene": "swing", "duration": "0.0"},
    "view.launch.py": {"browser": "false"},
    "feedforward.launch.py": {"record": "false", "hold": "100.0"},
}


@pytest.mark.launch_test
@launch_testing.parametrize("name", LAUNCHES)
def generate_test_description(name):
    os.environ.setdefault("ROS_DOMAIN_ID", str(1 + os.getpid() % 100))
    os.chdir(tempfile.mkdtemp())
    path = Path(get_package_share_directory("sst_ros")) / "launch" / name
    included = IncludeLaunchDescription(
        PythonLaunchDescriptionSource(str(path)), launch_arguments=LAUNCHES[name].items()
    )
    return LaunchDescription([included, launch_testing.actions.ReadyToTest()])


class Started(unittest.TestCase):
    def test_a_node_works(self, proc_output, name):
        proc_output.assertWaitFor("running", timeout=60, stream="stderr")


@launch_testing.post_shutdown_test()
class Ended(unittest.TestCase):
    def test_exit_codes(self, proc_info, name):
        launch_testing.asserts.assertExitCodes(proc_info)
