# SPDX-License-Identifier: Apache-2.0
"""The shipped scenes against a closed form, another integrator and the inverse
dynamics.
"""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from symmetric_motion import inertia, inertia_slope

from sst_ros.control.reference_motions import reference_motion
from sst_ros.dynamics import kernel
from sst_ros.errors import StrokeExceeded
from sst_ros.mechanism import virtual_work
from sst_ros.mechanism.geometry import angle_between, rotation_matrix
from sst_ros.scene.scene import load
from sst_ros.simulation.simulation import Simulation

MILLISECOND = 1_000_000
EXAMPLE1, EXAMPLE2, THIN = (
    load("example1"),
    load("example2_heavy"),
    load("example2_stroke"),
)


def swing(t_end):
    """Example 1 reduced to x = gamma - pi/4 by its symmetry, by another integrator."""

    def rates(t, y):
        x, rate = y
        push = 1.13 * np.sin(12.0 * t) - 0.5 * inertia_slope(EXAMPLE1, x) * rate**2
        return rate, push / inertia(EXAMPLE1, x)

    start = (0.0, EXAMPLE1.initial.gamma_dot[0])
    run = solve_ivp(rates, (0, t_end), start, method="DOP853", rtol=1e-13, atol=1e-15)
    return run.y[:, -1]


def swung(simulation, home):
    """Angle of the star about the centre since home, counted about E."""
    turn = rotation_matrix(home).T @ rotation_matrix(simulation.state.quaternion)
    return np.arctan2(turn[1, 0], turn[0, 0])


def test_example_1_follows_its_closed_form():
    """Both integrators err below 1e-12 in 0.3 s.

    E is off the centre by rounding only.
    """
    simulation, torque = Simulation(EXAMPLE1), EXAMPLE1.torque.at
    home = simulation.state.quaternion
    for k in range(1, 301):
        simulation.step(torque, MILLISECOND)
        centre = rotation_matrix(simulation.state.quaternion)[:, 2]
        assert np.abs(centre - 3.0**-0.5).max() < 1e-12
        if k % 100 == 0:
            x, rate = swing(k / 1000.0)
            np.testing.assert_allclose(
                simulation.state.joints.gamma, x + np.pi / 4, atol=1e-11
            )
            np.testing.assert_allclose(
                simulation.state.joints.gamma_dot, rate, atol=1e-10
            )
            psi = np.arctan(np.sqrt(3.0) * np.tan(x))
            assert swung(simulation, home) == pytest.approx(psi, abs=1e-11)


def by_scipy(scene, end, events=None):
    """The same motion by SciPy's DOP853 at its tightest tolerance."""
    simulation, torque = Simulation(scene), scene.torque.at
    model = kernel.model_of(scene)
    start = (*simulation.state.quaternion, *simulation.state.body_rate)

    def rates(t, y):
        return kernel.derivative(model, tuple(y), torque(t))

    return solve_ivp(
        rates,
        (0.0, end),
        start,
        "DOP853",
        rtol=2.3e-14,
        atol=1e-15,
        max_step=0.01,
        events=events,
    )


def test_heavy_example_2_stays_inside_for_its_second():
    """Dormand-Prince at 1 ms errs by 1e-13, SciPy's reference by 1e-14."""
    simulation, torque = Simulation(EXAMPLE2), EXAMPLE2.torque.at
    for _ in range(1000):
        simulation.step(torque, MILLISECOND)
    truth = by_scipy(EXAMPLE2, 1.0).y[:, -1]
    state = simulation.state
    assert state.time_ns == 1000 * MILLISECOND
    np.testing.assert_allclose(state.body_rate, truth[4:], atol=2e-12)
    sign = np.sign(truth[:4] @ state.quaternion)
    np.testing.assert_allclose(state.quaternion, sign * truth[:4], atol=1e-12)
    assert simulation.error_estimate < 1e-9


def time_of_the_end():
    """When gamma_1 of the thin scene passes pi/2: a root of SciPy's dense output."""
    model = kernel.model_of(THIN)

    def margin(t, y):
        return np.pi / 2 - kernel.joints(model, tuple(y)).gamma[0]

    margin.terminal = True
    return by_scipy(THIN, 1.0, events=margin).t_events[0][0]


def test_thin_example_2_stops_at_the_end_of_the_first_stroke():
    simulation, torque = Simulation(THIN), THIN.torque.at
    with pytest.raises(StrokeExceeded, match=r"gamma_1 > 1\.570796 rad") as caught:
        for _ in range(1000):
            simulation.step(torque, MILLISECOND)
    assert caught.value.time == pytest.approx(0.9125, abs=5e-4)
    # SciPy's dense output of a 10 ms step is of order 7: good for 1e-9 s.
    assert caught.value.time == pytest.approx(time_of_the_end(), abs=1e-9)
    assert caught.value.state is simulation.state
    assert simulation.state.time_ns == 912 * MILLISECOND
    assert simulation.state.joints.gamma[0] < np.pi / 2


@pytest.mark.slow
def test_torques_of_the_inverse_dynamics_bring_the_motion_back():
    """The paper's own check, 1 s. Nothing is held: torques are functions of time within
    a step. The method's error is below rounding, and some 1000 steps of rounding at
    1e-16 add up to less than 1e-12 rad; 1e-8 is what the paper shows.
    """
    scene = replace(EXAMPLE2, motion=load("reach").motion)
    motion, mechanism = reference_motion(scene), virtual_work.Mechanism.of(scene)

    @lru_cache(maxsize=8)
    def torque(t):
        at = motion.at(t)
        rotation = rotation_matrix(at.quaternion)
        posture = virtual_work.posture(mechanism.geometry, np.array(at.gamma), rotation)
        rates = np.array(at.gamma_dot), np.array(at.gamma_ddot)
        return tuple(virtual_work.inverse_dynamics(mechanism, posture, *rates).tolist())

    simulation, start = Simulation(scene, "dop853"), motion.at(0.0).quaternion
    worst, travelled = 0.0, 0.0
    for _ in range(250):
        state = simulation.step(torque, 4 * MILLISECOND)
        now = motion.at(state.time_ns / 1e9).quaternion
        worst = max(worst, float(angle_between(state.quaternion, now)))
        travelled = max(travelled, float(angle_between(state.quaternion, start)))
    assert travelled > 0.3
    assert worst < 1e-12
