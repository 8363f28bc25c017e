# SPDX-License-Identifier: Apache-2.0
"""The manipulator as links, joints and shapes, for the view, and as URDF, for ROS.

    base_link -gamma_k- actuated_k -mu_k- intermediate_k -beta_1- star
                                                         -beta_2- star_from_2
                                                         -beta_3- star_from_3

All joints turn about axes through O, so every frame has its origin there and a pose is
a rotation. The star is attached to leg 1. Legs 2 and 3 end in a frame without a body:
{E} as that leg sees it. The loops are closed where the three are one. Links are drawn
as arcs, rods, balls and boxes in their own frames; thicknesses are for the eye, arcs
and radii are the scene's. Fewer and simpler shapes enclose them for planners that check
for collisions. URDF has no loops, no springs, no elastic stops and no Stribeck
friction: a simulation of the file must add them.

A scene gives inertias about O, and a mass only where something weighs; URDF wants a
mass. Where the scene has none, it is the one that would have this tensor on the sphere
of its link, trace / (2 radius^2), with its centre at O: the motion is then the same for
any mass.

The actuators can be hardware of ros2_control, which drives them over topics, by
LockstepSystem of the package in hardware/ or JointStateTopicSystem of
joint_state_topic_hardware_interface. That one sends the names of all joints of its tag
with the efforts of those that have one: the passive joints, which have states only, get
a tag of their own.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import pairwise
from typing import Any, NamedTuple, TypeAlias

import numpy as np

from sst_ros.dynamics.model import limits_of, ranges_of
from sst_ros.files import load_templates
from sst_ros.mechanism.geometry import Array, Geometry
from sst_ros.scene.loads import (
    ACTUATED_JOINTS,
    JOINTS,
    PASSIVE_JOINTS,
    Friction,
)
from sst_ros.scene.scene import Scene
from sst_ros.state import BASE_FRAME, Vector3

BASE = BASE_FRAME
STAR_LINK = "star"
PAYLOAD = "payload"
LEG_NUMBERS = (1, 2, 3)
STARS = (STAR_LINK, "star_from_2", "star_from_3")  # {E} as seen from legs 1, 2 and 3
ACTUATED_LINKS = ("actuated_1", "actuated_2", "actuated_3")
"""Links with the frames {1k} = [r, w x r, w] of the legs."""
INTERMEDIATE = ("intermediate_1", "intermediate_2", "intermediate_3")
"""Links with the frames {2k} = [r, t x r, t] of the legs."""

Colour: TypeAlias = tuple[float, float, float]
GLOBE: Colour = (0.93, 0.94, 0.96)
TRIANGLE: Colour = (0.35, 0.38, 0.42)
STAR_COLOUR: Colour = (0.90, 0.62, 0.00)
STEEL: Colour = (0.60, 0.63, 0.67)
LEG_COLOURS: tuple[Colour, ...] = (
    (0.00, 0.45, 0.70),
    (0.84, 0.37, 0.00),
    (0.00, 0.62, 0.45),
)
"""Colours of legs 1 to 3, distinct also with colour blindness (Okabe and Ito)."""

LEAST_MASS = 1e-10
"""Least mass [kg], and least moment of inertia [kg m^2], that MuJoCo gives a link."""

ARC_STEP = np.radians(6.0)
"""Arcs are drawn as chords of this angle or less: 0.14 % of the radius off."""
COLLISION_STEP = np.radians(15.0)
"""The same of collision shapes: 0.9 % off, by which they are thicker."""
CARRIAGE = 3.0 * np.array([1.0, 1.3, 1.3])
"""Sides of a carriage on an arm of the star, in radii of a drawn bar."""

SERVO_TORQUE = 10.6
"""Torque limit of an actuator whose scene has none [N m].

It is the stall torque of a geared servo for arms of this size, ROBOTIS XM540-W270 at
12 V.
"""
SERVO_RATE = np.pi
"""Rate limit of such an actuator [rad/s]: the servo's speed without load."""

PLUGIN = "joint_state_topic_hardware_interface/JointStateTopicSystem"
LOCKSTEP_PLUGIN = "sst_ros_hardware/LockstepSystem"
TOPICS = "/sst_simulator/commands_stamped", "/joint_states"
"""Of commands and states, by which ros2_control drives a simulator."""

NEGLIGIBLE_MASS = 1e-12
"""Mass of a moving link that has none in the scene [kg]."""
NEGLIGIBLE_INERTIA = 2e-14
"""Moment of inertia of such a link [kg m^2].

MuJoCo refuses less than 1e-14. Beside that of the star, some 1e-2 kg m^2, it is lost in
the rounding of a few operations.
"""


class Joint(NamedTuple):
    """A joint between two links, named as in joint_states.

    child = parent * origin * rotation about the axis by the angle, with the origin,
    shape (3, 3), a rotation in the frame of the parent, and the axis a unit vector in
    the joint's frame.
    """

    name: str
    parent: str
    child: str
    origin: Array
    axis: Vector3


def joints_of(geometry: Geometry) -> list[Joint]:
    """Return all nine joints, parents before children; signs as in Eqs. 50 to 52."""
    z = np.array([0.0, 0.0, 1.0])
    joints = []
    for k, leg in enumerate(LEG_NUMBERS):
        v = geometry.v[k]
        w = geometry.w[k]
        e = geometry.e[k]
        at_rest = np.stack([v, np.cross(w, v), w], axis=1)  # 0kR at gamma = 0
        # At beta = 0 the arc's end s lies at r: in {E} the vectors of {2k} are z, e x z
        # and e.
        folded = np.stack([z, np.cross(e, z), e], axis=1).T
        back = (-float(e[0]), -float(e[1]), -float(e[2]))
        actuated = ACTUATED_LINKS[k]
        intermediate = INTERMEDIATE[k]
        joints += [
            Joint(f"gamma_{leg}", BASE, actuated, at_rest, (0.0, 0.0, 1.0)),
            Joint(f"mu_{leg}", actuated, intermediate, np.eye(3), (-1.0, 0.0, 0.0)),
            Joint(f"beta_{leg}", intermediate, STARS[k], folded, back),
        ]
    return joints


def rotations(joints: Iterable[Joint], angles: Mapping[str, float]) -> dict[str, Array]:
    """Return each link's rotation in {B}, shape (3, 3), by the joint angles [rad]."""
    frames: dict[str, Array] = {BASE: np.eye(3)}
    for joint in joints:
        angle = angles[joint.name]
        # Rodrigues' formula; `across` is the cross product with the axis.
        across = np.cross(np.eye(3), np.array(joint.axis))
        versine = 1.0 - np.cos(angle)
        turn = np.eye(3) + np.sin(angle) * across + versine * across @ across
        frames[joint.child] = frames[joint.parent] @ (joint.origin @ turn)
    return frames


class Arc(NamedTuple):
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

    def points(self, step: float = ARC_STEP) -> Array:
        """Return points along the arc, `step` [rad] apart or less, shape (n, 3) [m]."""
        count = max(2, int(np.ceil(self.angle / step)) + 1)
        angles = np.linspace(0.0, self.angle, count)[:, None]
        across = np.cross(self.axis, self.begin)
        return np.asarray(
            self.radius * (np.cos(angles) * self.begin + np.sin(angles) * across)
        )


class Rod(NamedTuple):
    """A straight round bar between two points, shape (3,) [m].

    `thickness` is its radius [m].
    """

    begin: Array
    end: Array
    thickness: float
    colour: Colour


class Ball(NamedTuple):
    """A ball; centre, shape (3,) [m]."""

    centre: Array
    radius: float
    colour: Colour
    opacity: float = 1.0


class Box(NamedTuple):
    """A box with sides along the axes of its link; size and centre, shape (3,) [m]."""

    centre: Array
    size: Array
    colour: Colour


Shape: TypeAlias = "Arc | Rod | Ball | Box"


def shapes(scene: Scene) -> dict[str, list[Shape]]:
    """Return the shapes of every link that has some, by the link's name."""
    geometry = Geometry.of(scene)
    base = scene.base.radius
    star = scene.star.radius
    bar = _bar_radius(scene)
    x, y, z = np.eye(3)
    sides = zip(geometry.v, geometry.w, geometry.arc.tolist(), strict=True)
    drawn: dict[str, list[Shape]] = {
        BASE: [
            Ball(np.zeros(3), base - bar, GLOBE, 0.92),
            *(Arc(v, w, angle, base, 0.7 * bar, TRIANGLE) for v, w, angle in sides),
            *(Ball(base * v, 1.6 * bar, TRIANGLE) for v in geometry.v),
        ],
        # In {E} the carriage k is at s turned about e by +beta.
        STAR_LINK: [
            *(Arc(z, e, geometry.beta_max, star, bar, STAR_COLOUR) for e in geometry.e),
            Ball(star * z, 2.2 * bar, STAR_COLOUR),
        ],
    }
    if scene.payload is not None:
        centre = np.array(scene.payload.centre)
        drawn[STAR_LINK].append(Rod(star * z, centre, 0.8 * bar, STEEL))
        drawn[STAR_LINK].append(Ball(centre, 2.8 * bar, STEEL))
    # A quarter arc goes from the motor at w to the carriage at r, just above the base.
    quarter = base + 1.5 * bar
    for actuated, intermediate, colour in zip(
        ACTUATED_LINKS, INTERMEDIATE, LEG_COLOURS, strict=True
    ):
        bearing_foot = z * (base - bar)
        bearing_end = z * (quarter + 2.0 * bar)
        drawn[actuated] = [
            Arc(x, -y, np.pi / 2, quarter, bar, colour),
            Rod(bearing_foot, bearing_end, 2.4 * bar, colour),
        ]
        drawn[intermediate] = [
            Rod(x * (base - bar), x * star, 0.9 * bar, STEEL),
            Box(star * x, bar * CARRIAGE, colour),
        ]
    return drawn


def collision_shapes(scene: Scene) -> dict[str, list[Shape]]:
    """Return few convex shapes of every link, for planners that check for collisions.

    Where the star lies outside of the base, they enclose what `shapes` draws: the
    actuated links turn inside the ball of the base and need none of their own. Beside
    the carriages on the arms of the star, which always touch these, links touch only
    where the mechanism collides.
    """
    star = scene.star.radius
    bar = _bar_radius(scene)
    x = np.array([1.0, 0.0, 0.0])  # from O to the carriage
    # Around the drawn bearings, but below the carriages and the arms of the star.
    ball = max(bar, min(scene.base.radius + 4.0 * bar, star - 3.0 * bar))
    enclosing: dict[str, list[Shape]] = {BASE: [Ball(np.zeros(3), ball, GLOBE)]}
    enclosing[STAR_LINK] = []
    for shape in shapes(scene)[STAR_LINK]:
        if isinstance(shape, Arc):
            # A chord lies below its arc, by less than this share of the radius.
            sag = 1.0 - np.cos(COLLISION_STEP / 2.0)
            enclosing[STAR_LINK].append(shape._replace(thickness=bar + sag * star))
        else:
            enclosing[STAR_LINK].append(shape)
    for intermediate in INTERMEDIATE:
        enclosing[intermediate] = [
            Rod(x * (ball + 0.5 * bar), x * star, 0.9 * bar, STEEL),
            Box(star * x, bar * CARRIAGE, STEEL),
        ]
    return enclosing


def _bar_radius(scene: Scene) -> float:
    """Return the radius of drawn bars [m], by which other sizes are given."""
    return 0.02 * scene.base.radius


def urdf(
    scene: Scene,
    topics: Sequence[str] = (),
    *,
    lockstep: bool = False,
    mounts: Mapping[str, Vector3] | None = None,
) -> str:
    """Write a scene as a URDF document.

    With topics of commands by name and of joint states it has the ros2_control tags of
    the actuators and the passive joints. Until the first joint states arrive, the
    actuators have the initial state of the scene: without it
    joint_trajectory_controller, activated before, holds nan, and no command starts the
    run.

    Mounts are frames of sensors that are fixed to the star, by name: where they are in
    {E} [m]; their axes are those of {E}.
    """
    return _render_urdf(scene, topics, lockstep=lockstep, mounts=mounts)


def xacro(scene: Scene, topics: Sequence[str] = (), *, lockstep: bool = False) -> str:
    """Write a scene as a macro of xacro that embeds the robot in a larger URDF.

    The macro sst_NAME fixes base_link to the link `parent` at the block `origin`, and
    puts `prefix` before the names of links and joints.
    """
    macro = f"sst_{xml_name(scene)}"
    return _render_urdf(
        scene, topics, lockstep=lockstep, macro=macro, prefix="${prefix}"
    )


def _render_urdf(
    scene: Scene,
    topics: Sequence[str],
    *,
    lockstep: bool,
    macro: str = "",
    prefix: str = "",
    mounts: Mapping[str, Vector3] | None = None,
) -> str:
    """Fill in the template of a URDF document, or of a macro with this name."""
    joints = joints_of(Geometry.of(scene))
    scene_bodies = {body.name: body for body in bodies_of(scene)}
    bodies = {body.name: body for body in _with_negligible_bodies(scene_bodies, joints)}
    links = dict.fromkeys((BASE, *(joint.child for joint in joints), *bodies))
    initial = scene.initial
    starts = zip(ACTUATED_JOINTS, initial.gamma, initial.gamma_dot, strict=True)
    template = load_description_templates().get_template("urdf.xml")
    document: str = template.render(
        name=xml_name(scene),
        macro=macro,
        prefix=prefix,
        base=BASE,
        assumed=[body.name for body in bodies.values() if body.assumed],
        links=list(links),
        bodies=bodies,
        mounts=mounts or {},
        visuals=solids_of_links(shapes(scene)),
        collisions=solids_of_links(collision_shapes(scene), COLLISION_STEP),
        joints=_limited_joints(scene, joints),
        starts=list(starts),
        topics=topics,
        least=LEAST_MASS,
        passive=PASSIVE_JOINTS,
        plugin=LOCKSTEP_PLUGIN if lockstep else PLUGIN,
        roll_pitch_yaw=roll_pitch_yaw,
    )
    return document


def xml_name(scene: Scene) -> str:
    """Return the name of a scene as XML allows it, without spaces."""
    letters = (letter if letter.isalnum() else "_" for letter in scene.name)
    return "".join(letters)


def _limited_joints(
    scene: Scene, joints: Iterable[Joint]
) -> Iterator[tuple[Joint, dict[str, float], Friction | None]]:
    """Yield each joint with the attributes of its limit, and its friction."""
    ranges = {}
    scene_limits = list(limits_of(scene, Geometry.of(scene)))
    for joint_number, lower, upper in ranges_of(scene_limits):
        ranges[joint_number] = (lower, upper)
    torque_limit = getattr(scene.actuators, "torque_limit", None) or SERVO_TORQUE
    rate_limit = getattr(scene.actuators, "velocity_limit", None)
    # The passive joints have no motor; their rates are of the order of the actuators'.
    highest_rate = max(SERVO_RATE, *map(abs, scene.initial.gamma_dot))
    for joint in joints:
        angle = joint.name.split("_")[0]
        driven = angle == "gamma"
        limits = {}
        lower, upper = ranges.get(JOINTS.index(joint.name), (-np.inf, np.inf))
        if np.isfinite([lower, upper]).all():
            limits["lower"] = lower
            limits["upper"] = upper
        limits["effort"] = torque_limit if driven else 0.0
        limits["velocity"] = highest_rate
        if driven and rate_limit:
            limits["velocity"] = rate_limit
        yield joint, limits, getattr(scene.friction, angle, None)


def load_description_templates() -> Any:
    """Return the templates of this room, with the filters that write numbers."""
    templates = load_templates("description")
    templates.filters["exact"] = _exact
    templates.filters["short"] = short
    return templates


def _exact(values: Iterable[float]) -> str:
    """Write numbers with all digits."""
    return " ".join(repr(float(value) + 0.0) for value in values)


def short(values: Iterable[float]) -> str:
    """Write lengths [m] and angles [rad] of shapes to a millionth."""
    return " ".join(f"{round(float(value), 6) + 0.0:g}" for value in values)


class Body(NamedTuple):
    """A rigid body that is fixed to a link of the tree.

    It has the link's name where it is the link.
    """

    name: str
    link: str  # whose frame all vectors are in
    mass: float  # [kg]
    centre: Array  # of mass [m], shape (3,)
    tensor: Array  # about the centre of mass [kg m^2], shape (3, 3)
    assumed: bool = False  # the scene has no mass for it

    @property
    def inertia(self) -> dict[str, float]:
        """Entries of the tensor by their names in URDF."""
        (xx, xy, xz), (_, yy, yz), (_, _, zz) = self.tensor.tolist()
        return {"ixx": xx, "ixy": xy, "ixz": xz, "iyy": yy, "iyz": yz, "izz": zz}


def bodies_of(scene: Scene) -> Iterator[Body]:
    """Yield all bodies that have mass or inertia."""
    star = scene.star
    yield _body(STAR_LINK, star.radius, star.tensor, star.mass, star.centre)
    payload = scene.payload
    if payload is not None:
        tensor = np.zeros((3, 3)) if payload.inertia is None else payload.inertia.matrix
        yield Body(PAYLOAD, STAR_LINK, payload.mass, np.array(payload.centre), tensor)
    motor = scene.actuators
    for k, leg in enumerate(LEG_NUMBERS):
        for name, link, radius in (
            (ACTUATED_LINKS[k], scene.actuated_links[k], scene.base.radius),
            (INTERMEDIATE[k], scene.intermediate_links[k], star.radius),
        ):
            if link.mass or link.inertia is not None:
                yield _body(name, radius, link.tensor, link.mass, link.centre)
        if motor is not None and motor.rotor_inertia:
            # A thin disc behind its gear: only its inertia about w matters.
            reflected = motor.gear_ratio**2 * motor.rotor_inertia
            disc = np.diag([reflected / 2.0, reflected / 2.0, reflected])
            rotor = _body(f"rotor_{leg}", scene.base.radius, disc)
            yield rotor._replace(link=ACTUATED_LINKS[k])


def _body(
    name: str,
    radius: float,
    about_o: Array,
    mass: float = 0.0,
    centre: Vector3 = (0.0, 0.0, 0.0),
) -> Body:
    """Make a body from its tensor about O [kg m^2]; without a mass it is assumed.

    The assumed mass has this tensor's trace on the sphere of this radius [m].
    """
    c = np.array(centre)
    about_centre = about_o - mass * (c @ c * np.eye(3) - np.outer(c, c))
    assumed = float(np.trace(about_o)) / (2.0 * radius**2)
    return Body(name, name, mass or assumed, c, about_centre, mass == 0.0)


def _with_negligible_bodies(
    bodies: Mapping[str, Body], joints: Iterable[Joint]
) -> list[Body]:
    """Give each moving link that has no body one that changes no motion."""
    tensor = NEGLIGIBLE_INERTIA * np.eye(3)
    complete = list(bodies.values())
    for joint in joints:
        link = joint.child
        if link not in bodies:
            complete.append(Body(link, link, NEGLIGIBLE_MASS, np.zeros(3), tensor))
    return complete


def roll_pitch_yaw(rotation: Array) -> Array:
    """Return the angles (r, p, y) [rad] of R = Rz(y) Ry(p) Rx(r), shape (3,).

    They are exact at p = pi/2 too.
    """
    yaw = np.arctan2(rotation[1, 0], rotation[0, 0])
    sine = np.sin(yaw)
    cosine = np.cos(yaw)
    pitch = np.arctan2(-rotation[2, 0], np.hypot(rotation[0, 0], rotation[1, 0]))
    roll = np.arctan2(
        sine * rotation[0, 2] - cosine * rotation[1, 2],
        cosine * rotation[1, 1] - sine * rotation[0, 1],
    )
    return np.array([roll, pitch, yaw])


class Solid(NamedTuple):
    """A primitive of URDF in the frame of its link."""

    kind: str  # sphere, box or cylinder
    sizes: Mapping[str, Any]  # [m], by the names of URDF's attributes
    centre: Array  # [m], shape (3,)
    roll_pitch_yaw: Array  # [rad], shape (3,)
    colour: tuple[float, float, float, float]  # red, green, blue, opacity


def solids_of_links(
    links: Mapping[str, Iterable[Shape]], step: float = ARC_STEP
) -> dict[str, list[Solid]]:
    """Return the primitives of each link's shapes; arcs are chords of `step` [rad]."""
    by_link = {}
    for link, drawn in links.items():
        by_link[link] = [solid for shape in drawn for solid in solids(shape, step)]
    return by_link


def solids(shape: Shape, step: float = ARC_STEP) -> Iterator[Solid]:
    """Yield the primitives that a shape is in URDF.

    An arc is chords of `step` [rad].
    """
    colour = (*shape.colour, getattr(shape, "opacity", 1.0))
    upright = np.zeros(3)
    if isinstance(shape, Ball):
        sizes = {"radius": [shape.radius]}
        yield Solid("sphere", sizes, shape.centre, upright, colour)
    elif isinstance(shape, Box):
        yield Solid("box", {"size": shape.size}, shape.centre, upright, colour)
    else:
        if isinstance(shape, Arc):
            ends = shape.points(step)
        else:
            ends = np.array([shape.begin, shape.end])
        for begin, end in pairwise(ends):
            x, y, z = end - begin
            # The cylinder's axis is z.
            turn = np.array([0.0, np.arctan2(np.hypot(x, y), z), np.arctan2(y, x)])
            # It ends a little late, so that no gap shows at the bends.
            length = float(np.linalg.norm(end - begin)) + 0.1 * shape.thickness
            sizes = {"radius": [shape.thickness], "length": [length]}
            yield Solid("cylinder", sizes, (begin + end) / 2.0, turn, colour)
