# SPDX-License-Identifier: Apache-2.0
"""ROS parameters from a `Section`: descriptors, bounds and the checked, frozen result."""

from __future__ import annotations

import dataclasses
import math
from array import array
from collections.abc import Callable
from typing import Any, TypeVar

from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor
from rcl_interfaces.msg import SetParametersResult as Result
from rclpy.exceptions import InvalidParameterTypeException, InvalidParameterValueException
from rclpy.node import Node
from rclpy.parameter import Parameter

from sst_ros.errors import InputError, Problem
from sst_ros.nodes import arguments
from sst_ros.scene.schema import Section, Spec, specs

P = TypeVar("P", bound=Section)

_TYPES = {
    "number": Parameter.Type.DOUBLE,
    "integer": Parameter.Type.INTEGER,
    "flag": Parameter.Type.BOOL,
    "text": Parameter.Type.STRING,
    "choice": Parameter.Type.STRING,
    "texts": Parameter.Type.STRING_ARRAY,
}
_WIDEST = 1e300


def declare(
    node: Node,
    cls: type[P],
    changed: Callable[[P], None] | None = None,
    more_defaults: Callable[[dict[str, Any]], dict[str, Any]] = lambda given: {},
) -> P:
    """Declare every field of `cls` on the node and return the values.

    Fields are read-only, except those of `cls.CHANGEABLE`. When one of them is set, `changed` gets
    all values, checked as at the start.

    Args:
        node: the node.
        cls: its parameters.
        changed: called with the values after a change.
        more_defaults: returns defaults that depend on the values given at the start.

    Raises:
        InputError: values given at the start are refused, or names are unknown; lists all of them.

    """
    defaults = cls()
    # rclpy has no public call for the values that were given; Jazzy and Kilted have this.
    given: dict[str, Any] = {
        name: parameter.value for name, parameter in node._parameter_overrides.items()
    }
    changeable = getattr(cls, "CHANGEABLE", ())
    values: dict[str, Any] = {}
    problems: list[Problem] = []
    more = more_defaults(given)
    for name, spec in specs(cls).items():
        default = more.get(name, getattr(defaults, name))
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
        elif not arguments.is_foreign(name):
            problems.append(arguments.unknown_parameter(name, [*values]))
    if problems:
        raise InputError(node.get_fully_qualified_name(), problems)
    try:
        result = cls(**values)
    except InputError as error:
        raise InputError(node.get_fully_qualified_name(), error.problems) from None
    _watch(node, result, changed)
    return result


def _watch(node: Node, start: P, changed: Callable[[P], None] | None) -> None:
    """Check values that are set at run time, and pass them on."""
    held = [start]

    def check(given: list[Parameter[Any]]) -> Result:
        known = specs(type(start))
        values = {parameter.name: parameter.value for parameter in given}
        if "use_sim_time" in values:
            reason = "use_sim_time is read when the node starts, and cannot be changed"
            return Result(successful=False, reason=reason)
        mine = {name: value for name, value in values.items() if name in known}
        try:
            result = dataclasses.replace(held[0], **mine)
        except InputError as error:
            return Result(successful=False, reason=str(error))
        if mine and changed is not None:
            held[0] = result
            changed(result)
        return Result(successful=True)

    node.add_on_set_parameters_callback(check)


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
