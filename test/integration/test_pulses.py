# SPDX-License-Identifier: Apache-2.0
"""Pulses and kinks of a torque function that are within steps, without `breaks`.

Each run is compared with one that is told where its torques jump or have a kink.
"""

import math

import numpy as np
import pytest

from sst_ros import load_scene, simulate
from sst_ros.dynamics.traced_dynamics import Dynamics
from sst_ros.integration.applied_torque import CHECKED_POINTS, AppliedTorque
from sst_ros.integration.point import Drive, orientation_distance
from sst_ros.scene.torque_profile import FunctionTorque

SCENE = load_scene("example2_heavy")
MAX_STEP = 0.03
BASE = np.array([0.3, -0.2, 0.1])


def pulse_of(begin, width, height):
    """Return base torques with a rectangular pulse."""

    def torque(t):
        acting = BASE + height * (begin <= t < begin + width)
        return tuple(acting.tolist())

    return torque


def run(torque, **options):
    return simulate(SCENE, torque, 0.5, samples=1, tolerance=1e-9, **options)


@pytest.mark.parametrize("method", ["auto", "dopri5", "rodas5p"])
def test_pulses_longer_than_a_32nd_of_a_step_are_never_missed(method):
    rng = np.random.default_rng(11)
    for _ in range(8):
        width = MAX_STEP / CHECKED_POINTS * 10.0 ** rng.uniform(0.01, 1.0)
        begin = rng.uniform(0.01, 0.4)
        height = 10.0 ** rng.uniform(-1.5, 0.5) * rng.choice([-1.0, 1.0], 3)
        torque = pulse_of(begin, width, height)
        told = run(torque, breaks=[begin, begin + width], method="dop853")
        found = run(torque, max_step=MAX_STEP, method=method)
        error = orientation_distance(found.quaternion[-1], told.quaternion[-1])
        assert found.status == 0
        assert error <= found.error_estimate + told.error_estimate, (begin, width)


def test_a_smooth_pulse_is_met_too():
    def torque(t):
        return 0.3 + 3.0 * np.exp(-(((t - 0.2345) / 0.002) ** 2)), -0.2, 0.1

    told = run(torque, max_step=1e-3)
    found = run(torque, max_step=MAX_STEP)
    error = orientation_distance(found.quaternion[-1], told.quaternion[-1])
    assert error <= found.error_estimate + told.error_estimate


def test_smooth_torques_cost_no_further_steps():
    def torque(t):
        return 0.3 * np.sin(8.0 * t), 0.1 - t, 0.2

    motion = run(torque, method="dop853")
    assert motion.evaluations < 1500


def draw_cut_sines(rng):
    """Return sines that are cut, and the times in half a second at which they are."""
    size, rate = rng.uniform(0.2, 0.6, 3), rng.uniform(3.0, 15.0, 3)
    phase, limit = rng.uniform(0.0, 6.0, 3), rng.uniform(0.1, 0.4)

    def torque(t):
        return tuple(np.clip(size * np.sin(rate * t + phase), -limit, limit).tolist())

    kinks = []
    for k in range(3):
        if size[k] <= limit:
            continue
        angle = math.asin(limit / size[k])
        for turn in range(-4, 8):
            for cut in (angle, math.pi - angle):
                kinks.append((turn * math.pi + cut - phase[k]) / rate[k])
    return torque, sorted(time for time in kinks if 0.0 < time < 0.5)


@pytest.mark.parametrize("method", ["auto", "dop853", "dopri5", "rk4", "rodas5p"])
def test_kinks_are_found_and_cost_little_more_than_told_ones(method):
    rng = np.random.default_rng(7)
    for _ in range(8):
        torque, kinks = draw_cut_sines(rng)
        tolerance = 10.0 ** rng.uniform(-10.0, -3.0)
        options = {"samples": 1, "method": method, "tolerance": tolerance}
        truth = run(torque, breaks=kinks, method="dop853", max_step=0.02)
        told = simulate(SCENE, torque, 0.5, breaks=kinks, **options)
        found = simulate(SCENE, torque, 0.5, **options)
        error = orientation_distance(found.quaternion[-1], truth.quaternion[-1])
        assert error <= found.error_estimate + truth.error_estimate
        assert found.evaluations < 4 * told.evaluations  # it was up to 46 times


@pytest.mark.parametrize("seed", range(10))
def test_a_kink_is_located_and_a_smooth_function_has_none(seed):
    rng = np.random.default_rng(seed)
    span = 2.0 * 0.1 / CHECKED_POINTS  # of a step of 0.1 s
    kink, rate = rng.uniform(0.0, span), rng.uniform(1.0, 20.0)
    slope = rng.uniform(0.3, 3.0) * rng.choice([-1.0, 1.0])

    def smooth(t):
        return math.sin(rate * t), math.exp(t), 0.3

    def bent(t):
        first, second, third = smooth(t)
        return first, second + slope * max(t - kink, 0.0), third

    torque = AppliedTorque(Dynamics.of(SCENE), None)
    bent_drive = Drive((0.0, 0.0, 0.0), FunctionTorque(bent))
    smooth_drive = Drive((0.0, 0.0, 0.0), FunctionTorque(smooth))
    assert torque.locate_kink(bent_drive, 0.0, span) == pytest.approx(kink, abs=1e-11)
    assert torque.locate_kink(smooth_drive, 0.0, span) is None
