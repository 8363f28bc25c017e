# SPDX-License-Identifier: Apache-2.0
"""The paper's verification: torques of the inverse dynamics drive the direct dynamics back."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import numpy as np

from sst_ros.mechanism import kinematics, virtual_work
from sst_ros.mechanism.frames import angle_between, quaternion_of
from sst_ros.scene.scene import Initial, load
from sst_ros.simulation.simulation import Simulation

STEP_NS, STEPS = 4_000_000, 250
EXAMPLE2 = load("example2_heavy")


def about(axis, angle):
    """Rotation about a coordinate axis; analytic, so complex angles give slopes."""
    c, s, i, j = np.cos(angle), np.sin(angle), (axis + 1) % 3, (axis + 2) % 3
    turn = np.zeros((3, 3), dtype=np.result_type(angle, float))
    turn[axis, axis], turn[i, i], turn[j, j], turn[i, j], turn[j, i] = 1.0, c, c, -s, s
    return turn


class Wanted:
    """R0 Rx(a) Ry(b) Rz(c) with smooth a(t), b(t), c(t), and its exact body rates."""

    amplitude = np.array([0.15, 0.2, 0.3])
    frequency = np.array([5.0, 7.0, 4.0])
    phase = np.array([0.3, 1.0, 2.0])

    def __init__(self, centre):
        self.centre = centre

    def angles(self, t):
        return self.amplitude * np.sin(self.frequency * t + self.phase)

    def rotation(self, t):
        a, b, c = self.angles(t)
        return self.centre @ about(0, a) @ about(1, b) @ about(2, c)

    def rate(self, t):
        _, b, c = self.angles(t)
        da, db, dc = self.amplitude * self.frequency * np.cos(self.frequency * t + self.phase)
        x, y, z = np.eye(3)
        return about(2, -c) @ (about(1, -b) @ (x * da) + y * db) + z * dc

    def rate_dot(self, t):
        return self.rate(t + 1e-20j).imag / 1e-20


def test_wanted_motion_is_consistent():
    """W of the motion is that of its rotation, by complex step."""
    wanted = Wanted(np.eye(3))
    slope = wanted.rotation(0.4).T @ (wanted.rotation(0.4 + 1e-20j).imag / 1e-20)
    np.testing.assert_allclose(
        [slope[2, 1], slope[0, 2], slope[1, 0]], wanted.rate(0.4), atol=1e-14
    )


def states_and_torques(scene, wanted):
    """gamma, gamma_dot and torques of the paper's inverse dynamics along a wanted motion."""
    mechanism = virtual_work.Mechanism.of(scene)

    @lru_cache(maxsize=8)
    def at(t):
        rotation = wanted.rotation(t)
        gamma, _, _ = kinematics.inverse(mechanism.geometry, rotation)
        posture = virtual_work.posture(mechanism.geometry, gamma, rotation)
        gamma_dot = np.linalg.solve(posture.j, rotation @ wanted.rate(t))
        bias = virtual_work.bias(posture, gamma_dot).omega_dot
        gamma_ddot = np.linalg.solve(posture.j, rotation @ wanted.rate_dot(t) - bias)
        torque = virtual_work.inverse_dynamics(mechanism, posture, gamma_dot, gamma_ddot)
        return gamma, gamma_dot, tuple(torque.tolist())

    return at


def test_torques_of_the_inverse_dynamics_bring_the_motion_back():
    """The paper's own check, 1 s. Nothing is held: torques are functions of time within a step.
    The method's error is below rounding, and some 1000 steps of rounding at 1e-16 add up to less
    than 1e-12 rad; 1e-8 is what the paper shows."""
    home = kinematics.admissible(Simulation(EXAMPLE2).geometry, EXAMPLE2.initial.gamma)
    wanted = Wanted(home.rotation)
    at = states_and_torques(EXAMPLE2, wanted)
    gamma, gamma_dot, _ = at(0.0)
    scene = replace(EXAMPLE2, initial=Initial(gamma=gamma, gamma_dot=gamma_dot))
    simulation, worst, travelled = Simulation(scene), 0.0, 0.0
    for _ in range(STEPS):
        state = simulation.step(lambda t: at(t)[2], STEP_NS)
        now = wanted.rotation(state.time_ns / 1e9)
        miss = angle_between(state.quaternion, quaternion_of(now))
        worst = max(worst, float(miss))
        travelled = max(
            travelled, float(angle_between(state.quaternion, quaternion_of(home.rotation)))
        )
    assert travelled > 0.3
    assert worst < 1e-12
