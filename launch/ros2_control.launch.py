# SPDX-License-Identifier: Apache-2.0
"""Start a simulator as the hardware of ros2_control.

Controller manager, joint state broadcaster and a controller start with it. The run
starts at the first command. With sync:=lockstep each sample waits for an update of the
controllers, at publish_rate. The launch ends with the simulator.
"""

from launch import LaunchDescription
from launch.action import Action

from sst_ros import launch_parts
from sst_ros.launch_parts import LaunchArgument, Values, flag

RUN = {
    "scene": LaunchArgument("example2", "scene, by name or path of a .yaml file"),
    "rate": LaunchArgument("", "steps per second of simulated time [Hz]"),
    "publish_rate": LaunchArgument("", "published samples per second [Hz]"),
    "duration": LaunchArgument("0.0", "length of the run [s]; 0 for no end"),
    "real_time_factor": LaunchArgument(
        "", "simulated time per time of the clock; 0.0 for as fast as possible"
    ),
    "sync": LaunchArgument(
        "",
        "free, or lockstep: one update of the controllers for each sample",
        ("", "free", "lockstep"),
    ),
    "publish_clock": flag("", "publish the simulated time on /clock"),
}
ARGUMENTS = {
    **RUN,
    "controller": LaunchArgument(
        "trajectory_controller",
        "controller that is started; config/controllers.yaml has effort_controller,"
        " trajectory_controller and pid_controller",
    ),
    "controllers": LaunchArgument(
        "", "parameters of the controllers; by default config/controllers.yaml"
    ),
}


def actions(values: Values) -> list[Action]:
    """Describe the nodes."""
    run = {name: values[name] for name in RUN}
    if values["sync"] == "lockstep":
        run["publish_clock"] = "true"
    run["wait_for_command"] = "true"
    run["partial_commands"] = "true"
    # robot_state_publisher publishes the description, with the tags of ros2_control.
    run["publish_description"] = "false"
    control = launch_parts.ros2_control(
        values, values["controller"], values["controllers"]
    )
    return [launch_parts.simulator(values, run, recorded=False), *control]


def generate_launch_description() -> LaunchDescription:
    """Describe the arguments and the nodes."""
    return launch_parts.description(__file__, ARGUMENTS, actions)
