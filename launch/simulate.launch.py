# SPDX-License-Identifier: Apache-2.0
"""Start the simulator, and with `play:=true` the torque player of the same scene."""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.conditions import IfCondition
from launch.substitutions import LaunchConfiguration, PythonExpression
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue

ARGUMENTS = {
    "scene": ("example2", "scene, by name or by path of a .yaml file"),
    "namespace": ("", "namespace of the nodes"),
    "rate": ("1000", "steps per second of simulated time [Hz]"),
    "publish_rate": ("500", "published samples per second [Hz]"),
    "duration": ("0.0", "length of the run [s]; 0 for no end"),
    "real_time_factor": ("1.0", "simulated time per time of the clock; 0 for as fast as possible"),
    "publish_clock": ("false", "publish the simulated time on /clock"),
    "sync": ("free", "free, or lockstep with the commands"),
    "play": ("false", "also play the scene's torques, from the beginning of the run"),
}


def generate_launch_description() -> LaunchDescription:
    """Describe the nodes and their arguments."""
    value = {name: LaunchConfiguration(name) for name in ARGUMENTS}
    simulator = Node(
        package="sst_ros",
        executable="simulator",
        namespace=value["namespace"],
        output="screen",
        parameters=[
            {
                "scene": ParameterValue(value["scene"], value_type=str),
                "rate": ParameterValue(value["rate"], value_type=int),
                "publish_rate": ParameterValue(value["publish_rate"], value_type=int),
                "duration": ParameterValue(value["duration"], value_type=float),
                "wait_for_command": ParameterValue(value["play"], value_type=bool),
                "real_time_factor": ParameterValue(value["real_time_factor"], value_type=float),
                "publish_clock": ParameterValue(value["publish_clock"], value_type=bool),
                "sync": ParameterValue(value["sync"], value_type=str),
            }
        ],
    )
    player = Node(
        package="sst_ros",
        executable="torque_player",
        namespace=value["namespace"],
        output="screen",
        parameters=[
            {
                "scene": ParameterValue(value["scene"], value_type=str),
                "stamped": ParameterValue(
                    PythonExpression(["'", value["sync"], "' == 'lockstep'"]), value_type=bool
                ),
            }
        ],
        condition=IfCondition(value["play"]),
    )
    declared = [
        DeclareLaunchArgument(name, default_value=default, description=said)
        for name, (default, said) in ARGUMENTS.items()
    ]
    return LaunchDescription([*declared, simulator, player])
