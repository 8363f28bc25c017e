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

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from sst_ros.control.actuator_space import REFERENCE_SIZES, Reference, name_parts
from sst_ros.control.controller import Controller
from sst_ros.control.law import Measurement
from sst_ros.dynamics import kernel
from sst_ros.dynamics.traced_dynamics import LEGS
from sst_ros.mechanism.generic_math import (
    Quadruple,
    Triple,
    add,
    axpy,
    multiply,
    quaternion_product,
    rows_of,
    triple,
)
from sst_ros.programs.expression import divide, trace
from sst_ros.proof.balls import (
    arb,
    arb_mat,
    around_zero,
    between,
    column,
    entries,
    from_columns,
    identity,
    inner_product,
    magnitude,
    middles,
    radii,
    zeros,
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

_NOISE_SIZES = {"angle_noise": LEGS, "rate_noise": LEGS}
NOISES = sum(_NOISE_SIZES.values())
_UNIT_BALL = {"unit_ball": 1}  # a ball from -1 to 1, see `turn_near_zero`
_EXACT_INPUTS = {
    "guess": 4,
    **REFERENCE_SIZES,
    "feedforward": 3,
    "held": 3,
    "limit": 1,
}
"""Sizes of the exact numbers that a tick takes: reference, its torques, limit."""


def turn_near_zero(quaternion: Quadruple, unit_ball: Any) -> Triple:
    """Return the rotation vector of a small turn.

    `law.rotation_vector` divides by 0 where the turn is zero. With t = |(x, y, z)| / w
    it is 2 (atan(t) / t) (x, y, z) / w. The alternating series of atan(t) / t is off by
    less than its next term, and so is its derivative: with `unit_ball`, a ball from -1
    to 1, the term unit_ball t^(2 ATAN_TERMS) encloses both.
    """
    x, y, z, w = quaternion
    tangent: Triple = (x / w, y / w, z / w)
    square = sum(component * component for component in tangent)
    total = unit_ball
    for k in reversed(range(ATAN_TERMS)):
        coefficient = (-1.0) ** k / (2 * k + 1)
        rounding: Any = 0.0
        if k > 0:  # as a double it is off by half a unit in its last place at most
            rounding = unit_ball * (HALF_ULP * coefficient)
        total = total * square + coefficient + rounding
    return multiply(2.0 * total, tangent)


class TrackingRow(NamedTuple):
    """What is proven at a tick: middles and bounds, by joint."""

    time: float
    error: list[tuple[Any, Any]]  # desired - true gamma [rad]
    torque: list[tuple[Any, Any]]  # that the controller commands [N m]


class _Response(NamedTuple):
    """The law at a tick: values at the middle, and slopes in all of the region.

    The values are three torques, the new memory, and three errors.
    """

    values: list[Any]
    by_region: list[list[Any]]  # a row for each value
    by_noise: list[list[Any]]
    observer_bounds: list[Any]  # by what the observer leaves open


class _ObservedTurn(NamedTuple):
    """The orientation at the measured angles, as a turn from a quaternion.

    It is the turn at the middle of the region, its slopes by the measured angles, and
    bounds of what these leave out.
    """

    guess: Sequence[float]  # the quaternion
    turn: list[Any]  # exact
    in_region: list[Any]  # balls of the turns at all angles
    by_angles: Any  # slopes, a row for each component of the turn
    remainder: list[Any]
    angle_slopes: list[dict[int, Any]]  # of each angle, by place in the region


class _Places(NamedTuple):
    """Where a region has the state, what ticks change, and the ranges."""

    state: slice
    memory: slice
    changed: slice  # the torques and the memory
    varied: slice
    size: int

    @classmethod
    def of(cls, size: int, memory: int, varied: int) -> _Places:
        """Return the places of so many numbers."""
        behind_torque = size + LEGS
        behind_memory = behind_torque + memory
        total = behind_memory + varied
        return cls(
            slice(0, size),
            slice(behind_torque, behind_memory),
            slice(size, behind_memory),
            slice(behind_memory, total),
            total,
        )


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
        angle_noise, rate_noise = map(arb, control.noise)
        self._noise = [angle_noise] * LEGS + [rate_noise] * LEGS
        integrals = LEGS if self._settings.integral_rate else 0
        self.memory = name_parts({"integral": integrals})
        self._places = _Places.of(len(state), integrals, len(balls.inputs))
        moving_sizes = {
            "state": len(state),
            "integral": integrals,
            **_NOISE_SIZES,
            "turn": 3,
        }
        self._sizes = moving_sizes | _EXACT_INPUTS | _UNIT_BALL
        self._slope_sizes = moving_sizes | {"varied": len(balls.inputs)}
        by = (*name_parts(moving_sizes), *balls.inputs)
        self._respond = balls.compile(self._law, name_parts(self._sizes), by)
        self._measure = balls.compile(_angles, state, (*state, *balls.inputs))
        # Where the orientation at the next tick is looked for from.
        start, _, _ = controller.desire(0.0)
        self._last_assembly = start.quaternion, start.gamma
        self._loops = self._compile_loops() if self._settings.observes else None
        self._limit = controller.law_with(_none, _none).limit
        self._start_directions = 0  # of a region, never put into a box

    def _law(self, traced_scene: Parts, *inputs: Any) -> list[Any]:
        """Torques, new memory, and the true error, in symbols."""
        of = divide(self._sizes, inputs)
        legs = list(kernel.leg_motions(traced_scene.model, of["state"]))
        gamma = triple(kernel.joint_angle(leg, 0) for leg in legs)
        gamma_dot = triple(leg.gamma_dot for leg in legs)
        measured = Measurement(
            add(gamma, of["angle_noise"]), add(gamma_dot, of["rate_noise"])
        )
        observed = quaternion_product(of["guess"], (*of["turn"], 1.0))
        model = kernel.model_of(self._controller.model)

        def torque(*motion: Any) -> Any:
            return kernel.actuator_torque(model, *motion)[0]

        def turn(quaternion: Quadruple) -> Triple:
            return turn_near_zero(quaternion, of["unit_ball"][0])

        accelerate = self._controller.space.star_accelerations
        scheme = self._controller.law_with(torque, accelerate)
        limit = None if scheme.limit is None else of["limit"][0]
        scheme = scheme._replace(limit=limit, turn=turn)
        desired = Reference(**{name: of[name] for name in REFERENCE_SIZES})
        torques = of["feedforward"], of["held"]
        command = scheme.answer(desired, torques, measured, observed, of["integral"])
        error = axpy(1.0, desired.gamma, -1.0, gamma)
        return [*command.torque, *command.integral, *error]

    def _compile_loops(self) -> Any:
        """Compile the loop closures of the model: by a turn, gamma and a quaternion."""
        space = self._controller.space
        sizes = {"turn": 3, "gamma": 3, "guess": 4}

        def closures(*inputs: Any) -> Any:
            of = divide(sizes, inputs)
            turned = quaternion_product(of["guess"], (*of["turn"], 1.0))
            step = space.newton_step(*turned, *space.carriages(of["gamma"]))
            _x, _y, _z, _w, *residuals = step
            return residuals

        by = name_parts({"turn": 3, "gamma": 3})
        return compile_on_balls(trace(closures, name_parts(sizes), by), [])

    def begin(self, start: Region) -> Region:
        """Return a region with torques and memory, which are zero, behind the state."""
        changed = self._places.changed
        count = LEGS + len(self.memory)

        def widen(numbers: Sequence[Any], new_numbers: Sequence[Any]) -> list[Any]:
            return [
                *numbers[: changed.start],
                *new_numbers,
                *numbers[changed.start :],
            ]

        zero = [arb(0)] * count
        start_directions = start.c.ncols()
        self._start_directions = start_directions
        columns = widen(start.c.tolist(), [[arb(0)] * start_directions] * count)
        axes = [widen(row, zero) for row in start.axes.tolist()]
        new_axes = identity(self._places.size).tolist()[changed]
        return Region(
            start.time,
            widen(start.centre, zero),
            arb_mat(columns),
            start.a,
            arb_mat(widen(axes, new_axes)),
            column(widen(entries(start.b), zero)),
            start.fixed + count,
        )

    def sample(self, region: Region) -> tuple[Region, TrackingRow]:
        """Return the region behind a tick, and what is proven of it."""
        desired, feedforward, held_torque = self._controller.desire(region.time)
        spread = entries(region.spread())
        response = self._answer(region, spread, desired, feedforward, held_torque)
        bounds = self._bounds(region, response)
        pairs = list(zip(response.values, bounds, strict=True))
        row = TrackingRow(region.time, error=pairs[-LEGS:], torque=pairs[:LEGS])
        return self._move(region, spread, response), row

    def _answer(
        self,
        region: Region,
        spread: Sequence[Any],
        desired: Reference,
        feedforward: Sequence[float],
        held_torque: Sequence[float],
    ) -> _Response:
        """Enclose the law in a region."""
        box = _sums(around_zero(spread), region.centre)
        noise = around_zero(self._noise)
        observed = self._observe(region, spread, box, noise)
        numbers: dict[str, Sequence[float]] = {"guess": observed.guess}
        for name in REFERENCE_SIZES:
            numbers[name] = getattr(desired, name)
        if self._settings.space == "so3" and self._settings.mode == "computed_torque":
            numbers["quaternion"] = _with_sign_of(
                observed.guess, observed.in_region, desired.quaternion
            )
        numbers["feedforward"] = feedforward
        numbers["held"] = held_torque
        numbers["limit"] = (self._limit or 0.0,)
        exact_inputs = [arb(x) for name in _EXACT_INPUTS for x in numbers[name]]

        def run(
            point: Sequence[Any], measurement_noise: Sequence[Any], turn: Sequence[Any]
        ) -> list[list[Any]]:
            """Return the values of the law, then its slopes by each input."""
            state_and_memory = *point[self._places.state], *point[self._places.memory]
            flat = self._respond(
                *state_and_memory,
                *measurement_noise,
                *turn,
                *exact_inputs,
                between(-1, 1),
                *point[self._places.varied],
            )
            value_count = LEGS + len(self.memory) + LEGS
            return rows_of(list(map(arb, flat)), value_count)

        # Where the law jumps in the region, its values at the middle take the sides
        # that were found in the region.
        record = SideRecord()
        with record.within(replay=False):
            _, *slopes = run(box, noise, observed.in_region)
        with record.within(replay=True):
            values, *_ = run(region.centre, [arb(0)] * NOISES, observed.turn)
        return self._chain_slopes(values, slopes, observed)

    def _chain_slopes(
        self,
        values: list[Any],
        slopes: Sequence[Sequence[Any]],
        observed: _ObservedTurn,
    ) -> _Response:
        """Return the slopes of the law by the region and by the noise.

        Those by each input, of all values, are `slopes`. Those by the turn are chained
        with the slopes of the turn by the measured angles, and these with the slopes of
        the angles by the region.
        """
        response = _Response(values, [], [], [])
        turn_by_each_angle = list(zip(*observed.by_angles.tolist(), strict=True))
        for value_slopes in zip(*slopes, strict=True):
            by = divide(self._slope_sizes, value_slopes)
            by_angles = triple(
                inner_product(by["turn"], turn_slopes)
                for turn_slopes in turn_by_each_angle
            )
            row = [arb(0)] * self._places.size
            row[self._places.state] = by["state"]
            row[self._places.memory] = by["integral"]
            row[self._places.varied] = by["varied"]
            pairs = zip(by_angles, observed.angle_slopes, strict=True)
            for by_angle, angle_slopes in pairs:
                for place, slope in angle_slopes.items():
                    row[place] = row[place] + by_angle * slope
            response.by_region.append(row)
            # Noise on an angle acts by itself and by the orientation observed from it.
            by_angle_noise = add(by["angle_noise"], by_angles)
            response.by_noise.append([*by_angle_noise, *by["rate_noise"]])
            by_turn = [abs(slope) for slope in by["turn"]]
            left_open = inner_product(by_turn, observed.remainder)
            response.observer_bounds.append(left_open.abs_upper())
        return response

    def _observe(
        self,
        region: Region,
        spread: Sequence[Any],
        box: Sequence[Any],
        noise: Sequence[Any],
    ) -> _ObservedTurn:
        """Enclose the orientation at the measured angles."""
        if self._loops is None:
            zero = [arb(0)] * 3
            no_slopes: list[dict[int, Any]] = [{}, {}, {}]
            upright = (0.0, 0.0, 0.0, 1.0)
            return _ObservedTurn(upright, zero, zero, zeros(3), zero, no_slopes)
        centre_angles, angle_slopes = self._measure_in(region, box)
        measured = []
        for angle, slopes, angle_noise in zip(
            centre_angles, angle_slopes, noise[:LEGS], strict=True
        ):
            moved = arb(0)
            for place, slope in slopes.items():
                moved = moved + slope * arb(0, spread[place].upper())
            measured.append(angle + moved + angle_noise)
        gamma = triple(float(x.mid()) for x in measured)
        guess = self._controller.space.follow(*self._last_assembly, gamma)
        self._last_assembly = guess, gamma
        loops = self._loops
        exact_guess = [arb(x) for x in guess]

        def run(*numbers: Any) -> Any:
            return loops(*numbers, *exact_guess)

        root = krawczyk(run, [0.0, 0.0, 0.0], measured, LOST)
        # The turn at the angles of the region's centre, by the slopes of the root.
        pairs = list(zip(centre_angles, measured, strict=True))
        off_middle = column([angle - ball.mid() for angle, ball in pairs])
        turn = _sums(root.middle, entries(root.slopes * off_middle))
        remainder = [
            arb(bound).abs_upper() + ball.rad()
            for bound, ball in zip(root.remainder, turn, strict=True)
        ]
        exact_turn = middles(turn)
        widths = column(
            [arb(ball.rad()) + abs(ball.mid() - angle) for angle, ball in pairs]
        )
        reach = _sums(entries(magnitude(root.slopes) * widths), remainder)
        in_region = _sums(around_zero(reach), exact_turn)
        return _ObservedTurn(
            guess, exact_turn, in_region, root.slopes, remainder, angle_slopes
        )

    def _measure_in(
        self, region: Region, box: Sequence[Any]
    ) -> tuple[list[Any], list[dict[int, Any]]]:
        """Return the angles at the centre of a region, and their slopes in all of it.

        The slopes are by place in the region.
        """
        every_place = range(self._places.size)
        places = [*every_place[self._places.state], *every_place[self._places.varied]]
        at_centre = self._measure(*(region.centre[place] for place in places))
        in_box = self._measure(*(box[place] for place in places))
        angles, *_ = rows_of(list(map(arb, at_centre)), LEGS)
        _, *slopes = rows_of(list(map(arb, in_box)), LEGS)
        angle_slopes = [
            dict(zip(places, slopes_of_angle, strict=True))
            for slopes_of_angle in zip(*slopes, strict=True)
        ]
        return angles, angle_slopes

    def _bounds(self, region: Region, response: _Response) -> list[Any]:
        """Bound how far the values can be from those at the middle."""
        by_region = entries(region.spread(arb_mat(response.by_region)))
        by_noise = magnitude(arb_mat(response.by_noise)) * column(self._noise)
        bounds = _sums(by_region, entries(by_noise))
        bounds = _sums(bounds, response.observer_bounds)
        bounds = _sums(bounds, radii(response.values))
        return [bound.upper() for bound in bounds]

    def _move(
        self, region: Region, spread: Sequence[Any], response: _Response
    ) -> Region:
        """Return the region with new torques and memory."""
        n = self._places.size
        changed = self._places.changed
        count = changed.stop - changed.start
        new_values = response.values[:count]
        rows = identity(n).tolist()
        rows[changed] = response.by_region[:count]
        noise_rows = [[arb(0)] * NOISES for _ in range(n)]
        noise_rows[changed] = response.by_noise[:count]
        centre = list(region.centre)
        centre[changed] = middles(new_values)
        remainder = [arb(0)] * n
        remainder[changed] = _sums(response.observer_bounds[:count], radii(new_values))
        slopes = arb_mat(rows)
        noise = arb_mat(noise_rows)
        exact_slopes = slopes.mid()
        exact_noise = noise.mid()
        error = magnitude(slopes - exact_slopes) * column(spread)
        error_of_noise = magnitude(noise - exact_noise) * column(self._noise)
        error += error_of_noise + column(remainder)
        generators = _Generators.of(region)
        moved = exact_slopes * generators.directions
        directions = moved.mid()
        error += magnitude(moved - directions) * generators.widths
        moved_generators = _Generators(directions, generators.widths)
        moved_generators = moved_generators.join(exact_noise, self._noise)
        moved_generators = moved_generators.join_box(entries(error))
        moved_generators = moved_generators.reduce(self._start_directions)
        return moved_generators.region(region, centre)


def _sums(left: Sequence[Any], right: Sequence[Any]) -> list[Any]:
    """Return the sums of two rows of numbers."""
    return [x + y for x, y in zip(left, right, strict=True)]


def _with_sign_of(
    guess: Sequence[float], turn: Sequence[Any], desired: Sequence[float]
) -> Sequence[float]:
    """Return a desired quaternion with the sign of the observed one.

    Raises Refused where the two may be too far apart.
    """
    observed = quaternion_product(tuple(map(arb, guess)), (*turn, arb(1)))
    signed = desired
    products = zip(desired, observed, strict=True)
    if sum(component * float(ball) for component, ball in products) < 0.0:
        signed = [-component for component in desired]
    x, y, z, w = observed
    exact_desired: Any = tuple(map(arb, signed))
    error = quaternion_product((-x, -y, -z, w), exact_desired)
    first, second, third, real = error
    if not real > 0:
        raise Refused(FAR)
    if not (first**2 + second**2 + third**2) / real**2 < SMALL_TANGENT:
        raise Refused(FAR)
    return signed


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

    @classmethod
    def of_columns(
        cls, columns: Sequence[Sequence[Any]], bounds: Sequence[Any]
    ) -> _Generators:
        """Return a set by its directions and their bounds."""
        return cls(from_columns(columns), column(bounds))

    @property
    def columns(self) -> list[tuple[Any, ...]]:
        """The directions one by one."""
        return list(zip(*self.directions.tolist(), strict=True))

    def join(self, directions: Any, widths: Sequence[Any]) -> _Generators:
        """Add directions, those of no width left out."""
        columns = self.columns
        bounds = entries(self.widths)
        new_columns = zip(*directions.tolist(), strict=True)
        for direction, width in zip(new_columns, widths, strict=True):
            if width > 0:
                columns.append(direction)
                bounds.append(width.upper())
        return _Generators.of_columns(columns, bounds)

    def join_box(self, half_widths: Sequence[Any]) -> _Generators:
        """Add a box."""
        n = len(half_widths)
        return self.join(identity(n), [arb(x) for x in half_widths])

    def reduce(self, first: int) -> _Generators:
        """Put the smallest directions into a box where they are too many.

        The first ones are not put into it.
        """
        columns = self.columns
        if len(columns) <= MOST_DIRECTIONS:
            return self
        bounds = entries(self.widths)
        floats = np.array([[float(x) for x in row] for row in self.directions.tolist()])
        sizes = np.abs(floats) * np.array([float(x) for x in bounds])
        # The size of a direction is its largest share in the reach of a number.
        reach = sizes.sum(axis=1, keepdims=True)
        shares = np.max(sizes / np.where(reach > 0.0, reach, 1.0), axis=0)
        shares[:first] = np.inf
        smallest_first = np.argsort(shares)
        excess = len(columns) - KEPT_DIRECTIONS
        folded = set(smallest_first[:excess].tolist())

        def select(places: Sequence[int]) -> _Generators:
            return _Generators.of_columns(
                [columns[k] for k in places], [bounds[k] for k in places]
            )

        small = select(list(folded))
        kept = select([k for k in range(len(columns)) if k not in folded])
        return kept.join_box(entries(magnitude(small.directions) * small.widths))

    def region(self, old_region: Region, centre: Sequence[Any]) -> Region:
        """Return a region of the set about another centre."""
        n = len(centre)
        return old_region._replace(
            centre=list(centre),
            c=self.directions,
            a=self.widths,
            axes=identity(n),
            b=column([0] * n),
        )


def _angles(traced_scene: Parts, *state: Any) -> list[Any]:
    """Angles of the actuators of a plant, in symbols."""
    return [
        kernel.joint_angle(leg, 0)
        for leg in kernel.leg_motions(traced_scene.model, state)
    ]


def _none(*_: Any) -> Any:
    """Stand for a function that is not called."""
    raise AssertionError("a function of the model is called")
