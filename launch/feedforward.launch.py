# SPDX-License-Identifier: Apache-2.0
"""Start the simulator, the controller that follows the scene's motion, and a recorder.

The controller's model may be another scene than the simulator's. The launch ends with
the motion.
"""

from launch import LaunchDescription
from launch.action import Action

from sst_ros import launch_parts
from sst_ros.control.law import MODES
from sst_ros.launch_parts import LaunchArgument, Values, flag

CONTROL = {
    "motion": LaunchArgument(
        "",
        "scene, or topic: trajectories from ~/joint_trajectory",
        ("", "scene", "topic"),
    ),
    "mode": LaunchArgument("", "control law", ("", *MODES)),
    "feedforward_at": LaunchArgument(
        "middle",
        "instant of a control period whose torque is held over it",
        ("start", "middle"),
    ),
    "bandwidth": LaunchArgument("", "natural frequency of the error [rad/s]"),
    "hold": LaunchArgument("0.3", "time for which the end of the motion is held [s]"),
}
RUN = {
    "scene": LaunchArgument(
        "reach", "simulated scene, by name or path of a .yaml file"
    ),
    "rate": LaunchArgument("", "steps per second of simulated time [Hz]"),
    "duration": LaunchArgument(
        "0.0", "length of the run [s]; 0 until the motion has ended"
    ),
    "real_time_factor": LaunchArgument(
        "", "simulated time per time of the clock; 0 for as fast as possible"
    ),
    "sync": LaunchArgument(
        "lockstep", "free, or lockstep with the commands", ("free", "lockstep")
    ),
}
ARGUMENTS = {
    **RUN,
    "model": LaunchArgument(
        "", "scene of the controller's model; default: the simulated one"
    ),
    "control_rate": LaunchArgument(
        "500", "commands per second of simulated time [Hz], a divisor of rate"
    ),
    **CONTROL,
    "record": flag("true", "record the run, which starts when it is recorded"),
    **launch_parts.recording_arguments("feedforward_bag"),
}


def actions(values: Values) -> list[Action]:
    """Describe the nodes."""
    recorded = values.is_true("record")
    run = {name: values[name] for name in RUN}
    run["publish_rate"] = values["control_rate"]
    run["wait_for_command"] = "true"
    control = {name: values[name] for name in CONTROL}
    control["scene"] = values["model"] or values["scene"]
    control["rate"] = values["control_rate"]
    control["stamped"] = "true" if values["sync"] == "lockstep" else ""
    # The controller also waits until the simulator has started.
    control["timeout"] = launch_parts.Default(launch_parts.WAIT_S)
    control["wait_for_recorder"] = values["record"]
    # The recorder reads the commands, too.
    control["min_subscribers"] = "2" if recorded else ""
    nodes = [launch_parts.recorder(values)] if recorded else []
    nodes.append(launch_parts.simulator(values, run, recorded=recorded))
    nodes.append(launch_parts.node(values, "inverse_dynamics", control))
    return nodes


def generate_launch_description() -> LaunchDescription:
    """Describe the arguments and the nodes."""
    return launch_parts.description(__file__, ARGUMENTS, actions)
