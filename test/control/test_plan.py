# SPDX-License-Identifier: Apache-2.0
"""What a motion asks for, against closed forms, and the speed it can be had at."""

from __future__ import annotations

import json
import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from models import FAST, folding_star
from scipy.integrate import quad
from scipy.optimize import minimize_scalar
from scipy.spatial.transform import Rotation
from symmetric_motion import inertia, inertia_slope

from sst_ros import __main__ as cli
from sst_ros.control.plan import (
    check_motion,
    examine_motion,
    examine_reactions,
    maximum,
    time_scaling,
)
from sst_ros.control.reference_motions import geodesic_motion, reference_motion
from sst_ros.errors import MotionRefused, SingularConfiguration
from sst_ros.mechanism import kinematics
from sst_ros.mechanism.geometry import Geometry, quaternion_of
from sst_ros.scene.bodies import Stroke, Workspace
from sst_ros.scene.loads import (
    Actuators,
    DesiredMotion,
    Friction,
    Initial,
    JointFriction,
    Spiral,
    Spring,
    Sweep,
    ToAngles,
    ToOrientation,
)
from sst_ros.scene.scene import load, text_of
from sst_ros.scene.torque_profile import TorqueTable
from sst_ros.simulation.simulation import Simulation

HOME = (math.pi / 4,) * 3
EXAMPLE1 = replace(load("example1"), initial=Initial(gamma=HOME))
WAY, TIME = 0.3, 0.5
FREE = {"stroke": Stroke(at_end="ignore"), "workspace": Workspace(at_edge="ignore")}


def planned(scene, check=examine_motion):
    return check(reference_motion(scene), scene)


def swing(**limits):
    """Example 1's one degree of freedom: all gamma go WAY on together."""
    goal = ToAngles(gamma=tuple(angle + WAY for angle in HOME), duration=TIME)
    actuators = Actuators(**limits) if limits else None
    return replace(EXAMPLE1, motion=DesiredMotion(to_angles=goal), actuators=actuators)


def swing_torque(time):
    """Of each actuator, from the inertia M1(x) of the coordinate x = gamma - pi/4."""
    law = WAY * np.polynomial.Polynomial([0, 0, 0, 10, -15, 6])
    u = time / TIME
    x, rate, acceleration = law(u), law.deriv()(u) / TIME, law.deriv(2)(u) / TIME**2
    return inertia(EXAMPLE1, x) * acceleration + 0.5 * inertia_slope(
        EXAMPLE1, x
    ) * rate**2, rate


def summit(function, count=400):
    """Largest size of a function of time over the swing: a fine grid, then a search."""
    times = np.linspace(0.0, TIME, count)
    top = int(np.argmax([abs(function(time)) for time in times]))
    bounds = times[max(top - 1, 0)], times[min(top + 1, count - 1)]
    found = minimize_scalar(
        lambda time: -abs(function(time)),
        bounds=bounds,
        method="bounded",
        options={"xatol": 1e-12},
    )
    return function(found.x), found.x


SUMMIT, _ = summit(lambda time: swing_torque(time)[0])
VELOCITY, ACCELERATION = 15.0 / 8.0 * WAY / TIME, 10.0 / math.sqrt(3.0) * WAY / TIME**2
"""Peaks of minimum jerk."""


def test_demands_of_one_degree_of_freedom_are_its_closed_form():
    square = quad(lambda time: swing_torque(time)[0] ** 2, 0.0, TIME, epsabs=1e-14)[0]
    root = 0.5 - math.sqrt(3.0) / 6.0
    plan = planned(swing())
    between = plan.trajectory.at(0.123)
    assert between.gamma[0] == pytest.approx(plan.motion.at(0.123).gamma, abs=1e-14)
    assert between.torque[0] == pytest.approx(swing_torque(0.123)[0], rel=1e-12)
    for leg in range(3):
        peaks = {name: found[leg] for name, found in plan.peaks.items()}
        for found, function in (
            (peaks["torque"], lambda time: swing_torque(time)[0]),
            (peaks["power"], lambda time: math.prod(swing_torque(time))),
        ):
            value, time = summit(function)
            assert found.value == pytest.approx(value, rel=1e-12)
            assert found.time == pytest.approx(time, abs=1e-6)
        assert plan.torque_rms[leg] == pytest.approx(math.sqrt(square / TIME), rel=1e-6)
        assert peaks["velocity"].value == pytest.approx(VELOCITY, rel=1e-14)
        assert abs(peaks["acceleration"].value) == pytest.approx(
            ACCELERATION, rel=1e-14
        )
        at = {round(share * TIME, 6) for share in (root, 1.0 - root)}
        assert round(peaks["acceleration"].time, 6) in at


@pytest.mark.slow
@FAST
@given(st.floats(0.0, 6.3), st.floats(0.5, 12.0), st.integers(40, 90))
def test_extremes_between_samples_are_found(phase, frequency, count):
    """Two sines of up to two periods, some 20 samples each at least.

    The truth from 20001.
    """

    def function(time):
        return math.sin(frequency * time + phase) + 0.5 * math.sin(
            2.3 * frequency * time
        )

    times, fine = np.linspace(0.0, 1.0, count), np.linspace(0.0, 1.0, 20_001)
    values = np.array([function(time) for time in times.tolist()])
    truth = np.array([function(time) for time in fine.tolist()])
    # A parabola through the best of the fine samples is lower than the truth by 1e-6 at
    # most.
    assert maximum(function, times, values).value == pytest.approx(
        truth.max(), abs=2e-6
    )
    low = maximum(lambda time: -function(time), times, -values)
    assert -low.value == pytest.approx(truth.min(), abs=2e-6)
    assert maximum(function, times, values).value >= truth.max() - 1e-12


@pytest.mark.parametrize(
    ("limits", "highest", "binding"),
    [
        ({"torque_limit": 2.0}, math.sqrt(2.0 / abs(SUMMIT)), "torque"),
        ({"velocity_limit": 3.0}, 3.0 / VELOCITY, "velocity"),
        (
            {"velocity_limit": 3.0, "acceleration_limit": 9.0},
            math.sqrt(9.0 / ACCELERATION),
            "acceleration",
        ),
        ({}, math.inf, ""),
    ],
)
def test_the_speed_of_pure_inertia_is_a_quotient_or_a_root(limits, highest, binding):
    found = time_scaling(planned(swing(**limits)))
    assert found.highest == pytest.approx(highest, rel=1e-12)
    assert (found.lowest, found.binding) == (0.0, binding)


def rubbing(duration, limit):
    """A turn under gravity with friction: torques that follow no power of the speed."""
    rub = JointFriction(
        gamma=Friction(viscous=0.3, coulomb=0.2), beta=Friction(coulomb=0.1)
    )
    turn = Rotation.from_quat(
        quaternion_of(kinematics.admissible(Geometry.of(EXAMPLE1), HOME).rotation)
    )
    goal = (turn * Rotation.from_rotvec([0.2, -0.1, 0.3])).as_quat()
    motion = ToOrientation(orientation=tuple(goal.tolist()), duration=duration)
    return replace(
        load("gravity_payload"),
        springs=(),
        friction=rub,
        initial=Initial(gamma=HOME),
        actuators=Actuators(torque_limit=limit),
        motion=DesiredMotion(to_orientation=motion),
    )


def test_the_highest_speed_is_where_the_check_turns():
    """The motion itself is squeezed in time, not the torques of the planned one."""
    limit = 9.0
    found = time_scaling(planned(rubbing(1.0, limit)))
    assert found.lowest == 0.0 and 1.5 < found.highest < 10.0
    for factor, fits in ((1.0 - 1e-9, True), (1.0 + 1e-9, False)):
        scene = rubbing(1.0 / (factor * found.highest), limit)
        assert (not planned(scene).problems) == fits


def test_a_weight_beyond_the_limit_is_infeasible_at_any_speed():
    plan = planned(rubbing(1.0, 0.5))
    assert {problem.key for problem in plan.problems} <= {
        f"torque_{leg}" for leg in (1, 2, 3)
    }
    assert plan.problems and time_scaling(plan).highest is None


def resonant(factor=1.0):
    """A sweep against springs: near their resonance it takes little, slower and faster
    it does.
    """
    springs = tuple(
        Spring(joint=f"gamma_{k}", stiffness=20.0, rest=HOME[0]) for k in (1, 2, 3)
    )
    own = factor * math.sqrt(20.0 / inertia(EXAMPLE1, 0.0))
    motion = Sweep(
        amplitude=(0.1,) * 3, frequency=(own,) * 3, fade=20.0 / own, duration=60.0 / own
    )
    motion, actuators = DesiredMotion(sweep=motion), Actuators(torque_limit=1.2)
    return replace(EXAMPLE1, springs=springs, actuators=actuators, motion=motion)


@pytest.mark.slow
def test_a_range_of_speeds_has_two_ends_where_slow_is_infeasible():
    """At rest the springs ask for 20 * 0.1 = 2 N m at the turning points.

    1.2 are there.
    """
    found = time_scaling(planned(resonant()))
    assert found.highest is not None and 0.3 < found.lowest < 1.0 < found.highest
    for end, inside in ((found.lowest, 1.0 + 1e-6), (found.highest, 1.0 - 1e-6)):
        assert not planned(resonant(end * inside)).problems
        assert planned(resonant(end / inside)).problems


def test_leaving_the_stroke_is_refused_unless_it_is_ignored():
    away = DesiredMotion(to_angles=ToAngles(gamma=(1.7, 0.9, 0.9), duration=1.0))
    scene = replace(EXAMPLE1, motion=away, workspace=FREE["workspace"])
    with pytest.raises(
        MotionRefused, match=r"gamma_1 = 1\.7.*must stay below 1\.57079633 rad"
    ):
        planned(scene, check_motion)
    elastic = replace(scene, stroke=Stroke(at_end="elastic", stiffness=1e3))
    assert planned(elastic).problems
    assert not planned(replace(scene, **FREE), check_motion).problems


def test_leaving_the_workspace_is_refused_where_farthest_out():
    out = DesiredMotion(spiral=Spiral(phi=1.0, theta=0.3, duration=1.0))
    scene = replace(EXAMPLE1, motion=out)
    plan = planned(scene)
    told = {problem.key: problem.value for problem in plan.problems}
    assert any(key.startswith("beta") for key in told)
    motion, geometry = plan.motion, Geometry.of(scene)
    times = np.linspace(0.0, 1.0, 2001)
    turned = Rotation.from_quat([motion.at(time).quaternion for time in times.tolist()])
    beta = kinematics.inverse(geometry, turned.as_matrix())[2]
    for distance in plan.distances:
        if distance.key.startswith("beta"):
            mine = distance.sign * (beta[:, int(distance.key[-1]) - 1] - distance.end)
            assert distance.least == pytest.approx(mine.min(), abs=1e-6)
            assert distance.least <= mine.min() + 1e-12


def test_limits_hold_between_samples_and_name_the_instant():
    limit = abs(SUMMIT)
    assert not planned(swing(torque_limit=limit * (1.0 + 1e-12)), check_motion).problems
    with pytest.raises(MotionRefused) as told:
        planned(swing(torque_limit=limit * (1.0 - 1e-9)), check_motion)
    assert [problem.key for problem in told.value.problems] == [
        "torque_1",
        "torque_2",
        "torque_3",
    ]
    fast = planned(swing(velocity_limit=1.1, acceleration_limit=6.9))
    keys = {problem.key.partition("_")[0] for problem in fast.problems}
    assert keys == {"velocity", "acceleration"}


def test_a_turn_through_a_parallel_singularity_is_refused():
    scene, poses = folding_star()
    ends = (
        Rotation.from_rotvec([0.0, 0.0, angle]).as_matrix() for angle in (-0.1, 0.123)
    )
    first, last = (tuple(quaternion_of(poses[1] @ end).tolist()) for end in ends)
    motion = geodesic_motion(Geometry.of(scene), first, last, 1.0)
    with pytest.raises(
        SingularConfiguration, match=r"parallel singularity at t = 0\.\d+ s"
    ) as told:
        check_motion(motion, replace(scene, **FREE))
    assert abs(told.value.measure) < 1e-9


def test_a_turn_past_a_serial_singularity_is_refused_or_far_out():
    """Through t_1 = w_1: the arc of the star folds over the base's."""
    first, last = (
        tuple(Rotation.from_euler("yx", [0.5, 0.5 * math.pi + off]).as_quat().tolist())
        for off in (-0.2, 0.2)
    )
    with pytest.raises(SingularConfiguration, match="serial singularity"):
        motion = geodesic_motion(Geometry.of(EXAMPLE1), first, last, 1.0)
        check_motion(motion, replace(EXAMPLE1, **FREE))


@pytest.mark.parametrize("name", ["point_to_point", "spiral"])
def test_shipped_motions_are_feasible_and_end_where_they_should(name):
    scene = load(name)
    plan = planned(scene, check_motion)
    assert scene.duration == plan.motion.duration
    assert time_scaling(plan).highest > 1.0
    assert (
        min(distance.least for distance in plan.distances if distance.sign > 0.0) > 0.1
    )


def test_the_command_tells_verdict_and_status(capsys, tmp_path):
    assert cli.main(["plan", "check", "point_to_point"]) == 0
    said = capsys.readouterr().out
    assert "\nfeasible\nHighest speed 1." in said and "torque limit is met" in said
    fast = tmp_path / "fast.yaml"
    source, _ = text_of("point_to_point")
    fast.write_text(source.replace("duration: 1}", "duration: 0.5}"), encoding="utf-8")
    assert cli.main(["plan", "check", str(fast)]) == 1
    said = capsys.readouterr().out
    assert "not feasible" in said and "refused: torque_1 = " in said
    assert cli.main(["plan", "check", "example1"]) == 1
    assert "no desired motion" in capsys.readouterr().err
    assert cli.main(["plan", "check", "spiral", "--csv", "x.csv", "--period", "0"]) == 1
    assert "--period = 0.0" in capsys.readouterr().err


@pytest.mark.slow
def test_json_says_what_the_table_says(capsys):
    assert cli.main(["plan", "check", "point_to_point", "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    plan = planned(load("point_to_point"))
    assert told["feasible"] is True and told["problems"] == []
    assert told["highest_speed"] == time_scaling(plan).highest
    for leg, found in zip(range(3), told["actuators"], strict=True):
        peak = plan.peaks["torque"][leg]
        assert found["torque"] == {"value": peak.value, "time": peak.time}
        assert found["torque_rms"] == plan.torque_rms[leg]
    assert len(told["distances"]) == len(plan.distances) == 16
    torque = examine_reactions(plan)["actuated"]["axis_torque"]
    assert told["reactions"]["actuated"]["axis_torque"]["rms"] == torque.rms.tolist()


def test_written_torques_do_the_motion(tmp_path):
    """Held torques of the middles err with the square of the period: 16 times less at a
    quarter.
    """
    scene, errors = load("point_to_point"), []
    goal = reference_motion(scene).at(1.0).gamma
    for period_ns in (8_000_000, 2_000_000):
        path = tmp_path / f"{period_ns}.csv"
        words = ["--csv", str(path), "--period", f"{period_ns}e-9"]
        assert cli.main(["plan", "check", "point_to_point", *words]) == 0
        profile = TorqueTable.read(path)
        last = profile.times[-1]
        assert last == pytest.approx(1.0, abs=1e-12)
        simulation = Simulation(scene)
        for k in range(1_000_000_000 // period_ns):
            simulation.step(profile((k + 0.5) * period_ns * 1e-9), period_ns)
        errors.append(np.abs(np.subtract(simulation.state.joints.gamma, goal)).max())
    assert errors[1] < 1e-5
    assert errors[0] / errors[1] == pytest.approx(16.0, rel=0.05)


@pytest.mark.slow
def test_peaks_of_reactions_are_those_of_a_fine_sampling():
    scene = load("reach")
    plan = examine_motion(reference_motion(scene), scene)
    found, t = examine_reactions(plan), plan.trajectory.t
    fine = plan.trajectory.at(np.linspace(t[0], t[-1], 20_001)).reactions
    for name, loads in fine.joints():
        for size, one in found[name].items():
            dense = np.abs(getattr(loads, size))
            assert one.peak == pytest.approx(dense.max(axis=0), rel=2e-5)
            rms = np.sqrt(np.mean(dense[1:] ** 2, axis=0))
            assert one.rms == pytest.approx(rms, rel=1e-4)
    bare = scene.with_values({"friction": None})
    plan = examine_motion(reference_motion(bare), bare)
    motors = examine_reactions(plan)["actuated"]["axis_torque"]
    peaks = plan.peaks["torque"]
    assert motors.peak == pytest.approx([abs(peak.value) for peak in peaks], rel=2e-5)
    assert motors.time == pytest.approx([peak.time for peak in peaks], abs=1e-3)
    assert motors.rms == pytest.approx(plan.torque_rms, rel=1e-4)
