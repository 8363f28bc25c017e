# SPDX-License-Identifier: Apache-2.0
"""ROS parameters from a `Section`: descriptors, bounds and the checked, frozen result."""

from __future__ import annotations

import dataclasses
import math
from array import array
from collections.abc import Callable
from typing import TypeVar

from rcl_interfaces.msg import (
    FloatingPointRange,
    IntegerRange,
    ParameterDescriptor,
    SetParametersResult,
)
from rclpy.exceptions import InvalidParameterTypeException, InvalidParameterValueException
from rclpy.node import Node
from rclpy.parameter import Parameter

from sst_ros.errors import InputError, Problem
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


def declare(node: Node, cls: type[P], changed: Callable[[P], None] | None = None) -> P:
    """Declare every field of `cls` on the node and return the values.

    Fields are read-only, but those that `cls.CHANGEABLE` names. When one of them is set, `changed`
    gets all values anew, checked as at the start.

    Raises:
        InputError: values given at start are refused; lists all of them.

    """
    defaults = cls()
    # rclpy has no public way to what was given; it is the same on Jazzy and Kilted.
    given = {name: parameter.value for name, parameter in node._parameter_overrides.items()}
    changeable = getattr(cls, "CHANGEABLE", ())
    values, problems = {}, []
    for name, spec in specs(cls).items():
        default = getattr(defaults, name)
        value = given.get(name, list(default) if isinstance(default, tuple) else default)
        if spec.kind == "number":  # "-p duration:=1" means 1.0
            value = float(value) if type(value) is int else value
            value = list(map(float, value)) if isinstance(value, array) else value
        try:
            node.declare_parameter(
                name, value, _descriptor(name, spec, name not in changeable), ignore_override=True
            )
        except (InvalidParameterTypeException, InvalidParameterValueException):
            problems.append(Problem(name, value, spec.allowed()))
        values[name] = value
    for name in given.keys() - values.keys() - node._parameters.keys():
        known = ", ".join(values)
        node.get_logger().warning(f"parameter {name} is unknown and not used; known are {known}")
    if problems:
        raise InputError(node.get_fully_qualified_name(), problems)
    try:
        result = cls(**values)
    except InputError as error:
        raise InputError(node.get_fully_qualified_name(), error.problems) from None
    _watch(node, result, changed)
    return result


def _watch(node: Node, start: P, changed: Callable[[P], None] | None) -> None:
    """Check what is set at run time, and pass it on."""
    held = [start]

    def check(given: list[Parameter]) -> SetParametersResult:
        known = specs(type(start))
        values = {parameter.name: parameter.value for parameter in given}
        if "use_sim_time" in values:
            reason = "use_sim_time is read when the node starts, and cannot be changed"
            return SetParametersResult(successful=False, reason=reason)
        mine = {name: value for name, value in values.items() if name in known}
        try:
            result = dataclasses.replace(held[0], **mine)
        except InputError as error:
            return SetParametersResult(successful=False, reason=str(error))
        if mine and changed is not None:
            held[0] = result
            changed(result)
        return SetParametersResult(successful=True)

    node.add_on_set_parameters_callback(check)


def _descriptor(name: str, spec: Spec, read_only: bool) -> ParameterDescriptor:
    unit = f" [{spec.unit}]" if spec.unit else ""
    descriptor = ParameterDescriptor(
        name=name,
        type=(Parameter.Type.DOUBLE_ARRAY if spec.shape else _TYPES[spec.kind]).value,
        description=spec.doc + unit,
        additional_constraints=spec.allowed(),
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
