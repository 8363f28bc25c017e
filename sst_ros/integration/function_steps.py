# SPDX-License-Identifier: Apache-2.0
"""Steps under torques that are a function.

1. A function of the time is evaluated at the times of all stages, and its torques go
   into the compiled step: `TimeSteps`. Many samples inside a step are under the
   polynomial that meets the function at some of its points, where there is one.
2. A function of the state is called in each stage, between two compiled parts of the
   step: `FeedbackSteps`.
3. Rosenbrock methods, and derivatives in plain Python, take the steps as they are read
   in `steps.py`: `FunctionSteps`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import lru_cache, partial
from typing import Any

import numpy as np
from numpy.polynomial.chebyshev import chebvander

from sst_ros.dynamics.traced_dynamics import LEGS, ODE
from sst_ros.integration.applied_torque import AppliedTorque
from sst_ros.integration.events import JointRanges, largest_overshoot
from sst_ros.integration.method_steps import (
    JOINTS,
    STEP_LENGTH,
    count_step_outputs,
    lagged_torques,
    pair_outputs,
    read_outcome,
    step_cost,
    trace_outputs,
    trace_overshoot,
    trace_steps,
)
from sst_ros.integration.methods import DenseOutput, Method, Rosenbrock, Tableau
from sst_ros.integration.point import Drive, Outcome, Point, Step
from sst_ros.integration.steps import (
    Linearisation,
    NewState,
    compare,
    end_step,
    explicit_step,
    move,
    normalise,
    rosenbrock_step,
    step_pair,
)
from sst_ros.mechanism.generic_math import rows_of
from sst_ros.mechanism.geometry import Array
from sst_ros.programs.compiled import (
    RowsFunction,
    compile_functions,
    compile_rows,
    without_errors,
)
from sst_ros.programs.expression import Program, Routine, trace
from sst_ros.programs.llvm import Function
from sst_ros.state import MOMENT, STAR, cached_property

Polynomial = Callable[[Array], Array]
"""Times after the begin of a step [s], shape (n,) -> states, shape (n, size)."""

_POINTS = 16
"""Points of a step at which a polynomial meets a function, its degree one less.

They are the extrema of Chebyshev's polynomial, the ends among them: a jump near an end
is seen there. Sines of up to 60 rad/s are followed in all steps to 1e-6 rad; with 12
points some steps under sines of 3 rad/s were not.
"""
_LAST_TERMS = 4
"""Terms that vanish where the polynomial follows the function between the points, too
(Battles & Trefethen, SIAM J. Sci. Comput. 25 (2004) 1743-1770).
"""
_SAME_TORQUE = 1e-13
"""Largest of these terms, relative to the torques.

A step turns a joint by about a radian at most, so no joint is off by more radians.
"""
_SAMPLES_AT_ONCE = 256
"""Samples whose torques are computed in one go: each takes several kB meanwhile."""
_WORST_OF_QUARTERS = 0.07
"""Share of a step at which a polynomial through its quarters has the largest error."""
_WORST_OF_DENSE = 0.83
"""Share of a step at which the dense output of DOP853 has it."""


class FunctionSteps:
    """Steps in plain Python, under a function or with a derivative in plain Python.

    Args:
        ode: what is integrated; the first three numbers of its drive are the torques.
        method: how.
        torque: evaluates the functions.
        ranges: of the joints, inside of the limits that a step may meet.
        derivative: of the state in place of that of the ODE, with the same inputs.

    Attributes:
        method: as given.
        cost: evaluations of a step; `pair` takes three steps.
        interpolation_cost: evaluations of `interpolate`.
        worst: share of a step at which the error of that polynomial is largest.

    """

    worst = _WORST_OF_QUARTERS

    def __init__(
        self,
        ode: ODE,
        method: Method,
        torque: AppliedTorque,
        ranges: JointRanges = (),
        derivative: Callable[..., Sequence[float]] | None = None,
    ) -> None:
        if derivative is not None and isinstance(method, Rosenbrock):
            raise ValueError(
                "a derivative of its own has no Jacobian, which the method needs"
            )
        self.method = method
        self._ode = ode
        self._torque = torque
        self._ranges = ranges
        self._derivative = derivative
        self.cost = step_cost(method)
        # steps to the three inner quarters, and slopes at five points
        self.interpolation_cost = 3 * self.cost + 5
        self._size = len(ode.state)

    @cached_property
    def _slope(self) -> Callable[..., Sequence[float]]:
        """The derivative under torques that are numbers."""
        if self._derivative is not None:
            return without_errors(self._derivative, self._size)
        return self._ode.slope

    def load(self) -> None:
        """Have the code compiled that a run calls."""
        _ = self._slope

    def pair(
        self,
        t: float,
        h: float,
        point: Point,
        drive: Drive,
        second_drive: Drive | None = None,
    ) -> Outcome:
        """See `MethodSteps.pair`."""
        if second_drive is None:
            second_drive = drive
        drives = (drive, second_drive, second_drive)

        def step(
            number: int, t: float, h: float, y: Sequence[float], linearised_at: Any
        ) -> NewState:
            return self._step(t, h, y, linearised_at, drives[number])

        pair = step_pair(step, t, h, point.y, point.z, lagged_torques(self._ode))
        joints = self._ode.dynamics.joints(*pair.y[STAR])
        overshoot = largest_overshoot(self._ranges, h, point.joints, joints)
        numbers = pair_outputs(pair, joints, overshoot)
        return read_outcome([*numbers], self._size)

    def single(
        self, t: float, h: float, y: Sequence[float], drive: Drive
    ) -> list[float]:
        """See `MethodSteps.single`."""
        return normalise(self._step(t, h, y, y, drive).state)

    def slope(self, t: float, y: Sequence[float], drive: Drive) -> list[float]:
        """See `MethodSteps.slope`."""
        torque = self._torque.of_drive(drive, t, y)
        return [*self._slope(t, *y, *torque, *drive.numbers[MOMENT])]

    def jacobian(self, t: float, y: Sequence[float], drive: Drive) -> Array:
        """See `MethodSteps.jacobian`."""
        columns: Array = np.array(self._linearise(t, y, drive).columns, dtype=float)
        if not np.isfinite(columns).all():
            raise ArithmeticError("the Jacobian is not finite")
        return np.asarray(columns.T)

    def interpolate(self, step: Step) -> Polynomial | None:
        """Return the states inside a step, through states and slopes at its quarters.

        None where one of these is not finite.
        """
        from scipy.interpolate import KroghInterpolator  # many runs have few samples

        times = [0.25 * k * step.h for k in range(5)]
        inner_states = map(step.inside, times[1:-1])
        states = [step.begin.y, *inner_states, step.end.y]
        data: list[Sequence[float]] = []
        for x, y in zip(times, states, strict=True):
            data += [y, self.slope(step.t + x, y, step.drive)]
        if not np.isfinite(data).all():
            return None
        polynomial: Polynomial = KroghInterpolator(np.repeat(times, 2), data)
        return polynomial

    def _step(
        self,
        t: float,
        h: float,
        y: Sequence[float],
        linearised_at: Sequence[float],
        drive: Drive,
    ) -> NewState:
        method = self.method
        if isinstance(method, Tableau):
            drives = [drive] * len(method.a)
            return explicit_step(self.slope, method, t, h, y, drives)
        linearisation = self._linearise(t, linearised_at, drive)
        return rosenbrock_step(self.slope, linearisation, method, t, h, y, drive)

    def _linearise(self, t: float, y: Sequence[float], drive: Drive) -> Linearisation:
        """Linearise: exactly the motion, and by differences the function's torques."""
        size = self._size
        torque = self._torque.of_drive(drive, t, y)
        moment = drive.numbers[MOMENT]
        numbers = self._ode.linearised_by_torque(t, *y, *torque, *moment)
        rows = np.array(numbers).reshape(-1, size)
        slope, by_time_alone, *_ = rows
        by_torque = rows[-LEGS:]
        by_state = rows[-LEGS - size : -LEGS]
        rate = self._torque.rate(drive, t, y, torque)
        feedback = self._torque.by_state(drive, t, y, torque)
        columns = by_state + feedback.T @ by_torque
        by_time = by_time_alone + rate @ by_torque
        return Linearisation(slope.tolist(), by_time.tolist(), columns.tolist())


class TimeSteps(FunctionSteps):
    """Steps of an explicit method under a function of the time."""

    method: Tableau

    @cached_property
    def _functions(self) -> dict[str, Function]:
        return compile_by_stage(self._ode, self.method, self._ranges)

    def load(self) -> None:
        """Have the code compiled that a run calls."""
        _ = self._functions

    def pair(
        self,
        t: float,
        h: float,
        point: Point,
        drive: Drive,
        second_drive: Drive | None = None,
    ) -> Outcome:
        """See `MethodSteps.pair`."""
        if second_drive is not None:
            raise ValueError("a function of the time is the same for both solutions")
        half = 0.5 * h
        times = [
            *self._times(t, h),
            *self._times(t, half),
            *self._times(t + half, half),
        ]
        stages = self._join(self._torques_at(times, drive), drive)
        numbers = self._functions["pair"](t, h, *point.y, *point.z, *stages)
        return read_outcome(numbers, self._size)

    def single(
        self, t: float, h: float, y: Sequence[float], drive: Drive
    ) -> list[float]:
        """See `MethodSteps.single`."""
        stages = self._join(self._torques_at(self._times(t, h), drive), drive)
        return self._functions["single"](t, h, *y, *stages)

    def jacobian(self, t: float, y: Sequence[float], drive: Drive) -> Array:
        """See `MethodSteps.jacobian`."""
        torque = self._torque.of_drive(drive, t, y)
        return self._ode.matrix(t, y, (*torque, *drive.numbers[MOMENT]))

    def states_inside(
        self, steps: Sequence[Step], counts: Sequence[int], x: Array
    ) -> Array:
        """See `MethodSteps.states_inside`."""
        rows = [(step.t, 0.0, *step.begin.y) for step in steps]
        begins = np.array(rows).repeat(counts, axis=0)
        begins[:, STEP_LENGTH] = x
        torques = self._torques_inside(steps, counts, x)
        # A moment is the same in all stages of a step.
        moments = np.array([step.drive.numbers[MOMENT] for step in steps])
        moments = moments.repeat(counts, axis=0)[:, None, :]
        moments = moments.repeat(len(self.method.c), axis=1)
        drives = np.concatenate([torques, moments], axis=2).reshape(len(x), -1)
        single = compile_rows_by_stage(self._ode, self.method, self._ranges)
        return single(np.hstack([begins, drives]))

    def _times(self, t: float, h: float) -> list[float]:
        """Return the times of the stages of a step."""
        return [t + node * h if node else t for node in self.method.c]

    def _torques_at(self, times: Sequence[float], drive: Drive) -> list[Any]:
        """Return the torques at times of the steps [s].

        The function is called once for times that are equal.
        """
        distinct_times = list(dict.fromkeys(times))
        torques = self._torque.of_drive_at_times(drive, distinct_times)
        torque_by_time = dict(zip(distinct_times, torques, strict=True))
        return [torque_by_time[time] for time in times]

    @staticmethod
    def _join(torques: Sequence[Any], drive: Drive) -> list[float]:
        """Return what acts in each stage, one stage after the other."""
        moment = drive.numbers[MOMENT]
        numbers: list[float] = []
        for torque in torques:
            numbers += torque
            numbers += moment
        return numbers

    def _torques_inside(
        self, steps: Sequence[Step], counts: Sequence[int], x: Array
    ) -> Array:
        """Return torques in the stages of shorter steps to times inside of steps.

        They are those of polynomials where this takes fewer calls, in the steps that
        have one, and those that the function gives in the others. The shape is
        (n, stages, 3).
        """
        nodes = np.array(self.method.c)
        times = np.multiply.outer(x, nodes)  # from the begin of the step
        torques = np.empty((*times.shape, 3))
        is_followed = np.zeros(len(steps), dtype=bool)
        if times.size > _POINTS * len(steps):
            polynomials, is_followed = self._fit(steps)
            lengths = np.array([step.h for step in steps])
            step_of_row = np.repeat(np.arange(len(steps)), counts)
            for rows in _blocks(0, len(x)):
                here = step_of_row[rows]
                basis = _basis(times[rows] / lengths[here, None], polynomials.shape[1])
                torques[rows] = basis @ polynomials[here]
        ends = np.cumsum(counts).tolist()
        for step, count, end, followed in zip(
            steps, counts, ends, is_followed, strict=True
        ):
            if followed:
                continue
            for rows in _blocks(end - count, end):
                stage_times = (step.t + times[rows]).ravel().tolist()
                called = self._torques_at(stage_times, step.drive)
                torques[rows] = np.reshape(called, torques[rows].shape)
        return torques

    def _fit(self, steps: Sequence[Step]) -> tuple[Array, Array]:
        """Return polynomials in steps, and which of them the torques follow.

        The terms are Chebyshev's polynomials, the coefficients have the shape
        (steps, terms, 3).
        """
        called = []
        for step in steps:
            times = (step.t + step.h * _SHARES).tolist()
            called.append(self._torque.of_drive_at_times(step.drive, times))
        torques = np.array(called)
        coefficients = _FIT @ torques
        largest = np.abs(torques).max(axis=(1, 2))
        sizes = np.abs(coefficients).max(axis=2)
        is_large = sizes > _SAME_TORQUE * largest[:, None]
        is_followed = ~is_large[:, -_LAST_TERMS:].any(axis=1)
        terms = np.flatnonzero(is_large[is_followed].any(axis=0))
        size = 1 + terms.max(initial=0)
        return coefficients[:, :size], is_followed


def _basis(shares: Array, size: int) -> Array:
    """Return Chebyshev's polynomials at shares of a step, shape (..., size)."""
    return np.asarray(chebvander(2.0 * shares - 1.0, size - 1))


_SHARES = 0.5 - 0.5 * np.cos(np.pi * np.linspace(0.0, 1.0, _POINTS))
_FIT = np.linalg.inv(_basis(_SHARES, _POINTS))
"""Torques at these shares of a step -> coefficients of the polynomial."""


def _blocks(first: int, end: int) -> list[slice]:
    """Return rows in blocks of `_SAMPLES_AT_ONCE`."""
    begins = range(first, end, _SAMPLES_AT_ONCE)
    return [slice(begin, min(begin + _SAMPLES_AT_ONCE, end)) for begin in begins]


@lru_cache(maxsize=64)
def compile_by_stage(
    ode: ODE, method: Tableau, ranges: JointRanges
) -> dict[str, Function]:
    """Compile `pair` and `single` of steps that take the torques of each stage."""
    return compile_functions(_trace_by_stage(ode, method, ranges), ("pair", "single"))


@lru_cache(maxsize=64)
def compile_rows_by_stage(
    ode: ODE, method: Tableau, ranges: JointRanges
) -> RowsFunction:
    """Compile `single` of `compile_by_stage` for rows of inputs."""
    return compile_rows(_trace_by_stage(ode, method, ranges), "single")


def _trace_by_stage(
    ode: ODE, method: Tableau, ranges: JointRanges
) -> dict[str, Program]:
    steps = trace_steps(
        method, len(ode.state), len(ode.drive), lagged_torques(ode), by_stage=True
    )
    return {
        "slope": ode.program,
        "joints": ode.dynamics.joints_program,
        "overshoot": trace_overshoot(ranges),
        **steps,
    }


class FeedbackSteps(FunctionSteps):
    """Steps of an explicit method under a function of the state.

    The parts of a step between two calls of the function are compiled.
    """

    method: Tableau

    def __init__(
        self,
        ode: ODE,
        method: Tableau,
        torque: AppliedTorque,
        ranges: JointRanges = (),
    ) -> None:
        super().__init__(ode, method, torque, ranges)
        if method.dense is not None:
            self.interpolation_cost = 1 + len(method.dense.c)
            self.worst = _WORST_OF_DENSE

    @cached_property
    def _functions(self) -> dict[str, Function]:
        return compile_stages(self._ode, self.method, self._ranges)

    @cached_property
    def _stages(self) -> list[tuple[float, Function]]:
        """Node and compiled part of each stage."""
        functions = self._functions
        nodes = self.method.c
        return [(node, functions[f"stage{k}"]) for k, node in enumerate(nodes)]

    def load(self) -> None:
        """Have the code compiled that a run calls."""
        _ = self._functions

    def pair(
        self,
        t: float,
        h: float,
        point: Point,
        drive: Drive,
        second_drive: Drive | None = None,
    ) -> Outcome:
        """See `MethodSteps.pair`.

        `stages` are the slopes in the stages of the first.
        """
        if second_drive is None:
            second_drive = drive
        joints = self._functions["joints"]
        half = 0.5 * h
        z = point.z
        slopes, y_end = self._take_stages(t, h, point.y, point.joints, drive)
        _, middle_end = self._take_stages(t, half, z, joints(*z[STAR]), second_drive)
        middle = middle_end[: self._size]
        _, z_end = self._take_stages(
            t + half, half, middle, joints(*middle[STAR]), second_drive
        )
        numbers = self._functions["end"](h, *point.y, *z, *y_end, *z_end)
        return read_outcome(numbers, self._size, slopes)

    def _step(
        self,
        t: float,
        h: float,
        y: Sequence[float],
        linearised_at: Sequence[float],
        drive: Drive,
    ) -> NewState:
        joints = self._functions["joints"](*y[STAR])
        _, numbers = self._take_stages(t, h, y, joints, drive)
        return NewState(numbers[: self._size], None)

    def _take_stages(
        self,
        t: float,
        h: float,
        y: Sequence[float],
        joints: Sequence[float],
        drive: Drive,
    ) -> tuple[list[float], list[float]]:
        """Take a step: return the slopes in its stages, and where it ends.

        The latter is the new state, and its error where the method estimates it.
        `joints` are those of y.
        """
        size = self._size
        moment = drive.numbers[MOMENT]
        evaluate = self._torque.of_state
        function = drive.function
        start = drive.start
        assert function is not None
        slopes: list[float] = []
        point = y
        numbers: list[float] = []
        for node, take_stage in self._stages:
            time = t + node * h if node else t
            torque = evaluate(function, start + time, point, joints)
            numbers = take_stage(time, h, *y, *slopes, *point, *torque, *moment)
            slopes += numbers[:size]
            point = numbers[size : 2 * size]
            joints = numbers[2 * size :]
        return slopes, numbers[size:]

    def interpolate(self, step: Step) -> Polynomial | None:
        """Return the states inside a step by the dense output, if there is one.

        Terms are F_0, F_1, ... of `DenseOutput`.
        """
        dense = self.method.dense
        if dense is None:
            return super().interpolate(step)
        a, weights_of_terms = _arrays_of_dense(dense)
        size = self._size
        h = step.h
        begin = np.array(step.begin.y)
        slopes = np.array(step.stages).reshape(-1, size)
        end = np.array(step.end.y)
        slopes = np.vstack([slopes, self.slope(step.t + h, step.end.y, step.drive)])
        for node, weights in zip(dense.c, a, strict=True):
            point = begin + h * (weights @ slopes)
            slope = self.slope(step.t + node * h, point.tolist(), step.drive)
            slopes = np.vstack([slopes, slope])
        chord = end - begin
        bend = h * slopes[0] - chord
        twist = chord - bend - h * slopes[len(self.method.c)]
        terms = [chord, bend, twist, *(h * (weights_of_terms @ slopes))]
        if not np.isfinite(terms).all():
            return None

        def states(x: Array) -> Array:
            share = np.reshape(x, (-1, 1)) / h
            total = np.zeros((len(share), size))
            for number in reversed(range(len(terms))):
                is_odd = number % 2 == 1
                factor = 1.0 - share if is_odd else share
                total = factor * (terms[number] + total)
            return np.asarray(begin + total)

        return states


@lru_cache(maxsize=8)
def _arrays_of_dense(dense: DenseOutput) -> tuple[list[Array], Array]:
    """Return the weights of a dense output as arrays."""
    return [np.array(weights) for weights in dense.a], np.array(dense.weights)


@lru_cache(maxsize=64)
def compile_stages(
    ode: ODE, method: Tableau, ranges: JointRanges
) -> dict[str, Function]:
    """Compile the programs of `trace_stages`, and `joints`."""
    stages = trace_stages(method, len(ode.state), len(ode.drive), lagged_torques(ode))
    programs = {
        "slope": ode.program,
        "joints": ode.dynamics.joints_program,
        "overshoot": trace_overshoot(ranges),
        **stages,
    }
    return compile_functions(programs, (*stages, "joints"))


@lru_cache(maxsize=16)
def trace_stages(
    method: Tableau, size: int, drive: int, lagged: int
) -> dict[str, Program]:
    """Trace the parts of an explicit step between calls of a function of the state.

    Inputs of the program of a stage are t, h, the state y, the slopes in all stages
    before, and the point and the drive of this stage; outputs its slope, and the point
    of the next stage with its joints; in the last stage the new state and, of a method
    with an estimate, its error. Inputs of `end` are h, both states before a step, and
    for each the outputs of its last stage; its outputs are those of `pair` of
    `trace_steps`.
    """
    slope = Routine("slope", 1 + size + drive, size)
    stages = len(method.a)
    end_size = count_step_outputs(method, size)

    def take_stage(number: int, t: Any, h: Any, *inputs: Any) -> tuple[Any, ...]:
        # Vectors as long as the state: itself, the slopes, and the point.
        vectors_end = (2 + number) * size
        y, *earlier_slopes, point = rows_of(inputs[:vectors_end], size)
        own_slope = slope(t, *point, *inputs[vectors_end:])
        slopes = [*earlier_slopes, own_slope]
        if number == stages - 1:
            return (*own_slope, *end_step(method, h, y, slopes).numbers())
        next_point = move(y, h, method.a[number + 1], slopes)
        return (*own_slope, *next_point, *JOINTS(*next_point[STAR]))

    def end_pair(h: Any, *inputs: Any) -> tuple[Any, ...]:
        y = inputs[:size]
        z = inputs[size : 2 * size]
        y_end, z_end = rows_of(inputs[2 * size :], end_size)
        first = NewState.of(y_end, size)
        second = NewState.of(z_end, size)
        pair = compare(h, y, z, first, second, lagged)
        return trace_outputs(pair, h, y)

    programs = {}
    for number in range(stages):
        count = 2 + (2 + number) * size + drive
        names = [f"i{k}" for k in range(count)]
        programs[f"stage{number}"] = trace(partial(take_stage, number), names)
    count = 1 + 2 * size + 2 * end_size
    programs["end"] = trace(end_pair, [f"i{k}" for k in range(count)])
    return programs
