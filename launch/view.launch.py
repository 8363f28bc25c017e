# SPDX-License-Identifier: Apache-2.0
"""Start a simulator and what shows it: the page in a browser, or RViz."""

from launch import LaunchDescription
from launch.action import Action

from sst_ros import launch_parts
from sst_ros.launch_parts import LaunchArgument, Values, flag

RUN = {
    "scene": LaunchArgument("swing", "scene, by name or path of a .yaml file"),
    "publish_rate": LaunchArgument("100", "published samples per second [Hz]"),
    "duration": LaunchArgument("0.0", "length of the run [s]; 0 for no end"),
}
ARGUMENTS = {
    **RUN,
    "browser": flag("true", "serve the page"),
    "port": LaunchArgument(
        "", "port of the page on this machine; the next free one is taken"
    ),
    "rviz": flag("false", "start robot_state_publisher and RViz"),
}


def actions(values: Values) -> list[Action]:
    """Describe the nodes."""
    run = {name: values[name] for name in RUN}
    views = []
    if values.is_true("browser"):
        views.append(launch_parts.node(values, "viewer", {"port": values["port"]}))
    if values.is_true("rviz"):
        run["publish_description"] = "false"  # robot_state_publisher does
        views += launch_parts.rviz(values, values["scene"])
    return [launch_parts.simulator(values, run, recorded=False), *views]


def generate_launch_description() -> LaunchDescription:
    """Describe the arguments and the nodes."""
    return launch_parts.description(__file__, ARGUMENTS, actions)
