# SPDX-License-Identifier: Apache-2.0
"""Record the topics of config/topics.txt until Ctrl-C."""

from launch import LaunchDescription

from sst_ros import launch_parts


def generate_launch_description() -> LaunchDescription:
    """Describe the recorder."""
    arguments = launch_parts.recording_arguments("sst_bag")
    return launch_parts.description(
        __file__, arguments, lambda given: [launch_parts.recorder(given)]
    )
