# SPDX-License-Identifier: Apache-2.0
"""The dynamics that run: state (quaternion q of {E} in {B}, body angular velocity W), rational.

In {E} the axis t_k of arc k is constant and the actuator axis w_k is a combination of rows of R.
With a = cos(mu_k) = t.w, p = t x w, u = 1 - a^2 and g = (w - a t)/u a leg moves as

    a_dot = p.W,    gamma_dot = g.W,

both rates of true coordinates, so each leg is a system with the two coordinates (a, gamma) and
the kinetic energy (B a_dot^2 + 2 C a_dot gamma_dot + A gamma_dot^2) / 2. Its inertia forces act
on the star through p and g (virtual work). The loops are closed by construction, and M is
positive definite wherever u > 0: only a serial singularity (t_k = +-w_k) has no dynamics.

The functions use + - * / and, for a link with products of inertia xz or yz, one square root; so
they run on floats, on complex numbers, on NumPy columns and on mpmath numbers alike.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

from sst_ros.mechanism.geometry import Geometry
from sst_ros.scene import Scene

Scalar = Any
Triple = tuple[Scalar, Scalar, Scalar]
Quadruple = tuple[Scalar, Scalar, Scalar, Scalar]
State = tuple[Scalar, ...]


class Leg(NamedTuple):
    """Constants of one leg: axis w and start v of the arc in {B}, axis (e0, e1, 0) in {E}.

    The energies are Ixx/u, A0 + A2 a^2 - 2 Iyz a sqrt(u) and Ixz a/sqrt(u) - Ixy for B, A, C.
    """

    w: Triple
    v: Triple
    across: Triple
    e0: float
    e1: float
    ixx: float
    a0: float
    a2: float
    ixy: float
    ixz: float
    iyz: float


class Model(NamedTuple):
    """All constants of the dynamics; `star` is the inertia (xx, yy, zz, xy, xz, yz) in {E}."""

    star: tuple[float, float, float, float, float, float]
    legs: tuple[Leg, Leg, Leg]


class Joints(NamedTuple):
    """Angles [rad] and rates [rad/s] of all nine joints, by kind and leg."""

    gamma: Triple
    mu: Triple
    beta: Triple
    gamma_dot: Triple
    mu_dot: Triple
    beta_dot: Triple


def model_of(scene: Scene) -> Model:
    """Collect the constants of a scene."""
    geometry, star = Geometry.of(scene), scene.star.inertia
    legs = []
    for k in range(3):
        link, drive = scene.intermediate_links[k].inertia, scene.actuated_links[k].inertia
        w, v, e = (tuple(row[k].tolist()) for row in (geometry.w, geometry.v, geometry.e))
        constants = (link.xx, drive.zz + link.yy, link.zz - link.yy, link.xy, link.xz, link.yz)
        legs.append(Leg(w, v, cross(w, v), e[0], e[1], *constants))
    return Model(
        (star.xx, star.yy, star.zz, star.xy, star.xz, star.yz), (legs[0], legs[1], legs[2])
    )


def derivative(model: Model, state: State, torque: Triple, moment: Triple | None = None) -> State:
    """Time derivative of the state, seven numbers (q, W).

    Args:
        model: constants.
        state: quaternion (x, y, z, w), of any length > 0, and W [rad/s] in {E}.
        torque: actuator torques [N m].
        moment: external moment on the star in {E} [N m], or None where there is none.

    """
    x, y, z, w, wx, wy, wz = state
    acceleration = body_acceleration(model, (x, y, z, w), (wx, wy, wz), torque, moment)
    return (
        0.5 * (w * wx + y * wz - z * wy),
        0.5 * (w * wy + z * wx - x * wz),
        0.5 * (w * wz + x * wy - y * wx),
        -0.5 * (x * wx + y * wy + z * wz),
        *acceleration,
    )


def body_acceleration(
    model: Model, q: Quadruple, rate: Triple, torque: Triple, moment: Triple | None = None
) -> Triple:
    """W_dot [rad/s^2] in {E} of the direct dynamics; arguments as for `derivative`."""
    wx, wy, wz = rate
    mxx, myy, mzz, mxy, mxz, myz = model.star
    spin = (
        mxx * wx + mxy * wy + mxz * wz,
        mxy * wx + myy * wy + myz * wz,
        mxz * wx + myz * wy + mzz * wz,
    )
    fx, fy, fz = cross(spin, rate)
    if moment is not None:
        fx, fy, fz = fx + moment[0], fy + moment[1], fz + moment[2]
    rows = rotation_rows(q)
    squared = wx * wx + wy * wy + wz * wz
    for leg, tau in zip(model.legs, torque, strict=True):
        axis, a, p, u, g = leg_vectors(leg, rows)
        along, a_dot, gamma_dot = leg.e0 * wx + leg.e1 * wy, dot(p, rate), dot(g, rate)
        # Accelerations of the coordinates at W_dot = 0.
        a_rest = dot(axis, rate) * along - a * squared
        gamma_rest = a_dot * (2.0 * a * gamma_dot - along) / u
        # T = (B a_dot^2 + 2 C a_dot gamma_dot + A gamma_dot^2) / 2; slopes are d/da.
        b_inertia = leg.ixx / u
        b_slope = 2.0 * a * b_inertia / u
        a_inertia, a_slope = leg.a0 + leg.a2 * (a * a), 2.0 * leg.a2 * a
        force_a = b_inertia * a_rest + 0.5 * (
            b_slope * a_dot * a_dot - a_slope * gamma_dot * gamma_dot
        )
        force_gamma = a_inertia * gamma_rest + a_slope * a_dot * gamma_dot - tau
        if leg.ixy or leg.ixz or leg.iyz:
            root = u**0.5
            c_inertia, c_slope = leg.ixz * a / root - leg.ixy, leg.ixz / (u * root)
            a_more, slope_more = (
                -2.0 * leg.iyz * a * root,
                -2.0 * leg.iyz * (1.0 - 2.0 * a * a) / root,
            )
            force_a = force_a + c_inertia * gamma_rest - 0.5 * slope_more * gamma_dot * gamma_dot
            force_gamma = force_gamma + c_inertia * a_rest + c_slope * a_dot * a_dot
            force_gamma = force_gamma + a_more * gamma_rest + slope_more * a_dot * gamma_dot
            a_inertia = a_inertia + a_more
            toward_a = axpy(c_inertia, g, b_inertia, p)
            toward_gamma = axpy(c_inertia, p, a_inertia, g)
        else:
            toward_a, toward_gamma = scaled(b_inertia, p), scaled(a_inertia, g)
        fx = fx - force_a * p[0] - force_gamma * g[0]
        fy = fy - force_a * p[1] - force_gamma * g[1]
        fz = fz - force_a * p[2] - force_gamma * g[2]
        mxx = mxx + toward_a[0] * p[0] + toward_gamma[0] * g[0]
        myy = myy + toward_a[1] * p[1] + toward_gamma[1] * g[1]
        mzz = mzz + toward_a[2] * p[2] + toward_gamma[2] * g[2]
        mxy = mxy + toward_a[0] * p[1] + toward_gamma[0] * g[1]
        mxz = mxz + toward_a[0] * p[2] + toward_gamma[0] * g[2]
        myz = myz + toward_a[1] * p[2] + toward_gamma[1] * g[2]
    return _solve_symmetric(mxx, myy, mzz, mxy, mxz, myz, fx, fy, fz)


def kinetic_energy(model: Model, q: Quadruple, rate: Triple) -> Scalar:
    """Kinetic energy of all seven links [J]."""
    wx, wy, wz = rate
    ixx, iyy, izz, ixy, ixz, iyz = model.star
    total = ixx * wx * wx + iyy * wy * wy + izz * wz * wz
    total = total + 2.0 * (ixy * wx * wy + ixz * wx * wz + iyz * wy * wz)
    rows = rotation_rows(q)
    for leg in model.legs:
        _, a, p, u, g = leg_vectors(leg, rows)
        a_dot, gamma_dot = dot(p, rate), dot(g, rate)
        total = total + leg.ixx / u * a_dot * a_dot
        total = total + (leg.a0 + leg.a2 * (a * a)) * gamma_dot * gamma_dot
        if leg.ixy or leg.ixz or leg.iyz:
            root = u**0.5
            mixed = (leg.ixz * a / root - leg.ixy) * a_dot - leg.iyz * a * root * gamma_dot
            total = total + 2.0 * mixed * gamma_dot
    return 0.5 * total


def joints(model: Model, state: State) -> Joints:
    """Angles and rates of all joints; real numbers only. See `kinematics.inverse` for branches."""
    x, y, z, w, wx, wy, wz = state
    rows = rotation_rows((x, y, z, w))
    angles, rates = [], []
    for leg in model.legs:
        axis, a, p, u, g = leg_vectors(leg, rows)
        outward = tuple(dot(row, p) for row in rows)
        root = u**0.5
        gamma = math.atan2(dot(outward, leg.across), dot(outward, leg.v))
        # r.(t x s) and r.s with s = (0, 0, 1), t = (e0, e1, 0), both times sqrt(u).
        beta = math.atan2(p[0] * leg.e1 - p[1] * leg.e0, p[2])
        angles.append((gamma, math.atan2(root, a), beta))
        along = leg.e0 * wx + leg.e1 * wy
        inward = (a * dot(axis, (wx, wy, wz)) - along) / u
        rates.append((dot(g, (wx, wy, wz)), -dot(p, (wx, wy, wz)) / root, inward))
    (g1, m1, b1), (g2, m2, b2), (g3, m3, b3) = angles
    (e1, n1, c1), (e2, n2, c2), (e3, n3, c3) = rates
    return Joints(
        (g1, g2, g3), (m1, m2, m3), (b1, b2, b3), (e1, e2, e3), (n1, n2, n3), (c1, c2, c3)
    )


def leg_vectors(
    leg: Leg, rows: tuple[Triple, Triple, Triple]
) -> tuple[Triple, Scalar, Triple, Scalar, Triple]:
    """Return (w, a, p, u, g) of a leg in {E}; `rows` are the rows of R."""
    e0, e1 = leg.e0, leg.e1
    w0, w1, w2 = leg.w
    (r00, r01, r02), (r10, r11, r12), (r20, r21, r22) = rows
    x = w0 * r00 + w1 * r10 + w2 * r20
    y = w0 * r01 + w1 * r11 + w2 * r21
    z = w0 * r02 + w1 * r12 + w2 * r22
    a, across = e0 * x + e1 * y, e0 * y - e1 * x
    u = across * across + z * z
    return (x, y, z), a, (e1 * z, -(e0 * z), across), u, ((x - a * e0) / u, (y - a * e1) / u, z / u)


def rotation_rows(q: Quadruple) -> tuple[Triple, Triple, Triple]:
    """Rows of R for a quaternion (x, y, z, w) of any length > 0."""
    x, y, z, w = q
    s = 2.0 / (x * x + y * y + z * z + w * w)
    sx, sy, sz = s * x, s * y, s * z
    xx, yy, zz = sx * x, sy * y, sz * z
    xy, xz, yz, wx, wy, wz = sx * y, sx * z, sy * z, sx * w, sy * w, sz * w
    return (
        (1.0 - (yy + zz), xy - wz, xz + wy),
        (xy + wz, 1.0 - (xx + zz), yz - wx),
        (xz - wy, yz + wx, 1.0 - (xx + yy)),
    )


def dot(a: Any, b: Any) -> Scalar:
    """Scalar product of two triples."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def cross(a: Any, b: Any) -> Triple:
    """Vector product of two triples."""
    return (a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])


def scaled(factor: Scalar, a: Triple) -> Triple:
    """Return factor a."""
    return (factor * a[0], factor * a[1], factor * a[2])


def axpy(alpha: Scalar, a: Triple, beta: Scalar, b: Triple) -> Triple:
    """Return alpha a + beta b."""
    return (alpha * a[0] + beta * b[0], alpha * a[1] + beta * b[1], alpha * a[2] + beta * b[2])


def _solve_symmetric(
    xx: Scalar, yy: Scalar, zz: Scalar, xy: Scalar, xz: Scalar, yz: Scalar,
    fx: Scalar, fy: Scalar, fz: Scalar,
) -> Triple:  # fmt: skip
    """Solve a symmetric positive definite 3 x 3 system by L D L^T."""
    l21, l31 = xy / xx, xz / xx
    d2 = yy - l21 * xy
    e32 = yz - l31 * xy
    l32 = e32 / d2
    d3 = zz - l31 * xz - l32 * e32
    y2 = fy - l21 * fx
    y3 = fz - l31 * fx - l32 * y2
    x3 = y3 / d3
    x2 = y2 / d2 - l32 * x3
    return (fx / xx - l21 * x2 - l31 * x3, x2, x3)
