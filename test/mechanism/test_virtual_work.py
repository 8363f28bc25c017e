# SPDX-License-Identifier: Apache-2.0
"""The paper's equations and the kernel that runs, against Lagrange's to 80 digits and
each other.

Samples keep abs(det J2) > 0.05 and sin(mu) > 0.2, so J and the inertia matrix lose at
most about two digits of double precision: 1e-12 of the largest terms that meet leaves
two more. The kernel is also held on every type of number.
"""

from __future__ import annotations

import lagrange
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from lagrange import Lagrange, Motion, exact
from mechanism.closed_chains import random_sample
from models import FAST, agree, samples, seeded_samples
from mpmath import mp, mpf
from slow_cases import slow_except

from sst_ros.dynamics import kernel
from sst_ros.mechanism import kinematics, rates, virtual_work
from sst_ros.mechanism.generic_math import rotation_rows

SAMPLES = [*seeded_samples(1, 6, isotropic=True), *seeded_samples(2, 6)]
TINY = 1e-30
every_sample = pytest.mark.parametrize("sample", SAMPLES, ids=range(len(SAMPLES)))


@every_sample
@pytest.mark.parametrize("pushed", slow_except([True], [False, True]))
def test_direct_dynamics_is_lagranges(sample, pushed):
    loads = (sample.torque, sample.moment) if pushed else (sample.torque,)
    truth = Lagrange(sample.scene, sample.rotation)
    arguments = (sample.mechanism, sample.posture, sample.gamma_dot)
    gamma_ddot = truth.acceleration(sample.gamma, sample.gamma_dot, *loads)
    agree(virtual_work.direct_dynamics(*arguments, *loads), gamma_ddot)
    motion = Motion(truth, sample.gamma, sample.gamma_dot, gamma_ddot)
    expected = motion.here.rotation.T @ motion.omega_dot[0]
    found = kernel.derivative(
        sample.model, sample.state, *(tuple(x.tolist()) for x in loads)
    )
    agree(found[4:], expected)


def test_the_truth_does_not_depend_on_its_steps(monkeypatch):
    sample = SAMPLES[-1]
    truth = Lagrange(sample.scene, sample.rotation)
    given_motion = sample.gamma, sample.gamma_dot, sample.torque, sample.moment
    fine = truth.acceleration(*given_motion)
    monkeypatch.setattr(lagrange, "STEP", 100 * lagrange.STEP)
    assert 0 < abs(truth.acceleration(*given_motion) - fine).max() < 1e-17


@every_sample
def test_t1_is_minus_the_inertia_matrix(sample):
    truth = Lagrange(sample.scene, sample.rotation).inertia_matrix(exact(sample.gamma))
    t1, _ = virtual_work.equation_of_motion(
        sample.mechanism, sample.posture, sample.gamma_dot
    )
    agree(-t1, truth)


@every_sample
def test_link_frames_are_those_built_by_geometry(sample):
    truth = Lagrange(sample.scene, sample.rotation).at(exact(sample.gamma)).frames
    actuated, intermediate = virtual_work.link_frames(sample.posture)
    agree(actuated, truth[1:4])
    agree(intermediate, truth[4:7])


@settings(max_examples=80)
@given(st.integers(0, 2**32 - 1))
def test_energy_momentum_and_both_dynamics_agree(seed):
    sample = random_sample(np.random.default_rng(seed))
    mechanism, at, rate = sample.mechanism, sample.posture, sample.gamma_dot
    torque, moment = sample.torque, sample.moment
    t1, t2 = virtual_work.equation_of_motion(mechanism, at, rate)
    assert np.linalg.eigvalsh(-t1)[0] > 0
    # Kinetic energy of the seven links, one by one.
    motion = rates.of_actuators(at, rate)
    body = sample.rotation.T @ motion.omega
    energy = body @ mechanism.star @ body
    for k in range(3):
        energy += motion.omega_a[k] @ mechanism.actuated[k] @ motion.omega_a[k]
        energy += motion.omega_ipl[k] @ mechanism.intermediate[k] @ motion.omega_ipl[k]
    np.testing.assert_allclose(-rate @ t1 @ rate, energy, rtol=1e-12)
    acceleration = virtual_work.direct_dynamics(mechanism, at, rate, torque, moment)
    again = virtual_work.inverse_dynamics(mechanism, at, rate, acceleration, moment)
    size = np.linalg.norm(t1) * np.linalg.norm(acceleration) + np.linalg.norm(t2)
    assert np.linalg.norm(again - torque) <= 1e-12 * (size + np.linalg.norm(torque))


def worst_term(sample):
    """Size of what adds up to gamma_ddot: torque and velocity products, each through
    M^-1.
    """
    t1, t2 = virtual_work.equation_of_motion(
        sample.mechanism, sample.posture, sample.gamma_dot
    )
    bias = virtual_work.bias(sample.posture, sample.gamma_dot).omega_dot
    force = np.abs(sample.torque).max() + np.abs(t2).max() + np.abs(sample.moment).max()
    through_j = np.abs(np.linalg.inv(sample.posture.j)).max() * np.abs(bias).max()
    return force * np.abs(np.linalg.inv(t1)).max() + through_j


@FAST
@given(samples(), st.floats(1e-6, 1e6))
def test_the_kernel_is_the_paper(sample, length):
    """Acceleration, energy, angles and rates.

    The length of the quaternion does not matter.
    """
    at, rate, torque, moment = (
        sample.posture,
        sample.gamma_dot,
        sample.torque,
        sample.moment,
    )
    paper = virtual_work.direct_dynamics(sample.mechanism, at, rate, torque, moment)
    state = (*(length * part for part in sample.quaternion), *sample.body_rate)
    body = kernel.derivative(sample.model, state, tuple(torque), tuple(moment))[4:]
    agree(sample.gamma_ddot_of(body), paper, worst_term(sample))
    t1, _ = virtual_work.equation_of_motion(sample.mechanism, at, rate)
    energy = kernel.kinetic_energy(sample.model, state)
    agree(energy, -rate @ t1 @ rate / 2.0, np.abs(t1).max() * (rate @ rate))
    joints = kernel.joints(sample.model, state)
    angles = kinematics.inverse(sample.geometry, sample.rotation)
    agree([joints.gamma, joints.mu, joints.beta], angles, 1.0)
    size = (1.0 + np.linalg.norm(rate)) * (1.0 + np.linalg.cond(at.j))
    agree(
        [joints.gamma_dot, joints.mu_dot, joints.beta_dot],
        [rate, at.a @ rate, at.b @ rate],
        size,
    )


@every_sample
def test_columns_give_what_single_states_give(sample):
    others = [sample.state, tuple(1.5 * x for x in sample.state)]
    torque = tuple(sample.torque.tolist())
    columns_in = tuple(np.array(column) for column in zip(*others, strict=True))
    batch = np.array(kernel.derivative(sample.model, columns_in, torque))
    for column, state in zip(batch.T, others, strict=True):
        single = kernel.derivative(sample.model, state, torque)
        agree(column, single)


@every_sample
def test_complex_step_by_the_state_is_the_mp_difference(sample):
    mp.dps, h = 40, mpf(10) ** -13
    torque = tuple(sample.torque.tolist())
    fine = kernel.derivative(sample.model, tuple(map(mpf, sample.state)), torque)
    agree(kernel.derivative(sample.model, sample.state, torque), fine)
    assert fine[4] != mpf(float(fine[4]))  # more digits than a float has
    for k in range(7):
        moved = [complex(x) for x in sample.state]
        moved[k] += 1j * TINY
        slope = [
            x.imag / TINY for x in kernel.derivative(sample.model, tuple(moved), torque)
        ]
        ends = []
        for sign in (-1, 1):
            state = [mpf(x) for x in sample.state]
            state[k] += sign * h
            ends.append(kernel.derivative(sample.model, tuple(state), torque))
        truth = [(y - x) / (2 * h) for x, y in zip(*ends, strict=True)]
        # A slope divides the terms of the sum by sin(mu) or det J2 once more: ten times
        # as large.
        agree(slope[4:], truth[4:], worst_term(sample) * 10.0 + 1.0)


@every_sample
def test_quaternion_rate_turns_the_frame_by_the_body_rate(sample):
    h = 1j * TINY
    rates = kernel.derivative(sample.model, sample.state, (0.0, 0.0, 0.0))
    moved = tuple(
        x + h * rate for x, rate in zip(sample.quaternion, rates, strict=False)
    )
    slope = np.array(rotation_rows(moved)).imag / TINY
    wx, wy, wz = sample.body_rate
    skew = np.array([[0, -wz, wy], [wz, 0, -wx], [-wy, wx, 0]])
    agree(slope, sample.rotation @ skew, 1.0 + np.linalg.norm(sample.body_rate))


@every_sample
def test_branch_without_products_of_inertia_is_the_general_one(sample):
    """A product of 1e-300 takes the long way and changes nothing above rounding."""
    bare = [leg._replace(ixy=0.0, ixz=0.0, iyz=0.0) for leg in sample.model.legs]
    full = [leg._replace(iyz=1e-300) for leg in bare]
    short, long = (
        kernel.derivative(
            sample.model._replace(legs=tuple(legs)),
            sample.state,
            tuple(sample.torque.tolist()),
        )
        for legs in (bare, full)
    )
    agree(long, short)
