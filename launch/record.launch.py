# SPDX-License-Identifier: Apache-2.0
"""Record the topics of config/topics.txt with `ros2 bag record`, in MCAP."""

from pathlib import Path

from ament_index_python.packages import get_package_share_directory
from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, ExecuteProcess
from launch.substitutions import LaunchConfiguration


def generate_launch_description() -> LaunchDescription:
    """Describe the recording."""
    share = Path(get_package_share_directory("sst_ros"))
    topics = (share / "config" / "topics.txt").read_text().split()
    output = LaunchConfiguration("output")
    return LaunchDescription(
        [
            DeclareLaunchArgument("output", description="folder of the bag; must not exist yet"),
            ExecuteProcess(
                cmd=["ros2", "bag", "record", "--storage", "mcap", "--output", output, *topics],
                output="screen",
            ),
        ]
    )
