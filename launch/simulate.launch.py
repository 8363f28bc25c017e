# SPDX-License-Identifier: Apache-2.0
"""Start the simulator and, if asked, torque player, recorder and RViz.

The launch ends with the simulator, that is after `duration` if there is one, in
lockstep by default that of the scene; without one it ends with the player of
play:=true, or when it is stopped.
"""

from launch import LaunchDescription
from launch.action import Action

from sst_ros import launch_parts
from sst_ros.launch_parts import Given

RUN = {
    "scene": ("example2", "scene, by name or by path of a .yaml file"),
    "rate": ("", "steps per second of simulated time [Hz]"),
    "publish_rate": ("", "published samples per second [Hz]"),
    "duration": (
        "",
        "length of the run [s]; 0 for no end; in lockstep by default the scene's",
    ),
    "real_time_factor": (
        "",
        "simulated time per time of the clock; 0 for as fast as possible",
    ),
    "publish_clock": ("", "true: publish the simulated time on /clock"),
    "sync": (
        "",
        "free, or lockstep with the commands; by default lockstep with play:=true",
    ),
}
ARGUMENTS = {
    **RUN,
    "play": ("false", "also play the scene's torques, from the start of the run"),
    "record": ("false", "also record the run, which starts when it is recorded"),
    "rviz": ("false", "also start robot_state_publisher and RViz"),
    **launch_parts.recording_arguments("sst_bag"),
}


def actions(given: Given) -> list[Action]:
    """Describe the nodes."""
    play, recorded = given["play"] == "true", given["record"] == "true"
    run = {name: given[name] for name in RUN}
    run["publish_description"] = "false" if given["rviz"] == "true" else ""
    if play:
        run["wait_for_command"] = "true"
        # By default the same run on a busy machine.
        run["sync"] = run["sync"] or launch_parts.Default("lockstep")
    nodes = launch_parts.rviz(given, given["scene"]) if given["rviz"] == "true" else []
    if recorded:
        nodes.append(launch_parts.recorder(given))
    nodes.append(launch_parts.simulator(given, run, recorded=recorded))
    if play:
        played = {
            "scene": given["scene"],
            "rate": given["publish_rate"],
            # also until the simulator is up
            "timeout": launch_parts.Default(launch_parts.WAIT_S),
            "stamped": "" if run["sync"] == "lockstep" else "false",
            "min_subscribers": "2" if recorded else "",  # the recorder reads them, too
        }
        endless = given["duration"] or ("0" if run["sync"] == "free" else "")
        endless = bool(endless) and float(endless) == 0.0
        nodes.append(launch_parts.node(given, "torque_player", played, ends=endless))
    return nodes


def generate_launch_description() -> LaunchDescription:
    """Describe the arguments and the nodes."""
    return launch_parts.description(__file__, ARGUMENTS, actions)
