# SPDX-License-Identifier: Apache-2.0
"""Scenes for the tests of integration."""

from __future__ import annotations

import math
from dataclasses import replace

from sst_ros.scene.bodies import Stroke, Workspace
from sst_ros.scene.loads import Actuators, Friction, JointFriction, Moment, Spring
from sst_ros.scene.scene import Scene, load
from sst_ros.simulation.simulation import Simulation

REST = (0.0, 0.0, 0.0)
IGNORE = {"stroke": Stroke(at_end="ignore"), "workspace": Workspace(at_edge="ignore")}


def loaded() -> Scene:
    """General inertia and every term there is."""
    general, friction, hung = load("general"), load("friction"), load("gravity_payload")
    return replace(
        general,
        star=replace(general.star, mass=2.6, centre=(0.0, 0.0, 0.25)),
        gravity=hung.gravity,
        payload=hung.payload,
        springs=hung.springs,
        friction=friction.friction,
        moment=Moment(topic=True),
        actuators=Actuators(
            rotor_inertia=1e-4, gear_ratio=10.0, torque_limit=4.0, time_constant=5e-3
        ),
        stroke=Stroke(at_end="elastic", stiffness=2e3, damping=0.5),
    )


def viscous(coefficient: float, stiffness: float = 500.0) -> Scene:
    """Springs at the actuators of example2_heavy against viscous friction."""
    rests = (0.9, 0.7, 0.8)
    springs = [
        Spring(joint=f"gamma_{k + 1}", stiffness=stiffness, rest=rest)
        for k, rest in enumerate(rests)
    ]
    friction = JointFriction(gamma=Friction(viscous=coefficient))
    return replace(load("example2_heavy"), friction=friction, springs=tuple(springs))


def start_of(scene: Scene, size: int = 7) -> list[float]:
    """Quaternion and body rate at the start, and zeros for what else the state has."""
    state = Simulation(scene).state
    return [*state.quaternion, *state.body_rate, *(0.0,) * (size - 7)]


def run(
    simulation: Simulation, seconds: float, period: float, torque=REST
) -> Simulation:
    """Step through a time.

    `torque` may be three numbers or a function, held over each period.
    """
    count = round(seconds / period)
    for k in range(count):
        now = torque((k + 0.5) * period) if callable(torque) else torque
        simulation.step(now, round(period * 1e9))
    return simulation


def apart(one: Simulation, other: Simulation) -> tuple[float, float]:
    """Angle between orientations [rad], distance of body rates [rad/s]."""
    p, q = one.state.quaternion, other.state.quaternion
    near = min(math.dist(p, q), math.dist(p, [-x for x in q]))
    return 2.0 * near, math.dist(one.state.body_rate, other.state.body_rate)
