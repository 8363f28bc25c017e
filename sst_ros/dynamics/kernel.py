# SPDX-License-Identifier: Apache-2.0
"""The dynamics that run, rational in the state.

The state is the quaternion q of {E} in {B} and the body angular velocity W.

In {E} the axis t_k of arc k is constant and the actuator axis w_k is a combination of
rows of R. With a = cos(mu_k) = t.w, p = t x w, u = 1 - a^2 and g = (w - a t)/u a leg
moves as

    a_dot = p.W,    gamma_dot = g.W,

both rates of true coordinates. Across t_k the intermediate link turns as the star does,
so the part Ixx (1 - t t^T) of its inertia belongs to the star, for good; what is left
of a leg is the kinetic energy C a_dot gamma_dot + A gamma_dot^2 / 2. Its inertia forces
act on the star through p and g (virtual work). The loops are closed by construction,
and M is positive definite wherever u > 0: only a serial singularity (t_k = +-w_k) has
no dynamics.

The inertial part uses + - * / and, for a link with products of inertia xz or yz, one
square root; loads may need angles. The functions run on floats, complex numbers, NumPy
columns, mpmath numbers and expressions alike; the simulation runs what `trace` leaves
of them for a scene.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

from sst_ros.dynamics.model import (
    AT_BETA,
    AT_GAMMA,
    AT_MU,
    JOINT_NAMES,
    LEGS,
    ElasticStops,
    Leg,
    Model,
    model_of,
)
from sst_ros.dynamics.own_loads import LoadConstants, load_program, run_program
from sst_ros.mechanism.generic_math import (
    Quadruple,
    Rows,
    Scalar,
    Symmetric,
    Triple,
    add,
    atan2,
    axpy,
    cross3,
    dot3,
    exp,
    multiply,
    positive,
    quaternion_rate,
    rotate_back,
    rotation_rows,
    solve_symmetric,
    sqrt,
    symmetric_rows,
    tanh,
    transform,
    triple,
)
from sst_ros.scene.bodies import PLACES
from sst_ros.scene.loads import Friction
from sst_ros.scene.own_loads import ANGLE_NAMES, BODY_RATE, OMEGA, ROTATION
from sst_ros.state import ZERO, Joints

__all__ = ["Leg", "Model", "model_of"]


class LegMotion(NamedTuple):
    """One leg at one instant, with the letters of this module's docstring.

    All vectors but `outward` are in {E}.
    """

    leg: Leg
    axis: Triple  # w_k
    along: Triple  # t_k = (e0, e1, 0)
    a: Scalar
    p: Triple
    u: Scalar
    g: Triple
    b: Triple  # beta_dot = b.W
    outward: Triple  # p in {B}, along r_k
    gamma_dot: Scalar
    a_dot: Scalar
    beta_dot: Scalar


def derivative(
    model: Model,
    state: tuple[Scalar, ...],
    torque: Triple,
    moment: Triple | None = None,
) -> tuple[Scalar, ...]:
    """Return the time derivative of the state: quaternion (x, y, z, w), then W.

    The quaternion has any length > 0; W [rad/s] is in {E}. Where the actuators lag, the
    torques [N m] that they give follow, and `torque` has the commanded ones. `moment`
    acts on the star, in {B} [N m].
    """
    x, y, z, w, wx, wy, wz, *lagged = state
    q = (x, y, z, w)
    rate = (wx, wy, wz)
    lag_rates: tuple[Scalar, ...] = ()
    lag = model.time_constant
    if lag is not None:
        pairs = zip(torque, lagged, strict=True)
        lag_rates = tuple((command - acting) / lag for command, acting in pairs)
        torque = triple(lagged)
    inertia, force, _ = balance(model, q, rate, torque, moment)
    acceleration = solve_symmetric(inertia, force)
    return (*quaternion_rate(q, rate), *acceleration, *lag_rates)


def actuator_torque(
    model: Model,
    q: Quadruple,
    rate: Triple,
    acceleration: Triple,
    moment: Triple | None = None,
) -> tuple[Triple, Scalar]:
    """Torques [N m] of the inverse dynamics, and the determinant of the rows g_k.

    The torques do the work tau_k g_k.W on the star: M W_dot = force + sum tau_k g_k.
    With g_k = N_k / c_k the determinant is -det J2 / (c_1 c_2 c_3), zero at a parallel
    singularity.
    """
    inertia, acting, (first, second, third) = balance(model, q, rate, ZERO, moment)
    rows = zip(symmetric_rows(inertia), acting, strict=True)
    missing = triple(dot3(row, acceleration) - force for row, force in rows)
    cofactors = (cross3(second, third), cross3(third, first), cross3(first, second))
    determinant = dot3(first, cofactors[0])
    torque = triple(dot3(missing, cofactor) / determinant for cofactor in cofactors)
    return torque, determinant


def balance(
    model: Model,
    q: Quadruple,
    rate: Triple,
    torque: Triple,
    moment: Triple | None = None,
) -> tuple[Symmetric, Triple, Rows]:
    """Reduce everything to the star by virtual work: M W_dot = force in {E}.

    Returns M (xx, yy, zz, xy, xz, yz) [kg m^2]; the moment of all that acts at W_dot =
    0, velocity products included [N m]; and the rows g_k: gamma_dot_k = g_k.W, and a
    torque at gamma_k acts as tau_k g_k.
    """
    rows = rotation_rows(q)
    inertia: tuple[Scalar, ...] = model.star
    force = cross3(transform(symmetric_rows(model.star), rate), rate)
    field = ZERO
    if model.gravity is not None:
        field = rotate_back(rows, model.gravity)
        force = add(force, cross3(model.weight, field))
    for external in (model.moment, moment):
        if external is not None:
            force = add(force, rotate_back(rows, external))
    own = own_torques(model, rows, rate) if model.own_loads else None
    if own is not None:
        force = add(force, own.star)
    jacobian = []
    for k, (leg, drive) in enumerate(zip(model.legs, torque, strict=True)):
        motion = leg_motion(leg, rows, rate)
        p = motion.p
        g = motion.g
        jacobian.append(g)
        forces = _inertia_forces(motion, rate, drive)
        loads = joint_torques(motion, field)
        if own is not None:
            loads = add(loads, own.joints[k])
        at_gamma, at_mu, at_beta = loads
        force_gamma = forces.gamma - at_gamma
        force_a = forces.a
        # Python's 0.0 is no load at mu: then no square root is traced for it.
        if not (type(at_mu) is float and at_mu == 0.0):
            force_a = force_a + at_mu / sqrt(motion.u)  # mu_dot = -a_dot / sqrt(u)
        force = triple(f + at_beta * b for f, b in zip(force, motion.b, strict=True))
        force = triple(
            f - force_a * along - force_gamma * across
            for f, along, across in zip(force, p, g, strict=True)
        )
        inertia = tuple(
            entry + forces.a_row[i] * p[j] + forces.gamma_row[i] * g[j]
            for entry, (i, j) in zip(inertia, PLACES, strict=True)
        )
    xx, yy, zz, xy, xz, yz = inertia
    return (xx, yy, zz, xy, xz, yz), force, triple(jacobian)


class InertiaForces(NamedTuple):
    """What the inertia of a leg takes at its coordinates a and gamma.

    That is a_row.W_dot + a at a, and gamma_row.W_dot + gamma, less the torque of the
    actuator, at gamma.
    """

    a_row: Triple
    a: Scalar
    gamma_row: Triple
    gamma: Scalar


def _inertia_forces(motion: LegMotion, rate: Triple, drive: Scalar) -> InertiaForces:
    """Apply Lagrange's equations to T = C a_dot gamma_dot + A gamma_dot^2 / 2."""
    leg = motion.leg
    a = motion.a
    a_dot = motion.a_dot
    gamma_dot = motion.gamma_dot
    a_rest, gamma_rest = rest_accelerations(motion, rate)
    # A and C, and their derivatives by a
    a_inertia = leg.a0 + leg.a2 * (a * a)
    a_slope = 2.0 * leg.a2 * a
    c_inertia = 0.0
    c_slope = 0.0
    if leg.ixy or leg.ixz or leg.iyz:
        root = sqrt(motion.u)
        c_inertia = leg.ixz * a / root - leg.ixy
        c_slope = leg.ixz / (motion.u * root)
        a_inertia = a_inertia - 2.0 * leg.iyz * a * root
        a_slope = a_slope - 2.0 * leg.iyz * (1.0 - 2.0 * a * a) / root
    force_a = c_inertia * gamma_rest - 0.5 * a_slope * gamma_dot * gamma_dot
    force_gamma = a_inertia * gamma_rest + c_inertia * a_rest - drive
    force_gamma = force_gamma + a_slope * a_dot * gamma_dot + c_slope * a_dot * a_dot
    a_row = multiply(c_inertia, motion.g)
    gamma_row = axpy(a_inertia, motion.g, c_inertia, motion.p)
    return InertiaForces(a_row, force_a, gamma_row, force_gamma)


def split_motion(state: Sequence[Scalar]) -> tuple[Quadruple, Triple]:
    """Return the quaternion and the body rate W that a state begins with."""
    x, y, z, w, wx, wy, wz, *_ = state
    return (x, y, z, w), (wx, wy, wz)


def joints(model: Model, state: tuple[Scalar, ...]) -> Joints:
    """Angles and rates of all joints. See `kinematics.inverse` for the branches."""
    of_legs = []
    for motion in leg_motions(model, state):
        angles = [joint_angle(motion, joint) for joint in (AT_GAMMA, AT_MU, AT_BETA)]
        rates = [joint_rate(motion, joint) for joint in (AT_GAMMA, AT_MU, AT_BETA)]
        of_legs.append([*angles, *rates])
    return Joints(*zip(*of_legs, strict=True))


def leg_motions(model: Model, state: Sequence[Scalar]) -> Iterator[LegMotion]:
    """Yield the motion of each leg; the state begins with quaternion and W."""
    q, rate = split_motion(state)
    rows = rotation_rows(q)
    for leg in model.legs:
        yield leg_motion(leg, rows, rate)


def leg_motion(leg: Leg, rows: Rows, rate: Triple) -> LegMotion:
    """Vectors and rates of a leg; `rows` are the rows of R, `rate` is W."""
    e0 = leg.e0
    e1 = leg.e1
    x, y, z = rotate_back(rows, leg.w)
    a = e0 * x + e1 * y
    across = e0 * y - e1 * x  # (t x w) along z
    p = (e1 * z, -(e0 * z), across)
    u = across * across + z * z
    g = ((x - a * e0) / u, (y - a * e1) / u, z / u)
    b = ((a * x - e0) / u, (a * y - e1) / u, a * z / u)
    outward = transform(rows, p)
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
        gamma_dot=dot3(g, rate),
        a_dot=dot3(p, rate),
        beta_dot=dot3(b, rate),
    )


def rest_accelerations(motion: LegMotion, rate: Triple) -> tuple[Scalar, Scalar]:
    """Accelerations of the coordinates a and gamma of a leg at W_dot = 0."""
    along = dot3(motion.along, rate)
    a_rest = dot3(motion.axis, rate) * along - motion.a * dot3(rate, rate)
    products = motion.a_dot * (2.0 * motion.a * motion.gamma_dot - along)
    return a_rest, products / motion.u


def actuator_acceleration(
    model: Model, state: Sequence[Scalar], acceleration: Triple
) -> Triple:
    """Return gamma_ddot [rad/s^2] of a state and its W_dot.

    The state begins with quaternion and W.
    """
    _, rate = split_motion(state)
    gamma_ddot = []
    for motion in leg_motions(model, state):
        _, gamma_rest = rest_accelerations(motion, rate)
        gamma_ddot.append(dot3(motion.g, acceleration) + gamma_rest)
    return triple(gamma_ddot)


def kinetic_energy(model: Model, state: tuple[Scalar, ...]) -> Scalar:
    """Kinetic energy of all seven links, payload and rotors [J]."""
    _, (wx, wy, wz) = split_motion(state)
    ixx, iyy, izz, ixy, ixz, iyz = model.star
    total = ixx * wx * wx + iyy * wy * wy + izz * wz * wz
    total = total + 2.0 * (ixy * wx * wy + ixz * wx * wz + iyz * wy * wz)
    for motion in leg_motions(model, state):
        leg = motion.leg
        a_inertia = leg.a0 + leg.a2 * (motion.a * motion.a)
        total = total + a_inertia * motion.gamma_dot * motion.gamma_dot
        if leg.ixy or leg.ixz or leg.iyz:
            root = sqrt(motion.u)
            mixed = (leg.ixz * motion.a / root - leg.ixy) * motion.a_dot
            mixed = mixed - leg.iyz * motion.a * root * motion.gamma_dot
            total = total + 2.0 * mixed * motion.gamma_dot
    return 0.5 * total


def potential_energy(model: Model, state: tuple[Scalar, ...]) -> Scalar:
    """Potential energy [J]: weight, springs and elastic stops."""
    q, rate = split_motion(state)
    rows = rotation_rows(q)
    field = ZERO
    total: Scalar = 0.0
    if model.gravity is not None:
        field = rotate_back(rows, model.gravity)
        total = -dot3(model.weight, field)
    for motion in leg_motions(model, state):
        leg = motion.leg
        own = 0.0
        for joint, spring in enumerate(leg.springs):
            if spring is not None:
                stretch = joint_angle(motion, joint) - spring.rest
                own = own + 0.5 * spring.stiffness * stretch * stretch
        if leg.stops is not None:
            gamma = joint_angle(motion, AT_GAMMA)
            for depth in (positive(-gamma), positive(gamma - leg.stops.arc)):
                own = own + 0.5 * leg.stops.stiffness * depth * depth
        if any(leg.drive) or any(leg.link):
            first, second = _link_axes(motion)
            own = own - dot3(rotate_back(first, leg.drive), field)
            own = own - dot3(rotate_back(second, leg.link), field)
        total = total + own
    legs = list(leg_motions(model, state)) if model.own_loads else []
    for load in model.own_loads:
        if load.formula.potential is not None:
            energy, *_ = _run_load(load, rows, rate, legs)
            total = total + energy
    return total


def power(
    model: Model,
    state: tuple[Scalar, ...],
    torque: Triple,
    moment: Triple | None = None,
) -> Scalar:
    """Return the power [W] that is put in, less what friction takes out.

    Actuators and external moments put it in. It is the rate of kinetic plus potential
    energy. With lag the torques are the state's own.
    """
    x, y, z, w, wx, wy, wz, *lagged = state
    rate = (wx, wy, wz)
    rows = rotation_rows((x, y, z, w))
    acting = torque if model.time_constant is None else lagged
    total: Scalar = 0.0
    for motion, drive in zip(leg_motions(model, state), acting, strict=True):
        total = total + drive * motion.gamma_dot
        total = total - _lost_power(motion)
    for external in (model.moment, moment):
        if external is not None:
            total = total + dot3(external, transform(rows, rate))
    for load in model.own_loads:
        if load.formula.moment:
            legs = list(leg_motions(model, state))
            total = total + dot3(_own_moment(load, rows, rate, legs), rate)
    return total


def _lost_power(motion: LegMotion) -> Scalar:
    """Return the power [W] that friction and the damping of stops take from a leg."""
    leg = motion.leg
    lost = 0.0
    for joint, friction in enumerate(leg.friction):
        if friction is not None:
            rate = joint_rate(motion, joint)
            lost = lost + friction_torque(friction, rate) * rate
    if leg.stops is not None and leg.stops.damping:
        gamma = joint_angle(motion, AT_GAMMA)
        speed = motion.gamma_dot
        elastic = leg.stops._replace(damping=0.0)
        elastic_torque = stop_torque(elastic, gamma, speed)
        damping_torque = elastic_torque - stop_torque(leg.stops, gamma, speed)
        lost = lost + damping_torque * speed
    return lost


# Loads of one leg: gravity, friction, springs and elastic stops. What the scene does
# not have is Python's 0.0, which leaves nothing behind in a traced program.


def joint_torques(motion: LegMotion, field: Triple) -> Triple:
    """Torques [N m] of the loads at gamma, mu and beta; `field` is gravity in {E}."""
    leg = motion.leg
    torques = []
    for joint in (AT_GAMMA, AT_MU, AT_BETA):
        rubbing = 0.0
        restoring = 0.0
        friction = leg.friction[joint]
        spring = leg.springs[joint]
        if friction is not None:
            rubbing = -friction_torque(friction, joint_rate(motion, joint))
        if spring is not None:
            restoring = -spring.stiffness * (joint_angle(motion, joint) - spring.rest)
        torques.append(rubbing + restoring)
    at_gamma = 0.0
    at_mu = 0.0
    if any(leg.drive) or any(leg.link):  # weight: moments about w_k and -r_k
        of_drive, of_link = _link_axes(motion)
        on_link = cross3(rotate_back(of_link, leg.link), field)
        on_drive = cross3(rotate_back(of_drive, leg.drive), field)
        r, _, _ = of_drive
        at_gamma = dot3(add(on_link, on_drive), motion.axis)
        at_mu = -dot3(on_link, r)
    if leg.stops is not None:
        gamma = joint_angle(motion, AT_GAMMA)
        at_gamma = at_gamma + stop_torque(leg.stops, gamma, motion.gamma_dot)
    of_gamma, of_mu, of_beta = torques
    return of_gamma + at_gamma, of_mu + at_mu, of_beta


class OwnTorques(NamedTuple):
    """What the own loads of a scene do."""

    star: Triple  # moment on the star in {E} [N m]
    joints: list[Triple]  # torques at gamma, mu and beta by leg [N m]


def own_torques(model: Model, rows: Rows, rate: Triple) -> OwnTorques:
    """Sum the own loads; `rows` are the rows of R, `rate` is W."""
    legs = [leg_motion(leg, rows, rate) for leg in model.legs]
    star: Triple = ZERO
    joints: list[Triple] = [ZERO, ZERO, ZERO]
    for load in model.own_loads:
        if load.formula.moment:
            star = add(star, _own_moment(load, rows, rate, legs))
            continue
        _potential, *slopes = _run_load(load, rows, rate, legs)
        names = load_program(load.formula).quantities
        by_name = dict(zip(names, slopes, strict=True))
        for i, row in enumerate(rows, start=1):
            by_row = triple(by_name.get(f"R{i}{j}", 0.0) for j in (1, 2, 3))
            star = add(star, cross3(row, by_row))  # -G_i x R_i
        for k in range(LEGS):
            angles = (f"{joint}_{k + 1}" for joint in JOINT_NAMES)
            torques = triple(-by_name.get(name, 0.0) for name in angles)
            joints[k] = add(joints[k], torques)
    return OwnTorques(star, joints)


def _own_moment(
    load: LoadConstants, rows: Rows, rate: Triple, legs: Sequence[LegMotion]
) -> Triple:
    """Moment of an own load on the star in {E} [N m]."""
    moment = triple(_run_load(load, rows, rate, legs))
    return moment if load.formula.in_star else rotate_back(rows, moment)


def _run_load(
    load: LoadConstants, rows: Rows, rate: Triple, legs: Sequence[LegMotion]
) -> list[Scalar]:
    """Run the program of an own load at a state."""
    names, program = load_program(load.formula)
    values = [_quantity(name, rows, rate, legs) for name in names]
    return run_program(program, [*values, *load.parameters])


def _quantity(name: str, rows: Rows, rate: Triple, legs: Sequence[LegMotion]) -> Scalar:
    """Return what a name in a formula means: see `scene.own_loads.STATE_NAMES`."""
    if name in ROTATION:
        row, column = divmod(ROTATION.index(name), 3)
        return rows[row][column]
    if name in OMEGA:
        return dot3(rows[OMEGA.index(name)], rate)
    if name in BODY_RATE:
        return rate[BODY_RATE.index(name)]
    angle, _, _ = name.partition("_")
    joint = JOINT_NAMES.index(angle)
    leg = legs[int(name[-1]) - 1]
    return joint_angle(leg, joint) if name in ANGLE_NAMES else joint_rate(leg, joint)


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
    """Torque of elastic stops; its damping grows with the depth (Hunt-Crossley)."""
    low = positive(-gamma)
    high = positive(gamma - stops.arc)
    if not stops.damping:
        return stops.stiffness * (low - high)
    inward = stops.damping * gamma_dot
    return stops.stiffness * (
        low * positive(1.0 - inward) - high * positive(1.0 + inward)
    )


def joint_rate(motion: LegMotion, joint: int) -> Scalar:
    """Rate of a joint, AT_GAMMA, AT_MU or AT_BETA [rad/s]."""
    if joint == AT_GAMMA:
        return motion.gamma_dot
    if joint == AT_MU:
        return -motion.a_dot / sqrt(motion.u)
    return motion.beta_dot


def joint_angle(motion: LegMotion, joint: int) -> Scalar:
    """Angle of a joint, AT_GAMMA, AT_MU or AT_BETA [rad]."""
    return atan2(*direction_of(motion, joint))


def direction_of(motion: LegMotion, joint: int) -> tuple[Scalar, Scalar]:
    """Sine and cosine of the angle of a joint, AT_GAMMA, AT_MU or AT_BETA.

    Those of gamma and beta are multiplied by sqrt(u).
    """
    if joint == AT_GAMMA:
        leg = motion.leg
        return dot3(motion.outward, leg.across), dot3(motion.outward, leg.v)
    if joint == AT_MU:
        return sqrt(motion.u), motion.a
    # p.(t x s) and p.s with s = (0, 0, 1)
    t_x, t_y, _ = motion.along
    p_x, p_y, p_z = motion.p
    return p_x * t_y - p_y * t_x, p_z


def _link_axes(motion: LegMotion) -> tuple[Rows, Rows]:
    """Axes of {1k} = [r, w x r, w] and {2k} = [r, t x r, t] in {E}."""
    root = sqrt(motion.u)
    r = triple(component / root for component in motion.p)
    w = motion.axis
    t = motion.along
    return (r, cross3(w, r), w), (r, cross3(t, r), t)
