# SPDX-License-Identifier: Apache-2.0
"""The reference motion of a scene: of the star, or of the actuators.

The star follows a motion of the actuators. Through waypoints, and through the samples
of a recording, goes one quintic a segment: position, velocity and acceleration at both
ends make it. Where a velocity or an acceleration is left open, all open ones together
minimise the integral of the jerk squared: with positions alone that is the quintic
spline with four continuous derivatives.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from itertools import pairwise
from operator import attrgetter
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import ArrayLike
from scipy.interpolate import BPoly, PPoly
from scipy.linalg import hilbert
from scipy.sparse import csc_array
from scipy.sparse.linalg import splu
from scipy.spatial.transform import Rotation

from sst_ros.control.actuator_space import (
    ActuatorSpaceMap,
    Reference,
    ReferenceMotion,
    equal_pieces,
    follow_assembly,
)
from sst_ros.dynamics.initial_state import initial_state
from sst_ros.errors import (
    Check,
    InputError,
    SingularConfiguration,
    check_kinds,
    refusal,
    refuse_unless,
)
from sst_ros.mechanism import continuation, kinematics
from sst_ros.mechanism.generic_math import axpy, multiply, quaternion_product, triple
from sst_ros.mechanism.geometry import Array, Geometry, quaternion_of, rotation_matrix
from sst_ros.scene.loads import Spiral, Sweep
from sst_ros.scene.scene import SceneInput, scene_of
from sst_ros.state import ZERO, Quaternion, Vector3

PIECES = 8  # pieces of a minimum-jerk motion, and of a quarter of a turn
# of a recording, whose samples lie much denser than the motion turns
SAMPLES_A_PIECE = 8
KEPT_STEP = 0.03  # distance in gamma [rad] between orientations that are kept
LONGEST_PIECE = 100.0  # longest path in gamma [rad] within a piece of a motion
NEAR = 0.1  # largest distance of a first point at time 0 from the start [rad]
_SAMPLES = 16  # of a piece, by which the length of its path is estimated


class StarPoint(NamedTuple):
    """Where a path of the star is at a share of it, as a turn from the start."""

    turn: Quaternion
    slope: Vector3  # W by the share [rad]
    curvature: Vector3  # the derivative of the slope by the share [rad]


class ActuatorPoint(NamedTuple):
    """Where a path of the actuators is at a time."""

    gamma: Vector3  # [rad]
    gamma_dot: Vector3  # [rad/s]
    gamma_ddot: Vector3  # [rad/s^2]


class KeptOrientation(NamedTuple):
    """An orientation on a path of the actuators, from which others are computed."""

    time: float
    quaternion: Quaternion
    gamma: Vector3
    sigma: float  # bound below the least singular value of J2


class Sine(NamedTuple):
    """The motion of an actuator in a sweep."""

    middle: float  # [rad]
    amplitude: float  # [rad]
    frequency: float  # at the start [rad/s]
    frequency_slope: float  # [rad/s^2]


StarPath: TypeAlias = Callable[[float], StarPoint]  # of the share of the path
ActuatorPath: TypeAlias = Callable[[float], ActuatorPoint]  # of the time [s]
OpenPoints: TypeAlias = Sequence[Sequence[float] | None]


@check_kinds
def reference_motion(
    scene: SceneInput,
    read_motion: Callable[[str, str | None], Any] | None = None,
) -> ReferenceMotion:
    """Return the reference motion of a scene.

    `read_motion` reads a bag as a `Trajectory`, as
    `recording.recording.read_run_motion` does. Raises InputError where the scene has no
    motion, or one that cannot be made (`through_points`); AssemblyError where the
    initial gamma has no unique admissible assembly; SingularConfiguration where the
    motion meets a parallel singularity.
    """
    scene = scene_of(scene)
    geometry = Geometry.of(scene)
    motion = scene.motion
    if motion is None:
        raise refusal(scene.name, "motion", None, "the scene has no desired motion")
    if motion.recorded:
        bag = motion.recorded.bag
        if read_motion is None:
            requirement = "a recorded motion cannot be read here"
            raise refusal(scene.name, "motion.recorded", bag, requirement)
        run = read_motion(bag, motion.recorded.namespace)
        x, y, z, w = run.quaternion[0].tolist()
        return through_samples(geometry, (x, y, z, w), run.t, run.gamma, run.gamma_dot)
    gamma = scene.initial.gamma
    x, y, z, w, *_ = initial_state(scene, geometry)
    start = (x, y, z, w)
    if motion.to_orientation:
        turn = motion.to_orientation
        return geodesic_motion(geometry, start, turn.orientation, turn.duration)
    if motion.spiral:
        return spiral_motion(geometry, start, motion.spiral)
    if motion.waypoints:
        points = motion.waypoints
        try:
            return through_points(
                geometry,
                start,
                times=[point.time for point in points],
                positions=[point.gamma for point in points],
                velocities=[point.gamma_dot for point in points],
                accelerations=[point.gamma_ddot for point in points],
            )
        except InputError as error:
            origin = f"{scene.name}: motion.waypoints"
            raise InputError(origin, error.problems) from None
    if motion.sweep:
        centre = motion.sweep.centre or gamma
        if centre != gamma:
            start = follow_assembly(geometry, start, gamma, centre)
        path, piece_ends = _sweep_path(motion.sweep, centre)
        return move_actuators(geometry, path, piece_ends, start)
    goal = motion.to_angles
    assert goal is not None
    span = axpy(1.0, goal.gamma, -1.0, gamma)
    path = partial(_on_line, gamma, span, goal.duration)
    piece_ends = equal_pieces(goal.duration, 2 * PIECES)
    return move_actuators(geometry, path, piece_ends, start)


# The paths below are functions of the module, which pickle takes, with their numbers in
# front.


def _on_line(
    gamma: Vector3, span: Vector3, duration: float, time: float
) -> ActuatorPoint:
    """Return the point at a time [s] of a straight motion from gamma over a span."""
    s, rate, acceleration = minimum_jerk(time, duration)
    return ActuatorPoint(
        axpy(1.0, gamma, s, span), multiply(rate, span), multiply(acceleration, span)
    )


def minimum_jerk(time: float, duration: float = 1.0) -> tuple[float, float, float]:
    """Return the minimum-jerk course from 0 to 1, and its two derivatives by time.

    It is at rest at both ends.
    """
    u = time / duration
    remaining = 1.0 - u
    square = u * u
    return (
        square * u * (10.0 + u * (6.0 * u - 15.0)),
        30.0 * square * remaining * remaining / duration,
        60.0 * u * remaining * (remaining - u) / (duration * duration),
    )


def move_star(
    geometry: Geometry, start: Quaternion, path: StarPath, duration: float, turn: float
) -> ReferenceMotion:
    """Return a motion of the star along a path, with minimum jerk.

    The star turns by about `turn` [rad], which decides on the number of pieces.
    """
    space = ActuatorSpaceMap(geometry)
    length = math.hypot(*start)
    x, y, z, w = start
    begin = (x / length, y / length, z / length, w / length)
    count = PIECES + math.ceil(turn / (0.5 * math.pi)) * PIECES
    inside = partial(_on_star_path, space, begin, path, duration)
    return ReferenceMotion(inside, equal_pieces(duration, count))


def _on_star_path(
    space: ActuatorSpaceMap,
    begin: Quaternion,
    path: StarPath,
    duration: float,
    time: float,
) -> Reference:
    """Return the reference of `move_star` at a time [s]."""
    s, rate, acceleration = minimum_jerk(time, duration)
    point = path(s)
    return space.of_star(
        quaternion_product(begin, point.turn),
        multiply(rate, point.slope),
        axpy(acceleration, point.slope, rate * rate, point.curvature),
    )


def geodesic_motion(
    geometry: Geometry, start: Quaternion, end: Quaternion, duration: float
) -> ReferenceMotion:
    """Turn from one orientation to another about one axis, with minimum jerk.

    This is the geodesic of SO(3). Quaternions (x, y, z, w) may have any length > 0; the
    shorter rotation is taken.
    """
    # The axis is the same in {B} and in {E}.
    turn = (Rotation.from_quat(start).inv() * Rotation.from_quat(end)).as_rotvec()
    vector = triple(turn.tolist())
    angle = math.hypot(*vector)
    path = partial(_on_geodesic, vector, angle)
    return move_star(geometry, start, path, duration, angle)


def _on_geodesic(vector: Vector3, angle: float, s: float) -> StarPoint:
    """Return the point at a share of a turn about one axis."""
    half = 0.5 * s * angle
    factor = math.sin(half) / angle if angle else 0.0
    x, y, z = multiply(factor, vector)
    return StarPoint((x, y, z, math.cos(half)), slope=vector, curvature=ZERO)


def spiral_motion(
    geometry: Geometry, start: Quaternion, spiral: Spiral
) -> ReferenceMotion:
    """Return the motion R(0) Rz(theta) Ry(phi) Rz(psi - theta).

    The three angles [rad] grow by minimum jerk. They are tilt, its direction and
    torsion: at phi = 0 the star only turns by psi about E, so the motion is smooth
    where ZYZ angles are not.
    """
    theta = spiral.theta
    phi = spiral.phi
    psi = spiral.psi
    turn = abs(theta) + abs(phi) + abs(psi)
    path = partial(_on_spiral, theta, phi, psi)
    return move_star(geometry, start, path, spiral.duration, turn)


def _on_spiral(theta: float, phi: float, psi: float, s: float) -> StarPoint:
    """Return the point at a share of the path of `spiral_motion`."""
    third = psi - theta
    b = s * phi
    c = s * third
    difference = 0.5 * s * (third - theta)
    total = 0.5 * s * psi
    sine, cosine = math.sin(0.5 * b), math.cos(0.5 * b)
    turn = (
        sine * math.sin(difference),
        sine * math.cos(difference),
        cosine * math.sin(total),
        cosine * math.cos(total),
    )
    sb, cb = math.sin(b), math.cos(b)
    sc, cc = math.sin(c), math.cos(c)
    slope = (
        -theta * sb * cc + phi * sc,
        theta * sb * sc + phi * cc,
        theta * cb + third,
    )
    curvature = (
        -theta * (phi * cb * cc - third * sb * sc) + phi * third * cc,
        theta * (phi * cb * sc + third * sb * cc) - phi * third * sc,
        -theta * phi * sb,
    )
    return StarPoint(turn, slope, curvature)


def move_actuators(
    geometry: Geometry,
    path: ActuatorPath,
    piece_ends: tuple[float, ...],
    start: Quaternion,
) -> ReferenceMotion:
    """Return a motion of the actuators, with the orientation along it.

    The orientation is that of one assembly mode. Orientations are computed once along
    the path, by `continuation` in steps that cannot leave the assembly mode; any other
    orientation is computed from the last of these before it. So the motion does not
    depend on the times that it was computed at before. It starts from an orientation
    (x, y, z, w). Raises SingularConfiguration, with the time, where the path meets a
    parallel singularity, InputError where a piece is longer than LONGEST_PIECE,
    AssemblyError where it does not begin at that orientation.
    """
    space = ActuatorSpaceMap(geometry)
    times = _choose_times(path, piece_ends)
    gammas = [path(time).gamma for time in times]
    try:
        rotations, sigmas = continuation.follow(
            geometry, gammas, rotation_matrix(start)
        )
    except continuation.BranchEnds as error:
        cause = f"parallel singularity before t = {times[error.row]:.9g} s"
        raise SingularConfiguration(
            f"{cause}, least singular value of J2", error.measure
        ) from error
    quaternions = quaternion_of(rotations)
    # Of the two signs each has that of the quaternion before it.
    cosines = np.sum(quaternions * np.vstack([start, quaternions[:-1]]), axis=1)
    signs = np.cumprod(np.where(cosines < 0.0, -1.0, 1.0))
    orientations = map(tuple, (signs[:, None] * quaternions).tolist())
    rows = zip(times, orientations, gammas, sigmas.tolist(), strict=True)
    kept = [KeptOrientation(*row) for row in rows]
    return ReferenceMotion(partial(_on_path, space, path, kept), piece_ends)


def _on_path(
    space: ActuatorSpaceMap,
    path: ActuatorPath,
    kept: Sequence[KeptOrientation],
    time: float,
) -> Reference:
    """Return the reference at a time [s] on a path of the actuators."""
    gamma, gamma_dot, gamma_ddot = path(time)
    later = bisect_right(kept, time, key=attrgetter("time"))
    near = kept[max(later - 1, 0)]
    q = space.follow(near.quaternion, near.gamma, gamma, near.sigma)
    wx, wy, wz, ax, ay, az = space.star_motion(*q, *gamma_dot, *gamma_ddot)
    return Reference(
        quaternion=q,
        body_rate=(wx, wy, wz),
        body_acceleration=(ax, ay, az),
        gamma=gamma,
        gamma_dot=gamma_dot,
        gamma_ddot=gamma_ddot,
    )


def _choose_times(path: ActuatorPath, piece_ends: tuple[float, ...]) -> list[float]:
    """Return times between which gamma moves by no more than KEPT_STEP.

    The first and the last time are among them.
    """
    times = [np.zeros(1)]
    for begin, end in pairwise(piece_ends):
        rough_times = np.linspace(begin, end, _SAMPLES + 1).tolist()
        rough = [path(time).gamma for time in rough_times]
        length = sum(math.dist(a, b) for a, b in pairwise(rough))
        requirement = (
            f"must be less than {LONGEST_PIECE:g} rad"
            f" between {begin:.9g} s and {end:.9g} s"
        )
        refuse_unless(
            "motion",
            ("path length of gamma", length, length < LONGEST_PIECE, requirement),
        )
        count = max(_SAMPLES, math.ceil(4.0 * length / KEPT_STEP))
        times.append(np.linspace(begin, end, count + 1)[1:])
    fine = np.concatenate(times)
    gammas = np.array([path(time).gamma for time in fine.tolist()])
    passed = np.cumsum(np.linalg.norm(np.diff(gammas, axis=0), axis=1))
    # The first of each half a KEPT_STEP of the path.
    _, kept = np.unique(np.append(0.0, passed) // (0.5 * KEPT_STEP), return_index=True)
    return [*fine[kept].tolist(), piece_ends[-1]]


def _sweep_path(
    sweep: Sweep, centre: Vector3
) -> tuple[ActuatorPath, tuple[float, ...]]:
    """Return sines that fade in and out, and pieces of a quarter period or less."""
    first = sweep.frequency
    last = sweep.last_frequency or first
    fade = sweep.fade
    duration = sweep.duration
    sines = []
    for leg in range(3):
        slope = (last[leg] - first[leg]) / duration
        sines.append(Sine(centre[leg], sweep.amplitude[leg], first[leg], slope))
    fastest = max(map(abs, (*first, *last)))
    quarters = math.ceil(fastest * duration / (0.5 * math.pi))
    piece_ends = {
        *equal_pieces(duration, max(quarters, 2 * PIECES)),
        fade,
        duration - fade,
    }
    return partial(_on_sines, sines, fade, duration), tuple(sorted(piece_ends))


def _on_sines(
    sines: Sequence[Sine], fade: float, duration: float, time: float
) -> ActuatorPoint:
    """Return the point at a time [s] of the path of a sweep."""
    # the fading, and its derivatives by time
    e = 1.0
    e1 = 0.0
    e2 = 0.0
    if not fade <= time <= duration - fade:
        e, e1, e2 = minimum_jerk(min(time, duration - time), fade)
        e1 = e1 if time < fade else -e1
    gamma = []
    gamma_dot = []
    gamma_ddot = []
    for middle, amplitude, first, slope in sines:
        angle = time * (first + 0.5 * slope * time)
        frequency = first + slope * time
        # the sine, and its derivatives by time
        s, c = math.sin(angle), math.cos(angle)
        s1 = frequency * c
        s2 = slope * c - frequency * frequency * s
        gamma.append(middle + amplitude * e * s)
        gamma_dot.append(amplitude * (e1 * s + e * s1))
        gamma_ddot.append(amplitude * (e2 * s + 2.0 * e1 * s1 + e * s2))
    return ActuatorPoint(triple(gamma), triple(gamma_dot), triple(gamma_ddot))


def through_points(
    geometry: Geometry,
    start: Quaternion,
    times: Sequence[float],
    positions: Sequence[Sequence[float]],
    velocities: OpenPoints | None = None,
    accelerations: OpenPoints | None = None,
    begin: tuple[Vector3, Vector3] = (ZERO, ZERO),
) -> ReferenceMotion:
    """Return the motion of the actuators through points, quintic between them.

    The fields of trajectory_msgs/JointTrajectory: times of n >= 1 points [s], and n
    rows of gamma [rad] and its derivatives in the order of the legs. A first point
    after time 0 is reached from the start, an orientation (x, y, z, w), and `begin`,
    gamma_dot and gamma_ddot there; one at time 0 is the start itself, at rest. The
    motion ends at rest. Rates and accelerations that are not given (no rows, or None or
    nothing in place of a row) are zero at the ends and chosen for minimum jerk between
    them. Raises InputError for points that make no motion, and as `move_actuators`.
    """
    count = len(times)
    checks: list[Check] = [("points", count, count > 0, "must be one or more")]
    time_rows = _read_rows("times", [[time] for time in times], count, checks)
    position_rows = _read_rows("positions", positions, count, checks)
    velocity_rows = _read_rows("velocities", velocities, count, checks)
    acceleration_rows = _read_rows("accelerations", accelerations, count, checks)
    refuse_unless("trajectory", *checks)
    point_times = np.array(time_rows).ravel()
    gamma = np.array(position_rows)
    rates = np.array(velocity_rows)
    second_rates = np.array(acceleration_rows)
    refuse_unless("trajectory", *_check_points(point_times, rates))
    start_gamma = kinematics.inverse(geometry, rotation_matrix(start))[0]
    if point_times[0] > 0.0:
        begin_rate, begin_acceleration = begin
        point_times = np.append(0.0, point_times)
        gamma = np.vstack([start_gamma, gamma])
        rates = np.vstack([begin_rate, rates])
        second_rates = np.vstack([begin_acceleration, second_rates])
    first = gamma[0].tolist()
    start_text = ", ".join(f"{angle:.6g}" for angle in start_gamma)
    requirement = f"must be within {NEAR:g} rad of the start, ({start_text}) rad"
    is_near = np.abs(gamma[0] - start_gamma).max() <= NEAR
    refuse_unless("trajectory", ("positions[0]", first, is_near, requirement))
    for ends in (rates[0], rates[-1], second_rates[0], second_rates[-1]):
        ends[np.isnan(ends)] = 0.0
    begun = follow_assembly(geometry, start, start_gamma, gamma[0])
    path = partial(_on_curve, quintic(point_times, gamma, rates, second_rates))
    return move_actuators(geometry, path, tuple(point_times.tolist()), begun)


def through_samples(
    geometry: Geometry,
    start: Quaternion,
    times: Array,
    positions: Array,
    velocities: Array,
) -> ReferenceMotion:
    """Return the motion through dense samples, quintic between them.

    It begins with the first sample, from an orientation (x, y, z, w), and may begin and
    end moving. Samples are rising times [s], shape (n,), gamma [rad] and gamma_dot
    [rad/s], shape (n, 3). Raises as `move_actuators`.
    """
    times = times - times[0]
    gamma = np.unwrap(positions, axis=0)
    open_accelerations = np.full_like(gamma, np.nan)
    piece_ends = (*times[:-1:SAMPLES_A_PIECE].tolist(), float(times[-1]))
    curve = quintic(times, gamma, velocities, open_accelerations)
    path = partial(_on_curve, curve)
    return move_actuators(geometry, path, piece_ends, start)


def _read_rows(
    name: str, rows: OpenPoints | None, count: int, checks: list[Check]
) -> list[list[float]]:
    """Read rows of numbers, NaN for open ones; append to checks what they must be."""
    rows = [None] * count if rows is None else rows
    rows_requirement = f"must have a row for each of {count} points"
    checks.append((name, len(rows), len(rows) == count, rows_requirement))
    size = 3
    requirement = "must be 3 finite numbers"
    if name == "times":
        size = 1
        requirement = "must be finite"
    numbers_by_row = [[] if row is None else list(map(float, row)) for row in rows]
    for index, numbers in enumerate(numbers_by_row):
        if not numbers and name in ("velocities", "accelerations"):
            numbers += [math.nan] * size
        else:
            good = len(numbers) == size and all(map(math.isfinite, numbers))
            checks.append((f"{name}[{index}]", numbers, good, requirement))
    return numbers_by_row


def _check_points(point_times: Array, rates: Array) -> Iterator[Check]:
    """Yield what points of finite numbers must be."""
    for index in np.flatnonzero(point_times[1:] <= point_times[:-1]) + 1:
        requirement = (
            f"must be > {point_times[index - 1]:g} s, that of the point before"
        )
        yield f"times[{index}]", float(point_times[index]), False, requirement
    early = point_times[0] < 0.0 or (point_times[0] == 0.0 and len(point_times) == 1)
    yield (
        "times[0]",
        float(point_times[0]),
        not early,
        "must be >= 0 s, that of a single point > 0 s",
    )
    rows_at_rest = {len(point_times) - 1}
    if point_times[0] == 0.0:
        rows_at_rest.add(0)
    for end in sorted(rows_at_rest):
        still = not np.nan_to_num(rates[end]).any()
        requirement = "must be zero: a motion begins and ends at rest"
        yield f"velocities[{end}]", rates[end].tolist(), still, requirement


def _on_curve(curve: PPoly, time: float) -> ActuatorPoint:
    gamma, gamma_dot, gamma_ddot = map(triple, curve(time).tolist())
    return ActuatorPoint(gamma, gamma_dot, gamma_ddot)


_UNIT_QUINTIC = BPoly.from_derivatives([0.0, 1.0], np.eye(6).reshape(2, 3, 6))
"""The quintics on [0, 1] that have one of (p0, v0, a0, p1, v1, a1) and no other."""


def quintic(
    times: ArrayLike,
    positions: ArrayLike,
    velocities: ArrayLike,
    accelerations: ArrayLike,
) -> PPoly:
    """Return position, velocity and acceleration, shape (3, m), quintic between points.

    Times of the points rise [s], shape (n,), n >= 2; the numbers there have shape (n,
    m), NaN where a velocity or an acceleration is left open.
    """
    point_times = np.asarray(times, dtype=float)
    nodes = np.stack([positions, velocities, accelerations], axis=1).astype(float)
    lengths = np.diff(point_times)
    _complete(nodes, lengths)
    # derivatives by the time of a segment, from 0 to 1
    powers = lengths[:, None] ** np.arange(6)
    of_ends = powers[:, [0, 1, 2, 0, 1, 2], None]
    ends = np.concatenate([nodes[:-1], nodes[1:]], axis=1) * of_ends
    unit = PPoly.from_bernstein_basis(_UNIT_QUINTIC).c[:, 0]
    coefficients = np.einsum("ij,njm->inm", unit, ends) / powers.T[::-1, :, None]
    path = PPoly(coefficients, point_times)
    derivatives = [path.derivative(order).c for order in range(3)]
    padded = [np.pad(c, ((6 - len(c), 0), (0, 0), (0, 0))) for c in derivatives]
    return PPoly(np.stack(padded, axis=2), point_times)


def _complete(nodes: Array, lengths: Array) -> None:
    """Fill in open numbers of nodes, shape (n, 3, m), in place.

    Of all choices they have the least integral of the jerk squared.
    """
    usual = float(np.median(lengths))
    # A velocity times the usual length has the size of a position: the system stays
    # well scaled.
    scale = np.array([1.0, usual, usual * usual])[:, None]
    jerk = PPoly.from_bernstein_basis(_UNIT_QUINTIC.derivative(3)).c[::-1, 0]
    h = (lengths / usual)[:, None, None]
    powers = h ** np.array([0, 1, 2, 0, 1, 2])
    # The integral of the jerk squared, as a form in the six numbers at the ends of each
    # segment.
    forms = np.swapaxes(powers, 1, 2) * (jerk.T @ hilbert(3) @ jerk) * powers / h**5
    # places of these numbers among those of all nodes
    places = 3 * np.arange(len(lengths))[:, None] + np.arange(6)
    rows, columns = np.broadcast_arrays(places[:, :, None], places[:, None])
    hessian = csc_array((forms.ravel(), (rows.ravel(), columns.ravel())))
    *_, column_count = nodes.shape
    for column in range(column_count):
        x = (nodes[:, :, column] * scale.T).ravel()
        missing = np.isnan(x)
        if missing.any():
            x[missing] = 0.0
            open_rows = hessian[missing]
            x[missing] = splu(open_rows[:, missing]).solve(-(open_rows @ x))
            nodes[:, :, column] = x.reshape(-1, 3) / scale.T
