# SPDX-License-Identifier: Apache-2.0
"""Scenes and references of the catalogue of extreme cases."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import lru_cache
from typing import Any

import numpy as np

from sst_ros.errors import RunStopped
from sst_ros.mechanism.geometry import Array
from sst_ros.scene.loads import Initial, Stroke, Workspace
from sst_ros.scene.scene import Scene, load
from sst_ros.simulation.simulation import WHOLE_MOTION_BUDGET, Simulation
from studies.model_errors import heavier, scaled

Triple = tuple[float, float, float]

REST: Triple = (0.0, 0.0, 0.0)
FREE: dict[str, Any] = {
    "stroke": Stroke(at_end="ignore"),
    "workspace": Workspace(at_edge="ignore"),
}
PUSH: Triple = (0.4, 0.5, 0.3)


def base() -> Scene:
    """Return example 2."""
    return load("example2_heavy")


def spun(rate: float) -> Scene:
    """Set it going from a general posture, without ends."""
    initial = Initial(gamma=(0.7, 0.8, 0.75), gamma_dot=(rate, -0.5 * rate, 0.25 * rate))
    return replace(base(), initial=initial, **FREE)


@lru_cache(maxsize=1)
def reference() -> Simulation:
    """Run it by DOP853 at the tightest tolerance."""
    return ended(spun(2.0), PUSH, 20, 10_000_000)


@lru_cache(maxsize=1)
def turned() -> Simulation:
    """Run it without torque."""
    return ended(spun(10.0), REST, 10, 4_000_000)


@lru_cache(maxsize=1)
def bounced() -> Simulation:
    """Run the bounce off stops ten times as stiff."""
    scene = bouncing(Stroke(at_end="elastic", stiffness=1e9))
    return ended(scene, REST, 30, 10_000_000)


def bouncing(stroke: Stroke) -> Scene:
    """Send gamma_1 against the end of its stroke."""
    initial = Initial(gamma=(0.1, 0.5, 0.5), gamma_dot=(-1.0, 0.0, 0.0))
    return replace(base(), initial=initial, stroke=stroke, workspace=Workspace(at_edge="ignore"))


def ended(scene: Scene, torque: Triple, steps: int, period_ns: int) -> Simulation:
    """Run a scene by DOP853 at the tightest tolerance."""
    simulation = Simulation(scene, "dop853", tolerance=1e-14, step_budget=WHOLE_MOTION_BUDGET)
    for _ in range(steps):
        simulation.step(torque, period_ns)
    return simulation


def stop_time(scene: Scene, torque: Triple) -> float:
    """Time at which a run ends [s]."""
    try:
        ended(scene, torque, 10_000, 10_000_000)
    except RunStopped as error:
        return error.time
    raise ValueError("the run does not end")


def apart(one: Simulation, other: Simulation) -> float:
    """Angle between two orientations [rad]."""
    p, q = one.state.quaternion, other.state.quaternion
    return 2.0 * min(math.dist(p, q), math.dist(p, [-x for x in q]))


def from_reference(simulation: Simulation) -> float:
    """Angle from the end of the reference motion [rad]."""
    return apart(simulation, reference())


def energy_drift(simulation: Simulation) -> float:
    """Energy residual relative to the energy."""
    state, dynamics = simulation.state, simulation.dynamics
    drive = (0.0,) * len(dynamics.drive)
    kinetic, potential, _ = dynamics.energies(*state.quaternion, *state.body_rate, *drive)
    return abs(simulation.energy_residual) / (kinetic + potential)


def mass_matrix(scene: Scene) -> Array:
    """Mass matrix in gamma at the start of a scene at rest [kg m^2], from its accelerations."""
    dt_ns, columns = 1000, []
    for k in range(3):
        torque = (float(k == 0), float(k == 1), float(k == 2))
        simulation = Simulation(scene)
        simulation.step(torque, dt_ns)
        columns.append(np.array(simulation.state.joints.gamma_dot) / (1e-9 * dt_ns))
    return np.asarray(np.linalg.inv(np.stack(columns, axis=1)))


def with_inertias(star: float, links: float) -> Scene:
    """Scale the inertia of the star, and those of the links."""
    scene = heavier(spun(2.0), links)
    inertia = scaled(base().star.inertia, star)
    return replace(scene, star=replace(scene.star, inertia=inertia))


def free() -> Scene:
    """Return example 2 without ends."""
    return replace(base(), **FREE)


def from_stiffer_bounce(simulation: Simulation) -> float:
    """Energy lost, or a thousandth of the angle from the bounce off stiffer stops."""
    return max(apart(simulation, bounced()) / 1e3, energy_drift(simulation))
