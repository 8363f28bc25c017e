# SPDX-License-Identifier: Apache-2.0
"""What the links look like: arcs, rods, balls and boxes in the links' own frames.

URDF and the view draw these and nothing else. Thicknesses are for the eye; arcs and radii
are the scene's.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeAlias

import numpy as np

from sst_ros.description.tree import BASE, LEGS, STAR, actuated, intermediate
from sst_ros.mechanism.geometry import Array, Geometry
from sst_ros.scene.scene import Scene

Colour = tuple[float, float, float]

GLOBE: Colour = (0.93, 0.94, 0.96)
TRIANGLE: Colour = (0.35, 0.38, 0.42)
STAR_COLOUR: Colour = (0.90, 0.62, 0.00)
STEEL: Colour = (0.60, 0.63, 0.67)
LEG_COLOURS: tuple[Colour, Colour, Colour] = (
    (0.00, 0.45, 0.70),
    (0.84, 0.37, 0.00),
    (0.00, 0.62, 0.45),
)
"""Colours of legs 1 to 3 distinguishable with colour blindness (Okabe and Ito)."""

STEP = np.radians(6.0)
"""Arcs are drawn as chords of this length or less: 0.14 % of the radius off."""


@dataclass(frozen=True)
class Arc:
    """A round bar along a circular arc about O.

    Attributes:
        begin: unit vector to its first point, shape (3,).
        axis: unit vector that it turns about, perpendicular to `begin`, shape (3,).
        angle: its length [rad].
        radius: of the arc [m].
        thickness: radius of the bar [m].

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
    thick = 0.02 * base
    found = {BASE: _base(geometry, base, thick), STAR: _star(scene, geometry, thick)}
    x, z = np.eye(3)[[0, 2]]
    for k, leg in enumerate(LEGS):
        colour = LEG_COLOURS[k]
        # A quarter arc from the motor at w to the carriage at r, just above the base.
        middle = base + 1.5 * thick
        found[actuated(leg)] = [
            Arc(x, -np.eye(3)[1], np.pi / 2, middle, thick, colour),
            Rod(z * (base - thick), z * (middle + 2.0 * thick), 2.4 * thick, colour),
        ]
        found[intermediate(leg)] = [
            Rod(x * (base - thick), x * star, 0.9 * thick, STEEL),
            Box(star * x, 3.0 * thick * np.array([1.0, 1.3, 1.3]), colour),
        ]
    return found


def end_point(scene: Scene, star: Array) -> Array:
    """Position of E in {B} [m], shape (..., 3), of rotations of the star (..., 3, 3)."""
    return np.asarray(scene.star.radius * star[..., :, 2])


def _base(geometry: Geometry, radius: float, thick: float) -> list[Shape]:
    sides = zip(geometry.v, geometry.w, geometry.arc.tolist(), strict=True)
    return [
        Ball(np.zeros(3), radius - thick, GLOBE, 0.92),
        *(Arc(v, w, angle, radius, 0.7 * thick, TRIANGLE) for v, w, angle in sides),
        *(Ball(radius * v, 1.6 * thick, TRIANGLE) for v in geometry.v),
    ]


def _star(scene: Scene, geometry: Geometry, thick: float) -> list[Shape]:
    radius, z = scene.star.radius, np.array([0.0, 0.0, 1.0])
    reach = geometry.beta_max
    # In {E} the carriage k is at s turned about e by +beta.
    found: list[Shape] = [Arc(z, e, reach, radius, thick, STAR_COLOUR) for e in geometry.e]
    found.append(Ball(radius * z, 2.2 * thick, STAR_COLOUR))
    if scene.payload is not None:
        centre = np.array(scene.payload.centre)
        found.append(Rod(radius * z, centre, 0.8 * thick, STEEL))
        found.append(Ball(centre, 2.8 * thick, STEEL))
    return found
