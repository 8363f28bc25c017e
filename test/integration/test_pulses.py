# SPDX-License-Identifier: Apache-2.0
"""Pulses of a torque function that are shorter than steps, without `breaks`.

Each run is compared with one that is told where its torques jump.
"""

import numpy as np
import pytest

from sst_ros import load_scene, simulate
from sst_ros.integration.applied_torque import CHECKED_POINTS
from sst_ros.integration.point import orientation_distance

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
