# SPDX-License-Identifier: Apache-2.0
"""A scene as an initial value problem, and its reference solution, with the error of that.

Torques are continuous functions of time, not held over control periods: zero where the scene has
none. The span ends at the first limit that stops the run. Elastic stops and torque limits have
kinks; there `Simulation`, which locates them, is the reference. Elsewhere the step size is halved
in double precision until the solution stops improving; then DOP853 solves with that step in
extended precision, by the code that is generated for it: what the methods solve, to the last bit.
The reference's own error is twice the difference of two step sizes.
"""

from __future__ import annotations

import contextlib
import math
import time
from dataclasses import replace
from fractions import Fraction
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from sst_ros.dynamics.traced_dynamics import ODE, Dynamics
from sst_ros.errors import InputError, Problem
from sst_ros.extras import require
from sst_ros.host import compiled_module
from sst_ros.host.compiled_module import numba_version
from sst_ros.integration.adaptive_stepper import WHOLE_MOTION_BUDGET
from sst_ros.integration.compiled_method import CompiledMethod
from sst_ros.integration.methods import DOP853
from sst_ros.integration.step_loops import explicit_step
from sst_ros.mechanism import kinematics
from sst_ros.mechanism.geometry import Array, Geometry, angle_between, rotation_matrix
from sst_ros.report.reference import initial, joint_columns
from sst_ros.report.results import WHOLE_RUN_S
from sst_ros.scene.scene import Scene
from sst_ros.simulation.simulate import simulate
from sst_ros.simulation.simulation import Simulation
from sst_ros.state import NANOSECONDS

LongArray: TypeAlias = NDArray[np.longdouble]
EXTENDED, MPMATH = "long double", "mpmath"

DIGITS = 30  # decimal digits of mpmath's numbers
LONGEST_S = 20.0
"""The reference stays in double precision where extended precision would take more than this [s]:
a work-precision study of one scene then stays below a minute."""
_MOST_STEPS = 200_000
INTERVALS = 20  # solutions are compared at this many instants or more

EXACT = replace(
    DOP853,
    b=(*DOP853.b[:-1], float(1 - sum(map(Fraction, DOP853.b[:-1])))),
    error=(),
    damping=(),
)
"""DOP853 without error estimates. As doubles its weights do not quite add up to 1, which no step
size would show; here they do, exactly."""


class StateError(NamedTuple):
    """Distance from the reference: orientation [rad], gamma [rad], gamma_dot [rad/s]."""

    orientation: float
    gamma: float
    gamma_dot: float


class InitialValueProblem:
    """A scene as an initial value problem.

    Raises:
        AssemblyError: the initial gamma has no unique admissible assembly.
        InputError: the scene cannot start, or stops at once.

    """

    def __init__(self, scene: Scene) -> None:
        self.scene, self.dynamics = scene, Dynamics.of(scene)
        self.torque = scene.torque or (0.0, 0.0, 0.0)  # [N m]
        self.system = ODE(self.dynamics, scene.torque, work=True)
        self.drive = (0.0,) * len(self.system.drive)  # its inputs
        self.start = (*initial(scene), 0.0)  # the state at time zero, the work in it
        largest = max(map(abs, scene.torque.amplitude)) if scene.torque else 0.0
        self.clamped = scene.torque_limit is not None and largest > scene.torque_limit
        self.kinked = self.clamped or scene.stroke.at_end == "elastic"
        motion = simulate(scene, duration=scene.duration or WHOLE_RUN_S)
        whole, reason = float(motion.t[-1]), motion.message.partition(": ")[2]
        self.ends = f"stop at {whole:.6f} s, {reason}" if reason else ""  # before the duration
        if whole * NANOSECONDS < 1000 * INTERVALS:
            allowed = f"the run is over before it can be studied: {self.ends or f'{whole} s'}"
            raise InputError(scene.name, [Problem("initial", whole, allowed)])
        # Instants of comparison lie 1, 2 or 5 times a power of ten apart.
        whole_ns = whole * NANOSECONDS * (1.0 + 1e-9)  # may be a little less than it is called
        lengths = (f * 10**n for n in range(18) for f in (1, 2, 5))
        self.interval_ns = max(x for x in lengths if x * INTERVALS <= whole_ns)
        self.interval = self.interval_ns / NANOSECONDS  # [s]
        self.count = math.floor(whole_ns / self.interval_ns)
        self.times: Array = self.interval_ns * np.arange(self.count + 1) / NANOSECONDS  # [s]
        self.seconds = float(self.times[-1])

    def errors(
        self, solution: Array | LongArray, reference: LongArray
    ) -> tuple[StateError, StateError]:
        """Distances of states (count + 1, n) at the end, and the largest; nan where unknown."""
        angle = angle_between(solution[:, :4], reference[:, :4])
        joints = np.abs(self.joints(solution) - self.joints(reference))
        legs = joints[:, :3].max(axis=1), joints[:, 9:12].max(axis=1)
        found = np.stack([angle.astype(float), *legs])
        return StateError(*found[:, -1].tolist()), StateError(*found.max(axis=1).tolist())

    def joints(self, solution: Array | LongArray) -> Array:
        """Nine angles [rad] and nine rates [rad/s] of states, shape (n, 18)."""
        return joint_columns(self.dynamics.model, solution[:, :7].astype(float))

    def residuals(self, y: Array) -> tuple[float, float]:
        """Energy residual [J] and the largest abs(r_k . t_k) at a final state, shape (n,)."""
        before, after = map(self.dynamics.total_energy, (self.start, y.tolist()))
        gamma, geometry = self.joints(y[None])[0, :3], Geometry.of(self.scene)
        closure = kinematics.closure(geometry, gamma, rotation_matrix(y[:4]))
        return float(after - before - y[-1]), float(np.abs(closure).max())

    def run_steps(self, machine: CompiledMethod, steps: int) -> Array:
        """States at the instants with `steps` steps an interval; nan after the last finite one."""
        result = np.full((self.count + 1, len(self.start)), np.nan)
        result[0] = y = list(self.start)
        h = self.interval / steps
        with contextlib.suppress(ArithmeticError, ValueError), np.errstate(all="ignore"):
            for k in range(self.count):
                result[k + 1] = y = machine.step_fixed(k * self.interval, h, steps, y, self.drive)
        return result

    def simulation(self, method: str, tolerance: float) -> Simulation:
        """Return a simulation, compiled where the torques can be."""
        compiled = numba_version() is not None and not self.clamped
        return Simulation(
            self.scene, method, tolerance=tolerance, compiled=compiled,
            step_budget=WHOLE_MOTION_BUDGET,
        )  # fmt: skip

    def run_simulation(self, simulation: Simulation) -> Array:
        """States at the instants from a simulation, begun again; raises RunStopped at a limit."""
        simulation.reset()
        rows = [self.start]
        for _ in range(self.count):
            simulation.steps(self.torque, self.interval_ns, 1)
            rows.append(tuple(simulation.sample[0]))
        return np.array(rows)


class ReferenceSolution(NamedTuple):
    """States at the instants of comparison, their own error, and how they were found."""

    states: LongArray
    own: StateError
    how: str


def solve_reference(problem: InitialValueProblem, kind: str = EXTENDED) -> ReferenceSolution:
    """Solve a problem as accurately as possible, in numbers of a kind, EXTENDED or MPMATH.

    Raises:
        InputError: there is no finite motion, or mpmath is asked for and not installed.

    """
    if problem.kinked:
        pair: list[Any] = [
            problem.run_simulation(problem.simulation("dop853", tolerance))
            for tolerance in (1e-13, 1e-14)
        ]
        how = "Simulation, dop853, tolerance 1e-14"
    else:
        machine = CompiledMethod(problem.system, DOP853, compiled=numba_version() is not None)
        best, solution = _finest(problem, machine)
        solver = ExtendedSolver(problem, kind)
        began = time.perf_counter()
        solver.run_steps(3, intervals=1)
        seconds = (time.perf_counter() - began) / 3 * problem.count
        steps, numbers = (3 * best // 2, 2 * best), solver.numbers
        if kind != EXTENDED or seconds * sum(steps) < LONGEST_S:
            pair = [solver.run_steps(number) for number in steps]
        else:
            pair, steps = [problem.run_steps(machine, best // 2), solution], (best // 2, best)
            numbers = "double precision"
        how = f"DOP853, {problem.interval / steps[1]:.3g} s steps, {numbers}"
    # Twice the difference of two solutions, but not less than doubles resolve.
    rough, fine = (states.astype(np.longdouble) for states in pair)
    change, joints = problem.errors(rough, fine)[1], np.abs(problem.joints(fine))
    least = 1e-17, *(2.3e-16 * float(joints[:, i : i + 3].max()) for i in (0, 9))
    own = StateError(*(max(2.0 * x, floor) for x, floor in zip(change, least, strict=True)))
    return ReferenceSolution(fine, own, how)


def _finest(problem: InitialValueProblem, machine: CompiledMethod) -> tuple[int, Array]:
    """Halve the step until rounding dominates; return steps an interval, and the solution."""
    found: list[tuple[float, int, Array]] = []
    before = problem.run_steps(machine, 1)
    for power in range(1, 14):
        after = problem.run_steps(machine, 2**power)
        change = problem.errors(before, after.astype(np.longdouble))[1].orientation
        if math.isfinite(change):
            found.append((change, 2**power, after))
        converged = len(found) > 1 and (change < 1e-13 or change > found[-2][0] < 1e-9)
        if converged or problem.count * 2**power > _MOST_STEPS:
            break
        before = after
    if not found:
        problems = [Problem("duration", problem.scene.duration, "the reference is not finite")]
        raise InputError(problem.scene.name, problems)
    return min(found, key=lambda row: row[0])[1:]


class ExtendedSolver:
    """DOP853 with fixed steps on long doubles or mpmath's numbers; `numbers` says which."""

    def __init__(self, problem: InitialValueProblem, kind: str) -> None:
        library: Any = np
        if kind == EXTENDED:
            self.numbers = f"{np.finfo(np.longdouble).precision}-digit floats"
            self._number, arctan = np.longdouble, "arctan2"
        else:
            library = require("mpmath").mp.clone()
            library.dps = DIGITS
            self.numbers = f"mpmath, {DIGITS} digits"
            self._number, arctan = library.mpf, "atan2"
        self._problem = problem
        step = explicit_step(EXACT, len(problem.start), len(problem.drive))
        self._code: Any = compiled_module.load(
            [problem.system.program.source("rhs"), step], {}, numba=False
        )
        for name in ("sqrt", "sin", "cos", "tanh", "exp", "atan2"):
            vars(self._code)[name] = getattr(library, arctan if name == "atan2" else name)

    def run_steps(self, steps: int, intervals: int | None = None) -> LongArray:
        """States at the instants, of the first `intervals` or all, with `steps` steps an interval.

        The quaternion is kept at length 1. A row of nan stands where there is no finite state.
        """
        problem, number = self._problem, self._number
        count, size = intervals or problem.count, len(problem.start)
        result = np.full((count + 1, size), np.nan, dtype=np.longdouble)
        result[0] = problem.start
        y, h = [number(x) for x in problem.start], number(problem.interval) / steps
        new_y, error = list(y), list(y)
        with contextlib.suppress(ArithmeticError, ValueError), np.errstate(all="ignore"):
            for k in range(count * steps):
                self._code.attempt(k * h, h, y, y, problem.drive, (), new_y, error)
                length = self._code.sqrt(sum(x * x for x in new_y[:4]))
                y = [*(x / length for x in new_y[:4]), *new_y[4:]]
                if (k + 1) % steps == 0:  # as text, in which both kinds have all their digits
                    result[(k + 1) // steps] = [np.longdouble(str(x)) for x in y]
        return result
