# SPDX-License-Identifier: Apache-2.0
"""Start the simulator and, if asked, torque player, recorder and RViz.

The launch ends with the simulator, that is after `duration` if there is one, in
lockstep by default that of the scene; without one it ends with the player of
play:=true, or when it is stopped.
"""

from launch import LaunchDescription
from launch.action import Action

from sst_ros import launch_parts
from sst_ros.launch_parts import Default, LaunchArgument, Values, flag

RUN = {
    "scene": LaunchArgument("example2", "scene, by name or path of a .yaml file"),
    "rate": LaunchArgument("", "steps per second of simulated time [Hz]"),
    "publish_rate": LaunchArgument("", "published samples per second [Hz]"),
    "duration": LaunchArgument(
        "", "length of the run [s]; 0 for no end; in lockstep by default the scene's"
    ),
    "real_time_factor": LaunchArgument(
        "", "simulated time per time of the clock; 0 for as fast as possible"
    ),
    "publish_clock": flag("", "publish the simulated time on /clock"),
    "sync": LaunchArgument(
        "",
        "free, or lockstep with the commands; by default lockstep with play:=true",
        ("", "free", "lockstep"),
    ),
}
ARGUMENTS = {
    **RUN,
    "play": flag("false", "also play the scene's torques, from the start of the run"),
    "record": flag("false", "also record the run, which starts when it is recorded"),
    "rviz": flag("false", "also start robot_state_publisher and RViz"),
    **launch_parts.recording_arguments("sst_bag"),
}


def actions(values: Values) -> list[Action]:
    """Describe the nodes."""
    play = values.is_true("play")
    recorded = values.is_true("record")
    run = {name: values[name] for name in RUN}
    nodes = []
    if values.is_true("rviz"):
        run["publish_description"] = "false"  # robot_state_publisher does
        nodes += launch_parts.rviz(values, values["scene"])
    if play:
        run["wait_for_command"] = "true"
        # By default the same run on a busy machine.
        run["sync"] = run["sync"] or Default("lockstep")
    if recorded:
        nodes.append(launch_parts.recorder(values))
    nodes.append(launch_parts.simulator(values, run, recorded=recorded))
    if play:
        player = {
            "scene": values["scene"],
            "rate": values["publish_rate"],
            # The player also waits until the simulator has started.
            "timeout": Default(launch_parts.WAIT_S),
            "stamped": "" if run["sync"] == "lockstep" else "false",
            # The recorder reads the commands, too.
            "min_subscribers": "2" if recorded else "",
        }
        duration = values["duration"]
        if not duration and run["sync"] == "free":
            duration = "0"
        endless = bool(duration) and float(duration) == 0.0
        nodes.append(launch_parts.node(values, "torque_player", player, ends=endless))
    return nodes


def generate_launch_description() -> LaunchDescription:
    """Describe the arguments and the nodes."""
    return launch_parts.description(__file__, ARGUMENTS, actions)
