# SPDX-License-Identifier: Apache-2.0
"""Record the topics of config/topics.txt until Ctrl-C."""

from launch import LaunchDescription
from launch.action import Action

from sst_ros import launch_parts
from sst_ros.launch_parts import Values

ARGUMENTS = launch_parts.recording_arguments("sst_bag")


def actions(values: Values) -> list[Action]:
    """Describe the recorder."""
    return [launch_parts.recorder(values)]


def generate_launch_description() -> LaunchDescription:
    """Describe the arguments and the recorder."""
    return launch_parts.description(__file__, ARGUMENTS, actions)
