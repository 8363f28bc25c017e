# SPDX-License-Identifier: Apache-2.0
"""Start a simulator and what shows it: the page in a browser, or RViz."""

from launch import LaunchDescription
from launch.action import Action

from sst_ros import launch_parts
from sst_ros.launch_parts import Given

ARGUMENTS = {
    "scene": ("swing", "scene, by name or by path of a .yaml file"),
    "publish_rate": ("100", "published samples per second [Hz]"),
    "duration": ("0.0", "length of the run [s]; 0 for no end"),
    "browser": ("true", "serve the page"),
    "port": ("", "port of the page on this machine; the next free one is taken"),
    "rviz": ("false", "start robot_state_publisher and RViz"),
}


def actions(given: Given) -> list[Action]:
    """Describe the nodes."""
    shown = launch_parts.rviz(given, given["scene"]) if given["rviz"] == "true" else []
    run = {name: given[name] for name in ("scene", "publish_rate", "duration")}
    run["publish_description"] = "false" if given["rviz"] == "true" else ""
    nodes = [launch_parts.simulator(given, run, recorded=False)]
    if given["browser"] == "true":
        nodes.append(launch_parts.node(given, "viewer", {"port": given["port"]}))
    return [*nodes, *shown]


def generate_launch_description() -> LaunchDescription:
    """Describe the arguments and the nodes."""
    return launch_parts.description(__file__, ARGUMENTS, actions)
