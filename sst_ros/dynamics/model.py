# SPDX-License-Identifier: Apache-2.0
"""The constants of a scene that the kernel computes with, and the torques of its loads at joints.

Loads are gravity, friction, springs and elastic stops. Every function of them is for one leg and
returns Python's 0.0 for what the scene does not have, which leaves nothing behind in a traced
program (`trace`).
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from sst_ros.mechanism.generic_math import (
    ZERO,
    Rows,
    Scalar,
    Symmetric,
    Triple,
    atan2,
    cross,
    dot,
    exp,
    positive,
    sqrt,
    tanh,
    triple,
)
from sst_ros.mechanism.geometry import Geometry
from sst_ros.scene.scene import Friction, Inertia, Link, Payload, Scene, Star, Stroke


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

    star: Symmetric
    legs: tuple[Leg, Leg, Leg]
    gravity: Triple | None = None
    weight: Triple = ZERO
    moment: Triple | None = None
    time_constant: float | None = None


class JointSpring(NamedTuple):
    """All springs of one joint as one: torque -stiffness (angle - rest)."""

    stiffness: float
    rest: float


class ElasticStops(NamedTuple):
    """Elastic stops at the ends of the stroke, 0 and arc."""

    arc: float
    stiffness: float
    damping: float


class LegLoads(NamedTuple):
    """Loads of one leg; None or zero where the scene has none.

    Attributes:
        friction: of the joints gamma, mu, beta.
        springs: at the joints gamma, mu, beta.
        drive: mass times centre of the actuated link in {1k} [kg m].
        link: mass times centre of the intermediate link in {2k} [kg m].
        stops: elastic stops of the stroke.

    """

    friction: tuple[Friction | None, Friction | None, Friction | None]
    springs: tuple[JointSpring | None, JointSpring | None, JointSpring | None]
    drive: Triple
    link: Triple
    stops: ElasticStops | None


def model_of(scene: Scene, geometry: Geometry | None = None) -> Model:
    """Collect the constants of a scene; its geometry may be given where it is known.

    The numbers of the scene and its geometry may be columns, of many scenes at once.
    """
    geometry, star = geometry or Geometry.of(scene), _star(scene)
    legs = []
    for k in range(3):
        w, v, e = (tuple(geometry.of_leg(name, k)) for name in ("w", "v", "e"))
        drive_zz = _tensor(scene.actuated_links[k].inertia)[2]
        if scene.actuators is not None:
            gear = scene.actuators.gear_ratio
            drive_zz = drive_zz + gear * gear * scene.actuators.rotor_inertia
        xx, yy, zz, xy, xz, yz = _tensor(scene.intermediate_links[k].inertia)
        constants = (drive_zz + yy - xx, zz - yy + xx, xy, xz, yz)
        star = [
            part + xx * (float(i == j) - e[i] * e[j])
            for part, (i, j) in zip(star, PLACES, strict=True)
        ]
        legs.append(
            Leg(w, v, cross(w, v), e[0], e[1], *constants, loads_of_leg(scene, geometry, k))
        )
    carried: list[Star | Payload] = [scene.star]
    if scene.payload is not None:
        carried.append(scene.payload)
    weight = [sum(body.mass * body.centre[i] for body in carried) for i in range(3)]
    return Model(
        star=(star[0], star[1], star[2], star[3], star[4], star[5]),
        legs=(legs[0], legs[1], legs[2]),
        gravity=None if scene.gravity is None else scene.gravity.acceleration,
        weight=(weight[0], weight[1], weight[2]),
        moment=None if scene.moment is None else scene.moment.value,
        time_constant=None if scene.actuators is None else scene.actuators.time_constant,
    )


PLACES = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))
"""Rows and columns of the six numbers of an inertia (xx, yy, zz, xy, xz, yz)."""


def _star(scene: Scene) -> list[Scalar]:
    """Inertia of star and payload about O in {E}, in the order of `PLACES`."""
    star, payload = _tensor(scene.star.inertia), scene.payload
    if payload is None:
        return star
    mass, c = payload.mass, payload.centre
    square = c[0] * c[0] + c[1] * c[1] + c[2] * c[2]
    return [
        part + (own + mass * (square * float(i == j) - c[i] * c[j]))
        for part, own, (i, j) in zip(star, _tensor(payload.inertia), PLACES, strict=True)
    ]


def _tensor(inertia: Inertia | None) -> list[Scalar]:
    if inertia is None:
        return [0.0] * 6
    return [inertia.xx, inertia.yy, inertia.zz, inertia.xy, inertia.xz, inertia.yz]


def loads_of_leg(scene: Scene, geometry: Geometry, k: int) -> LegLoads | None:
    """Collect the loads of leg k; None where it has none."""
    joints, springs = scene.friction, scene.springs
    friction = (joints.gamma, joints.mu, joints.beta) if joints else (None, None, None)
    by_joint = tuple(
        _join([s for s in springs if s.joint == f"{kind}_{k + 1}"])
        for kind in ("gamma", "mu", "beta")
    )
    drive = link = ZERO
    if scene.gravity is not None:
        drive, link = _moment(scene.actuated_links[k]), _moment(scene.intermediate_links[k])
    stops = None
    if scene.stroke.stiffness is not None:
        damping = damping_of(scene.stroke)
        stops = ElasticStops(geometry.of_leg("arc", k), scene.stroke.stiffness, damping)
    heavy = any(x.any() if isinstance(x, np.ndarray) else x for x in (*drive, *link))
    if not (any(friction) or any(by_joint) or heavy or stops):
        return None
    return LegLoads(friction, (by_joint[0], by_joint[1], by_joint[2]), drive, link, stops)


def damping_of(stroke: Stroke) -> float:
    """Damping of elastic stops [s/rad], as given or from the restitution at the impact rate.

    For one freedom of inertia m, m v dv/dx = -k x (1 + c v) separates: from the rate v into the
    stop to e v out of it, with d = c v,

        d (1 + e) = ln((1 + d) / (1 - d e)),

    whatever m and k (Gonthier, McPhee, Lange & Piedboeuf, Multibody Syst. Dyn. 11 (2004) 209-233;
    the force is that of Hunt & Crossley, J. Appl. Mech. 42 (1975) 440-445). With s = d (1 + e) it
    reads L(s/2) = (1 - e) / (1 + e), where L(x) = coth x - 1/x is Langevin's function.
    """
    if stroke.restitution is None or stroke.impact_rate is None:
        return stroke.damping
    e = stroke.restitution
    return 2.0 * _inverse_langevin((1.0 - e) / (1.0 + e)) / ((1.0 + e) * stroke.impact_rate)


def _inverse_langevin(y: float) -> float:
    """Solve coth x - 1/x = y for x >= 0, 0 <= y < 1."""
    if y < 0.05:  # coth x - 1/x would cancel; the next term of the series is 2.1 y^13
        coefficients = (3.0, 9 / 5, 297 / 175, 1539 / 875, 126117 / 67375, 43733439 / 21896875)
        return sum(c * y ** (2 * i + 1) for i, c in enumerate(coefficients))
    low, high = 3.0 * y, 1.0 / (1.0 - y) + 3.0 * y
    while True:  # at most some sixty bisections
        x = 0.5 * (low + high)
        if not low < x < high:
            return x
        if 1.0 / math.tanh(x) - 1.0 / x < y:
            low = x
        else:
            high = x


def _join(springs: list[Any]) -> JointSpring | None:
    stiffness = sum(spring.stiffness for spring in springs)
    if not springs:
        return None
    return JointSpring(stiffness, sum(s.stiffness * s.rest for s in springs) / stiffness)


def _moment(link: Link) -> Triple:
    x, y, z = link.centre
    return (link.mass * x, link.mass * y, link.mass * z)


class LegMotion(NamedTuple):
    """One leg at one instant, vectors in {E}: see `kernel` for the letters.

    Attributes:
        leg: its constants.
        axis: w_k.
        along: t_k = (e0, e1, 0).
        outward: p in {B}, which points along r_k.
        b: beta_dot = b.W.

    """

    leg: Leg
    axis: Triple
    along: Triple
    a: Scalar
    p: Triple
    u: Scalar
    g: Triple
    b: Triple
    outward: Triple
    gamma_dot: Scalar
    a_dot: Scalar
    beta_dot: Scalar


def joint_torques(at: LegMotion, field: Triple) -> Triple:
    """Torques [N m] of the loads at gamma, mu and beta; `field` is gravity in {E}."""
    loads = at.leg.loads
    if loads is None:
        return ZERO
    friction = triple(
        0.0 if one is None else -friction_torque(one, joint_rate(at, kind))
        for kind, one in enumerate(loads.friction)
    )
    springs = triple(
        0.0 if spring is None else -spring.stiffness * (joint_angle(at, kind) - spring.rest)
        for kind, spring in enumerate(loads.springs)
    )
    at_gamma, at_mu = _weight(loads, at, field)
    if loads.stops is not None:
        at_gamma = at_gamma + stop_torque(loads.stops, joint_angle(at, 0), at.gamma_dot)
    return (
        friction[0] + springs[0] + at_gamma,
        friction[1] + springs[1] + at_mu,
        friction[2] + springs[2],
    )


def spring_and_weight_energy(at: LegMotion, field: Triple) -> Scalar:
    """Energy [J] in springs, elastic stops and the weight of the links."""
    loads, total = at.leg.loads, 0.0
    if loads is None:
        return total
    for kind, spring in enumerate(loads.springs):
        if spring is not None:
            stretch = joint_angle(at, kind) - spring.rest
            total = total + 0.5 * spring.stiffness * stretch * stretch
    if loads.stops is not None:
        gamma = joint_angle(at, 0)
        for depth in (positive(-gamma), positive(gamma - loads.stops.arc)):
            total = total + 0.5 * loads.stops.stiffness * depth * depth
    if any(loads.drive) or any(loads.link):
        first, second = _directions(at)
        total = total - dot(_combine(loads.drive, *first), field)
        total = total - dot(_combine(loads.link, *second), field)
    return total


def dissipation(at: LegMotion) -> Scalar:
    """Power [W] that friction and the damping of elastic stops take out."""
    loads, total = at.leg.loads, 0.0
    if loads is None:
        return total
    for kind, friction in enumerate(loads.friction):
        if friction is not None:
            total = total + friction_torque(friction, joint_rate(at, kind)) * joint_rate(at, kind)
    if loads.stops is not None and loads.stops.damping:
        gamma, speed = joint_angle(at, 0), at.gamma_dot
        elastic = loads.stops._replace(damping=0.0)
        excess = stop_torque(elastic, gamma, speed) - stop_torque(loads.stops, gamma, speed)
        total = total + excess * speed
    return total


def friction_torque(friction: Friction, v: Scalar) -> Scalar:
    """Friction torque [N m] against the rate v [rad/s]."""
    torque = friction.viscous * v
    if friction.coulomb or friction.static:
        level: Scalar = friction.coulomb
        if friction.static:
            slow = v / friction.stribeck
            level = level + (friction.static - friction.coulomb) * exp(-(slow * slow))
        torque = torque + level * tanh(v / friction.smoothing)
    return torque


def stop_torque(stops: ElasticStops, gamma: Scalar, gamma_dot: Scalar) -> Scalar:
    """Torque of elastic stops; the damping grows from zero with the depth (Hunt-Crossley)."""
    low, high = positive(-gamma), positive(gamma - stops.arc)
    if not stops.damping:
        return stops.stiffness * (low - high)
    inward = stops.damping * gamma_dot
    return stops.stiffness * (low * positive(1.0 - inward) - high * positive(1.0 + inward))


def joint_rate(at: LegMotion, kind: int) -> Scalar:
    """Rate of gamma (0), mu (1) or beta (2) [rad/s]."""
    if kind == 0:
        return at.gamma_dot
    return -at.a_dot / sqrt(at.u) if kind == 1 else at.beta_dot


def joint_angle(at: LegMotion, kind: int) -> Scalar:
    """Angle of gamma (0), mu (1) or beta (2) [rad]."""
    if kind == 0:
        return atan2(dot(at.outward, at.leg.across), dot(at.outward, at.leg.v))
    if kind == 1:
        return atan2(sqrt(at.u), at.a)
    # r.(t x s) and r.s with s = (0, 0, 1), both times sqrt(u).
    return atan2(at.p[0] * at.along[1] - at.p[1] * at.along[0], at.p[2])


def _weight(loads: LegLoads, leg: LegMotion, field: Triple) -> tuple[Scalar, Scalar]:
    """Torques of the links' weight at gamma and mu: moments about w_k and -r_k."""
    if not (any(loads.drive) or any(loads.link)):
        return 0.0, 0.0
    first, second = _directions(leg)
    on_link = cross(_combine(loads.link, *second), field)
    on_both = cross(_combine(loads.drive, *first), field)
    total = (on_link[0] + on_both[0], on_link[1] + on_both[1], on_link[2] + on_both[2])
    return dot(total, leg.axis), -dot(on_link, first[0])


def _directions(leg: LegMotion) -> tuple[Rows, Rows]:
    """Axes of {1k} = [r, w x r, w] and {2k} = [r, t x r, t] in {E}."""
    root = sqrt(leg.u)
    r = (leg.p[0] / root, leg.p[1] / root, leg.p[2] / root)
    return (r, cross(leg.axis, r), leg.axis), (r, cross(leg.along, r), leg.along)


def _combine(c: Triple, x: Triple, y: Triple, z: Triple) -> Triple:
    return triple(c[0] * x[i] + c[1] * y[i] + c[2] * z[i] for i in range(3))
