# SPDX-License-Identifier: Apache-2.0
"""One process, one node: its parameters, start, callbacks, and an orderly end.

`run` reads the command line, starts the worker of the node and lets it `spin` until it
is done, is asked to end or fails.
"""

from __future__ import annotations

import atexit
import contextlib
import dataclasses
import faulthandler
import importlib
import math
import os
import sys
import threading
import time
from array import array
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, Generic, TypeAlias, TypeVar

import rclpy
from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor
from rcl_interfaces.msg import SetParametersResult as Result
from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.duration import Duration
from rclpy.exceptions import ParameterException
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.signals import SignalHandlerOptions
from rclpy.timer import Timer

from sst_ros.errors import Check, InputError, SstError, refuse_unless
from sst_ros.nodes import signals
from sst_ros.runtime import arguments, settings
from sst_ros.runtime.child_process import is_orphan
from sst_ros.scene.schema import Spec

_STEADY = Clock(clock_type=ClockType.STEADY_TIME)
_PROFILES = {
    "FASTRTPS_DEFAULT_PROFILES_FILE": "fast_dds_2.xml",
    "FASTDDS_DEFAULT_PROFILES_FILE": "fast_dds_3.xml",
}
"""Our profile, by the variable that names it.

The first is for Fast DDS 2, libfastrtps, the second for Fast DDS 3, libfastdds.
"""
_ORPHAN_POLL_S = 0.1
"""Period of looks for a signal and for the end of the parent.

The executor would take half a millisecond for each look.
"""
_CALLBACK_S = 1.0
"""Longest wait for a callback in progress.

A service that waits for the run ends once that is closed.
"""
_ACKNOWLEDGE_AT_END_S = 6.0
"""Longest wait for subscribers of a node whose work is done, within _CLEAN_UP_S."""
_ACKNOWLEDGE_S = 1.2
"""The same after a signal: a killed subscriber never acknowledges, and a node ends
within 2 s of a signal.
"""
_CLEAN_UP_S = 10.0
"""Longer than any clean-up of the middleware takes, also on a busy machine."""
_STDERR = 2  # its descriptor

_PARAMETER_TYPES = {
    "number": Parameter.Type.DOUBLE,
    "integer": Parameter.Type.INTEGER,
    "flag": Parameter.Type.BOOL,
    "text": Parameter.Type.STRING,
    "choice": Parameter.Type.STRING,
    "texts": Parameter.Type.STRING_ARRAY,
}
_LISTS = (Parameter.Type.DOUBLE_ARRAY, Parameter.Type.STRING_ARRAY)
_WIDEST_RANGE = 1e300
"""Ends of a range in a descriptor are finite."""

Defaults: TypeAlias = Callable[[dict[str, Any]], dict[str, Any]]
"""Defaults of some parameters, by the values that others are given."""
P = TypeVar("P", bound=settings.NodeParameters)


class Worker(Generic[P]):
    """What a process runs: a node with checked `parameters`, `done` when its work is.

    Fields of `cls` are read-only, except those of `cls.CHANGEABLE`; some defaults
    depend on the values given at the start. An InputError lists all that are refused,
    and all unknown names. Where a callback has raised an error, that is its `failure`.
    """

    def __init__(
        self,
        node: str,
        cls: type[P],
        dependent_defaults: Defaults = lambda overrides: {},
    ) -> None:
        self.node = Node(node)
        self.done = threading.Event()
        self.failure: BaseException | None = None
        self.parameters = _declare(self.node, cls, dependent_defaults)
        self.node.add_on_set_parameters_callback(self._set)

    def close(self) -> None:
        """Finish while still connected; raise an SstError where the work has failed.

        What it publishes is received by its subscribers before the node leaves.
        """

    def change(self, changed: P) -> None:
        """Take over values that were set at run time, each of which is allowed.

        An InputError refuses them, with the reason; then nothing has changed.
        """
        self.parameters = changed

    def _set(self, parameters: list[Parameter[Any]]) -> Result:
        """Take over what is set; refuse it with the reason where it is not allowed."""
        specs = self.parameters.SPECS
        changes = {}
        for parameter in parameters:
            if parameter.name == "use_sim_time":
                reason = "use_sim_time is read when the node starts, and cannot change"
                return Result(successful=False, reason=reason)
            if parameter.name in specs:
                spec = specs[parameter.name]
                changes[parameter.name] = _plain_value(spec, parameter.value)
        try:
            if changes:
                self.change(dataclasses.replace(self.parameters, **changes))
        except InputError as error:
            named = InputError(self.node.get_fully_qualified_name(), error.problems)
            return Result(successful=False, reason=str(named))
        return Result(successful=True)


def _plain_value(spec: Spec, value: Any) -> Any:
    """Return the value of a parameter as a field of its section takes it."""
    if type(value) is int and spec.kind == "number":  # "-p duration:=1" means 1.0
        return float(value)
    if value is None or isinstance(value, (array, tuple, list)):
        # None is what rcl has for []
        return [float(x) if type(x) is int else x for x in value or ()]
    return value


def _declare(node: Node, cls: type[P], dependent_defaults: Defaults) -> P:
    """Declare the parameters of a node and return their values, checked."""
    # rclpy has no public call for the values that were given; Jazzy and Kilted have
    # this.
    overrides: dict[str, Any] = {
        name: parameter.value for name, parameter in node._parameter_overrides.items()
    }
    defaults = {**vars(cls()), **dependent_defaults(overrides)}
    values: dict[str, Any] = {}
    origin = node.get_fully_qualified_name()
    checks: list[Check] = []
    for name, spec in cls.SPECS.items():
        value = _plain_value(spec, overrides.get(name, defaults[name]))
        values[name] = value
        read_only = name not in cls.CHANGEABLE
        try:
            if value == [] and _type_of(spec) in _LISTS:
                _declare_empty_list(node, name, spec, read_only=read_only)
            else:
                descriptor = _descriptor(name, spec, read_only=read_only)
                node.declare_parameter(name, value, descriptor, ignore_override=True)
        except ParameterException:  # of another type, or out of range
            checks.append((name, value, False, spec.describe()))
    names_of_all_nodes = {
        name
        for _, parameters in settings.NODE_COMMANDS.values()
        for name in parameters.SPECS
    }
    for name in sorted(overrides.keys() - values.keys()):
        if name in names_of_all_nodes:  # nodes may share a parameter file
            node.get_logger().info(f"parameter {name} is one of another node: not used")
        elif not name.startswith(arguments.FOREIGN):
            checks.append(arguments.unknown_name(name, values))
    refuse_unless(origin, *checks)
    try:
        # `build` would take a number for text, as a YAML file has it
        return cls(**values)
    except InputError as error:
        raise InputError(origin, error.problems) from None


def _declare_empty_list(node: Node, name: str, spec: Spec, *, read_only: bool) -> None:
    """Declare a parameter whose value is an empty list, with its type.

    rclpy takes the type of a list from its entries, and an empty one for bytes.
    """
    value_type = _type_of(spec)
    changeable = _descriptor(name, spec, read_only=False)
    node.declare_parameter(name, value_type, changeable, ignore_override=True)
    node.set_parameters([Parameter(name, value_type, [])])
    if read_only:
        node.set_descriptor(name, _descriptor(name, spec, read_only=True))


def _type_of(spec: Spec) -> Parameter.Type:
    return Parameter.Type.DOUBLE_ARRAY if spec.shape else _PARAMETER_TYPES[spec.kind]


def _descriptor(name: str, spec: Spec, *, read_only: bool) -> ParameterDescriptor:
    """Describe a parameter: its type, words, range and whether it can be set."""
    descriptor = ParameterDescriptor(
        name=name,
        type=_type_of(spec).value,
        description=spec.doc + (f" [{spec.unit}]" if spec.unit else ""),
        additional_constraints=spec.describe(),
        read_only=read_only,
    )
    least = max(spec.least, -_WIDEST_RANGE)
    most = min(spec.most, _WIDEST_RANGE)
    if spec.kind == "number" and not spec.shape:
        # Only a parameter with a range refuses NaN.
        if math.isfinite(spec.above):
            least = math.nextafter(spec.above, math.inf)
        descriptor.floating_point_range = [
            FloatingPointRange(from_value=least, to_value=most)
        ]
    if spec.kind == "integer":
        descriptor.integer_range = [
            IntegerRange(from_value=int(least), to_value=int(most))
        ]
    return descriptor


def run(command_line: Sequence[str]) -> int:
    """Run a node until a signal of `signals`, its end or the end of its parent.

    The signal handlers of rclpy would cut the connection at once; ours let the worker
    close. The command line is the name of a node and the arguments behind it. The
    exit status is 0, 1 for a failure, 2 for arguments that are refused.
    """
    status = _run(command_line)
    atexit.register(_leave_compilation, status)
    return status


def _leave_compilation(status: int) -> None:
    """End the process now where a thread compiles what no caller waits for any more.

    LLVM can neither be interrupted nor taken down below that thread; by now the node
    has left and its files are closed.
    """
    llvm = sys.modules.get("sst_ros.programs.llvm")
    if llvm is not None and llvm.is_compiling():
        for stream in (sys.stdout, sys.stderr):
            with contextlib.suppress(AttributeError, OSError, ValueError):  # closed
                stream.flush()
        os._exit(status)


def _run(command_line: Sequence[str]) -> int:
    signals.handle()
    command, *node_arguments = command_line
    if {"-h", "--help"} & set(node_arguments):
        arguments.make_parser(command).print_help()
        return 0
    configure_middleware()
    try:
        ros = arguments.ros_arguments(command, node_arguments)
        rclpy.init(args=[command, *ros], signal_handler_options=SignalHandlerOptions.NO)
    except InputError as error:
        print(error, file=sys.stderr)
        return 2
    # of rcl; some have nothing but the words
    except (RuntimeError, ValueError) as error:
        print(f"{command}: {type(error).__name__}: {error}", file=sys.stderr)
        return 2
    try:
        if not signals.came:
            module = importlib.import_module(f"sst_ros.nodes.{command}")
            worker = getattr(module, settings.NODE_COMMANDS[command][0])()
            for line in arguments.unused_files(
                ros, worker.node.get_fully_qualified_name()
            ):
                worker.node.get_logger().warning(line)
            spin(worker)
    except (SstError, ParameterException) as error:
        text = str(error)
        if not text.startswith(f"{command}: "):
            text = f"{command}: {text}"
        print(text, file=sys.stderr)
        return 1
    finally:
        with _bound_time():
            rclpy.try_shutdown()
        signals.ignore()
    return 0


@contextlib.contextmanager
def _bound_time() -> Iterator[None]:
    """End the process where the middleware hangs for ten seconds.

    It ends with a traceback and status 1. Fast DDS 3.2 deadlocks now and then when
    another node leaves (eProsima/Fast-DDS issue 6502), and rclpy holds the
    interpreter's lock while it gives up a node: neither another thread nor a signal
    could end it from Python.
    """
    faulthandler.dump_traceback_later(_CLEAN_UP_S, exit=True, file=_STDERR)
    try:
        yield
    finally:
        faulthandler.cancel_dump_traceback_later()


def spin(worker: Worker[Any]) -> None:
    """Run a worker until it is done or asked to end, or a callback raises; close it.

    The executor has a thread, which sleeps until there is work: signals would not wake
    it.
    """
    node = worker.node
    ends = threading.Event()
    errors: list[BaseException] = []
    executor = SingleThreadedExecutor(context=node.context)
    executor.add_node(node)
    wake = node.create_guard_condition(lambda: None)

    def call_back() -> None:
        try:
            while not ends.is_set():
                executor.spin_once()
        except BaseException as error:
            errors.append(error)

    callbacks = threading.Thread(target=call_back, name="executor", daemon=True)
    callbacks.start()
    try:
        while callbacks.is_alive() and not (signals.came or is_orphan()):
            if worker.done.wait(_ORPHAN_POLL_S):
                break
        ends.set()  # no other callback begins
        wake.trigger()
        callbacks.join(_CALLBACK_S)
        if errors:
            worker.failure = errors[0]
            raise errors[0]
    finally:
        try:
            worker.close()
        finally:
            with _bound_time():
                _wait_for_subscribers(node)
                callbacks.join(_CALLBACK_S)
                executor.shutdown()
                node.destroy_node()


def _wait_for_subscribers(node: Node) -> None:
    """Wait until what was published is received; say where that takes too long.

    After a signal a node ends within 2 s. Where its work is done it waits longer: a
    recorder on a busy machine would lose the end of the run.
    """
    longest_s = _ACKNOWLEDGE_S if signals.came else _ACKNOWLEDGE_AT_END_S
    deadline = time.monotonic() + longest_s
    unheard = []
    for publisher in node.publishers:
        left = max(0.0, deadline - time.monotonic())
        if not publisher.wait_for_all_acked(Duration(seconds=left)):
            unheard.append(publisher.topic_name)
    if unheard:
        topics_named = ", ".join(unheard)
        node.get_logger().warning(
            f"subscribers have not received all of {topics_named}"
            f" within {longest_s:g} s"
        )


def configure_middleware() -> None:
    """Select our profile of Fast DDS, unless the user has selected one.

    Call this before `rclpy.init`.

    By default a reliable writer asks its readers every 3 s what has arrived, and then
    removes 1500 samples at once while the publisher waits: one to three milliseconds,
    hence missed ticks. Five times a second it takes a fifteenth of that; more often it
    would cost a thread that wakes for each topic.

    By default a reliable writer also wakes its thread for events after each message and
    reader, to ignore requests for it for a time of zero: half of what publishing costs.
    With 50 ms (the element's name is spelt as Fast DDS spells it) the thread wakes 20
    times a second; a message that was lost is repeated that much later.

    Other middleware ignores the profile.
    """
    if any(os.environ.get(name) for name in _PROFILES):
        return
    is_old = _has_library("fastrtps") and not _has_library("fastdds")
    old, new = _PROFILES
    name = old if is_old else new
    os.environ[name] = str(Path(__file__).with_name(_PROFILES[name]))


def _has_library(name: str) -> bool:
    """Look for a shared library where the loader finds that of the middleware."""
    for folder in os.environ.get("LD_LIBRARY_PATH", "").split(os.pathsep):
        if folder and any(Path(folder).glob(f"lib{name}.so*")):
            return True
    return False


def every(node: Node, seconds: float, callback: Callable[[], None]) -> Timer:
    """Call back by a clock that does not stand still with simulated time."""
    return node.create_timer(seconds, callback, clock=_STEADY)
