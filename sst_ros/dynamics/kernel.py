# SPDX-License-Identifier: Apache-2.0
"""The dynamics that run: state (quaternion q of {E} in {B}, body angular velocity W), rational.

In {E} the axis t_k of arc k is constant and the actuator axis w_k is a combination of rows of R.
With a = cos(mu_k) = t.w, p = t x w, u = 1 - a^2 and g = (w - a t)/u a leg moves as

    a_dot = p.W,    gamma_dot = g.W,

both rates of true coordinates. Across t_k the intermediate link turns as the star does, so the part
Ixx (1 - t t^T) of its inertia belongs to the star, for good; what is left of a leg is the kinetic
energy C a_dot gamma_dot + A gamma_dot^2 / 2. Its inertia forces act on the star through p and g
(virtual work). The loops are closed by construction, and M is positive definite wherever u > 0:
only a serial singularity (t_k = +-w_k) has no dynamics.

The inertial part uses + - * / and, for a link with products of inertia xz or yz, one square root;
loads may need angles (`model`). The functions run on floats, complex numbers, NumPy columns,
mpmath numbers and expressions alike; the simulation runs what `trace` leaves of them for a scene.
"""

from __future__ import annotations

from typing import NamedTuple

from sst_ros.dynamics.model import (
    PLACES,
    Leg,
    LegMotion,
    Model,
    dissipation,
    joint_angle,
    joint_rate,
    joint_torques,
    model_of,
    spring_and_weight_energy,
)
from sst_ros.mechanism.generic_math import (
    ZERO,
    Quadruple,
    Rows,
    Scalar,
    Symmetric,
    Triple,
    add,
    axpy,
    cross,
    dot,
    multiply,
    quaternion_rate,
    rotate_back,
    rotation_rows,
    solve_symmetric,
    sqrt,
    symmetric_rows,
    triple,
)
from sst_ros.state import Joints

__all__ = [
    "Balance",
    "Joints",
    "Leg",
    "Model",
    "actuator_torque",
    "balance",
    "body_acceleration",
    "derivative",
    "joints",
    "model_of",
]


class Balance(NamedTuple):
    """M W_dot = force in {E}, everything reduced to the star by virtual work.

    Attributes:
        inertia: M (xx, yy, zz, xy, xz, yz) [kg m^2].
        force: moment of all that acts at W_dot = 0, velocity products included [N m].
        jacobian: rows g_k; gamma_dot_k = g_k.W, and a torque at gamma_k acts as tau_k g_k.

    """

    inertia: Symmetric
    force: Triple
    jacobian: Rows


def derivative(
    model: Model, state: tuple[Scalar, ...], torque: Triple, moment: Triple | None = None
) -> tuple[Scalar, ...]:
    """Time derivative of the state, seven numbers (q, W), and with lag three torques more.

    Args:
        model: constants.
        state: quaternion (x, y, z, w), of any length > 0, W [rad/s] in {E}, and where the
            actuators lag the torques they give [N m].
        torque: actuator torques [N m]; with lag the commanded ones.
        moment: external moment on the star in {B} [N m], or None where there is none.

    """
    x, y, z, w, wx, wy, wz, *given = state
    more: tuple[Scalar, ...] = ()
    if model.time_constant is not None:
        more = tuple(
            (asked - has) / model.time_constant for asked, has in zip(torque, given, strict=True)
        )
        torque = (given[0], given[1], given[2])
    acceleration = body_acceleration(model, (x, y, z, w), (wx, wy, wz), torque, moment)
    return (*quaternion_rate((x, y, z, w), (wx, wy, wz)), *acceleration, *more)


def body_acceleration(
    model: Model, q: Quadruple, rate: Triple, torque: Triple, moment: Triple | None = None
) -> Triple:
    """W_dot [rad/s^2] in {E} of the direct dynamics; arguments as for `derivative`."""
    at = balance(model, q, rate, torque, moment)
    return solve_symmetric(at.inertia, at.force)


def actuator_torque(
    model: Model, q: Quadruple, rate: Triple, acceleration: Triple, moment: Triple | None = None
) -> tuple[Triple, Scalar]:
    """Torques [N m] of the inverse dynamics, and the determinant of the rows g_k.

    The torques do the work tau_k g_k.W on the star: M W_dot = force + sum tau_k g_k. With
    g_k = N_k / c_k the determinant is -det J2 / (c_1 c_2 c_3), zero at a parallel singularity.
    """
    at = balance(model, q, rate, ZERO, moment)
    rows = zip(symmetric_rows(at.inertia), at.force, strict=True)
    missing = triple(dot(row, acceleration) - force for row, force in rows)
    first, second, third = at.jacobian
    others = (cross(second, third), cross(third, first), cross(first, second))
    determinant = dot(first, others[0])
    return triple(dot(missing, other) / determinant for other in others), determinant


def balance(
    model: Model, q: Quadruple, rate: Triple, torque: Triple, moment: Triple | None = None
) -> Balance:
    """Collect all that acts on the star; arguments as for `derivative`."""
    rows = rotation_rows(q)
    inertia: tuple[Scalar, ...] = model.star
    force = _on_star(model, rows, rate, moment)
    field = field_of(model, rows)
    jacobian = []
    for leg, drive in zip(model.legs, torque, strict=True):
        at = leg_motion(leg, rows, rate)
        a, p, u, g, a_dot, gamma_dot = at.a, at.p, at.u, at.g, at.a_dot, at.gamma_dot
        jacobian.append(g)
        a_rest, gamma_rest = rest_accelerations(at, rate)
        # T = C a_dot gamma_dot + A gamma_dot^2 / 2; slopes are d/da.
        a_inertia, a_slope = leg.a0 + leg.a2 * (a * a), 2.0 * leg.a2 * a
        c_inertia: Scalar = 0.0
        c_slope: Scalar = 0.0
        if leg.ixy or leg.ixz or leg.iyz:
            root = sqrt(u)
            c_inertia, c_slope = leg.ixz * a / root - leg.ixy, leg.ixz / (u * root)
            a_inertia = a_inertia - 2.0 * leg.iyz * a * root
            a_slope = a_slope - 2.0 * leg.iyz * (1.0 - 2.0 * a * a) / root
        force_a = c_inertia * gamma_rest - 0.5 * a_slope * gamma_dot * gamma_dot
        force_gamma = a_inertia * gamma_rest + c_inertia * a_rest - drive
        force_gamma = force_gamma + a_slope * a_dot * gamma_dot + c_slope * a_dot * a_dot
        toward_a = multiply(c_inertia, g)
        toward_gamma = axpy(a_inertia, g, c_inertia, p)
        if leg.loads is not None:
            at_gamma, at_mu, at_beta = joint_torques(at, field)
            force_gamma = force_gamma - at_gamma
            # mu_dot = -a_dot / sqrt(u)
            force_a = force_a + _quotient(at_mu, u)
            force = triple(f + at_beta * b for f, b in zip(force, at.b, strict=True))
        force = triple(
            f - force_a * along - force_gamma * across
            for f, along, across in zip(force, p, g, strict=True)
        )
        inertia = tuple(
            m + toward_a[i] * p[j] + toward_gamma[i] * g[j]
            for m, (i, j) in zip(inertia, PLACES, strict=True)
        )
    xx, yy, zz, xy, xz, yz = inertia
    return Balance((xx, yy, zz, xy, xz, yz), force, (jacobian[0], jacobian[1], jacobian[2]))


def joints(model: Model, state: tuple[Scalar, ...]) -> Joints:
    """Angles and rates of all joints. See `kinematics.inverse` for the branches."""
    x, y, z, w, wx, wy, wz = state[:7]
    rows = rotation_rows((x, y, z, w))
    angles, rates = [], []
    for leg in model.legs:
        at = leg_motion(leg, rows, (wx, wy, wz))
        angles.append([joint_angle(at, kind) for kind in range(3)])
        rates.append([joint_rate(at, kind) for kind in range(3)])
    gamma, mu, beta = zip(*angles, strict=True)
    gamma_dot, mu_dot, beta_dot = zip(*rates, strict=True)
    return Joints(gamma, mu, beta, gamma_dot, mu_dot, beta_dot)


def leg_motion(leg: Leg, rows: Rows, rate: Triple) -> LegMotion:
    """Vectors and rates of a leg; `rows` are the rows of R, `rate` is W."""
    e0, e1 = leg.e0, leg.e1
    w0, w1, w2 = leg.w
    (r00, r01, r02), (r10, r11, r12), (r20, r21, r22) = rows
    x = w0 * r00 + w1 * r10 + w2 * r20
    y = w0 * r01 + w1 * r11 + w2 * r21
    z = w0 * r02 + w1 * r12 + w2 * r22
    a, across = e0 * x + e1 * y, e0 * y - e1 * x
    p = (e1 * z, -(e0 * z), across)
    u = across * across + z * z
    g = ((x - a * e0) / u, (y - a * e1) / u, z / u)
    b = ((a * x - e0) / u, (a * y - e1) / u, a * z / u)
    outward = triple(dot(row, p) for row in rows)
    return LegMotion(
        leg=leg,
        axis=(x, y, z),
        along=(e0, e1, 0.0),
        a=a,
        p=p,
        u=u,
        g=g,
        b=b,
        outward=outward,
        gamma_dot=dot(g, rate),
        a_dot=dot(p, rate),
        beta_dot=dot(b, rate),
    )


def rest_accelerations(at: LegMotion, rate: Triple) -> tuple[Scalar, Scalar]:
    """Accelerations of the coordinates a and gamma of a leg at W_dot = 0."""
    along = dot(at.along, rate)
    a_rest = dot(at.axis, rate) * along - at.a * dot(rate, rate)
    return a_rest, at.a_dot * (2.0 * at.a * at.gamma_dot - along) / at.u


def _on_star(model: Model, rows: Rows, rate: Triple, moment: Triple | None) -> Triple:
    """Moments on the star in {E}: gyroscopic, weight, external."""
    total = cross(triple(dot(row, rate) for row in symmetric_rows(model.star)), rate)
    if model.gravity is not None:
        total = add(total, cross(model.weight, field_of(model, rows)))
    for external in (model.moment, moment):
        if external is not None:
            total = add(total, rotate_back(rows, external))
    return total


def field_of(model: Model, rows: Rows) -> Triple:
    """Gravity in {E}."""
    return ZERO if model.gravity is None else rotate_back(rows, model.gravity)


def _quotient(torque: Scalar, u: Scalar) -> Scalar:
    return 0.0 if type(torque) is float and torque == 0.0 else torque / sqrt(u)


def kinetic_energy(model: Model, state: tuple[Scalar, ...]) -> Scalar:
    """Kinetic energy of all seven links, payload and rotors [J]."""
    x, y, z, w, wx, wy, wz = state[:7]
    ixx, iyy, izz, ixy, ixz, iyz = model.star
    total = ixx * wx * wx + iyy * wy * wy + izz * wz * wz
    total = total + 2.0 * (ixy * wx * wy + ixz * wx * wz + iyz * wy * wz)
    rows = rotation_rows((x, y, z, w))
    for leg in model.legs:
        at = leg_motion(leg, rows, (wx, wy, wz))
        total = total + (leg.a0 + leg.a2 * (at.a * at.a)) * at.gamma_dot * at.gamma_dot
        if leg.ixy or leg.ixz or leg.iyz:
            root = sqrt(at.u)
            mixed = (leg.ixz * at.a / root - leg.ixy) * at.a_dot
            mixed = mixed - leg.iyz * at.a * root * at.gamma_dot
            total = total + 2.0 * mixed * at.gamma_dot
    return 0.5 * total


def potential_energy(model: Model, state: tuple[Scalar, ...]) -> Scalar:
    """Potential energy [J]: weight, springs and elastic stops."""
    x, y, z, w, wx, wy, wz = state[:7]
    rows = rotation_rows((x, y, z, w))
    field = field_of(model, rows)
    total: Scalar = 0.0 if model.gravity is None else -dot(model.weight, field)
    for leg in model.legs:
        if leg.loads is not None:
            at = leg_motion(leg, rows, (wx, wy, wz))
            total = total + spring_and_weight_energy(at, field)
    return total


def power(
    model: Model, state: tuple[Scalar, ...], torque: Triple, moment: Triple | None = None
) -> Scalar:
    """Power [W] that actuators and external moments put in, less what friction takes out.

    It is the rate of kinetic plus potential energy. With lag the torques are the state's own.
    """
    x, y, z, w, wx, wy, wz, *given = state
    rows = rotation_rows((x, y, z, w))
    acting = torque if model.time_constant is None else given
    total: Scalar = 0.0
    for leg, drive in zip(model.legs, acting, strict=True):
        at = leg_motion(leg, rows, (wx, wy, wz))
        total = total + drive * at.gamma_dot
        if leg.loads is not None:
            total = total - dissipation(at)
    for external in (model.moment, moment):
        if external is not None:
            total = total + dot(external, triple(dot(row, (wx, wy, wz)) for row in rows))
    return total
