# SPDX-License-Identifier: Apache-2.0
"""Every load against a truth of its own: geometry, Lagrange with potentials, energy."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from lagrange import Lagrange, exact
from lagrange import friction_torque as documented_torque
from models import FAST, inertia_of, samples, seeded_samples
from mpmath import mpf

from sst_ros import Simulation, load_scene
from sst_ros.dynamics import kernel
from sst_ros.dynamics.kernel import friction_torque, stop_torque
from sst_ros.dynamics.model import model_of
from sst_ros.dynamics.traced_dynamics import Dynamics
from sst_ros.scene.bodies import Inertia, Link, Payload, Stroke
from sst_ros.scene.loads import (
    Actuators,
    Friction,
    Gravity,
    JointFriction,
    Moment,
    Spring,
)

STEP = 1e-200
REST = (0.0, 0.0, 0.0)
EXAMPLE2 = load_scene("example2_heavy")


def loaded(sample, number):
    """Give the sample's scene every load; `number` in [0, 1] moves all coefficients."""
    scene = sample.scene
    links = [
        tuple(
            Link(
                inertia=link.inertia,
                mass=0.2 + number,
                centre=(0.02 * k, -0.01, 0.01 + 0.01 * k),
            )
            for k, link in enumerate(group)
        )
        for group in (scene.actuated_links, scene.intermediate_links)
    ]
    rub = Friction(
        viscous=0.3 + number, coulomb=0.2, static=0.3, stribeck=0.5, smoothing=0.1
    )
    return replace(
        scene,
        star=replace(scene.star, mass=1.0, centre=(0.02, -0.01, 0.03 * number)),
        actuated_links=links[0],
        intermediate_links=links[1],
        payload=Payload(
            mass=0.5,
            centre=(0.1, 0.0, 0.3),
            inertia=Inertia(xx=0.01, yy=0.012, zz=0.015),
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
    # The forces are linear in what the energy and power functions say, so a wrong sign
    # or factor of any term breaks this for a random velocity.
    model = kernel.model_of(loaded(sample, number))
    state, torque = sample.state, tuple(sample.torque)
    rate = kernel.derivative(model, state, torque)
    moved = [complex(x, STEP * dx) for x, dx in zip(state, rate, strict=True)]
    change = (
        np.imag(
            kernel.kinetic_energy(model, moved) + kernel.potential_energy(model, moved)
        )
        / STEP
    )
    power = kernel.power(model, state, torque)
    scale = sum(abs(p) for p in (*np.multiply(rate[4:], 1.0), power, 1.0))
    assert change == pytest.approx(power, rel=1e-12, abs=1e-12 * scale)


def laden(sample):
    """What `Lagrange.loads` knows: weight, springs and friction, of payload and rotors
    too.
    """
    return replace(loaded(sample, 0.5), moment=None, stroke=Stroke(at_end="ignore"))


@pytest.mark.parametrize("sample", seeded_samples(71, 3), ids=range(3))
def test_gravity_springs_and_friction_are_lagranges(sample):
    """Both lose some two digits of 1e-16 to M and J.

    The loads are of the size of the torques.
    """
    scene = laden(sample)
    truth = Lagrange(scene, sample.rotation)
    height = float(truth.potential(exact(sample.gamma)))
    potential = kernel.potential_energy(kernel.model_of(scene), sample.state)
    assert potential == pytest.approx(height, rel=1e-13, abs=1e-13)
    loads = truth.loads(sample.gamma, sample.gamma_dot)
    expected = truth.acceleration(sample.gamma, sample.gamma_dot, sample.torque + loads)
    slope = Dynamics.of(scene).derivative(*sample.state, *sample.torque.tolist())
    found = sample.gamma_ddot_of(slope[4:])
    assert np.abs(loads).max() > 1.0
    assert np.abs(found - expected).max() <= 1e-11 * np.abs(expected).max()


def springs(scene):
    """Springs at one joint are one, with the mean of their angles of rest."""
    two = [
        Spring(joint="mu_1", stiffness=k, rest=r) for k, r in ((2.0, 0.5), (3.0, -0.2))
    ]
    one = Spring(joint="mu_1", stiffness=5.0, rest=0.08)
    return {"springs": tuple(two)}, {"springs": (one,)}, 1e-10


def bare(scene):
    """A link without inertia is one of vanishing inertia."""
    light = Link(inertia=inertia_of(1e-12 * np.eye(3)))
    return (
        {"intermediate_links": (Link(),) * 3},
        {"intermediate_links": (light,) * 3},
        1e-9,
    )


@pytest.mark.parametrize("pair", [springs, bare])
def test_two_ways_to_say_the_same_move_alike(pair):
    sample = seeded_samples(7, 1)[0]
    *terms, tolerance = pair(sample.scene)
    one, other = (
        Dynamics.of(replace(sample.scene, **term)).derivative(
            *sample.state, *sample.torque
        )
        for term in terms
    )
    assert one == pytest.approx(other, rel=tolerance)


def test_elastic_stops_push_beyond_the_stroke_and_never_pull():
    sample = seeded_samples(9, 1)[0]
    scene = replace(
        sample.scene, stroke=Stroke(at_end="elastic", stiffness=100.0, damping=5.0)
    )
    stops = model_of(scene).legs[0].stops
    assert stop_torque(stops, 0.5 * stops.arc, 1.0) == 0.0
    assert stop_torque(stops, -0.01, 0.0) == pytest.approx(1.0)
    assert stop_torque(stops, stops.arc + 0.01, 0.0) == pytest.approx(-1.0)
    assert stop_torque(stops, -0.01, -0.1) == pytest.approx(1.5)
    assert stop_torque(stops, -0.01, 10.0) == 0.0


@pytest.mark.parametrize("v", [-2.0, -0.05, 0.0, 0.003, 0.4])
def test_friction_is_the_documented_torque_of_its_rate(v):
    friction = Friction(
        viscous=0.3, coulomb=0.2, static=0.5, stribeck=0.1, smoothing=0.01
    )
    expected = float(documented_torque(friction, mpf(v)))
    assert friction_torque(friction, v) == pytest.approx(expected, rel=1e-14)
    assert friction_torque(friction, -v) == -friction_torque(friction, v)
    assert friction_torque(friction, v) * v >= 0.0


def test_lagging_actuators_follow_with_their_time_constant():
    sample = seeded_samples(10, 1)[0]
    scene = replace(sample.scene, actuators=Actuators(time_constant=0.05))
    dynamics = Dynamics.of(scene)
    has, asked = (0.1, 0.2, 0.3), (1.0, -1.0, 0.5)
    found = dynamics.derivative(*sample.state, *has, *asked)
    assert found[7:] == pytest.approx([18.0, -24.0, 4.0], rel=1e-14)
    assert found[:7] == Dynamics.of(sample.scene).derivative(*sample.state, *has)


def test_commands_beyond_the_torque_limit_are_clamped_to_it():
    scene = replace(EXAMPLE2, actuators=Actuators(torque_limit=2.0))
    limited, free = Simulation(scene), Simulation(EXAMPLE2)
    for _ in range(20):
        state = limited.step((9.0, -3.0, 1.5), 1_000_000)
        expected = free.step((2.0, -2.0, 1.5), 1_000_000)
    assert state == expected
    assert state.torque == (2.0, -2.0, 1.5)


def test_a_command_is_clamped_before_it_lags():
    actuators = Actuators(torque_limit=2.0, time_constant=0.01)
    simulation = Simulation(replace(EXAMPLE2, actuators=actuators))
    for _ in range(30):
        state = simulation.step((9.0, 0.0, 0.0), 1_000_000)
    assert state.torque[0] == pytest.approx(2.0 * (1.0 - np.exp(-3.0)), rel=1e-9)


def test_a_moment_from_a_topic_is_the_constant_one():
    value = (0.3, -0.2, 0.1)
    given = Simulation(replace(EXAMPLE2, moment=Moment(value=value)))
    told = Simulation(replace(EXAMPLE2, moment=Moment(topic=True)))
    deaf = Simulation(EXAMPLE2)
    for _ in range(20):
        one = given.step(REST, 1_000_000)
        other = told.step(REST, 1_000_000, value)
        without = deaf.step(REST, 1_000_000, value)
    assert other.body_rate == pytest.approx(one.body_rate, rel=1e-12)
    assert abs(without.body_rate[0] - one.body_rate[0]) > 1e-4
