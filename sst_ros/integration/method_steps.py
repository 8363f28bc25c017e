# SPDX-License-Identifier: Apache-2.0
"""The steps of one scene by one method, as functions of floats.

`steps.py` has the steps as ordinary functions. Here they are traced, as programs that
call the derivative of the scene, and become machine code where llvmlite is installed,
else flat Python with the same bits. Torques that are numbers, or a function of time, go
in as inputs; see `function_steps.py`. Beside one step of both solutions, `pair`, there
are those of several equal periods, `periods`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import lru_cache
from typing import Any

import numpy as np

from sst_ros.dynamics.traced_dynamics import LAG, ODE, STATE_SIZE
from sst_ros.integration.events import JointRanges, largest_overshoot
from sst_ros.integration.methods import Method, Rosenbrock
from sst_ros.integration.point import Drive, Outcome, Point, Step
from sst_ros.integration.steps import (
    Linearisation,
    NewState,
    Pair,
    add_up,
    explicit_step,
    is_not_finite,
    normalise,
    rosenbrock_step,
    step_pair,
)
from sst_ros.mechanism.generic_math import rows_of, select
from sst_ros.mechanism.geometry import Array
from sst_ros.programs.compiled import (
    RowsFunction,
    compile_functions,
    compile_rows,
)
from sst_ros.programs.expression import Number, Program, Routine, trace
from sst_ros.programs.llvm import Function
from sst_ros.state import JOINT_COUNT, STAR, cached_property

JACOBIAN_COST = 30
"""Measured cost of a Jacobian with factorisation, in evaluations of plain Python."""

JOINT_NUMBERS = 2 * JOINT_COUNT
"""Numbers of `joints`: the angles and their rates."""

JOINTS = Routine("joints", STATE_SIZE, JOINT_NUMBERS)
_OVERSHOOT = Routine("overshoot", 1 + 2 * JOINT_NUMBERS, 1)
"""Programs that others call: joints of a star, and `trace_overshoot`."""

PERIODS_AT_ONCE = 16
"""Periods of one call of `periods`: its own cost is then a small part of theirs."""

STEP_LENGTH = 1
"""Place of the length of a step among the inputs of `single`."""

LARGEST_GROWTH = 5.0
"""Factor by which a step grows at most: one small estimate may be chance."""
LARGEST_SHRINKAGE = 0.2
"""Factor by which it shrinks at most: an error far too large says little."""
SAFETY = 0.9
"""Share of the step that the error allows, so that few steps are rejected."""


class MethodSteps:
    """Steps of an ODE under torques that are numbers or a sine.

    Args:
        ode: what is integrated; its drive is the numbers of a `Drive`.
        method: how.
        ranges: of the joints, inside of the limits that a step may meet.

    Attributes:
        method: as given.
        cost: evaluations of a step; `pair` takes three steps.

    """

    def __init__(self, ode: ODE, method: Method, ranges: JointRanges = ()) -> None:
        self.method = method
        self._ode = ode
        self._ranges = ranges
        self.cost = step_cost(method)
        self._size = len(ode.state)

    @cached_property
    def _programs(self) -> dict[str, Program]:
        """`pair`, `single` and `slope` of this scene, and what they call."""
        ode = self._ode
        method = self.method
        programs = {
            "slope": ode.program,
            "joints": ode.dynamics.joints_program,
            "overshoot": trace_overshoot(self._ranges),
            **trace_steps(method, self._size, len(ode.drive), lagged_torques(ode)),
        }
        if isinstance(method, Rosenbrock):
            programs["linearise"] = ode.jacobian
        return programs

    @cached_property
    def _functions(self) -> dict[str, Function]:
        return compile_functions(self._programs, ("pair", "single", "slope"))

    @cached_property
    def _periods(self) -> Function:
        drive_size = len(self._ode.drive)
        program = trace_periods(self._size, drive_size)
        programs = {**self._programs, "periods": program}
        return compile_functions(programs, ("periods",))["periods"]

    @cached_property
    def _single_of_rows(self) -> RowsFunction:
        return compile_rows(self._programs, "single")

    def load(self) -> None:
        """Have the code compiled that a run calls."""
        _ = self._functions
        if not isinstance(self.method, Rosenbrock):
            _ = self._periods

    def pair(
        self,
        t: float,
        h: float,
        point: Point,
        drive: Drive,
        second_drive: Drive | None = None,
    ) -> Outcome:
        """Advance both solutions of a point by h: by one step, and by two of h / 2.

        The second one has the drive `second_drive`, by default that of the first.
        Returns where they end, and the local error estimate, which is infinite where a
        number of the step is not finite.
        """
        if second_drive is None:
            second_drive = drive
        numbers = self._functions["pair"](
            t, h, *point.y, *point.z, *drive.numbers, *second_drive.numbers
        )
        return read_outcome(numbers, self._size)

    def periods(
        self, h: float, point: Point, drive: Drive, tolerance: float
    ) -> tuple[Point, list[float]]:
        """Advance through equal periods of h under one drive, by a step of each.

        They are PERIODS_AT_ONCE, or those before one that is not plain, see
        `trace_periods`.

        Returns:
            The point at the end, but for the length of its next step, and the size of
            the error of each period. Without any the point is not to be used.

        """
        size = self._size
        z_end = 2 * size
        joints_end = z_end + JOINT_NUMBERS
        numbers = self._periods(h, tolerance, *point.y, *point.z, *drive.numbers)
        *sizes, count = numbers[joints_end:]
        number = int(count)
        end = point._replace(
            y=numbers[:size],
            z=numbers[size:z_end],
            joints=tuple(numbers[z_end:joints_end]),
            steps=point.steps + number,
        )
        return end, sizes[:number]

    def single(
        self, t: float, h: float, y: Sequence[float], drive: Drive
    ) -> list[float]:
        """Advance a state alone by h; its error is not looked at.

        Its numbers are nan where the step has no finite result.
        """
        return self._functions["single"](t, h, *y, *drive.numbers)

    def fixed(
        self, t: float, h: float, count: int, y: Sequence[float], drive: Drive
    ) -> list[float]:
        """Advance a state by `count` steps of h; their errors are not looked at."""
        single = self._functions["single"]
        numbers = drive.numbers
        state = [*y]
        for k in range(count):
            state = single(t + k * h, h, *state, *numbers)
        return state

    def states_after(self, rows: Array) -> Array:
        """Return what `single` does for rows of t, h, state and drive, (n, size)."""
        return self._single_of_rows(rows)

    def states_inside(
        self, steps: Sequence[Step], counts: Sequence[int], x: Array
    ) -> Array:
        """Return states inside steps, each by a shorter step from the begin, (n, size).

        Args:
            steps: those of this method in a run.
            counts: how many states are asked for in each.
            x: their times after the begin of their step [s], shape (n,): the lengths of
                the shorter steps.

        """
        rows = [(step.t, 0.0, *step.begin.y, *step.drive.numbers) for step in steps]
        inputs = np.array(rows).repeat(counts, axis=0)
        inputs[:, STEP_LENGTH] = x
        return self.states_after(inputs)

    def slope(self, t: float, y: Sequence[float], drive: Drive) -> list[float]:
        """Return the derivative of the state."""
        return self._functions["slope"](t, *y, *drive.numbers)

    def jacobian(self, t: float, y: Sequence[float], drive: Drive) -> Array:
        """Return the exact Jacobian, shape (size, size).

        Raises ArithmeticError where it is not finite.
        """
        return self._ode.matrix(t, y, drive.numbers)


@lru_cache(maxsize=64)
def steps_of(ode: ODE, method: Method, ranges: JointRanges = ()) -> MethodSteps:
    """Return the steps of an ODE by a method, compiled once for all its runs."""
    return MethodSteps(ode, method, ranges)


@lru_cache(maxsize=64)
def trace_overshoot(ranges: JointRanges) -> Program:
    """Trace `largest_overshoot` as the program `overshoot`.

    Its inputs are the length of a step, and the joints at its begin and its end.
    """
    numbers = []
    for joint, least, most in ranges:
        least = Number(least, ("least", joint))
        most = Number(most, ("most", joint))
        numbers.append((joint, least, most))

    def compute(h: Any, *joints: Any) -> tuple[Any]:
        begin = joints[:JOINT_NUMBERS]
        end = joints[JOINT_NUMBERS:]
        return (largest_overshoot(tuple(numbers), h, begin, end),)

    names = [f"i{k}" for k in range(2 * JOINT_NUMBERS)]
    return trace(compute, ("h", *names))


@lru_cache(maxsize=64)
def trace_steps(
    method: Method, size: int, drive: int, lagged: int, *, by_stage: bool = False
) -> dict[str, Program]:
    """Trace the programs `step`, `pair` and `single` of a method.

    They call the programs `slope` (t, state, drive), `joints` (first seven numbers of
    the state), `overshoot` (see `trace_overshoot`) and, of a Rosenbrock method,
    `linearise`, which has the outputs of `ODE.jacobian`. Inputs of `pair` are t, h,
    both solutions and their drives; for its outputs see `pair_outputs`. Inputs of
    `single` are t, h, state and drive; its outputs are the new state.

    Args:
        method: how.
        size: numbers of the state.
        drive: numbers of the drive.
        lagged: numbers of the state that are lagging torques.
        by_stage: whether an explicit step takes a drive for each stage.

    """
    tracer = _StepTracer(method, size, drive, lagged, by_stage)
    state = [f"y{i}" for i in range(size)]
    second_state = [f"z{i}" for i in range(size)]
    point = [f"near{i}" for i in range(tracer.point_size)]
    drives = [f"d{i}" for i in range(tracer.drive_size)]
    second_count = tracer.drive_size
    if by_stage:  # both steps of the second solution have drives of their own
        second_count = 2 * second_count
    second_drives = [f"e{i}" for i in range(second_count)]
    pair_inputs = ("t", "h", *state, *second_state, *drives, *second_drives)
    return {
        "step": trace(tracer.take_step, ("t", "h", *state, *point, *drives)),
        "pair": trace(tracer.take_pair, pair_inputs),
        "single": trace(tracer.take_single, ("t", "h", *state, *drives)),
    }


@lru_cache(maxsize=64)
def trace_periods(size: int, drive: int) -> Program:
    """Trace the program `periods`: PERIODS_AT_ONCE equal periods by one step each.

    It calls the program `pair`. A period is plain where the error of its step is below
    the tolerance, all numbers are finite, and no joint can have reached a limit. The
    first that is not ends them: what follows it is not used. Inputs are the length of a
    period, the tolerance, both solutions and the drive. Outputs are both solutions and
    the joints at the end of the last plain period, the size of the error of each, and
    their number.

    Args:
        size: numbers of the state.
        drive: numbers of the drive.

    """
    solutions_size = 2 * size
    output_count = solutions_size + JOINT_NUMBERS + 3  # see `pair_outputs`
    pair = Routine("pair", 2 + solutions_size + 2 * drive, output_count)

    def take(h: Any, tolerance: Any, *inputs: Any) -> list[Any]:
        drive_numbers = inputs[solutions_size:]
        last = [*inputs[:solutions_size], *[0.0] * JOINT_NUMBERS]
        sizes = []
        is_plain: Any = 1.0
        count: Any = 0.0
        for _ in range(PERIODS_AT_ONCE):
            solutions = last[:solutions_size]
            results = pair(0.0, h, *solutions, *drive_numbers, *drive_numbers)
            *ends, error, total, overshoot = results
            is_plain = select(tolerance - error, is_plain, 0.0)
            is_plain = select(is_not_finite(total), 0.0, is_plain)
            is_plain = select(-overshoot, is_plain, 0.0)
            count = count + is_plain
            sizes.append(error)
            last = [
                select(is_plain, after, before)
                for before, after in zip(last, ends, strict=True)
            ]
        return [*last, *sizes, count]

    solutions = [f"y{i}" for i in range(solutions_size)]
    drives = [f"d{i}" for i in range(drive)]
    return trace(take, ("h", "tolerance", *solutions, *drives))


class _StepTracer:
    """The functions that `trace_steps` traces; it takes the same arguments.

    Attributes:
        point_size: numbers of the state at which a step linearises; none if explicit.
        drive_size: numbers of the drives of a step.

    """

    def __init__(
        self, method: Method, size: int, drive: int, lagged: int, by_stage: bool
    ) -> None:
        self._method = method
        self._size = size
        self._drive = drive
        self._lagged = lagged
        self._by_stage = by_stage
        self.point_size = size if isinstance(method, Rosenbrock) else 0
        self.drive_size = drive * len(method.a) if by_stage else drive
        self._slope = Routine("slope", 1 + size + drive, size)
        step_inputs = 2 + size + self.point_size + self.drive_size
        self._step = Routine("step", step_inputs, count_step_outputs(method, size))

    def take_step(self, t: Any, h: Any, *inputs: Any) -> list[Any]:
        """Return the new state, and its error where the method estimates it."""
        size = self._size
        method = self._method
        derivative = self._derivative
        y = inputs[:size]
        point = inputs[size : size + self.point_size]
        drive = inputs[size + self.point_size :]
        if isinstance(method, Rosenbrock):
            linearisation = self._linearise(t, point, drive)
            new = rosenbrock_step(derivative, linearisation, method, t, h, y, drive)
        else:
            drives: list[Any] = [drive] * len(method.a)
            if self._by_stage:
                drives = rows_of(drive, self._drive)
            new = explicit_step(derivative, method, t, h, y, drives)
        return new.numbers()

    def take_pair(self, t: Any, h: Any, *inputs: Any) -> tuple[Any, ...]:
        """Return what both solutions have become, and the size of the error."""
        size = self._size
        y = inputs[:size]
        z = inputs[size : 2 * size]
        drive_inputs = inputs[2 * size :]
        second_drives = drive_inputs[self.drive_size :]
        # of the step of y, and of both steps of z, which may have the same
        drives_of_steps = (
            drive_inputs[: self.drive_size],
            second_drives[: self.drive_size],
            second_drives[-self.drive_size :],
        )

        def call(
            number: int, t: Any, h: Any, y: Sequence[Any], linearised_at: Sequence[Any]
        ) -> NewState:
            point = linearised_at[: self.point_size]
            results = self._step(t, h, *y, *point, *drives_of_steps[number])
            return NewState.of(results, size)

        pair = step_pair(call, t, h, y, z, self._lagged)
        return trace_outputs(pair, h, y)

    def take_single(self, t: Any, h: Any, *inputs: Any) -> tuple[Any, ...]:
        """Return the new state."""
        size = self._size
        y = inputs[:size]
        point = y[: self.point_size]
        results = self._step(t, h, *y, *point, *inputs[size:])
        return tuple(normalise(results[:size]))

    def _derivative(
        self, t: Any, y: Sequence[Any], numbers: Sequence[Any]
    ) -> Sequence[Any]:
        return self._slope(t, *y, *numbers)

    def _linearise(
        self, t: Any, y: Sequence[Any], numbers: Sequence[Any]
    ) -> Linearisation:
        size = self._size
        linearise = Routine("linearise", 1 + size + self._drive, (size + 2) * size)
        slope, by_time, *columns = rows_of(linearise(t, *y, *numbers), size)
        return Linearisation(slope, by_time, columns)


def step_cost(method: Method) -> int:
    """Return the evaluations of a step, its Jacobian included."""
    stages = len(method.a)
    return stages + JACOBIAN_COST if isinstance(method, Rosenbrock) else stages


def count_step_outputs(method: Method, size: int) -> int:
    """Return how many numbers a step gives: the state, and its error if estimated."""
    estimates_error = isinstance(method, Rosenbrock) or bool(method.error)
    return 2 * size if estimates_error else size


def lagged_torques(ode: ODE) -> int:
    """Return how many numbers of the state are torques that lag."""
    return len(LAG) if set(LAG) <= set(ode.state) else 0


def pair_outputs(pair: Pair, joints: Sequence[Any], overshoot: Any) -> tuple[Any, ...]:
    """Return the outputs of `pair`.

    They are both new solutions, the joints of the first, the size of its error, a total
    that is finite where all numbers are, and the joints' overshoot.
    """
    total = pair.total + add_up(joints)
    return (*pair.y, *pair.z, *joints, pair.size, total, overshoot)


def trace_outputs(pair: Pair, h: Any, y: Sequence[Any]) -> tuple[Any, ...]:
    """Return the outputs of `pair` after a step of h from y.

    They are traced, as calls of the programs `joints` and `overshoot`.
    """
    joints = JOINTS(*pair.y[STAR])
    (overshoot,) = _OVERSHOOT(h, *JOINTS(*y[STAR]), *joints)
    return pair_outputs(pair, joints, overshoot)


def read_outcome(
    numbers: list[float], size: int, stages: Sequence[Any] = ()
) -> Outcome:
    """Read the outputs of `pair`, see `pair_outputs`; a state has `size` numbers."""
    error, total, overshoot = numbers[-3:]
    return Outcome(
        numbers[:size],
        numbers[size : 2 * size],
        tuple(numbers[2 * size : 2 * size + JOINT_NUMBERS]),
        error if math.isfinite(total) else math.inf,
        overshoot < 0.0,
        stages,
    )


def step_factor(error: float, method: Method) -> float:
    """Return the next step's factor by a local error relative to the tolerance."""
    if error == 0.0:
        return LARGEST_GROWTH
    if not math.isfinite(error):
        return LARGEST_SHRINKAGE
    factor: float = SAFETY * error ** (-1.0 / (method.error_order + 1))
    return min(max(factor, LARGEST_SHRINKAGE), LARGEST_GROWTH)
