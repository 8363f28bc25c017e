# SPDX-License-Identifier: Apache-2.0
"""Reactions against Newton's and Euler's equations of each link, virtual work, and
Pinocchio.

The links' accelerations are differences of positions in 80 digits, which know loop
closure alone.
"""

from dataclasses import replace

import numpy as np
import pytest
from description.test_urdf import Read, angles_of, by_joint, closed
from lagrange import Lagrange, Motion, slope
from lagrange import friction_torque as documented_torque
from loaded_scenes import loaded as loaded_scene
from mechanism.test_loads import loaded
from models import seeded_samples
from mpmath import mpf

from sst_ros import load_scene, simulate
from sst_ros.dynamics.own_loads import own_load
from sst_ros.dynamics.reactions import LINK_JOINTS, reactions_of
from sst_ros.dynamics.traced_dynamics import Dynamics
from sst_ros.mechanism import rates, virtual_work
from sst_ros.mechanism.geometry import Geometry, quaternion_of
from sst_ros.scene.loads import Friction, JointFriction, Spring

EXACT = 1e-10


def at_state(scene, state, torque):
    """Reactions at one state."""
    y = np.array([state])
    return reactions_of(scene, np.zeros(1), y[:, :4], y[:, 4:7], np.array([torque]))


def in_base(found):
    """Forces and moments of the only sample in {B}, shapes (3 joints, 3 legs, 3)."""
    frames = {"actuated": found.actuated_frames}
    vectors = []
    for kind in ("force", "moment"):
        rows = []
        for name, loads in found.joints():
            frame = frames.get(name, found.intermediate_frames)[0]
            rows.append(np.einsum("kij,kj->ki", frame, getattr(loads, kind)[0]))
        vectors.append(np.array(rows))
    return vectors


@pytest.mark.parametrize("sample", seeded_samples(91, 3), ids=range(3))
def test_every_link_obeys_newton_and_euler_under_every_load(sample):
    scene = loaded(sample, 0.4)
    found = at_state(scene, sample.state, sample.torque)
    force, moment = in_base(found)
    slopes = Dynamics.of(scene).derivative(*sample.state, *sample.torque.tolist())
    gamma_ddot = sample.gamma_ddot_of(slopes[4:7])
    truth = Lagrange(scene, sample.rotation)
    motion = Motion(truth, sample.gamma, sample.gamma_dot, gamma_ddot)
    here = motion.here

    def centres(t):  # mass times centre of all bodies in {B}
        frames = truth.at(motion.path(t)).frames
        return np.array([f @ h for f, h in zip(frames, truth.weights, strict=True)])

    bodies = [scene.star, *scene.actuated_links, *scene.intermediate_links]
    mass = np.array([body.mass for body in bodies])
    mass[0] += scene.payload.mass
    gravity = np.array(scene.gravity.acceleration)
    heavy = centres(0).astype(float)
    needs_force = (
        slope(lambda t: slope(centres, t)).astype(float) - mass[:, None] * gravity
    )
    needs_moment = motion.momentum_rates().astype(float) - np.cross(heavy, gravity)
    needs_moment[0] -= scene.moment.value
    scale_force, scale = np.abs(needs_force).max(), np.abs(needs_moment).max()
    for got, needs, size in (
        (force, needs_force, scale_force),
        (moment, needs_moment, scale),
    ):
        actuated, revolute, prismatic = got
        rest = np.array(
            [*(actuated - revolute), *(revolute - prismatic), prismatic.sum(axis=0)]
        )
        wanted = np.array([*needs[1:4], *needs[4:7], needs[0]])
        assert np.abs(rest - wanted).max() < EXACT * size
        # Virtual work: any turns and shifts of all links, whether or not joints allow
        # them.
        rng = np.random.default_rng(5)
        drives, links, star = (
            rng.normal(size=(3, 3)),
            rng.normal(size=(3, 3)),
            rng.normal(size=3),
        )
        work = np.sum(actuated * drives) + np.sum(revolute * (links - drives))
        work += np.sum(prismatic * (star - links))
        expected = (
            np.sum(needs[1:4] * drives) + np.sum(needs[4:7] * links) + needs[0] @ star
        )
        assert work == pytest.approx(expected, abs=EXACT * size)
    # About its own axis a joint transmits what acts there, and nothing else.
    angles, speeds = here.angles.astype(float), motion.rates.astype(float)
    axes = np.array([truth.w, -here.r, -here.t]).astype(float)
    about = np.einsum("jki,jki->jk", moment, axes)
    expected = np.zeros((3, 3))
    for kind, name in enumerate(("gamma", "mu", "beta")):
        friction = getattr(scene.friction, name)
        for leg in range(3):
            rubbing = documented_torque(friction, mpf(speeds[kind, leg]))
            expected[kind, leg] -= float(rubbing)
    for spring in scene.springs:
        kind, leg = (
            ("gamma", "mu", "beta").index(spring.joint[:-2]),
            int(spring.joint[-1]) - 1,
        )
        expected[kind, leg] -= spring.stiffness * (angles[kind, leg] - spring.rest)
    arcs = Geometry.of(scene).arc
    for leg in range(3):
        stiffness, damping = scene.stroke.stiffness, scene.stroke.damping
        low, high = max(-angles[0, leg], 0.0), max(angles[0, leg] - arcs[leg], 0.0)
        inward = damping * speeds[0, leg]
        push = low * max(1.0 - inward, 0.0) - high * max(1.0 + inward, 0.0)
        expected[0, leg] += stiffness * push + sample.torque[leg]
    assert np.abs(about - expected).max() < EXACT * np.abs(expected).max()


def test_forces_have_the_least_sum_of_squares():
    """They are the solution of least norm of all 21 balances of forces."""
    sample = seeded_samples(92, 1)[0]
    force, _ = in_base(at_state(loaded(sample, 0.7), sample.state, sample.torque))
    rows = np.zeros((7, 9))  # of links by joints; each holds for every axis
    for k in range(3):
        rows[k, k], rows[k, 3 + k] = 1.0, -1.0
        rows[3 + k, 3 + k], rows[3 + k, 6 + k] = 1.0, -1.0
        rows[6, 6 + k] = 1.0
    given = force.reshape(9, 3)
    least = np.linalg.lstsq(rows, rows @ given, rcond=None)[0]
    assert np.linalg.matrix_rank(rows) == 7  # so six components of 27 are free
    assert np.abs(given - least).max() < 1e-12 * np.abs(given).max()


@pytest.mark.parametrize("seed", range(4))
def test_pinocchios_internal_forces(seed):
    """From the URDF alone: moments about O in all joints that its tree has, sums of
    forces.
    """
    rub = Friction(viscous=0.3, coulomb=0.2, smoothing=0.1)
    scene = replace(
        loaded_scene(),
        friction=JointFriction(gamma=rub, mu=rub),
        springs=(Spring(joint="mu_2", stiffness=5.0, rest=0.3),
                 Spring(joint="beta_1", stiffness=4.0, rest=0.1)),
        moment=None,
        actuators=None,  # a URDF gives rotors a mass
    )  # fmt: skip
    scene = scene.with_values(
        {
            "actuated_links.mass": 0.3, "actuated_links.centre": [0.05, 0.02, 0.0],
            "intermediate_links.mass": 0.2,
            "intermediate_links.centre": [0.03, 0.0, 0.02],
        }
    )  # fmt: skip
    rng = np.random.default_rng(seed)
    geometry = Geometry.of(scene)
    gamma = np.add(scene.initial.gamma, rng.uniform(-0.05, 0.05, 3))
    at = virtual_work.posture(geometry, gamma)
    gamma_dot, torque = rng.normal(size=3), rng.normal(size=3)
    motion = rates.of_actuators(at, gamma_dot)
    state = (*quaternion_of(at.rotation), *(at.rotation.T @ motion.omega))
    found = at_state(scene, state, torque)
    force, moment = in_base(found)

    read = Read(scene)
    pin = read.pin
    model, ties, tied = closed(read, geometry)
    read.model, data = model, model.createData()
    model.gravity = pin.Motion(np.array(scene.gravity.acceleration), np.zeros(3))
    angles = angles_of(geometry, gamma, at.rotation)
    speeds = by_joint(motion.gamma_dot, motion.mu_dot, motion.beta_dot)
    opened = {
        name: angle for name, angle in angles.items() if model.existJointName(name)
    }
    q, v, u = read.configuration(opened), np.zeros(model.nv), np.zeros(model.nv)
    for name in opened:
        index = model.joints[model.getJointId(name)].idx_v
        v[index] = speeds[name]
        kind, leg = name.split("_")
        if kind == "gamma":
            u[index] += torque[int(leg) - 1]
        if kind in ("gamma", "mu"):
            u[index] -= float(documented_torque(rub, mpf(speeds[name])))
        for spring in scene.springs:
            if spring.joint == name:
                u[index] -= spring.stiffness * (angles[name] - spring.rest)
    try:
        pin.initConstraintDynamics(model, data, ties, tied)
    except TypeError:  # before Pinocchio 4
        pin.initConstraintDynamics(model, data, ties)
    proximal = pin.ProximalSettings(1e-16, 1e-3, 30)
    a = pin.constraintDynamics(model, data, q, v, u, ties, tied, proximal)
    pin.forwardKinematics(model, data, q, v, a)
    external = [pin.Force.Zero() for _ in range(model.njoints)]
    for tie, own in zip(ties, tied, strict=True):
        # The tie's force acts on its first joint, in the frame there; its opposite on
        # the second.
        at_first = tie.joint1_placement.act(own.contact_force)
        external[tie.joint1_id] += at_first
        in_world = data.oMi[tie.joint1_id].act(at_first)
        external[tie.joint2_id] -= data.oMi[tie.joint2_id].actInv(in_world)
    pin.rnea(model, data, q, v, a, external)
    scale, forces = np.abs(moment).max(), np.zeros(3)
    for kind, name in enumerate(("gamma", "mu", "beta")):
        for leg in range(3):
            if not model.existJointName(f"{name}_{leg + 1}"):
                continue
            joint = model.getJointId(f"{name}_{leg + 1}")
            transmitted = data.oMi[joint].act(data.f[joint])
            assert np.abs(transmitted.angular - moment[kind, leg]).max() < 1e-9 * scale
            forces += transmitted.linear if kind == 0 else 0.0
    assert np.abs(forces - force[0].sum(axis=0)).max() < 1e-9 * np.abs(forces).max()


def test_a_payload_at_rest_hangs_in_the_joints():
    """The base carries all weights, and holds them about O."""
    scene = load_scene("gravity_payload").with_values(
        {"friction": None, "springs": None}
    )
    motion = simulate(
        scene, duration=1e-3, samples=1, initial=(scene.initial.gamma, np.zeros(3))
    )
    still = motion.reactions
    bodies = [
        scene.star,
        scene.payload,
        *scene.actuated_links,
        *scene.intermediate_links,
    ]
    mass = sum(body.mass for body in bodies)
    accelerated = np.abs(motion.gamma_ddot[0]).max()
    # torques do not hold it: the weight is not all that the base carries
    assert accelerated > 0.1
    from sst_ros import equilibrium

    held = equilibrium(scene, scene.initial.gamma)
    found = at_state(scene, [*held.quaternion, *held.body_rate], held.torque)
    force, moment = in_base(found)
    gravity = np.array(scene.gravity.acceleration)
    assert force[0].sum(axis=0) == pytest.approx(-mass * gravity, rel=1e-12)
    assert found.actuated.axis_torque[0] == pytest.approx(held.torque, rel=1e-11)
    assert found.revolute.axis_torque[0] == pytest.approx(np.zeros(3), abs=1e-13)
    star = np.array(scene.star.centre) * scene.star.mass
    star = star + np.array(scene.payload.centre) * scene.payload.mass
    rotation = virtual_work.posture(Geometry.of(scene), scene.initial.gamma).rotation
    weight = np.cross(rotation @ star, gravity)
    assert moment[2].sum(axis=0) == pytest.approx(-weight, abs=1e-12)
    assert still.t.shape == (2,)


@pytest.mark.slow
def test_an_own_load_acts_where_its_formula_says():
    """A spring, a formula of its angle: the same reactions, in the joint and in all
    others.
    """
    scene = load_scene("friction").with_values(
        {"springs": [{"joint": "beta_2", "stiffness": 6.0, "rest": 0.2}]}
    )
    own = own_load("spring", potential=lambda at: 3.0 * (at.beta[1] - 0.2) ** 2)
    given = [simulate(scene, duration=0.2, samples=5)]
    given.append(
        simulate(replace(scene, springs=(), own_loads=(own,)), duration=0.2, samples=5)
    )
    one, other = (motion.reactions.columns() for motion in given)
    assert np.abs(one["moment_prismatic_2_z"]).max() > 0.1
    for name, column in one.items():
        assert other[name] == pytest.approx(column, abs=1e-6)


def test_columns_figures_and_pictures():
    motion = simulate("gravity_payload", duration=0.3, samples=60)
    found = motion.reactions
    columns = found.columns()
    assert len(columns) == 54 and not found.actuated.force.flags.writeable
    for name in LINK_JOINTS:
        loads = getattr(found, name)
        parts = [columns[f"force_{name}_2_{axis}"] for axis in "xyz"]
        whole = np.sqrt(sum(x * x for x in parts))
        assert np.hypot(loads.radial_force, loads.axial_force)[:, 1] == pytest.approx(
            whole
        )
    figures = found.figures["prismatic"]["bending_moment"]
    bending = found.prismatic.bending_moment
    assert figures.peak == pytest.approx(bending.max(axis=0))
    assert figures.time == pytest.approx(motion.t[bending.argmax(axis=0)])
    fine = simulate("gravity_payload", duration=0.3, samples=6000).reactions
    exact = np.sqrt(np.mean(fine.prismatic.bending_moment[1:] ** 2, axis=0))
    assert figures.rms == pytest.approx(exact, rel=1e-3)
    assert len(found.plot().axes) == 7
    assert "bending moment" in repr(found)


def test_a_sample_has_the_reactions_of_its_state_alone():
    motion = simulate("friction", duration=0.3, samples=10)
    whole = motion.reactions.columns()
    alone = motion[4:5].reactions.columns()
    assert all(alone[name][0] == column[4] for name, column in whole.items())
