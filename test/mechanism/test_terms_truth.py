# SPDX-License-Identifier: Apache-2.0
"""Each term against a truth of its own: Lagrange with potentials, energy, frequency, impulse."""

from __future__ import annotations

import importlib.util
from dataclasses import replace

import numpy as np
import pytest
from lagrange import add
from mechanism.loaded_lagrange import LoadedLagrange
from models import seeded_samples
from mpmath import mpf
from scipy.integrate import solve_ivp
from scipy.linalg import eigh

from sst_ros import Simulation, load_scene
from sst_ros.dynamics.traced_dynamics import Dynamics
from sst_ros.mechanism import virtual_work
from sst_ros.mechanism.frames import rotation_matrix
from sst_ros.mechanism.geometry import Geometry
from sst_ros.scene.bodies import Link
from sst_ros.scene.loads import (
    Actuators,
    Friction,
    Gravity,
    Initial,
    JointFriction,
    Moment,
    Spring,
    Stroke,
    Workspace,
)

REST = (0.0, 0.0, 0.0)
NUMBA = importlib.util.find_spec("numba") is not None
FREE = {"stroke": Stroke(at_end="ignore"), "workspace": Workspace(at_edge="ignore")}


def laden(sample):
    """The sample's bodies with mass, gravity, springs of every kind and friction everywhere."""
    scene = sample.scene

    def heavy(links):
        return tuple(
            replace(link, mass=0.4, centre=(0.05, -0.02, 0.04 + 0.01 * k))
            for k, link in enumerate(links)
        )

    rub = Friction(viscous=0.3, coulomb=0.2, static=0.35, stribeck=0.7, smoothing=0.4)
    return replace(
        scene,
        star=replace(scene.star, mass=0.9, centre=(0.03, -0.02, 0.1)),
        actuated_links=heavy(scene.actuated_links),
        intermediate_links=heavy(scene.intermediate_links),
        gravity=Gravity(acceleration=(2.0, -3.0, -9.0)),
        springs=tuple(
            Spring(joint=f"{kind}_{leg}", stiffness=2.0 + leg, rest=0.2 * leg)
            for kind in ("gamma", "mu", "beta")
            for leg in (1, 2, 3)
        ),
        friction=JointFriction(gamma=rub, mu=Friction(viscous=0.2), beta=rub),
        **FREE,
    )


@pytest.mark.parametrize("sample", seeded_samples(71, 3), ids=range(3))
def test_gravity_springs_and_friction_are_lagranges_on_general_models(sample):
    """Both lose some two digits of 1e-16 to M and J; the loads are of the size of the torques."""
    scene = laden(sample)
    truth = LoadedLagrange(scene, sample.rotation)
    loads = truth.loads(sample.gamma, sample.gamma_dot)
    expected = truth.acceleration(sample.gamma, sample.gamma_dot, sample.torque + loads)
    slope = Dynamics.of(scene).derivative(*sample.state, *sample.torque.tolist())
    bias = virtual_work.bias(sample.posture, sample.gamma_dot).omega_dot
    found = np.linalg.solve(sample.posture.j, sample.rotation @ np.array(slope[4:]) - bias)
    expected = np.array(expected, dtype=float)
    assert np.abs(loads).max() > 1.0
    assert np.abs(found - expected).max() <= 1e-11 * np.abs(expected).max()


def total_energy(simulation):
    state = simulation.state
    kinetic, potential, _ = simulation.dynamics.energies(*state.quaternion, *state.body_rate, *REST)
    return kinetic, kinetic + potential


def drift(seconds, **options):
    """Largest change of the energy of a tool in springs under gravity, in kinetic energies."""
    simulation = Simulation(load_scene("gravity_payload"), "dop853", tolerance=1e-13, **options)
    start, most, change = total_energy(simulation)[1], 0.0, 0.0
    for _ in range(round(seconds / 0.05)):
        simulation.step(REST, 50_000_000)
        kinetic, total = total_energy(simulation)
        most, change = max(most, kinetic), max(change, abs(total - start))
    return change / most


def test_energy_is_conserved_under_gravity_for_10_s():
    assert drift(10.0) <= 1e-11


@pytest.mark.slow
def test_energy_is_conserved_under_gravity_for_100_s():
    assert drift(100.0, compiled=NUMBA) <= 1e-10


def resistance(friction, v):
    level = friction.coulomb
    if friction.static:
        level += (friction.static - friction.coulomb) * np.exp(-((v / friction.stribeck) ** 2))
    return friction.viscous * v + level * np.tanh(v / friction.smoothing)


def test_work_becomes_kinetic_energy_and_heat_by_scipys_integrator():
    """Work and heat are integrated beside the motion; 1e-9 of the work is asked for."""
    scene, torque = load_scene("friction"), load_scene("friction").torque.at
    dynamics = Dynamics.of(scene)
    kinds = (scene.friction.gamma, scene.friction.mu, scene.friction.beta)

    def rates(t, y):
        tau, joints = torque(t), dynamics.joints(*y[:7])
        speeds = np.reshape(joints[9:], (3, 3))
        heat = sum(
            resistance(kind, v) * v for kind, row in zip(kinds, speeds, strict=True) for v in row
        )
        return (*dynamics.derivative(*y[:7], *tau), float(np.dot(tau, speeds[0])), heat)

    simulation = Simulation(scene)
    start = (*simulation.state.quaternion, *simulation.state.body_rate, 0.0, 0.0)
    run = solve_ivp(rates, (0.0, 0.5), start, method="DOP853", rtol=1e-12, atol=1e-13)
    *end, work, heat = run.y[:, -1].tolist()
    kinetic = dynamics.energies(*end, *REST)[0]
    assert min(work, heat, kinetic) > 0.01
    assert heat + kinetic == pytest.approx(work, abs=1e-9 * work)


def test_friction_alone_never_speeds_anything_up():
    scene = replace(load_scene("friction"), torque=None, **FREE)
    scene = replace(scene, initial=Initial(gamma=scene.initial.gamma, gamma_dot=(3.0, -2.0, 1.0)))
    simulation = Simulation(scene, "dop853")
    energies = [total_energy(simulation)[0]]
    for _ in range(60):
        simulation.step(REST, 10_000_000)
        energies.append(total_energy(simulation)[0])
    assert np.all(np.diff(energies) < 0.0)
    assert energies[-1] < 0.5 * energies[0]


def period(scene, start, direction):
    """Time between the first and the last of some zeros of the motion along a direction [s]."""
    dynamics, simulation = Dynamics.of(scene), Simulation(scene)
    here = (*simulation.state.quaternion, *simulation.state.body_rate)

    def crossing(_, y):
        return float(np.dot(dynamics.joints(*y[:7])[:3] - start, direction))

    run = solve_ivp(
        lambda _, y: dynamics.derivative(*y, *REST), (0.0, 3.0), here, method="DOP853",
        rtol=1e-11, atol=1e-14, events=crossing,
    )  # fmt: skip
    times = run.t_events[0]
    times = times[times > 1e-6]
    return 2.0 * (times[-1] - times[0]) / (len(times) - 1)


@pytest.mark.parametrize("mode", range(3))
@pytest.mark.parametrize("name", ["example2_stroke", "general"])
def test_small_swings_between_springs_have_the_periods_of_t1_and_stiffness(name, mode):
    """Springs at all kinds of joints, relaxed at the start; errors go with the amplitude, 1e-5."""
    scene = load_scene(name)
    gamma, amplitude = np.array(scene.initial.gamma), 1e-5
    geometry, state = Geometry.of(scene), Simulation(scene).state
    at = virtual_work.posture(geometry, gamma, rotation_of(state))
    rows = {"gamma": np.eye(3), "mu": at.a, "beta": at.b}
    springs, stiffness = [], np.zeros((3, 3))
    for kind, rest in (("gamma", gamma), ("mu", state.joints.mu), ("beta", state.joints.beta)):
        for k in range(3):
            value = 20.0 + 7.0 * k if kind == "gamma" else 3.0 + 2.0 * k
            springs.append(Spring(joint=f"{kind}_{k + 1}", stiffness=value, rest=float(rest[k])))
            stiffness += value * np.outer(rows[kind][k], rows[kind][k])
    mechanism = virtual_work.Mechanism.of(scene)
    mass = -virtual_work.equation_of_motion(mechanism, at, np.zeros(3))[0]
    squares, modes = eigh(stiffness, mass)
    moving = Initial(gamma=gamma, gamma_dot=amplitude * np.sqrt(squares[mode]) * modes[:, mode])
    swinging = replace(scene, springs=tuple(springs), torque=None, initial=moving, **FREE)
    found = period(swinging, gamma, mass @ modes[:, mode])
    assert found == pytest.approx(2.0 * np.pi / np.sqrt(squares[mode]), rel=1e-6)


def rotation_of(state):
    return rotation_matrix(state.quaternion)


def curvature(function, at):
    """Second derivatives by differences at 50 digits, shape (3, 3)."""
    step = mpf(10) ** -12
    units = [[step * (i == j) for j in range(3)] for i in range(3)]

    def slope(i, j):
        corners = ((a, b) for a in (-1, 1) for b in (-1, 1))
        total = sum(a * b * function(add(add(at, units[i], a), units[j], b)) for a, b in corners)
        return float(total / (2 * step) ** 2)

    return np.array([[slope(i, j) for j in range(3)] for i in range(3)])


def test_a_tool_that_hangs_in_springs_swings_with_the_periods_of_its_height():
    """Gravity towards E makes the centre stable; the fast mode turns E about itself."""
    home = (np.pi / 4,) * 3
    scene = replace(
        load_scene("gravity_payload"),
        gravity=Gravity(acceleration=(5.0, 5.0, 5.0)),
        initial=Initial(gamma=home),
        **FREE,
    )
    at_home = rotation_of(Simulation(scene).state)
    truth = LoadedLagrange(scene, at_home)
    tool = [scene.payload.mass * x for x in scene.payload.centre]
    truth.weights[0] = add(truth.weights[0], tool)
    stiffness = curvature(truth.potential, [mpf(x) for x in home])
    at = virtual_work.posture(Geometry.of(scene), home, at_home)
    mechanism = virtual_work.Mechanism.of(scene)
    mass = -virtual_work.equation_of_motion(mechanism, at, np.zeros(3))[0]
    squares, modes = eigh(stiffness, mass)
    assert abs(stiffness[0, 1]) > 0.1
    for square, mode in zip(squares, modes.T, strict=True):
        rate = 1e-5 * np.sqrt(square) * mode
        swinging = replace(scene, initial=Initial(gamma=home, gamma_dot=rate))
        found = period(swinging, np.array(home), mass @ mode)
        assert found == pytest.approx(2.0 * np.pi / np.sqrt(square), rel=1e-6)


def test_commands_beyond_the_torque_limit_are_clamped_to_it():
    scene = replace(load_scene("example2_heavy"), actuators=Actuators(torque_limit=2.0))
    limited, free = Simulation(scene), Simulation(load_scene("example2_heavy"))
    for _ in range(20):
        state = limited.step((9.0, -3.0, 1.5), 1_000_000)
        expected = free.step((2.0, -2.0, 1.5), 1_000_000)
    assert state == expected
    assert state.torque == (2.0, -2.0, 1.5)


def test_a_command_is_clamped_before_it_lags():
    actuators = Actuators(torque_limit=2.0, time_constant=0.01)
    simulation = Simulation(replace(load_scene("example2_heavy"), actuators=actuators))
    for _ in range(30):
        state = simulation.step((9.0, 0.0, 0.0), 1_000_000)
    assert state.torque[0] == pytest.approx(2.0 * (1.0 - np.exp(-3.0)), rel=1e-9)


def test_a_moment_from_a_topic_is_the_constant_one():
    value = (0.3, -0.2, 0.1)
    given = Simulation(replace(load_scene("example2_heavy"), moment=Moment(value=value)))
    told = Simulation(replace(load_scene("example2_heavy"), moment=Moment(topic=True)))
    deaf = Simulation(load_scene("example2_heavy"))
    for _ in range(20):
        one = given.step(REST, 1_000_000)
        other = told.step(REST, 1_000_000, value)
        without = deaf.step(REST, 1_000_000, value)
    assert other.body_rate == pytest.approx(one.body_rate, rel=1e-12)
    assert abs(without.body_rate[0] - one.body_rate[0]) > 1e-4


def test_a_link_without_inertia_is_one_of_vanishing_inertia():
    scene = load_scene("example2_heavy")
    tiny = replace(scene.intermediate_links[0].inertia, xx=1e-12, yy=1e-12, zz=1e-12)
    inputs = (0.1, 0.2, 0.3, 0.9, 1.0, -1.0, 0.5, 1.0, 2.0, 3.0)
    bare = replace(scene, intermediate_links=(Link(),) * 3)
    light = replace(scene, intermediate_links=(Link(inertia=tiny),) * 3)
    found, expected = (Dynamics.of(s).derivative(*inputs) for s in (bare, light))
    assert found == pytest.approx(expected, rel=1e-9)
