# SPDX-License-Identifier: Apache-2.0
"""Start the simulator, the controller that follows the scene's motion, and a recorder.

The controller's model may be another scene than the simulator's. The launch ends with
the motion.
"""

from launch import LaunchDescription
from launch.action import Action

from sst_ros import launch_parts
from sst_ros.launch_parts import Given

CONTROL = {
    "motion": ("", "scene, or topic: trajectories from ~/joint_trajectory"),
    "mode": ("", "feedforward, feedforward_pd, computed_torque, pd or gravity_pd"),
    "feedforward_at": ("middle", "start or middle of a control period, held over it"),
    "bandwidth": ("", "natural frequency of the error [rad/s]"),
    "hold": ("0.3", "time for which the end of the motion is held [s]"),
}
RUN = {
    "scene": ("reach", "scene that is simulated, by name or by path of a .yaml file"),
    "rate": ("", "steps per second of simulated time [Hz]"),
    "duration": ("0.0", "length of the run [s]; 0 until the motion has ended"),
    "real_time_factor": (
        "",
        "simulated time per time of the clock; 0 for as fast as possible",
    ),
    "sync": ("lockstep", "free, or lockstep with the commands"),
}
ARGUMENTS = {
    **RUN,
    "model": ("", "scene of the controller's model; by default the simulated one"),
    "control_rate": (
        "500",
        "commands per second of simulated time [Hz], a divisor of rate",
    ),
    **CONTROL,
    "record": ("true", "record the run, which starts when it is recorded"),
    **launch_parts.recording_arguments("feedforward_bag"),
}


def actions(given: Given) -> list[Action]:
    """Describe the nodes."""
    recorded = given["record"] == "true"
    run = {
        **{name: given[name] for name in RUN},
        "publish_rate": given["control_rate"],
        "wait_for_command": "true",
    }
    control = {
        **{name: given[name] for name in CONTROL},
        "scene": given["model"] or given["scene"],
        "rate": given["control_rate"],
        "stamped": "true" if given["sync"] == "lockstep" else "",
        # also until the simulator is up
        "timeout": launch_parts.Default(launch_parts.WAIT_S),
        "wait_for_recorder": given["record"],
        # the recorder reads the commands, too
        "min_subscribers": "2" if recorded else "",
    }
    return [
        *([launch_parts.recorder(given)] if recorded else []),
        launch_parts.simulator(given, run, recorded=recorded),
        launch_parts.node(given, "inverse_dynamics", control),
    ]


def generate_launch_description() -> LaunchDescription:
    """Describe the arguments and the nodes."""
    return launch_parts.description(__file__, ARGUMENTS, actions)
