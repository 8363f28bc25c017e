# SPDX-License-Identifier: Apache-2.0
"""Desired motions: every derivative is one, every part describes the same motion."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from models import folding_star
from numpy.polynomial import chebyshev
from scipy.interpolate import BPoly
from scipy.spatial.transform import Rotation

from sst_ros.control.actuator_space import slow_down
from sst_ros.control.reference_motions import (
    minimum_jerk,
    quintic,
    reference_motion,
    through_points,
    through_samples,
)
from sst_ros.dynamics.initial_state import initial_state
from sst_ros.errors import InputError, SingularConfiguration
from sst_ros.mechanism import continuation, kinematics, rates, virtual_work
from sst_ros.mechanism.generic_math import quaternion_product
from sst_ros.mechanism.geometry import Geometry, quaternion_of, rotation_matrix
from sst_ros.scene.loads import (
    DesiredMotion,
    Initial,
    Recorded,
    Spiral,
    Sweep,
    ToAngles,
    ToOrientation,
    Waypoint,
)
from sst_ros.scene.scene import load
from sst_ros.simulation.simulation import Simulation

START = (0.75, 0.7, 0.75)
POINTS = ((0.4, (0.8, 0.75, 0.8)), (0.9, (0.9, 0.55, 0.7)), (1.6, (0.6, 0.8, 0.65)))
SWEEP = Sweep(
    amplitude=(0.1, 0.15, 0.05), frequency=(3.0, 4.0, 5.0),
    last_frequency=(10.0, 9.0, 1.0), fade=0.5, duration=2.0,
)  # fmt: skip
KINDS = {
    "to_angles": ToAngles(gamma=(0.9, 0.6, 0.85), duration=0.8),
    "to_orientation": ToOrientation(orientation=(0.1, 0.5, 0.3, 0.8), duration=0.8),
    "sweep": SWEEP,
    "spiral": Spiral(phi=0.3, theta=7.0, psi=0.4, duration=3.0),
    "waypoints": tuple(Waypoint(time=time, gamma=gamma) for time, gamma in POINTS),
}
GENERAL = replace(load("general"), initial=Initial(gamma=START))
GEOMETRY = Geometry.of(GENERAL)
RATES = ("body_rate", "body_acceleration", "gamma_dot", "gamma_ddot")
HALT = (0.0, 0.0, 0.0)


def moving(**kind):
    """The motion of the general manipulator that a section describes."""
    return reference_motion(replace(GENERAL, motion=DesiredMotion(**kind)))


@pytest.fixture
def motion(request):
    return moving(**{request.param: KINDS[request.param]})


every_kind = pytest.mark.parametrize("motion", KINDS, indirect=True)


def pose(gamma=START):
    """Quaternion of the general manipulator at gamma."""
    return initial_state(replace(GENERAL, initial=Initial(gamma=gamma)), GEOMETRY)[:4]


def slope(motion, time, part, h=0.02):
    """Derivative of a part at a time: a polynomial through 14 values within h of it."""
    nodes = chebyshev.chebpts1(14)
    values = [part(motion.at(time + h * node)) for node in nodes]
    return (
        chebyshev.chebval(0.0, chebyshev.chebder(chebyshev.chebfit(nodes, values, 13)))
        / h
    )


def check_derivatives(motion, time):
    """The polynomial errs by some 1e-16 of the values over h, times its 14 terms."""
    at, h = motion.at(time), 0.02
    x, y, z, w = at.quaternion
    q_dot = slope(motion, time, lambda at: at.quaternion, h)
    found = 2.0 * np.array(quaternion_product((-x, -y, -z, w), tuple(q_dot)))[:3]
    size = 1.0 + np.abs(at.body_acceleration).max() + np.abs(at.gamma_ddot).max()
    tolerance = 1e-12 * size / h * 0.02
    assert found == pytest.approx(at.body_rate, abs=tolerance)
    for value, derivative in (RATES[:2], ("gamma", "gamma_dot"), RATES[2:]):
        found = slope(motion, time, lambda at, value=value: getattr(at, value), h)
        assert found == pytest.approx(getattr(at, derivative), abs=tolerance)


@every_kind
def test_rates_and_accelerations_are_derivatives(motion):
    """Inside pieces, away from joints where the fourth derivative may jump."""
    pieces = np.array(motion.pieces)
    middles = 0.5 * (pieces[1:] + pieces[:-1])[np.diff(pieces) > 0.05]
    for time in middles[:: max(1, len(middles) // 9)].tolist():
        check_derivatives(motion, time)


@every_kind
def test_star_and_actuators_move_as_the_paper_has_it(motion):
    for time in np.linspace(0.0, motion.duration, 23).tolist():
        at = motion.at(time)
        rotation = rotation_matrix(at.quaternion)
        assert math.hypot(*at.quaternion) == pytest.approx(1.0, abs=1e-15)
        assert kinematics.inverse(GEOMETRY, rotation)[0] == pytest.approx(
            at.gamma, abs=1e-14
        )
        paper = rates.of_actuators(
            virtual_work.posture(GEOMETRY, at.gamma, rotation),
            at.gamma_dot,
            at.gamma_ddot,
        )
        assert rotation.T @ paper.omega == pytest.approx(at.body_rate, abs=1e-13)
        size = 1.0 + np.abs(at.body_acceleration).max()
        assert rotation.T @ paper.omega_dot == pytest.approx(
            at.body_acceleration, abs=1e-13 * size
        )


@every_kind
def test_a_motion_rests_before_and_after_and_has_no_jumps(motion):
    """In steps of 1e-7 s nothing moves by more than its own derivative and rounding
    allow.
    """
    step = 1e-7
    for time, outside in ((0.0, -1.0), (motion.duration, motion.duration + 1.0)):
        end, beyond = motion.at(time), motion.at(outside)
        assert beyond.quaternion == end.quaternion and beyond.gamma == end.gamma
        for name in RATES:
            assert getattr(beyond, name) == HALT
            assert getattr(end, name) == pytest.approx(HALT, abs=1e-12)
    for time in motion.pieces[1:-1]:
        before, after = motion.at(time - step), motion.at(time + step)
        for name in ("quaternion", "body_rate", "body_acceleration", "gamma_ddot"):
            assert getattr(after, name) == pytest.approx(
                getattr(before, name), abs=1e-3
            )


@every_kind
def test_what_is_asked_before_does_not_matter(motion):
    rng, times = np.random.default_rng(0), np.linspace(-0.1, motion.duration + 0.1, 40)
    first = {time: motion.at(time) for time in times.tolist()}
    for time in rng.permutation(times).tolist():
        assert motion.at(time) == first[time]


def test_a_turn_goes_straight_along_the_shorter_way():
    goal = KINDS["to_orientation"]
    motion = moving(to_orientation=goal)
    begin, end = Rotation.from_quat(pose()), Rotation.from_quat(goal.orientation)
    whole, last = (begin.inv() * end).as_rotvec(), motion.at(motion.duration).quaternion
    assert last == pytest.approx(
        end.as_quat() * np.sign(end.as_quat() @ last), abs=1e-15
    )
    for share in (0.2, 0.5, 0.9):
        turned = begin.inv() * Rotation.from_quat(
            motion.at(share * motion.duration).quaternion
        )
        assert turned.as_rotvec() == pytest.approx(
            minimum_jerk(share)[0] * whole, abs=1e-14
        )


def test_a_spiral_is_what_its_angles_say():
    spiral, begin = KINDS["spiral"], Rotation.from_quat(pose())
    motion = moving(spiral=spiral)
    for share in (0.1, 0.5, 1.0):
        grown = minimum_jerk(share)[0]
        theta, phi, psi = (
            grown * end for end in (spiral.theta, spiral.phi, spiral.psi)
        )
        expected = begin * Rotation.from_euler("ZYZ", [theta, phi, psi - theta])
        found = Rotation.from_quat(motion.at(share * spiral.duration).quaternion)
        assert (expected.inv() * found).magnitude() < 1e-14
        tilt = (begin.inv() * found).as_matrix()[:, 2]
        assert math.acos(tilt[2]) == pytest.approx(phi, abs=1e-7)


@pytest.mark.parametrize("centre", [None, (0.8, 0.8, 0.8)])
def test_a_grown_sweep_is_a_chirp_about_the_start_or_its_centre(centre):
    motion, middle, time = (
        moving(sweep=replace(SWEEP, centre=centre)),
        centre or START,
        1.1,
    )
    for k in range(3):
        rise = (SWEEP.last_frequency[k] - SWEEP.frequency[k]) / SWEEP.duration
        angle = SWEEP.frequency[k] * time + 0.5 * rise * time**2
        expected = middle[k] + SWEEP.amplitude[k] * math.sin(angle)
        assert motion.at(time).gamma[k] == pytest.approx(expected, abs=1e-15)
    begin = motion.at(0.0)
    assert begin.gamma == motion.at(SWEEP.duration).gamma == middle
    expected = kinematics.admissible(GEOMETRY, middle).rotation
    assert rotation_matrix(begin.quaternion) == pytest.approx(expected, abs=1e-14)


def test_points_are_passed_in_time_with_rates_and_accelerations():
    motion = moving(waypoints=KINDS["waypoints"])
    assert motion.duration == POINTS[-1][0]
    for time, gamma in ((0.0, START), *POINTS):
        assert motion.at(time).gamma == pytest.approx(gamma, abs=1e-14)
    points = [Waypoint(time=0.5, gamma=(0.8, 0.8, 0.7), gamma_dot=(0.3, 0.1, -0.2))]
    points += [Waypoint(time=1.0, gamma=(0.9, 0.8, 0.6), gamma_ddot=(0.4, -0.3, 0.0))]
    motion = moving(waypoints=tuple(points))
    assert motion.at(0.5).gamma_dot == pytest.approx((0.3, 0.1, -0.2), abs=1e-14)
    # The coefficients of a quintic are some ten times its values, and more for
    # accelerations.
    assert motion.at(1.0).gamma_ddot == pytest.approx((0.4, -0.3, 0.0), abs=1e-12)


def test_an_assembly_is_followed_not_the_nearest_or_the_first():
    """The same gamma in two assemblies: each is carried along to where continuation
    brings it.
    """
    found = [one for one in kinematics.direct(GEOMETRY, START) if abs(one.det_j2) > 0.3]
    assert len(found) >= 2
    ends = set()
    for assembly in found:
        start = tuple(quaternion_of(assembly.rotation).tolist())
        here = kinematics.inverse(GEOMETRY, assembly.rotation)[0]
        rows = np.array([1.0]), np.add([here], (0.05, -0.04, 0.03)), np.zeros((1, 3))
        last = through_points(GEOMETRY, start, *rows).at(1.0)  # lists elsewhere
        truth, _ = continuation.follow(
            GEOMETRY, np.linspace(here, last.gamma, 200), assembly.rotation
        )
        assert rotation_matrix(last.quaternion) == pytest.approx(truth[-1], abs=1e-13)
        ends.add(tuple(np.round(truth[-1].ravel(), 6)))
    assert len(ends) == len(found)


def test_a_parallel_singularity_in_the_way_is_told_with_its_time():
    scene, poses = folding_star()
    geometry = Geometry.of(scene)
    # Where two assemblies meet gamma turns back: ahead of the pose there is none.
    before = poses[1] @ Rotation.from_rotvec([0.0, 0.0, 0.1]).as_matrix()
    here, there = (kinematics.inverse(geometry, r)[0] for r in (before, poses[1]))
    start, goal = (
        tuple(quaternion_of(before).tolist()),
        (here + 3.0 * (there - here)).tolist(),
    )
    with pytest.raises(
        SingularConfiguration, match=r"parallel singularity before t = 0\.\d+ s"
    ):
        through_points(geometry, start, [1.0], [goal])


def test_a_recorded_motion_is_what_was_recorded():
    """Quintic between samples 2 ms apart.

    The accelerations at both ends are the least certain.
    """
    scene, period, torque = load("general"), 2_000_000, (0.5, -0.4, 0.3)
    simulation = Simulation(scene, tolerance=1e-13)
    states = [simulation.state, *(simulation.step(torque, period) for _ in range(100))]
    times = np.array([state.time_ns * 1e-9 for state in states])
    gamma, gamma_dot = (
        np.array([getattr(state.joints, k) for state in states])
        for k in ("gamma", "gamma_dot")
    )
    motion = through_samples(GEOMETRY, states[0].quaternion, times, gamma, gamma_dot)
    again, errors = Simulation(scene, tolerance=1e-13), []
    for _ in range(100):
        middle = again.step(torque, period // 2)
        at = motion.at(middle.time_ns * 1e-9)
        expected = again.dynamics.derivative(
            *middle.quaternion, *middle.body_rate, *torque
        )[4:7]
        pairs = (
            (at.gamma, middle.joints.gamma),
            (at.quaternion, middle.quaternion),
            (at.gamma_dot, middle.joints.gamma_dot),
            (at.body_acceleration, expected),
        )
        errors.append([np.abs(np.subtract(*pair)).max() for pair in pairs])
        again.step(torque, period // 2)
    assert np.all(np.array(errors) < [1e-10, 1e-10, 1e-7, 1e-3])
    assert np.all(np.array(errors[5:-5]) < [1e-14, 1e-14, 1e-11, 1e-7])
    assert motion.at(0.0).gamma_dot == pytest.approx(scene.initial.gamma_dot, abs=1e-12)
    assert motion.at(-1e-9).gamma_dot == HALT


def test_a_scene_without_motion_and_an_unread_bag_are_refused():
    with pytest.raises(InputError, match="no desired motion"):
        reference_motion(load("example1"))
    with pytest.raises(InputError, match="cannot be read here"):
        moving(recorded=Recorded(bag="somewhere"))


GOOD = [[0.8, 0.8, 0.8], [0.7, 0.7, 0.7]]
NAN, INF = math.nan, math.inf


@pytest.mark.parametrize(
    ("named", "arguments"),
    [
        (r"points = 0: must be one or more", ([], [])),
        (
            r"positions = 1: must have a row for each of 2 points",
            ([1.0, 2.0], GOOD[:1]),
        ),
        (
            r"positions\[1\] = \[0.7\]: must be 3 finite numbers",
            ([1.0, 2.0], [GOOD[0], [0.7]]),
        ),
        (r"positions\[0\] = .*must be 3 finite", ([1.0], [[0.8, NAN, 0.8]])),
        (r"times\[0\] = .*must be finite", ([NAN], GOOD[:1])),
        (r"times\[1\] = .*must be finite", ([1.0, INF], GOOD)),
        (r"times\[1\] = 1.0: must be > 1 s", ([1.0, 1.0], GOOD)),
        (r"times\[0\] = -1.0: must be >= 0 s", ([-1.0, 0.5], GOOD)),
        (r"times\[0\] = 0.0: .*single point > 0 s", ([0.0], GOOD[:1])),
        (r"velocities\[0\] = .*3 finite", ([1.0], GOOD[:1], [[NAN, 0.0, 0.0]])),
        (r"velocities\[0\] = .*must be zero", ([1.0], GOOD[:1], [[0.1, 0.0, 0.0]])),
        (r"velocities\[0\] = .*3 finite", ([1.0], GOOD[:1], [[0.0, 0.0]])),
        (r"accelerations = 1: .*each of 2", ([1.0, 2.0], GOOD, None, [[0.0] * 3])),
        (
            r"accelerations\[1\] = .*3 finite",
            ([1.0, 2.0], GOOD, None, [[], [INF, 0.0, 0.0]]),
        ),
        (r"positions\[0\] = .*within 0.1 rad of the start", ([0.0, 1.0], GOOD[::-1])),
        (r"path length of gamma = .*less than 100 rad", ([1.0], [[1e300, 0.0, 0.0]])),
        (
            r"path length of gamma = .*less than 100",
            ([1.0, 2.0], GOOD, [[1e12, 0.0, 0.0], []]),
        ),
    ],
)
def test_points_that_make_no_motion_are_refused_with_the_reason(named, arguments):
    with pytest.raises(InputError, match=named):
        through_points(GEOMETRY, pose((0.85, 0.85, 0.85)), *arguments)


@pytest.mark.parametrize(
    ("named", "build"),
    [
        ("give one of", lambda: DesiredMotion()),
        ("give one of", lambda: DesiredMotion(sweep=SWEEP, spiral=KINDS["spiral"])),
        ("not all zero", lambda: ToOrientation(orientation=(0.0,) * 4, duration=1.0)),
        ("must not exceed half", lambda: replace(SWEEP, fade=1.1)),
    ],
)
def test_sections_that_say_no_motion_are_refused(named, build):
    with pytest.raises(InputError, match=named):
        build()


def test_a_stop_begins_with_the_motion_and_rests_on_its_path():
    motion, begin, duration = reference_motion(load("reach")), 0.4, 0.25
    stopping = slow_down(motion, begin, duration)
    last, end = stopping.at(duration), motion.at(begin + 0.5 * duration)
    assert stopping.at(0.0) == motion.at(begin)
    assert last.gamma == pytest.approx(end.gamma, abs=1e-15)
    assert last.quaternion == pytest.approx(end.quaternion, abs=1e-15)
    for name in RATES:
        assert getattr(last, name) == pytest.approx(HALT, abs=1e-14), name
    assert stopping.at(duration + 1.0).gamma == last.gamma
    for time in np.linspace(0.025, duration - 0.025, 7):
        check_derivatives(stopping, time)
    # What ends during the stop rests at its end.
    late = slow_down(motion, motion.duration - 0.05, duration)
    assert late.at(duration).gamma == motion.at(motion.duration).gamma
    assert late.at(0.2).gamma_dot == HALT


OPEN = np.nan


def points(seed, count=9):
    rng = np.random.default_rng(seed)
    return np.cumsum(rng.uniform(0.2, 1.0, count)), *rng.normal(size=(3, count, 2))


@pytest.mark.parametrize("seed", range(3))
def test_a_quintic_between_points_is_hermites_polynomial(seed):
    """What is open between them has a test of its own."""
    times, *nodes = points(seed)
    truth = BPoly.from_derivatives(times, np.stack(nodes, axis=1))
    found, fine = quintic(times, *nodes), np.linspace(times[0], times[-1], 200)
    for part in range(3):
        expected = truth.derivative(part)(fine) if part else truth(fine)
        error = np.abs(found(fine)[:, part] - expected).max()
        assert error <= 1e-12 * np.abs(expected).max()


def jerk_squared(times, nodes):
    """Integral of the jerk squared, by SciPy's polynomials and Gauss' rule, which is
    exact here.
    """
    jerk = BPoly.from_derivatives(times, nodes).derivative(3)
    x, weights = np.polynomial.legendre.leggauss(3)
    h = np.diff(times)[:, None]
    at = times[:-1, None] + 0.5 * h * (x + 1.0)
    return float(np.sum(0.5 * h * weights * np.sum(jerk(at) ** 2, axis=-1)))


@pytest.mark.parametrize("seed", range(4))
def test_what_is_open_has_the_least_jerk(seed):
    """The integral is a quadratic of the open numbers: both its neighbours are equally
    above.
    """
    times, *given_nodes = points(seed, 6)
    nodes = np.stack(given_nodes, axis=1)
    rng = np.random.default_rng(seed)
    open_ = rng.random(nodes.shape) < 0.6
    open_[:, 0], open_[[0, -1]] = False, False
    found = quintic(times, *np.where(open_, OPEN, nodes).transpose(1, 0, 2))
    filled = found(times)
    assert filled[~open_] == pytest.approx(nodes[~open_], abs=1e-10)
    assert open_.sum() > 5
    least = jerk_squared(times, filled)
    for index in np.argwhere(open_):
        step = np.zeros_like(filled)
        step[tuple(index)] = 0.1
        above = [
            jerk_squared(times, filled + sign * step) - least for sign in (-1.0, 1.0)
        ]
        assert min(above) > 0.0
        assert above[0] == pytest.approx(above[1], abs=1e-9 * (least + above[0]))


def test_thousands_of_samples_are_completed_at_once():
    """A recording of 20 s at 1 kHz: the band is solved in one go."""
    times = np.arange(20_001) * 1e-3
    positions, velocities = (
        f(3.0 * times)[:, None] for f in (np.sin, lambda x: 3.0 * np.cos(x))
    )
    found = quintic(times, positions, velocities, np.full_like(positions, OPEN))
    fine = np.linspace(1.0, 19.0, 501)
    assert found(fine)[:, 2, 0] == pytest.approx(-9.0 * np.sin(3.0 * fine), abs=1e-6)
