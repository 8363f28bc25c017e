# SPDX-License-Identifier: Apache-2.0
"""A scene as URDF, for robot_state_publisher, RViz and engines that read it.

The tree's joints are those of joint_states, the passive ones included, so that the loops of what is
shown are as closed as those of the simulation. URDF has no loops, no springs, no elastic
stops and no Stribeck friction: a simulation of the file must add them. No shape is meant for
collisions.

A scene gives inertias about O, and a mass only where something weighs; URDF wants a mass. Where the
scene has none, it is the one that would have this tensor on the sphere of its link,
trace / (2 radius^2), with its centre at O: the motion is then the same for any mass.

The actuators can be hardware of ros2_control, which drives them over topics by the plug-in
JointStateTopicSystem of the package joint_state_topic_hardware_interface. It sends the effort of
the joints of its tag only: passive joints, which have no command, must not be in it.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Iterable
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from sst_ros.description import tree
from sst_ros.dynamics.model import limits_of, ranges_of
from sst_ros.mechanism.geometry import Array, Geometry
from sst_ros.scene.loads import JOINTS, Friction
from sst_ros.scene.scene import LARGEST, Scene
from sst_ros.state import Vector3

PLUGIN = "joint_state_topic_hardware_interface/JointStateTopicSystem"
STATES = ("position", "velocity", "effort")
PAYLOAD = "payload"
EVERY_CYCLE = "-1"
"""Threshold of the change of a command below which the plug-in sends none: the simulator drops a
command that is not repeated within command_timeout."""

_NOTE = """ Made by sst_ros from the scene {name}. Joints have the names and angles of joint_states.
     star_from_2 and star_from_3 are the star's frame as legs 2 and 3 see it: in closed loops they
     and star are one. """

_ASSUMED = """ The scene has no masses for {bodies}. Theirs are trace / (2 radius^2), with
     the centre at O, about which all turns: they change no motion. The tensors are the scene's. """


def urdf(scene: Scene) -> str:
    """Write a scene as a URDF document."""
    return _text(_robot(scene))


def _text(root: ET.Element) -> str:
    ET.indent(root)
    return ET.tostring(root, encoding="unicode", xml_declaration=True) + "\n"


def _robot(scene: Scene) -> ET.Element:
    geometry = Geometry.of(scene)
    joints, drawn = tree.tree(geometry), tree.shapes(scene)
    own = {body.name: body for body in bodies(scene)}
    # An XML name has no spaces.
    name = "".join(letter if letter.isalnum() else "_" for letter in scene.name)
    root = ET.Element("robot", name=name)
    root.append(ET.Comment(_NOTE.format(name=name)))
    if assumed := ", ".join(body.name for body in own.values() if body.assumed):
        root.append(ET.Comment(_ASSUMED.format(bodies=assumed)))
    for name in (tree.BASE, *(joint.child for joint in joints)):
        _link(root, name, own.pop(name, None), drawn.get(name, ()))
    for body in own.values():
        _link(root, body.name, body, ())
    ranges = {joint: (low, high) for joint, low, high in ranges_of([*limits_of(scene, geometry)])}
    for joint in joints:
        _joint(root, scene, joint, ranges.get(JOINTS.index(joint.name), (-np.inf, np.inf)))
    for body in own.values():
        fixed = ET.SubElement(root, "joint", name=f"{body.name}_fixed", type="fixed")
        ET.SubElement(fixed, "parent", link=body.link)
        ET.SubElement(fixed, "child", link=body.name)
    return root


def urdf_with_ros2_control(
    scene: Scene,
    commands: str = "/sst_simulator/commands_stamped",
    states: str = "/joint_states",
) -> str:
    """Write a scene as URDF with the ros2_control tag of its actuators.

    The simulator takes commands by name on the one topic, and has its joint states on the other.
    Until the first of them arrive, the hardware has the initial state of the scene: without it
    joint_trajectory_controller, activated before, holds nan, and no command starts the run.
    """
    root = _robot(scene)
    tag = ET.SubElement(root, "ros2_control", name="sst_ros", type="system")
    hardware = ET.SubElement(tag, "hardware")
    ET.SubElement(hardware, "plugin").text = PLUGIN
    for name, value in (
        ("joint_commands_topic", commands),
        ("joint_states_topic", states),
        ("trigger_joint_command_threshold", EVERY_CYCLE),
    ):
        ET.SubElement(hardware, "param", name=name).text = value
    initial = scene.initial
    for name, *start in zip(JOINTS[:3], initial.gamma, initial.gamma_dot, strict=True):
        joint = ET.SubElement(tag, "joint", name=name)
        ET.SubElement(joint, "command_interface", name="effort")
        for state, start_value in zip(STATES, (*start, 0.0), strict=True):
            interface = ET.SubElement(joint, "state_interface", name=state)
            ET.SubElement(interface, "param", name="initial_value").text = repr(float(start_value))
    return _text(root)


@dataclass(frozen=True)
class Body:
    """A rigid body that is fixed to a link of the tree, and has its name where it is the link."""

    name: str
    link: str  # whose frame all vectors are in
    mass: float  # [kg]
    centre: Array  # of mass [m], shape (3,)
    tensor: Array  # about the centre of mass [kg m^2], shape (3, 3)
    assumed: bool = False  # the scene has no mass for it


def bodies(scene: Scene) -> list[Body]:
    """All bodies that have mass or inertia."""
    star, base = scene.star, scene.base
    found = [_body(tree.STAR, star.mass, star.centre, star.tensor, star.radius)]
    if scene.payload is not None:
        own = scene.payload.inertia
        tensor = np.zeros((3, 3)) if own is None else own.matrix
        centre = np.array(scene.payload.centre)
        found.append(Body(PAYLOAD, tree.STAR, scene.payload.mass, centre, tensor))
    for k, leg in enumerate(tree.LEGS):
        for name, link, radius in (
            (tree.ACTUATED[k], scene.actuated_links[k], base.radius),
            (tree.INTERMEDIATE[k], scene.intermediate_links[k], star.radius),
        ):
            if link.mass or link.inertia is not None:
                found.append(_body(name, link.mass, link.centre, link.tensor, radius))
        if (motor := scene.actuators) is not None and motor.rotor_inertia:
            # A thin disc behind its gear: only its inertia about w matters.
            behind = motor.gear_ratio**2 * motor.rotor_inertia
            tensor = np.diag([behind / 2.0, behind / 2.0, behind])
            found.append(_massless(f"rotor_{leg}", tree.ACTUATED[k], tensor, base.radius))
    return found


def _body(name: str, mass: float, centre: Vector3, about_o: Array, radius: float) -> Body:
    if mass == 0.0:
        return _massless(name, name, about_o, radius)
    c = np.array(centre)
    return Body(name, name, mass, c, about_o - mass * (c @ c * np.eye(3) - np.outer(c, c)))


def _massless(name: str, link: str, tensor: Array, radius: float) -> Body:
    mass = float(np.trace(tensor)) / (2.0 * radius**2)
    return Body(name, link, mass, np.zeros(3), tensor, assumed=True)


def roll_pitch_yaw(rotation: Array) -> Array:
    """Angles (r, p, y) [rad] of R = Rz(y) Ry(p) Rx(r), shape (3,), exact at p = pi/2 too."""
    yaw = np.arctan2(rotation[1, 0], rotation[0, 0])
    sine, cosine = np.sin(yaw), np.cos(yaw)
    pitch = np.arctan2(-rotation[2, 0], np.hypot(rotation[0, 0], rotation[1, 0]))
    roll = np.arctan2(
        sine * rotation[0, 2] - cosine * rotation[1, 2],
        cosine * rotation[1, 1] - sine * rotation[0, 1],
    )
    return np.array([roll, pitch, yaw])


def _link(root: ET.Element, name: str, body: Body | None, drawn: Iterable[tree.Shape]) -> None:
    link = ET.SubElement(root, "link", name=name)
    if body is not None:
        inertial = ET.SubElement(link, "inertial")
        ET.SubElement(inertial, "origin", xyz=_exact(body.centre))
        ET.SubElement(inertial, "mass", value=_exact([body.mass]))
        entries = zip(
            ("xx", "xy", "xz", "yy", "yz", "zz"), body.tensor[np.triu_indices(3)], strict=True
        )
        ET.SubElement(inertial, "inertia", {f"i{key}": _exact([x]) for key, x in entries})
    for shape in drawn:
        _draw(link, shape)


def _joint(root: ET.Element, scene: Scene, joint: tree.Joint, ends: tuple[float, float]) -> None:
    limited = bool(np.all(np.isfinite(ends)))
    kind = "revolute" if limited else "continuous"
    element = ET.SubElement(root, "joint", name=joint.name, type=kind)
    ET.SubElement(element, "parent", link=joint.parent)
    ET.SubElement(element, "child", link=joint.child)
    ET.SubElement(element, "origin", xyz="0 0 0", rpy=_exact(roll_pitch_yaw(joint.origin)))
    ET.SubElement(element, "axis", xyz=_exact(joint.axis))
    motor = scene.actuators if joint.name.startswith("gamma") else None
    bounds = {"lower": _exact(ends[:1]), "upper": _exact(ends[1:])} if limited else {}
    for name, key in (("effort", "torque_limit"), ("velocity", "velocity_limit")):
        bounds[name] = _exact([getattr(motor, key, None) or LARGEST])
    ET.SubElement(element, "limit", bounds)
    friction: Friction | None = getattr(scene.friction, joint.name.split("_")[0], None)
    if friction is not None:
        values = {"damping": friction.viscous, "friction": friction.coulomb}
        ET.SubElement(element, "dynamics", {key: _exact([x]) for key, x in values.items()})


def _draw(link: ET.Element, shape: tree.Shape) -> None:
    straight = np.zeros(3)
    if isinstance(shape, tree.Ball):
        size = {"radius": _short([shape.radius])}
        _visual(link, "sphere", size, shape.centre, straight, shape.colour, shape.opacity)
    elif isinstance(shape, tree.Box):
        _visual(link, "box", {"size": _short(shape.size)}, shape.centre, straight, shape.colour)
    else:
        ends = shape.points() if isinstance(shape, tree.Arc) else (shape.begin, shape.end)
        for begin, end in pairwise(ends):
            x, y, z = end - begin
            # The cylinder's axis is z; it ends a little late, so that no gap shows at the bends.
            turn = np.array([0.0, np.arctan2(np.hypot(x, y), z), np.arctan2(y, x)])
            length = float(np.linalg.norm(end - begin)) + 0.1 * shape.thickness
            size = {"radius": _short([shape.thickness]), "length": _short([length])}
            _visual(link, "cylinder", size, (begin + end) / 2.0, turn, shape.colour)


def _visual(
    link: ET.Element,
    kind: str,
    size: dict[str, str],
    at: Array,
    turn: Array,
    colour: tree.Colour,
    opacity: float = 1.0,
) -> None:
    visual = ET.SubElement(link, "visual")
    ET.SubElement(visual, "origin", xyz=_short(at), rpy=_short(turn))
    ET.SubElement(ET.SubElement(visual, "geometry"), kind, size)
    name = "_".join(f"{round(255 * part):02x}" for part in (*colour, opacity))
    material = ET.SubElement(visual, "material", name=f"rgba_{name}")
    ET.SubElement(material, "color", rgba=_short((*colour, opacity)))


def _exact(values: Iterable[float]) -> str:
    return " ".join(repr(float(x) + 0.0) for x in values)


def _short(values: Iterable[float]) -> str:
    return " ".join(f"{round(float(x), 6) + 0.0:g}" for x in values)
