# SPDX-License-Identifier: Apache-2.0
"""Every load against the geometry it comes from, and all of them against the balance of energy."""

import dataclasses

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from models import FAST, inertia_of, samples, seeded_samples

from sst_ros.dynamics import kernel
from sst_ros.dynamics.model import friction_torque, loads_of_leg, stop_torque
from sst_ros.dynamics.traced_dynamics import Dynamics
from sst_ros.mechanism import virtual_work
from sst_ros.scene.bodies import Inertia, Link, Payload
from sst_ros.scene.loads import (
    Actuators,
    Friction,
    Gravity,
    JointFriction,
    Moment,
    Spring,
    Stroke,
)

STEP = 1e-200


def loaded(sample, number):
    """Give the sample's scene every load; `number` in [0, 1] moves all coefficients."""
    scene = sample.scene
    links = [
        tuple(
            Link(inertia=link.inertia, mass=0.2 + number, centre=(0.02 * k, -0.01, 0.01 + 0.01 * k))
            for k, link in enumerate(group)
        )
        for group in (scene.actuated_links, scene.intermediate_links)
    ]
    rub = Friction(viscous=0.3 + number, coulomb=0.2, static=0.3, stribeck=0.5, smoothing=0.1)
    return dataclasses.replace(
        scene,
        star=dataclasses.replace(scene.star, mass=1.0, centre=(0.02, -0.01, 0.03 * number)),
        actuated_links=links[0],
        intermediate_links=links[1],
        payload=Payload(
            mass=0.5, centre=(0.1, 0.0, 0.3), inertia=Inertia(xx=0.01, yy=0.012, zz=0.015)
        ),
        gravity=Gravity(acceleration=(1.0 - number, 2.0, -9.0)),
        moment=Moment(value=(0.3, -0.2, number)),
        friction=JointFriction(gamma=rub, mu=rub, beta=Friction(viscous=0.1)),
        springs=tuple(
            Spring(joint=f"{kind}_{leg}", stiffness=1.0 + leg + number, rest=0.3 * leg)
            for kind in ("gamma", "mu", "beta")
            for leg in (1, 2, 3)
        ),
        actuators=Actuators(rotor_inertia=1e-4, gear_ratio=20.0),
        # Ends inside the motion: pressed at one of them in most states.
        stroke=Stroke(at_end="elastic", stiffness=50.0, damping=0.2),
    )


@FAST
@given(samples(), st.floats(0.0, 1.0))
def test_energy_changes_by_the_power_put_in(sample, number):
    # The forces are linear in what the energy and power functions say, so a wrong sign or factor
    # of any term breaks this for a random velocity.
    model = kernel.model_of(loaded(sample, number))
    state, torque = sample.state, tuple(sample.torque)
    rate = kernel.derivative(model, state, torque)
    moved = [complex(x, STEP * dx) for x, dx in zip(state, rate, strict=True)]
    change = (
        np.imag(kernel.kinetic_energy(model, moved) + kernel.potential_energy(model, moved)) / STEP
    )
    power = kernel.power(model, state, torque)
    scale = sum(abs(p) for p in (*np.multiply(rate[4:], 1.0), power, 1.0))
    assert change == pytest.approx(power, rel=1e-12, abs=1e-12 * scale)


@FAST
@given(samples())
def test_potential_energy_is_the_height_of_the_centres_of_mass(sample):
    scene = dataclasses.replace(loaded(sample, 0.5), springs=(), stroke=Stroke(at_end="ignore"))
    first, second = virtual_work.link_frames(sample.posture)
    field = np.array(scene.gravity.acceleration)
    expected = 0.0
    for frame, links in ((first, scene.actuated_links), (second, scene.intermediate_links)):
        for k, link in enumerate(links):
            expected -= link.mass * field @ (frame[k] @ link.centre)
    for body in (scene.star, scene.payload):
        expected -= body.mass * field @ (sample.rotation @ body.centre)
    found = kernel.potential_energy(kernel.model_of(scene), sample.state)
    assert found == pytest.approx(expected, rel=1e-13, abs=1e-13)


def only(sample, **terms):
    return dataclasses.replace(sample.scene, **terms)


def extra_torque(sample, **terms):
    """Torque at the actuators that has the effect of the terms, by the paper's Eq. 90."""
    model = kernel.model_of(only(sample, **terms))
    at = sample.posture
    rate = np.array(
        kernel.body_acceleration(model, sample.quaternion, sample.body_rate, (0.0,) * 3)
    )
    bias = virtual_work.bias(at, sample.gamma_dot)
    gamma_ddot = np.linalg.solve(at.j, sample.rotation @ rate - bias.omega_dot)
    return virtual_work.inverse_dynamics(sample.mechanism, at, sample.gamma_dot, gamma_ddot)


@pytest.mark.parametrize("sample", seeded_samples(4, 4))
def test_coulomb_friction_turns_into_the_full_torque(sample):
    friction = JointFriction(gamma=Friction(coulomb=0.4, smoothing=1e-9))
    expected = -0.4 * np.sign(sample.gamma_dot)
    assert extra_torque(sample, friction=friction) == pytest.approx(expected, rel=1e-11)


@pytest.mark.parametrize("sample", seeded_samples(6, 4))
def test_a_constant_moment_works_through_j(sample):
    moment = Moment(value=(0.3, -0.5, 0.7))
    expected = sample.posture.j.T @ moment.value
    assert extra_torque(sample, moment=moment) == pytest.approx(expected, rel=1e-10, abs=1e-12)


def test_rotor_and_gear_are_an_inertia_of_the_actuated_link():
    sample = seeded_samples(7, 1)[0]
    with_rotor = only(sample, actuators=Actuators(rotor_inertia=2e-5, gear_ratio=50.0))
    heavier = tuple(
        Link(inertia=dataclasses.replace(link.inertia, xx=1.0, yy=1.0, zz=link.inertia.zz + 0.05))
        for link in sample.scene.actuated_links
    )
    expected = Dynamics.of(only(sample, actuated_links=heavier)).derivative
    found = Dynamics.of(with_rotor).derivative
    inputs = (*sample.state, *sample.torque)
    assert found(*inputs) == pytest.approx(expected(*inputs), rel=1e-13)


def test_a_payload_is_an_inertia_of_the_star_by_parallel_axes():
    sample = seeded_samples(8, 1)[0]
    own = Inertia(xx=0.01, yy=0.02, zz=0.025, xy=0.001)
    carried = only(sample, payload=Payload(mass=0.5, centre=(0.1, 0.2, 0.3), inertia=own))
    x, y, z = 0.1, 0.2, 0.3
    steiner = 0.5 * np.array(
        [
            [y * y + z * z, -x * y, -x * z],
            [-x * y, x * x + z * z, -y * z],
            [-x * z, -y * z, x * x + y * y],
        ]
    )
    total = sample.scene.star.inertia.matrix + own.matrix + steiner
    star = dataclasses.replace(sample.scene.star, inertia=inertia_of(total))
    inputs = (*sample.state, *sample.torque)
    found = Dynamics.of(carried).derivative(*inputs)
    assert found == pytest.approx(
        Dynamics.of(only(sample, star=star)).derivative(*inputs), rel=1e-13
    )


def test_elastic_stops_push_only_beyond_the_stroke_and_never_pull():
    sample = seeded_samples(9, 1)[0]
    scene = only(sample, stroke=Stroke(at_end="elastic", stiffness=100.0, damping=5.0))
    stops = loads_of_leg(scene, sample.geometry, 0).stops
    assert stop_torque(stops, 0.5 * stops.arc, 1.0) == 0.0
    assert stop_torque(stops, -0.01, 0.0) == pytest.approx(1.0)
    assert stop_torque(stops, stops.arc + 0.01, 0.0) == pytest.approx(-1.0)
    assert stop_torque(stops, -0.01, -0.1) == pytest.approx(1.5)
    assert stop_torque(stops, -0.01, 10.0) == 0.0


@pytest.mark.parametrize("v", [-2.0, -0.05, 0.0, 0.003, 0.4])
def test_friction_is_the_documented_torque_of_its_rate(v):
    friction = Friction(viscous=0.3, coulomb=0.2, static=0.5, stribeck=0.1, smoothing=0.01)
    fading = 0.2 + 0.3 * np.exp(-((v / 0.1) ** 2))
    expected = 0.3 * v + fading * np.tanh(v / 0.01)
    assert friction_torque(friction, v) == pytest.approx(expected, rel=1e-14)
    assert friction_torque(friction, -v) == -friction_torque(friction, v)
    assert friction_torque(friction, v) * v >= 0.0


def test_springs_at_one_joint_add_up():
    sample = seeded_samples(13, 1)[0]
    two = [Spring(joint="mu_1", stiffness=k, rest=r) for k, r in ((2.0, 0.5), (3.0, -0.2))]
    together = extra_torque(sample, springs=tuple(two))
    alone = [extra_torque(sample, springs=(spring,)) for spring in two]
    assert together == pytest.approx(sum(alone), rel=1e-10)


def test_lagging_actuators_follow_the_command_with_their_time_constant():
    scene = only(seeded_samples(10, 1)[0], actuators=Actuators(time_constant=0.05))
    sample = seeded_samples(10, 1)[0]
    dynamics = Dynamics.of(scene)
    has, asked = (0.1, 0.2, 0.3), (1.0, -1.0, 0.5)
    found = dynamics.derivative(*sample.state, *has, *asked)
    assert found[7:] == pytest.approx([18.0, -24.0, 4.0], rel=1e-14)
    assert found[:7] == Dynamics.of(sample.scene).derivative(*sample.state, *has)
