# SPDX-License-Identifier: Apache-2.0
"""The ticks of a sampled controller, on balls.

Between ticks the torques are held, so that a motion is one of a smooth equation with
three more numbers that never change. At a tick the law of `control.law`, traced as the
controllers of a batch have it, is a function of state, memory and noise. A region goes
through it by the mean value theorem: its directions by the Jacobian at the middle, what
the Jacobian varies by over the region as new ones. Noise is new at every tick: it adds
directions, so that the feedback of later ticks takes them back.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from sst_ros.control.actuator_space import REFERENCE_SIZES, Reference
from sst_ros.control.controller import Controller
from sst_ros.dynamics import kernel
from sst_ros.mechanism.generic_math import (
    Quadruple,
    Triple,
    add,
    axpy,
    multiply,
    quaternion_product,
    triple,
)
from sst_ros.programs.expression import divide, trace
from sst_ros.proof.balls import (
    arb,
    arb_mat,
    between,
    column,
    entries,
    magnitude,
)
from sst_ros.proof.enclosure import (
    Refused,
    Region,
    SideRecord,
    compile_on_balls,
)
from sst_ros.proof.root import krawczyk
from sst_ros.proof.scene_balls import Parts, SceneBalls

MOST_DIRECTIONS = 600  # of a region, beyond which the smallest are put into a box
KEPT_DIRECTIONS = 450  # of them behind that
HALF_ULP = 2.0**-53  # of a double, relative to it
ATAN_TERMS = 40  # of the series of atan(t) / t
SMALL_TANGENT = 0.25  # largest square of the tangent of half an error on SO(3)
LOST = "the orientation at the measured angles is not proven to be the only one near"
FAR = "the error on SO(3) may exceed what the series of its logarithm is proven for"

_EXACT_INPUTS = {
    "guess": 4,
    **REFERENCE_SIZES,
    "feedforward": 3,
    "held": 3,
    "limit": 1,
    "rest": 1,
}
"""Sizes of the exact numbers that a tick takes: reference, its torques, limit."""


def name_parts(sizes: Mapping[str, int]) -> list[str]:
    """Return names of the numbers of some parts."""
    return [f"{name}_{k}" for name, size in sizes.items() for k in range(size)]


def turn_near_zero(quaternion: Quadruple, unit_ball: Any) -> Triple:
    """Return the rotation vector of a small turn.

    `law.rotation_vector` divides by 0 there. With t = |(x, y, z)| / w it is 2 atan(t) /
    t (x, y, z) / w. What the alternating series of atan(t) / t leaves out is less than
    its next term, and so is its derivative: both are in those of `unit_ball` t^(2
    ATAN_TERMS), for a ball from -1 to 1.
    """
    x, y, z, w = quaternion
    tangent: Triple = (x / w, y / w, z / w)
    square = sum(component * component for component in tangent)
    total = unit_ball
    for k in reversed(range(ATAN_TERMS)):
        coefficient = (-1.0) ** k / (2 * k + 1)
        # As a double it is off by half a unit in its last place at most.
        doubt = 0.0 if k == 0 else unit_ball * (HALF_ULP * coefficient)
        total = total * square + coefficient + doubt
    return multiply(2.0 * total, tangent)


class TrackingRow(NamedTuple):
    """What is proven at a tick: middles and bounds, by joint."""

    time: float
    error: list[tuple[Any, Any]]  # desired - true gamma [rad]
    torque: list[tuple[Any, Any]]  # that the controller commands [N m]


class _Response(NamedTuple):
    """The law at a tick: values at the middle, and slopes in all of the region."""

    values: list[Any]
    by_region: list[list[Any]]  # a row for each value
    by_noise: list[list[Any]]
    observer_bounds: list[Any]  # by what the observer leaves open


class CertifiedControl(NamedTuple):
    """A controller, and what lies between it and the plant."""

    controller: Controller
    period: float  # from one sample to the next [s]
    noise: tuple[float, float]  # most that an angle [rad] and a rate [rad/s] are off


class SampledLoop:
    """A controller at its ticks, for all numbers of a scene in balls.

    Args:
        control: what is sampled; it computes with the doubles of its own model.
        balls: the plant.
        state: names of the numbers of the state.

    """

    def __init__(
        self, control: CertifiedControl, balls: SceneBalls, state: Sequence[str]
    ) -> None:
        controller = control.controller
        self._controller = controller
        self._settings = controller.settings
        self._size = len(state)
        self._varied = len(balls.inputs)
        self._noise = [arb(control.noise[k // 3]) for k in range(6)]
        self._integrates = bool(self._settings.integral_rate)
        self.memory = name_parts({"integral": 3 if self._integrates else 0})
        self._sizes = {
            "state": self._size,
            "integral": len(self.memory),
            "noise": 6,
            "turn": 3,
            **_EXACT_INPUTS,
        }
        moving = [*state, *self.memory, *name_parts({"noise": 6, "turn": 3})]
        inputs = [*moving, *name_parts(_EXACT_INPUTS)]
        self._respond = balls.compile(self._law, inputs, (*moving, *balls.inputs))
        self._measure = balls.compile(_angles, state, (*state, *balls.inputs))
        start = controller.desire(0.0)[0]
        self._last_assembly = start.quaternion, start.gamma
        self._loops = self._compile_loops() if self._settings.observes else None
        self._limit = controller.law_with(_none, _none).limit

    def _law(self, traced_scene: Parts, *inputs: Any) -> list[Any]:
        """Torques, new memory, and the true error, in symbols."""
        of = divide(self._sizes, inputs)
        legs = list(kernel.leg_motions(traced_scene.model, of["state"]))
        gamma = triple(kernel.joint_angle(leg, 0) for leg in legs)
        gamma_dot = triple(leg.gamma_dot for leg in legs)
        measured = add(gamma, of["noise"][:3]), add(gamma_dot, of["noise"][3:])
        observed = quaternion_product(of["guess"], (*of["turn"], 1.0))
        model = kernel.model_of(self._controller.model)

        def torque(*motion: Any) -> Any:
            return kernel.actuator_torque(model, *motion)[0]

        def turn(quaternion: Quadruple) -> Triple:
            return turn_near_zero(quaternion, of["rest"][0])

        accelerate = self._controller.space.star_accelerations
        scheme = self._controller.law_with(torque, accelerate)
        limit = None if scheme.limit is None else of["limit"][0]
        scheme = scheme._replace(limit=limit, turn=turn)
        desired = Reference(**{name: of[name] for name in REFERENCE_SIZES})
        torques = of["feedforward"], of["held"]
        command = scheme.answer(desired, torques, *measured, observed, of["integral"])
        error = axpy(1.0, desired.gamma, -1.0, gamma)
        return [*command.torque, *command.integral, *error]

    def _compile_loops(self) -> Any:
        """Compile the loop closures of the model: by a turn, gamma and a quaternion."""
        space = self._controller.space
        by = name_parts({"turn": 3, "gamma": 3})

        def closures(*inputs: Any) -> Any:
            turned = quaternion_product(inputs[6:], (*inputs[:3], 1.0))
            return space.newton_step(*turned, *space.carriages(inputs[3:6]))[4:]

        program = trace(closures, [*by, *name_parts({"guess": 4})], by)
        return compile_on_balls(program, [])

    def begin(self, start: Region) -> Region:
        """Return a region with torques and memory, which are zero, behind the state."""
        count = 3 + len(self.memory)
        size = self._size
        places = [*range(size), *range(size + count, len(start.centre) + count)]
        self._first = start.c.ncols()
        n = len(start.centre) + count
        centre = [arb(0)] * n
        for place, number in zip(places, start.centre, strict=True):
            centre[place] = number
        identity = [[arb(int(i == j)) for j in range(n)] for i in range(n)]
        axes = [row[:] for row in identity]
        b = [arb(0)] * n
        columns = [[arb(0)] * start.c.ncols() for _ in range(n)]
        rows = zip(places, start.c.tolist(), start.axes.tolist(), strict=True)
        for place, c_row, axes_row in rows:
            columns[place] = c_row
            for axis_place, x in zip(places, axes_row, strict=True):
                axes[place][axis_place] = x
        for place, x in zip(places, entries(start.b), strict=True):
            b[place] = x
        return Region(
            start.time,
            centre,
            arb_mat(columns),
            start.a,
            arb_mat(axes),
            column(b),
            start.fixed + count,
        )

    def sample(self, region: Region) -> tuple[Region, TrackingRow]:
        """Return the region behind a tick, and what is proven of it."""
        desired, feedforward, held_torque = self._controller.desire(region.time)
        spread = entries(region.spread())
        response = self._answer(region, spread, desired, feedforward, held_torque)
        count = 3 + len(self.memory)
        bounds = self._bounds(region, response)
        pairs = list(zip(response.values, bounds, strict=True))
        row = TrackingRow(region.time, pairs[count:], pairs[:3])
        return self._move(region, spread, response, count), row

    def _answer(
        self,
        region: Region,
        spread: Sequence[Any],
        desired: Reference,
        feedforward: Sequence[float],
        held_torque: Sequence[float],
    ) -> _Response:
        """Enclose the law in a region."""
        size, varied = self._size, self._varied
        memory = len(self.memory)
        box = [
            arb(0, x.upper()) + c for c, x in zip(region.centre, spread, strict=True)
        ]
        noise = [arb(0, x) for x in self._noise]
        guess, turn, turn_box, by_gamma, turn_rest, gamma_slopes = self._observe(
            region, spread, box, noise
        )
        numbers: dict[str, Sequence[float]] = {"guess": guess}
        numbers |= {name: getattr(desired, name) for name in REFERENCE_SIZES}
        if self._settings.space == "so3" and self._settings.mode == "computed_torque":
            numbers["quaternion"] = self._alike(guess, turn_box, desired.quaternion)
        numbers |= {
            "feedforward": feedforward,
            "held": held_torque,
            "limit": (self._limit or 0.0,),
        }
        exact_inputs = [
            arb(x) for name in list(_EXACT_INPUTS)[:-1] for x in numbers[name]
        ]
        exact_inputs.append(between(-1, 1))
        record = SideRecord()
        memories = slice(size + 3, size + 3 + memory)
        tail = slice(len(box) - varied, len(box))

        def run(point: Sequence[Any], off: Sequence[Any], turned: Sequence[Any]) -> Any:
            state = (*point[:size], *point[memories], *off, *turned)
            return [arb(x) for x in self._respond(*state, *exact_inputs, *point[tail])]

        count = 6 + memory
        with record.within(replay=False):
            flat = run(box, noise, turn_box)
        with record.within(replay=True):
            values = run(region.centre, [arb(0)] * 6, turn)[:count]
        blocks = [flat[k : k + count] for k in range(count, len(flat), count)]
        return self._chain_slopes(values, blocks, by_gamma, turn_rest, gamma_slopes)

    def _chain_slopes(
        self,
        values: list[Any],
        blocks: Sequence[Sequence[Any]],
        by_gamma: Any,
        turn_rest: Sequence[Any],
        gamma_slopes: Sequence[dict[int, Any]],
    ) -> _Response:
        """Return the slopes of the law by the region and by the noise.

        The blocks have its derivatives by each input. Those by the turn are chained
        with the slopes of the turn by the measured angles, and these with the slopes
        of the angles by the region.
        """
        size, varied = self._size, self._varied
        memory = len(self.memory)
        width = size + 3 + memory + varied
        count = len(values)
        by_state, by_memory = blocks[:size], blocks[size : size + memory]
        by_noise = blocks[size + memory : size + memory + 6]
        by_turn = blocks[size + memory + 6 : size + memory + 9]
        by_varied = blocks[size + memory + 9 :]
        by_measured = [
            [
                sum((by_turn[j][i] * by_gamma[j, k] for j in range(3)), arb(0))
                for k in range(3)
            ]
            for i in range(count)
        ]
        rows, noise_rows, observer_bounds = [], [], []
        for i in range(count):
            row = [arb(0)] * width
            for j, block in enumerate(by_state):
                row[j] = block[i]
            for j, block in enumerate(by_memory):
                row[size + 3 + j] = block[i]
            for j, block in enumerate(by_varied):
                row[width - varied + j] = block[i]
            for k in range(3):
                for j, slope in gamma_slopes[k].items():
                    row[j] = row[j] + by_measured[i][k] * slope
            rows.append(row)
            off = [block[i] for block in by_noise]
            for k in range(3):
                off[k] = off[k] + by_measured[i][k]
            noise_rows.append(off)
            left = (abs(by_turn[j][i]) * turn_rest[j] for j in range(3))
            observer_bounds.append(sum(left, arb(0)).abs_upper())
        return _Response(values, rows, noise_rows, observer_bounds)

    def _observe(
        self,
        region: Region,
        spread: Sequence[Any],
        box: Sequence[Any],
        noise: Sequence[Any],
    ) -> Any:
        """Enclose the orientation at the measured angles, as a turn from a quaternion.

        It is the turn at the middle, its slopes by the measured angles, and bounds.
        """
        if self._loops is None:
            zero = [arb(0)] * 3
            none: list[dict[int, Any]] = [{}, {}, {}]
            return (0.0, 0.0, 0.0, 1.0), zero, zero, arb_mat(3, 3, [0] * 9), zero, none
        size, varied = self._size, self._varied
        first = len(box) - varied
        places = [*range(size), *range(first, len(box))]
        middle = [
            arb(x) for x in self._measure(*(region.centre[j] for j in places))[:3]
        ]
        flat = [arb(x) for x in self._measure(*(box[j] for j in places))]
        slopes = [
            {j: flat[3 * (k + 1) + i] for k, j in enumerate(places)} for i in range(3)
        ]
        measured = []
        for x, row, off in zip(middle, slopes, noise[:3], strict=True):
            moved = sum((s * arb(0, spread[j].upper()) for j, s in row.items()), arb(0))
            measured.append(x + moved + off)
        gamma = triple(float(x.mid()) for x in measured)
        guess = self._controller.space.follow(*self._last_assembly, gamma)
        self._last_assembly = guess, gamma
        exact_guess = [arb(x) for x in guess]
        loops = self._loops

        def run(*numbers: Any) -> Any:
            return loops(*numbers, *exact_guess)

        root = krawczyk(run, [0.0, 0.0, 0.0], measured, LOST)
        off = column([x - y.mid() for x, y in zip(middle, measured, strict=True)])
        turn = [
            x + moved
            for x, moved in zip(root.middle, entries(root.slopes * off), strict=True)
        ]
        remainder = [
            arb(x).abs_upper() + t.rad()
            for x, t in zip(root.remainder, turn, strict=True)
        ]
        exact = [x.mid() for x in turn]
        widths = column(
            [
                arb(x.rad()) + abs(x.mid() - m)
                for x, m in zip(measured, middle, strict=True)
            ]
        )
        reach = entries(magnitude(root.slopes) * widths)
        turn_box = [
            arb(0, (x + r).upper()) + t
            for t, x, r in zip(exact, reach, remainder, strict=True)
        ]
        return guess, exact, turn_box, root.slopes, remainder, slopes

    def _alike(
        self, guess: Sequence[float], turn: Sequence[Any], desired: Sequence[float]
    ) -> Sequence[float]:
        """Return a desired quaternion with the sign of the observed one.

        Refused: far.
        """
        x, y, z, w = quaternion_product(tuple(map(arb, guess)), (*turn, arb(1)))
        signed = desired
        if sum(a * float(b) for a, b in zip(desired, (x, y, z, w), strict=True)) < 0.0:
            signed = [-component for component in desired]
        d: Any = tuple(map(arb, signed))
        first, second, third, real = quaternion_product((-x, -y, -z, w), d)
        if (
            not real > 0
            or not (first**2 + second**2 + third**2) / real**2 < SMALL_TANGENT
        ):
            raise Refused(FAR)
        return signed

    def _bounds(self, region: Region, response: _Response) -> list[Any]:
        """Bound how far the values are from those at the middle; exact errors first."""
        reach = entries(region.spread(arb_mat(response.by_region)))
        noise = entries(magnitude(arb_mat(response.by_noise)) * column(self._noise))
        contributions = zip(
            reach, noise, response.observer_bounds, response.values, strict=True
        )
        return [(x + y + z + v.rad()).upper() for x, y, z, v in contributions]

    def _move(
        self, region: Region, spread: Sequence[Any], response: _Response, count: int
    ) -> Region:
        """Return the region with new torques and memory."""
        n = len(region.centre)
        size = self._size
        rows = [[arb(int(i == j)) for j in range(n)] for i in range(n)]
        noise_rows = [[arb(0)] * 6 for _ in range(n)]
        centre = list(region.centre)
        remainder = [arb(0)] * n
        for k in range(count):
            place = size + k
            rows[place], noise_rows[place] = response.by_region[k], response.by_noise[k]
            centre[place] = response.values[k].mid()
            remainder[place] = response.observer_bounds[k] + response.values[k].rad()
        slopes, noise = arb_mat(rows), arb_mat(noise_rows)
        middle, noise_middle = slopes.mid(), noise.mid()
        widths = column(self._noise)
        error = magnitude(slopes - middle) * column(spread)
        error += magnitude(noise - noise_middle) * widths + column(remainder)
        generators = _Generators.of(region)
        moved = middle * generators.directions
        directions = moved.mid()
        error += magnitude(moved - directions) * generators.widths
        moved_generators = _Generators(directions, generators.widths)
        moved_generators = moved_generators.join(noise_middle, self._noise)
        moved_generators = moved_generators.join_box(entries(error))
        return moved_generators.reduce(self._first).region(region, centre)


class _Generators(NamedTuple):
    """A set of all sums of directions times numbers between bounds.

    No box is put around it from one tick to the next, as a box around a set that turns
    grows; the feedback makes each direction smaller, and the smallest are put together.
    """

    directions: Any  # a column each
    widths: Any  # a column of their bounds

    @classmethod
    def of(cls, region: Region) -> _Generators:
        """Return a region as one set."""
        first = cls(region.c, region.a)
        return first.join(region.axes, entries(region.b))

    def join(self, directions: Any, widths: Sequence[Any]) -> _Generators:
        """Add directions, those of no width left out."""
        columns = [*zip(*self.directions.tolist(), strict=True)]
        bounds = entries(self.widths)
        for k, width in enumerate(widths):
            if width > 0:
                columns.append(tuple(row[k] for row in directions.tolist()))
                bounds.append(width.upper())
        return _Generators(_of_columns(columns), column(bounds))

    def join_box(self, radii: Sequence[Any]) -> _Generators:
        """Add a box."""
        n = len(radii)
        identity = arb_mat([[arb(int(i == j)) for j in range(n)] for i in range(n)])
        return self.join(identity, [arb(x) for x in radii])

    def reduce(self, first: int) -> _Generators:
        """Put the smallest directions into a box where they are too many.

        The first ones are not put into it.
        """
        columns = [*zip(*self.directions.tolist(), strict=True)]
        if len(columns) <= MOST_DIRECTIONS:
            return self
        bounds = entries(self.widths)
        floats = np.abs([[float(x) for x in row] for row in self.directions.tolist()])
        sizes = floats * np.array([float(x) for x in bounds])
        scale = sizes.sum(axis=1, keepdims=True)
        shares = np.max(sizes / np.where(scale > 0.0, scale, 1.0), axis=0)
        shares[:first] = np.inf
        order = np.argsort(shares)
        fold = set(order[: len(columns) - KEPT_DIRECTIONS].tolist())
        kept = [k for k in range(len(columns)) if k not in fold]
        folded = _Generators(
            _of_columns([columns[k] for k in fold]), column([bounds[k] for k in fold])
        )
        box = entries(magnitude(folded.directions) * folded.widths)
        kept_generators = _Generators(
            _of_columns([columns[k] for k in kept]), column([bounds[k] for k in kept])
        )
        return kept_generators.join_box(box)

    def region(self, old_region: Region, centre: Sequence[Any]) -> Region:
        """Return a region of the set about another centre."""
        n = len(centre)
        identity = arb_mat(n, n, [0] * (n * n)) + 1
        return old_region._replace(
            centre=list(centre),
            c=self.directions,
            a=self.widths,
            axes=identity,
            b=column([0] * n),
        )


def _of_columns(columns: Sequence[Sequence[Any]]) -> Any:
    return arb_mat([list(row) for row in zip(*columns, strict=True)])


def _angles(traced_scene: Parts, *state: Any) -> list[Any]:
    """Angles of the actuators of a plant, in symbols."""
    return [
        kernel.joint_angle(leg, 0)
        for leg in kernel.leg_motions(traced_scene.model, state)
    ]


def _none(*_: Any) -> Any:
    """Stand for a function that is not called."""
    raise AssertionError(math.nan)
