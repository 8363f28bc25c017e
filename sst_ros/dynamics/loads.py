# SPDX-License-Identifier: Apache-2.0
"""Loads of a scene as torques at joints: gravity, friction, springs, compliant stops.

Every function is for one leg and returns Python's 0.0 for what the scene does not have, which
leaves nothing behind in a traced program (`trace`).
"""

from __future__ import annotations

from typing import NamedTuple

from sst_ros.mechanism.generic_math import (
    Scalar,
    Triple,
    atan2,
    cross,
    dot,
    exp,
    positive,
    sqrt,
    tanh,
)
from sst_ros.scene.scene import Friction


class JointSpring(NamedTuple):
    """All springs of one joint as one: torque -stiffness (angle - rest)."""

    stiffness: float
    rest: float


class CompliantStops(NamedTuple):
    """Compliant stops at the ends of the stroke, 0 and arc."""

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
        stops: compliant stops of the stroke.

    """

    friction: tuple[Friction | None, Friction | None, Friction | None]
    springs: tuple[JointSpring | None, JointSpring | None, JointSpring | None]
    drive: Triple
    link: Triple
    stops: CompliantStops | None


class LegMotion(NamedTuple):
    """One leg at one instant, vectors in {E}: see `kernel` for the letters.

    Attributes:
        axis: w_k.
        along: t_k = (e0, e1, 0).
        outward: p in {B}, which points along r_k.
        b: beta_dot = b.W.

    """

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


def joint_torques(
    loads: LegLoads, leg: LegMotion, across: Triple, v: Triple, field: Triple
) -> Triple:
    """Torques [N m] at gamma, mu and beta; `field` is gravity in {E}."""
    friction = tuple(
        0.0 if one is None else -friction_torque(one, rate(leg, kind))
        for kind, one in enumerate(loads.friction)
    )
    springs = tuple(
        0.0 if spring is None else -spring.stiffness * (angle(leg, kind, across, v) - spring.rest)
        for kind, spring in enumerate(loads.springs)
    )
    at_gamma, at_mu = _weight(loads, leg, field)
    if loads.stops is not None:
        at_gamma = at_gamma + stop_torque(loads.stops, angle(leg, 0, across, v), leg.gamma_dot)
    return (
        friction[0] + springs[0] + at_gamma,
        friction[1] + springs[1] + at_mu,
        friction[2] + springs[2],
    )


def potential_energy(
    loads: LegLoads, leg: LegMotion, across: Triple, v: Triple, field: Triple
) -> Scalar:
    """Energy [J] in springs, compliant stops and the weight of the links."""
    total: Scalar = 0.0
    for kind, spring in enumerate(loads.springs):
        if spring is not None:
            stretch = angle(leg, kind, across, v) - spring.rest
            total = total + 0.5 * spring.stiffness * stretch * stretch
    if loads.stops is not None:
        gamma = angle(leg, 0, across, v)
        for depth in (positive(-gamma), positive(gamma - loads.stops.arc)):
            total = total + 0.5 * loads.stops.stiffness * depth * depth
    if any(loads.drive) or any(loads.link):
        first, second = _directions(leg)
        total = total - dot(_combined(loads.drive, *first), field)
        total = total - dot(_combined(loads.link, *second), field)
    return total


def dissipation(loads: LegLoads, leg: LegMotion, across: Triple, v: Triple) -> Scalar:
    """Power [W] that friction and the damping of compliant stops take out."""
    total: Scalar = 0.0
    for kind, friction in enumerate(loads.friction):
        if friction is not None:
            total = total + friction_torque(friction, rate(leg, kind)) * rate(leg, kind)
    if loads.stops is not None and loads.stops.damping:
        gamma, speed = angle(leg, 0, across, v), leg.gamma_dot
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


def rate(leg: LegMotion, kind: int) -> Scalar:
    """Rate of gamma (0), mu (1) or beta (2) [rad/s]."""
    if kind == 0:
        return leg.gamma_dot
    return -leg.a_dot / sqrt(leg.u) if kind == 1 else leg.beta_dot


def angle(leg: LegMotion, kind: int, across: Triple, v: Triple) -> Scalar:
    """Angle of gamma (0), mu (1) or beta (2) [rad]; v and across = w x v are the arc's in {B}."""
    if kind == 0:
        return atan2(dot(leg.outward, across), dot(leg.outward, v))
    if kind == 1:
        return atan2(sqrt(leg.u), leg.a)
    # r.(t x s) and r.s with s = (0, 0, 1), both times sqrt(u).
    return atan2(leg.p[0] * leg.along[1] - leg.p[1] * leg.along[0], leg.p[2])


def _weight(loads: LegLoads, leg: LegMotion, field: Triple) -> tuple[Scalar, Scalar]:
    """Torques of the links' weight at gamma and mu: moments about w_k and -r_k."""
    if not (any(loads.drive) or any(loads.link)):
        return 0.0, 0.0
    first, second = _directions(leg)
    on_link = cross(_combined(loads.link, *second), field)
    on_both = cross(_combined(loads.drive, *first), field)
    total = (on_link[0] + on_both[0], on_link[1] + on_both[1], on_link[2] + on_both[2])
    return dot(total, leg.axis), -dot(on_link, first[0])


def _directions(
    leg: LegMotion,
) -> tuple[tuple[Triple, Triple, Triple], tuple[Triple, Triple, Triple]]:
    """Axes of {1k} = [r, w x r, w] and {2k} = [r, t x r, t] in {E}."""
    root = sqrt(leg.u)
    r = (leg.p[0] / root, leg.p[1] / root, leg.p[2] / root)
    return (r, cross(leg.axis, r), leg.axis), (r, cross(leg.along, r), leg.along)


def stop_torque(stops: CompliantStops, gamma: Scalar, gamma_dot: Scalar) -> Scalar:
    """Torque of compliant stops; the damping grows from zero with the depth (Hunt-Crossley)."""
    low, high = positive(-gamma), positive(gamma - stops.arc)
    if not stops.damping:
        return stops.stiffness * (low - high)
    inward = stops.damping * gamma_dot
    return stops.stiffness * (low * positive(1.0 - inward) - high * positive(1.0 + inward))


def _combined(c: Triple, x: Triple, y: Triple, z: Triple) -> Triple:
    first, second, third = (c[0] * x[i] + c[1] * y[i] + c[2] * z[i] for i in range(3))
    return (first, second, third)
