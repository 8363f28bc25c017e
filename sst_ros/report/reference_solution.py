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
from sst_ros.state import NANOSECONDS

LongArray: TypeAlias = NDArray[np.longdouble]
Run: TypeAlias = tuple[Array, int]
"""States at the instants of comparison, and evaluations of the right-hand side.

The states have the shape (count + 1, n).
"""

_MOST_REFERENCE_STEPS = 25_000  # in extended precision: half a minute's work
INTERVALS = 20  # solutions are compared at this many instants or more

EXACT_DOP853 = replace(
    DOP853,
    b=(*DOP853.b[:-1], float(1 - sum(map(Fraction, DOP853.b[:-1])))),
    error=(),
    damping=(),
)
"""DOP853 without error estimates. As doubles its weights do not quite add up to 1,
which no step size would show; here they do, exactly.
"""


class StateError(NamedTuple):
    """Distance from the reference.

    Of the orientation [rad], gamma [rad] and gamma_dot [rad/s].
    """

    orientation: float
    gamma: float
    gamma_dot: float


class InitialValueProblem:
    """A scene as an initial value problem.

    Raises AssemblyError where the initial gamma has no unique admissible assembly,
    InputError where the scene cannot start, or stops at once. Solutions are compared at
    instants `interval_ns` apart, by default at INTERVALS of them or more.
    """

    def __init__(self, scene: Scene, interval_ns: int | None = None) -> None:
        self.scene, self.dynamics = scene, Dynamics.of(scene)
        self.torque = scene.torque or (0.0, 0.0, 0.0)  # [N m]
        self.system = ODE(self.dynamics, scene.torque, work=True)
        self.drive = (0.0,) * len(self.system.drive)  # its inputs
        start = initial_state(scene, Geometry.of(scene))
        # at time zero
        self.start = (*start, *(0.0,) * (len(self.system.state) - len(start)))
        largest = max(map(abs, scene.torque.amplitude)) if scene.torque else 0.0
        self.clamped = scene.torque_limit is not None and largest > scene.torque_limit
        self.kinked = self.clamped or scene.stroke.at_end == "elastic"
        motion = simulate(scene, duration=scene.duration or WHOLE_RUN_S)
        end_time, reason = float(motion.t[-1]), motion.message.partition(": ")[2]
        # before the duration
        self.ends = f"stop at {end_time:.6f} s, {reason}" if reason else ""
        lasts = end_time * NANOSECONDS >= 1000 * INTERVALS
        requirement = (
            f"the run is over before it can be studied: {self.ends or f'{end_time} s'}"
        )
        refuse_unless(scene.name, ("initial", end_time, lasts, requirement))
        # Instants of comparison lie 1, 2 or 5 times a power of ten apart.
        # may be a little less than it is called
        whole_ns = end_time * NANOSECONDS * (1.0 + 1e-9)
        lengths = (f * 10**n for n in range(18) for f in (1, 2, 5))
        self.interval_ns = interval_ns or max(
            x for x in lengths if x * INTERVALS <= whole_ns
        )
        self.interval = self.interval_ns / NANOSECONDS  # [s]
        self.count = math.floor(whole_ns / self.interval_ns)
        # [s]
        self.times: Array = self.interval_ns * np.arange(self.count + 1) / NANOSECONDS
        self.seconds = float(self.times[-1])

    def errors(
        self, solution: Array | LongArray, reference: LongArray
    ) -> tuple[StateError, StateError]:
        """Distances of states (m, 7 or more) at the end, and the largest.

        Nan where unknown.
        """
        angle = angle_between(solution[:, :4], reference[:, :4]).astype(float)
        joints = np.abs(self.joints(solution) - self.joints(reference)).max(axis=1)
        distances = np.vstack([angle, joints])
        return StateError(*distances[:, -1].tolist()), StateError(
            *distances.max(axis=1).tolist()
        )

    def joints(self, solution: Array | LongArray) -> Array:
        """Return angles gamma [rad] and rates gamma_dot [rad/s], (2, 3, m).

        States have the shape (m, 7 or more).
        """
        with np.errstate(all="ignore"):
            joints = kernel.joints(
                self.dynamics.model, tuple(solution[:, :7].astype(float).T)
            )
        return np.array([joints.gamma, joints.gamma_dot])

    def run_steps(self, method: MethodSteps, steps: int) -> Run:
        """Run with `steps` steps an interval; nan after the last finite state."""
        result = np.full((self.count + 1, len(self.start)), np.nan)
        result[0] = y = list(self.start)
        h, drive = self.interval / steps, Drive(tuple(self.drive))
        for k in range(self.count):
            y = method.fixed(k * self.interval, h, steps, y, drive)
            if not np.isfinite(y).all():
                break
            result[k + 1] = y
        return result, len(method.method.a) * steps * self.count

    def simulation(self, method: str, tolerance: float) -> Simulation:
        """Return a simulation whose steps may take long."""
        return Simulation(
            self.scene, method, tolerance=tolerance, step_budget=WHOLE_MOTION_BUDGET
        )

    def run_simulation(self, simulation: Simulation) -> Run:
        """Begin a simulation again and run it; raises RunStopped at a limit."""
        simulation.reset()
        before, rows = simulation.evaluations, [self.start]
        for _ in range(self.count):
            simulation.steps(self.torque, self.interval_ns, 1)
            rows.append(tuple(simulation.sample[0]))
        return np.array(rows), simulation.evaluations - before


class ReferenceSolution(NamedTuple):
    """States at the instants of comparison, and their own error.

    Also how they were found.
    """

    states: LongArray
    own: StateError
    how: str


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
            problem.run_simulation(problem.simulation("dop853", tolerance))[0].astype(
                np.longdouble
            )
            for tolerance in (1e-13, 1e-14)
        )
        how = "Simulation, dop853, tolerance 1e-14"
    # Twice the difference of two solutions, but not less than doubles resolve.
    change = problem.errors(rough, fine)[1]
    least = 1e-17, *(2.3e-16 * np.abs(problem.joints(fine)).max(axis=(1, 2))).tolist()
    own = StateError(
        *(max(2.0 * x, floor) for x, floor in zip(change, least, strict=True))
    )
    return ReferenceSolution(fine, own, how)


def _halve_steps(
    problem: InitialValueProblem,
) -> tuple[LongArray, LongArray, int] | None:
    """Halve the steps until the solution stops changing.

    Returns the last two solutions, and the steps an interval. None where so many steps
    as are allowed do not suffice.
    """
    steps, change = 1, math.inf
    before = after = run_extended(problem, 1)
    # all of them together; halved at least once
    most = max(_MOST_REFERENCE_STEPS, 4 * problem.count)
    while 4 * steps * problem.count <= most and not change < 1e-17:
        before, last, steps = after, change, 2 * steps
        after = run_extended(problem, steps)
        change = problem.errors(before, after)[1].orientation
        if change > last < 1e-12:
            break
    return (before, after, steps) if change < 1e-12 else None


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
    derivative, number = exact_derivative(problem), np.longdouble
    result = np.full((problem.count + 1, len(problem.start)), np.nan, dtype=number)
    result[0] = problem.start
    y, h = result[0].copy(), number(problem.interval) / steps
    stages = [None] * len(EXACT_DOP853.a)
    with contextlib.suppress(ArithmeticError, ValueError), np.errstate(all="ignore"):
        for k in range(problem.count * steps):
            y = np.array(
                explicit_step(derivative, EXACT_DOP853, k * h, h, [*y], stages).state
            )
            y[:4] /= np.sqrt(y[:4] @ y[:4])
            if (k + 1) % steps == 0:
                result[(k + 1) // steps] = y
    return result
