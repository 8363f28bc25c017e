# SPDX-License-Identifier: Apache-2.0
"""One process, one node: its parameters, its start, its callbacks, and an end in order."""

from __future__ import annotations

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
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, Generic, TypeVar

import rclpy
from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor
from rcl_interfaces.msg import SetParametersResult as Result
from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.duration import Duration
from rclpy.exceptions import (
    InvalidParameterTypeException,
    InvalidParameterValueException,
    ParameterException,
)
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.signals import SignalHandlerOptions
from rclpy.timer import Timer

from sst_ros.errors import InputError, Problem, SstError
from sst_ros.host.child_process import is_orphan
from sst_ros.nodes import arguments, signals
from sst_ros.scene.schema import Section, Spec, specs

_STEADY = Clock(clock_type=ClockType.STEADY_TIME)
_FIRST_RCLPY_ON_FAST_DDS_3 = 9
"""Of ROS 2 Kilted."""
_POLL_S = 0.1
"""Longest delay of a signal. The executor would take half a millisecond for each look."""
_CALLBACK_S = 1.0
"""Wait for a callback in progress: a service that waits for the run ends once that is closed."""
_ACKNOWLEDGE_S = 1.2
"""A subscriber that was killed never acknowledges: a node ends within 2 s of a signal."""
_CLEAN_UP_S = 10.0
"""Longer than any clean-up of the middleware, also on a busy machine."""
_STDERR = 2

_TYPES = {
    "number": Parameter.Type.DOUBLE,
    "integer": Parameter.Type.INTEGER,
    "flag": Parameter.Type.BOOL,
    "text": Parameter.Type.STRING,
    "choice": Parameter.Type.STRING,
    "texts": Parameter.Type.STRING_ARRAY,
}
_WIDEST = 1e300

P = TypeVar("P", bound=Section)


class Worker(Generic[P]):
    """What a process runs: a node with checked `parameters`, `done` when its work is.

    Fields of `cls` are read-only, except those of `cls.CHANGEABLE`; some defaults depend on the
    values given at the start. An InputError lists all that are refused, and all unknown names.
    """

    def __init__(
        self,
        node: str,
        cls: type[P],
        more_defaults: Callable[[dict[str, Any]], dict[str, Any]] = lambda given: {},
    ) -> None:
        self.node, self.done = Node(node), threading.Event()
        self.parameters = _declare(self.node, cls, more_defaults)
        self.node.add_on_set_parameters_callback(self._set)

    def close(self) -> None:
        """Finish while still connected; raise an SstError where the work has failed.

        What it publishes is received by its subscribers before the node leaves.
        """

    def change(self, changed: P) -> None:
        """Take over values that were set at run time, all of which are checked."""
        self.parameters = changed

    def _set(self, given: list[Parameter[Any]]) -> Result:
        known, values = specs(type(self.parameters)), {one.name: one.value for one in given}
        if "use_sim_time" in values:
            reason = "use_sim_time is read when the node starts, and cannot be changed"
            return Result(successful=False, reason=reason)
        mine = {name: value for name, value in values.items() if name in known}
        try:
            changed = dataclasses.replace(self.parameters, **mine)
        except InputError as error:
            return Result(successful=False, reason=str(error))
        if mine:
            self.change(changed)
        return Result(successful=True)


def _declare(
    node: Node, cls: type[P], more_defaults: Callable[[dict[str, Any]], dict[str, Any]]
) -> P:
    # rclpy has no public call for the values that were given; Jazzy and Kilted have this.
    given: dict[str, Any] = {name: one.value for name, one in node._parameter_overrides.items()}
    changeable = getattr(cls, "CHANGEABLE", ())
    values: dict[str, Any] = {}
    problems: list[Problem] = []
    defaults = {**vars(cls()), **more_defaults(given)}
    for name, spec in specs(cls).items():
        default = defaults[name]
        value = given.get(name, list(default) if isinstance(default, tuple) else default)
        if spec.kind == "number":  # "-p duration:=1" means 1.0
            value = float(value) if type(value) is int else value
            value = list(map(float, value)) if isinstance(value, array) else value
        try:
            node.declare_parameter(
                name, value, _descriptor(name, spec, name not in changeable), ignore_override=True
            )
        except (InvalidParameterTypeException, InvalidParameterValueException):
            problems.append(Problem(name, value, spec.describe()))
        values[name] = value
    ours = {name for _, parameters in arguments.COMMANDS.values() for name in specs(parameters)}
    for name in sorted(given.keys() - values.keys()):
        if name in ours:  # nodes may share a parameter file
            node.get_logger().info(f"parameter {name} is one of another node: not used")
        elif not name.startswith(arguments.FOREIGN):
            problems.append(arguments.unknown_parameter(name, [*values]))
    try:
        if problems:
            raise InputError("", problems)
        return cls(**values)
    except InputError as error:
        raise InputError(node.get_fully_qualified_name(), error.problems) from None


def _descriptor(name: str, spec: Spec, read_only: bool) -> ParameterDescriptor:
    descriptor = ParameterDescriptor(
        name=name,
        type=(Parameter.Type.DOUBLE_ARRAY if spec.shape else _TYPES[spec.kind]).value,
        description=spec.doc + (f" [{spec.unit}]" if spec.unit else ""),
        additional_constraints=spec.describe(),
        read_only=read_only,
    )
    low, high = max(spec.least, -_WIDEST), min(spec.most, _WIDEST)
    if spec.kind == "number" and not spec.shape:
        # Only a parameter with a range refuses NaN.
        low = math.nextafter(spec.above, math.inf) if math.isfinite(spec.above) else low
        descriptor.floating_point_range = [FloatingPointRange(from_value=low, to_value=high)]
    if spec.kind == "integer":
        descriptor.integer_range = [IntegerRange(from_value=int(low), to_value=int(high))]
    return descriptor


def run(words: Sequence[str]) -> int:
    """Run a node until SIGINT, SIGTERM, its end or the end of its parent.

    The signal handlers of rclpy would cut the connection at once; ours let the worker close. Words
    are a key of `arguments.COMMANDS` and the arguments behind it. The exit status is 0, 1 for a
    failure, 2 for arguments that are refused.
    """
    signals.handle()
    command, *given = words
    if {"-h", "--help"} & set(given):
        print(arguments.help_text(command))
        return 0
    configure_middleware()
    try:
        ros = arguments.ros_arguments(command, given)
        for line in arguments.params_file_warnings(command, ros):
            print(f"{command}: {line}", file=sys.stderr)
        rclpy.init(args=[command, *ros], signal_handler_options=SignalHandlerOptions.NO)
    except (InputError, RuntimeError, ValueError) as error:  # the latter from rcl
        text = str(error) if isinstance(error, InputError) else str(error).splitlines()[0]
        print(text if text.startswith(command) else f"{command}: {text}", file=sys.stderr)
        return 2
    try:
        if not signals.came:
            module = importlib.import_module(f"sst_ros.nodes.{command}")
            spin(getattr(module, arguments.COMMANDS[command][0])())
    except (SstError, ParameterException) as error:
        print(f"{command}: {error}", file=sys.stderr)
        return 1
    finally:
        with _bound_time():
            rclpy.try_shutdown()
        signals.ignore()
    return 0


@contextlib.contextmanager
def _bound_time() -> Iterator[None]:
    """End the process, with a traceback and status 1, where the middleware hangs for ten seconds.

    Fast DDS 3.2 deadlocks now and then when another node leaves (eProsima/Fast-DDS issue 6502), and
    rclpy holds the interpreter's lock while it gives up a node: neither another thread nor a signal
    could end it from Python.
    """
    faulthandler.dump_traceback_later(_CLEAN_UP_S, exit=True, file=_STDERR)
    try:
        yield
    finally:
        faulthandler.cancel_dump_traceback_later()


class _Callbacks(threading.Thread):
    """Thread of the executor: it sleeps until there is work, where signals would not wake it.

    It runs callbacks until `end`, or until one fails, with this `error`.
    """

    def __init__(self, node: Node) -> None:
        super().__init__(name="executor", daemon=True)
        self.error: BaseException | None = None
        self._executor = SingleThreadedExecutor(context=node.context)
        self._executor.add_node(node)
        self._wake = node.create_guard_condition(lambda: None)
        self._ends = False

    def run(self) -> None:
        try:
            while not self._ends:
                self._executor.spin_once()
        except BaseException as error:
            self.error = error

    def end(self) -> None:
        """Begin no other callback; wait for the one in progress."""
        self._ends = True
        self._wake.trigger()
        self.join(_CALLBACK_S)

    def shut_down(self) -> None:
        self.join(_CALLBACK_S)
        self._executor.shutdown()


def spin(worker: Worker[Any]) -> None:
    """Run a worker until it is done or asked to end, or a callback raises; then close it."""
    callbacks = _Callbacks(worker.node)
    callbacks.start()
    try:
        while callbacks.is_alive() and not (signals.came or is_orphan()):
            if worker.done.wait(_POLL_S):
                break
        callbacks.end()
        if callbacks.error is not None:
            raise callbacks.error
    finally:
        try:
            worker.close()
        finally:
            with _bound_time():
                # What was published is received first, if that takes no longer than this.
                deadline = time.monotonic() + _ACKNOWLEDGE_S
                for publisher in worker.node.publishers:
                    left = max(0.0, deadline - time.monotonic())
                    publisher.wait_for_all_acked(Duration(seconds=left))
                callbacks.shut_down()
                worker.node.destroy_node()


def configure_middleware() -> None:
    """Select our profile of Fast DDS, unless the user has selected one. Before `rclpy.init`.

    By default a reliable writer asks its readers every 3 s what has arrived, and then removes 1500
    samples at once while the publisher waits: one to three milliseconds, hence missed ticks. Five
    times a second it takes a fifteenth of that; more often it would cost a thread that wakes for
    each topic.

    By default a reliable writer also wakes its thread for events after each message and reader, to
    ignore requests for it for a time of zero: half of what publishing costs. With 50 ms (the
    element's name is spelt as Fast DDS spells it) the thread wakes 20 times a second; a message
    that was lost is repeated that much later.

    Other middleware ignores the profile.
    """
    names = ("FASTRTPS_DEFAULT_PROFILES_FILE", "FASTDDS_DEFAULT_PROFILES_FILE")
    if any(os.environ.get(name) for name in names):
        return
    generation = 3
    with contextlib.suppress(PackageNotFoundError, ValueError):
        if int(version("rclpy").partition(".")[0]) < _FIRST_RCLPY_ON_FAST_DDS_3:
            generation = 2  # which has other names for both the variable and the setting
    os.environ[names[generation - 2]] = str(Path(__file__).with_name(f"fast_dds_{generation}.xml"))


def every(node: Node, seconds: float, callback: Callable[[], None]) -> Timer:
    """Call back by a clock that does not stand still with simulated time."""
    return node.create_timer(seconds, callback, clock=_STEADY)
