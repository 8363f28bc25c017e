# SPDX-License-Identifier: Apache-2.0
"""The work that every engine gets: seven links, three torques over time, one second
from rest.

As rigid bodies the links are a tree with two loops to close, for engines that need one:
base -> actuated k -> intermediate k for each leg, the star hangs on leg 1. All axes
pass through O. Legs 2 and 3 are closed by tying the point t_k of the intermediate link
to that of the star. At the start all joint angles are 0 and all body frames are {B}.
"""

from __future__ import annotations

import math
from functools import cached_property
from typing import NamedTuple

import numpy as np

from sst_ros.dynamics import kernel
from sst_ros.dynamics.traced_dynamics import ODE, Dynamics
from sst_ros.integration.method_steps import MethodSteps
from sst_ros.integration.methods import DOP853
from sst_ros.integration.point import Drive
from sst_ros.mechanism import virtual_work
from sst_ros.mechanism.generic_math import rotation_rows
from sst_ros.mechanism.geometry import Array, Geometry, rotation_matrix
from sst_ros.scene import scene as scenes
from sst_ros.simulation.simulation import Simulation

DURATION = 1.0
JOINTS = ("g0", "m0", "b0", "g1", "m1", "g2", "m2")
"""Joints of the tree: gamma (g) and mu (m) of each leg.

The star hangs on leg 1 by beta (b).
"""

KINDS = {"g": 0, "m": 3, "b": 6}


class Pose(NamedTuple):
    """Where an engine has the mechanism: R of the star in {B}, and gamma [rad] of its
    own.
    """

    rotation: Array
    gamma: Array


class Moving(NamedTuple):
    """A state to compare accelerations at; joints as differences to the start.

    Attributes:
        time: [s].
        y: quaternion and body rate.
        position, velocity: of the tree's joints by name [rad, rad/s].
        torque: at that time [N m].
        answer: gamma_ddot of the paper's equations [rad/s^2].

    """

    time: float
    y: list[float]
    position: dict[str, float]
    velocity: dict[str, float]
    torque: Array
    answer: Array


class Task:
    """A scene with its torques as continuous functions of time, Example 2 by default.

    Attributes:
        frames: rotations at the start by body: s, a0..a2, i0..i2.
        tensors: inertias about O in these frames [kg m^2].
        w, r, t: axes at the start in {B}, rows by leg.

    """

    def __init__(self, scene: str = "example2_heavy") -> None:
        self.scene = scenes.load(scene)
        assert self.scene.torque is not None
        self.torque = self.scene.torque
        self.dynamics = Dynamics.of(self.scene)
        self.system = ODE(self.dynamics, self.torque)
        self.geometry = geometry = Geometry.of(self.scene)
        start = Simulation(self.scene).state
        self.start = [*start.quaternion, *start.body_rate]
        self.gamma = np.array(self.scene.initial.gamma)
        rotation = rotation_matrix(np.array(start.quaternion))
        across = np.cross(geometry.w, geometry.v)
        self.w, self.t = geometry.w, geometry.e @ rotation.T
        self.r = (
            np.cos(self.gamma)[:, None] * geometry.v
            + np.sin(self.gamma)[:, None] * across
        )
        self.frames = {"s": rotation}
        mechanism = virtual_work.Mechanism.of(self.scene)
        self.tensors = {"s": mechanism.star}
        for k in range(3):
            r, w, t = self.r[k], self.w[k], self.t[k]
            self.frames[f"a{k}"] = np.stack([r, np.cross(w, r), w], 1)
            self.frames[f"i{k}"] = np.stack([r, np.cross(t, r), t], 1)
            self.tensors[f"a{k}"] = mechanism.actuated[k]
            self.tensors[f"i{k}"] = mechanism.intermediate[k]

    def tensor(self, body: str) -> Array:
        """Inertia about O at the start in {B}."""
        frame = self.frames[body]
        return np.asarray(frame @ self.tensors[body] @ frame.T)

    def sines(self) -> list[tuple[float, float, float]]:
        """Amplitude [N m], frequency [rad/s] and phase [rad] of each torque."""
        torque = self.torque
        return list(zip(torque.amplitude, torque.frequency, torque.phase, strict=True))

    def torque_at(self, time: float) -> list[float]:
        """Torques [N m]."""
        return [a * math.sin(f * time + p) for a, f, p in self.sines()]

    def pose_of(self, y: list[float]) -> Pose:
        """Pose of a state (q, W)."""
        gamma = np.array(self.dynamics.joints(*y[:7])[:3])
        return Pose(rotation_matrix(np.array(y[:4])), gamma)

    def kernel_answer(self, y: list[float], torque: Array) -> Array:
        """gamma_ddot [rad/s^2] of the kernel that sst_ros runs."""
        rate = np.array(self.dynamics.derivative(*y, *torque)[4:7])
        q0, q1, q2, q3, w0, w1, w2 = y[:7]
        rows, body_rate = rotation_rows((q0, q1, q2, q3)), (w0, w1, w2)
        legs = [
            kernel.leg_motion(leg, rows, body_rate) for leg in self.dynamics.model.legs
        ]
        at_rest = [kernel.rest_accelerations(at, body_rate)[1] for at in legs]
        answer: Array = np.array([at.g for at in legs]) @ rate + at_rest
        return answer

    @cached_property
    def moving(self) -> list[Moving]:
        """States of the motion itself, well after its start."""
        steps = MethodSteps(self.system, DOP853)
        return [
            self._moving(time, steps.fixed(0.0, time / 50, 50, self.start, Drive(())))
            for time in (0.21, 0.53, 0.87)
        ]

    def _moving(self, time: float, y: list[float]) -> Moving:
        first, now = (
            np.array(self.dynamics.joints(*state)) for state in (self.start, y)
        )
        turn = now[:9] - first[:9]
        turn -= 2.0 * np.pi * np.round(turn / (2.0 * np.pi))
        places = {joint: KINDS[joint[0]] + int(joint[1]) for joint in JOINTS}
        posture = virtual_work.posture(
            self.geometry, now[:3], rotation_matrix(np.array(y[:4]))
        )
        mechanism = virtual_work.Mechanism.of(self.scene)
        torque = np.array(self.torque_at(time))
        answer = virtual_work.direct_dynamics(mechanism, posture, now[9:12], torque)
        return Moving(
            time,
            y,
            {joint: float(turn[place]) for joint, place in places.items()},
            {joint: float(now[9 + place]) for joint, place in places.items()},
            torque,
            answer,
        )


def turn_between(first: Array, second: Array) -> float:
    """Angle [rad] between two rotations, accurate when it is small."""
    e = first @ second.T
    sine = 0.5 * np.array([e[2, 1] - e[1, 2], e[0, 2] - e[2, 0], e[1, 0] - e[0, 1]])
    return float(np.arctan2(np.linalg.norm(sine), 0.5 * (np.trace(e) - 1.0)))


def find_relative(found: Array, expected: Array) -> float:
    """Length of the difference over the length of what is expected."""
    return float(
        np.linalg.norm(np.asarray(found) - expected) / np.linalg.norm(expected)
    )


BASE = "base"


class Body(NamedTuple):
    """A body with the hinge that it hangs on; depth first, parents before children.

    Attributes:
        name, parent, joint: names.
        axis: of the hinge in {B}, through O.
        mass: [kg].
        centre: of mass in {B} [m].
        about_centre: inertia about the centre of mass in {B} [kg m^2].

    """

    name: str
    parent: str
    joint: str
    axis: Array
    mass: float
    centre: Array
    about_centre: Array


def list_bodies(task: Task) -> list[Body]:
    """All seven."""
    found = []
    for k in range(3):
        found.append(_body(task, f"a{k}", BASE, f"g{k}", task.w[k]))
        found.append(_body(task, f"i{k}", f"a{k}", f"m{k}", -task.r[k]))
        if k == 0:
            found.append(_body(task, "s", "i0", "b0", -task.t[0]))
    return found


def list_ties(task: Task) -> list[tuple[str, Array]]:
    """Bodies that are tied to the star, and the point in {B} at the start."""
    return [(f"i{k}", task.t[k]) for k in (1, 2)]


def _body(task: Task, name: str, parent: str, joint: str, axis: Array) -> Body:
    """Put the centre of mass off O: engines scale the softness of a tie by where it is.

    Without gravity only the inertia about O matters, so mass and centre are free: a
    point mass on the axis of the largest moment takes from the two smaller ones only.
    """
    tensor = task.tensor(name)
    moments, axes = np.linalg.eigh(tensor)
    least, middle, most = moments
    mass = 1.0
    centre = axes[:, 2] * np.sqrt(max(0.0, 0.2 * (least + middle - most)) / mass)
    central = tensor - mass * (centre @ centre * np.eye(3) - np.outer(centre, centre))
    return Body(name, parent, joint, axis, mass, centre, central)
