# SPDX-License-Identifier: Apache-2.0
"""The steps of one scene by one method, on plain floats or compiled.

Code is made once for each method and each structure of a scene - its terms, and which numbers are 0
or 1 - which takes seconds, and kept in `cache_folder()`; to load it takes tenths of a second.
"""

from __future__ import annotations

import fcntl
import inspect
import math
from collections.abc import Callable, Iterator, Sequence
from functools import lru_cache
from operator import is_
from types import ModuleType
from typing import Any, NamedTuple

import numpy as np

from sst_ros.dynamics.expression import Slots
from sst_ros.dynamics.traced_dynamics import LAG, ODE, Dynamics, ode_with_work
from sst_ros.host.cache_folder import cache_folder
from sst_ros.integration import codegen, step_loops
from sst_ros.integration.methods import (
    DOP853,
    DORMAND_PRINCE,
    METHODS,
    RODAS5P,
    Rosenbrock,
    Tableau,
)
from sst_ros.scene.scene import Scene

Method = Tableau | Rosenbrock
Vector = Sequence[float]
Function = Callable[..., tuple[float, ...]]
Linearisation = Callable[[float, Vector, Vector, Any, Any, Any, Any], None]
"""(t, y, d, numbers, slope, by_time, matrix) -> None: fills the derivative, df/dt and df/dy, which
are zero before."""
JointRanges = Sequence[tuple[int, float, float]]
JACOBIAN_COST = 30
"""Evaluations that a Jacobian with its factorisation counts as: measured in plain Python."""
_LANES = 4
"""The loop over the columns of a Jacobian is a multiple of this long: numbers in a register."""


_SHARED = (step_loops.size_of, step_loops.normalise, step_loops.all_far)
_LOOPS = (
    step_loops.step_pair,
    step_loops.step_fixed,
    step_loops.step_many,
    step_loops.step_sequence,
)
_IMPLICIT = (step_loops.factorise, step_loops.substitute, step_loops.attempt_linearly_implicit)


class Point(NamedTuple):
    """Solution y, coarse solution z by a method of that order, nine angles and nine rates."""

    y: list[float]
    z: list[float]
    joints: tuple[float, ...]
    order: int

    def coarse(self, order: int) -> list[float]:
        """Return z moved so that with a method of that order it means the same error."""
        if order == self.order:
            return self.z
        grow = (2.0**order - 1.0) / (2.0**self.order - 1.0)
        return [a + grow * (b - a) for a, b in zip(self.y, self.z, strict=True)]


class _MethodSource(NamedTuple):
    """Functions of a module, one text each, in the order of their calls; constants; numbers.

    `base` has what the modules of all methods have in common.
    """

    base: codegen.SharedFunctions
    texts: list[str]
    constants: dict[str, Any]
    numbers: list[float]


class CompiledMethod:
    """Steps of a system by a method.

    Args:
        system: what is integrated.
        method: how.
        compiled: by numba; otherwise, or where there is no numba, as plain Python.
        derivative: rhs(t, state.., drive..) to use instead of the ODE's, in plain Python.
        linearise: the derivatives of `derivative`, which a Rosenbrock method needs.
        ranges: joints that `step_many` looks at, see `limits.ranges_of`.

    Attributes:
        system, method, compiled: as given.
        pair_cost: evaluations of `step_pair`, which takes three steps.
        sizes: local error estimates of the periods of the last `step_many`.

    """

    def __init__(
        self,
        system: ODE,
        method: Method,
        *,
        compiled: bool,
        derivative: Function | None = None,
        linearise: Linearisation | None = None,
        ranges: JointRanges = (),
    ) -> None:
        self.system = system
        self.method = method
        self.compiled = compiled = compiled and codegen.numba_version() is not None
        implicit = isinstance(method, Rosenbrock)
        self.pair_cost = 3 * (len(method.a) + (JACOBIAN_COST if implicit else 0))
        if derivative is not None and (compiled or (implicit and linearise is None)):
            raise ValueError("a derivative of its own needs plain Python and, if implicit, its own")
        source = _source(system, method, by_structure=compiled)
        self._module: ModuleType = codegen.load(
            source.texts, source.constants, numba=compiled, base=source.base
        )
        if derivative is not None:
            self._module.__dict__["rhs"] = derivative
        if linearise is not None and implicit:
            self._module.__dict__["linearise"] = linearise
        self._vector: Callable[[Vector], Any] = np.array if compiled else list
        self._listed: Callable[[Any], list[float]] = np.ndarray.tolist if compiled else list
        self._numbers = self._vector(source.numbers)
        self._error = self._vector([0.0] * len(system.state))
        self.sizes: Any = self._vector([])
        self._at = Point([], [], (), method.order)
        self._place: list[Any] = []
        self._drive: tuple[Vector, Any] = (), None
        self._ranges = np.array(ranges, dtype=float).reshape(-1, 3) if compiled else ranges

    def step_pair(
        self, t: float, h: float, y: Vector, z: Vector, d: Vector
    ) -> tuple[list[float], list[float], float]:
        """Two steps of h / 2 for y, one of h for its coarse solution z.

        Returns:
            New y, new z, and the local error estimate of y in units of the tolerance; infinite
            where the step has no finite result.

        """
        new_y, new_z = self._vector(y), self._vector(z)
        try:
            size = self._module.step_pair(
                t, h, self._vector(y), self._vector(z), self._vector(d), self._numbers,
                new_y, new_z, self._error,
            )  # fmt: skip
        except (ArithmeticError, ValueError):
            return list(y), list(z), float("inf")
        return self._listed(new_y), self._listed(new_z), float(size)

    def doubling_error(
        self, h: float, begin: tuple[Vector, Vector], end: tuple[Vector, Vector]
    ) -> float:
        """Local error estimate of a pair of steps by its distance from the one step of z.

        Args:
            h: length of the pair [s].
            begin: y and z before it.
            end: y and z after it.

        Returns:
            As `step_pair`, whose estimate is zero for a method that has none.

        """
        share = 1.0 / (2.0**self.method.order - 1.0)
        rows = zip(*begin, *end, strict=True)
        error = self._vector([share * ((p - y) - (q - z)) for y, z, p, q in rows])
        return float(self._module.size_of(error, self._vector(begin[0]), self._vector(end[0]), h))

    def step_many(
        self, h: float, count: int, tolerance: float, at: Point, d: Vector
    ) -> tuple[int, Point]:
        """Advance by up to `count` periods of h, a pair of steps each, as long as that suffices.

        Args:
            h: length of a period [s].
            count: how many, at most.
            tolerance: largest local error estimate of a period.
            at: where it begins, its coarse solution by this method.
            d: drive.

        Returns:
            How many were done, and where the last one ended. `sizes` has the local error estimate
            of each.

        """
        if not all(map(is_, at, self._at)):  # otherwise the numbers are there already
            self._place = [self._vector(part) for part in at[:3]]
        if len(self.sizes) < count or not self.compiled:
            self.sizes = self._vector([-1.0] * count)
        # At each wake in real time the processor's caches are cold: to make an array takes 8 us, a
        # tenth of the call. A list may have other numbers now.
        if d is not self._drive[0] or type(d) is not tuple:
            self._drive = d, self._vector(d)
        y, z, joints = self._place
        try:
            done = self._module.step_many(
                count, h, tolerance, y, z, self._drive[1], self._numbers, self._ranges,
                joints, self.sizes,
            )  # fmt: skip
        except (ArithmeticError, ValueError):
            done = sum(size >= 0.0 for size in self.sizes)
        self._at = self._point(y, z, joints)
        return done, self._at

    def step_sequence(
        self,
        first: int,
        periods: tuple[Any, Any, Any],
        tolerance: float,
        at: Point,
        reached: Any,
    ) -> tuple[int, Point]:
        """Advance from period `first` by a pair of steps a period; stop before one that needs more.

        Args:
            first: number of the period that begins.
            periods: of n periods the lengths [s], shape (n,), the drives, (n, m), and the states
                (n, size) at which they begin, NaN where they continue; lists in plain Python.
            tolerance: largest local error estimate of a period.
            at: where the period begins.
            reached: takes solution and coarse solution at the ends, shape (n, 2, size).

        Returns:
            The first period that was not done, and where it begins.

        """
        y, z, joints = (self._vector(part) for part in at[:3])
        lengths, drives, starts = periods
        try:
            done = self._module.step_sequence(
                first, lengths, drives, self._numbers, tolerance, starts, y, z, self._ranges,
                joints, reached,
            )  # fmt: skip
        except (ArithmeticError, ValueError):  # plain Python, of a number without a value
            done = next(k for k in range(first, len(lengths)) if math.isnan(reached[k][0][0]))
        return done, self._point(y, z, joints)

    def _point(self, y: Any, z: Any, joints: Any) -> Point:
        order = self.method.order
        return Point(self._listed(y), self._listed(z), tuple(self._listed(joints)), order)

    def step_fixed(self, t: float, h: float, count: int, y: Vector, d: Vector) -> list[float]:
        """Advance by `count` steps of h, errors unseen.

        Raises:
            ArithmeticError, ValueError: in plain Python, where a step has no finite result.

        """
        new = self._vector(y)
        drive = self._vector(d)
        self._module.step_fixed(t, h, count, self._vector(y), drive, self._numbers, new)
        return self._listed(new)


def has_step_code(
    system: ODE, method: Method, functions: Sequence[str] = ("step_pair", "step_many")
) -> bool:
    """Return whether machine code of what a run calls is there, to be loaded quickly."""
    source = _source(system, method, by_structure=True)
    return codegen.has_code(source.texts, source.constants, functions, base=source.base)


def compile_derivative(system: ODE) -> Function:
    """Return the derivative of a system in machine code, with the digits of plain Python."""
    source = _source(system, DORMAND_PRINCE, by_structure=True)
    base, numbers = source.base, np.array(source.numbers)
    rhs: Function = codegen.load(list(base.texts), base.constants, numba=True).rhs
    return lambda *inputs: rhs(*inputs, numbers)


@lru_cache(maxsize=64)
def _source(system: ODE, method: Method, *, by_structure: bool) -> _MethodSource:
    """Return what the steps of a system by a method consist of.

    By structure the text has no number of the scene: they are in a vector p, an argument of all
    functions. Otherwise they are in the text, and p is empty.
    """
    size, slots = len(system.state), Slots() if by_structure else None
    y, d = [f"y[{i}]" for i in range(size)], [f"d[{i}]" for i in range(len(system.drive))]
    p = ["p"] if by_structure else []
    lag = 3 if set(LAG) <= set(system.state) else 0
    common = {"SIZE": size, "LAG": lag}
    constants: dict[str, Any] = {"SIZE": size, "SHARE": 0.5**method.error_order}
    inputs = ", ".join(["t", *y, *d, *p])
    joints = _assign(
        [f"joints[{i}]" for i in range(18)], f"angles_and_rates({', '.join(y[:7] + p)})"
    )
    shared = [
        system.program.source("rhs", slots),
        system.joints.source("angles_and_rates", slots),
        f"def joints_of(y, p, joints):\n{joints}",
        *(inspect.getsource(function) for function in _SHARED),
    ]
    texts: list[str] = []
    if isinstance(method, Tableau):
        texts.append(codegen.attempt_explicitly(method, size, len(d), *p))
    else:
        constants |= method.constants
        slope = [f"slope[{i}]" for i in range(size)]
        if slots is not None:
            texts.append(_linearise(system, slots))
        else:  # without a compiler the columns in a row take less time
            texts.append(system.jacobian.source("jacobian"))
            texts.append(inspect.getsource(step_loops.linearise))
        evaluate = _assign(slope, f"rhs({inputs})")
        texts.append(f"def evaluate(t, y, d, p, slope):\n{evaluate}")
        texts += [
            inspect.getsource(function).replace("attempt_linearly_implicit", "attempt")
            for function in _IMPLICIT
        ]
    texts += [inspect.getsource(function) for function in _LOOPS]
    base = codegen.SharedFunctions(tuple(shared), common)
    return _MethodSource(base, texts, constants, slots.values if slots else [])


def _linearise(system: ODE, slots: Slots) -> str:
    """Source of `linearise` for numba: all columns of the Jacobian in a loop over directions.

    It is half as long as the operations of each column in a row, which takes half the time to
    compile, and the compiler takes four columns at once; the digits are those of the columns.

        def linearise(t, state, d, p, slope, by_time, matrix):
            x = state[0]
            t1 = d[0]
            c0 = p[0]
            v0 = x * x
            slope[0] = v7
            columns = vector(64)
            for k in range(8):
                d_x = 1.0 if k == 0 else 0.0
                v8 = d_x * v0
                columns[0 + k] = v9
            for i in range(8):
                by_time[i] = columns[8 * i + 7]
                for k in range(7):
                    matrix[i][k] = columns[8 * i + k]
    """
    size, variables, program = len(system.state), system.variables, system.directional
    directions = [f"d_{name}" for name in variables]
    lines, results = program.body(slots)
    inner = program.steps_of(directions)
    width = -(-len(variables) // _LANES) * _LANES
    states = len(variables) - ("t" in variables)
    body = [
        *(f"{name} = state[{i}]" for i, name in enumerate(system.state)),
        *(f"{name} = d[{i}]" for i, name in enumerate(system.drive)),
        *slots.reads([*lines, *results]),
        *(line for line, along in zip(lines, inner, strict=True) if not along),
        *(f"slope[{i}] = {result}" for i, result in enumerate(results[:size])),
        f"columns = vector({size * width})",
        f"for k in range({width}):",
        *(f"    {name} = 1.0 if k == {k} else 0.0" for k, name in enumerate(directions)),
        *(f"    {line}" for line, along in zip(lines, inner, strict=True) if along),
        *(f"    columns[{i * width} + k] = {result}" for i, result in enumerate(results[size:])),
        f"for i in range({size}):",
        *([f"    by_time[i] = columns[{width} * i + {states}]"] if "t" in variables else []),
        f"    for k in range({states}):",
        f"        matrix[i][k] = columns[{width} * i + k]",
    ]
    head = "def linearise(t, state, d, p, slope, by_time, matrix):"
    return "\n    ".join([head, *body]) + "\n"


def _assign(places: list[str], call: str) -> str:
    """Body of a function that puts what a call returns into places."""
    return f"    ({', '.join(places)},) = {call}\n"


def code_is_there(scene: Scene, integrator: str) -> bool:
    """Return whether all code of a run of the scene is there, for each method it may use."""
    if codegen.numba_version() is None:
        return False
    system = ode_with_work(Dynamics.of(scene))
    return all(has_step_code(system, method) for method in _methods(integrator))


def make_code(scene: Scene, integrator: str) -> Iterator[str]:
    """Make what is not there; yields the name of each method when its code is there.

    Where another process makes code this does nothing: it would take the processor from it.
    """
    system = ode_with_work(Dynamics.of(scene))
    folder = cache_folder()
    with (folder / "lock").open("w") as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            return
        for method in _methods(integrator):
            if not has_step_code(system, method):
                size, drive = len(system.state), (0.0,) * len(system.drive)
                y = [0.0, 0.0, 0.0, 1.0, *(0.0,) * (size - 4)]
                machine = CompiledMethod(system, method, compiled=True)
                # What comes out is of no interest: the calls have the code made.
                machine.step_pair(0.0, 1e-3, y, y, drive)
                machine.step_many(1e-3, 1, 1.0, Point(y, y, (0.0,) * 18, method.order), drive)
            yield method.name


def _methods(integrator: str) -> tuple[Method, ...]:
    return (METHODS[integrator],) if integrator in METHODS else (DORMAND_PRINCE, DOP853, RODAS5P)
