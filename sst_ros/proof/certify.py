# SPDX-License-Identifier: Apache-2.0
"""certify(): how far a motion can be from the one that `simulate` gives, proven.

A number of a scene stands for what is written and for the double that is read, or for
anything in a range that is given. What is made from them (unit vectors, shifted
inertias, the posture at the start) is enclosed. The room: `balls` has Arb's numbers and
their rounding, `scene_balls` the numbers of a scene, `enclosure` the theorem of a step;
this file makes a motion of steps.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from functools import reduce
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np

from sst_ros.control.controller import Controller
from sst_ros.dynamics import kernel
from sst_ros.dynamics.initial_state import start_of
from sst_ros.dynamics.model import Limit, limits_of
from sst_ros.dynamics.motion_table import JOINT_QUANTITIES
from sst_ros.dynamics.traced_dynamics import (
    LEGS,
    MOTION,
    RATE_SYMBOLS,
    STATE_SIZE,
    TORQUE_SYMBOLS,
    Dynamics,
)
from sst_ros.errors import (
    InputError,
    Problem,
    SstError,
    check_kinds,
    refuse_unless,
    require,
)
from sst_ros.mechanism import generic_math as gm
from sst_ros.mechanism.generic_math import (
    Quadruple,
    cross3,
    dot3,
    quaternion_product,
    rows_of,
    triple,
)
from sst_ros.mechanism.geometry import Array, Geometry
from sst_ros.programs.expression import divide
from sst_ros.progress import Bar
from sst_ros.proof import enclosure
from sst_ros.proof.balls import (
    arb,
    arb_mat,
    arb_poly,
    between,
    from_columns,
    inner_product,
    norm,
    precision,
    upper,
    write_down,
    write_up,
)
from sst_ros.proof.closed_loop import CertifiedControl, SampledLoop, TrackingRow
from sst_ros.proof.enclosure import Advance, Function, ProvenSteps, Refused, Region
from sst_ros.proof.root import Root, krawczyk
from sst_ros.proof.scene_balls import (
    NumberReading,
    Parts,
    SceneBalls,
    WrittenDocument,
    range_balls,
)
from sst_ros.scene.scene import Scene
from sst_ros.scene.schema import Place, key_of
from sst_ros.scene.torque_profile import (
    ConstantTorque,
    SineTorque,
    TorqueLike,
    TorqueProfile,
)
from sst_ros.simulation.simulate import simulate
from sst_ros.simulation.trajectory import Trajectory
from sst_ros.state import (
    NANOSECONDS,
    QUATERNION,
    STAR,
    STAR_RATE,
    Explained,
    cached_property,
)

PARALLEL = "parallel singularity, det J2 = 0"
KNOWN_TORQUES = "must be numbers, sines, a table, polynomials or a Controller"
AT_START = "the posture at the start is not proven to be the only one near"
MOST_BOX_PARTS = 10_000  # of the box of ranges

# The start, see `_start_equations`: unknowns, and what is given of the actuators.
TURN_SYMBOLS = ("turn_x", "turn_y", "turn_z")
GAMMA_SYMBOLS = ("g1", "g2", "g3")
ANGLE_RATES = ("gd1", "gd2", "gd3")
_UNKNOWN_SIZES = {"turn": len(TURN_SYMBOLS), "body_rate": len(RATE_SYMBOLS)}
_START_SIZES = {**_UNKNOWN_SIZES, "gamma": LEGS, "gamma_dot": LEGS}
_UNIT_TURNS = ((1.0, 0.0, 0.0, 0.0), (0.0, 1.0, 0.0, 0.0), (0.0, 0.0, 1.0, 0.0))

ANGLES_AND_RATES = len(JOINT_QUANTITIES) * LEGS  # numbers of all joints

# Choice of steps: it decides how long a proof takes, not what is true.
ORDER_PER_DIGIT = 1.6  # order of p over the digits of the tolerance, rounded up
LEAST_ORDER = 14  # of p
FIRST_TOLERANCE = 1e-6  # of a step, as a share of the bound
PROOF_ATTEMPTS = 3  # proofs of a motion, each at a smaller tolerance
NEXT_TOLERANCE = 0.1  # of the next proof, as a share of what would just do

# Signs that say when a limit may be met.
LIMIT_ORDER = 6  # of expansions of the numbers
SPLITS = 200  # of a step, most of them near a limit
TURN_SPLITS = 80  # of a step in which a joint may turn back: a joint may be at rest
SHORTEST_SPAN = 1e-10  # of a step: it is not split, whatever is known of its signs

# Search for narrower ranges that would do: they are halved so often, then bisected.
HALVINGS = (1, 2, 4, 8, 16, 32)
SHARE_DIGITS = 3  # of a share of a width that would do
# Most steps of a proof with narrower ranges: so many times those without, and some.
NARROW_STEPS = 4
SPARE_STEPS = 10


class SignSpan(NamedTuple):
    """A span of time [s], and the sign of a number in it; 0 where it is not known."""

    begin: float
    end: float
    sign: int


class _StartSet(NamedTuple):
    """How the unknowns of the start depend on the numbers of the first region.

    An unknown is that at the middle, its row times numbers within the radii, and what
    the readings leave out.
    """

    rows: list[list[Any]]  # by unknown
    radii: list[Any]
    reading_errors: list[Any]  # by unknown


class BallEquations:
    """The motion of a scene on balls.

    The state y has that of the dynamics, what a controller changes at ticks, and the
    numbers that are ranges.
    """

    def __init__(
        self,
        scene: Scene,
        profile: TorqueProfile | None,
        ranges: Mapping[Place, Any],
        control: CertifiedControl | None = None,
    ) -> None:
        self.scene = scene
        self._profile = profile
        self.state = Dynamics.of(scene).state
        self.balls = SceneBalls(scene, profile, ranges)
        self.loop: SampledLoop | None = None
        # numbers that a controller changes at ticks
        self._tick_inputs: tuple[str, ...] = ()
        if control is not None:
            self.loop = SampledLoop(control, self.balls, self.state)
            self._tick_inputs = (*TORQUE_SYMBOLS, *self.loop.memory)
        self.inputs = (*self.state, *self._tick_inputs, *self.balls.inputs)
        # Inputs of compiled functions, before the numbers that are ranges.
        commands = self._tick_inputs or TORQUE_SYMBOLS
        self._function_inputs = ("t", *self.state, *commands)
        self._sizes = {"state": len(self.state), "command": LEGS}

    def start(self) -> Region:
        """Enclose the start by Krawczyk's test.

        Unknown are a small turn from the orientation that `simulate` begins with, and
        the body rate; the set keeps how they depend on gamma, gamma_dot and the numbers
        that are ranges. Raises Refused where the start is not proven to be the only one
        near.
        """
        x, y, z, w, *body_rate = start_of(self.scene)[STAR]
        orientation = (x, y, z, w)
        inputs = (*TURN_SYMBOLS, *RATE_SYMBOLS, *GAMMA_SYMBOLS, *ANGLE_RATES)
        run = self.balls.compile(
            _start_equations(orientation), inputs, (*inputs, *self.balls.inputs)
        )
        initial_numbers = [
            *self.balls.initial("gamma"),
            *self.balls.initial("gamma_dot"),
        ]
        parameters = []
        for number in initial_numbers:
            is_reading = isinstance(number, NumberReading)
            parameters.append(number.ball if is_reading else number)
        parameters += self.balls.varied_balls
        root = krawczyk(run, [0.0, 0.0, 0.0, *body_rate], parameters, AT_START)
        start_set = self._start_set(root, initial_numbers, parameters)
        region = self._start_region(orientation, root, start_set)
        return region if self.loop is None else self.loop.begin(region)

    def _start_region(
        self, orientation: Quadruple, root: Root, start_set: _StartSet
    ) -> Region:
        """Return the region of all starts: the quaternion is linear in the turn."""
        remainder = [
            bound + reading_error
            for bound, reading_error in zip(
                root.remainder, start_set.reading_errors, strict=True
            )
        ]
        rows = divide(_UNKNOWN_SIZES, start_set.rows)
        errors = divide(_UNKNOWN_SIZES, remainder)
        middle = divide(_UNKNOWN_SIZES, root.middle)
        by_turn = zip(
            *(quaternion_product(orientation, unit) for unit in _UNIT_TURNS),
            strict=True,
        )
        region_rows = []
        region_errors = []
        for component_slopes in by_turn:
            slopes = [arb(slope) for slope in component_slopes]
            columns = zip(*rows["turn"], strict=True)
            region_rows.append([inner_product(slopes, numbers) for numbers in columns])
            sizes = [abs(slope) for slope in slopes]
            region_errors.append(inner_product(sizes, errors["turn"]))
        region_rows += rows["body_rate"]
        region_errors += errors["body_rate"]
        size = len(self.state)
        n = size + len(self.balls.inputs)
        for place in range(len(region_rows), n):
            row = [arb(0)] * n
            if place >= size:  # a range; lagged torques are zero at the start
                row[place] = arb(1)
            region_rows.append(row)
            region_errors.append(arb(0))
        turned = quaternion_product(orientation, (*middle["turn"], arb(1)))
        lagged = [arb(0)] * (size - STATE_SIZE)
        varied = [arb(ball.mid()) for ball in self.balls.varied_balls]
        centre = [*turned, *middle["body_rate"], *lagged, *varied]
        c = arb_mat(region_rows)
        return Region.linear(
            0.0, centre, c, start_set.radii, region_errors, fixed=n - size
        )

    def _start_set(
        self, root: Root, initial_numbers: Sequence[Any], parameters: Sequence[Any]
    ) -> _StartSet:
        """Return how the root depends on the numbers of the first region.

        A range of an initial number takes the column of a number of the state, which
        has no use of its own at the start. How numbers are read, and all other ranges,
        have the columns of their inputs.
        """
        size = len(self.state)
        n = size + len(self.balls.inputs)
        unknowns = range(len(root.middle))
        rows = [[arb(0)] * n for _ in unknowns]
        reading_errors = [arb(0)] * len(unknowns)
        column_radii = [arb(0)] * n
        for j, ball in enumerate(parameters):
            is_initial = j < len(initial_numbers)
            place = j if is_initial else size + j - len(initial_numbers)
            factor = arb(1)
            radius = ball.rad()
            if is_initial and isinstance(initial_numbers[j], NumberReading):
                reading = initial_numbers[j]
                place = n - 1  # the input READING
                factor = reading.half
                radius = arb(0)
                missing = abs(reading.middle - ball.mid())
                for i in unknowns:
                    reading_errors[i] += abs(root.slopes[i, j]) * missing
            for i in unknowns:
                rows[i][place] += root.slopes[i, j] * factor
            column_radii[place] = arb.max(column_radii[place], radius)
        return _StartSet(rows, column_radii, reading_errors)

    def _unlimited(
        self, traced_scene: Parts, time: Any, command: Sequence[Any]
    ) -> list[Any]:
        """Return the torques that are commanded: those given, or sines of the time."""
        if not isinstance(self._profile, SineTorque):
            return list(command)
        sine = traced_scene.scene.torque
        torques = []
        for amplitude, frequency, phase in zip(
            sine.amplitude, sine.frequency, sine.phase, strict=True
        ):
            torque: Any = 0.0
            if amplitude:
                torque = amplitude * gm.sin(frequency * time + phase)
            torques.append(torque)
        return torques

    def _acting(
        self, traced_scene: Parts, time: Any, command: Sequence[Any]
    ) -> list[Any]:
        """Return the torques that act: those that are commanded, clamped."""
        torques = self._unlimited(traced_scene, time, command)
        limit = getattr(traced_scene.scene.actuators, "torque_limit", None)
        if limit is None:
            return torques
        return [
            limit - gm.positive(2.0 * limit - gm.positive(torque + limit))
            for torque in torques
        ]

    @cached_property
    def derivatives(self) -> tuple[Function, Function]:
        """The derivative of the state, without and with the Jacobian.

        Both are functions of time, state, commands and varied numbers.
        """
        held_count = len(self.inputs) - len(self.state)

        def derivative(traced_scene: Parts, time: Any, *state_and_commands: Any) -> Any:
            of = divide(self._sizes, state_and_commands)
            torque = self._acting(traced_scene, time, of["command"])
            slope = kernel.derivative(traced_scene.model, of["state"], triple(torque))
            return (*slope, *[0.0] * held_count)

        value = self.balls.compile(derivative, self._function_inputs)
        with_jacobian = self.balls.compile(
            derivative, self._function_inputs, self.inputs
        )
        return value, with_jacobian

    def between(self, begin: float, end: float) -> tuple[Function, Function]:
        """Return the derivative, and the derivative with the Jacobian.

        Both are functions of time and state between two kinks.
        """
        value, jacobian = self.derivatives
        return self.command(value, begin, end), self.command(jacobian, begin, end)

    def command(self, function: Function, begin: float, end: float) -> Function:
        """Return a function of time and state between two kinks.

        The given one has commands, too. They are those of the profile; a controller has
        its own in the state.
        """
        if self.loop is not None:
            return function
        size = len(self.state)
        torque_piece: TorqueProfile = ConstantTorque((0.0, 0.0, 0.0))
        if self._profile is not None and not isinstance(self._profile, SineTorque):
            torque_piece = self._profile.piece(begin, end)

        def commanded(time: Any, *y: Any) -> Sequence[Any]:
            held_torque = torque_piece.held
            if held_torque is None:
                command = torque_piece.at(time)
            else:
                command = tuple(map(arb, held_torque))
            return function(time, *y[:size], *command, *y[size:])

        return commanded

    @cached_property
    def joints(self) -> Function:
        """Compile the angles and rates of the joints, and their derivatives.

        The derivatives are by quaternion, W and the numbers that are ranges.
        """

        def angles_and_rates(traced_scene: Parts, *y: Any) -> list[Any]:
            return [x for row in kernel.joints(traced_scene.model, y) for x in row]

        return self.balls.compile(
            angles_and_rates, MOTION, (*MOTION, *self.balls.inputs)
        )

    @cached_property
    def stops(self) -> list[Limit]:
        """Limits of the mechanism, at which the scene may stop or not."""
        # `limits_of` reads no more of a scene: here all limits stop.
        stopping: Any = SimpleNamespace(
            stroke=SimpleNamespace(at_end="stop"),
            workspace=SimpleNamespace(at_edge="stop"),
        )
        return list(limits_of(stopping, Geometry.of(self.scene)))

    @cached_property
    def stop_names(self) -> set[str]:
        """Names of the limits at which the motion ends."""
        limits = limits_of(self.scene, Geometry.of(self.scene))
        return {limit.reason for limit in limits}

    @cached_property
    def limit_names(self) -> list[str]:
        """Names of limits: of joints, of singularities, of contacts and of torques."""
        names = [*(limit.reason for limit in self.stops), PARALLEL]
        if self.scene.stroke.at_end == "elastic":
            for leg in (1, 2, 3):
                names.append(f"contact of gamma_{leg} at 0")
                names.append(f"contact of gamma_{leg} at arc")
        if self.scene.torque_limit is not None:
            names += [f"torque_{leg} at its limit" for leg in (1, 2, 3)]
        return names

    @cached_property
    def turn_names(self) -> list[str]:
        """Names of the joints with dry friction, where they turn back."""
        return [
            f"{JOINT_QUANTITIES[joint_kind]}_{leg} turns back under dry friction"
            for joint_kind in self._dry_joints
            for leg in (1, 2, 3)
        ]

    @cached_property
    def _dry_joints(self) -> list[int]:
        """Kinds of joints (0 to 2) that have dry friction."""
        friction = self.scene.friction
        if friction is None:
            return []
        dry_joints = []
        laws = (friction.gamma, friction.mu, friction.beta)
        for joint_kind, law in enumerate(laws):
            if law is not None and (law.coulomb or law.static):
                dry_joints.append(joint_kind)
        return dry_joints

    @cached_property
    def turn_rates(self) -> Function:
        """Compile the rates of the joints [rad/s] that `turn_names` names.

        They are functions of time, state, commands and the numbers that are ranges.
        """

        def rates(
            traced_scene: Parts, time: Any, *state_and_commands: Any
        ) -> list[Any]:
            legs = list(kernel.leg_motions(traced_scene.model, state_and_commands))
            return [
                kernel.joint_rate(leg, joint_kind)
                for joint_kind in self._dry_joints
                for leg in legs
            ]

        return self.balls.compile(rates, self._function_inputs)

    @cached_property
    def limits(self) -> Function:
        """Compile numbers that are zero at a limit and positive inside.

        They are functions of time, state, commands and the numbers that are ranges, in
        the order of `limit_names`.
        """
        is_elastic = self.scene.stroke.at_end == "elastic"

        def distances(
            traced_scene: Parts, time: Any, *state_and_commands: Any
        ) -> list[Any]:
            of = divide(self._sizes, state_and_commands)
            legs = list(kernel.leg_motions(traced_scene.model, of["state"]))
            angles = [
                kernel.joint_angle(leg, joint_kind)
                for joint_kind in range(3)
                for leg in legs
            ]
            gamma = angles[:LEGS]
            arc = traced_scene.axes.arc
            values = []
            for limit in self.stops:
                end = _end_of(traced_scene, limit)
                values.append(limit._replace(end=end).distance(angles))
            first, second, third = (leg.g for leg in legs)
            values.append(dot3(first, cross3(second, third)))
            if is_elastic:
                for angle, most in zip(gamma, arc, strict=True):
                    values += [angle, most - angle]
            torque_limit = getattr(traced_scene.scene.actuators, "torque_limit", None)
            if torque_limit is not None:
                for torque in self._unlimited(traced_scene, time, of["command"]):
                    values.append((torque_limit - torque) * (torque_limit + torque))
            return values

        return self.balls.compile(distances, self._function_inputs)


def _end_of(traced_scene: Parts, limit: Limit) -> Any:
    """Return the end of a limit, in symbols where the numbers of a scene make it."""
    joint_kind, leg = divmod(limit.joint, LEGS)
    if limit.sign < 0.0 and JOINT_QUANTITIES[joint_kind] == "gamma":
        return traced_scene.axes.arc[leg]
    if limit.sign < 0.0 and JOINT_QUANTITIES[joint_kind] == "beta":
        return traced_scene.axes.beta_max
    return limit.end


def _start_equations(orientation: Quadruple) -> Callable[..., list[Any]]:
    """Return the equations of the start, whose unknowns are a turn and the body rate.

    The first three are zero where the turn from the orientation puts the legs at the
    angles of the actuators, the others where their rates agree.
    """

    def equations(traced_scene: Parts, *inputs: Any) -> list[Any]:
        of = divide(_START_SIZES, inputs)
        turned = quaternion_product(orientation, (*of["turn"], 1.0))
        legs = kernel.leg_motions(traced_scene.model, (*turned, *of["body_rate"]))
        angle_gaps = []
        rate_gaps = []
        for leg, angle, rate in zip(legs, of["gamma"], of["gamma_dot"], strict=True):
            sine, cosine = kernel.direction_of(leg, 0)
            angle_gaps.append(sine * gm.cos(angle) - cosine * gm.sin(angle))
            rate_gaps.append(leg.gamma_dot - rate)
        return [*angle_gaps, *rate_gaps]

    return equations


class Row(NamedTuple):
    """What is proven at an instant."""

    time: float
    quaternion: list[float]
    angle: float  # of the true orientation to `quaternion`, at most [rad]
    distance: float  # of the true orientation to that of `simulate`, at most [rad]
    # body rates, angles and rates of joints; their bounds
    values: list[tuple[float, float]]


class Follower:
    """A proof of one motion, step by step.

    It holds for all numbers in the balls of the equations.
    """

    def __init__(self, equations: BallEquations, trajectory: Trajectory) -> None:
        self._equations = equations
        self._trajectory = trajectory
        self._times_left = trajectory.t.tolist()  # of rows that are not proven yet
        self.rows: list[Row] = []
        self.tracking: list[TrackingRow] = []
        names = [*equations.limit_names, *equations.turn_names]
        self.signs: dict[str, list[SignSpan]] = {name: [] for name in names}
        self.until = 0.0
        self.reason = ""
        self.steps = 0

    @property
    def is_whole(self) -> bool:
        """Whether the motion is proven to its end.

        That is the duration, or a limit that stops it.
        """
        return not self.reason or self.reason in self._equations.stop_names

    @property
    def largest(self) -> float:
        """Largest angle [rad]; inf without a row."""
        return max((row.angle for row in self.rows), default=math.inf)

    def follow(
        self, breaks: Sequence[float], tolerance: float, max_steps: int, bar: Bar
    ) -> None:
        """Prove step by step from one break in time to the next.

        Where a step is not proven, the proof ends, and `reason` says why.
        """
        digits = -math.log10(tolerance)
        order = max(LEAST_ORDER, math.ceil(ORDER_PER_DIGIT * digits))
        # NumPy need not warn of what overflows in doubles: it is refused.
        try:
            with np.errstate(all="ignore"):
                self._follow(breaks, tolerance, order, max_steps, bar)
        except (Refused, SstError) as refused:
            self.reason = str(refused)
        except (ArithmeticError, ValueError):
            self.reason = enclosure.UNBOUNDED

    def _follow(
        self,
        breaks: Sequence[float],
        tolerance: float,
        order: int,
        max_steps: int,
        bar: Bar,
    ) -> None:
        equations = self._equations
        loop = equations.loop
        region = equations.start()
        for begin, end in pairwise(breaks):
            if loop is not None:
                region = self._sample(loop, region)
            f, jacobian = equations.between(begin, end)
            limits = equations.command(equations.limits, begin, end)
            for step in ProvenSteps(f, jacobian, region, end, tolerance, order):
                self._take(step, limits)
                if equations.turn_names:
                    rates = equations.command(equations.turn_rates, begin, end)
                    self._note_signs(step, equations.turn_names, rates, TURN_SPLITS)
                bar.draw(step.end / breaks[-1])
                if self.reason:
                    return
                if self.steps >= max_steps and step.end < breaks[-1]:
                    raise Refused(f"{max_steps} steps are not enough")
            region = enclosure.region_at_end(step, boxed=loop is not None)
        if loop is not None:
            self._sample(loop, region)

    def _sample(self, loop: SampledLoop, region: Region) -> Region:
        """Return the region behind a tick of the controller; keep what it tracks."""
        region, row = loop.sample(region)
        self.tracking.append(row)
        return region

    def _take(self, step: Advance, limits: Function) -> None:
        """Take what a step proves, up to where the motion meets an end of the scene."""
        self.steps += 1
        names = self._equations.limit_names
        self.until = self._note_signs(step, names, limits, SPLITS)
        while self._times_left and self._times_left[0] <= self.until:
            self.rows.append(self._row(step, self._times_left.pop(0)))

    def _note_signs(
        self, step: Advance, names: Sequence[str], function: Function, splits: int
    ) -> float:
        """Note the signs of numbers in a step, and where the motion ends by them.

        Return the end of the step [s], or the time at which a limit that stops the
        motion may be met.
        """
        end = step.end
        stop_names = self._equations.stop_names
        for low, high, signs in _signs(step, function, len(names), splits):
            for name, sign in zip(names, signs, strict=True):
                self.signs[name].append(SignSpan(low, high, sign))
                if name in stop_names and sign <= 0 and low < end:
                    self.reason = name
                    end = low
        return end

    def _row(self, step: Advance, time: float) -> Row:
        """Return what a step proves at an instant."""
        p, error_bounds = step.at(time)
        q = p[QUATERNION]
        balls = [
            *zip(p[STAR_RATE], error_bounds[STAR_RATE], strict=True),
            *self._joint_balls(step, time, p, error_bounds),
        ]
        values = []
        for middle, radius in balls:
            centre = float(middle)
            values.append((centre, upper(abs(middle - centre) + radius)))
        length = norm(q)
        relative_error = norm(error_bounds[QUATERNION]) / length
        quaternion = [float(x / length) for x in q]
        simulated = self._trajectory.quaternion[len(self.rows)].tolist()
        angle = arb.pi()
        distance = arb.pi()
        if relative_error < 1:
            from_middle = 2 * relative_error.asin()
            angle = from_middle + _turn(q, quaternion)
            distance = from_middle + _turn(q, simulated)
        return Row(time, quaternion, upper(angle), upper(distance), values)

    def _joint_balls(
        self, step: Advance, time: float, p: list[Any], error_bounds: list[Any]
    ) -> list[tuple[Any, Any]]:
        """Return middles and bounds of the angles and rates of the joints.

        At an instant the state is in p +- error_bounds.
        """
        varied = len(self._equations.balls.inputs)
        # Joints depend on the state without lagged torques, and on the ranges.
        inputs = [*range(STATE_SIZE), *range(len(p) - varied, len(p))]
        try:
            at_middle = self._equations.joints(*(p[i] for i in inputs))
            in_box = self._equations.joints(
                *(arb(p[i], error_bounds[i]) for i in inputs)
            )
            _, *slopes = rows_of(in_box, ANGLES_AND_RATES)
            slopes_by_place = dict(zip(inputs, slopes, strict=True))
            no_slopes = [arb(0)] * ANGLES_AND_RATES
            by_state = from_columns(
                [slopes_by_place.get(place, no_slopes) for place in range(len(p))]
            )
            _, joint_bounds = step.at(time, by_state)
        except Refused:  # an angle passes pi
            half = ANGLES_AND_RATES // 2
            return [(0, arb.pi())] * half + [(0, arb("inf"))] * half
        return list(zip(at_middle[:ANGLES_AND_RATES], joint_bounds, strict=True))


def unite(proofs: Sequence[Follower]) -> tuple[list[Row], dict[str, list[SignSpan]]]:
    """Return rows that hold for all motions of some proofs, and all of their spans."""
    spans: dict[str, list[SignSpan]] = {}
    for name in proofs[0].signs:
        spans[name] = sorted(span for proof in proofs for span in proof.signs[name])
    if len(proofs) == 1:  # rows that were united would be wider by rounding
        return proofs[0].rows, spans
    until = min(proof.until for proof in proofs)
    rows = []
    for rows_at_time in zip(*(proof.rows for proof in proofs), strict=False):
        if rows_at_time[0].time > until:
            break
        rows.append(_unite_rows(rows_at_time))
    return rows, spans


def _unite_rows(rows: Sequence[Row]) -> Row:
    """Return a row that holds for all motions of some rows at the same instant."""
    time = rows[0].time
    quaternion = rows[0].quaternion
    angles = []
    for row in rows:
        turn = _turn([arb(x) for x in row.quaternion], quaternion)
        angles.append(upper(turn + row.angle))
    values = []
    for pairs in zip(*(row.values for row in rows), strict=True):
        first_middle, _ = pairs[0]
        ball = between(first_middle, first_middle)
        for middle, bound in pairs:
            ball = ball.union(arb(middle, bound))
        centre = float(ball)
        values.append((centre, upper(abs(ball - centre))))
    distance = max(row.distance for row in rows)
    return Row(time, quaternion, max(angles), distance, values)


def track_columns(proofs: Sequence[Follower], until: float) -> dict[str, Array]:
    """Return what holds for all parts at the ticks: middles and bounds by name."""
    table: dict[str, list[float]] = {}
    for rows_at_time in zip(*(proof.tracking for proof in proofs), strict=False):
        time = rows_at_time[0].time
        if time > until:
            break
        table.setdefault("t", []).append(time)
        errors = zip(*(row.error for row in rows_at_time), strict=True)
        torques = zip(*(row.torque for row in rows_at_time), strict=True)
        for name, pairs_by_leg in (("error", errors), ("torque", torques)):
            for leg, pairs in enumerate(pairs_by_leg, 1):
                middle, bound = _hull(pairs)
                table.setdefault(f"{name}_{leg}", []).append(middle)
                table.setdefault(f"{name}_{leg}_bound", []).append(bound)
    return {name: np.array(numbers) for name, numbers in table.items()}


def _hull(pairs: Sequence[tuple[Any, Any]]) -> tuple[float, float]:
    """Return a number, and a bound of how far some numbers with bounds are from it."""
    hulls = [arb(middle) + arb(0, bound) for middle, bound in pairs]
    hull = reduce(arb.union, hulls)
    centre = float(hull)
    return centre, upper(abs(hull - centre))


class ProvenMotion(Explained):
    """What is proven of a motion at the instants of a table.

    Attributes:
        scene: what moves.
        columns: by name, shape (n,): t [s], none later than `until`; quaternion_x to
            _w, an orientation, and angle [rad], how far the true one can be from it;
            body_rate_x to _z [rad/s] and gamma_1 to beta_dot_3 [rad, rad/s], each with
            NAME_bound; distance [rad], the most between the true orientation and that
            of `simulate`.
        until: time to which the motion is proven to exist and to be within the bounds
            [s].
        reason: why it ends there; "" where that is the duration.
        limits: for each limit of the mechanism the spans of time [s] in which the
            motion may be on it; at all other times until `until` it is proven not to
            be. Contacts with elastic stops, torques at their limit and the turns of
            joints with dry friction are among them: they begin and end in these spans.
        tracking: under a controller, by name, shape (m,): t [s], its ticks and the end;
            error_1 to _3 [rad], desired - true gamma, and torque_1 to _3 [N m], what it
            commands, each with NAME_bound, how far the true one can be from it.
        trajectory: what `simulate` gives.
        bound: what the angle was to be at most [rad].
        steps: number of steps of the proof.

    """

    def __init__(
        self, parts: Sequence[Follower], bound: float, trajectory: Trajectory
    ) -> None:
        self.scene = trajectory.scene
        self.bound = bound
        self.trajectory = trajectory
        shortest = min(parts, key=lambda proof: proof.until)
        failed = [proof for proof in parts if not proof.is_whole]
        self.until = shortest.until
        deciding = failed[0] if failed else shortest
        self.reason = deciding.reason
        self.steps = sum(proof.steps for proof in parts)
        self._is_whole = not failed
        rows, spans = unite(parts)
        names = [f"body_rate_{axis}" for axis in "xyz"]
        names += [f"{joint}_{leg}" for joint in JOINT_QUANTITIES for leg in (1, 2, 3)]
        quaternion = np.array([row.quaternion for row in rows]).reshape(-1, 4)
        values = np.array([row.values for row in rows]).reshape(-1, len(names), 2)
        self.columns: dict[str, Array] = {"t": np.array([row.time for row in rows])}
        for k, axis in enumerate("xyzw"):
            self.columns[f"quaternion_{axis}"] = quaternion[:, k]
        self.columns["angle"] = np.array([row.angle for row in rows])
        self.columns["distance"] = np.array([row.distance for row in rows])
        for k, name in enumerate(names):
            self.columns[name] = values[:, k, 0]
            self.columns[f"{name}_bound"] = values[:, k, 1]
        self.tracking = track_columns(parts, self.until)
        for numbers in (*self.columns.values(), *self.tracking.values()):
            numbers.flags.writeable = False
        self.limits: dict[str, list[tuple[float, float]]] = {}
        for name, sign_spans in spans.items():
            self.limits[name] = _unknown_spans(sign_spans, self.until)

    @property
    def tracking_error(self) -> float:
        """Largest tracking error of a joint at a tick that is possible [rad]."""
        most = 0.0 if self.tracking else math.inf
        for leg in (1, 2, 3):
            errors = self.tracking.get(f"error_{leg}", ())
            bounds = self.tracking.get(f"error_{leg}_bound", ())
            for error, bound in zip(errors, bounds, strict=True):
                most = max(most, upper(abs(arb(float(error))) + arb(float(bound))))
        return most

    @property
    def largest(self) -> float:
        """Largest angle between true orientation and that of the table [rad].

        It is inf where the table has no row.
        """
        return self._largest_of("angle")

    @property
    def error(self) -> float:
        """Largest distance of `simulate` from the true motion [rad].

        It is inf where the table has no row.
        """
        return self._largest_of("distance")

    def _largest_of(self, name: str) -> float:
        """Return the largest number of a column; inf where it has none."""
        return float(max(self.columns[name], default=math.inf))

    def __len__(self) -> int:
        """Return the number of rows."""
        return len(self.columns["t"])

    @property
    def success(self) -> bool:
        """Whether the motion is proven to its end, within the bound asked for."""
        return self._is_whole and self.largest <= self.bound

    def to_pandas(self) -> Any:
        """Table of `columns`."""
        return require("pandas").DataFrame(self.columns)

    def _facts(self) -> dict[str, object]:
        met = []
        for name, spans in self.limits.items():
            for begin, end in spans:
                met.append(f"{name}: {write_down(begin, 15)} to {write_up(end, 15)} s")
        until = f"to {write_down(self.until, 15)} s"
        if self.reason:
            until = f"{until}: {self.reason}"
        facts: dict[str, object] = {"scene": self.scene.name, "proven": until}
        if len(self):
            estimate = self.trajectory.error_estimate
            facts["orientation"] = f"within {write_up(self.largest)} rad of the table"
            facts["error of simulate"] = (
                f"not above {write_up(self.error)} rad; its estimate is"
                f" {estimate:.2g} rad"
            )
            if self.tracking:
                most = write_up(self.tracking_error)
                facts["tracking error"] = f"not above {most} rad at any tick"
            facts["limits"] = met or "no limit is reached and no singularity is passed"
        return facts | {"steps": self.steps}


def _unknown_spans(
    sign_spans: Sequence[SignSpan], until: float
) -> list[tuple[float, float]]:
    """Join the spans whose sign is not known, of those that begin by a time."""
    joined: list[tuple[float, float]] = []
    for begin, end, sign in sign_spans:
        if sign != 0 or begin > until:
            continue
        if joined:
            last_begin, last_end = joined[-1]
            if begin <= last_end:
                joined[-1] = (last_begin, max(end, last_end))
                continue
        joined.append((begin, end))
    return joined


def _turn(a: Sequence[Any], b: Sequence[Any]) -> Any:
    """Angle of the rotation between quaternions, as a ball [rad]."""
    a_length = norm(a)
    b_length = norm(list(map(arb, b)))
    unit_a = [x / a_length for x in a]
    unit_b = [arb(y) / b_length for y in b]
    differences = [x - y for x, y in zip(unit_a, unit_b, strict=True)]
    sums = [x + y for x, y in zip(unit_a, unit_b, strict=True)]
    # Unit quaternions an angle apart have the chord 2 sin(angle / 4); q and -q are one
    # orientation.
    chord = min(norm(differences), norm(sums), key=float)
    return 4 * (chord / 2).asin()


def _signs(
    step: Advance, run: Function, count: int, splits: int
) -> Iterator[tuple[float, float, Sequence[int]]]:
    """Split a step into spans of time by the signs of numbers.

    Each span has its begin and end [s], and the signs of the numbers in it: > 0 (1), <
    0 (-1), or unknown (0). Spans with unknown signs are halved, `splits` times at most.
    """
    begin = step.begin.time
    shortest = SHORTEST_SPAN * (step.end - begin)
    splits_left = splits
    open_spans = [(begin, step.end)]
    while open_spans:
        low, high = open_spans.pop()
        splits_left -= 1
        signs = [0] * count
        with suppress(ArithmeticError, ValueError):  # a division by what may be zero
            signs = _signs_in(step, run, low, high)
        if all(signs) or splits_left < 0 or high - low < shortest:
            yield low, high, signs
        else:
            middle = 0.5 * (low + high)
            open_spans.append((middle, high))
            open_spans.append((low, middle))


def _signs_in(step: Advance, run: Function, low: float, high: float) -> list[int]:
    """Return the signs of numbers in a span of time of a step [s]; 0 if unknown."""
    begin = step.begin.time
    span = (arb(low) - begin, arb(high) - begin)
    from_middle = between(span[0] - span[1], span[1] - span[0]) / 2
    signs = []
    for coefficients in step.enclose(run, LIMIT_ORDER, step.tube, span):
        value = arb_poly(coefficients)(from_middle)
        signs.append(int(bool(value > 0)) - int(bool(value < 0)))
    return signs


def split_ranges(ranges: Mapping[Place, Any], box_count: int) -> list[dict[Place, Any]]:
    """Halve a box of ranges until there are as many boxes.

    Each is halved along the range of which it has the largest share.
    """
    boxes = [dict(ranges)]
    while len(boxes) < box_count:
        box = boxes.pop(0)
        shares = {
            place: float(ball.rad() / ranges[place].rad())
            for place, ball in box.items()
        }
        widest = max(shares, key=shares.__getitem__)
        middle = box[widest].mid()
        quarter = box[widest].rad() / 2
        for centre in (middle - quarter, middle + quarter):
            half = arb(centre.mid(), (quarter + centre.rad()).upper())
            boxes.append(box | {widest: half})
    return boxes


class ProofTask(NamedTuple):
    """What is to be proven, and how hard to try."""

    trajectory: Trajectory
    profile: TorqueProfile | None
    breaks: list[float]
    bound: float
    max_steps: int
    progress: bool
    control: CertifiedControl | None = None
    split: int = 1  # parts of the box of ranges, of which one is proven

    def prove(self, ranges: Mapping[Place, Any], label: str = "certify") -> Follower:
        """Prove the motion for all numbers of ranges."""
        scene = self.trajectory.scene
        tolerance = FIRST_TOLERANCE * self.bound
        for _ in range(PROOF_ATTEMPTS):
            equations = BallEquations(scene, self.profile, ranges, self.control)
            follower = Follower(equations, self.trajectory)
            follower.follow(
                self.breaks, tolerance, self.max_steps, Bar(label, self.progress)
            )
            is_wide = bool(ranges) or self.control is not None
            if is_wide or follower.largest <= self.bound:
                break
            if follower.largest == math.inf:
                break
            tolerance *= NEXT_TOLERANCE * self.bound / follower.largest
        return follower

    def prove_boxes(self, ranges: Mapping[Place, Any]) -> list[Follower]:
        """Prove the motion for each part of the box of ranges."""
        wide = {place: x for place, x in ranges.items() if x.rad() > 0}
        boxes = split_ranges(wide, self.split) if wide else [{}]
        return [self.prove_part({**ranges, **box}) for box in boxes]

    def prove_part(self, ranges: Mapping[Place, Any]) -> Follower:
        """Prove the motion for all numbers of ranges.

        Where they are too wide, the reason says so, with a width that would do.

        Raises:
            InputError: the scene cannot even be enclosed for all of them.

        """
        try:
            follower = self.prove(ranges)
        except (ArithmeticError, ValueError):
            if not ranges:
                raise
            too_wide = self._too_wide_alone(ranges) or list(ranges)
            names = ", ".join(dict.fromkeys(map(_key_without_index, too_wide)))
            exact = self.prove(_narrowed(ranges, 0.0), "no range")
            advice = f"must be narrower: {self._advise(ranges, exact.steps)}"
            raise InputError("certify", [Problem("ranges", names, advice)]) from None
        if not ranges or not follower.reason or follower.steps >= self.max_steps:
            return follower
        exact = self.prove(_narrowed(ranges, 0.0), "no range")
        if not exact.is_whole or exact.reason == follower.reason:
            return follower  # it ends so without a range, too
        follower.reason = (
            f"the ranges are too wide: {self._advise(ranges, exact.steps)}"
            f" ({follower.reason})"
        )
        return follower

    def _too_wide_alone(self, ranges: Mapping[Place, Any]) -> list[Place]:
        """Return the places of ranges for which the scene alone is not enclosed."""
        places = []
        for place, ball in ranges.items():
            exact_ranges = _narrowed(ranges, 0.0)
            try:
                SceneBalls(
                    self.trajectory.scene, self.profile, exact_ranges | {place: ball}
                )
            except (ArithmeticError, ValueError):
                places.append(place)
        return places

    def _advise(self, ranges: Mapping[Place, Any], steps: int) -> str:
        """Say what share of the width of ranges would do.

        `steps` are those of the proof without ranges.
        """
        most = min(self.max_steps, NARROW_STEPS * (steps + SPARE_STEPS))
        halvings = self._replace(max_steps=most)._needed_halvings(ranges)
        if halvings is None:
            share = write_down(0.5 ** HALVINGS[-1], SHARE_DIGITS)
            return f"{share} of their width would not do either"
        share = write_down(0.5**halvings, SHARE_DIGITS)
        advice = f"{share} of their width would do"
        wide = sum(ball.rad() > 0 for ball in ranges.values())
        needed_split = self.split * 2 ** (halvings * wide)
        if needed_split <= MOST_BOX_PARTS:
            advice = f"{advice}, or split={needed_split} or more"
        return advice

    def _needed_halvings(self, ranges: Mapping[Place, Any]) -> int | None:
        """Return how often ranges must be halved; None where that is in vain."""
        too_few = 0
        for halvings in HALVINGS:
            if self._is_proven(_narrowed(ranges, 0.5**halvings)):
                break
            too_few = halvings
        else:
            return None
        enough = halvings
        while enough - too_few > 1:
            middle = (enough + too_few) // 2
            if self._is_proven(_narrowed(ranges, 0.5**middle)):
                enough = middle
            else:
                too_few = middle
        return enough

    def _is_proven(self, ranges: Mapping[Place, Any]) -> bool:
        try:
            return self.prove(ranges, "narrower").is_whole
        except (ArithmeticError, ValueError):
            return False


def _key_without_index(place: Place) -> str:
    """Return the key of a number, or of all numbers of the list that it is in."""
    while isinstance(place[-1], int):
        place = place[:-1]
    return key_of(place)


def _narrowed(ranges: Mapping[Place, Any], share: float) -> dict[Place, Any]:
    """Return a share of the width of ranges, about their middles."""
    return {place: arb(x.mid(), x.rad() * share) for place, x in ranges.items()}


@check_kinds
def certify(
    scene: Scene | Mapping[str, Any] | str | Path,
    torque: TorqueLike = None,
    duration: float | None = None,
    *,
    bound: float = 1e-9,
    ranges: Mapping[str, Any] | None = None,
    split: int = 1,
    max_steps: int = 100_000,
    noise: tuple[float, float] = (0.0, 0.0),
    progress: bool = False,
    **options: Any,
) -> ProvenMotion:
    """Enclose the true motion of a scene and bound the error of `simulate`.

    Both are proven. A number of the scene stands for what is written and for the double
    that is read, or for all of a range; rounding is outward. The proof passes contacts
    and torques at their limit. It ends where the motion meets an end of the scene, or
    where no step is proven: `until` and `reason` say so. One proof runs at a time,
    whatever the threads.

    Under a `Controller` the motion is that of the sampled loop: torques are held over
    `control_period`, and its law acts at the ticks as it does in `simulate`, but
    without rounding. `tracking` is then the proven tube of the tracking error.

    Args:
        scene: as `simulate` takes it.
        torque: as `simulate` takes it; of functions a `Controller` alone.
        duration: as `simulate` takes it.
        bound: angle [rad] within which the orientation is to be proven; steps are
            chosen for it.
        ranges: how far numbers of the document may be from those given, by key, as in
            {"star.inertia.zz": 5e-4, "star.alpha_deg": (119.0, 121.0), "star.mass":
            "digits"}: a half-width, an interval, or half a unit of the last digit that
            the document has. Keys may name all numbers that act on the motion, those of
            its geometry, limits and torques included; others are refused.
        split: number of parts that the box of ranges is split into; what holds for all
            of them is returned.
        max_steps: number of steps after which the proof of a part ends, some 20 ms
            each.
        noise: most that a controller may measure angles [rad] and rates [rad/s] wrong,
            by any amount at any tick.
        progress: draw a bar on a terminal.
        options: of `simulate`, as initial, method, tolerance, control_period, and
            t_eval, the times of the table.

    Raises:
        InputError: an argument is not allowed; names it and the allowed values.
        AssemblyError, SingularConfiguration: as `simulate`.
        MissingDependency: python-flint is not installed.

    """
    control = None
    if isinstance(torque, Controller):
        control = _read_control(torque, noise, options.get("control_period"))
        torque = copy.deepcopy(control.controller)
    trajectory = simulate(scene, torque, duration, **options)
    simulated_scene = trajectory.scene
    profile = trajectory.law
    end = simulated_scene.duration if duration is None else duration
    is_known = profile is not None and profile.is_known_ahead
    refuse_unless(
        "certify",
        ("torque", torque, is_known, KNOWN_TORQUES),
        (
            "noise",
            noise,
            control is not None or not any(noise),
            "is that of what a Controller measures",
        ),
        ("bound", bound, 0.0 < bound < math.inf, "must be a number > 0 [rad]"),
        ("max_steps", max_steps, max_steps > 0, "must be > 0"),
        (
            "split",
            split,
            1 <= split <= MOST_BOX_PARTS,
            f"must be a whole number from 1 to {MOST_BOX_PARTS}",
        ),
        ("split", split, split == 1 or bool(ranges), "splits ranges: give some"),
    )
    assert profile is not None and end is not None
    own_torque = profile == simulated_scene.torque
    # `simulate` ends at a whole nanosecond.
    end = round(end * NANOSECONDS) / NANOSECONDS
    kinks = profile.kinks()
    if control is not None:
        profile = None
        kinks = _ticks(control.period, end)
    breaks = [0.0, *np.unique(kinks[(kinks > 0.0) & (kinks < end)]).tolist(), end]
    with precision():
        balls = range_balls(
            WrittenDocument.of(simulated_scene),
            ranges or {},
            own_torque=own_torque,
            origin="certify",
        )
        task = ProofTask(
            trajectory, profile, breaks, bound, max_steps, progress, control, split
        )
        return ProvenMotion(task.prove_boxes(balls), bound, trajectory)


def _read_control(
    controller: Controller, noise: tuple[float, float], period: float | None
) -> CertifiedControl:
    """Return a copy of a controller as it begins, and how it is sampled."""
    requirement = "must be two half-widths >= 0, of angles [rad] and of rates [rad/s]"
    refuse_unless(
        "certify",
        (
            "control_period",
            period,
            period is not None,
            "must be given with a Controller [s]",
        ),
        ("noise", noise, all(0.0 <= x < math.inf for x in noise), requirement),
    )
    assert period is not None
    begun = copy.deepcopy(controller)
    begun.reset()
    return CertifiedControl(begun, period, noise)


def _ticks(period: float, end: float) -> Array:
    """Return the times of ticks before an end [s], as `simulate` has them."""
    step = round(period * NANOSECONDS)
    return np.arange(0, round(end * NANOSECONDS), step) / NANOSECONDS
