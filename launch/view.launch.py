# SPDX-License-Identifier: Apache-2.0
"""Start a simulator and what shows it: the page in a browser, or RViz."""

from pathlib import Path

from ament_index_python.packages import get_package_share_directory
from launch import LaunchContext, LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.conditions import IfCondition
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

from sst_ros.description.urdf import urdf
from sst_ros.scene.scene import load

ARGUMENTS = {
    "scene": ("swing", "scene, by name or by path of a .yaml file"),
    "namespace": ("", "namespace of the nodes"),
    "browser": ("true", "serve the page, at the port"),
    "port": ("8080", "port of the page on this machine; the next free one is taken"),
    "rviz": ("false", "start robot_state_publisher and RViz"),
}


def nodes(context: LaunchContext) -> list[Node]:
    """Describe the nodes; the URDF is that of the scene."""
    value = {name: LaunchConfiguration(name).perform(context) for name in ARGUMENTS}
    rviz = IfCondition(LaunchConfiguration("rviz"))
    layout = Path(get_package_share_directory("sst_ros")) / "config" / "sst_ros.rviz"
    shared = {"namespace": value["namespace"], "output": "screen"}
    return [
        Node(
            package="sst_ros",
            executable="simulator",
            parameters=[{"scene": value["scene"], "publish_rate": 100}],
            **shared,
        ),
        Node(
            package="sst_ros",
            executable="viewer",
            parameters=[{"port": int(value["port"])}],
            condition=IfCondition(LaunchConfiguration("browser")),
            **shared,
        ),
        Node(
            package="robot_state_publisher",
            executable="robot_state_publisher",
            parameters=[{"robot_description": urdf(load(value["scene"]))}],
            condition=rviz,
            **shared,
        ),
        Node(
            package="rviz2",
            executable="rviz2",
            arguments=["-d", str(layout)],
            condition=rviz,
            **shared,
        ),
    ]


def generate_launch_description() -> LaunchDescription:
    """Describe the arguments and the nodes."""
    declared = [
        DeclareLaunchArgument(name, default_value=default, description=said)
        for name, (default, said) in ARGUMENTS.items()
    ]
    return LaunchDescription([*declared, OpaqueFunction(function=nodes)])
