# SPDX-License-Identifier: Apache-2.0
"""The paper's verification: torques of the inverse dynamics drive the direct dynamics back."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import numpy as np

from sst_ros.control.reference_motions import reference_motion
from sst_ros.mechanism import virtual_work
from sst_ros.mechanism.frames import angle_between, rotation_matrix
from sst_ros.scene.scene import load
from sst_ros.simulation.simulation import Simulation

STEP_NS, STEPS = 4_000_000, 250


def test_torques_of_the_inverse_dynamics_bring_the_motion_back():
    """The paper's own check, 1 s. Nothing is held: torques are functions of time within a step.
    The method's error is below rounding, and some 1000 steps of rounding at 1e-16 add up to less
    than 1e-12 rad; 1e-8 is what the paper shows."""
    scene = replace(load("example2_heavy"), motion=load("reach").motion)
    motion, mechanism = reference_motion(scene), virtual_work.Mechanism.of(scene)

    @lru_cache(maxsize=8)
    def torque(t):
        at = motion.at(t)
        rotation = rotation_matrix(at.quaternion)
        posture = virtual_work.posture(mechanism.geometry, np.array(at.gamma), rotation)
        rates = np.array(at.gamma_dot), np.array(at.gamma_ddot)
        return tuple(virtual_work.inverse_dynamics(mechanism, posture, *rates).tolist())

    simulation, start = Simulation(scene), motion.at(0.0).quaternion
    worst, travelled = 0.0, 0.0
    for _ in range(STEPS):
        state = simulation.step(torque, STEP_NS)
        now = motion.at(state.time_ns / 1e9).quaternion
        worst = max(worst, float(angle_between(state.quaternion, now)))
        travelled = max(travelled, float(angle_between(state.quaternion, start)))
    assert travelled > 0.3
    assert worst < 1e-12
