# SPDX-License-Identifier: Apache-2.0
"""Constraint moments against the multipliers of a maximal-coordinate Newton-Euler model.

The model knows bodies, axes and inertias only: 21 angular accelerations, 18 multipliers.
"""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from mechanism.closed_chains import random_geometry, random_mechanism, random_pose, random_rotation

from sst_ros.mechanism import rates, virtual_work

RELATIVE = 1e-10
BODIES = 7  # actuated 0 to 2, intermediate 3 to 5, star 6; the base is None


def newton_euler(mechanism, gamma, rotation, gamma_dot, torque, moment):
    """Accelerations (7, 3) and joint moments (9, 3) in {B}; joints by kind, then by leg."""
    geometry = mechanism.geometry
    w = geometry.w
    t = geometry.e @ rotation.T
    across = np.cross(w, geometry.v)
    r = np.cos(gamma)[:, None] * geometry.v + np.sin(gamma)[:, None] * across
    joints = [(None, k, w[k]) for k in range(3)]
    joints += [(k, 3 + k, r[k]) for k in range(3)] + [(3 + k, 6, t[k]) for k in range(3)]
    frames = [np.stack([r[k], np.cross(w[k], r[k]), w[k]], axis=1) for k in range(3)]
    frames += [np.stack([r[k], np.cross(t[k], r[k]), t[k]], axis=1) for k in range(3)]
    frames.append(rotation)
    tensors = [*mechanism.actuated, *mechanism.intermediate, mechanism.star]
    inertia = [f @ i @ f.T for f, i in zip(frames, tensors, strict=True)]

    # Two directions across each axis, fixed in the parent, which all of the axis is too.
    pairs = [np.linalg.svd(axis[None])[2][1:] for _, _, axis in joints]
    rows = np.zeros((18, 3 * BODIES))
    for index, ((parent, child, _), pair) in enumerate(zip(joints, pairs, strict=True)):
        for which, u in enumerate(pair):
            rows[2 * index + which, 3 * child : 3 * child + 3] = u
            if parent is not None:
                rows[2 * index + which, 3 * parent : 3 * parent + 3] = -u
    # Velocities: 18 constraints and three actuator rates.
    drive = np.zeros((3, 3 * BODIES))
    for k in range(3):
        drive[k, 3 * k : 3 * k + 3] = w[k]
    known = np.concatenate([np.zeros(18), gamma_dot])
    omega = np.linalg.solve(np.vstack([rows, drive]), known).reshape(BODIES, 3)

    bias, force = np.zeros(18), np.zeros(3 * BODIES)
    for index, ((parent, child, _), pair) in enumerate(zip(joints, pairs, strict=True)):
        if parent is not None:
            for which, u in enumerate(pair):
                turning = np.cross(omega[parent], u)
                bias[2 * index + which] = turning @ (omega[child] - omega[parent])
    mass = np.zeros((3 * BODIES, 3 * BODIES))
    for body in range(BODIES):
        at = slice(3 * body, 3 * body + 3)
        mass[at, at] = inertia[body]
        force[at] = -np.cross(omega[body], inertia[body] @ omega[body])
    for k in range(3):
        force[3 * k : 3 * k + 3] += torque[k] * w[k]
    force[18:] += moment
    system = np.block([[mass, -rows.T], [rows, np.zeros((18, 18))]])
    solved = np.linalg.solve(system, np.concatenate([force, -bias]))
    multipliers = solved[21:].reshape(9, 2)
    moments = np.array([m @ pair for m, pair in zip(multipliers, pairs, strict=True)])
    return solved[:21].reshape(BODIES, 3), moments, frames


def case(seed):
    rng = np.random.default_rng(seed)
    geometry = random_geometry(rng)
    mechanism = random_mechanism(rng, geometry)
    gamma, rotation = random_pose(rng, geometry)
    return (mechanism, gamma, rotation, *rng.normal(size=(3, 3)) * [[2.0], [1.0], [1.0]])


@settings(max_examples=120)
@given(st.integers(0, 2**32 - 1))
def test_accelerations_and_constraint_moments_are_those_of_the_model(seed):
    mechanism, gamma, rotation, rate, torque, moment = case(seed)
    moving, expected, frames = newton_euler(mechanism, gamma, rotation, rate, torque, moment)
    at = virtual_work.posture(mechanism.geometry, gamma, rotation)
    answer = virtual_work.direct_dynamics(mechanism, at, rate, torque, moment)
    truth = np.sum(moving[:3] * mechanism.geometry.w, axis=1)
    assert np.linalg.norm(answer - truth) <= RELATIVE * np.linalg.norm(truth)
    found = rates.of_torque(mechanism, at, rate, torque, moment)
    moments = np.concatenate([found.actuated, found.revolute, found.prismatic])
    assert np.linalg.norm(moments - expected) <= RELATIVE * np.linalg.norm(expected)
    local = [found.actuated_local, found.revolute_local, found.prismatic_local]
    turned = [frames[0:3], frames[3:6], frames[3:6]]
    for kind in range(3):
        seen = [turned[kind][k].T @ expected[3 * kind + k] for k in range(3)]
        assert np.linalg.norm(local[kind] - seen) <= RELATIVE * np.linalg.norm(expected)
    assert not np.any(found.actuated_local[:, 2])
    assert not np.any(found.revolute_local[:, 0])
    assert not np.any(found.prismatic_local[:, 2])
    assert not found.actuated.flags.writeable


def test_the_star_is_in_balance_and_motion_and_torque_agree():
    for seed in range(10):
        mechanism, gamma, rotation, rate, torque, moment = case(seed)
        at = virtual_work.posture(mechanism.geometry, gamma, rotation)
        first = rates.of_torque(mechanism, at, rate, torque, moment)
        acceleration = virtual_work.direct_dynamics(mechanism, at, rate, torque, moment)
        second = rates.of_motion(mechanism, at, rate, acceleration, moment)
        for name in ("actuated", "revolute", "prismatic", "torque"):
            one, two = getattr(first, name), getattr(second, name)
            assert np.linalg.norm(one - two) <= RELATIVE * max(np.linalg.norm(one), 1.0)
        bias = virtual_work.bias(at, rate)
        omega_dot = at.j @ acceleration + bias.omega_dot
        tensor = rotation @ mechanism.star @ rotation.T
        spin = np.cross(bias.omega, tensor @ bias.omega)
        total = first.prismatic.sum(axis=0) + moment
        np.testing.assert_allclose(total, tensor @ omega_dot + spin, rtol=1e-9, atol=1e-9)


def test_at_rest_without_load_nothing_presses():
    rng = np.random.default_rng(1)
    geometry = random_geometry(rng)
    gamma, rotation = random_pose(rng, geometry)
    at = virtual_work.posture(geometry, gamma, rotation)
    found = rates.of_torque(random_mechanism(rng, geometry), at, np.zeros(3), np.zeros(3))
    assert not np.any(found.actuated) and not np.any(found.prismatic)


def test_a_static_moment_goes_through_the_legs_to_the_base():
    """At rest with tau = -J^T n_ext all moments on the base add up to n_ext."""
    rng = np.random.default_rng(2)
    for _ in range(10):
        geometry = random_geometry(rng)
        mechanism = random_mechanism(rng, geometry)
        gamma, rotation = random_pose(rng, geometry)
        at = virtual_work.posture(geometry, gamma, rotation)
        moment = random_rotation(rng)[0]
        found = rates.of_motion(mechanism, at, np.zeros(3), np.zeros(3), moment)
        base = found.actuated + found.torque[:, None] * geometry.w
        np.testing.assert_allclose(base.sum(axis=0), -moment, atol=1e-12)
