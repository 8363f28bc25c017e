# SPDX-License-Identifier: Apache-2.0
"""The manipulator as a model of MuJoCo, with its loops closed.

The tree is that of `robot`: nine hinges through O, of which leg 1 ends in the star and
legs 2 and 3 in frames of their own. Here these have a body each, with a third of the
star's inertia as the star itself, and two `connect` constraints a loop make one body of
them again. Two points are enough: all frames share O, which no joint moves. The points
belong to bodies that weigh next to nothing: MuJoCo makes a tie as soft as the centre of
mass of its body is mobile, and a centre at O would make it too stiff for any step.

MuJoCo's constraints are springs and dampers, so a loop opens a little under load; its
joints know viscous and dry friction, linear springs and no other loads. What a scene
has beyond that is named at the head of the file.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np

from sst_ros.description.robot import (
    ACTUATED_LINKS,
    BASE,
    INTERMEDIATE,
    LEAST_MASS,
    LEG_NUMBERS,
    STAR_LINK,
    STARS,
    Body,
    Joint,
    bodies_of,
    joints_of,
    load_description_templates,
    shapes,
    short,
    solids_of_links,
    xml_name,
)
from sst_ros.dynamics.initial_state import start_of
from sst_ros.dynamics.model import limits_of, model_of, ranges_of
from sst_ros.dynamics.traced_dynamics import Dynamics
from sst_ros.mechanism.geometry import Array, Geometry, quaternion_of
from sst_ros.scene.loads import ACTUATED_JOINTS, JOINTS
from sst_ros.scene.scene import Scene
from sst_ros.state import STAR, ZERO

JOINT_KINDS = ("gamma", "mu", "beta")


def mjcf(scene: Scene) -> str:
    """Write a scene as an MJCF document, with its initial state as the key `initial`.

    Raises:
        AssemblyError: the initial gamma has no unique admissible assembly.

    """
    geometry = Geometry.of(scene)
    joints = {joint.child: joint for joint in joints_of(geometry)}
    bodies: dict[str, Body | None] = dict.fromkeys(joints)
    carried: dict[str, list[Body]] = {}
    for body in bodies_of(scene):
        if body.name.startswith("rotor"):
            continue  # is the armature of its joint
        if body.name == body.link:
            bodies[body.name] = body
        else:
            carried.setdefault(body.link, []).append(body)
    star = bodies[STAR_LINK]
    if star is not None:
        third = star._replace(mass=star.mass / 3.0, tensor=star.tensor / 3.0)
        bodies.update(dict.fromkeys(STARS, third))
    chains = list(_nest(joints))
    names = [link.joint.name for link in chains if link.joint is not None]
    numbers = Dynamics.of(scene).joints(*start_of(scene)[STAR])
    start_angles = dict(zip(JOINTS, numbers[: len(JOINTS)], strict=True))
    start_rates = dict(zip(JOINTS, numbers[len(JOINTS) :], strict=True))
    document: str = (
        load_description_templates()
        .get_template("model.mjcf.xml")
        .render(
            name=xml_name(scene),
            left_out=[*_left_out(scene)],
            least=LEAST_MASS,
            gravity=ZERO if scene.gravity is None else scene.gravity.acceleration,
            base=BASE,
            visuals=solids_of_links(shapes(scene)),
            solid=_geom,
            chains=chains,
            bodies=bodies,
            carried=carried,
            quaternion=_quaternion,
            full_inertia=_full_inertia,
            attributes=_joint_attributes(scene, geometry),
            sites=_sites(scene, geometry),
            end=[0.0, 0.0, scene.star.radius],
            ties=[
                (f"{STAR_LINK}_{end}{k}", f"{STARS[k - 1]}_{end}")
                for k in (2, 3)
                for end in "et"
            ],
            actuated=ACTUATED_JOINTS,
            motor=_motor(scene),
            start=[start_angles[name] for name in names],
            start_rates=[start_rates[name] for name in names],
        )
    )
    return document


class _LinkTag(NamedTuple):
    """Where the element of a link begins, or ends, in a tree of elements."""

    begins: bool
    link: str
    joint: Joint | None  # to the link around it, where the element begins


def _nest(joints: dict[str, Joint]) -> Iterator[_LinkTag]:
    """Yield the tags of all moving links, leg by leg, each link inside its parent."""
    for chain in zip(ACTUATED_LINKS, INTERMEDIATE, STARS, strict=True):
        for link in chain:
            yield _LinkTag(True, link, joints[link])
        for link in reversed(chain):
            yield _LinkTag(False, link, None)


def _sites(scene: Scene, geometry: Geometry) -> dict[str, list[tuple[str, Array]]]:
    """Return the points that the ties connect, by link: along e_k, and at the end E."""
    radius = scene.star.radius
    end = np.array([0.0, 0.0, radius])
    sites: dict[str, list[tuple[str, Array]]] = {STAR_LINK: []}
    for leg in LEG_NUMBERS[1:]:
        along = radius * geometry.e[leg - 1]
        sites[STAR_LINK] += [
            (f"{STAR_LINK}_e{leg}", along),
            (f"{STAR_LINK}_t{leg}", end),
        ]
        name = STARS[leg - 1]
        sites[name] = [(f"{name}_e", along), (f"{name}_t", end)]
    return sites


def _joint_attributes(scene: Scene, geometry: Geometry) -> dict[str, dict[str, Any]]:
    """Return springs, friction, range and rotor of each joint, as MuJoCo names them."""
    model = model_of(scene)
    ranges: dict[int, list[float]] = {}  # by the number of the joint
    for joint, lower, upper in ranges_of(list(limits_of(scene, geometry))):
        ranges[joint] = [lower, upper]
    by_joint: dict[str, dict[str, Any]] = {}
    motor = scene.actuators
    for number, name in enumerate(JOINTS):
        angle, leg = divmod(number, len(LEG_NUMBERS))
        kind = JOINT_KINDS[angle]
        attributes: dict[str, Any] = {}
        spring = model.legs[leg].springs[angle]
        if spring is not None:
            attributes["stiffness"] = [spring.stiffness]
            attributes["springref"] = [spring.rest]
        friction = model.legs[leg].friction[angle]
        if friction is not None:
            attributes["damping"] = [friction.viscous]
            attributes["frictionloss"] = [friction.coulomb]
        # Limits of mu are serial singularities, at which no joint ends.
        if kind != "mu" and np.isfinite(ranges.get(number, np.inf)).all():
            attributes["range"] = ranges[number]
        if kind == "gamma" and motor is not None and motor.rotor_inertia:
            attributes["armature"] = [motor.gear_ratio**2 * motor.rotor_inertia]
        by_joint[name] = attributes
    return by_joint


def _motor(scene: Scene) -> dict[str, object]:
    """Return torque limit and lag of the actuators, as MuJoCo names them."""
    attributes: dict[str, object] = {}
    if scene.torque_limit is not None:
        attributes["ctrlrange"] = f"{-scene.torque_limit!r} {scene.torque_limit!r}"
    if scene.actuators is not None and scene.actuators.time_constant is not None:
        attributes |= {
            "dyntype": "filter",
            "dynprm": repr(scene.actuators.time_constant),
        }
    return attributes


def _left_out(scene: Scene) -> Iterator[str]:
    """Say what the scene has and MuJoCo has not, or has otherwise."""
    frictions = [getattr(scene.friction, angle, None) for angle in JOINT_KINDS]
    for friction in frictions:
        if friction is not None and (friction.coulomb or friction.static):
            lacks = "without breakaway torque and smoothing"
            yield f"Dry friction is MuJoCo's own, {lacks}."
            break
    if scene.stroke.at_end == "elastic":
        yield "Elastic stops are left out: MuJoCo's are of another kind."
    if scene.moment is not None:
        yield "The moment on the star is left out: apply it by xfrc_applied."


def _quaternion(rotation: Array) -> list[float]:
    """Return a rotation as MuJoCo has it, (w, x, y, z)."""
    x, y, z, w = quaternion_of(rotation).tolist()
    return [w, x, y, z]


def _full_inertia(body: Body) -> Array:
    """Return the tensor about the centre of mass as (xx, yy, zz, xy, xz, yz)."""
    (xx, xy, xz), (_, yy, yz), (_, _, zz) = body.tensor
    return np.array([xx, yy, zz, xy, xz, yz])


def _geom(primitive: str, sizes: Any, position: Any, turn: Any, rgba: Any) -> str:
    """Write a shape of `robot.solids` as a geom; lengths of MuJoCo are halves."""
    if primitive == "box":
        size = [0.5 * side for side in sizes["size"]]
    elif primitive == "cylinder":
        size = [sizes["radius"][0], 0.5 * sizes["length"][0]]
    else:
        size = sizes["radius"]
    attributes = {"size": size, "pos": position, "euler": turn, "rgba": rgba}
    texts = (f'{key}="{short(values)}"' for key, values in attributes.items())
    return f'<geom type="{primitive}" {" ".join(texts)} />'
