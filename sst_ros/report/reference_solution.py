# SPDX-License-Identifier: Apache-2.0
"""A scene as an initial value problem, and its reference solution with its error.

Torques are continuous functions of time, not held over control periods: zero where the
scene has none. The span ends at the first limit that stops the run. DOP853 solves in
extended precision, by the code that is generated for it: what the methods solve, to the
last bit. Its steps are halved until the solution stops changing; its own error is twice
the last change. Elastic stops and torque limits have kinks; there, and where no step is
short enough, `Simulation` is the reference.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Sequence
from dataclasses import replace
from fractions import Fraction
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from sst_ros.dynamics import kernel
from sst_ros.dynamics.initial_state import initial_state
from sst_ros.dynamics.traced_dynamics import ODE, Dynamics
from sst_ros.errors import refuse_unless
from sst_ros.integration.method_steps import MethodSteps
from sst_ros.integration.methods import DOP853
from sst_ros.integration.point import Drive
from sst_ros.integration.stepper import WHOLE_MOTION_BUDGET
from sst_ros.integration.steps import Derivative, explicit_step
from sst_ros.mechanism.geometry import Array, Geometry, angle_between
from sst_ros.programs.expression import compile_for_arrays
from sst_ros.report.results import WHOLE_RUN_S
from sst_ros.scene.scene import Scene
from sst_ros.simulation.simulate import simulate
from sst_ros.simulation.simulation import Simulation
from sst_ros.state import NANOSECONDS, QUATERNION, ZERO

LongArray: TypeAlias = NDArray[np.longdouble]
_MOST_REFERENCE_STEPS = 25_000  # in extended precision: half a minute's work
# Changes of the orientation from one solution to the next [rad]: of one that extended
# precision does not resolve further, and the largest of a reference.
RESOLVED_CHANGE = 1e-17
LARGEST_CHANGE = 1e-12
# Errors that are assumed at least: of the orientation [rad], and of joints over their
# size, as these are computed in doubles.
LEAST_ORIENTATION_ERROR = 1e-17
DOUBLE_ROUNDING = 2.3e-16
REFERENCE_TOLERANCES = (1e-13, 1e-14)  # of the two runs where `Simulation` solves
INTERVALS = 20  # solutions are compared at this many instants or more
SHORTEST_INTERVAL_NS = 1000  # with INTERVALS of which a run can be studied

EXACT_DOP853 = replace(
    DOP853,
    b=(*DOP853.b[:-1], float(1 - sum(map(Fraction, DOP853.b[:-1])))),
    error=(),
    damping=(),
)
"""DOP853 without error estimates. As doubles its weights do not quite add up to 1,
which no step size would show; here they do, exactly.
"""


class SolverRun(NamedTuple):
    """A solution, and what it took."""

    states: Array  # at the instants of comparison, shape (count + 1, n)
    evaluations: int  # of the right-hand side


class StateError(NamedTuple):
    """Distance from the reference."""

    orientation: float  # [rad]
    gamma: float  # [rad]
    gamma_dot: float  # [rad/s]


class InitialValueProblem:
    """A scene as an initial value problem.

    Raises AssemblyError where the initial gamma has no unique admissible assembly,
    InputError where the scene cannot start, or stops at once. Solutions are compared at
    instants `interval_ns` apart, by default at INTERVALS of them or more.
    """

    def __init__(self, scene: Scene, interval_ns: int | None = None) -> None:
        self.scene = scene
        self.dynamics = Dynamics.of(scene)
        self.torque = scene.torque or ZERO  # [N m]
        self.system = ODE(self.dynamics, scene.torque, work=True)
        self.drive = (0.0,) * len(self.system.drive)  # its inputs
        start = initial_state(scene, Geometry.of(scene))
        lagged_and_work = (0.0,) * (len(self.system.state) - len(start))
        self.start = (*start, *lagged_and_work)  # at time zero
        largest = 0.0
        if scene.torque is not None:
            largest = max(map(abs, scene.torque.amplitude))
        self.clamped = scene.torque_limit is not None and largest > scene.torque_limit
        self.kinked = self.clamped or scene.stroke.at_end == "elastic"
        motion = simulate(scene, duration=scene.duration or WHOLE_RUN_S)
        end_time = float(motion.t[-1])
        _, _, reason = motion.message.partition(": ")
        self.ends = ""  # why the run ends before the duration
        if reason:
            self.ends = f"stop at {end_time:.6f} s, {reason}"
        lasts = end_time * NANOSECONDS >= SHORTEST_INTERVAL_NS * INTERVALS
        requirement = (
            f"the run is over before it can be studied: {self.ends or f'{end_time} s'}"
        )
        refuse_unless(scene.name, ("initial", end_time, lasts, requirement))
        whole_ns = end_time * NANOSECONDS * (1.0 + 1e-9)  # to the rounding of the end
        self.interval_ns = interval_ns or _choose_interval(whole_ns)
        self.interval = self.interval_ns / NANOSECONDS  # [s]
        self.count = math.floor(whole_ns / self.interval_ns)
        times_ns = self.interval_ns * np.arange(self.count + 1)
        self.times: Array = times_ns / NANOSECONDS  # [s]
        self.seconds = float(self.times[-1])

    def errors(
        self, solution: Array | LongArray, reference: LongArray
    ) -> tuple[StateError, StateError]:
        """Return the distances of two solutions at the end, and the largest.

        Their states have the shape (m, 7 or more). Distances are nan where unknown.
        """
        orientation = angle_between(
            solution[:, QUATERNION], reference[:, QUATERNION]
        ).astype(float)
        joints = np.abs(self.joints(solution) - self.joints(reference)).max(axis=1)
        distances = np.vstack([orientation, joints])
        final = StateError(*distances[:, -1].tolist())
        return final, StateError(*distances.max(axis=1).tolist())

    def joints(self, solution: Array | LongArray) -> Array:
        """Return angles gamma [rad] and rates gamma_dot [rad/s], (2, 3, m).

        States have the shape (m, 7 or more).
        """
        with np.errstate(all="ignore"):  # states of a solution that diverges
            columns = tuple(solution.astype(float).T)
            joints = kernel.joints(self.dynamics.model, columns)
        return np.array([joints.gamma, joints.gamma_dot])

    def run_steps(self, method: MethodSteps, steps: int) -> SolverRun:
        """Run with `steps` steps an interval; nan after the last finite state."""
        states = np.full((self.count + 1, len(self.start)), np.nan)
        y = list(self.start)
        states[0] = y
        h = self.interval / steps
        drive = Drive(tuple(self.drive))
        for k in range(self.count):
            y = method.fixed(k * self.interval, h, steps, y, drive)
            if not np.isfinite(y).all():
                break
            states[k + 1] = y
        return SolverRun(states, len(method.method.a) * steps * self.count)

    def simulation(self, method: str, tolerance: float) -> Simulation:
        """Return a simulation whose steps may take long."""
        return Simulation(
            self.scene, method, tolerance=tolerance, step_budget=WHOLE_MOTION_BUDGET
        )

    def run_simulation(self, simulation: Simulation) -> SolverRun:
        """Begin a simulation again and run it; raises RunStopped at a limit."""
        simulation.reset()
        evaluations = simulation.evaluations
        states = [self.start]
        for _ in range(self.count):
            simulation.steps(self.torque, self.interval_ns, 1)
            states.append(tuple(simulation.sample[0]))
        return SolverRun(np.array(states), simulation.evaluations - evaluations)


def _choose_interval(duration_ns: float) -> int:
    """Return the longest interval [ns] of which INTERVALS or more fit in a run.

    Its length is 1, 2 or 5 times a power of ten.
    """
    fitting: list[int] = []
    for power in range(len(str(int(duration_ns)))):
        for factor in (1, 2, 5):
            length = factor * int(10**power)
            if length * INTERVALS <= duration_ns:
                fitting.append(length)
    return max(fitting)


class ReferenceSolution(NamedTuple):
    """A solution with a known error."""

    states: LongArray  # at the instants of comparison
    own: StateError  # their own error
    how: str  # they were found, in words


def solve_reference(problem: InitialValueProblem) -> ReferenceSolution:
    """Solve a problem as accurately as possible.

    Raises RunStopped where no step resolves it.
    """
    solution = None if problem.kinked else _halve_steps(problem)
    if solution is not None:
        rough, fine, steps = solution
        numbers = f"{np.finfo(np.longdouble).precision}-digit floats"
        how = f"DOP853, {problem.interval / steps:.3g} s steps, {numbers}"
    else:
        rough, fine = (
            problem.run_simulation(
                problem.simulation(DOP853.name, tolerance)
            ).states.astype(np.longdouble)
            for tolerance in REFERENCE_TOLERANCES
        )
        how = f"Simulation, dop853, tolerance {REFERENCE_TOLERANCES[-1]:.0e}"
    # Twice the difference of two solutions, but not less than doubles resolve.
    _, change = problem.errors(rough, fine)
    gamma, gamma_dot = np.abs(problem.joints(fine)).max(axis=(1, 2)).tolist()
    own = StateError(
        max(2.0 * change.orientation, LEAST_ORIENTATION_ERROR),
        max(2.0 * change.gamma, DOUBLE_ROUNDING * gamma),
        max(2.0 * change.gamma_dot, DOUBLE_ROUNDING * gamma_dot),
    )
    return ReferenceSolution(fine, own, how)


def _halve_steps(
    problem: InitialValueProblem,
) -> tuple[LongArray, LongArray, int] | None:
    """Halve the steps until the solution stops changing.

    Returns the last two solutions, and the steps an interval. None where so many steps
    as are allowed do not suffice.
    """
    steps = 1
    change = math.inf
    before = after = run_extended(problem, steps)
    # all of them together; halved at least once
    most = max(_MOST_REFERENCE_STEPS, 4 * problem.count)
    while 4 * steps * problem.count <= most and not change < RESOLVED_CHANGE:
        before = after
        last_change = change
        steps *= 2
        after = run_extended(problem, steps)
        _, largest = problem.errors(before, after)
        change = largest.orientation
        if change > last_change and last_change < LARGEST_CHANGE:  # by rounding
            break
    return (before, after, steps) if change < LARGEST_CHANGE else None


def exact_derivative(problem: InitialValueProblem) -> Derivative:
    """Return the derivative of a problem for any numbers that NumPy takes."""
    slope = compile_for_arrays(problem.system.program)
    drive = problem.drive

    def derivative(t: Any, y: Sequence[Any], _: Any) -> Sequence[Any]:
        return slope(t, *y, *drive)

    return derivative


def run_extended(problem: InitialValueProblem, steps: int) -> LongArray:
    """Return states at the instants, in long doubles.

    There are `steps` steps of EXACT_DOP853 an interval. The quaternion is kept at
    length 1. A row of nan stands where there is no finite state.
    """
    derivative = exact_derivative(problem)
    result = np.full((problem.count + 1, len(problem.start)), np.nan, np.longdouble)
    result[0] = problem.start
    y = result[0].copy()
    h = np.longdouble(problem.interval) / steps
    stages = [None] * len(EXACT_DOP853.a)
    with contextlib.suppress(ArithmeticError, ValueError), np.errstate(all="ignore"):
        for k in range(problem.count * steps):
            step = explicit_step(derivative, EXACT_DOP853, k * h, h, [*y], stages)
            y = np.array(step.state)
            quaternion = y[QUATERNION]
            quaternion /= np.sqrt(quaternion @ quaternion)
            if (k + 1) % steps == 0:
                result[(k + 1) // steps] = y
    return result
