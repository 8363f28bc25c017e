# SPDX-License-Identifier: Apache-2.0
"""What the dynamics take from a scene: leg inertias, joint loads, where it stops."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np

from sst_ros.dynamics.own_loads import LoadConstants, load_constants
from sst_ros.errors import RunStopped, SingularityReached, StrokeExceeded, WorkspaceLeft
from sst_ros.mechanism.generic_math import Symmetric, Triple, cross3, multiply, triple
from sst_ros.mechanism.geometry import Geometry
from sst_ros.scene.bodies import PLACES, Payload, Star, Stroke, entries_of
from sst_ros.scene.loads import Friction
from sst_ros.state import JOINT_COUNT, ZERO

LEGS = 3
JOINT_NAMES = ("gamma", "mu", "beta")  # of a leg, from the base to the star
# their places in the joints of a leg
AT_GAMMA = 0
AT_MU = 1
AT_BETA = 2
# distance of mu_k from 0 and pi [rad] within which gamma_k has lost its meaning
SINGULAR_MU = 1e-6
# farther beyond than this [rad], an actuator has not just reached the contact
CONTACT_BAND = 1e-9
_FREE_BEYOND = 4.0 * CONTACT_BAND
"""Distance from an elastic stop [rad] from which on there is no contact.

It is well beyond the band in which an actuator may still be at the contact.
"""
# a distance below this [rad] counts as zero: closure and rounding reach 1e-15
GRAZING = 1e-12
_STEP_WIDTH = 2.0
"""Largest change of v / smoothing in a step. Its tanh has poles at pi / 2 from the real
axis: steps of this width converge with the order of their method.
"""
_INVERSE_LANGEVIN_SERIES = (
    3.0,
    9 / 5,
    297 / 175,
    1539 / 875,
    126117 / 67375,
    43733439 / 21896875,
)
"""Taylor coefficients of y, y^3, ... y^11 in the x that solves coth x - 1/x = y
(Itskov, Dargazany & Hoernes, Math. Mech. Solids 17 (2012) 693-701)."""
_RESOLVED = 0.1
"""Share of the tolerance that a width exceeds: the local errors of accepted steps alone
would leap over a narrower one, and steps would shrink without end where a joint
sticks."""


class JointSpring(NamedTuple):
    """All springs of one joint as one: torque -stiffness (angle - rest)."""

    stiffness: float
    rest: float


class ElasticStops(NamedTuple):
    """Elastic stops at the ends of the stroke, 0 and arc."""

    arc: float
    stiffness: float
    damping: float


class Leg(NamedTuple):
    """Constants of one leg and its loads: None or zero where the scene has none.

    A = A0 + A2 a^2 - 2 Iyz a sqrt(u) and C = Ixz a/sqrt(u) - Ixy, with A0 = I_a(zz) +
    Iyy - Ixx and A2 = Izz - Iyy + Ixx.
    """

    w: Triple  # axis of the arc in {B}
    v: Triple  # its start
    across: Triple
    e0: float  # axis (e0, e1, 0) in {E}
    e1: float
    a0: float = 0.0
    a2: float = 0.0
    ixy: float = 0.0
    ixz: float = 0.0
    iyz: float = 0.0
    friction: tuple[Friction | None, ...] = (None, None, None)  # of gamma, mu, beta
    springs: tuple[JointSpring | None, ...] = (None, None, None)
    drive: Triple = ZERO  # mass times centre of the actuated link in {1k} [kg m]
    link: Triple = ZERO  # mass times centre of the intermediate link in {2k} [kg m]
    stops: ElasticStops | None = None


class Model(NamedTuple):
    """All constants of the dynamics; None for what the scene does not have."""

    # of star, payload and what of the intermediate links turns with them, in {E}
    star: Symmetric
    legs: tuple[Leg, Leg, Leg]
    gravity: Triple | None = None  # acceleration of free fall in {B} [m/s^2]
    weight: Triple = ZERO  # mass times centre of star and payload in {E} [kg m]
    moment: Triple | None = None  # constant, on the star in {B} [N m]
    time_constant: float | None = None  # lag of the actuators [s]
    own_loads: tuple[LoadConstants, ...] = ()


def model_of(scene: Any, geometry: Geometry | None = None) -> Model:
    """Collect the constants of a `Scene`; its geometry may be given where it is known.

    The numbers of the scene and its geometry may be columns, of many scenes at once.
    """
    if geometry is None:
        geometry = Geometry.of(scene)
    star = entries_of(scene.star.inertia)
    carried: list[Star | Payload] = [scene.star]
    damping = damping_of(scene.stroke)
    if scene.payload is not None:
        carried.append(scene.payload)
        pairs = zip(star, scene.payload.entries, strict=True)
        star = [entry + payload_entry for entry, payload_entry in pairs]
    legs = []
    for k in range(LEGS):
        _, _, drive_zz, *_ = actuated_inertia(scene, k)
        xx, *_ = entries_of(scene.intermediate_links[k].inertia)
        e = tuple(geometry.of_leg("e", k))
        # Across t_k the link turns as the star: Ixx (1 - t t^T) is the star's.
        star = [
            entry + xx * (float(i == j) - e[i] * e[j])
            for entry, (i, j) in zip(star, PLACES, strict=True)
        ]
        legs.append(_leg_of(scene, geometry, k, drive_zz, damping))
    gravity = None
    if scene.gravity is not None:
        gravity = scene.gravity.acceleration
    moment = None
    if scene.moment is not None:
        moment = scene.moment.value
    time_constant = None
    if scene.actuators is not None:
        time_constant = scene.actuators.time_constant
    weight = [sum(body.mass * body.centre[i] for body in carried) for i in range(3)]
    return Model(
        star=tuple(star),
        legs=triple(legs),
        gravity=gravity,
        weight=triple(weight),
        moment=moment,
        time_constant=time_constant,
        own_loads=tuple(map(load_constants, scene.own_loads)),
    )


def actuated_inertia(scene: Any, k: int) -> list[Any]:
    """Return the inertia of the actuated link of leg k with its rotor's [kg m^2].

    It has the entries xx, yy, zz, xy, xz and yz in {1k}.
    """
    xx, yy, zz, *products = entries_of(scene.actuated_links[k].inertia)
    if scene.actuators is not None:
        gear = scene.actuators.gear_ratio
        zz = zz + gear * gear * scene.actuators.rotor_inertia
    return [xx, yy, zz, *products]


def _leg_of(scene: Any, geometry: Geometry, k: int, drive_zz: Any, damping: Any) -> Leg:
    """Collect the constants of leg k, with the inertia of its drive about w_k."""
    w = tuple(geometry.of_leg("w", k))
    v = tuple(geometry.of_leg("v", k))
    e0, e1, _ = geometry.of_leg("e", k)
    actuated = scene.actuated_links[k]
    intermediate = scene.intermediate_links[k]
    xx, yy, zz, xy, xz, yz = entries_of(intermediate.inertia)
    drive = ZERO
    link = ZERO
    if scene.gravity is not None:
        drive = multiply(actuated.mass, actuated.centre)
        link = multiply(intermediate.mass, intermediate.centre)
    stops = None
    if scene.stroke.stiffness is not None:
        arc = geometry.of_leg("arc", k)
        stops = ElasticStops(arc, scene.stroke.stiffness, damping)
    a0 = drive_zz + yy - xx
    a2 = zz - yy + xx
    springs = _springs_of(scene, k)
    return Leg(
        w=w,
        v=v,
        across=cross3(w, v),
        e0=e0,
        e1=e1,
        a0=a0,
        a2=a2,
        ixy=xy,
        ixz=xz,
        iyz=yz,
        friction=_friction_of(scene),
        springs=springs,
        drive=drive,
        link=link,
        stops=stops,
    )


def _friction_of(scene: Any) -> tuple[Friction | None, ...]:
    """Return the friction of gamma, mu and beta, None where a joint has none."""
    return tuple(getattr(scene.friction, name, None) for name in JOINT_NAMES)


def _springs_of(scene: Any, k: int) -> tuple[JointSpring | None, ...]:
    """Return the springs of gamma, mu and beta of leg k, one a joint."""
    springs = []
    for name in JOINT_NAMES:
        joint = f"{name}_{k + 1}"
        springs.append(
            _join([spring for spring in scene.springs if spring.joint == joint])
        )
    return tuple(springs)


def damping_of(stroke: Stroke) -> Any:
    """Return the damping of elastic stops [s/rad].

    It is as given, or from the restitution at the impact rate. Its numbers may be
    columns.

    For one freedom of inertia m, m v dv/dx = -k x (1 + c v) separates: from the rate v
    into the stop to e v out of it, with d = c v,

        d (1 + e) = ln((1 + d) / (1 - d e)),

    whatever m and k (Gonthier, McPhee, Lange & Piedboeuf, Multibody Syst. Dyn. 11
    (2004) 209-233; the force is that of Hunt & Crossley, J. Appl. Mech. 42 (1975)
    440-445). With s = d (1 + e) it reads L(s/2) = (1 - e) / (1 + e), where L(x) = coth
    x - 1/x is Langevin's function.
    """
    if stroke.restitution is None or stroke.impact_rate is None:
        return stroke.damping
    e = stroke.restitution
    lost_share = (1.0 - e) / (1.0 + e)
    if isinstance(e, np.ndarray):
        half_s = np.vectorize(_inverse_langevin)(lost_share)
    else:
        half_s = _inverse_langevin(lost_share)
    return 2.0 * half_s / ((1.0 + e) * stroke.impact_rate)


def _inverse_langevin(y: float) -> float:
    """Solve coth x - 1/x = y for x >= 0, 0 <= y < 1."""
    if y < 0.05:  # coth x - 1/x would cancel; the next term of the series is 2.1 y^13
        terms = enumerate(_INVERSE_LANGEVIN_SERIES)
        return sum(coefficient * y ** (2 * i + 1) for i, coefficient in terms)
    # 1 - 1/x <= coth x - 1/x <= x/3; the upper end is widened, so that rounding cannot
    # put it below the lower one.
    low = 3.0 * y
    high = 1.0 / (1.0 - y) + 3.0 * y
    while True:  # at most some sixty bisections
        x = 0.5 * (low + high)
        if not low < x < high:
            return x
        if 1.0 / math.tanh(x) - 1.0 / x < y:
            low = x
        else:
            high = x


def _join(springs: list[Any]) -> JointSpring | None:
    """Return springs of one joint as one; None where there are none."""
    if not springs:
        return None
    stiffness = sum(spring.stiffness for spring in springs)
    moment = sum(spring.stiffness * spring.rest for spring in springs)
    return JointSpring(stiffness, moment / stiffness)


class Limit(NamedTuple):
    """One end: sign * (angle of a joint - end) >= 0."""

    reason: str  # text of the error when the run stops here
    error: type[RunStopped] | None  # what is raised then; None for a contact event
    joint: int  # number in (gamma_1..3, mu_1..3, beta_1..3), from 0
    sign: float  # +1 for a lower end, -1 for an upper one
    end: Any  # angle [rad]

    def distance(self, joints: Sequence[float]) -> Any:
        """Distance to the end [rad], negative beyond it.

        Nine angles, then nine rates.
        """
        return self.sign * (joints[self.joint] - self.end)

    def slope(self, joints: Sequence[float]) -> float:
        """Rate of the distance [rad/s]."""
        return self.sign * joints[self.joint + JOINT_COUNT]


def ranges_of(limits: Sequence[Limit]) -> list[tuple[int, float, float]]:
    """Return the joint, lower and upper end of each range that the limits leave.

    An end is infinite where there is no limit.
    """
    ranges: dict[int, tuple[float, float]] = {}
    for limit in limits:
        low, high = ranges.get(limit.joint, (-math.inf, math.inf))
        if limit.sign > 0.0:
            low = limit.end
        else:
            high = limit.end
        ranges[limit.joint] = (low, high)
    return [(joint, low, high) for joint, (low, high) in ranges.items()]


def limits_of(scene: Any, geometry: Geometry) -> Iterator[Limit]:
    """Yield the serial singularities, and the ends at which a scene's motion stops.

    The ends of many geometries are columns, whose numbers are in no message.
    """

    def above(name: str, end: Any) -> str:
        if isinstance(end, float):
            return f"{name} > {end:.6f} rad"
        return f"{name} > its end"

    for k in range(LEGS):
        singular = f"serial singularity, mu_{k + 1}"
        mu = AT_MU * LEGS + k
        yield Limit(f"{singular} = 0", SingularityReached, mu, 1.0, SINGULAR_MU)
        most = math.pi - SINGULAR_MU
        yield Limit(f"{singular} = pi", SingularityReached, mu, -1.0, most)
        if scene.stroke.at_end == "stop":
            arc = geometry.of_leg("arc", k)
            name = f"gamma_{k + 1}"
            yield Limit(f"{name} < 0", StrokeExceeded, k, 1.0, 0.0)
            yield Limit(above(name, arc), StrokeExceeded, k, -1.0, arc)
        if scene.workspace.at_edge == "stop":
            name = f"beta_{k + 1}"
            beta = AT_BETA * LEGS + k
            edge = geometry.beta_max
            yield Limit(f"{name} < 0", WorkspaceLeft, beta, 1.0, 0.0)
            yield Limit(above(name, edge), WorkspaceLeft, beta, -1.0, edge)


def contact_events_of(scene: Any, geometry: Geometry) -> Iterator[Limit]:
    """Yield begin and end of contact at a `Scene`'s elastic stops, a limit each."""
    if scene.stroke.at_end == "elastic":
        for k in range(LEGS):
            for end in (0.0, float(geometry.arc[k])):
                for sign in (1.0, -1.0):
                    yield Limit(f"gamma_{k + 1} = {end:.6f} rad", None, k, sign, end)


def free_range(events: Sequence[Limit]) -> list[Limit]:
    """Return limits of the range in which no elastic stop can be in contact."""
    # Of the two events at each end: the one whose distance is positive inside.
    inner = [event for event in events if (event.end == 0.0) == (event.sign > 0.0)]
    return [
        event._replace(end=event.end + _FREE_BEYOND * event.sign) for event in inner
    ]


class Transition(NamedTuple):
    """The rates of a joint within which its friction changes."""

    rate: int  # place of the joint's rate behind all angles
    edge: float  # magnitude from which the friction is constant [rad/s]
    width: float  # part of the range that a step may pass [rad/s]


def transitions_of(scene: Any, tolerance: float) -> tuple[Transition, ...]:
    """Return the transitions of the joints of a `Scene`.

    They end where 1 - tanh(x), about 2 exp(-2 x), is below the tolerance. One that is
    narrower than local errors is left out.
    """
    edge = 0.5 * math.log(max(2.0 / tolerance, 1.0))
    if scene.friction is None or edge == 0.0:
        return ()
    transitions = []
    for joint, friction in enumerate(_friction_of(scene)):
        if friction is None or not (friction.coulomb or friction.static):
            continue
        width = _STEP_WIDTH * friction.smoothing
        if width < _RESOLVED * tolerance:
            continue
        for k in range(LEGS):
            rate = JOINT_COUNT + joint * LEGS + k
            transitions.append(Transition(rate, edge * friction.smoothing, width))
    return tuple(transitions)
