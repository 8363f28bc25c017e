# SPDX-License-Identifier: Apache-2.0
"""The paper's equations on (q, gamma_dot) under SciPy at its tightest, with actuators held still.

A held actuator is a constraint: its row of the equation of motion gives the torque of its end.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

from sst_ros.mechanism import kinematics, virtual_work
from sst_ros.mechanism.frames import rotation_matrix
from sst_ros.mechanism.geometry import Geometry
from sst_ros.scene.scene import Scene
from sst_ros.simulation import Simulation

NOISE = 1e-13
"""Rounding of an angle: what has just left an end is at it."""


class PaperForm:
    """A scene under torques that are a function of time, with friction at gamma or none."""

    def __init__(self, scene: Scene, torque: Callable[[float], tuple[float, float, float]]):
        self.geometry, self.torque = Geometry.of(scene), torque
        self.mechanism = virtual_work.Mechanism.of(scene)
        self.friction = scene.friction.gamma if scene.friction else None
        state = Simulation(scene).state
        self.start = np.array([*state.quaternion, *state.joints.gamma_dot])

    def posture(self, y):
        rotation = rotation_matrix(y[:4] / np.linalg.norm(y[:4]))
        gamma = kinematics.inverse(self.geometry, rotation)[0]
        return virtual_work.posture(self.geometry, gamma, rotation)

    def inertia(self, y):
        """M = -T1 of the paper."""
        return -virtual_work.equation_of_motion(self.mechanism, self.posture(y), y[4:])[0]

    def accelerations(self, t, y, held=()):
        """gamma_ddot of all actuators, and the torques of all ends: zero where none holds."""
        rate = y[4:]
        t1, t2 = virtual_work.equation_of_motion(self.mechanism, self.posture(y), rate)
        force = t2 + np.asarray(self.torque(t))
        if self.friction is not None:
            force -= self.friction.viscous * rate
            force -= self.friction.coulomb * np.tanh(rate / self.friction.smoothing)
        free = [k for k in range(3) if k not in held]
        answer = np.zeros(3)
        answer[free] = np.linalg.solve(-t1[np.ix_(free, free)], force[free])
        torques = -t1 @ answer - force
        torques[free] = 0.0
        return answer, torques

    def slope(self, t, y, held=()):
        spin = self.posture(y).j @ y[4:]
        vector, scalar = y[:3], y[3]
        turning = [*(scalar * spin + np.cross(spin, vector)), -spin @ vector]
        return np.concatenate([0.5 * np.array(turning), self.accelerations(t, y, held)[0]])

    def travelled(self, begin, end, y, held=()):
        """Times and states of SciPy's steps from one time to another."""
        if end == begin:
            return np.array([begin]), np.array(y)[:, None]
        found = solve_ivp(
            self.slope, (begin, end), y, method="DOP853", rtol=2.3e-14, atol=1e-14, args=(held,)
        )
        return found.t, found.y

    def first_zero(self, signal, begin, y, end, held=()):
        """When signal(t, y) becomes negative, and the state then; None where it does not."""
        times, states = self.travelled(begin, end, y, held)
        for i in range(1, len(times)):
            if signal(times[i], states[:, i]) >= -NOISE:
                continue

            def at(t, i=i):
                return self.travelled(times[i - 1], t, states[:, i - 1], held)[1][:, -1]

            if signal(times[i - 1], states[:, i - 1]) <= 0.0:
                return times[i - 1], states[:, i - 1]
            t = brentq(lambda t: signal(t, at(t)), times[i - 1], times[i], xtol=1e-15)
            return t, at(t)
        return None

    def run(self, leg, upper, until):
        """Impacts without restitution at one end, and releases: their times; the state at last."""
        t, y, held, times = 0.0, self.start, (), []
        while True:
            signal = self.push(leg, upper, held) if held else self.end(leg, upper)
            found = self.first_zero(signal, t, y, until, held)
            if found is None:
                return times, self.travelled(t, until, y, held)[1][:, -1]
            t, y = found
            times.append(t)
            y, held = (y, ()) if held else (self.struck(y, leg, 0.0), (leg,))

    def end(self, leg, upper):
        """Distance to an end of the stroke, as a signal."""

        def distance(_, y):
            gamma = self.posture(y).gamma[leg]
            return self.geometry.arc[leg] - gamma if upper else gamma

        return distance

    def push(self, leg, upper, held):
        """Torque by which the end keeps the actuator from going on, as a signal."""

        def torque(t, y):
            return (-1.0 if upper else 1.0) * self.accelerations(t, y, held)[1][leg]

        return torque

    def struck(self, y, leg, restitution, held=()):
        """State after an impact that leaves the momenta of free actuators as they are."""
        legs = [leg, *held]
        wanted = -y[4:][legs]
        wanted[0] *= 1.0 + restitution
        response = np.linalg.inv(self.inertia(y))[:, legs]
        after = y.copy()
        after[4:] += response @ np.linalg.solve(response[legs], wanted)
        return after

    def apart(self, y, state):
        """Largest difference of orientation [rad] and actuator rates [rad/s] to a state."""
        q = y[:4] / np.linalg.norm(y[:4])
        other = np.array(state.quaternion)
        turned = 2.0 * min(np.abs(q - other).max(), np.abs(q + other).max())
        return turned, np.abs(y[4:] - state.joints.gamma_dot).max()

    def distances(self, y, state):
        """Angle between orientations [rad], distance of angular velocities [rad/s]."""
        at, q, other = self.posture(y), y[:4] / np.linalg.norm(y[:4]), np.array(state.quaternion)
        turned = 2.0 * min(np.linalg.norm(q - other), np.linalg.norm(q + other))
        return turned, np.linalg.norm(at.rotation.T @ at.j @ y[4:] - state.body_rate)
