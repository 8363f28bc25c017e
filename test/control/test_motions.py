# SPDX-License-Identifier: Apache-2.0
"""Desired motions: every derivative is one, every part describes the same motion."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from models import FAST
from numpy.polynomial import chebyshev
from scipy.interpolate import BPoly, make_interp_spline
from scipy.spatial.transform import Rotation

from sst_ros.control.actuator_motions import (
    Quintic,
    minimum_jerk,
    through_points,
    through_samples,
)
from sst_ros.control.reference import StoppingMotion
from sst_ros.control.reference_motions import reference_motion
from sst_ros.dynamics.initial_state import initial_state
from sst_ros.errors import InputError, SingularConfiguration
from sst_ros.mechanism import continuation, kinematics, rates, virtual_work, workspace
from sst_ros.mechanism.frames import quaternion_of, rotation_matrix
from sst_ros.mechanism.generic_math import quaternion_product
from sst_ros.mechanism.geometry import Geometry
from sst_ros.scene.loads import (
    DesiredMotion,
    Recorded,
    Spiral,
    Sweep,
    ToAngles,
    ToOrientation,
    Waypoint,
)
from sst_ros.scene.scene import Initial, Scene, load
from sst_ros.simulation.simulation import Simulation

START = (0.75, 0.7, 0.75)
POINTS = ((0.4, (0.8, 0.75, 0.8)), (0.9, (0.9, 0.55, 0.7)), (1.6, (0.6, 0.8, 0.65)))
SWEEP = Sweep(
    amplitude=(0.1, 0.15, 0.05), frequency=(3.0, 4.0, 5.0), last_frequency=(10.0, 9.0, 1.0),
    fade=0.5, duration=2.0,
)  # fmt: skip
KINDS = {
    "to_angles": ToAngles(gamma=(0.9, 0.6, 0.85), duration=0.8),
    "to_orientation": ToOrientation(orientation=(0.1, 0.5, 0.3, 0.8), duration=0.8),
    "sweep": SWEEP,
    "spiral": Spiral(phi=0.3, theta=7.0, psi=0.4, duration=3.0),
    "waypoints": tuple(Waypoint(time=time, gamma=gamma) for time, gamma in POINTS),
}
every_kind = pytest.mark.parametrize("kind", KINDS)


def scene_of(kind, **more) -> Scene:
    """The general manipulator with a motion."""
    scene = replace(load("general"), initial=Initial(gamma=START))
    return replace(
        scene, motion=DesiredMotion(**{kind: more.pop("motion", KINDS.get(kind))}), **more
    )


def slope(motion, time, part, h=0.02):
    """Derivative of a part at a time: a polynomial through 14 values within h of it."""
    nodes = chebyshev.chebpts1(14)
    values = [part(motion.at(time + h * node)) for node in nodes]
    return chebyshev.chebval(0.0, chebyshev.chebder(chebyshev.chebfit(nodes, values, 13))) / h


def within(motion, count=9):
    """Times inside pieces, away from joints where the fourth derivative may jump."""
    pieces = np.array(motion.pieces)
    middles = 0.5 * (pieces[1:] + pieces[:-1])[np.diff(pieces) > 0.05]
    return middles[:: max(1, len(middles) // count)].tolist()


@every_kind
def test_rates_and_accelerations_are_derivatives(kind):
    """The polynomial errs by some 1e-16 of the values over h, times its 14 terms."""
    motion = reference_motion(scene_of(kind))
    for time in within(motion):
        at, h = motion.at(time), 0.02
        x, y, z, w = at.quaternion
        q_dot = slope(motion, time, lambda at: at.quaternion, h)
        found = 2.0 * np.array(quaternion_product((-x, -y, -z, w), tuple(q_dot)))[:3]
        size = 1.0 + np.abs(at.body_acceleration).max() + np.abs(at.gamma_ddot).max()
        tolerance = 1e-12 * size / h * 0.02
        assert found == pytest.approx(at.body_rate, abs=tolerance)
        for value, derivative in (
            ("body_rate", "body_acceleration"),
            ("gamma", "gamma_dot"),
            ("gamma_dot", "gamma_ddot"),
        ):
            found = slope(motion, time, lambda at, value=value: getattr(at, value), h)
            assert found == pytest.approx(getattr(at, derivative), abs=tolerance)


@every_kind
def test_star_and_actuators_move_as_the_paper_has_it(kind):
    motion, geometry = reference_motion(scene_of(kind)), Geometry.of(scene_of(kind))
    for time in np.linspace(0.0, motion.duration, 23).tolist():
        at = motion.at(time)
        rotation = rotation_matrix(at.quaternion)
        assert math.hypot(*at.quaternion) == pytest.approx(1.0, abs=1e-15)
        assert kinematics.inverse(geometry, rotation)[0] == pytest.approx(at.gamma, abs=1e-14)
        paper = rates.of_actuators(
            virtual_work.posture(geometry, at.gamma, rotation), at.gamma_dot, at.gamma_ddot
        )
        assert rotation.T @ paper.omega == pytest.approx(at.body_rate, abs=1e-13)
        size = 1.0 + np.abs(at.body_acceleration).max()
        assert rotation.T @ paper.omega_dot == pytest.approx(at.body_acceleration, abs=1e-13 * size)


@every_kind
def test_a_motion_rests_before_and_after_and_has_no_jumps(kind):
    """In steps of 1e-7 s nothing moves by more than its own derivative and rounding allow."""
    motion, step = reference_motion(scene_of(kind)), 1e-7
    for time, outside in ((0.0, -1.0), (motion.duration, motion.duration + 1.0)):
        end, beyond = motion.at(time), motion.at(outside)
        assert beyond.quaternion == end.quaternion and beyond.gamma == end.gamma
        for name in ("body_rate", "body_acceleration", "gamma_dot", "gamma_ddot"):
            assert getattr(beyond, name) == (0.0, 0.0, 0.0)
            assert getattr(end, name) == pytest.approx((0.0, 0.0, 0.0), abs=1e-12)
    for time in motion.pieces[1:-1]:
        before, after = motion.at(time - step), motion.at(time + step)
        for name in ("quaternion", "body_rate", "body_acceleration", "gamma_ddot"):
            assert getattr(after, name) == pytest.approx(getattr(before, name), abs=1e-3)


@every_kind
def test_what_is_asked_before_does_not_matter(kind):
    motion, rng = reference_motion(scene_of(kind)), np.random.default_rng(0)
    times = np.linspace(-0.1, motion.duration + 0.1, 40)
    first = {time: motion.at(time) for time in times.tolist()}
    for time in rng.permutation(times).tolist():
        assert motion.at(time) == first[time]


def test_a_turn_goes_straight_along_the_shorter_way():
    scene = scene_of("to_orientation")
    motion, start = reference_motion(scene), initial_state(scene, Geometry.of(scene))[:4]
    begin, end = (Rotation.from_quat(q) for q in (start, KINDS["to_orientation"].orientation))
    whole = (begin.inv() * end).as_rotvec()
    assert motion.at(motion.duration).quaternion == pytest.approx(
        end.as_quat() * np.sign(end.as_quat() @ motion.at(motion.duration).quaternion), abs=1e-15
    )
    for share in (0.2, 0.5, 0.9):
        turned = begin.inv() * Rotation.from_quat(motion.at(share * motion.duration).quaternion)
        s = 10.0 * share**3 - 15.0 * share**4 + 6.0 * share**5
        assert turned.as_rotvec() == pytest.approx(s * whole, abs=1e-14)


def test_a_spiral_is_what_its_angles_say():
    scene, spiral = scene_of("spiral"), KINDS["spiral"]
    motion = reference_motion(scene)
    begin = Rotation.from_quat(initial_state(scene, Geometry.of(scene))[:4])
    for share in (0.1, 0.5, 1.0):
        s = 10.0 * share**3 - 15.0 * share**4 + 6.0 * share**5
        theta, phi, psi = s * spiral.theta, s * spiral.phi, s * spiral.psi
        expected = begin * Rotation.from_euler("ZYZ", [theta, phi, psi - theta])
        found = Rotation.from_quat(motion.at(share * spiral.duration).quaternion)
        assert (expected.inv() * found).magnitude() < 1e-14
        tilt = (begin.inv() * found).as_matrix()[:, 2]
        assert math.acos(tilt[2]) == pytest.approx(phi, abs=1e-7)


def test_a_sweep_is_a_chirp_once_it_has_grown():
    motion, time = reference_motion(scene_of("sweep")), 1.1
    for k in range(3):
        rise = (SWEEP.last_frequency[k] - SWEEP.frequency[k]) / SWEEP.duration
        angle = SWEEP.frequency[k] * time + 0.5 * rise * time**2
        expected = START[k] + SWEEP.amplitude[k] * math.sin(angle)
        assert motion.at(time).gamma[k] == pytest.approx(expected, abs=1e-15)
    assert motion.at(0.0).gamma == motion.at(SWEEP.duration).gamma == START


def test_a_sweep_about_another_centre_begins_there():
    centre = (0.8, 0.8, 0.8)
    motion = reference_motion(scene_of("sweep", motion=replace(SWEEP, centre=centre)))
    geometry = Geometry.of(load("general"))
    assert motion.at(0.0).gamma == centre
    expected = kinematics.admissible(geometry, centre).rotation
    assert rotation_matrix(motion.at(0.0).quaternion) == pytest.approx(expected, abs=1e-14)


def test_points_are_passed_at_their_times():
    motion = reference_motion(scene_of("waypoints"))
    assert motion.duration == POINTS[-1][0]
    for time, gamma in ((0.0, START), *POINTS):
        assert motion.at(time).gamma == pytest.approx(gamma, abs=1e-14)


def test_points_with_rates_and_accelerations_are_passed_with_them():
    points = [Waypoint(time=0.5, gamma=(0.8, 0.8, 0.7), gamma_dot=(0.3, 0.1, -0.2))]
    points += [Waypoint(time=1.0, gamma=(0.9, 0.8, 0.6), gamma_ddot=(0.4, -0.3, 0.0))]
    motion = reference_motion(scene_of("waypoints", motion=tuple(points)))
    assert motion.at(0.5).gamma_dot == pytest.approx((0.3, 0.1, -0.2), abs=1e-14)
    # The coefficients of a quintic are some ten times its values, and more for accelerations.
    assert motion.at(1.0).gamma_ddot == pytest.approx((0.4, -0.3, 0.0), abs=1e-12)


def test_an_assembly_is_followed_and_not_the_nearest_or_the_first():
    """The same gamma in two assemblies: each is carried along to where continuation brings it."""
    geometry = Geometry.of(load("general"))
    found = [one for one in kinematics.direct(geometry, START) if abs(one.det_j2) > 0.3]
    assert len(found) >= 2
    ends = set()
    for assembly in found:
        x, y, z, w = quaternion_of(assembly.rotation).tolist()
        motion = through_points(geometry, (x, y, z, w), [1.0], [assembly_gamma(geometry, assembly)])
        end = rotation_matrix(motion.at(1.0).quaternion)
        here = kinematics.inverse(geometry, assembly.rotation)[0]
        truth = continuation.follow(
            geometry, np.linspace(here, motion.at(1.0).gamma, 200), assembly.rotation
        )
        assert end == pytest.approx(truth.rotation[-1], abs=1e-13)
        ends.add(tuple(np.round(end.ravel(), 6)))
    assert len(ends) == len(found)


def assembly_gamma(geometry, assembly):
    """A little way from the angles that the kernel's branch of the legs gives an assembly."""
    return (kinematics.inverse(geometry, assembly.rotation)[0] + [0.05, -0.04, 0.03]).tolist()


def test_a_parallel_singularity_in_the_way_is_told_with_its_time():
    star = replace(load("example1").star, alpha_deg=(210.0, 75.0, 75.0))
    scene = replace(load("example1"), star=star)
    geometry = Geometry.of(scene)
    s, _ = workspace.triangle_directions(geometry, 6)
    poses = workspace.parallel_singularities(workspace.over_orientations(geometry, s, 36))
    rotation = poses.rotation[1]
    # Where two assemblies meet gamma turns back: ahead of the pose there is none.
    before = rotation @ Rotation.from_rotvec([0.0, 0.0, 0.1]).as_matrix()
    here, there = (kinematics.inverse(geometry, r)[0] for r in (before, rotation))
    x, y, z, w = quaternion_of(before).tolist()
    with pytest.raises(SingularConfiguration, match=r"parallel singularity before t = 0\.\d+ s"):
        through_points(geometry, (x, y, z, w), [1.0], [(here + 3.0 * (there - here)).tolist()])


def test_a_recorded_motion_is_what_was_recorded():
    """Quintic between samples 2 ms apart; the accelerations at both ends are the least certain."""
    scene = load("general")
    simulation, period = Simulation(scene, tolerance=1e-13), 2_000_000
    torque = (0.5, -0.4, 0.3)
    states = [simulation.state, *(simulation.step(torque, period) for _ in range(100))]
    times = np.array([state.time_ns * 1e-9 for state in states])
    joints = [state.joints for state in states]
    gamma, gamma_dot = (
        np.array([getattr(one, k) for one in joints]) for k in ("gamma", "gamma_dot")
    )
    motion = through_samples(Geometry.of(scene), states[0].quaternion, times, gamma, gamma_dot)
    again, worst = Simulation(scene, tolerance=1e-13), []
    for _ in range(100):
        middle = again.step(torque, period // 2)
        at = motion.at(middle.time_ns * 1e-9)
        expected = again.dynamics.derivative(*middle.quaternion, *middle.body_rate, *torque)[4:7]
        pairs = (
            (at.gamma, middle.joints.gamma),
            (at.quaternion, middle.quaternion),
            (at.gamma_dot, middle.joints.gamma_dot),
            (at.body_acceleration, expected),
        )
        worst.append([np.abs(np.subtract(*pair)).max() for pair in pairs])
        again.step(torque, period // 2)
    assert np.all(np.array(worst) < [1e-10, 1e-10, 1e-7, 1e-3])
    assert np.all(np.array(worst[5:-5]) < [1e-14, 1e-14, 1e-11, 1e-7])
    assert motion.at(0.0).gamma_dot == pytest.approx(scene.initial.gamma_dot, abs=1e-12)
    assert motion.at(-1e-9).gamma_dot == (0.0, 0.0, 0.0)


def test_a_scene_without_motion_and_a_bag_without_reader_are_refused():
    with pytest.raises(InputError, match="no desired motion"):
        reference_motion(load("example1"))
    with pytest.raises(InputError, match="cannot be read here"):
        reference_motion(scene_of("recorded", motion=Recorded(bag="somewhere")))


GOOD = [[0.8, 0.8, 0.8], [0.7, 0.7, 0.7]]
NAN, INF = math.nan, math.inf


@pytest.mark.parametrize(
    ("named", "arguments"),
    [
        (r"points = 0: must be one or more", ([], [])),
        (r"positions = 1: must have a row for each of 2 points", ([1.0, 2.0], GOOD[:1])),
        (r"positions\[1\] = \[0.7\]: must be 3 finite numbers", ([1.0, 2.0], [GOOD[0], [0.7]])),
        (r"positions\[0\] = .*must be 3 finite", ([1.0], [[0.8, NAN, 0.8]])),
        (r"times\[0\] = .*must be finite", ([NAN], GOOD[:1])),
        (r"times\[1\] = .*must be finite", ([1.0, INF], GOOD)),
        (r"times\[1\] = 1.0: must be > 1 s", ([1.0, 1.0], GOOD)),
        (r"times\[1\] = 0.5: must be > 1 s", ([1.0, 0.5], GOOD)),
        (r"times\[0\] = -1.0: must be >= 0 s", ([-1.0, 0.5], GOOD)),
        (r"times\[0\] = 0.0: .*single point > 0 s", ([0.0], GOOD[:1])),
        (r"velocities\[0\] = .*3 finite", ([1.0], GOOD[:1], [[NAN, 0.0, 0.0]])),
        (r"velocities\[0\] = .*must be zero", ([1.0], GOOD[:1], [[0.1, 0.0, 0.0]])),
        (r"velocities\[0\] = .*3 finite", ([1.0], GOOD[:1], [[0.0, 0.0]])),
        (r"accelerations = 1: .*each of 2", ([1.0, 2.0], GOOD, None, [[0.0] * 3])),
        (r"accelerations\[1\] = .*3 finite", ([1.0, 2.0], GOOD, None, [[], [INF, 0.0, 0.0]])),
        (r"positions\[0\] = .*within 0.1 rad of the start", ([0.0, 1.0], GOOD[::-1])),
        (r"path length of gamma = .*less than 100 rad", ([1.0], [[1e300, 0.0, 0.0]])),
        (r"path length of gamma = .*less than 100", ([1.0, 2.0], GOOD, [[1e12, 0.0, 0.0], []])),
    ],
)
def test_points_that_make_no_motion_are_refused_with_the_reason(named, arguments):
    scene = replace(load("general"), initial=Initial(gamma=(0.85, 0.85, 0.85)))
    geometry = Geometry.of(scene)
    x, y, z, w = initial_state(scene, geometry)[:4]
    with pytest.raises(InputError, match=named):
        through_points(geometry, (x, y, z, w), *arguments)


@pytest.mark.parametrize(
    ("named", "build"),
    [
        ("give one of", lambda: DesiredMotion()),
        ("give one of", lambda: DesiredMotion(sweep=SWEEP, spiral=KINDS["spiral"])),
        ("must not be zero", lambda: ToOrientation(orientation=(0.0,) * 4, duration=1.0)),
        ("must not exceed half", lambda: replace(SWEEP, fade=1.1)),
        (r"must be > 0.9 s", lambda: DesiredMotion(waypoints=KINDS["waypoints"][1::-1])),
        ("duration", lambda: ToAngles(gamma=START, duration=0.0)),
    ],
)
def test_sections_that_say_no_motion_are_refused(named, build):
    with pytest.raises(InputError, match=named):
        build()


def test_arrays_and_lists_of_points_are_one():
    scene = replace(load("general"), initial=Initial(gamma=START))
    geometry = Geometry.of(scene)
    x, y, z, w = initial_state(scene, geometry)[:4]
    rows = ([0.5, 1.0], [[0.8, 0.8, 0.7], [0.9, 0.7, 0.8]], [[0.1, 0.2, 0.1], [0.0] * 3])
    motions = [
        through_points(geometry, (x, y, z, w), *given) for given in (rows, map(np.array, rows))
    ]
    assert motions[0].at(0.7) == motions[1].at(0.7)


BEGIN, DURATION = 0.4, 0.25


def test_it_begins_with_the_motion_and_ends_at_rest_on_its_path():
    motion = reference_motion(load("reach"))
    stopping = StoppingMotion(motion, BEGIN, DURATION)
    first, last = stopping.at(0.0), stopping.at(DURATION)
    assert first == motion.at(BEGIN)
    end = motion.at(BEGIN + 0.5 * DURATION)
    assert last.gamma == pytest.approx(end.gamma, abs=1e-15)
    assert last.quaternion == pytest.approx(end.quaternion, abs=1e-15)
    for name in ("gamma_dot", "gamma_ddot", "body_rate", "body_acceleration"):
        assert getattr(last, name) == pytest.approx((0.0, 0.0, 0.0), abs=1e-14), name
    assert stopping.at(DURATION + 1.0).gamma == last.gamma


@pytest.mark.parametrize(
    ("name", "derivative"),
    [("gamma", "gamma_dot"), ("gamma_dot", "gamma_ddot"), ("body_rate", "body_acceleration")],
)
def test_its_rates_are_derivatives(name, derivative):
    stopping = StoppingMotion(reference_motion(load("reach")), BEGIN, DURATION)
    for time in np.linspace(0.01, DURATION - 0.01, 7):
        after, before = (np.array(getattr(stopping.at(time + h), name)) for h in (1e-5, -1e-5))
        slope = (after - before) / 2e-5
        assert getattr(stopping.at(time), derivative) == pytest.approx(slope, abs=1e-6)


def test_what_ends_during_the_stop_rests_at_its_end():
    motion = reference_motion(load("reach"))
    stopping = StoppingMotion(motion, motion.duration - 0.05, DURATION)
    end = motion.at(motion.duration)
    assert stopping.at(DURATION).gamma == end.gamma
    assert stopping.at(0.2).gamma_dot == (0.0, 0.0, 0.0)


OPEN = np.nan


def points(seed, count=9):
    rng = np.random.default_rng(seed)
    return np.cumsum(rng.uniform(0.2, 1.0, count)), *rng.normal(size=(3, count, 2))


def sampled(quintic, times, part):
    return np.array([quintic.at(time)[part] for time in times.tolist()])


@pytest.mark.parametrize("seed", range(3))
def test_positions_alone_make_scipys_quintic_spline(seed):
    """Its system has a condition of some 1e4 for these intervals."""
    times, positions, velocities, accelerations = points(seed)
    velocities[1:-1] = accelerations[1:-1] = OPEN
    found = Quintic(times, positions, velocities, accelerations)
    ends = [[(1, velocities[i]), (2, accelerations[i])] for i in (0, -1)]
    truth = make_interp_spline(times, positions, k=5, bc_type=ends)
    fine = np.linspace(times[0], times[-1], 200)
    for part in range(3):
        expected = truth(fine, part)
        error = np.abs(sampled(found, fine, part) - expected).max()
        assert error <= 1e-12 * np.abs(expected).max()


def test_all_given_is_hermites_polynomial():
    times, *nodes = points(5)
    found = Quintic(times, *nodes)
    truth = BPoly.from_derivatives(times, np.stack(nodes, axis=1))
    fine = np.linspace(times[0], times[-1], 200)
    for part in range(3):
        expected = truth.derivative(part)(fine) if part else truth(fine)
        assert sampled(found, fine, part) == pytest.approx(
            expected, rel=1e-12, abs=1e-12 * np.abs(expected).max()
        )


def jerk_squared(times, nodes):
    """Integral of the jerk squared, by SciPy's polynomials and Gauss' rule, which is exact here."""
    jerk = BPoly.from_derivatives(times, nodes).derivative(3)
    x, weights = np.polynomial.legendre.leggauss(3)
    h = np.diff(times)[:, None]
    at = times[:-1, None] + 0.5 * h * (x + 1.0)
    return float(np.sum(0.5 * h * weights * np.sum(jerk(at) ** 2, axis=-1)))


@pytest.mark.parametrize("seed", range(4))
def test_what_is_open_has_the_least_jerk(seed):
    """The integral is a quadratic of the open numbers: both its neighbours are equally above."""
    times, *given_nodes = points(seed, 6)
    nodes = np.stack(given_nodes, axis=1)
    rng = np.random.default_rng(seed)
    open_ = rng.random(nodes.shape) < 0.6
    open_[:, 0], open_[[0, -1]] = False, False
    found = Quintic(times, *np.where(open_, OPEN, nodes).transpose(1, 0, 2))
    filled = np.stack([sampled(found, times, part) for part in range(3)], axis=1)
    assert filled[~open_] == pytest.approx(nodes[~open_], abs=1e-10)
    assert open_.sum() > 5
    least = jerk_squared(times, filled)
    for index in np.argwhere(open_):
        step = np.zeros_like(filled)
        step[tuple(index)] = 0.1
        above = [jerk_squared(times, filled + sign * step) - least for sign in (-1.0, 1.0)]
        assert min(above) > 0.0
        assert above[0] == pytest.approx(above[1], abs=1e-9 * (least + above[0]))


@FAST
@given(st.floats(0.0, 1.0))
def test_minimum_jerk_is_its_polynomial(u):
    polynomial = np.polynomial.Polynomial([0, 0, 0, 10, -15, 6])
    expected = [polynomial(u), polynomial.deriv()(u), polynomial.deriv(2)(u)]
    assert minimum_jerk(u) == pytest.approx(expected, abs=2e-14)


def test_thousands_of_samples_are_completed_at_once():
    """A recording of 20 s at 1 kHz: the band is solved in one go."""
    times = np.arange(20_001) * 1e-3
    positions, velocities = (f(3.0 * times)[:, None] for f in (np.sin, lambda x: 3.0 * np.cos(x)))
    found = Quintic(times, positions, velocities, np.full_like(positions, OPEN))
    fine = np.linspace(1.0, 19.0, 501)
    assert sampled(found, fine, 2)[:, 0] == pytest.approx(-9.0 * np.sin(3.0 * fine), abs=1e-6)
