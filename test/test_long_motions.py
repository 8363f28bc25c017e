# SPDX-License-Identifier: Apache-2.0
"""Motions of many thousand seconds end, in time and memory, and estimates hold."""

import math
import resource
import warnings

import numpy as np
import pytest

from sst_ros import simulate
from sst_ros.scene.scene import load

AT_REST = [0.0, 0.0, 0.0]


def angle_between(a, b):
    """Angle between the orientations at the ends of two motions [rad]."""
    sign = np.sign(a.quaternion[-1] @ b.quaternion[-1])
    return 2.0 * np.linalg.norm(sign * a.quaternion[-1] - b.quaternion[-1])


def test_no_warning_of_a_motion_that_only_has_to_run_again():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        motion = simulate("swing", AT_REST, 100.0, tolerance=1e-4)
    assert motion.success
    assert motion.evaluations > 100_000  # where a hopeless motion is warned of


@pytest.mark.slow
def test_a_damped_motions_energy_residual_is_its_works_error():
    scene = load("swing").with_values({"friction.gamma.viscous": 0.6})

    def drive(t):
        return [1.5 * math.sin(2 * t), -math.sin(3 * t), 0.8 * math.cos(2.5 * t)]

    accurate = simulate(scene, drive, 30.0, tolerance=1e-11)
    motion = simulate(scene, drive, 30.0, tolerance=1e-4)
    error_of_energy = abs(motion.energy[-1] - accurate.energy[-1])
    assert abs(accurate.energy_residual) < 1e-9
    assert angle_between(motion, accurate) <= motion.error_estimate < 1e-4
    assert error_of_energy < 1e-5
    assert abs(motion.energy_residual) > 100.0 * error_of_energy


@pytest.mark.slow
def test_ten_thousand_seconds_under_gravity_and_springs():
    shorter = simulate("gravity_payload", AT_REST, 1e3, tolerance=1e-4)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    motion = simulate("gravity_payload", AT_REST, 1e4, tolerance=1e-4)
    grown = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before
    assert shorter.success
    assert motion.success
    assert grown < 10_000  # kB
    accurate = simulate("gravity_payload", AT_REST, 1e4, tolerance=1e-6)
    assert angle_between(motion, accurate) <= motion.error_estimate <= 1e-4
