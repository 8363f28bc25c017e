# SPDX-License-Identifier: Apache-2.0
"""Impacts and rest at rigid ends of the stroke, against momentum and the paper's T1."""

import dataclasses
import itertools

import numpy as np
import pytest
from models import seeded_samples

from sst_ros import Simulation, load_scene
from sst_ros.control.torque_profiles import sine
from sst_ros.dynamics.contacts import RigidEnds
from sst_ros.dynamics.traced_dynamics import Dynamics
from sst_ros.errors import ImpactsAccumulate
from sst_ros.integration import propagator
from sst_ros.mechanism import kinematics, virtual_work
from sst_ros.mechanism.frames import rotation_matrix
from sst_ros.scene.loads import Friction, Initial, JointFriction, Stroke, Workspace

MILLISECOND = 1_000_000


def actuator_rates(sample, body_rate):
    return np.linalg.solve(sample.posture.j, sample.rotation @ np.array(body_rate))


@pytest.mark.parametrize("sample", seeded_samples(11, 4))
@pytest.mark.parametrize("restitution", [0.0, 0.6, 1.0])
def test_an_impact_keeps_the_momenta_of_the_other_actuators(sample, restitution):
    ends = RigidEnds(Dynamics.of(sample.scene))
    after = actuator_rates(sample, ends.after_impact(sample.state, 1, restitution)[4:])
    before = sample.gamma_dot
    mass = -virtual_work.equation_of_motion(sample.mechanism, sample.posture, before)[0]
    momentum = mass @ (after - before)
    assert after[1] == pytest.approx(-restitution * before[1], rel=1e-11, abs=1e-13)
    assert np.abs(momentum[[0, 2]]).max() <= 1e-12 * np.abs(mass @ before).max()
    energy = (before @ mass @ before, after @ mass @ after)
    if restitution == 1.0:
        assert energy[1] == pytest.approx(energy[0], rel=1e-12)
    else:
        assert energy[1] < energy[0]


@pytest.mark.parametrize("sample", seeded_samples(12, 4))
def test_held_actuators_do_not_accelerate_and_others_feel_only_the_coupling(sample):
    dynamics = Dynamics.of(sample.scene)
    still = dataclasses.replace(sample, gamma_dot=np.array([0.0, sample.gamma_dot[1], 0.0]))
    torque = tuple(sample.torque.tolist())
    slope = dynamics.derivative(*still.state, *torque)
    held, push = RigidEnds(dynamics).held(still.state, slope, [0, 2])
    at = still.posture
    bias = virtual_work.bias(at, still.gamma_dot)
    gamma_ddot = np.linalg.solve(at.j, still.rotation @ np.array(held[4:]) - bias.omega_dot)
    expected = virtual_work.inverse_dynamics(still.mechanism, at, still.gamma_dot, gamma_ddot)
    scale = np.abs(sample.torque).max() + np.abs(push).max()
    assert np.abs(gamma_ddot[[0, 2]]).max() <= 1e-11 * np.abs(gamma_ddot).max()
    assert expected - np.array(torque) == pytest.approx([push[0], 0.0, push[1]], abs=1e-11 * scale)


ALL_SIGNS = list(itertools.product((1.0, -1.0), repeat=3))


def complementary(impulse, motion, inward):
    """Ends push or their actuators leave: never both, never neither, never the other way."""
    for leg, sign in inward.items():
        pushes, leaves = sign * impulse[leg], sign * motion[leg]
        assert min(pushes, leaves) > -1e-11
        assert min(abs(pushes), abs(leaves)) < 1e-11


@pytest.mark.parametrize("signs", ALL_SIGNS)
@pytest.mark.parametrize("sample", seeded_samples(13, 4))
def test_ends_hold_what_they_push_and_leave_what_they_would_pull(sample, signs):
    dynamics = Dynamics.of(sample.scene)
    ends, inward = RigidEnds(dynamics), dict(enumerate(signs))
    still = dataclasses.replace(sample, gamma_dot=np.zeros(3))
    torque = tuple(sample.torque.tolist())
    slope = dynamics.derivative(*still.state, *torque)
    legs = ends.holding(still.state, slope, inward)
    held = ends.held(still.state, slope, legs)[0] if legs else slope
    at = still.posture
    gamma_ddot = np.linalg.solve(at.j, still.rotation @ np.array(held[4:]))
    needed = virtual_work.inverse_dynamics(still.mechanism, at, np.zeros(3), gamma_ddot)
    complementary(needed - np.array(torque), gamma_ddot, inward)


@pytest.mark.parametrize("signs", ALL_SIGNS)
@pytest.mark.parametrize("sample", seeded_samples(14, 4))
def test_an_impact_presses_on_what_rests_or_tears_it_off(sample, signs):
    """The actuator of leg 0 comes to its end; the others rest against theirs."""
    ends, inward = RigidEnds(Dynamics.of(sample.scene)), dict(enumerate(signs))
    coming = dataclasses.replace(sample, gamma_dot=np.array([-signs[0], 0.0, 0.0]))
    legs = ends.kicked(coming.state, 0, inward)
    assert legs[0] == 0
    after = actuator_rates(sample, ends.after_impact(coming.state, 0, 0.0, legs[1:])[4:])
    mass = -virtual_work.equation_of_motion(sample.mechanism, sample.posture, after)[0]
    complementary(mass @ (after - coming.gamma_dot), after, inward)


@pytest.mark.parametrize("sample", seeded_samples(15, 4))
def test_what_has_drifted_off_its_end_is_put_back(sample):
    ends = RigidEnds(Dynamics.of(sample.scene))
    wanted = {0: sample.gamma[0] + 1e-6, 2: sample.gamma[2] - 1e-6}
    state = ends.with_rates(ends.with_angles(sample.state, wanted), {1: 0.5})
    rotation = rotation_matrix(np.array(state[:4]))
    gamma = kinematics.inverse(sample.geometry, rotation)[0]
    assert gamma[[0, 2]] == pytest.approx(list(wanted.values()), abs=1e-15)
    assert abs(gamma[1] - sample.gamma[1]) < 1e-5
    at = virtual_work.posture(sample.geometry, gamma, rotation)
    rate = np.linalg.solve(at.j, rotation @ np.array(state[4:]))
    assert rate[1] == pytest.approx(0.5, abs=1e-13)


def near_the_end(**stroke):
    """Actuator 1 just before its upper end, in joints that rub."""
    return dataclasses.replace(
        load_scene("impacts"),
        initial=Initial(gamma=(1.55, 0.66, 0.93)),
        friction=JointFriction(gamma=Friction(viscous=2.0)),
        stroke=Stroke(at_end="impact", **stroke),
        workspace=Workspace(at_edge="ignore"),
    )


def test_the_run_bounces_and_is_the_same_for_any_step():
    scene = load_scene("impacts")
    ends = []
    for step in (MILLISECOND, 250_000):
        simulation, torque = Simulation(scene, "dop853"), sine(scene.torque)
        for _ in range(1_000_000_000 // step):
            simulation.step(torque, step)
            assert min(simulation.geometry.arc - simulation.state.joints.gamma) > -1e-12
        ends.append(simulation.state)
    assert ends[0].joints.gamma == pytest.approx(ends[1].joints.gamma, abs=1e-11)
    assert ends[0].body_rate == pytest.approx(ends[1].body_rate, abs=1e-10)


def test_pressed_against_an_end_it_rests_there_and_leaves_when_pulled():
    scene = near_the_end(restitution=0.5)
    simulation = Simulation(scene)
    arc = float(simulation.geometry.arc[0])
    for _ in range(400):
        simulation.step((3.0, 0.0, 0.0), MILLISECOND)
        assert simulation.state.joints.gamma[0] <= arc + 1e-11
    assert simulation.state.joints.gamma[0] == pytest.approx(arc, abs=1e-10)
    assert simulation.state.joints.gamma_dot[0] == pytest.approx(0.0, abs=1e-10)
    for _ in range(50):
        simulation.step((-3.0, 0.0, 0.0), MILLISECOND)
    assert simulation.state.joints.gamma[0] < arc - 1e-4
    assert simulation.state.joints.gamma_dot[0] < -1e-3


def test_impacts_without_end_are_refused_with_the_last_valid_state(monkeypatch):
    monkeypatch.setattr(propagator, "_IMPACTS_PER_PERIOD", 50)
    simulation = Simulation(near_the_end(restitution=0.9))
    before = simulation.state
    with pytest.raises(ImpactsAccumulate, match="gamma_1"):
        simulation.step((100.0, 0.0, 0.0), 400 * MILLISECOND)
    assert simulation.state is before
    monkeypatch.undo()
    for _ in range(10):
        simulation.step((100.0, 0.0, 0.0), 30 * MILLISECOND)
    assert simulation.state.joints.gamma_dot[0] == pytest.approx(0.0, abs=1e-9)
