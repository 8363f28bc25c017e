# SPDX-License-Identifier: Apache-2.0
"""The estimate of the hold error against the true one, and where there is none."""

import dataclasses

import pytest

from sst_ros import load_scene
from sst_ros.mechanism.geometry import angle_between
from sst_ros.runtime.tick_loop import HeldTorques
from sst_ros.scene.loads import Actuators
from sst_ros.simulation.simulation import Simulation


def held(scene, rate, shift, seconds):
    """Hold the torques of a scene at a rate [Hz], those at `shift` of each hold."""
    simulation, torques = Simulation(scene, "dop853"), HeldTorques()
    profile = scene.torque.at
    for k in range(round(seconds * rate)):
        torque = profile((k + shift) / rate)
        simulation.step(torque, 10**9 // rate)
        torques.add(torque, 1.0 / rate)
    return simulation, torques


@pytest.mark.parametrize("rate", [100, 500])
@pytest.mark.parametrize(
    ("name", "within"), [("example2", 1.3), ("general", 1.3), ("friction", 6)]
)
@pytest.mark.parametrize("shift", [0.0, 0.5])
def test_the_hold_error_is_estimated_to_a_factor(name, within, shift, rate):
    """Friction damps the error, of which the estimate sees nothing."""
    scene = load_scene(name)
    simulation, torques = held(scene, rate, shift, 1.0)
    exact = Simulation(scene, "dop853", tolerance=1e-12, step_budget=10**6)
    exact.step(scene.torque, 1_000_000_000)
    true = angle_between(simulation.state.quaternion, exact.state.quaternion)
    estimate = torques.errors(simulation)[shift > 0.0]
    assert true / within <= estimate <= within * true


def test_there_is_no_estimate_before_two_torques_and_with_lag():
    scene = load_scene("example2")
    simulation, torques = held(scene, 100, 0.0, 0.01)
    assert torques.errors(simulation) is None
    simulation, torques = held(scene, 100, 0.0, 0.05)
    assert torques.errors(simulation)[0] > 0.0
    lagging = dataclasses.replace(scene, actuators=Actuators(time_constant=0.01))
    assert torques.errors(Simulation(lagging)) is None
    torques.clear()
    assert torques.errors(simulation) is None
