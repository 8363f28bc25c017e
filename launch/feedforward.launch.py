# SPDX-License-Identifier: Apache-2.0
"""Start the simulator, the companion that follows the scene's motion, and `ros2 bag record`.

The companion's model may be another scene than the simulator's. With record:=false, as where
another recorder runs, nothing is recorded.
"""

from pathlib import Path

from ament_index_python.packages import get_package_share_directory
from launch import LaunchDescription
from launch.actions import (
    DeclareLaunchArgument,
    EmitEvent,
    IncludeLaunchDescription,
    RegisterEventHandler,
)
from launch.conditions import IfCondition
from launch.event_handlers import OnProcessExit
from launch.events import Shutdown
from launch.launch_description_sources import PythonLaunchDescriptionSource
from launch.substitutions import LaunchConfiguration, PythonExpression
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue

ARGUMENTS = {
    "scene": ("reach", "scene that is simulated, by name or by path of a .yaml file"),
    "model": (LaunchConfiguration("scene"), "scene that the companion takes it for"),
    "motion": ("scene", "scene, or topic: trajectories from ~/joint_trajectory"),
    "mode": ("feedforward", "feedforward, feedforward_pd, computed_torque, pd or gravity_pd"),
    "feedforward_at": ("middle", "start or middle of a control period, held over it"),
    "bandwidth": ("30.0", "natural frequency of the error [rad/s]"),
    "hold": ("0.3", "time for which the end of the motion is held [s]"),
    "rate": ("1000", "steps per second of simulated time [Hz]"),
    "control_rate": ("500", "commands per second of simulated time [Hz], a divisor of rate"),
    "duration": ("0.0", "length of the run [s]; 0 for no end"),
    "real_time_factor": ("1.0", "simulated time per time of the clock; 0 for as fast as possible"),
    "sync": ("lockstep", "free, or lockstep with the commands"),
    "record": ("true", "record a bag"),
    "output": ("feedforward_bag", "folder of the bag; must not exist yet"),
}


def generate_launch_description() -> LaunchDescription:
    """Describe the nodes and their arguments."""
    value = {name: LaunchConfiguration(name) for name in ARGUMENTS}
    launch = Path(get_package_share_directory("sst_ros")) / "launch"
    simulator = Node(
        package="sst_ros",
        executable="simulator",
        output="screen",
        parameters=[
            {
                "scene": ParameterValue(value["scene"], value_type=str),
                "rate": ParameterValue(value["rate"], value_type=int),
                "publish_rate": ParameterValue(value["control_rate"], value_type=int),
                "duration": ParameterValue(value["duration"], value_type=float),
                "wait_for_command": True,
                "real_time_factor": ParameterValue(value["real_time_factor"], value_type=float),
                "sync": ParameterValue(value["sync"], value_type=str),
            }
        ],
    )
    companion = Node(
        package="sst_ros",
        executable="inverse_dynamics",
        output="screen",
        parameters=[
            {
                "scene": ParameterValue(value["model"], value_type=str),
                "motion": ParameterValue(value["motion"], value_type=str),
                "mode": ParameterValue(value["mode"], value_type=str),
                "feedforward_at": ParameterValue(value["feedforward_at"], value_type=str),
                "bandwidth": ParameterValue(value["bandwidth"], value_type=float),
                "hold": ParameterValue(value["hold"], value_type=float),
                "rate": ParameterValue(value["control_rate"], value_type=int),
                "stamped": ParameterValue(
                    PythonExpression(["'", value["sync"], "' == 'lockstep'"]), value_type=bool
                ),
                "wait_for_recorder": ParameterValue(value["record"], value_type=bool),
                # The recorder reads the commands, too: begin when it does.
                "wait_for_subscribers": ParameterValue(
                    PythonExpression(["2 if '", value["record"], "' == 'true' else 1"]),
                    value_type=int,
                ),
            }
        ],
    )
    recorder = IncludeLaunchDescription(
        PythonLaunchDescriptionSource(str(launch / "record.launch.py")),
        launch_arguments={"output": value["output"]}.items(),
        condition=IfCondition(value["record"]),
    )
    end = RegisterEventHandler(
        OnProcessExit(target_action=companion, on_exit=[EmitEvent(event=Shutdown())])
    )
    declared = [
        DeclareLaunchArgument(name, default_value=default, description=said)
        for name, (default, said) in ARGUMENTS.items()
    ]
    return LaunchDescription([*declared, recorder, simulator, companion, end])
