# SPDX-License-Identifier: Apache-2.0
"""Scenes and torques of the extreme cases: `example2_heavy` with values by key."""

from __future__ import annotations

import math
import random
from collections.abc import Mapping
from dataclasses import asdict
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from sst_ros.dynamics import kernel
from sst_ros.mechanism import kinematics, workspace
from sst_ros.mechanism.geometry import Array, Geometry, quaternion_of
from sst_ros.scene.scene import Scene, load
from sst_ros.simulation.simulation import Simulation
from sst_ros.state import Vector3
from studies.sampled_data import pole

Changes = Mapping[str, Any]

MS = 1_000_000
RIGHT, QUARTER = math.pi / 2, math.pi / 4
REST: Vector3 = (0.0, 0.0, 0.0)
PUSH: Vector3 = (0.4, 0.5, 0.3)
POSE: Vector3 = (0.7, 0.8, 0.75)
UNBOUNDED: Changes = {"workspace": {"at_edge": "ignore"}}
FREE: Changes = {"stroke": {"at_end": "ignore"}, **UNBOUNDED}
SINGULAR: Changes = {**FREE, "star.alpha_deg": (210, 75, 75)}
"""Parallel singularities inside the workspace, limits ignored."""
RESTS: Vector3 = (0.9, 0.7, 0.8)
"""Where the springs of `sprung` hold the actuators [rad]."""
BREAKAWAY, CREEP_PUSH = 2.0, (0.3, 0.4, 0.2)
"""Static friction, and torques below it [N m]."""


def changed(changes: Changes, base: str = "example2_heavy") -> Scene:
    """Return a shipped scene with other values by key."""
    return load(base).with_values(changes)


def start(
    gamma: Vector3, gamma_dot: Vector3 = REST, orientation: ArrayLike | None = None
) -> Changes:
    """Start at angles [rad] and rates [rad/s], in an assembly near an orientation."""
    initial: dict[str, Any] = {"gamma": gamma, "gamma_dot": gamma_dot}
    return {
        "initial": initial
        if orientation is None
        else {**initial, "orientation": orientation}
    }


def spun(rate: float) -> Changes:
    """Set it going from a general posture, without ends."""
    return {**start(POSE, (rate, -0.5 * rate, 0.25 * rate)), **FREE}


def bouncing(stiffness: float) -> Changes:
    """Send gamma_1 against the elastic end of its stroke."""
    stroke = {"at_end": "elastic", "stiffness": stiffness}
    return {**start((0.1, 0.5, 0.5), (-1.0, 0.0, 0.0)), "stroke": stroke, **UNBOUNDED}


def bouncing_thrice(stiffness: float, rate: float) -> Changes:
    """Send all three actuators against their stops at once."""
    at = start((QUARTER, QUARTER, QUARTER), (rate, rate, rate))
    return {**bouncing(stiffness), **at}


def inertias(star: float, links: float) -> Changes:
    """Scale the inertia of the star, and those of the links."""
    scene = load("example2_heavy")
    bodies = {
        "star": (scene.star, star),
        "actuated_links": (scene.actuated_links[0], links),
        "intermediate_links": (scene.intermediate_links[0], links),
    }
    return {
        f"{name}.inertia": {
            key: factor * value for key, value in asdict(body.inertia).items()
        }
        for name, (body, factor) in bodies.items()
        if body.inertia is not None
    }


def massless_links(scale: float) -> Changes:
    """Leave inertia to the star alone, scaled."""
    star = {"xx": scale * 0.39, "yy": scale * 0.39, "zz": scale * 0.26}
    return {"star.inertia": star, "actuated_links.inertia": None,
            "intermediate_links.inertia": None}  # fmt: skip


def sprung(stiffness: float, damping: float) -> Changes:
    """Hold the actuators by springs towards RESTS, against viscous friction."""
    springs = [
        {"joint": f"gamma_{k + 1}", "stiffness": stiffness, "rest": rest}
        for k, rest in enumerate(RESTS)
    ]
    return {"friction": {"gamma": {"viscous": damping}}, "springs": springs}


@cache
def singular_pose() -> Array:
    """Return a rotation R with det J2 = 0 of the scene SINGULAR, shape (3, 3)."""
    geometry = Geometry.of(changed(SINGULAR))
    chart = workspace.over_orientations(
        geometry, workspace.triangle_directions(geometry, 12)[0]
    )
    poses = workspace.parallel_singularities(chart)
    return np.asarray(poses.rotation[len(poses) // 2])


def about_e(angle: float) -> Array:
    """Return the rotation about OE by an angle [rad]."""
    c, s = math.cos(angle), math.sin(angle)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def near_singularity(angle: float, spin: float) -> Changes:
    """Start `angle` [rad] from a singular pose, turning at a rate [rad/s].

    Both are about OE.
    """
    scene, rotation = changed(SINGULAR), singular_pose() @ about_e(angle)
    gamma, _, _ = kinematics.inverse(Geometry.of(scene), rotation)
    quaternion = quaternion_of(rotation)
    x, y, z, w = quaternion.tolist()
    rates = kernel.joints(
        kernel.model_of(scene), (x, y, z, w, 0.0, 0.0, spin)
    ).gamma_dot
    a, b, c = gamma.tolist()
    p, q, r = (float(rate) for rate in rates)
    return {**SINGULAR, **start((a, b, c), (p, q, r), quaternion)}


def at_edge(beta: float) -> Changes:
    """Start where E has the distance beta [rad] from the arc P1 P2, to first order."""
    geometry = Geometry.of(changed({}))
    chart = workspace.over_orientations(geometry, [[1.0, 0.9, 1e-3]], turns=60)
    psi = chart.psi[np.flatnonzero(chart.measures.admissible[0])[0]]

    def gamma_beta(height: float) -> tuple[Array, float]:
        s = np.array([1.0, 0.9, height])
        rotation = workspace.orientations(s[None] / np.linalg.norm(s), np.array([psi]))[
            0
        ]
        gamma, _, found = kinematics.inverse(geometry, rotation)
        return gamma, float(found[0])

    slope = gamma_beta(1e-6)[1] / 1e-6
    a, b, c = gamma_beta(beta / slope)[0].tolist()
    return start((a, b, c))


def at_largest_beta(off: float) -> Changes:
    """Start `off` [rad] inside the largest beta."""
    beta = max(Simulation(changed(start(POSE))).state.joints.beta)
    return {**start(POSE), "workspace": {"beta_max_deg": math.degrees(beta + off)}}


def at_the_pole(rate: Vector3) -> Changes:
    """Rotate the base so that its centre, where E starts, is z of {B}: phi = 0."""
    x = np.array([1.0, -1.0, 0.0]) / math.sqrt(2.0)
    z = np.full(3, math.sqrt(1.0 / 3.0))
    turn = np.stack([x, np.cross(z, x), z])
    return {**FREE, **start((QUARTER, QUARTER, QUARTER), rate), "base.v": turn.T}


def in_triangle(v: ArrayLike) -> Changes:
    """Take a base triangle, and go from the middle of its arcs.

    Rates are in proportion to the arcs.
    """
    geometry = Geometry.of(changed({"base.v": v}))
    a, b, c = (0.5 * float(arc) for arc in geometry.arc)
    return {**FREE, "base.v": v, **start((a, b, c), (0.1 * a, 0.2 * b, -0.1 * c))}


def small_triangle(spread: float) -> Changes:
    """Return a base triangle whose corners are `spread` [rad] from its centre."""
    centre, v = np.full(3, math.sqrt(1.0 / 3.0)), []
    for corner in np.eye(3):
        away = corner - centre * (centre @ corner)
        v.append(
            centre * math.cos(spread) + away / np.linalg.norm(away) * math.sin(spread)
        )
    return in_triangle(v)


def short_arc(degrees: float) -> Changes:
    """Return a base of whose three arcs one is that short.

    The others are a right angle.
    """
    angle = math.radians(degrees)
    v = ((1.0, 0.0, 0.0), (math.cos(angle), math.sin(angle), 0.0), (0.0, 0.0, 1.0))
    return in_triangle(v)


def pushed(scale: float) -> Vector3:
    """Return the torques of the reference motion times `scale` [N m]."""
    a, b, c = PUSH
    return (a * scale, b * scale, c * scale)


def noise(k: int, _: Any) -> Vector3:
    """Return reproducible noise of 1 N m for period k."""
    generator = random.Random(k)
    return (
        generator.gauss(0.0, 1.0),
        generator.gauss(0.0, 1.0),
        generator.gauss(0.0, 1.0),
    )


def square_wave(k: int, _: Any) -> Vector3:
    """Return torques that jump by twice their size every second period."""
    sign = 1.0 if k % 4 < 2 else -1.0
    return (2.0 * sign, -1.5 * sign, 1.0 * sign)


PD_RATE = 100.0
"""Bandwidth of the sampled PD control [rad/s]; its damping ratio is 1."""


OFF_POSE: Changes = {**FREE, **start((0.7 + 1e-7, 0.8 - 1e-7, 0.75 + 2e-7))}


class SampledPd:
    """PD control with bandwidth x period = `product` [rad], held over each period.

    Its gains are the mass matrix at the pose times bandwidth^2 and 2 x bandwidth, so
    that theory is the sampled double integrator: errors grow by `sampled_data.pole` a
    period.
    """

    def __init__(self, product: float) -> None:
        self.pole, self.period_ns = (
            pole(product, 1.0, 0),
            round(product / PD_RATE * 1e9),
        )
        self._inertia = mass_matrix(changed(OFF_POSE))
        self._sizes: list[float] = []

    def __call__(self, k: int, simulation: Simulation) -> Vector3:
        """Return the torques of period k, and keep the error's size at its start."""
        joints = simulation.state.joints
        off, rate = joints.gamma - np.array(POSE), np.array(joints.gamma_dot)
        if k == 0:
            self._sizes.clear()
        self._sizes.append(math.hypot(*off, *(rate / PD_RATE)))
        torque = -self._inertia @ (PD_RATE**2 * off + 2.0 * PD_RATE * rate)
        first, second, third = torque.tolist()
        return (first, second, third)

    def from_pole(self, *_: Any) -> float:
        """Return how far a period's growth, in the second half, is from the pole."""
        half = len(self._sizes) // 2
        found: float = (self._sizes[-1] / self._sizes[-1 - half]) ** (1.0 / half)
        return abs(found - self.pole)


def mass_matrix(scene: Scene) -> Array:
    """Mass matrix in gamma at the start of a scene at rest [kg m^2].

    It is found from accelerations of the scene.
    """
    rates = [
        Simulation(scene).step(torque, 1000).joints.gamma_dot
        for torque in ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
    ]
    return np.asarray(np.linalg.inv(np.transpose(rates) / 1e-6))
