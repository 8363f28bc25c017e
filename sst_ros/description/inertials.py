# SPDX-License-Identifier: Apache-2.0
"""Mass, centre of mass and tensor of every body of the tree, from the scene.

A scene gives inertias about O, and a mass only where something weighs. Formats of other programs
want a mass. Where the scene has none, the centre is put at O, about which everything turns: the
motion is then the same for any mass, under gravity too. The mass written is the one that would have
this tensor on the sphere of its link, trace / (2 radius^2).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sst_ros.description.tree import LEGS, STAR, actuated, intermediate
from sst_ros.mechanism.geometry import Array
from sst_ros.scene.bodies import Inertia, Payload
from sst_ros.scene.scene import Scene, Vector

PAYLOAD = "payload"


@dataclass(frozen=True)
class Body:
    """A rigid body that is fixed to a link.

    Attributes:
        name: its own; the link's where it is the link.
        link: of the tree, whose frame all vectors are in.
        mass: [kg].
        centre: of mass [m], shape (3,).
        tensor: about the centre of mass [kg m^2], shape (3, 3).
        assumed: the scene has no mass for it.

    """

    name: str
    link: str
    mass: float
    centre: Array
    tensor: Array
    assumed: bool = False


def bodies(scene: Scene) -> list[Body]:
    """All bodies that have mass or inertia."""
    star, base = scene.star, scene.base
    found = [_body(STAR, star.mass, star.centre, star.inertia, star.radius)]
    if scene.payload is not None:
        found.append(_payload(scene.payload))
    for k, leg in enumerate(LEGS):
        for name, link, radius in (
            (actuated(leg), scene.actuated_links[k], base.radius),
            (intermediate(leg), scene.intermediate_links[k], star.radius),
        ):
            if link.mass or link.inertia is not None:
                found.append(_body(name, link.mass, link.centre, link.inertia, radius))
        if scene.actuators is not None and scene.actuators.rotor_inertia:
            found.append(_rotor(scene, leg))
    return found


def _body(name: str, mass: float, centre: Vector, inertia: Inertia | None, radius: float) -> Body:
    about_o = np.zeros((3, 3)) if inertia is None else inertia.matrix
    if mass == 0.0:
        return Body(name, name, _mass(about_o, radius), np.zeros(3), about_o, assumed=True)
    c = np.array(centre)
    return Body(name, name, mass, c, about_o - mass * (c @ c * np.eye(3) - np.outer(c, c)))


def _payload(payload: Payload) -> Body:
    tensor = np.zeros((3, 3)) if payload.inertia is None else payload.inertia.matrix
    return Body(PAYLOAD, STAR, payload.mass, np.array(payload.centre), tensor)


def _rotor(scene: Scene, leg: int) -> Body:
    """Return a rotor behind its gear as a thin disc: only its inertia about w matters."""
    assert scene.actuators is not None
    behind = scene.actuators.gear_ratio**2 * scene.actuators.rotor_inertia
    tensor = np.diag([behind / 2.0, behind / 2.0, behind])
    mass = _mass(tensor, scene.base.radius)
    return Body(f"rotor_{leg}", actuated(leg), mass, np.zeros(3), tensor, assumed=True)


def _mass(tensor: Array, radius: float) -> float:
    return float(np.trace(tensor)) / (2.0 * radius**2)
