# SPDX-License-Identifier: Apache-2.0
"""Many scenes as one program: a number that differs between them becomes an input.

What is the same in all scenes stays a constant that `trace` folds, so a family pays for what varies
and for nothing else. A term that only some of the scenes have is there for all: the others have
coefficients of zero, which change no bit.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property, reduce
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sst_ros.dynamics import energy, kernel
from sst_ros.dynamics.expression import Expression, Program, trace
from sst_ros.dynamics.limits import Limit, limits_of
from sst_ros.dynamics.traced_dynamics import QUATERNION, RATE, Dynamics
from sst_ros.errors import InputError, Problem
from sst_ros.integration.limit_source import margins
from sst_ros.integration.ode import ODE
from sst_ros.integration.scenario_columns import numbers_of
from sst_ros.integration.scenario_constants import (
    Constants,
    Member,
    Places,
    alike,
    constants_of,
    joined,
    member_of,
    rebuilt,
    table,
)
from sst_ros.integration.scenarios import Variants
from sst_ros.mechanism.geometry import Array, Geometry
from sst_ros.scene.scene import Scene


class Present(Expression):
    """A number that differs between scenes: not all have zero there, so all have its term."""

    __slots__ = ()

    def __bool__(self) -> bool:
        return True


class Family:
    """Scenes as one program, and a column of its inputs for each.

    Args:
        variants: the scenes.
        profile: whether the scenes' own torques act.
        progress: draw a bar on a terminal.

    Attributes:
        scene: one of them, for what all have in common.
        system: what is integrated, for the names of its state and drive.
        columns: the numbers that differ, shape (numbers, N).
        geometries: the distinct ones.
        geometry: number of the geometry of each row, shape (N,).
        torque_limit: largest torque of an actuator [N m], infinite without one, shape (N,).

    Raises:
        InputError: rows make no scene, or actuators cannot give the torques of the profile.

    """

    def __init__(self, variants: Variants, *, profile: bool, progress: bool = False) -> None:
        self.geometries: list[Geometry] = []
        self._limits: dict[int, tuple[Limit, ...]] = {}
        kinds: dict[bytes, tuple[Constants, list[tuple[int, Array]]]] = {}
        known: dict[bytes, int] = {}
        count = variants.count or 1
        self.geometry: NDArray[np.intp] = np.zeros(count, dtype=np.intp)
        self.torque_limit: Array = np.empty(count)
        regular, together = _together(variants, profile)
        single = np.ones(count, dtype=bool)
        single[regular[1:]] = False
        alone = np.flatnonzero(single).tolist()
        for row, scene in variants.scenes(alone, progress):
            member = member_of(scene, profile=profile)
            _refuse_clamped(scene, member, f"scenario {row}: " if variants.keys else "")
            here = self.geometry[row] = known.setdefault(member.shape, len(known))
            if here == len(self.geometries):
                self.geometries.append(member.geometry)
            if row in regular[:1]:
                self.geometry[regular] = here
            terms = np.isnan(member.numbers).tobytes()
            if row not in regular[:1]:
                kinds.setdefault(terms, (member.constants, []))[1].append((row, member.numbers))
            self.torque_limit[row] = member.torque_limit
            self.scene = scene
        members = [
            (constants, np.array([row for row, _ in rows]), np.stack([n for _, n in rows], axis=1))
            for constants, rows in kinds.values()
        ]
        if together is not None:
            constants, columns, limit = together
            self.torque_limit[regular] = limit
            if members:
                members.append((constants, regular, numbers_of(columns, len(regular))))
        torque = self.scene.torque if profile else None
        dynamics = Dynamics.of(self.scene)
        self.system, self._moved = ODE(dynamics, torque), dynamics.moved
        everywhere: Places
        numbers: Sequence[Any] | Array
        if members:
            self._tree: Constants = reduce(joined, [constants for constants, _, _ in members])
            everywhere, numbers = table(members)
        else:
            assert together is not None
            self._tree = constants
            everywhere, numbers = alike(constants, columns)
        differ = [i for i, row in enumerate(numbers) if np.max(row) != np.min(row)]
        self.columns: Array = np.array([numbers[i] for i in differ]).reshape(len(differ), count)
        self._fixed = {
            place: float(np.ravel(row)[0]) for place, row in zip(everywhere, numbers, strict=True)
        }
        self._varied = [everywhere[i] for i in differ]
        self._names = tuple(f"p{i}" for i in range(len(differ)))

    def limits(self, row: int) -> tuple[Limit, ...]:
        """Return the limits of a row; only their ends differ between rows."""
        number = int(self.geometry[row % len(self.geometry)])
        if number not in self._limits:
            self._limits[number] = tuple(limits_of(self.scene, self.geometries[number]))
        return self._limits[number]

    @cached_property
    def program(self) -> Program:
        """Derivative of the state; inputs t, state, drive, and the numbers that differ."""
        known = ("t", *self.system.state, *self.system.drive)

        def slope(*inputs: Expression) -> tuple[Any, ...]:
            at = self._constants(inputs[len(known) :])
            system = ODE(Dynamics(at.model, moved=self._moved), at.torque)
            return system.derivative(*inputs[: len(known)])

        return trace(slope, (*known, *self._names))

    @cached_property
    def margins(self) -> Program:
        """Distances to the limits; inputs are quaternion, body rate and the numbers that differ."""
        limits = self.limits(0)

        def signs(*inputs: Expression) -> tuple[Any, ...]:
            at = self._constants(inputs[7:])
            return margins(limits, at.ends, at.model, inputs[:7])

        return trace(signs, (*QUATERNION, *RATE, *self._names))

    @cached_property
    def outputs(self) -> Program:
        """Angles and rates of the joints (18 numbers) and the energy [J]; inputs as `margins`."""

        def values(*inputs: Expression) -> tuple[Any, ...]:
            model, state = self._constants(inputs[7:]).model, inputs[:7]
            joints = [number for triple in kernel.joints(model, state) for number in triple]
            return (*joints, energy.kinetic(model, state) + energy.potential(model, state))

        return trace(values, (*QUATERNION, *RATE, *self._names))

    @property
    def torque_columns(self) -> Any:
        """Torques of the profile, numbers or a column where they differ; None without a profile."""
        numbers: dict[Any, Any] = self._fixed | dict(zip(self._varied, self.columns, strict=True))
        return rebuilt(self._tree, numbers).torque

    def _constants(self, inputs: Sequence[Expression]) -> Constants:
        """Return the constants, with expressions where they differ."""
        present = (Present(entry.graph, entry.index) for entry in inputs)
        numbers: dict[Any, Any] = self._fixed | dict(zip(self._varied, present, strict=True))
        tree: Constants = rebuilt(self._tree, numbers)
        return tree


def _together(
    variants: Variants, profile: bool
) -> tuple[NDArray[np.intp], tuple[Constants, Constants, Any] | None]:
    """Rows that are prepared as arrays: constants of the first, columns and torque limits of all.

    The first of them is made a scene as well, for what all have in common.
    """
    rows, columns = variants.regular()
    if len(rows) < 2:
        return rows[:0], None
    scene = variants.scene(int(rows[0]))
    actuators = columns.actuators
    limit = None if actuators is None else actuators.torque_limit
    limit = np.inf if limit is None else limit
    if profile and np.any(np.max(np.abs(_stacked(columns.torque.amplitude)), axis=0) > limit):
        return rows[:0], None
    own = member_of(scene, profile=profile)
    return rows, (
        own.constants,
        constants_of(scene, columns, own.geometry, profile=profile),
        limit,
    )


def _stacked(triple: Any) -> Array:
    return np.array(np.broadcast_arrays(*triple))


def _refuse_clamped(scene: Scene, member: Member, where: str) -> None:
    """Refuse a profile that actuators would clamp: a fixed step knows nothing of the kinks."""
    torque, limit = member.constants.torque, member.torque_limit
    if torque is not None and max(map(abs, torque.amplitude)) > limit:
        allowed = f"must not be less than the amplitudes {torque.amplitude} of a batch's profile"
        raise InputError(scene.name, [Problem(f"{where}actuators.torque_limit", limit, allowed)])
