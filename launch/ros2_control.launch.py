# SPDX-License-Identifier: Apache-2.0
"""Start a simulator as the hardware of ros2_control.

Controller manager, joint state broadcaster and a controller start with it.
The run starts at the first command. With sync:=lockstep each sample waits for an update
of the controllers, at publish_rate. The launch ends with the simulator.
"""

from launch import LaunchDescription
from launch.action import Action

from sst_ros import launch_parts
from sst_ros.launch_parts import Given

RUN = {
    "scene": ("example2", "scene, by name or by path of a .yaml file"),
    "rate": ("", "steps per second of simulated time [Hz]"),
    "publish_rate": ("", "published samples per second [Hz]"),
    "duration": ("0.0", "length of the run [s]; 0 for no end"),
    "real_time_factor": (
        "",
        "simulated time per time of the clock; 0.0 for as fast as possible",
    ),
    "sync": ("", "free, or lockstep: one update of the controllers for each sample"),
    "publish_clock": ("", "true: publish the simulated time on /clock"),
}
ARGUMENTS = {
    **RUN,
    "controller": (
        "trajectory_controller",
        (
            "controller that is started: effort_controller, trajectory_controller or"
            " pid_controller"
        ),
    ),
    "controllers": (
        "",
        "parameters of the controllers; by default config/controllers.yaml",
    ),
}


def actions(given: Given) -> list[Action]:
    """Describe the nodes."""
    run = {
        **{name: given[name] for name in RUN},
        **({"publish_clock": "true"} if given["sync"] == "lockstep" else {}),
        "wait_for_command": "true",
        "partial_commands": "true",
        # robot_state_publisher publishes that with the tag
        "publish_description": "false",
    }
    return [
        launch_parts.simulator(given, run, recorded=False),
        *launch_parts.ros2_control(given, given["controller"], given["controllers"]),
    ]


def generate_launch_description() -> LaunchDescription:
    """Describe the arguments and the nodes."""
    return launch_parts.description(__file__, ARGUMENTS, actions)
