# SPDX-License-Identifier: Apache-2.0
"""The URDF of a scene, as Pinocchio, MuJoCo and ros2_control read it.

Shapes of the links.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml
from loaded_scenes import loaded
from mechanism.closed_chains import ISOTROPIC, random_sample
from models import assembly_of, seeded_samples
from scipy.spatial.transform import Rotation
from slow_cases import slow_except

from sst_ros.__main__ import main
from sst_ros.description.robot import (
    ACTUATED_LINKS,
    BASE,
    INTERMEDIATE,
    LEAST_MASS,
    LEG_NUMBERS,
    PLUGIN,
    STAR_LINK,
    STARS,
    Arc,
    Ball,
    Box,
    roll_pitch_yaw,
    shapes,
    urdf,
    xacro,
)
from sst_ros.dynamics.initial_state import start_of
from sst_ros.dynamics.traced_dynamics import Dynamics
from sst_ros.mechanism import rates, virtual_work
from sst_ros.mechanism.geometry import Geometry, quaternion_of
from sst_ros.scene.loads import JOINTS, Actuators
from sst_ros.scene.scene import load, names
from sst_ros.simulation.simulate import simulate

ACTUATORS = list(JOINTS[:3])
CONTROLLERS = Path(__file__).parents[2] / "config" / "controllers.yaml"
HARDWARE = ET.parse(Path(__file__).parents[2] / "hardware" / "plugins.xml").getroot()
EXACT = 2e-14  # a product of nine rotations, each rounded
GEARED = Actuators(rotor_inertia=1e-4, gear_ratio=10.0)
LINKS = {STAR_LINK, *ACTUATED_LINKS, *INTERMEDIATE}


class Read:
    """A URDF as Pinocchio reads it."""

    def __init__(self, scene):
        self.pin = pytest.importorskip(
            "pinocchio", reason="Pinocchio is missing: pip install pin"
        )
        self.model = self.pin.buildModelFromXML(urdf(scene))
        self.data = self.model.createData()

    def configuration(self, angles):
        """q in Pinocchio's order; a joint without ends is given by cosine and sine."""
        q = np.zeros(self.model.nq)
        for name, angle in angles.items():
            joint = self.model.joints[self.model.getJointId(name)]
            told = [angle] if joint.nq == 1 else [np.cos(angle), np.sin(angle)]
            q[joint.idx_q : joint.idx_q + joint.nq] = told
        return q

    def rotation(self, angles, link):
        self.pin.framesForwardKinematics(
            self.model, self.data, self.configuration(angles)
        )
        placement = self.data.oMf[self.model.getFrameId(link, self.pin.FrameType.BODY)]
        assert not placement.translation.any()
        return placement.rotation


def by_joint(gamma, mu, beta):
    return dict(zip(JOINTS, (*gamma, *mu, *beta), strict=True))


def angles_of(geometry, gamma, rotation):
    assembly = assembly_of(geometry, gamma, rotation)
    return by_joint(gamma, assembly.mu, assembly.beta)


@pytest.mark.parametrize("isotropic", [False, True])
def test_poses_of_all_links(isotropic):
    for sample in seeded_samples(11, 8, isotropic):
        read = Read(sample.scene)
        at = sample.posture
        angles = angles_of(sample.geometry, sample.gamma, sample.rotation)
        expected = dict.fromkeys(STARS, sample.rotation)
        for k in range(3):
            r, t, w = at.r[k], at.t[k], at.w[k]
            expected[ACTUATED_LINKS[k]] = np.stack([r, np.cross(w, r), w], axis=1)
            expected[INTERMEDIATE[k]] = np.stack([r, np.cross(t, r), t], axis=1)
        for link, rotation in expected.items():
            assert np.abs(read.rotation(angles, link) - rotation).max() < EXACT


some_scenes = pytest.mark.parametrize(
    "name", slow_except(["elastic_stops", "general", "swing"], names())
)


@some_scenes
def test_inertias_of_every_scene(name):
    scene = load(name)
    read = Read(scene)
    found = dict(zip(read.model.names, read.model.inertias, strict=True))
    about_o = {joint: inertia.matrix()[3:, 3:] for joint, inertia in found.items()}
    bodies = virtual_work.Mechanism.of(scene)
    expected = {"beta_1": bodies.star}
    for k, leg in enumerate(LEG_NUMBERS):
        expected[f"gamma_{leg}"] = bodies.actuated[k]
        expected[f"mu_{leg}"] = bodies.intermediate[k]
    scale = np.abs(bodies.star).max()
    for joint, tensor in expected.items():
        assert np.abs(about_o[joint] - tensor).max() < 1e-15 * scale
    for joint in ("beta_2", "beta_3"):
        assert found[joint].mass == 1e-12 and np.abs(about_o[joint]).max() < 3e-14


def test_a_rotor_weighs_about_its_axis_alone():
    scene = replace(load("example2_heavy"), actuators=GEARED)
    read = Read(scene)
    tensor = read.model.inertias[read.model.getJointId("gamma_1")].matrix()[3:, 3:]
    own = scene.actuated_links[0].inertia.matrix
    assert tensor[2, 2] == pytest.approx(own[2, 2] + 0.01, rel=1e-15)
    assert np.linalg.eigvalsh(tensor - own)[0] > 0.0  # and some rigid body has it


def test_masses_are_those_of_the_scene_or_said_to_be_assumed():
    weighed, bare = load("gravity_payload"), load("example2_heavy")
    masses = {
        name.get("name"): float(name.find("inertial/mass").get("value"))
        for name in ET.fromstring(urdf(weighed)).iter("link")
        if name.find("inertial") is not None
    }
    assert masses[STAR_LINK] == 2.6 and masses["payload"] == 0.8
    assert "has no masses" not in urdf(weighed)
    assert "has no masses" in urdf(bare)
    # Thin arcs on the sphere: the printed masses come back.
    read = Read(bare)
    assert read.model.inertias[read.model.getJointId("gamma_1")].mass == pytest.approx(
        0.3
    )


def closed(read, geometry):
    """Lock the frames without bodies.

    Tie a point of the axis t_k on legs 2 and 3 to the star.
    """
    pin = read.pin
    locked = [read.model.getJointId(name) for name in ("beta_2", "beta_3")]
    model = pin.buildReducedModel(read.model, locked, pin.neutral(read.model))
    ties, data = pin.StdVec_RigidConstraintModel(), pin.StdVec_RigidConstraintData()
    for k in (1, 2):
        at_star = pin.SE3(np.eye(3), geometry.e[k])
        at_link = pin.SE3(np.eye(3), np.array([0.0, 0.0, 1.0]))
        star, link = (model.getJointId(name) for name in ("beta_1", f"mu_{k + 1}"))
        kind = pin.ContactType.CONTACT_3D
        tie = pin.RigidConstraintModel(kind, model, star, at_star, link, at_link)
        ties.append(tie)
        data.append(tie.createData())
    return model, ties, data


def acceleration(scene, angles, motion, torque, moment=(0.0, 0.0, 0.0)):
    """W_dot of the star in {E} by Pinocchio, from the URDF alone."""
    read = Read(scene)
    pin, geometry = read.pin, Geometry.of(scene)
    model, ties, tied = closed(read, geometry)
    read.model, read.data = model, model.createData()
    gravity = scene.gravity.acceleration if scene.gravity else (0.0, 0.0, 0.0)
    model.gravity = pin.Motion(np.array(gravity), np.zeros(3))
    open_joints = {
        name: angle for name, angle in angles.items() if model.existJointName(name)
    }
    q, v, u = read.configuration(open_joints), np.zeros(model.nv), np.zeros(model.nv)
    rate_of = by_joint(motion.gamma_dot, motion.mu_dot, motion.beta_dot)
    for name in open_joints:
        v[model.joints[model.getJointId(name)].idx_v] = rate_of[name]
    for k, leg in enumerate(LEG_NUMBERS):
        u[model.joints[model.getJointId(f"gamma_{leg}")].idx_v] = torque[k]
    pin.computeJointJacobians(model, read.data, q)
    in_base = pin.ReferenceFrame.LOCAL_WORLD_ALIGNED
    u += (
        pin.getJointJacobian(model, read.data, model.getJointId("beta_1"), in_base)[
            3:
        ].T
        @ moment
    )
    try:
        pin.initConstraintDynamics(model, read.data, ties, tied)
    except TypeError:  # before Pinocchio 4
        pin.initConstraintDynamics(model, read.data, ties)
    # Each tie has three rows of rank two: proximal steps bring the least-squares
    # answer.
    proximal = pin.ProximalSettings(1e-16, 1e-3, 30)
    a = pin.constraintDynamics(model, read.data, q, v, u, ties, tied, proximal)
    pin.forwardKinematics(model, read.data, q, v, a)
    return read.data.a[model.getJointId("beta_1")].angular


@pytest.mark.parametrize("seed", slow_except(range(6), range(32)))
def test_motion_of_random_mechanisms(seed):
    """Other engines are compared, on one scene, in test/benchmark/test_peers.py."""
    sample = random_sample(
        np.random.default_rng(seed), ISOTROPIC if seed % 4 == 0 else None
    )
    loads = sample.torque, sample.moment
    answer = virtual_work.direct_dynamics(
        sample.mechanism, sample.posture, sample.gamma_dot, *loads
    )
    motion = rates.of_actuators(sample.posture, sample.gamma_dot, answer)
    angles = angles_of(sample.geometry, sample.gamma, sample.rotation)
    found = acceleration(sample.scene, angles, motion, *loads)
    expected = sample.rotation.T @ motion.omega_dot
    assert np.linalg.norm(found - expected) < 1e-12 * np.linalg.norm(expected)


def test_motion_under_gravity_with_payload_and_rotors():
    scene = replace(loaded(), friction=None, moment=None, actuators=GEARED)
    geometry, gamma = (
        Geometry.of(scene),
        np.add(scene.initial.gamma, [0.05, -0.03, 0.02]),
    )
    at = virtual_work.posture(geometry, gamma)
    gamma_dot, torque = np.array([1.0, -2.0, 0.5]), np.array([0.3, -1.0, 2.0])
    motion = rates.of_actuators(at, gamma_dot)
    angles = angles_of(geometry, gamma, at.rotation)
    for spring in scene.springs:  # URDF has none
        torque[LEG_NUMBERS.index(int(spring.joint[-1]))] -= spring.stiffness * (
            angles[spring.joint] - spring.rest
        )
    found = acceleration(scene, angles, motion, torque)
    state = (*quaternion_of(at.rotation), *(at.rotation.T @ motion.omega))
    expected = np.array(
        Dynamics.of(replace(scene, springs=())).derivative(*state, *torque)[4:7]
    )
    assert np.linalg.norm(found - expected) < 1e-11 * np.linalg.norm(expected)


@some_scenes
def test_motion_of_every_scene(name):
    """Inertias and weight; what URDF has not is left out of the scene."""
    scene = replace(load(name), friction=None, springs=(), own_loads=(), moment=None)
    scene = replace(scene, actuators=None)
    geometry = Geometry.of(scene)
    at = virtual_work.posture(
        geometry, np.add(scene.initial.gamma, [0.02, -0.01, 0.01])
    )
    torque = np.array([0.3, -1.0, 2.0])
    motion = rates.of_actuators(at, np.array([0.8, -1.1, 0.5]))
    angles = angles_of(geometry, at.gamma, at.rotation)
    state = (*quaternion_of(at.rotation), *(at.rotation.T @ motion.omega))
    expected = np.array(Dynamics.of(scene).derivative(*state, *torque)[4:7])
    found = acceleration(scene, angles, motion, torque)
    assert np.linalg.norm(found - expected) < 1e-11 * np.linalg.norm(expected)


@some_scenes
def test_mujoco_loads_every_scene(name):
    mujoco = pytest.importorskip(
        "mujoco", reason="MuJoCo is missing: pip install mujoco"
    )
    model = mujoco.MjModel.from_xml_string(urdf(load(name)))
    assert {model.joint(i).name for i in range(model.njnt)} == set(JOINTS)
    # of the frames, which MuJoCo wants to weigh
    assert model.body_inertia[1:].min() == LEAST_MASS


def test_mujoco_reads_it():
    mujoco = pytest.importorskip(
        "mujoco", reason="MuJoCo is missing: pip install mujoco"
    )
    sample = seeded_samples(3, 1)[0]
    model = mujoco.MjModel.from_xml_string(urdf(sample.scene))
    data = mujoco.MjData(model)
    for name, angle in angles_of(
        sample.geometry, sample.gamma, sample.rotation
    ).items():
        data.qpos[model.joint(name).qposadr[0]] = angle
    mujoco.mj_kinematics(model, data)
    for star in STARS:
        found = data.xmat[model.body(star).id].reshape(3, 3)
        assert np.abs(found - sample.rotation).max() < EXACT
    assert not LINKS - {model.body(i).name for i in range(model.nbody)}


@some_scenes
def test_mujoco_loads_every_scene_as_it_is_written(name):
    """It refuses a moving body without mass or inertia.

    The torques act on what has been read.
    """
    mujoco = pytest.importorskip(
        "mujoco", reason="MuJoCo is missing: pip install mujoco"
    )
    model = mujoco.MjModel.from_xml_string(urdf(load(name)))
    data = mujoco.MjData(model)
    assert {model.joint(i).name for i in range(model.njnt)} == set(JOINTS)
    assert (model.body_inertia[1:] > 0.0).all() and (model.body_mass[1:] > 0.0).all()
    mujoco.mj_forward(model, data)
    assert np.isfinite(data.qacc).all()


@some_scenes
def test_every_moving_link_has_mass_and_inertia(name):
    root = ET.fromstring(urdf(load(name)))
    links = {link.get("name"): link for link in root.iter("link")}
    for joint in root.iter("joint"):
        link = links[joint.find("child").get("link")]
        assert float(link.find("inertial/mass").get("value")) > 0.0
        inertia = link.find("inertial/inertia")
        assert all(float(inertia.get(key)) > 0.0 for key in ("ixx", "iyy", "izz")) or (
            link.get("name") == "payload"
        )


def test_angles_of_a_rotation_at_the_pole():
    for pitch in (np.pi / 2, -np.pi / 2, 1.5707963, 0.3):
        for roll, yaw in ((0.4, -1.1), (0.0, 2.0)):
            expected = Rotation.from_euler("xyz", (roll, pitch, yaw)).as_matrix()
            found = Rotation.from_euler("xyz", roll_pitch_yaw(expected)).as_matrix()
            assert np.abs(found - expected).max() < 1e-15


def test_ends_limits_and_friction_are_in_it():
    root = ET.fromstring(urdf(load("friction")))
    joints = {joint.get("name"): joint for joint in root.iter("joint")}
    first = joints["gamma_1"]
    assert float(first.find("limit").get("upper")) == pytest.approx(np.pi / 2)
    friction = load("friction").friction.gamma
    assert float(first.find("dynamics").get("damping")) == friction.viscous
    limited = replace(load("example2_heavy"), actuators=Actuators(torque_limit=4.0))
    effort = (
        ET.fromstring(urdf(limited)).find("joint[@name='gamma_2']/limit").get("effort")
    )
    assert float(effort) == 4.0


@some_scenes
def test_limits_are_those_of_a_drive(name):
    """As Pinocchio reads them: finite, above the scene's own start.

    No drive, no torque.
    """
    scene, read = load(name), Read(load(name))
    motor = scene.actuators or Actuators(torque_limit=10.6)
    for joint, effort, rate in zip(
        read.model.names[1:],
        read.model.effortLimit,
        read.model.velocityLimit,
        strict=True,
    ):
        driven = joint.startswith("gamma")
        assert effort == (motor.torque_limit if driven else 0.0)
        assert max(np.abs(scene.initial.gamma_dot)) <= rate <= 120.0
        assert rate == (motor.velocity_limit if driven else 0.0) or rate >= np.pi


class Collisions:
    """Which links touch, by the collision checks of Pinocchio."""

    def __init__(self, scene):
        self.scene = scene
        self.read = Read(scene)
        self.pin = self.read.pin
        kind = self.pin.GeometryType.COLLISION
        self.shapes = self.geometry(kind)
        self.shapes.addAllCollisionPairs()
        self.data = self.shapes.createData()

    def geometry(self, kind):
        return self.pin.buildGeomFromUrdfString(self.read.model, urdf(self.scene), kind)

    def link(self, shape):
        return self.read.model.frames[shape.parentFrame].name

    def touching(self, angles):
        """Pairs of links that touch at the angles of the joints [rad]."""
        model, shapes = self.read.model, self.shapes.geometryObjects
        q = self.read.configuration(angles)
        data = self.read.data
        self.pin.computeCollisions(model, data, self.shapes, self.data, q, False)
        found = set()
        for pair, result in zip(
            self.shapes.collisionPairs, self.data.collisionResults, strict=True
        ):
            if result.isCollision():
                first, second = (
                    self.link(shapes[k]) for k in (pair.first, pair.second)
                )
                found |= {frozenset((first, second))} - {frozenset((first,))}
        return found


ON_THE_ARMS = {frozenset((STAR_LINK, carriage)) for carriage in INTERMEDIATE}
"""Links that touch in each pose: one is the joint of leg 1, which URDF has; loops close
by the others."""


@some_scenes
def test_only_carriages_touch_the_arms_of_the_star(name):
    """Planners take a robot that collides at its start as stuck."""
    scene = load(name)
    check = Collisions(scene)
    assert 10 < len(check.shapes.geometryObjects) < 40
    joints = Dynamics.of(scene).joints(*start_of(scene)[:7])[:9]
    assert check.touching(dict(zip(JOINTS, joints, strict=True))) == ON_THE_ARMS


def test_links_touch_no_more_along_a_motion():
    scene = load("swing")
    check = Collisions(scene)
    run = simulate(scene, (0.0, 0.0, 0.0), 1.0)
    rows = np.hstack([run.gamma, run.mu, run.beta])
    for angles in rows[:: len(rows) // 20]:
        assert check.touching(dict(zip(JOINTS, angles, strict=True))) == ON_THE_ARMS


@pytest.mark.parametrize("name", ["swing", "gravity_payload", "general"])
def test_collision_shapes_enclose_what_is_drawn(name):
    """Points on each drawn shape lie in one that collisions are checked with."""
    coal = pytest.importorskip("coal", reason="coal is missing: pip install pin")
    scene = load(name)
    check = Collisions(scene)
    drawn = check.geometry(check.pin.GeometryType.VISUAL)
    joints = Dynamics.of(scene).joints(*start_of(scene)[:7])[:9]
    q = check.read.configuration(dict(zip(JOINTS, joints, strict=True)))
    placed = []
    for shapes_of_kind in (drawn, check.shapes):
        data = shapes_of_kind.createData()
        model = check.read.model
        check.pin.updateGeometryPlacements(
            model, check.read.data, shapes_of_kind, data, q
        )
        placed.append(data.oMg)
    point = coal.Sphere(1e-9)
    for shape, at in zip(drawn.geometryObjects, placed[0], strict=True):
        for corner in corners(shape.geometry):
            where = coal.Transform3s(np.eye(3), at.act(corner))
            assert any(
                coal.collide(
                    point,
                    where,
                    solid.geometry,
                    coal.Transform3s(there.rotation, there.translation),
                    coal.CollisionRequest(),
                    coal.CollisionResult(),
                )
                for solid, there in zip(
                    check.shapes.geometryObjects, placed[1], strict=True
                )
            ), (check.link(shape), shape.geometry)


def corners(solid):
    """Points just inside of a sphere, a box or a cylinder, in its own frame."""
    if hasattr(solid, "halfSide"):
        signs = 2.0 * np.array(list(np.ndindex(2, 2, 2))) - 1.0
        return list(0.999 * signs * np.array(solid.halfSide))
    height = 0.999 * getattr(solid, "halfLength", solid.radius)
    return [np.array([0.0, 0.0, height]), np.array([0.0, 0.0, -height])]


TABLE = """<?xml version="1.0"?>
<robot xmlns:xacro="http://www.ros.org/wiki/xacro" name="cell">
  <xacro:include filename="robot.urdf.xacro" />
  <link name="table" />
  {instances}
</robot>
"""
INSTANCE = (
    '<xacro:sst_swing parent="table" {prefix}><origin xyz="{x} 0 0.8" rpy="0 0 0.5" />'
    "</xacro:sst_swing>"
)


def embedded(tmp_path, *instances):
    """A larger URDF, as xacro makes it of our macro."""
    tool = pytest.importorskip("xacro", reason="needs xacro of a ROS installation")
    (tmp_path / "robot.urdf.xacro").write_text(xacro(load("swing"), ("/a", "/b")))
    document = tmp_path / "cell.urdf.xacro"
    document.write_text(TABLE.format(instances="\n".join(instances)))
    return ET.fromstring(tool.process_file(str(document)).toxml())


def parts(tree):
    """Links, joints and tags of a document, by kind and name."""
    return {
        (part.tag, part.get("name")): content(part)
        for part in tree
        if part.tag in ("link", "joint", "ros2_control")
    }


def content(part):
    """An element and all in it, without its layout; xacro orders attributes anew."""
    text = (part.text or "").strip()
    return part.tag, dict(part.attrib), text, [content(inner) for inner in part]


def test_xacro_embeds_the_robot_as_it_is(tmp_path):
    tree = embedded(tmp_path, INSTANCE.format(prefix="", x=1))
    fixed = tree.find("joint[@name='base_joint']")
    assert fixed.get("type") == "fixed"
    assert fixed.find("origin").attrib == {"xyz": "1 0 0.8", "rpy": "0 0 0.5"}
    assert fixed.find("parent").get("link") == "table"
    assert fixed.find("child").get("link") == BASE
    found = parts(tree)
    assert found.pop(("joint", "base_joint")) and found.pop(("link", "table"))
    own = ET.fromstring(urdf(load("swing"), ("/a", "/b")))
    assert found == parts(own)


def test_two_robots_in_one_document_have_names_of_their_own(tmp_path):
    instances = [
        INSTANCE.format(prefix=f'prefix="{side}_"', x=x)
        for x, side in enumerate(("left", "right"))
    ]
    tree = embedded(tmp_path, *instances)
    assert len(parts(tree)) == 1 + 2 * (
        len(parts(ET.fromstring(urdf(load("swing"), ("/a", "/b"))))) + 1
    )
    model = pytest.importorskip("pinocchio").buildModelFromXML(
        ET.tostring(tree, "unicode")
    )
    assert {f"{side}_{name}" for side in ("left", "right") for name in JOINTS} == set(
        list(model.names)[1:]
    )


def test_the_command_writes_the_macro(capsys):
    assert main(["describe", "--scene", "swing", "--xacro"]) == 0
    assert capsys.readouterr().out == xacro(load("swing"))


def test_an_arc_begins_ends_and_stays_on_its_sphere():
    begin, axis = np.array([0.6, 0.8, 0.0]), np.array([0.0, 0.0, 1.0])
    points = Arc(begin, axis, 1.234, 0.35, 0.01, (1.0, 0.0, 0.0)).points()
    assert points[0] == pytest.approx(0.35 * begin)
    assert np.linalg.norm(points, axis=1) == pytest.approx(0.35)
    assert np.arccos(points[0] @ points[-1] / 0.35**2) == pytest.approx(1.234)
    assert points[-1] @ np.cross(axis, begin) > 0.0


@some_scenes
def test_every_scene_is_drawn(name):
    drawn = shapes(load(name))
    assert len(drawn) == 8
    for shape in (shape for link in drawn.values() for shape in link):
        size = (
            shape.size.min()
            if isinstance(shape, Box)
            else getattr(shape, "radius", 1.0)
        )
        assert size > 0.0 and getattr(shape, "thickness", 1.0) > 0.0
        ends = (shape.centre,) if isinstance(shape, Ball | Box) else ()
        assert all(np.isfinite(end).all() for end in ends)


@pytest.mark.parametrize("name", ["example2_heavy", "general"])
def test_arcs_of_the_star_begin_at_e_and_are_perpendicular_to_it(name):
    scene = load(name)
    geometry = Geometry.of(scene)
    arcs = [
        shape.points() for shape in shapes(scene)[STAR_LINK] if isinstance(shape, Arc)
    ]
    for points, e in zip(arcs, geometry.e, strict=True):
        assert points[0] == pytest.approx([0.0, 0.0, scene.star.radius])
        assert points @ e == pytest.approx(0.0, abs=1e-15)


@pytest.mark.parametrize("lockstep", [False, True])
def test_tags_have_joints_topics_and_the_states_before_a_message(
    lockstep,
):
    """Without those a controller activated first holds nan, and no run starts."""
    scene = load("swing")
    text = urdf(scene, ("/a/commands", "/a/states"), lockstep=lockstep)
    tag, passive = ET.fromstring(text).findall("ros2_control")
    plugin = HARDWARE.find("class").get("name") if lockstep else PLUGIN
    topics = {"joint_commands_topic": "/a/commands", "joint_states_topic": "/a/states"}
    for one, name, given in (
        (tag, "sst_ros", topics | {"trigger_joint_command_threshold": "-1"}),
        (passive, "sst_ros_passive", {"joint_states_topic": "/a/states"}),
    ):
        assert one.attrib == {"name": name, "type": "system"}
        assert one.findtext("hardware/plugin") == plugin
        params = one.findall("hardware/param")
        assert {param.get("name"): param.text for param in params} == given
    assert [joint.get("name") for joint in passive.findall("joint")] == list(JOINTS[3:])
    assert not passive.findall(".//command_interface")
    for joint in passive.findall("joint"):
        states = [one.get("name") for one in joint.findall("state_interface")]
        assert states == ["position", "velocity"]
    assert [joint.get("name") for joint in tag.findall("joint")] == ACTUATORS
    starts = zip(scene.initial.gamma, scene.initial.gamma_dot, strict=True)
    for joint, (gamma, gamma_dot) in zip(tag.findall("joint"), starts, strict=True):
        assert [one.get("name") for one in joint.findall("command_interface")] == [
            "effort"
        ]
        assert [
            (
                one.get("name"),
                one.find("param").get("name"),
                float(one.findtext("param")),
            )
            for one in joint.findall("state_interface")
        ] == [
            (name, "initial_value", value)
            for name, value in (
                ("position", gamma),
                ("velocity", gamma_dot),
                ("effort", 0.0),
            )
        ]


def test_the_command_writes_both_and_the_second_has_the_first(capsys):
    assert main(["describe", "--scene", "swing"]) == 0
    assert capsys.readouterr().out == urdf(load("swing"))
    assert main(["describe", "--scene", "swing", "--ros2-control"]) == 0
    root = ET.fromstring(capsys.readouterr().out)
    for tag in root.findall("ros2_control"):
        root.remove(tag)
    plain = ET.fromstring(urdf(load("swing")))
    for tree in (root, plain):
        ET.indent(tree)
    assert ET.tostring(root).split() == ET.tostring(plain).split()


def test_each_controller_has_its_parameters_and_drives_actuators():
    document = yaml.safe_load(CONTROLLERS.read_text(encoding="utf-8"))
    given = {
        name.rpartition("/")[2]: node["ros__parameters"]
        for name, node in document.items()
    }
    manager = given.pop("controller_manager")
    assert set(given) == {
        name for name, value in manager.items() if isinstance(value, dict)
    }
    assert given["joint_state_broadcaster"]["use_local_topics"] is True
    for name in ("effort_controller", "trajectory_controller", "pid_controller"):
        joints = given[name].get("joints", given[name].get("dof_names"))
        assert joints == ACTUATORS
        assert set(given[name].get("gains", joints)) == set(joints)
