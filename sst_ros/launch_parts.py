# SPDX-License-Identifier: Apache-2.0
"""What the launch files share: arguments, nodes, recorders, RViz, and when a launch ends.

Only launch files import this module: it needs `launch` and `launch_ros` of a ROS
installation.
"""

from __future__ import annotations

import atexit
import os
import signal
import sys
import tempfile
from collections.abc import Callable, Mapping, Sequence
from datetime import datetime
from pathlib import Path
from typing import Any

import yaml
from ament_index_python.packages import get_packages_with_prefixes
from launch.action import Action
from launch.actions import (
    DeclareLaunchArgument,
    EmitEvent,
    ExecuteProcess,
    OpaqueFunction,
)
from launch.events.process import ProcessExited, ShutdownProcess
from launch.launch_context import LaunchContext
from launch.launch_description import LaunchDescription
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue
from launch_ros.utilities import make_namespace_absolute, prefix_namespace

from sst_ros.description.robot import TOPICS, urdf
from sst_ros.errors import explain_missing_ros, suggestion
from sst_ros.nodes import topics
from sst_ros.runtime import child_process
from sst_ros.runtime.settings import SimulatorParameters, default_topics, ros_arguments
from sst_ros.scene.scene import load, share_directory
from sst_ros.scene.yaml_document import read_file, read_values
from sst_ros.state import BASE_FRAME


class Given(dict[str, str]):
    """Values of the launch arguments of one launch file, and the actions that are made of them.

    Those end together, and nothing else of a launch that includes this one does.
    """

    partners: Sequence[Action] = ()
    ending = False


class Default(str):
    """A value that was not given, before which params_file goes."""

    __slots__ = ()


_CHOICES = {"sync": ["", "free", "lockstep"], "bag": ["ros2", "sst"]}
_FLAG = ["true", "false"]
_SHARED = {
    "namespace": ("", "namespace of the nodes"),
    "params_file": (
        "",
        "YAML file of parameters; arguments that are given here go before it",
    ),
    "log_level": ("info", "log level of the nodes: debug, info, warn, error or fatal"),
}
_SIGNAL_AGAIN_S = "10"
"""Wait for the end after SIGINT, before SIGTERM asks for the same: `ros2 bag record`
can lose the first signal while it starts, when the handler of rclcpp is there and its
own is not yet.
"""
_CLOSING_S = "60"  # time that a recorder has to write its index before it is killed
_ENDS: dict[str, Any] = {
    "sigterm_timeout": _SIGNAL_AGAIN_S,
    "sigkill_timeout": _CLOSING_S,
}
WAIT_S = "60.0"  # [s] of the nodes for each other; on a busy machine one starts in 20 s


def recording_arguments(name: str) -> dict[str, tuple[str, str]]:
    """Return the launch arguments of `recorder`; the default of output is dated."""
    dated = f"{name}_{datetime.now():%Y%m%d_%H%M%S}"
    return {
        "output": (dated, "folder of the recording, which must not exist yet"),
        "bag": (
            "ros2",
            "recorder: ros2 for `ros2 bag record`, sst for the node of this package",
        ),
    }


def description(
    file: str,
    arguments: Mapping[str, tuple[str, str]],
    actions: Callable[[Given], list[Action]],
) -> LaunchDescription:
    """Describe a launch: `actions` makes its nodes from the values of its launch arguments.

    Arguments are default and description by name; empty defaults are left to the nodes.
    """
    every = {**arguments, **_SHARED}

    given = set[str]()

    def perform(context: LaunchContext) -> list[Action]:
        ours = any(
            word.endswith(Path(file).name) for word in sys.argv
        )  # not one that is included
        for word in context.argv if ours else ():
            name, assigned, _ = word.partition(":=")
            if assigned and name not in every:
                raise RuntimeError(f"{word}: no such argument{suggestion(name, every)}")
        values = context.launch_configurations
        if (path := values["params_file"]) and not Path(path).is_file():
            raise RuntimeError(f"params_file:={path}: no such file")
        chosen = Given(
            {n: values[n] if n in given else Default(values[n]) for n in every}
        )
        pushed = prefix_namespace(values.get("ros_namespace"), values["namespace"])
        chosen["namespace"] = make_namespace_absolute(pushed or "")
        # not that of another robot's recording
        if "output" in every and "output" not in given:
            words = [*filter(None, chosen["namespace"].split("/")), chosen["output"]]
            chosen["output"] = Default("_".join(words))
        for name in every.keys() - given:
            del values[name]  # the next file that is included has defaults of its own
        chosen.partners = made = actions(chosen)
        return made

    def note(context: LaunchContext) -> None:
        given.update(context.launch_configurations)

    declared = [
        DeclareLaunchArgument(
            name,
            default_value=default,
            description=text,
            choices=_FLAG if default in _FLAG else _CHOICES.get(name),
        )
        for name, (default, text) in every.items()
    ]
    named = OpaqueFunction(function=note)  # before the defaults are filled in
    return LaunchDescription([named, *declared, OpaqueFunction(function=perform)])


def node(
    given: Given, executable: str, values: Mapping[str, str], *, ends: bool = True
) -> Node:
    """Describe a node of this package, which ends with the launch, however that ends.

    Values that are empty are left to params_file or the default; an InputError lists
    what the node would refuse. Where it `ends`, its end is that of its partners; its
    failure always is.
    """
    defaults = {k: str(v) for k, v in values.items() if v and isinstance(v, Default)}
    set_here = {k: v for k, v in values.items() if v and k not in defaults}
    words = [f"--{key.replace('_', '-')}={text}" for key, text in set_here.items()]
    ros_arguments(executable, words)
    return _node(
        given,
        "sst_ros",
        executable,
        ends,
        arguments=words,
        parameters=[
            one for one in (defaults, given["params_file"]) if one
        ],  # the later goes first
        ros_arguments=["--log-level", given["log_level"]],
        additional_env={child_process.PARENT: str(os.getpid())},
    )


def _node(
    given: Given, package: str, executable: str = "", ends: bool = True, **more: Any
) -> Node:
    """Describe a node of a package, by default of the same name.

    Its end may be its partners'.
    """
    return Node(
        package=package,
        executable=executable or package,
        namespace=given["namespace"],
        output="screen",
        on_exit=_exit_handler(given, executable or package, ends),
        **_ENDS,
        **more,
    )


def simulator(given: Given, parameters: Mapping[str, str], *, recorded: bool) -> Node:
    """Describe a simulator, which does not start its run before it is recorded.

    In a namespace its frame has that as a prefix, as those of robot_state_publisher.
    """
    parameters = {
        **parameters,
        "base_frame": Default(f"{_frame_prefix(given)}{BASE_FRAME}"),
    }
    waits = {
        "wait_for_subscribers": ",".join(topics.SAMPLED),
        "subscriber_timeout": WAIT_S,
    }
    return node(given, "simulator", {**parameters, **waits} if recorded else parameters)


def recorder(given: Given) -> Action:
    """Describe what records the topics of config/topics.txt into `output`."""
    shared, prefix = (
        topics.SIMULATOR["diagnostics"].name,
        given["namespace"].rstrip("/"),
    )
    names = {t: t if t == shared else prefix + t for t in default_topics()}
    if given["bag"] == "sst":
        recorded = {"output": given["output"], "topics": ",".join(names.values())}
        return node(given, "recorder", recorded)
    require("ros2bag", "rosbag2_storage_mcap")
    profiles = yaml.safe_load(
        (share_directory() / "config" / "rosbag2_qos.yaml").read_text()
    )
    profiles = {names[topic]: profile for topic, profile in profiles.items()}
    return ExecuteProcess(
        cmd=[
            *(
                "ros2",
                "bag",
                "record",
                "--storage",
                "mcap",
                "--output",
                given["output"],
            ),
            *("--disable-keyboard-controls", "--qos-profile-overrides-path"),
            _temporary_file(yaml.safe_dump(profiles)),
            *("--topics", *names.values()),
        ],
        output="screen",
        on_exit=_exit_handler(given, "ros2 bag record", True),
        **_ENDS,
    )


def _temporary_file(text: str) -> str:
    with tempfile.NamedTemporaryFile("w", suffix=".yaml", delete=False) as file:
        file.write(text)
    atexit.register(Path(file.name).unlink, missing_ok=True)
    return file.name


def rviz(given: Given, scene_name: str) -> list[Action]:
    """Describe robot_state_publisher with the URDF of a scene, and RViz with our layout.

    In a namespace its frames have that as a prefix.
    """
    require("robot_state_publisher", "rviz2")
    layout, prefix = share_directory() / "config" / "sst_ros.rviz", _frame_prefix(given)
    path = str(layout)
    if prefix:
        text = layout.read_text(encoding="utf-8").replace(
            "base_link", f"{prefix}base_link"
        )
        path = _temporary_file(
            text.replace('TF Prefix: ""', f"TF Prefix: {prefix[:-1]}")
        )
    state_publisher = _state_publisher(given, urdf(load(scene_name)))
    return [state_publisher, _node(given, "rviz2", arguments=["-d", path])]


def ros2_control(given: Given, controller: str, controllers: str) -> list[Action]:
    """Describe a controller manager whose hardware is the simulator, and the controllers.

    Beside joint_state_broadcaster it starts the controller of this name, by the file of
    parameters `controllers`, config/controllers.yaml where empty.
    """
    path = controllers or str(share_directory() / "config" / "controllers.yaml")
    if not Path(path).is_file():
        raise RuntimeError(f"controllers:={path}: no such file")
    lockstep = given["sync"] == "lockstep"
    hardware = (
        "sst_ros_hardware" if lockstep else "joint_state_topic_hardware_interface"
    )
    names = ["controller_manager", hardware, "robot_state_publisher"]
    spawned = ["joint_state_broadcaster", controller]
    for listed in read_values(read_file(Path(path)), path).values():
        given_there = listed.get("ros__parameters", {})
        types = [
            given_there[name].get("type", "") for name in spawned if name in given_there
        ]
        names += [plugin.partition("/")[0] for plugin in types if plugin]
    require(*names)
    topics_there = [given["namespace"].rstrip("/") + topic for topic in TOPICS]
    # /clock may come late
    words = [*spawned, "--param-file", path, "--switch-timeout", WAIT_S]
    timed: dict[str, Any] = {"use_sim_time": lockstep}
    if lockstep:  # an update for each sample
        timed["update_rate"] = int(
            given["publish_rate"] or SimulatorParameters().publish_rate
        )
    return [
        _state_publisher(
            given, urdf(load(given["scene"]), topics_there, lockstep=lockstep)
        ),
        _node(
            given, "controller_manager", "ros2_control_node", parameters=[path, timed]
        ),
        _node(given, "controller_manager", "spawner", ends=False, arguments=words),
    ]


def _state_publisher(given: Given, document: str) -> Node:
    description = ParameterValue(document, value_type=str)
    parameters = {
        "robot_description": description,
        "frame_prefix": _frame_prefix(given),
    }
    # time stands still in a pause, and /tf goes on
    parameters["ignore_timestamp"] = True
    return _node(given, "robot_state_publisher", parameters=[parameters])


def _frame_prefix(given: Given) -> str:
    return f"{given['namespace']}/".lstrip("/")


def require(*packages: str) -> None:
    """Refuse a launch for which ROS packages are missing, all of them, before any start."""
    installed = get_packages_with_prefixes()
    if missing := [package for package in packages if package not in installed]:
        raise RuntimeError(explain_missing_ros(missing))


def _exit_handler(
    given: Given, name: str, ends: bool
) -> Callable[[ProcessExited, LaunchContext], list[Action] | None]:
    """Return what is done when a process exits: it ends its partners, also those that yet start.

    If it has failed, the launch goes on with what else it includes, and its status will
    be 1.
    """

    def handle(event: ProcessExited, context: LaunchContext) -> list[Action] | None:
        over = given.ending or context.is_shutdown
        failed = event.returncode and not (over and event.returncode == -signal.SIGINT)
        if failed:
            # launch takes its status from this handler, or from an exception, which
            # ends all
            text = f"{name} failed with exit status {event.returncode}"
            context.asyncio_loop.call_exception_handler({"message": text})
        if over or not (failed or ends):
            return None
        given.ending = True
        partners = [one for one in given.partners if one is not event.action]
        return [
            EmitEvent(
                event=ShutdownProcess(process_matcher=lambda one: one in partners)
            )
        ]

    return handle
