# SPDX-License-Identifier: Apache-2.0
"""The steps of one scene by one method from point to point, on plain floats or compiled.

Code is made once for each method and each structure of a scene - its terms, and which numbers are 0
or 1 - which takes seconds, and kept in `cache_folder()`; to load it takes tenths of a second.
"""

from __future__ import annotations

import fcntl
import inspect
import math
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from functools import lru_cache
from multiprocessing import get_context
from types import ModuleType
from typing import Any, NamedTuple

import numpy as np

from sst_ros.dynamics.traced_dynamics import LAG, ODE, Dynamics, Function, recent_ode
from sst_ros.host import compiled_module
from sst_ros.host.compiled_module import cache_folder
from sst_ros.integration import step_loops
from sst_ros.integration.methods import (
    DOP853,
    DORMAND_PRINCE,
    METHODS,
    RODAS5P,
    Method,
    Rosenbrock,
    Tableau,
)
from sst_ros.integration.simd_source import linearise_by_columns
from sst_ros.programs.expression import Slots
from sst_ros.scene.scene import Scene

Vector = Sequence[float]
Linearisation = Callable[[float, Vector, Vector, Any, Any, Any, Any], None]
"""(t, y, d, numbers, slope, by_time, matrix) -> None: fills the derivative, df/dt and df/dy, which
are zero before."""
JointRanges = Sequence[tuple[int, float, float]]
Most = tuple[float, float, float]
"""What one call may take: longest step [s], attempts since the method was chosen, and steps since
the start of the run; then another method may be chosen, or a bound is met."""
Periods = tuple[Any, Any, Any]
"""Of n periods, or of all, the lengths [s], shape (n,), the drives, (n, m), and the states at which
they begin, (n, size), NaN where they continue; lists in plain Python."""
JACOBIAN_COST = 30
"""Evaluations that a Jacobian with its factorisation counts as: measured in plain Python."""
_MARGIN, _FLOOR = 2.0, 8 * 2.220446049250313e-16
"""Of the distance: an error that halves with the steps is twice as large; of rounding, a step."""

_SHARED = (
    step_loops.size_of,
    step_loops.normalise,
    step_loops.all_far,
    step_loops.step_factor,
    step_loops.next_length,
)
_LOOPS = (step_loops.step_pair, step_loops.step_fixed, step_loops.step_many)
_IMPLICIT = (step_loops.factorise, step_loops.substitute, step_loops.attempt_linearly_implicit)


def methods_of(integrator: str) -> tuple[Method, ...]:
    """Methods that an integrator may use, the one it begins with first: of auto three."""
    named = METHODS.get(integrator)
    return (named,) if named else (DORMAND_PRINCE, DOP853, RODAS5P)


class MethodChange(NamedTuple):
    """A change of method."""

    time: float  # [s]
    method: str  # the new one
    reason: str


class Point(NamedTuple):
    """Where a run stands: all that its next step depends on; and how far it can be trusted.

    A second solution goes through each step by two of half the length: its distance is the error.
    No order is assumed, as none holds where a torque jumps, a clamp or a contact bends the motion,
    or friction is sharp. Where the method has its order, the second solution is nearly exact, and
    the distance is the error; where each step loses its order, the error halves, and the distance
    is half of the error.
    """

    y: list[float]  # the solution
    z: list[float]  # the second one, by steps of half the length
    joints: tuple[float, ...]  # nine angles and nine rates of y
    method: Method
    h: float = math.inf  # longest next step [s]
    attempts: int = 0  # since the method was chosen
    steps: int = 0  # accepted since the start
    changes: tuple[MethodChange, ...] = ()

    @property
    def error(self) -> float:
        """Estimated global error of the orientation [rad]."""
        return estimate_error(orientation_distance(self.y, self.z), self.steps)

    @property
    def rate_error(self) -> float:
        """Estimated global error of the body rate [rad/s]."""
        speed = max(1.0, math.hypot(*self.y[4:7]))
        return speed * estimate_error(math.dist(self.y[4:7], self.z[4:7]) / speed, self.steps)


def estimate_error(distance: float, steps: int) -> float:
    """Estimate the error of a solution by that of a second one, by steps of half the length."""
    return max(_MARGIN * distance, _FLOOR * math.sqrt(steps + 1.0))


def orientation_distance(y: Sequence[float], z: Sequence[float]) -> float:
    """Angle between the orientations of two states that are near [rad]; q and -q are the same."""
    return 2.0 * min(math.dist(y[:4], z[:4]), math.dist(y[:4], [-x for x in z[:4]]))


def state_distance(y: Sequence[float], z: Sequence[float]) -> float:
    """Distance of orientations [rad], or that of the rest relative to the rate if it is larger.

    Rates below 1 rad/s count as 1 rad/s; infinite where a number is not finite.
    """
    speed = max(1.0, math.hypot(*z[4:7]))
    distance = max(orientation_distance(y, z), math.dist(y[4:], z[4:]) / speed)
    return distance if math.isfinite(distance) else math.inf


class TorqueLaw(NamedTuple):
    """A derivative in plain Python, under torques that are a function, in place of the ODE's."""

    derivative: Function
    linearise: Linearisation | None  # None where it is not known, and no method is implicit
    jump: Callable[[float, float, Vector], tuple[float, float] | None]
    """(begin, end, state): times just before and after a jump in between, if there is one."""


class CompiledMethod:
    """Steps of a system by a method.

    Args:
        system: what is integrated.
        method: how.
        compiled: by numba; otherwise, or where there is no numba, as plain Python.
        law: what takes the place of the ODE's derivative, in plain Python.
        ranges: joints that `step_many` looks at, see `ranges_of`.

    Attributes:
        system, method, compiled: as given.
        cost: evaluations of a step; `step_pair` takes three.

    """

    def __init__(
        self,
        system: ODE,
        method: Method,
        *,
        compiled: bool,
        law: TorqueLaw | None = None,
        ranges: JointRanges = (),
    ) -> None:
        self.system = system
        self.method = method
        self.compiled = compiled = compiled and compiled_module.numba_version() is not None
        implicit = isinstance(method, Rosenbrock)
        self.cost = len(method.a) + (JACOBIAN_COST if implicit else 0)
        if law and (compiled or (implicit and law.linearise is None)):
            raise ValueError("a derivative of its own needs plain Python and, if implicit, its own")
        texts, constants, base, numbers = _source(system, method, by_structure=compiled)
        self._module: ModuleType = compiled_module.load(texts, constants, numba=compiled, base=base)
        if law:
            vars(self._module).update(rhs=law.derivative, linearise=law.linearise)
        self._vector: Callable[[Vector], Any] = np.array if compiled else list
        self._listed: Callable[[Any], list[float]] = np.ndarray.tolist if compiled else list
        self._numbers = self._vector(numbers)
        self._extra = (self._numbers,) if compiled else ()
        # At each wake in real time the processor's caches are cold: to make an array takes 8 us, a
        # tenth of a step's call.
        size, drive = len(system.state), len(system.drive)
        self._place = [self._vector([0.0] * n) for n in (size, size, 18)]
        self._run = self._vector([0.0] * 10)
        self._length: Any = self._vector([0.0])
        self._drive: Any = np.zeros((1, drive)) if compiled else [[0.0] * drive]
        self._no_start: Any = np.empty((0, size)) if compiled else []
        self._not_kept: Any = np.empty((0, 2, size)) if compiled else []
        self._ranges, self._no_ranges = (
            np.array(rows, dtype=float).reshape(-1, 3) if compiled else rows
            for rows in (ranges, ())
        )

    def load(self) -> None:
        """Have the code that a run calls loaded, or made where it is not there."""
        size, drive = len(self.system.state), (0.0,) * len(self.system.drive)
        y = [0.0, 0.0, 0.0, 1.0, *(0.0,) * (size - 4)]
        self.step_pair(0.0, 1e-3, Point(y, y, (0.0,) * 18, self.method), drive)

    def step_pair(
        self,
        t: float,
        h: float,
        at: Point,
        d: Vector,
        *,
        other: Vector | None = None,
        parts: int = 3,
    ) -> tuple[Point, float]:
        """Advance both solutions of a point by h: one by a step, the other by two of h / 2.

        The second one has the drive `other`, by default that of the first; with one part in place
        of three it has no meaning. Returns where they end, and the local error estimate in units of
        the tolerance; infinite where the step has no finite result.
        """
        one, begin = self.hold(h, d), at._replace(h=math.inf)
        done, end = self.step_many(0, 1, one, begin, ranges=self._no_ranges, t=t, parts=parts)
        size = float(self._run[9]) if done else math.inf
        if other is None:
            return end, size
        second, finite = self.step_pair(t, h, at, other)
        return end._replace(z=second.z), size if finite < math.inf else math.inf

    def slope(self, t: float, y: Vector, d: Vector) -> tuple[float, ...]:
        """Return the derivative of the state."""
        found: tuple[float, ...] = self._module.slope(t, *y, *d, *self._extra)
        return found

    def hold(self, h: float, d: Vector) -> Periods:
        """Return periods that all have the length h [s] and the drive d."""
        self._length[0], self._drive[0][:] = h, d
        return self._length, self._drive, self._no_start

    def step_many(
        self,
        first: int,
        end: int,
        periods: Periods,
        at: Point,
        tolerance: float = math.inf,
        most: Most = (math.inf,) * 3,
        reached: Any = None,
        *,
        ranges: Any = None,
        t: float = 0.0,
        parts: int = 3,
    ) -> tuple[int, Point]:
        """Advance from period `first` to `end`; stop before one that needs more than steps.

        Returns the first period that was not done, and where it begins.

        Args:
            first: number of the period that begins.
            end: number of the last one, and one.
            periods: what they are.
            at: where the first one begins.
            tolerance: largest local error estimate of a step.
            most: what they may take.
            reached: takes both solutions at the ends, shape (n, 2, size).
            ranges: in place of those of the method.
            t: time at which periods begin, as the system takes it [s].
            parts: see `step_pair`.

        """
        y, z, joints = self._place
        run = self._run
        y[:], z[:], joints[:] = at[:3]
        run[0], run[1], run[2], run[3] = at.h, at.attempts, at.steps, first
        run[4], run[5], run[6] = most
        run[7], run[8] = t, parts
        try:
            done = self._module.step_many(
                first, end, *periods, self._numbers, tolerance, y, z,
                self._ranges if ranges is None else ranges, joints,
                run, self._not_kept if reached is None else reached,
            )  # fmt: skip
        except (ArithmeticError, ValueError):  # plain Python, of a number without a value
            done = int(run[3])
        listed, (h, attempts, steps, *_) = self._listed, self._listed(run)
        return done, at._replace(
            y=listed(y), z=listed(z), joints=tuple(listed(joints)),
            h=h, attempts=int(attempts), steps=int(steps),
        )  # fmt: skip

    def step_fixed(self, t: float, h: float, count: int, y: Vector, d: Vector) -> list[float]:
        """Advance by `count` steps of h, errors unseen.

        ArithmeticError, ValueError: in plain Python, where a step has no finite result.
        """
        new = self._vector(y)
        drive = self._vector(d)
        self._module.step_fixed(t, h, count, self._vector(y), drive, self._numbers, new)
        return self._listed(new)


def has_step_code(system: ODE, method: Method) -> bool:
    """Return whether machine code of what a run calls is there, to be loaded quickly."""
    texts, constants, base, _ = _source(system, method, by_structure=True)
    return compiled_module.has_code(texts, constants, ("step_many",), base=base)


def compile_derivative(system: ODE) -> Function:
    """Return the derivative of a system in machine code, with the digits of plain Python."""
    _, _, base, numbers = _source(system, DORMAND_PRINCE, by_structure=True)
    slope: Function = compiled_module.load(list(base.texts), base.constants, numba=True).slope
    place = np.array(numbers)
    return lambda *inputs: slope(*inputs, place)


@lru_cache(maxsize=64)
def _source(
    system: ODE, method: Method, *, by_structure: bool
) -> tuple[list[str], dict[str, Any], compiled_module.SharedFunctions, list[float]]:
    """Return what the steps of a system by a method are made of.

    That is one text a function, in the order of their calls; constants; what the modules of all
    methods have in common; numbers.

    By structure the text has no number of the scene: they are in a vector p, an argument of all
    functions. Otherwise they are in the text, and p is empty.
    """
    size, slots = len(system.state), Slots() if by_structure else None
    y, d = [f"y[{i}]" for i in range(size)], [f"d[{i}]" for i in range(len(system.drive))]
    p = ["p"] if by_structure else []
    lag = 3 if set(LAG) <= set(system.state) else 0
    common = {"SIZE": size, "LAG": lag}
    common |= {name: getattr(step_loops, name) for name in ("GROW", "SHRINK", "SAFETY")}
    doubling = isinstance(method, Tableau) and not method.error
    constants: dict[str, Any] = {
        "SIZE": size,
        "DOUBLING": doubling,
        "IMPLICIT": isinstance(method, Rosenbrock),
        # No int: numba would compile a function anew for each value that it is called with.
        "ERROR_ORDER": float(method.error_order),
    }
    inputs = ", ".join(["t", *y, *d, *p])
    floats = inputs.replace("[", "").replace("]", "")
    joints = _assign(
        [f"joints[{i}]" for i in range(18)], f"angles_and_rates({', '.join(y[:7] + p)})"
    )
    shared = [
        system.program.source("rhs", slots),
        system.dynamics.joints_program.source("angles_and_rates", slots),
        f"def joints_of(y, p, joints):\n{joints}",
        f"def slope({floats}):\n    return rhs({floats})\n",
        *(inspect.getsource(function) for function in _SHARED),
    ]
    texts: list[str] = []
    if isinstance(method, Tableau):
        texts.append(step_loops.explicit_step(method, size, len(d), *p))
    else:
        constants |= method.constants
        slope = [f"slope[{i}]" for i in range(size)]
        if slots is not None:
            columns = system.directional, system.state, system.drive
            texts += linearise_by_columns(*columns, slots)
        else:  # without a compiler the columns in a row take less time
            texts.append(system.jacobian.source("jacobian"))
            texts.append(inspect.getsource(step_loops.linearise))
        evaluate = _assign(slope, f"rhs({inputs})")
        texts.append(f"def evaluate(t, y, d, p, slope):\n{evaluate}")
        texts += [inspect.getsource(function) for function in _IMPLICIT]
    attempt = "attempt(" if isinstance(method, Tableau) else f"{_IMPLICIT[-1].__name__}("
    texts += [inspect.getsource(function).replace("attempt(", attempt) for function in _LOOPS]
    base = compiled_module.SharedFunctions(tuple(shared), common)
    return texts, constants, base, slots.values if slots else []


def _assign(places: list[str], call: str) -> str:
    """Body of a function that puts what a call returns into places."""
    return f"    ({', '.join(places)},) = {call}\n"


def code_is_there(scene: Scene, integrator: str) -> bool:
    """Return whether all code of a run of the scene is there, for each method it may use."""
    return compiled_module.numba_version() is not None and not _missing(scene, integrator)


def make_code(scene: Scene, integrator: str) -> None:
    """Make what is not there: of several methods the last one, the longest, in another process.

    Where another process makes code this does nothing: it would take the processor from it.
    """
    with (cache_folder() / "lock").open("w") as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            return
        missing = _missing(scene, integrator)
        with ProcessPoolExecutor(1, get_context("spawn")) as beside:
            if len(missing) > 1:
                beside.submit(_make, scene, missing.pop().name)
            for method in missing:
                _make(scene, method.name)


def _missing(scene: Scene, integrator: str) -> list[Method]:
    system = recent_ode(Dynamics.of(scene), work=True)
    return [method for method in methods_of(integrator) if not has_step_code(system, method)]


def _make(scene: Scene, method: str) -> None:
    system = recent_ode(Dynamics.of(scene), work=True)
    CompiledMethod(system, METHODS[method], compiled=True).load()
