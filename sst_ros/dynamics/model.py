# SPDX-License-Identifier: Apache-2.0
"""The constants of a scene that the kernel computes with."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from sst_ros.dynamics import loads
from sst_ros.dynamics.loads import LegLoads
from sst_ros.mechanism.geometry import Geometry
from sst_ros.mechanism.vec3 import ZERO, Triple, cross
from sst_ros.scene.scene import Payload, Scene, Star


class Leg(NamedTuple):
    """Constants of one leg: axis w and start v of the arc in {B}, axis (e0, e1, 0) in {E}.

    A = A0 + A2 a^2 - 2 Iyz a sqrt(u) and C = Ixz a/sqrt(u) - Ixy, with A0 = I_a(zz) + Iyy - Ixx and
    A2 = Izz - Iyy + Ixx.
    """

    w: Triple
    v: Triple
    across: Triple
    e0: float
    e1: float
    a0: float
    a2: float
    ixy: float
    ixz: float
    iyz: float
    loads: LegLoads | None


class Model(NamedTuple):
    """All constants of the dynamics.

    Attributes:
        star: inertia (xx, yy, zz, xy, xz, yz) in {E} of star, payload and what of the intermediate
            links turns with the star [kg m^2].
        legs: the three legs.
        gravity: acceleration of free fall in {B} [m/s^2]; None without gravity.
        weight: mass times centre of star and payload in {E} [kg m].
        moment: constant external moment on the star in {B} [N m]; None without one.
        time_constant: lag of the actuators [s]; None without one.

    """

    star: tuple[float, float, float, float, float, float]
    legs: tuple[Leg, Leg, Leg]
    gravity: Triple | None = None
    weight: Triple = ZERO
    moment: Triple | None = None
    time_constant: float | None = None


def model_of(scene: Scene, geometry: Geometry | None = None) -> Model:
    """Collect the constants of a scene; its geometry may be given where it is known."""
    geometry, star = geometry or Geometry.of(scene), scene.star_inertia
    drives, links = scene.actuated_inertias, scene.intermediate_inertias
    legs = []
    for k in range(3):
        w, v, e = (tuple(row[k].tolist()) for row in (geometry.w, geometry.v, geometry.e))
        link, drive_zz = links[k], float(drives[k][2, 2])
        xx, yy, zz = (float(link[i, i]) for i in range(3))
        xy, xz, yz = float(link[0, 1]), float(link[0, 2]), float(link[1, 2])
        constants = (drive_zz + yy - xx, zz - yy + xx, xy, xz, yz)
        star = star + xx * (np.eye(3) - np.outer(geometry.e[k], geometry.e[k]))
        legs.append(
            Leg(w, v, cross(w, v), e[0], e[1], *constants, loads.of_leg(scene, geometry, k))
        )
    carried: list[Star | Payload] = [scene.star]
    if scene.payload is not None:
        carried.append(scene.payload)
    weight = [sum(body.mass * body.centre[i] for body in carried) for i in range(3)]
    pairs = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))
    xx, yy, zz, xy, xz, yz = (float(star[i]) for i in pairs)
    return Model(
        star=(xx, yy, zz, xy, xz, yz),
        legs=(legs[0], legs[1], legs[2]),
        gravity=None if scene.gravity is None else scene.gravity.acceleration,
        weight=(weight[0], weight[1], weight[2]),
        moment=None if scene.moment is None else scene.moment.value,
        time_constant=None if scene.actuators is None else scene.actuators.time_constant,
    )
