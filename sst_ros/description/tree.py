# SPDX-License-Identifier: Apache-2.0
"""The manipulator as links and joints, and what the links look like, for URDF and the view.

    base_link -gamma_k- actuated_k -mu_k- intermediate_k -beta_1- star
                                                         -beta_2- star_from_2
                                                         -beta_3- star_from_3

All joints turn about axes through O, so every frame has its origin there and a pose is a rotation.
The star is attached to leg 1. Legs 2 and 3 end in a frame without a body: {E} as that leg sees it.
The loops are closed where the three are one. Links are drawn as arcs, rods, balls and boxes in
their own frames; thicknesses are for the eye, arcs and radii are the scene's.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np

from sst_ros.mechanism.geometry import Array, Geometry
from sst_ros.scene.scene import Scene
from sst_ros.state import BASE_FRAME

BASE, STAR = BASE_FRAME, "star"
LEGS = (1, 2, 3)
STARS = (STAR, "star_from_2", "star_from_3")  # {E} as seen from legs 1, 2 and 3
ACTUATED = ("actuated_1", "actuated_2", "actuated_3")
"""Links with the frames {1k} = [r, w x r, w] of the legs."""
INTERMEDIATE = ("intermediate_1", "intermediate_2", "intermediate_3")
"""Links with the frames {2k} = [r, t x r, t] of the legs."""

Colour: TypeAlias = tuple[float, float, float]
GLOBE: Colour = (0.93, 0.94, 0.96)
TRIANGLE: Colour = (0.35, 0.38, 0.42)
STAR_COLOUR: Colour = (0.90, 0.62, 0.00)
STEEL: Colour = (0.60, 0.63, 0.67)
LEG_COLOURS: tuple[Colour, ...] = ((0.00, 0.45, 0.70), (0.84, 0.37, 0.00), (0.00, 0.62, 0.45))
"""Colours of legs 1 to 3 distinguishable with colour blindness (Okabe and Ito)."""

STEP = np.radians(6.0)  # arcs are drawn as chords of this length or less: 0.14 % of the radius off


@dataclass(frozen=True)
class Joint:
    """A joint between two links, named as in joint_states.

    child = parent * origin * rotation about the axis by the angle, with the origin, shape (3, 3), a
    rotation in the frame of the parent, and the axis a unit vector in the joint's frame.
    """

    name: str
    parent: str
    child: str
    origin: Array
    axis: tuple[float, float, float]

    def rotation(self, angle: float) -> Array:
        """Rotation of the child in its parent at an angle [rad], shape (3, 3)."""
        across = np.cross(np.eye(3), np.array(self.axis))
        turn = np.eye(3) + np.sin(angle) * across + (1.0 - np.cos(angle)) * across @ across
        return np.asarray(self.origin @ turn)


def tree(geometry: Geometry) -> tuple[Joint, ...]:
    """All nine joints, parents before children; signs are those of Eqs. 50 to 52."""
    z, found = np.array([0.0, 0.0, 1.0]), []
    legs = zip(LEGS, geometry.v, geometry.w, geometry.e, ACTUATED, INTERMEDIATE, STARS, strict=True)
    for leg, v, w, e, actuated, intermediate, star in legs:
        at_rest = np.stack([v, np.cross(w, v), w], axis=1)  # 0kR at gamma = 0
        # At beta = 0 the arc's end s lies at r: in {E} the vectors of {2k} are z, e x z and e.
        folded = np.stack([z, np.cross(e, z), e], axis=1).T
        back = (-float(e[0]), -float(e[1]), -float(e[2]))
        found += [
            Joint(f"gamma_{leg}", BASE, actuated, at_rest, (0.0, 0.0, 1.0)),
            Joint(f"mu_{leg}", actuated, intermediate, np.eye(3), (-1.0, 0.0, 0.0)),
            Joint(f"beta_{leg}", intermediate, star, folded, back),
        ]
    return tuple(found)


def rotations(joints: Iterable[Joint], angles: Mapping[str, float]) -> dict[str, Array]:
    """Rotation of every link in {B}, each shape (3, 3), by the angles of the joints [rad]."""
    found: dict[str, Array] = {BASE: np.eye(3)}
    for joint in joints:
        found[joint.child] = found[joint.parent] @ joint.rotation(angles[joint.name])
    return found


@dataclass(frozen=True)
class Arc:
    """A round bar along a circular arc about O, `thickness` its radius [m].

    From the unit vector `begin` it turns by an angle [rad] about `axis`, a unit vector
    perpendicular to it; `radius` is that of the arc [m].
    """

    begin: Array
    axis: Array
    angle: float
    radius: float
    thickness: float
    colour: Colour

    def points(self) -> Array:
        """Points along the arc, STEP apart or less, shape (n, 3) [m]."""
        count = max(2, int(np.ceil(self.angle / STEP)) + 1)
        angles = np.linspace(0.0, self.angle, count)[:, None]
        across = np.cross(self.axis, self.begin)
        return np.asarray(self.radius * (np.cos(angles) * self.begin + np.sin(angles) * across))


@dataclass(frozen=True)
class Rod:
    """A straight round bar between two points, shape (3,) [m]; `thickness` is its radius [m]."""

    begin: Array
    end: Array
    thickness: float
    colour: Colour


@dataclass(frozen=True)
class Ball:
    """A ball; centre, shape (3,) [m]."""

    centre: Array
    radius: float
    colour: Colour
    opacity: float = 1.0


@dataclass(frozen=True)
class Box:
    """A box with sides along the axes of its link; size and centre, shape (3,) [m]."""

    centre: Array
    size: Array
    colour: Colour


Shape: TypeAlias = "Arc | Rod | Ball | Box"


def shapes(scene: Scene) -> dict[str, list[Shape]]:
    """Return the shapes of every link that has some, by the link's name."""
    geometry = Geometry.of(scene)
    base, star = scene.base.radius, scene.star.radius
    thick, (x, y, z) = 0.02 * base, np.eye(3)
    sides = zip(geometry.v, geometry.w, geometry.arc.tolist(), strict=True)
    found: dict[str, list[Shape]] = {
        BASE: [
            Ball(np.zeros(3), base - thick, GLOBE, 0.92),
            *(Arc(v, w, angle, base, 0.7 * thick, TRIANGLE) for v, w, angle in sides),
            *(Ball(base * v, 1.6 * thick, TRIANGLE) for v in geometry.v),
        ],
        # In {E} the carriage k is at s turned about e by +beta.
        STAR: [
            *(Arc(z, e, geometry.beta_max, star, thick, STAR_COLOUR) for e in geometry.e),
            Ball(star * z, 2.2 * thick, STAR_COLOUR),
        ],
    }
    if scene.payload is not None:
        centre = np.array(scene.payload.centre)
        rod = Rod(star * z, centre, 0.8 * thick, STEEL)
        found[STAR] += [rod, Ball(centre, 2.8 * thick, STEEL)]
    for actuated, intermediate, colour in zip(ACTUATED, INTERMEDIATE, LEG_COLOURS, strict=True):
        # A quarter arc from the motor at w to the carriage at r, just above the base.
        middle = base + 1.5 * thick
        found[actuated] = [
            Arc(x, -y, np.pi / 2, middle, thick, colour),
            Rod(z * (base - thick), z * (middle + 2.0 * thick), 2.4 * thick, colour),
        ]
        found[intermediate] = [
            Rod(x * (base - thick), x * star, 0.9 * thick, STEEL),
            Box(star * x, 3.0 * thick * np.array([1.0, 1.3, 1.3]), colour),
        ]
    return found


def end_point(scene: Scene, star: Array) -> Array:
    """Position of E in {B} [m], shape (..., 3), of rotations of the star (..., 3, 3)."""
    return np.asarray(scene.star.radius * star[..., :, 2])
