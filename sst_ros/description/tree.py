# SPDX-License-Identifier: Apache-2.0
"""The manipulator as a tree of links and joints, as URDF and the view see it.

    base_link -gamma_k- actuated_k -mu_k- intermediate_k -beta_1- star
                                                         -beta_2- star_from_2
                                                         -beta_3- star_from_3

All joints turn about axes through O, so every frame has its origin there and a pose is a rotation.
The star is attached to leg 1. Legs 2 and 3 end in a frame without a body: {E} as that leg sees it.
The loops are closed where the three are one.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np

from sst_ros.description.headers import BASE_FRAME
from sst_ros.mechanism.geometry import Array, Geometry

BASE, STAR = BASE_FRAME, "star"
LEGS = (1, 2, 3)
STARS = (STAR, "star_from_2", "star_from_3")
"""{E} as seen from legs 1, 2 and 3."""


@dataclass(frozen=True)
class Joint:
    """A joint: child = parent * origin * rotation about the axis by the angle.

    Attributes:
        name: as in joint_states.
        parent, child: links.
        origin: rotation of the joint's frame in that of the parent, shape (3, 3).
        axis: unit vector in the joint's frame, shape (3,).

    """

    name: str
    parent: str
    child: str
    origin: Array
    axis: tuple[float, float, float]

    def rotation(self, angle: float) -> Array:
        """Rotation of the child in its parent at an angle [rad], shape (3, 3)."""
        x, y, z = self.axis
        across = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
        turn = np.eye(3) + np.sin(angle) * across + (1.0 - np.cos(angle)) * across @ across
        return np.asarray(self.origin @ turn)


def tree(geometry: Geometry) -> tuple[Joint, ...]:
    """All nine joints, parents before children; signs are those of Eqs. 50 to 52."""
    return tuple(joint for k in range(3) for joint in _leg(geometry, k))


def actuated(leg: int) -> str:
    """Name of the actuated link of a leg, 1 to 3; its frame is {1k} = [r, w x r, w]."""
    return f"actuated_{leg}"


def intermediate(leg: int) -> str:
    """Name of the intermediate link of a leg, 1 to 3; its frame is {2k} = [r, t x r, t]."""
    return f"intermediate_{leg}"


def rotations(joints: Iterable[Joint], angles: Mapping[str, float]) -> dict[str, Array]:
    """Rotation of every link in {B}, each shape (3, 3), by the angles of the joints [rad]."""
    found: dict[str, Array] = {BASE: np.eye(3)}
    for joint in joints:
        found[joint.child] = found[joint.parent] @ joint.rotation(angles[joint.name])
    return found


def _leg(geometry: Geometry, k: int) -> tuple[Joint, Joint, Joint]:
    v, w, e = geometry.v[k], geometry.w[k], geometry.e[k]
    base = np.stack([v, np.cross(w, v), w], axis=1)  # 0kR at gamma = 0
    # At beta = 0 the arc's end s lies at r: in {E} the vectors of {2k} are z, e x z and e.
    z = np.array([0.0, 0.0, 1.0])
    star = np.stack([z, np.cross(e, z), e], axis=1).T
    back = (-float(e[0]), -float(e[1]), -float(e[2]))
    leg = LEGS[k]
    return (
        Joint(f"gamma_{leg}", BASE, actuated(leg), base, (0.0, 0.0, 1.0)),
        Joint(f"mu_{leg}", actuated(leg), intermediate(leg), np.eye(3), (-1.0, 0.0, 0.0)),
        Joint(f"beta_{leg}", intermediate(leg), STARS[k], star, back),
    )
