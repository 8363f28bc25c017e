# SPDX-License-Identifier: Apache-2.0
"""The error that a run tells of itself, its energy balance and its closure.

Truth: the same periods by DOP853 at tolerance 1e-14 (Rodas5P for the stiff scene). Its
own estimate is asserted to be 20 times below the errors it judges; smaller errors are
rounding, and only bounded.
"""

from __future__ import annotations

import functools
import math
from dataclasses import replace

import pytest
from loaded_scenes import REST, apart, run
from slow_cases import slow_after

from sst_ros.scene.loads import Friction, JointFriction
from sst_ros.scene.scene import load
from sst_ros.simulation.simulation import Simulation

ROUNDING = 1e-12
PERIOD = 0.01
SPANS = {
    "example1": 0.5,
    "example2_heavy": 1.0,
    "example2_stroke": 0.9,
    "general": 1.0,
    "friction": 1.0,
    "fast_spin": 0.1,
    "gravity_payload": 1.0,
    "elastic_stops": 1.5,
    "impacts": 1.5,
    "stiff": 0.3,
}


def travelled(name, method, tolerance):
    scene = load(name)
    torque = scene.torque.at if scene.torque else REST
    return run(
        Simulation(scene, method, tolerance=tolerance, step_budget=10**6),
        SPANS[name],
        PERIOD,
        torque,
    )


@functools.cache
def truth_of(name):
    method, tolerance = ("rodas5p", 1e-11) if name == "stiff" else ("dop853", 1e-14)
    return travelled(name, method, tolerance)


def slowly(*values):
    return pytest.param(*values, marks=pytest.mark.slow)


@pytest.mark.parametrize("tolerance", slow_after(1, [1e-6, 1e-8]))
@pytest.mark.parametrize(
    ("name", "method"),
    [
        *((name, "auto") for name in SPANS),
        *(
            slowly(name, "dop853")
            for name in ("friction", "fast_spin", "elastic_stops", "impacts")
        ),
        ("elastic_stops", "rodas5p"),
        *(slowly(name, "rodas5p") for name in ("friction", "impacts", "general")),
    ],
)
def test_the_estimate_is_within_ten_times_of_the_true_error(name, method, tolerance):
    simulation, truth = travelled(name, method, tolerance), truth_of(name)
    estimates = simulation.error_estimate, simulation.rate_error_estimate
    own = truth.error_estimate, truth.rate_error_estimate
    for estimate, error, its_own in zip(
        estimates, apart(simulation, truth), own, strict=True
    ):
        unsure = max(ROUNDING, 20.0 * its_own)
        assert estimate > 0.1 * error - unsure
        assert estimate < 10.0 * error + unsure


@pytest.mark.parametrize("name", ["elastic_stops", "impacts"])
def test_contacts_lose_no_order(name):
    """Steps end where a force has its kink, so 100 times the accuracy costs few steps
    more.
    """
    loose, tight, truth = (
        travelled(name, "dop853", 1e-6),
        travelled(name, "dop853", 1e-10),
        truth_of(name),
    )
    assert apart(tight, truth)[0] < 1e-11
    assert apart(loose, truth)[0] < 1e-7
    assert tight.accepted_steps < 1.5 * loose.accepted_steps


@pytest.mark.parametrize("name", list(SPANS))
def test_energy_balance_and_closure_show_no_loss(name):
    """The balance is judged at tolerance 1e-10 by the largest energy turned over."""
    simulation = travelled(name, "auto", 1e-10)
    turned_over = max(1.0, simulation._energy)
    assert abs(simulation.energy_residual) < 1e-8 * turned_over
    assert simulation.closure_residual < 1e-15 * 8


@pytest.mark.parametrize(("seconds", "bound"), [(20.0, 1e-13), slowly(1000.0, 1e-12)])
def test_springs_keep_their_energy(seconds, bound):
    scene = replace(load("gravity_payload"), friction=None)
    simulation = Simulation(scene, "dop853", tolerance=1e-14)
    scale = max(abs(simulation._energy), 1.0)
    for _ in range(round(seconds / 0.01)):
        simulation.step(REST, 10_000_000)
        assert abs(simulation.energy_residual) < bound * scale


# underestimated 27, 11, 16 and 10 times by an estimate that took order 4 for granted
SHARP = [
    ("example2_heavy", 0.05, 1e-4, 1),
    ("example2_heavy", 0.5, 1e-3, 5),
    ("example2_heavy", 0.5, 1e-4, 5),
    ("friction", 0.05, 1e-4, 2),
]


@pytest.mark.parametrize(("name", "coulomb", "smoothing", "step_ms"), SHARP)
def test_fixed_steps_over_sharp_friction_use_the_order_left(
    name, coulomb, smoothing, step_ms
):
    friction = JointFriction(gamma=Friction(coulomb=coulomb, smoothing=smoothing))
    scene = replace(load(name), friction=friction)
    torque = scene.torque.at
    fixed = Simulation(scene, "rk4")
    truth = Simulation(scene, tolerance=1e-11, step_budget=10**6)
    for k in range(50):
        now = torque(k * PERIOD)
        truth.step(now, 10_000_000)
        for _ in range(10 // step_ms):
            fixed.step(now, step_ms * 1_000_000)
    assert math.hypot(*fixed.state.quaternion) == pytest.approx(1.0, abs=1e-15)
    error, rate_error = apart(fixed, truth)
    assert 0.1 * error < fixed.error_estimate < 10.0 * error
    assert 0.1 * rate_error < fixed.rate_error_estimate < 10.0 * rate_error
