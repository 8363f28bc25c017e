# SPDX-License-Identifier: Apache-2.0
"""What is proven holds for solutions of 60 digits, but not where a part breaks."""

import math
from concurrent.futures import ThreadPoolExecutor
from decimal import Decimal

import numpy as np
import pytest
from mpmath import mp, mpf
from slow_cases import slow_after

from sst_ros import (
    InputError,
    PolynomialTorque,
    SineTorque,
    TorqueTable,
    certify,
    load_scene,
    simulate,
)
from sst_ros.__main__ import main
from sst_ros.dynamics.motion_table import JOINT_QUANTITIES
from sst_ros.mechanism.geometry import angle_between
from sst_ros.proof import balls, enclosure, scene_balls
from sst_ros.proof import certify as certify_module
from sst_ros.proof.balls import arb, arb_poly, arb_series
from sst_ros.proof.enclosure import Region
from sst_ros.report.accuracy import proven_error
from sst_ros.report.reference_solution import InitialValueProblem, solve_reference
from studies.sixty_digits import Motion, angle

REFERENCES = ("example1", "example2", "general", "gravity_payload")
ROUNDING = 1e-15  # of a reference that is rounded to doubles [rad]
FREE = {"stroke.at_end": "ignore", "workspace.at_edge": "ignore"}
SINE = SineTorque(
    amplitude=(1.0, -0.5, 2.0), frequency=(15.0, 12.0, 20.0), phase=(0.0, 1.0, 0.5)
)
CASES = {
    "general": ("general", {}, None),
    "gravity_payload": (
        "gravity_payload",
        {"initial.gamma_dot": (0.5, -0.5, 0.2)},
        SINE,
    ),
    "lag": (
        "example2_heavy",
        {"actuators": {"time_constant": 0.02, "rotor_inertia": 1e-3}},
        SINE,
    ),
    "friction": (
        "friction",
        {"friction.gamma.smoothing": 0.3, "friction.mu.smoothing": 0.3},
        None,
    ),
}
NAMES = [f"{joint}_{leg}" for joint in JOINT_QUANTITIES for leg in (1, 2, 3)]


def worst(columns, motion, row, time):
    """Largest true error over its bound at an instant."""
    y = motion.at(time)
    q = [columns[f"quaternion_{part}"][row] for part in "xyzw"]
    ratios = [angle(y[:4], q) / mpf(columns["angle"][row])]
    names = ["body_rate_x", "body_rate_y", "body_rate_z", *NAMES]
    for name, x in zip(names, [*y[4:7], *motion.joints(y)], strict=True):
        ratios.append(
            abs(x - mpf(columns[name][row])) / mpf(columns[f"{name}_bound"][row])
        )
    return float(max(ratios))


def case(name):
    scene, values, torque = CASES[name]
    return load_scene(scene).with_values({**FREE, **values}), torque


@pytest.mark.parametrize(
    "name",
    slow_after(1, CASES),
)
def test_a_solution_of_60_digits_lies_inside(name):
    scene, torque = case(name)
    given = {"t_eval": [0.05], "method": "rk4", "tolerance": 1e-6}
    proven, motion = certify(scene, torque, 0.05, **given), Motion(scene, torque)
    assert proven.success and proven.until == 0.05 and proven.largest < 1e-12
    assert worst(proven.columns, motion, 0, 0.05) < 1.0
    true = angle(motion.at(0.05)[:4], proven.trajectory.quaternion[0])
    most = proven.columns["distance"][0]
    assert 1e-13 < true <= most < 1.1 * true


@pytest.mark.slow
def test_all_motions_of_ranges_lie_inside():
    scene, _ = case("general")
    ranges = {
        "initial.gamma_dot": 1e-4,
        "initial.gamma[0]": 1e-5,
        "star.inertia.zz": 5e-4,
    }
    proven = certify(scene, SINE, 0.1, ranges=ranges, t_eval=[0.1])
    assert not proven.reason and proven.until == 0.1
    found = []
    for signs in (
        (1, 1, 1, 1, 1),
        (-1, 1, -1, 1, -1),
        (1, -1, -1, -1, 1),
        (-1, -1, 1, 1, 1),
    ):
        values = {
            "initial.gamma_dot": tuple(
                x + 1e-4 * sign
                for x, sign in zip(scene.initial.gamma_dot, signs, strict=False)
            ),
            "initial.gamma": (0.75 + 1e-5 * signs[3], 0.7, 0.75),
            "star.inertia.zz": 0.22 + 5e-4 * signs[4],
        }
        found.append(
            worst(proven.columns, Motion(scene.with_values(values), SINE), 0, 0.1)
        )
    assert max(found) < 1.0
    assert max(found) > 0.3  # not wider than needed by much


def test_digits_are_half_a_unit_of_the_last_one():
    scene, _ = case("general")
    times = {"t_eval": [0.01]}
    digits = certify(scene, SINE, 0.01, ranges={"star.inertia.zz": "digits"}, **times)
    half = certify(scene, SINE, 0.01, ranges={"star.inertia.zz": 0.005}, **times)
    assert digits.columns["angle"] == half.columns["angle"]


def oscillator(radius=0.0):
    """y'' = -y from (1, 0)."""
    box = Region.box(0.0, [arb(1, radius), arb(0, radius)])
    return (lambda t, x, v: (v, -x)), (lambda t, x, v: (v, -x, 0, -1, 1, 0)), box


def last(f, jacobian, box, end, tolerance=1e-20, order=24):
    *_, step = enclosure.ProvenSteps(f, jacobian, box, end, tolerance, order)
    return step


def test_an_oscillator_is_not_wrapped():
    with balls.precision():
        step = last(*oscillator(1e-3), 20.0)
        p, e = step.at(20.0)
    with mp.workdps(40):
        assert abs(mpf(p[0].str(40, radius=False)) - mp.cos(20)) < 1e-17
    exactly = 1e-3 * (abs(math.cos(20.0)) + abs(math.sin(20.0)))
    assert exactly <= float(e[0]) < 1.1 * exactly


def halve_the_defect(patch):
    bound = enclosure.bound_defect
    patch.setattr(enclosure, "bound_defect", lambda *given: [
        [x / 2 for x in row] for row in bound(*given)
    ])  # fmt: skip


def test_a_halved_defect_misses_the_solution(monkeypatch):
    # y' = 3 (t - h/2)^2 by p = 0: the defect is all of it, and its integral is the
    # error, h^3 / 4.
    h = arb(0.125)

    def miss():
        with balls.precision():
            p, tube = [enclosure.arb_poly([0])], [arb(0, 1)]
            step = enclosure.Advance(Region.box(0.0, [arb(0)]), 0.125, p, tube)

            def f(t, y):
                return (3 * (t - h / 2) ** 2,)

            step = enclosure.prove(f, lambda t, y: (*f(t, y), 0 * t), step, 2, 1.0)
            return float(h**3 / 4) / float(step.at(0.125)[1][0])

    assert 0.999 < miss() <= 1.0
    halve_the_defect(monkeypatch)
    assert miss() > 1.9


def test_the_norm_of_an_integral_is_no_bound(monkeypatch):
    # x' = 100 (y - x) + .., y' = 0 by p = (0, -t): the defect of y acts all the time,
    # that of x at the end, and x has both; each has the integral h.
    h, order = 0.125, 30
    monkeypatch.setattr(enclosure, "_weights", lambda _: [arb(1), arb(1)])

    def f(t, x, y):
        return 100 * (y - x) + 100 * t + (order + 1) * (t * (1 / h)) ** order, 0 * t

    with balls.precision():
        p = [enclosure.arb_poly([0]), enclosure.arb_poly([0, -1])]
        step = enclosure.Advance(Region.box(0.0, [arb(0)] * 2), h, p, [arb(0, 1e3)] * 2)
        given = (lambda *y: (*f(*y), -100, 0, 100, 0)), step, order, 1e3
        bound = float(enclosure.prove(f, *given).at(h)[1][0])
    error = mp.quad(
        lambda s: mp.exp(100 * (s - h)) * (100 * s + (order + 1) * (s / h) ** order),
        [0, h],
    )
    assert 1.2 * h < error < bound


@pytest.mark.parametrize("unknown", ["nan", "inf"])
def test_a_slope_that_is_not_a_number_is_refused(unknown):
    with balls.precision():
        p, tube = [arb_poly([0])] * 2, [arb(0, 1)] * 2
        step = enclosure.Advance(Region.box(0.0, [arb(0)] * 2), 0.125, p, tube)

        def f(t, x, y):
            return 0 * t, arb(unknown)

        with pytest.raises(enclosure.Refused, match="not bounded"):
            enclosure.prove(f, lambda *y: (*f(*y), 0, 0, 0, 0), step, 2, 1.0)


def remove_rounding(patch):
    """Leave Lagrange's remainder of the defect alone; take reached ends as exact."""
    bound, end = enclosure.bound_defect, enclosure.region_at_end
    patch.setattr(enclosure, "bound_defect", lambda *given: [
        [*(0 * x for x in row[:-1]), row[-1]] for row in bound(*given)
    ])  # fmt: skip
    patch.setattr(enclosure, "region_at_end", lambda step: end(step)._replace(b=step.w))


def test_without_rounding_the_solution_is_missed(monkeypatch):
    # 40 bits, so that nearly all of the bound is rounding; -cos(1) is known better.
    monkeypatch.setattr(balls, "PRECISION", 40)

    def miss():
        with balls.precision():
            p, e = last(*oscillator(), 1.0, 1e-12, 24).at(1.0)
            return abs(float(p[0]) - math.cos(1.0)), float(e[0])

    error, bound = miss()
    assert 1e-16 < error < bound < 1e-9
    remove_rounding(monkeypatch)
    error, bound = miss()
    assert error > bound


def test_a_wrong_jacobian_misses_a_motion_of_the_range(monkeypatch):
    f, jacobian, box = oscillator(1e-3)
    with balls.precision():
        e = last(f, jacobian, box, 1.0).at(1.0)[1]
        approximate = enclosure.approximate  # by the right one
        monkeypatch.setattr(
            enclosure,
            "approximate",
            lambda f, _, *given: approximate(f, jacobian, *given),
        )
        wrong = last(f, lambda t, x, v: (v, -x, 0, -0.5, 0.5, 0), box, 1.0).at(1.0)[1]
    # from (1.001, 0.001)
    apart = 1.001 * math.cos(1.0) + 0.001 * math.sin(1.0) - math.cos(1.0)
    assert float(wrong[0]) < apart < float(e[0])


def ratios(step, motion):
    """True errors of the numbers of a state at the end of a step, over their bounds."""
    p, e = step.at(step.end)
    with mp.workdps(40):
        truth = motion.at(step.end)
        moving = len(truth)  # how numbers are read follows, which does not move
        assert moving == len(p) - 1
        found = [mpf(x.str(40, radius=False)) for x in p[:moving]]
        return [
            float(abs(x - y) / mpf(float(r)))
            for x, y, r in zip(found, truth, e[:moving], strict=True)
        ]


def equations_of(scene, torque):
    """The derivative, it with the Jacobian, and the start of a proof."""
    equations = certify_module.BallEquations(scene, torque, {})
    return *equations.between(0.0, 1.0), equations.start()


def test_without_rounding_a_motion_of_60_digits_is_missed(monkeypatch):
    scene, _ = case("general")
    motion = Motion(scene, SINE)

    def reach(size):
        with monkeypatch.context() as patch:
            patch.setattr(balls, "PRECISION", 40)
            with balls.precision():
                f, jacobian, here = equations_of(scene, SINE)
                here = here._replace(a=size * here.a, b=size * here.b)
                step = last(f, jacobian, here, 0.02, 1e-11, 24)
        with balls.precision():
            return max(ratios(step, motion))

    assert 1e-3 < reach(1) < 1.0
    remove_rounding(monkeypatch)
    assert reach(0) > 1.0


@pytest.mark.slow
def test_a_halved_defect_misses_a_motion_of_60_digits(monkeypatch):
    # In a short step p is off by 2^-20 s, so that the defect acts alike all the time.
    scene, _ = case("general")
    motion, h = Motion(scene, SINE), 2.0**-12
    monkeypatch.setattr(enclosure, "_weights", lambda j: [arb(1)] * len(j.tolist()))

    def found():
        with balls.precision():
            f, jacobian, here = equations_of(scene, SINE)
            p = enclosure.approximate(f, jacobian, here, 20)
            for row in p:
                row[1] += arb(2) ** -20
            fixed = [arb(0, x.upper()) for x in balls.entries(here.spread())[7:]]
            tube = [arb(0, 1e-3)] * 7 + fixed
            step = enclosure.Advance(here, h, list(map(arb_poly, p)), tube)
            return ratios(enclosure.prove(f, jacobian, step, 20, 1.0), motion)

    assert 0.9 < min(found()) <= max(found()) <= 1.0
    halve_the_defect(monkeypatch)
    assert min(found()) > 1.8


@pytest.mark.slow
def test_a_wrong_jacobian_misses_a_motion_of_60_digits(monkeypatch):
    scene, _ = case("general")
    rates = tuple(
        x + 1e-4 * sign
        for x, sign in zip(scene.initial.gamma_dot, (1, -1, 1), strict=True)
    )
    motion = Motion(scene.with_values({"initial.gamma_dot": rates}), SINE)

    def found():
        given = {"ranges": {"initial.gamma_dot": 1e-4}, "t_eval": [0.05]}
        return worst(certify(scene, SINE, 0.05, **given).columns, motion, 0, 0.05)

    assert 0.3 < found() <= 1.0
    matrices, approximate = enclosure._matrices, enclosure.approximate

    def find_with_the_right_one(*given):
        with monkeypatch.context() as patch:
            patch.setattr(enclosure, "_matrices", matrices)
            return approximate(*given)

    monkeypatch.setattr(enclosure, "approximate", find_with_the_right_one)
    monkeypatch.setattr(
        enclosure, "_matrices", lambda *given: [x / 8 for x in matrices(*given)]
    )
    assert found() > 1.0


@pytest.mark.slow
def test_polynomials_are_followed_over_their_pieces():
    scene, _ = case("general")
    c = [[[30.0, 9.0, -20.0], [-4.0, 8.0, 5.0]], [[0.5, -1.0, 2.0], [-1.0, 0.1, 0.0]]]
    begins = [0.0, 0.03, 0.06]
    proven = certify(scene, PolynomialTorque(c, begins), 0.05, t_eval=[0.03, 0.05])
    motion = Motion(scene)
    for piece, time in enumerate((0.03, 0.05)):
        rows = zip(c[0][piece], c[1][piece], strict=True)
        lines, begin = [(mpf(slope), mpf(at)) for slope, at in rows], mpf(begins[piece])
        motion.torque = lambda t: [slope * (t - begin) + at for slope, at in lines]  # noqa: B023
        assert worst(proven.columns, motion, piece, time) < 1.0


def test_a_proof_ends_at_a_limit_where_simulate_stops():
    start = {"gamma": (1.5, 0.8, 0.8), "gamma_dot": (2.0, -0.5, -0.5)}
    scene = load_scene("example2_stroke").with_values({"initial": start})
    proven, found = (
        certify(scene, duration=0.02, t_eval=[0.005, 0.01]),
        simulate(scene, duration=0.02),
    )
    (span,) = proven.limits["beta_2 < 0"]
    assert proven.reason == "beta_2 < 0" and proven.success
    assert proven.until == span[0] and span[1] - span[0] < 1e-11
    assert abs(found.t[-1] - 0.5 * sum(span)) < 1e-9
    assert list(proven.columns["t"]) == [0.005, found.t[-1]]


@pytest.mark.slow
def test_the_end_of_the_stroke_is_enclosed_where_simulate_stops():
    proven, found = (
        certify("example2_stroke", t_eval=[0.5, 0.9]),
        simulate("example2_stroke"),
    )
    (span,) = proven.limits["gamma_1 > 1.570796 rad"]
    assert (
        proven.reason == "gamma_1 > 1.570796 rad"
        and proven.until == span[0]
        and proven.success
    )
    assert span[1] - span[0] < 1e-11
    assert abs(found.t[-1] - 0.5 * sum(span)) < 1e-9


@pytest.mark.slow
def test_limits_that_are_passed_are_enclosed():
    proven = certify("example2", t_eval=[1.0])
    passed = {name: spans for name, spans in proven.limits.items() if spans}
    assert list(passed) == ["gamma_1 > 1.570796 rad", "beta_2 < 0"]
    assert all(
        len(spans) == 1 and spans[0][1] - spans[0][0] < 1e-11
        for spans in passed.values()
    )


def test_a_torque_passes_its_limit_where_the_time_is_enclosed():
    scene = load_scene("example2_heavy").with_values(
        {"actuators": {"torque_limit": 4.5}}
    )
    # of 5 cos(12 t)
    proven, kink = certify(scene, None, 0.05), math.acos(4.5 / 5.0) / 12.0
    ((begin, end),) = proven.limits["torque_2 at its limit"]
    assert proven.success and proven.until == 0.05 and proven.largest < 1e-12
    assert begin - 1e-15 < kink < end + 1e-15 and end - begin < 1e-12


def test_a_proof_ends_after_its_steps():
    proven = certify("example2", max_steps=2, t_eval=[0.01, 1.0])
    assert (
        proven.reason == "2 steps are not enough"
        and proven.steps == 2
        and not proven.success
    )
    assert 0.01 < proven.until < 1.0 and list(proven.columns["t"]) == [0.01]


def test_a_cell_of_a_table_has_the_bound_or_the_reason():
    assert proven_error("example2", lambda t: (0.0, 0.0, 0.0), 0.01).startswith(
        "-: certify: torque"
    )
    assert proven_error("example2", duration=0.01, t_eval=[0.01]).endswith("e-16 rad")
    assert "steps are not enough" in proven_error("example2", max_steps=1)


@pytest.mark.slow
def test_a_range_around_a_rate_of_zero_widens_what_is_proven():
    scene = load_scene("general").with_values(
        {**FREE, "initial.gamma_dot": (0.0, 0.0, 0.0)}
    )
    motion, slow = {"t_eval": [0.0, 0.05]}, {"ranges": {"initial.gamma_dot": 1e-4}}
    wide = certify(scene, SINE, 0.05, **motion, **slow).columns
    for rate in ((1e-4, -1e-4, 1e-4), (-1e-4, -1e-4, 0.0)):
        moving = simulate(
            scene.with_values({"initial.gamma_dot": rate}), SINE, 0.05, **motion
        )
        for leg, found in enumerate(moving.gamma_dot.T, 1):
            name = f"gamma_dot_{leg}"
            assert (abs(found - wide[name]) <= wide[f"{name}_bound"] + 1e-9).all()


@pytest.mark.parametrize("number", [arb(0, 1e-3), 0.5, arb_series([0, 1])])
def test_only_what_is_exactly_zero_hides_a_kink(number):
    unknown = enclosure.cut(arb_series([arb(0, 1), 1], 4))
    assert (unknown * arb(0), arb_series([0]) * unknown, 0.0 * unknown) == (0, 0, 0)
    for product in (unknown * number, number * unknown):
        with pytest.raises(enclosure.Refused, match="kink"):
            product + 1.0


@pytest.mark.slow
def test_elastic_stops_are_passed_and_the_contact_is_enclosed():
    proven, motion = (
        certify("impacts", None, 0.95, t_eval=[0.9, 0.95]),
        simulate("impacts", None, 0.95, t_eval=[0.9, 0.95], tolerance=1e-12),
    )
    first = certify("example2_stroke").limits["gamma_1 > 1.570796 rad"][0]
    contact = proven.limits["contact of gamma_1 at arc"]
    assert proven.success and proven.until == 0.95 and len(contact) == 2
    assert contact[0][0] <= first[1] and first[0] <= contact[0][1]
    assert all(end - begin < 1e-8 for begin, end in contact)
    for leg in range(3):
        off = abs(motion.gamma[:, leg] - proven.columns[f"gamma_{leg + 1}"])
        assert (off <= proven.columns[f"gamma_{leg + 1}_bound"] + 1e-11).all()


def test_held_torques_are_followed_over_their_ticks():
    scene, _ = case("general")
    table = TorqueTable([0.0, 0.03, 0.05], [[1, 0, 0], [0, -1, 0.5], [0.2, 0.1, 0]])
    proven = certify(scene, table, 0.05, t_eval=[0.03, 0.05])
    motion = Motion(scene, (1.0, 0.0, 0.0))
    assert worst(proven.columns, motion, 0, 0.03) < 1.0
    motion.torque = (0.0, -1.0, 0.5)
    assert worst(proven.columns, motion, 1, 0.05) < 1.0


@pytest.mark.slow
@pytest.mark.parametrize(
    "name",
    ["example2_heavy", *(pytest.param(x, marks=pytest.mark.slow) for x in REFERENCES)],
)
def test_the_reference_of_other_tests_lies_inside(name):
    scene = load_scene(name)
    problem = InitialValueProblem(scene)
    truth, times = solve_reference(problem), problem.times
    proven = certify(scene, duration=problem.seconds, bound=1e-12, t_eval=times)
    columns = proven.columns
    assert proven.until == problem.seconds and proven.success
    table = np.transpose([columns[f"quaternion_{part}"] for part in "xyzw"])
    apart = angle_between(truth.states[:, :4].astype(float), table)
    assert (apart <= columns["angle"] + truth.own.orientation + ROUNDING).all()
    gamma, _ = problem.joints(truth.states)
    for leg, found in enumerate(gamma, 1):
        bound = columns[f"gamma_{leg}_bound"] + truth.own.gamma + ROUNDING
        assert (abs(found - columns[f"gamma_{leg}"]) <= bound).all()


def test_torques_at_their_limit_are_clamped_exactly():
    scene = case("general")[0].with_values({"actuators": {"torque_limit": 0.5}})
    beyond, at = TorqueTable([0.0], [[0.5, -9.0, 0.1]]), (0.5, -0.5, 0.1)
    times = {"t_eval": [0.005]}
    clamped, same = (
        certify(scene, beyond, 0.005, **times),
        certify(scene, at, 0.005, **times),
    )
    assert clamped.success and clamped.columns["angle"] == same.columns["angle"]


SHORT = {"duration": 0.05, "t_eval": [0.05]}


def widest_distance(scene, changes):
    """Angle between the motion of a scene and those with other values, by simulate
    [rad].
    """
    at = {**SHORT, "tolerance": 1e-12}
    centre = simulate(scene, **at).quaternion[-1]
    return [
        float(
            angle_between(simulate(scene.with_values(one), **at).quaternion[-1], centre)
        )
        for one in changes
    ]


@pytest.mark.parametrize(
    ("values", "ranges", "changes"),
    slow_after(
        1,
        [
            (
                {},
                {"star.alpha_deg": 0.01},
                [{"star.alpha_deg": (120.01, 119.99, 120.0)}],
            ),
            (
                {"actuators": {"torque_limit": 2.0}},
                {"actuators.torque_limit": 0.01},
                [{"actuators.torque_limit": 1.99}, {"actuators.torque_limit": 2.01}],
            ),
            ({}, {"star.inertia.zz": (0.205, 0.211)}, [{"star.inertia.zz": 0.205}]),
            (
                {},
                {"torque.amplitude[1]": 0.01},
                [{"torque.amplitude": (4.0, 5.01, 3.0)}],
            ),
        ],
    ),
)
def test_ranges_reach_the_motion(values, ranges, changes):
    scene = load_scene("example2").with_values({**FREE, **values})
    proven = certify(scene, ranges=ranges, max_steps=2000, **SHORT)
    apart = widest_distance(scene, changes)
    if proven.reason:  # nothing is said at the time
        assert "too wide" in proven.reason and proven.error == math.inf
    else:
        assert 1e-9 < max(apart) <= proven.error


def about_centre(**values):
    inertia = {"xx": "0.31", "yy": "0.31", "zz": "0.20"}
    star = {"inertia": inertia, "mass": 2.6, "centre": [0.0, 0.01, 0.05], "radius": 0.4}
    star |= {
        "inertia_about": "centre_of_mass",
        "alpha_deg": [120.0, 120.0, 120.0],
        **values,
    }
    return load_scene("example2").with_values({**FREE, "star": star})


def test_a_range_of_what_reading_converts_is_one_of_the_document():
    scene = about_centre()
    proven = certify(scene, ranges={"star.mass": 0.02}, **SHORT)
    at = {**SHORT, "tolerance": 1e-12}
    centre, other = (
        simulate(x, **at).quaternion[-1] for x in (scene, about_centre(mass=2.62))
    )
    assert (
        not proven.reason and 1e-9 < float(angle_between(centre, other)) <= proven.error
    )


def test_digits_are_those_that_are_written():
    def width(text):
        document = scene_balls.WrittenDocument.of(
            load_scene("example2").with_values({"star.inertia.zz": text})
        )
        given = {"star.inertia.zz": "digits"}
        with balls.precision():
            found = scene_balls.range_balls(
                document, given, own_torque=True, origin="certify"
            )
            return float(found["star", "inertia", "zz"].rad())

    assert width("0.20") == pytest.approx(0.005) and width("0.2") == pytest.approx(0.05)
    assert width("2.0e-1") == pytest.approx(0.005)
    with pytest.raises(InputError, match="no written digits"):
        width(0.25)


@pytest.mark.parametrize("number", [8.7e-15, 1.23e-9, 0.3, 7.0, 1e-300, 123456.789])
def test_bounds_are_written_outward(number):
    for digits in (2, 12, 15):
        assert Decimal(balls.write_up(number, digits)) >= Decimal(number)
        assert Decimal(balls.write_down(number, digits)) <= Decimal(number)


@pytest.mark.slow
def test_all_that_is_printed_of_a_motion_is_outward():
    proven = certify("example2", duration=0.1, t_eval=[0.05, 0.1])
    facts = proven._facts()
    assert float(str(facts["orientation"]).split()[1]) >= proven.largest
    assert float(str(facts["error of simulate"]).split()[2]) >= proven.error
    assert float(str(facts["proven"]).split()[1]) <= proven.until


def test_the_length_of_what_may_be_zero_is_a_number():
    with balls.precision():
        for number in (arb(0), arb(0, 1e-30), arb(1e-40, 1e-30)):
            length = balls.norm([number] * 4)
            assert length.is_finite() and length.contains(2 * abs(number).upper())
        turn = certify_module._turn([arb(x) / 3 for x in (1, 2, 3, 4)], [1, 2, 3, 4])
        assert turn.is_finite() and turn.upper() < 1e-30


def test_two_threads_prove_at_once():
    short = {"duration": 0.02, "t_eval": [0.02]}
    alone = certify("example2", **short).columns["angle"]
    with ThreadPoolExecutor(3) as pool:
        found = list(pool.map(lambda _: certify("example2", **short), range(4)))
    assert all(np.array_equal(one.columns["angle"], alone) for one in found)


def test_a_short_series_is_refused():
    with balls.precision(), pytest.raises(enclosure.Refused, match="shorter"):
        enclosure._coefficients(arb_series([1, 2], 3), 5)


def test_an_angle_across_the_cut_is_refused():
    with balls.precision(), pytest.raises(enclosure.Refused, match="jumps"):
        enclosure._atan2(arb_series([arb(0, 0.1), 1], 4), arb_series([-1, 0.5], 4))


def test_damping_by_restitution_is_enclosed():
    with balls.precision():
        damping = scene_balls.damping_ball(arb("0.6"), arb("1.5"))
    with mp.workdps(40):
        e, v = mpf("0.6"), mpf("1.5")
        d = mp.findroot(lambda d: d * (1 + e) - mp.log((1 + d) / (1 - d * e)), 0.5)
        assert abs(mpf(damping.str(35, radius=False)) - d / v) < 1e-30
    assert float(damping.rad()) < 1e-30


@pytest.mark.parametrize(
    ("given", "word"),
    [
        ({"torque": lambda t: (0.0, 0.0, 0.0)}, "torque"),
        ({"bound": 0.0}, "bound"),
        ({"ranges": {"base.radius": 0.1}}, "does not act on the motion"),
        ({"ranges": {"star.inertia.zz": -1.0}}, "must be a half-width >= 0"),
        ({"ranges": {"no.key": 1.0}}, "no"),
        ({"ranges": {"star.inertia.zz": (0.5, 0.4)}}, "an interval"),
        ({"ranges": {"star.inertia.zz": (0.5, 0.6)}}, "must hold the number"),
        ({"ranges": {"duration": 0.1}}, "argument `duration`"),
        ({"ranges": {"actuators.velocity_limit": 0.1}}, "no actuators"),
        ({"split": 2}, "splits ranges"),
    ],
)
def test_what_cannot_be_proven_is_refused(given, word):
    with pytest.raises(InputError, match=word):
        certify("example2", **given)


def test_the_command_prints_what_is_proven(capsys):
    assert main(["certify", "example2", "--duration", "0.05", "--bound", "1e-12"]) == 0
    said = capsys.readouterr().out
    assert (
        "to 0.05 s" in said
        and "no limit is reached and no singularity is passed" in said
    )


@pytest.mark.slow
def test_a_stiff_motion_is_proven_by_short_steps():
    # Its set once widened in each step, by V in all of a long one, until nothing held.
    proven = certify("stiff", duration=0.03, t_eval=[0.03])
    assert not proven.reason and proven.largest < 1e-12
