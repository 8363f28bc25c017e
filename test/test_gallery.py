# SPDX-License-Identifier: Apache-2.0
"""Every shipped scene runs, and does what its description says."""

from __future__ import annotations

import re
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from sst_ros.cli.runs import check
from sst_ros.errors import RunStopped
from sst_ros.scene.scene import load, names
from sst_ros.simulation.simulation import Simulation

FOLDER = Path(__file__).parents[1] / "config" / "scenes"
REST = (0.0, 0.0, 0.0)
STEP_NS = 2_000_000
STEPS = {"fast_spin": 200_000, "stiff": 20_000_000}


@cache
def run(name):
    """A scene at every step of its whole duration: the simulation, its states, what
    ended it.
    """
    scene = load(name)
    simulation = Simulation(scene)
    torque = scene.torque.at if scene.torque else REST
    states, step = [simulation.state], STEPS.get(name, STEP_NS)
    try:
        for _ in range(round(scene.duration * 1e9 / step)):
            states.append(simulation.step(torque, step))
    except RunStopped as stopped:
        return simulation, states, stopped
    return simulation, states, None


def of(name, quantity):
    """A joint quantity over a whole run, shape (n, 3); nothing may have ended it."""
    _, states, stopped = run(name)
    assert stopped is None
    return np.array([getattr(state.joints, quantity) for state in states])


def energies(simulation, state):
    """Kinetic and potential energy [J]."""
    return simulation.dynamics.energies(*state.quaternion, *state.body_rate)


@pytest.mark.parametrize("name", names())
def test_a_scene_is_small_commented_and_can_start(name):
    source = (FOLDER / f"{name}.yaml").read_text(encoding="utf-8")
    assert source.startswith("# ")
    assert source.count("\n") < 70 and max(map(len, source.splitlines())) <= 110
    numbers = [line for line in source.splitlines() if re.search(r"[:,[] *-?\d", line)]
    told = [
        line for line in numbers if "#" in line or "printed" in line or "chosen" in line
    ]
    assert len(told) > len(numbers) / 2
    assert check(name).name == name


def test_example2_passes_the_ends_that_it_ignores():
    """With every printed number: gamma_1 from 0.9125 s, beta_2 from 0.9326 s to the end
    at 1 s.
    """
    gamma, beta = (
        np.degrees(of("example2", "gamma")),
        np.degrees(of("example2", "beta")),
    )
    assert run("example2")[1][-1].time_ns == 1_000_000_000
    assert (
        gamma[-1, 0] == gamma.max() == pytest.approx(93.986, abs=1e-3)
        and gamma.min() > 0.0
    )
    assert np.flatnonzero(gamma[:, 0] > 90.0)[0] * STEP_NS == 914_000_000
    assert beta[-1, 1] == beta.min() == pytest.approx(-5.157, abs=1e-3)
    assert np.flatnonzero(beta[:, 1] < 0.0)[0] * STEP_NS == 934_000_000


@pytest.mark.parametrize(
    ("name", "bound"), [("gravity_payload", 1e-8), ("fast_spin", 1e-6)]
)
def test_energy_is_conserved_while_it_moves(name, bound):
    assert np.ptp(of(name, "gamma")) > 0.1
    simulation, states, _ = run(name)
    found = np.array([energies(simulation, state) for state in states])
    assert np.ptp(found.sum(axis=1)) < bound * found[:, 0].max()
    assert name != "fast_spin" or np.abs(of(name, "gamma_dot")).max() > 100.0


@pytest.mark.slow
def test_with_friction_the_kinetic_energy_is_less_than_without():
    simulation, states, _ = run("friction")
    free, torque = (
        Simulation(replace(simulation.scene, friction=None)),
        simulation.scene.torque,
    )
    freely = [free.step(torque.at, STEP_NS) for _ in range(450)]
    rubbed, unrubbed = (
        np.mean([sum(energies(simulation, state)) for state in some])
        for some in (states[:450], freely)
    )
    assert rubbed < 0.8 * unrubbed
    assert np.ptp(of("friction", "gamma"), axis=0).min() > 0.05


@pytest.mark.slow
def test_elastic_stops_catch_the_actuator_and_throw_it_back():
    gamma, rate = (
        of("elastic_stops", "gamma")[:, 0],
        of("elastic_stops", "gamma_dot")[:, 0],
    )
    beyond = np.flatnonzero(gamma > np.pi / 2)
    assert len(beyond) and gamma.max() < np.pi / 2 + 0.1
    assert rate[beyond[0]] > 0.0 and gamma[beyond[-1] + 1 :].min() < np.pi / 2 - 0.01


def test_impacts_bounce_at_upper_and_lower_stops():
    gamma, rate = of("impacts", "gamma"), of("impacts", "gamma_dot")
    assert gamma.max() < np.pi / 2 + 0.01 and gamma.min() > -0.01
    bounces = []
    for leg in range(3):
        beyond = (gamma[:, leg] < 0.0) | (gamma[:, leg] > np.pi / 2)
        first, last = (
            np.flatnonzero(np.diff(beyond.astype(int)) == way) for way in (1, -1)
        )
        for i, j in zip(first, last, strict=True):
            bounces.append((leg, rate[i, leg] > 0.0))
            assert 0.2 < -rate[j + 1, leg] / rate[i, leg] < 0.9
    assert bounces == [(0, True), (0, False), (1, False), (1, True), (2, True)]


def test_general_is_general_and_moves():
    scene = load("general")
    assert len(set(run("general")[0].geometry.arc.tolist())) == 3
    assert len(set(scene.star.alpha_deg)) == 3
    inertias = [scene.star.inertia, scene.intermediate_links[0].inertia]
    assert all(i.xy and i.xz and i.yz for i in inertias)
    assert np.ptp(of("general", "gamma"), axis=0).min() > 0.02


def test_stiff_creeps_to_the_rest_of_its_springs():
    """1000 rate = -500 (gamma - rest) once inertia has died: off by 500 / 1000^2 of the
    way.
    """
    scene, gamma = load("stiff"), of("stiff", "gamma")
    start, rest = np.array(scene.initial.gamma), np.array([0.9, 0.7, 0.8])
    seconds = np.array([state.time_ns for state in run("stiff")[1]]) / 1e9
    expected = rest + (start - rest) * np.exp(-0.5 * seconds)[:, None]
    assert np.abs(gamma[-1] - start).max() > 0.03
    assert gamma == pytest.approx(expected, abs=3e-4 * np.abs(start - rest).max())
