# SPDX-License-Identifier: Apache-2.0
"""Arguments, nodes, recorders and RViz for the launch files, and when a launch ends.

Only launch files import this module: it needs `launch` and `launch_ros` of a ROS
installation. A launch file names its arguments, each an `LaunchArgument`, and a
function that makes its actions from their values; `description` does the rest. The
actions of one launch file end together: when one that `ends` has exited, or when any
has failed.
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
from typing import Any, NamedTuple

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
from sst_ros.runtime.arguments import LOG_LEVELS, USE_SIM_TIME, ros_arguments
from sst_ros.runtime.settings import SimulatorParameters, default_topics
from sst_ros.scene.scene import load, share_directory
from sst_ros.scene.yaml_document import read_file, read_values, resolve_numbers
from sst_ros.state import BASE_FRAME


class LaunchArgument(NamedTuple):
    """A launch argument.

    An empty default leaves the value to params_file or the node.
    """

    default: str
    description: str
    choices: Sequence[str] = ()


def flag(default: str, description: str) -> LaunchArgument:
    """Describe an argument that is true or false."""
    choices = ["true", "false"]
    return LaunchArgument(default, description, choices if default else ["", *choices])


class Values(dict[str, str]):
    """Values of the arguments of one launch file, and the actions made from them."""

    actions: Sequence[Action] = ()
    is_ending = False  # the actions of this launch file have been asked to end

    def is_true(self, name: str) -> bool:
        """Return whether a flag is set."""
        return self[name] == "true"

    @property
    def node_time(self) -> dict[str, bool]:
        """Parameters of a node that reads the simulated time where requested."""
        return {USE_SIM_TIME: True} if self.is_true(USE_SIM_TIME) else {}


class Default(str):
    """A value that the user did not set: params_file takes precedence over it."""

    __slots__ = ()


_SIGNAL_AGAIN_S = "10"
"""Wait for the end after SIGINT, before SIGTERM asks for the same: `ros2 bag record`
can lose the first signal while it starts, when rclcpp has installed its handler and
the recorder has not yet."""
_CLOSING_S = "60"  # time that a recorder has to write its index before it is killed
_ENDS: dict[str, Any] = {
    "sigterm_timeout": _SIGNAL_AGAIN_S,
    "sigkill_timeout": _CLOSING_S,
}
WAIT_S = "60.0"
"""Time that nodes wait for each other [s]; on a busy machine one starts in 20 s."""

_SHARED = {
    "namespace": LaunchArgument("", "namespace of the nodes"),
    "params_file": LaunchArgument(
        "", "YAML file of parameters; arguments given here take precedence"
    ),
    "log_level": LaunchArgument("info", "log level of the nodes", LOG_LEVELS),
    USE_SIM_TIME: flag(
        "false",
        "true: the nodes read the time from /clock, which the simulator publishes;"
        " with publish_clock:=false the simulator follows another source of /clock",
    ),
}


def recording_arguments(name: str) -> dict[str, LaunchArgument]:
    """Return the launch arguments of `recorder`; the default of output is dated."""
    dated = f"{name}_{datetime.now():%Y%m%d_%H%M%S}"
    return {
        "output": LaunchArgument(
            dated, "folder of the recording, which must not exist yet"
        ),
        "bag": LaunchArgument(
            "ros2",
            "recorder: ros2 for `ros2 bag record`, sst for the node of this package",
            ("ros2", "sst"),
        ),
    }


def description(
    file: str,
    arguments: Mapping[str, LaunchArgument],
    actions: Callable[[Values], list[Action]],
) -> LaunchDescription:
    """Describe a launch: `actions` makes its nodes from the values of its arguments."""
    declared = {**arguments, **_SHARED}
    set_by_user = set[str]()

    def note_set_by_user(context: LaunchContext) -> None:
        set_by_user.update(context.launch_configurations)

    def make_actions(context: LaunchContext) -> list[Action]:
        _refuse_unknown_arguments(file, context, declared)
        configurations = context.launch_configurations
        values = Values()
        for name in declared:
            text = configurations[name]
            values[name] = text if name in set_by_user else Default(text)
        path = values["params_file"]
        if path and not Path(path).is_file():
            raise RuntimeError(f"params_file:={path}: no such file")
        namespace = prefix_namespace(
            configurations.get("ros_namespace"), values["namespace"]
        )
        values["namespace"] = make_namespace_absolute(namespace or "")
        if isinstance(values.get("output"), Default):
            # Each robot has a folder of its own.
            name_parts = [*values["namespace"].split("/"), values["output"]]
            values["output"] = Default("_".join(filter(None, name_parts)))
        for name in declared.keys() - set_by_user:
            del configurations[name]  # an included file has defaults of its own
        values.actions = actions(values)
        return list(values.actions)

    declarations = [
        DeclareLaunchArgument(
            name,
            default_value=argument.default,
            description=argument.description,
            choices=list(argument.choices) or None,
        )
        for name, argument in declared.items()
    ]
    return LaunchDescription(
        [
            OpaqueFunction(function=note_set_by_user),  # before defaults are filled in
            *declarations,
            OpaqueFunction(function=make_actions),
        ]
    )


def _refuse_unknown_arguments(
    file: str, context: LaunchContext, declared: Mapping[str, LaunchArgument]
) -> None:
    """Raise for a misspelt NAME:=VALUE, which launch would ignore.

    A file that is included takes no arguments of the command line.
    """
    if not any(argument.endswith(Path(file).name) for argument in sys.argv):
        return
    for argument in context.argv:
        name, assignment, _ = argument.partition(":=")
        if assignment and name not in declared:
            raise RuntimeError(
                f"{argument}: no such argument{suggestion(name, declared)}"
            )


def node(
    values: Values,
    executable: str,
    parameters: Mapping[str, str],
    *,
    ends: bool = True,
    reads_clock: bool | None = None,
) -> Node:
    """Describe a node of this package, which ends with the launch, however that ends.

    Empty parameters are left to params_file or the default; an InputError lists what
    the node would refuse. Where it `ends`, so do the other actions of its launch file;
    its failure always ends them. By default it reads /clock with use_sim_time.
    """
    defaults: dict[str, Any] = {}
    options = []
    for name, text in parameters.items():
        if text and isinstance(text, Default):
            defaults[name] = str(text)
        elif text:
            options.append(f"--{name.replace('_', '-')}={text}")
    ros_arguments(executable, options)
    if reads_clock is None:
        reads_clock = values.is_true(USE_SIM_TIME)
    if reads_clock:
        defaults[USE_SIM_TIME] = True
    sources = [defaults, values["params_file"]]  # the later takes precedence
    return _node(
        values,
        "sst_ros",
        executable,
        ends,
        arguments=options,
        parameters=[source for source in sources if source],
        ros_arguments=["--log-level", values["log_level"]],
        additional_env={child_process.PARENT: str(os.getpid())},
    )


def _node(
    values: Values, package: str, executable: str, ends: bool = True, **options: Any
) -> Node:
    """Describe a node of any package."""
    return Node(
        package=package,
        executable=executable,
        namespace=values["namespace"],
        output="screen",
        on_exit=_exit_handler(values, executable, ends),
        **_ENDS,
        **options,
    )


def simulator(values: Values, parameters: Mapping[str, str], *, recorded: bool) -> Node:
    """Describe a simulator, which does not start its run before it is recorded.

    In a namespace its frame has that as a prefix, as those of robot_state_publisher.
    With use_sim_time it publishes /clock, or follows it with publish_clock:=false.
    """
    base_frame = Default(f"{_frame_prefix(values)}{BASE_FRAME}")
    parameters = {**parameters, "base_frame": base_frame}
    reads_clock = False
    if values.is_true(USE_SIM_TIME):
        reads_clock = parameters.get("publish_clock") == "false"
        if not parameters.get("publish_clock"):
            parameters["publish_clock"] = Default("true")
    if recorded:
        parameters["wait_for_subscribers"] = ",".join(topics.SAMPLED)
        parameters["subscriber_timeout"] = WAIT_S
    return node(values, "simulator", parameters, reads_clock=reads_clock)


def recorder(values: Values) -> Action:
    """Describe what records the topics of config/topics.txt into `output`."""
    shared = topics.SIMULATOR["diagnostics"].name  # has no namespace
    prefix = values["namespace"].rstrip("/")
    names = {}
    for topic in default_topics():
        names[topic] = topic if topic == shared else prefix + topic
    if values["bag"] == "sst":
        parameters = {"output": values["output"], "topics": ",".join(names.values())}
        return node(values, "recorder", parameters)
    require("ros2bag", "rosbag2_storage_mcap")
    path = share_directory() / "config" / "rosbag2_qos.yaml"
    profiles = resolve_numbers(read_values(read_file(path), str(path)))
    renamed = {names[topic]: profile for topic, profile in profiles.items()}
    command = ["ros2", "bag", "record"]
    command += ["--storage", "mcap", "--output", values["output"]]
    command += ["--disable-keyboard-controls"]
    if values.is_true(USE_SIM_TIME):
        command += ["--use-sim-time"]
    command += [
        "--qos-profile-overrides-path",
        _temporary_file(yaml.safe_dump(renamed)),
    ]
    command += ["--topics", *names.values()]
    return ExecuteProcess(
        cmd=command,
        output="screen",
        on_exit=_exit_handler(values, "ros2 bag record", True),
        **_ENDS,
    )


def _temporary_file(text: str) -> str:
    """Write a file that is removed when the launch ends; return its path."""
    with tempfile.NamedTemporaryFile("w", suffix=".yaml", delete=False) as file:
        file.write(text)
    atexit.register(Path(file.name).unlink, missing_ok=True)
    return file.name


def rviz(values: Values, scene_name: str) -> list[Action]:
    """Describe robot_state_publisher with a scene's URDF, and RViz with our layout.

    In a namespace its frames have that as a prefix.
    """
    require("robot_state_publisher", "rviz2")
    path = str(share_directory() / "config" / "sst_ros.rviz")
    prefix = _frame_prefix(values)
    if prefix:
        layout = Path(path).read_text(encoding="utf-8")
        layout = layout.replace(BASE_FRAME, f"{prefix}{BASE_FRAME}")
        layout = layout.replace('TF Prefix: ""', f"TF Prefix: {prefix[:-1]}")
        path = _temporary_file(layout)
    return [
        _state_publisher(values, urdf(load(scene_name)), values.node_time),
        _node(
            values,
            "rviz2",
            "rviz2",
            arguments=["-d", path],
            parameters=[values.node_time],
        ),
    ]


def ros2_control(values: Values, controller: str, controllers: str) -> list[Action]:
    """Describe a controller manager with the simulator as hardware, and controllers.

    Beside joint_state_broadcaster it starts the controller of this name, with the
    parameters of the file `controllers`, by default config/controllers.yaml. In
    lockstep they update once for each sample, so they read /clock.
    """
    path = controllers or str(share_directory() / "config" / "controllers.yaml")
    if not Path(path).is_file():
        raise RuntimeError(f"controllers:={path}: no such file")
    lockstep = values["sync"] == "lockstep"
    spawned = ["joint_state_broadcaster", controller]
    hardware = (
        "sst_ros_hardware" if lockstep else "joint_state_topic_hardware_interface"
    )
    require(
        "controller_manager",
        hardware,
        "robot_state_publisher",
        *_plugin_packages(path, spawned),
    )
    namespace = values["namespace"].rstrip("/")
    hardware_topics = [namespace + topic for topic in TOPICS]
    document = urdf(load(values["scene"]), hardware_topics, lockstep=lockstep)
    time = {USE_SIM_TIME: lockstep or values.is_true(USE_SIM_TIME)}
    parameters: list[Any] = [path, time]
    if lockstep:
        rate = values["publish_rate"] or SimulatorParameters().publish_rate
        parameters.append({"update_rate": int(rate)})
    spawn = [*spawned, "--param-file", path]
    spawn += ["--switch-timeout", WAIT_S]  # /clock may come late
    return [
        _state_publisher(values, document, time),
        _node(values, "controller_manager", "ros2_control_node", parameters=parameters),
        _node(values, "controller_manager", "spawner", ends=False, arguments=spawn),
    ]


def _plugin_packages(path: str, controllers: Sequence[str]) -> list[str]:
    """List the packages of the plug-ins that a parameter file names for controllers."""
    packages = []
    for listed in read_values(read_file(Path(path)), path).values():
        parameters = listed.get("ros__parameters", {})
        for name in controllers:
            plugin = parameters.get(name, {}).get("type", "")
            if plugin:
                packages.append(plugin.partition("/")[0])
    return packages


def _state_publisher(values: Values, document: str, time: Mapping[str, bool]) -> Node:
    """Describe robot_state_publisher with a URDF document."""
    parameters = {
        "robot_description": ParameterValue(document, value_type=str),
        "frame_prefix": _frame_prefix(values),
        "ignore_timestamp": True,  # time stands still in a pause, and /tf goes on
        **time,
    }
    package = "robot_state_publisher"
    return _node(values, package, package, parameters=[parameters])


def _frame_prefix(values: Values) -> str:
    """Return the namespace as robot_state_publisher puts it before frames."""
    return f"{values['namespace']}/".lstrip("/")


def require(*packages: str) -> None:
    """Refuse a launch without its ROS packages, naming all, before anything starts."""
    installed = get_packages_with_prefixes()
    missing = [package for package in packages if package not in installed]
    if missing:
        raise RuntimeError(explain_missing_ros(missing))


def _exit_handler(
    values: Values, name: str, ends: bool
) -> Callable[[ProcessExited, LaunchContext], list[Action] | None]:
    """Return the handler of a process's exit.

    It ends the other actions of the launch file, also those that are yet to start. If
    the process has failed, the launch goes on with what else it includes, and its exit
    status will be 1.
    """

    def handle(event: ProcessExited, context: LaunchContext) -> list[Action] | None:
        stopped = values.is_ending or context.is_shutdown
        interrupted = stopped and event.returncode == -signal.SIGINT
        failed = event.returncode != 0 and not interrupted
        if failed:
            # launch takes its exit status from this handler of asyncio, or from an
            # exception, which would end everything.
            message = f"{name} failed with exit status {event.returncode}"
            context.asyncio_loop.call_exception_handler({"message": message})
        if stopped or not (failed or ends):
            return None
        values.is_ending = True
        remaining = [action for action in values.actions if action is not event.action]
        return [
            EmitEvent(event=ShutdownProcess(process_matcher=remaining.__contains__))
        ]

    return handle
