# SPDX-License-Identifier: Apache-2.0
"""Many scenarios of one scene: as documents, and as one program whose inputs are what differs.

A row of each array makes a scene, which meets all requirements of a document. What has no effect
in a row is left out of it, as documents demand: a friction whose coefficients are zero there, the
gear of a rotor without inertia. In the program what is the same in all scenarios stays a constant
that `trace` folds, so a batch computes only what varies. A term whose coefficients are zero in some
scenarios changes no bit there.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sst_ros.dynamics import kernel
from sst_ros.dynamics.expression import (
    Expression,
    Program,
    compile_for_arrays,
    leaves,
    rebuild,
    trace,
)
from sst_ros.dynamics.model import Limit, damping_of, limits_of
from sst_ros.dynamics.traced_dynamics import ODE, QUATERNION, RATE, Dynamics
from sst_ros.errors import InputError, Problem
from sst_ros.host.output import slices
from sst_ros.integration.events import limit_distances
from sst_ros.mechanism.geometry import Array, Geometry
from sst_ros.scene.loads import SineTorque
from sst_ros.scene.scene import LARGEST, SMALLEST, Scene
from sst_ros.scene.schema import Place, Spec
from sst_ros.scene.yaml_document import (
    NO_NUMBER,
    broken_rows,
    build,
    find_fields,
    open_values,
    replace_values,
    values_of,
)
from sst_ros.state import Joints

OUTPUTS = (*Joints._fields, "energy")
"""Quantities of a state that depend on the numbers of its scenario."""

_OF_GEOMETRY = ("base.v", "star.alpha_deg", "workspace.beta_max_deg")

_MOST_PROBLEMS = 10


class Scenarios:
    """Scenarios of a scene by row.

    Args:
        scene: the document.
        parameters: numbers by their keys in the document, as in "star.mass", "springs[0].rest" or
            "gravity.acceleration": first the row, then what one scene has, so shape (N,), (N, 3) or
            (N, 3, 3). A list without an index means all of its entries.

    Attributes:
        document: the scene.
        rows: the arrays by key.
        count: number of rows N; None where nothing varies.

    Raises:
        InputError: a key names no number of the scene, or an array has another shape.

    """

    def __init__(self, scene: Scene, parameters: Mapping[str, ArrayLike]) -> None:
        self.document = scene
        self.count: int | None = None
        self.rows: dict[str, Array] = {}
        self._specs: dict[str, Spec] = {}
        self._values = values_of(scene)
        problems, taken = [], set[Place]()
        for key, value in parameters.items():
            try:
                for place, _, spec in find_fields(scene, key):
                    if spec.kind != "number":
                        raise ValueError(NO_NUMBER)
                    if place in taken:
                        raise ValueError("is given twice")
                    taken.add(place)
                self._specs[key] = spec
                self.rows[key] = rows = _rows(value, spec, self.count)
                self.count = len(rows)
            except ValueError as error:
                problems.append(Problem(key, value, str(error)))
        if problems:
            raise InputError(scene.name, problems)

    def scene(self, row: int) -> Scene:
        """Build the scene of a row.

        Raises:
            InputError: the numbers of this row make no scene; names each and what is allowed.

        """
        values = {key: rows[row].tolist() for key, rows in self.rows.items()}
        try:
            return build(Scene, replace_values(self._values, values), "", of_row=True)
        except InputError as error:
            faults = [replace(one, key=f"scenario {row}: {one.key}") for one in error.problems]
            raise InputError(self.document.name, faults) from None

    def columns(self) -> Any:
        """Return the document with arrays for the numbers that vary."""
        columns = {key: _components(rows) for key, rows in self.rows.items()}
        return open_values(Scene, replace_values(self._values, columns))

    def faults(
        self, *, progress: bool = False, most: int = _MOST_PROBLEMS
    ) -> dict[int, InputError]:
        """Rows that make no scene, and why; no more than `most` rows are looked for."""
        if self.count is None:
            return {}
        unknown, faults = np.flatnonzero(self._doubtful()).tolist(), {}
        for part in slices(len(unknown), 0, f"{self.document.name}, preparing", progress):
            for row in unknown[part]:
                try:
                    self.scene(row)
                except InputError as error:
                    faults[row] = error
                if len(faults) == most:
                    return faults
        return faults

    def _doubtful(self) -> NDArray[np.bool_]:
        """Rows whose scene may be refused: a zero may refuse a number, or leave its section out."""
        doubtful = np.zeros(self.count or 0, dtype=bool)
        for key, values in self.rows.items():
            spec, flat = self._specs[key], values.reshape(len(values), -1)
            least = max(SMALLEST if spec.above == 0.0 else spec.least, -LARGEST)
            most = min(spec.most, LARGEST)
            if not (flat.min() >= least and flat.max() <= most):  # a nan is neither
                doubtful |= ~np.all((flat >= least) & (flat <= most), axis=1)
        return np.asarray(doubtful | broken_rows(Scene, self.columns()))

    def check(self, *, progress: bool = False) -> None:
        """Raise InputError with the first ten problems if rows make no scene."""
        errors = self.faults(progress=progress).values()
        if problems := [problem for error in errors for problem in error.problems]:
            raise InputError(self.document.name, problems[:_MOST_PROBLEMS])


def _rows(value: ArrayLike, spec: Spec, count: int | None) -> Array:
    words = ", ".join(map(str, (count or "N", *spec.shape))) + ("" if spec.shape else ",")
    try:
        rows = np.asarray(value, dtype=float)
    except TypeError as error:
        raise ValueError(str(error)) from None
    number = count or max(1, len(np.atleast_1d(rows)))
    if rows.shape != (number, *spec.shape):
        raise ValueError(f"must have the shape ({words}), a row a scenario; it has {rows.shape}")
    return rows


def _components(values: Array) -> Any:
    """Contiguous columns (N,) of an array (N, ...), nested tuples where it has more dimensions."""
    if values.ndim == 1:
        return values
    return tuple(_components(np.ascontiguousarray(values[:, i])) for i in range(values.shape[1]))


class Constants(NamedTuple):
    """All numbers that the traced programs of a scene are made of: a tree of numbers or columns."""

    model: kernel.Model
    ends: tuple[tuple[float, float], ...]  # cosine and sine of the end of each of `limits_of`
    torque: SineTorque | None  # the scene's own over time; None where it does not act


def _with_damping(stroke: Any) -> Any:
    """Elastic stops with the damping that their restitution gives, row by row if it varies."""
    varied = (stroke.restitution, stroke.impact_rate)
    if not any(isinstance(value, np.ndarray) for value in varied):
        return stroke
    pairs = zip(*np.broadcast_arrays(*varied), strict=True)
    rows = [SimpleNamespace(restitution=float(e), impact_rate=float(v)) for e, v in pairs]
    damping = np.array([damping_of(row) for row in rows])  # type: ignore[arg-type]
    return SimpleNamespace(**vars(stroke) | {"damping": damping, "restitution": None})


class VariedNumber(Expression):
    """A number that differs between scenarios: it counts as nonzero, so its term is present."""

    __slots__ = ()

    def __bool__(self) -> bool:
        return True


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
        self._tree, numbers = self._numbers(scenarios)
        varied = [place for place, value in numbers.items() if _varies(value)]
        self._varied = dict(zip(varied, (f"p{i}" for i in range(len(varied))), strict=True))
        self._fixed = {place: float(np.ravel(value)[0]) for place, value in numbers.items()}
        dynamics = Dynamics.of(self.scene)
        self._has_moment_topic = dynamics.has_moment_topic
        self._functions: dict[tuple[str, ...], Callable[..., tuple[Any, ...]]] = {}
        self.ode = ODE(dynamics, self.scene.torque if profile else None)
        self._limits = self.limits(Geometry.of(self.scene))

    def columns(self, scenarios: Scenarios) -> ParameterColumns:
        """Return the numbers of scenarios.

        Raises:
            InputError: actuators cannot give the torques of the profile, or a number differs that
                does not in the scenarios that this model was made from.

        """
        _, numbers = self._numbers(scenarios)
        count = scenarios.count or 1
        inputs = np.empty((len(self._varied), count))
        for row, place in zip(inputs, self._varied, strict=True):
            row[:] = numbers[place]
            if place[-1] == "static":
                # static = 0 is no breakaway torque, which is as if it were the Coulomb torque.
                level: Place = (*place[:-1], "coulomb")
                row[:] = np.where(row == 0.0, numbers[level], row)
            elif place[-1] == "rest":
                np.nan_to_num(row, copy=False)  # of a spring without stiffness any will do
        for place in numbers.keys() - self._varied.keys():
            value = numbers[place]
            if isinstance(value, np.ndarray) and not np.all(value == self._fixed[place]):
                allowed = f"must be {self._fixed[place]} in all scenarios of this model"
                raise InputError(self.scene.name, [Problem(str(place), value, allowed)])
        if np.any(numbers.get(("model", "time_constant"), 1.0) == 0.0):
            allowed = "must be > 0 [s] in every scenario, or in none"
            raise InputError(self.scene.name, [Problem("actuators.time_constant", 0.0, allowed)])
        limit = self._torque_limit(scenarios, numbers)
        return ParameterColumns(inputs, *_geometries(scenarios), limit)

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

    def output_function(self, names: tuple[str, ...]) -> Callable[..., tuple[Any, ...]]:
        """Return a function of arrays: quantities of OUTPUTS by name; inputs as `limit_distances`.

        Three angles [rad] or rates [rad/s] each, or the energy [J].
        """

        def values(*inputs: Expression) -> tuple[Any, ...]:
            model, state = self.constants(inputs[7:]).model, inputs[:7]
            found = kernel.joints(model, state)._asdict()
            found["energy"] = (
                kernel.kinetic_energy(model, state) + kernel.potential_energy(model, state),
            )
            return tuple(number for name in names for number in found[name])

        if names not in self._functions:
            program = trace(values, (*QUATERNION, *RATE, *self.names))
            self._functions[names] = compile_for_arrays(program)
        return self._functions[names]

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the varied numbers."""
        return tuple(self._varied.values())

    def constants(self, inputs: Sequence[Any]) -> Constants:
        """Return the constants, with expressions or columns where they differ."""
        given = [
            VariedNumber(entry.graph, entry.index) if isinstance(entry, Expression) else entry
            for entry in inputs
        ]
        numbers: dict[Any, Any] = self._fixed | dict(zip(self._varied, given, strict=True))
        tree: Constants = rebuild(self._tree, lambda place, _: numbers[place])
        return tree

    def _numbers(self, scenarios: Scenarios) -> tuple[Constants, dict[Place, Any]]:
        """Constants of scenarios as a tree, and its numbers or columns by place."""
        geometries, which = _geometries(scenarios)
        columns, geometry = scenarios.columns(), geometries.of_rows(which)
        columns.stroke = _with_damping(columns.stroke)
        limits = limits_of(self.scene, geometry)
        ends = tuple((np.cos(limit.end), np.sin(limit.end)) for limit in limits)
        with np.errstate(invalid="ignore"):  # 0/0 is the rest of springs without stiffness
            model = kernel.model_of(columns, geometry)
        tree = Constants(model, ends, columns.torque if self._profile else None)
        return tree, dict(leaves(tree))

    def _torque_limit(self, scenarios: Scenarios, numbers: dict[Place, Any]) -> Array:
        """Torque limits of scenarios; refuses those that would clamp a profile.

        A fixed step does not resolve the kinks of a clamped torque.
        """
        actuators = scenarios.columns().actuators
        given = None if actuators is None else actuators.torque_limit
        limit = np.full(scenarios.count or 1, np.inf if given is None else given, dtype=float)
        limit[limit == 0.0] = np.inf  # of actuators that are left out
        if self._profile:
            amplitudes = [numbers["torque", "amplitude", k] for k in range(3)]
            largest = np.max(np.abs(np.array(np.broadcast_arrays(*amplitudes, limit)[:3])), axis=0)
            if len(clamped := np.flatnonzero(largest > limit)):
                row = int(clamped[0])
                where = f"scenario {row}: " if scenarios.count else ""
                allowed = f"must not be less than the amplitude {largest[row]} of the profile"
                problem = Problem(f"{where}actuators.torque_limit", float(limit[row]), allowed)
                raise InputError(self.scene.name, [problem])
        return limit


def _varies(value: Any) -> bool:
    return isinstance(value, np.ndarray) and bool(np.max(value) != np.min(value))


def _geometries(scenarios: Scenarios) -> tuple[Geometry, NDArray[np.intp]]:
    """Return the distinct geometries, and the index of that of each row."""
    scene, count, rows = scenarios.document, scenarios.count or 1, scenarios.rows
    varied = [rows[key].reshape(count, -1) for key in _OF_GEOMETRY if key in rows]
    if not varied:
        return Geometry.of(scene), np.zeros(count, dtype=np.intp)
    _, first, index = np.unique(np.hstack(varied), axis=0, return_index=True, return_inverse=True)
    nominal = scene.base.v, scene.star.alpha_deg, scene.workspace.beta_max_deg
    v, alpha, beta = (
        rows[key][first] if key in rows else np.repeat([value], len(first), axis=0)
        for key, value in zip(_OF_GEOMETRY, nominal, strict=True)
    )
    found = Geometry.build(v, np.radians(alpha), np.radians(beta))
    if len(first) == 1:  # one for all rows: its numbers are no columns
        found = Geometry.build(found.v[0], found.alpha[0], found.beta_max[0])
    return found, index.ravel()
