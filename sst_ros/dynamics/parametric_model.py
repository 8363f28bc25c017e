# SPDX-License-Identifier: Apache-2.0
"""One program for many scenarios of a scene, whose inputs are the numbers that differ.

What is the same in all scenarios stays a constant that `trace` folds, so a batch computes only what
varies. A term whose coefficients are zero in some scenarios changes no bit there.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sst_ros.dynamics import kernel
from sst_ros.dynamics.expression import (
    Expression,
    Program,
    compile_for_arrays,
    mark_present,
    trace,
)
from sst_ros.dynamics.model import Limit, limits_of
from sst_ros.dynamics.traced_dynamics import ODE, QUATERNION, RATE, Dynamics, limit_distances
from sst_ros.errors import InputError, Problem
from sst_ros.mechanism.geometry import Array, Geometry
from sst_ros.scene.loads import SineTorque
from sst_ros.scene.scene import Scenarios
from sst_ros.scene.schema import Place, leaves, rebuild
from sst_ros.state import Joints

OUTPUTS = (*Joints._fields, "energy")
"""Quantities of a state that depend on the numbers of its scenario."""


class Constants(NamedTuple):
    """All numbers that the traced programs of a scene are made of: a tree of numbers or columns."""

    model: kernel.Model
    ends: tuple[tuple[float, float], ...]  # cosine and sine of the end of each of `limits_of`
    torque: SineTorque | None  # the scene's own over time; None where it does not act


class ParameterColumns(NamedTuple):
    """Numbers of the scenarios of a batch."""

    inputs: Array  # the program's varied numbers, shape (numbers, N)
    geometries: Geometry  # the distinct ones, or one for all rows
    geometry: NDArray[np.intp]  # index of the geometry of each row, shape (N,)
    torque_limit: Array  # largest torque of an actuator [N m], infinite without one, shape (N,)


class ParametricModel:
    """The programs of a scene, with the numbers that differ between scenarios as inputs.

    With `profile` the scene's own torques act. `ode` has the names of the state and the drive.
    """

    def __init__(self, scenarios: Scenarios, *, profile: bool) -> None:
        self.scene, self._profile = scenarios.document, profile
        self._tree = self._constants_of(scenarios, *Geometry.of_scenarios(scenarios))
        numbers = leaves(self._tree)
        varied = [place for place, value in numbers.items() if np.max(value) != np.min(value)]
        self._varied = {place: f"p{i}" for i, place in enumerate(varied)}
        self._fixed = {place: float(np.ravel(value)[0]) for place, value in numbers.items()}
        dynamics = Dynamics.of(self.scene)
        self._has_moment_topic = dynamics.has_moment_topic
        self.ode = ODE(dynamics, self.scene.torque if profile else None)
        self._limits = self.limits(Geometry.of(self.scene))

    def columns(self, scenarios: Scenarios) -> ParameterColumns:
        """Return the numbers of scenarios.

        Refused are actuators that cannot give the torques of the profile, and numbers that differ
        but do not in the scenarios that this model was made from.
        """
        geometries, which = Geometry.of_scenarios(scenarios)
        tree = self._constants_of(scenarios, geometries, which)
        numbers = leaves(tree)
        inputs = np.empty((len(self._varied), len(which)))
        for row, place in zip(inputs, self._varied, strict=True):
            row[:] = numbers[place]
            if place[-1] == "static":
                # static = 0 is no breakaway torque, which is as if it were the Coulomb torque.
                level: Place = (*place[:-1], "coulomb")
                row[:] = np.where(row == 0.0, numbers[level], row)
            elif place[-1] == "rest":
                np.nan_to_num(row, copy=False)  # of a spring without stiffness any will do
        problems = [
            Problem(str(place), numbers[place], f"must be {fixed} in all scenarios of this model")
            for place, fixed in self._fixed.items()
            if place not in self._varied and not np.all(numbers[place] == fixed)
        ]
        if np.any(tree.model.time_constant == 0.0):
            allowed = "must be > 0 [s] in every scenario, or in none"
            problems.append(Problem("actuators.time_constant", 0.0, allowed))
        actuators = scenarios.columns().actuators
        given = None if actuators is None else actuators.torque_limit
        limit = np.full(len(which), np.inf if given is None else given)
        limit[limit == 0.0] = np.inf  # of actuators that are left out
        if tree.torque is not None:  # a fixed step does not resolve the kinks of a clamped torque
            amplitudes = np.array(np.broadcast_arrays(*tree.torque.amplitude, limit)[:3])
            largest = np.abs(amplitudes).max(axis=0)
            if len(clamped := np.flatnonzero(largest > limit)):
                n = int(clamped[0])
                where = f"scenario {n}: " if scenarios.count else ""
                allowed = f"must not be less than the amplitude {largest[n]} of the profile"
                problems.append(Problem(f"{where}actuators.torque_limit", float(limit[n]), allowed))
        if problems:
            raise InputError(self.scene.name, problems)
        return ParameterColumns(inputs, geometries, which, limit)

    def limits(self, geometry: Geometry) -> tuple[Limit, ...]:
        """Return the limits of scenarios with this geometry."""
        return tuple(limits_of(self.scene, geometry))

    @cached_property
    def program(self) -> Program:
        """Derivative of the state; inputs t, state, drive, and the varied numbers."""
        known = ("t", *self.ode.state, *self.ode.drive)

        def slope(*inputs: Expression) -> tuple[Any, ...]:
            at = self.constants(inputs[len(known) :])
            ode = ODE(Dynamics(at.model, has_moment_topic=self._has_moment_topic), at.torque)
            return ode.derivative(*inputs[: len(known)])

        return trace(slope, (*known, *self.names))

    @cached_property
    def limit_distances(self) -> Program:
        """Distances to the limits, and their rates; inputs: state (7) and the varied numbers."""

        def values(*inputs: Expression) -> tuple[Any, ...]:
            at = self.constants(inputs[7:])
            return limit_distances(self._limits, at.ends, at.model, inputs[:7])

        return trace(values, (*QUATERNION, *RATE, *self.names))

    @cached_property
    def outputs(self) -> dict[str, Callable[..., tuple[Any, ...]]]:
        """Functions of arrays for quantities of OUTPUTS by name; inputs as `limit_distances`.

        Three angles [rad] or rates [rad/s] each, or the energy [J].
        """

        def values(*inputs: Expression) -> tuple[Any, ...]:
            model, state = self.constants(inputs[7:]).model, inputs[:7]
            joints = (number for kind in kernel.joints(model, state) for number in kind)
            kinetic = kernel.kinetic_energy(model, state)
            return (*joints, kinetic + kernel.potential_energy(model, state))

        whole = trace(values, (*QUATERNION, *RATE, *self.names))
        parts = [replace(whole, outputs=whole.outputs[i : i + 3]) for i in range(0, 19, 3)]
        programs = zip(OUTPUTS, parts, strict=True)
        return {name: compile_for_arrays(program.prune()) for name, program in programs}

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the varied numbers."""
        return tuple(self._varied.values())

    def constants(self, inputs: Sequence[Any]) -> Constants:
        """Return the constants, with expressions or columns where they differ."""
        given = dict(zip(self._varied, map(mark_present, inputs), strict=True))
        tree: Constants = rebuild(self._tree, self._fixed | given)
        return tree

    def _constants_of(
        self, scenarios: Scenarios, geometries: Geometry, which: NDArray[np.intp]
    ) -> Constants:
        columns, geometry = scenarios.columns(), geometries.of_rows(which)
        limits = limits_of(self.scene, geometry)
        ends = tuple((np.cos(limit.end), np.sin(limit.end)) for limit in limits)
        with np.errstate(invalid="ignore"):  # 0/0 is the rest of springs without stiffness
            model = kernel.model_of(columns, geometry)
        return Constants(model, ends, columns.torque if self._profile else None)
