# SPDX-License-Identifier: Apache-2.0
"""Rates of every joint and link against differences, and the moments between the links.

The moments are held against the multipliers of a maximal-coordinate Newton-Euler model,
which knows bodies, axes and inertias only: 21 angular accelerations, 18 multipliers.
"""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from lagrange import Lagrange, Motion
from mechanism.closed_chains import ISOTROPIC, random_sample

from sst_ros.dynamics.reactions import reactions_of
from sst_ros.errors import SingularConfiguration
from sst_ros.mechanism import kinematics, rates, virtual_work
from sst_ros.scene.loads import Moment

EXACT = 1e-12
RELATIVE = 1e-10
BODIES = 7  # actuated 0 to 2, intermediate 3 to 5, star 6; the base is None


def relative(found, expected):
    return np.linalg.norm(found - expected) / np.linalg.norm(expected)


def states():
    rng = np.random.default_rng(11)
    for index in range(6):
        sample = random_sample(rng, ISOTROPIC if index == 0 else None)
        branch = [1, 1, 1] if index < 4 else [1, -1, -1]
        yield sample, sample.gamma + np.pi * (np.array(branch) < 0)


@pytest.mark.parametrize(("sample", "gamma"), list(states()), ids=range(6))
def test_rates_and_accelerations_of_every_joint_and_link(sample, gamma):
    rate, acceleration = sample.gamma_dot, sample.torque
    exact = Motion(Lagrange(sample.scene, sample.rotation), gamma, rate, acceleration)
    here = exact.here
    omega, omega_dot = (x[0].astype(float) for x in (exact.omega, exact.omega_dot))
    of_links, links_dot = (
        here.own(x)[1:].astype(float) for x in (exact.omega, exact.omega_dot)
    )
    joints, joints_dot = exact.rates.astype(float), exact.accelerations.astype(float)
    at = virtual_work.posture(sample.geometry, gamma, here.rotation.astype(float))
    from_star = rates.of_star(sample.geometry, at.rotation, omega, omega_dot, gamma)
    from_actuators = rates.of_actuators(at, rate, acceleration)
    assert not from_actuators.omega.flags.writeable
    for motion in (from_star, from_actuators):
        pairs = [
            (motion.omega, omega),
            (motion.omega_dot, omega_dot),
            ([motion.gamma_dot, motion.mu_dot, motion.beta_dot], joints),
            ([motion.gamma_ddot, motion.mu_ddot, motion.beta_ddot], joints_dot),
            (motion.omega_a, of_links[:3]),
            (motion.omega_a_dot, links_dot[:3]),
            (motion.omega_ipl, of_links[3:]),
            (motion.omega_ipl_dot, links_dot[3:]),
        ]
        assert max(relative(np.ravel(f), np.ravel(e)) for f, e in pairs) <= EXACT
    # The paper's rows, one by one.
    bias = virtual_work.bias(at, rate)
    ja, jipl = virtual_work.link_jacobians(at)
    pairs = [
        (at.j @ rate, omega),
        (at.a @ rate, joints[1]),
        (at.b @ rate, joints[2]),
        (bias.omega, omega),
        (at.j @ acceleration + bias.omega_dot, omega_dot),
        (at.a @ acceleration + bias.mu_ddot, joints_dot[1]),
        (at.b @ acceleration + bias.beta_ddot, joints_dot[2]),
        (at.u @ acceleration + bias.beta_ddot, joints_dot[2]),
        (ja @ rate, of_links[:3]),
        (jipl @ rate, of_links[3:]),
    ]
    assert max(relative(np.ravel(f), np.ravel(e)) for f, e in pairs) <= EXACT


def newton_euler(sample):
    """Accelerations (7, 3) and joint moments (9, 3) in {B}.

    Joints by kind, then by leg.
    """
    scene, rotation, at = sample.scene, sample.rotation, sample.posture
    w, r, t = at.w, at.r, at.t
    joints = [(None, k, w[k]) for k in range(3)]
    joints += [(k, 3 + k, r[k]) for k in range(3)] + [
        (3 + k, 6, t[k]) for k in range(3)
    ]
    frames = [*np.concatenate(virtual_work.link_frames(at)), rotation]
    links = [*scene.actuated_links, *scene.intermediate_links, scene.star]
    inertia = [
        f @ body.inertia.matrix @ f.T for f, body in zip(frames, links, strict=True)
    ]

    # Two directions across each axis, fixed in the parent, which all of the axis is
    # too.
    pairs = [np.linalg.svd(axis[None])[2][1:] for _, _, axis in joints]
    rows = np.zeros((18, 3 * BODIES))
    for index, ((parent, child, _), pair) in enumerate(zip(joints, pairs, strict=True)):
        rows[2 * index : 2 * index + 2, 3 * child : 3 * child + 3] = pair
        if parent is not None:
            rows[2 * index : 2 * index + 2, 3 * parent : 3 * parent + 3] = -pair
    # Velocities: 18 constraints and three actuator rates.
    drive = np.zeros((3, 3 * BODIES))
    for k in range(3):
        drive[k, 3 * k : 3 * k + 3] = w[k]
    known = np.concatenate([np.zeros(18), sample.gamma_dot])
    omega = np.linalg.solve(np.vstack([rows, drive]), known).reshape(BODIES, 3)

    bias, force = np.zeros(18), drive.T @ sample.torque
    for index, ((parent, child, _), pair) in enumerate(zip(joints, pairs, strict=True)):
        if parent is not None:
            turning = np.cross(omega[parent], pair)
            bias[2 * index : 2 * index + 2] = turning @ (omega[child] - omega[parent])
    mass = np.zeros((3 * BODIES, 3 * BODIES))
    for body in range(BODIES):
        at = slice(3 * body, 3 * body + 3)
        mass[at, at] = inertia[body]
        force[at] -= np.cross(omega[body], inertia[body] @ omega[body])
    force[18:] += sample.moment
    system = np.block([[mass, -rows.T], [rows, np.zeros((18, 18))]])
    solved = np.linalg.solve(system, np.concatenate([force, -bias]))
    multipliers = solved[21:].reshape(9, 2)
    moments = np.array([m @ pair for m, pair in zip(multipliers, pairs, strict=True)])
    return solved[:21].reshape(BODIES, 3), moments, frames


@settings(max_examples=120)
@given(st.integers(0, 2**32 - 1))
def test_accelerations_and_constraint_moments_are_the_models(seed):
    sample = random_sample(np.random.default_rng(seed))
    moving, expected, frames = newton_euler(sample)
    given_motion = sample.mechanism, sample.posture, sample.gamma_dot
    answer = virtual_work.direct_dynamics(*given_motion, sample.torque, sample.moment)
    truth = np.sum(moving[:3] * sample.geometry.w, axis=1)
    assert relative(answer, truth) <= RELATIVE
    scene = replace(sample.scene, moment=Moment(value=tuple(sample.moment.tolist())))
    state = np.array([sample.state])
    given_state = np.zeros(1), state[:, :4], state[:, 4:], sample.torque[None]
    found = reactions_of(scene, *given_state)
    turned = [frames[0:3], frames[3:6], frames[3:6]]
    axes = 2, 0, 2
    for kind, (name, loads) in enumerate(found.joints()):
        axis = axes[kind]
        about = loads.moment[0, :, axis]
        torque = sample.torque if name == "actuated" else np.zeros(3)
        assert np.abs(about - torque).max() <= RELATIVE * np.linalg.norm(expected)
        across = loads.moment[0].copy()
        across[:, axis] = 0.0
        seen = [turned[kind][k].T @ expected[3 * kind + k] for k in range(3)]
        assert np.linalg.norm(across - seen) <= RELATIVE * np.linalg.norm(expected)
    assert not found.actuated.moment.flags.writeable


@pytest.mark.parametrize(
    "ask",
    [
        lambda rotation, gamma: rates.of_star(ISOTROPIC, rotation, [1.0, 0.0, 0.0]),
        lambda rotation, gamma: virtual_work.posture(ISOTROPIC, gamma, rotation),
    ],
)
def test_a_serial_singularity_is_told(ask):
    t, x = ISOTROPIC.w[0], np.array([1.0, 0.0, 0.0])  # t_1 = R e_1 = w_1
    assert t @ x == 0.0
    s = np.cos(0.7) * x + np.sin(0.7) * np.cross(t, x)
    rotation = np.stack([np.cross(t, s), t, s], axis=1)
    with pytest.raises(SingularConfiguration, match="serial"):
        ask(rotation, kinematics.inverse(ISOTROPIC, rotation)[0])
