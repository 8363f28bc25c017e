# SPDX-License-Identifier: Apache-2.0
"""Inverse dynamics against the direct ones, the paper's form, Lagrange's potential, its
limits.
"""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from lagrange import Lagrange
from mechanism.test_loads import laden, loaded
from models import FAST, folding_star, samples, seeded_samples
from scipy.spatial.transform import Rotation

from benchmark.plain_python import without_llvmlite
from sst_ros import Trajectory, simulate
from sst_ros.control.controller import InverseDynamics
from sst_ros.dynamics import kernel
from sst_ros.dynamics.traced_dynamics import ODE, Dynamics
from sst_ros.errors import AssemblyError, InputError, SingularConfiguration
from sst_ros.mechanism import kinematics, virtual_work
from sst_ros.mechanism.generic_math import symmetric_rows
from sst_ros.mechanism.geometry import Geometry, quaternion_of
from sst_ros.scene.loads import Moment
from sst_ros.scene.scene import load
from sst_ros.simulation.simulation import Simulation
from sst_ros.state import State

FEW = settings(FAST, max_examples=25)  # each traces programs of its own
EPS = np.finfo(float).eps
ACCELERATIONS = st.tuples(*[st.floats(-20.0, 20.0)] * 3)


def rounding(scene, sample, acceleration, torque):
    """What rounding of the terms of both balances makes of W_dot, through M^-1 and the
    g_k.
    """
    inertia, force, reach = kernel.balance(
        kernel.model_of(scene), sample.quaternion, sample.body_rate, (0.0,) * 3
    )
    m, reach = np.array(symmetric_rows(inertia)), np.array(reach)
    terms = (
        np.abs(m) @ np.abs(acceleration)
        + np.abs(force)
        + np.abs(reach.T) @ np.abs(torque)
    )
    return (
        16.0
        * EPS
        * np.linalg.cond(reach)
        * np.linalg.norm(np.linalg.inv(m))
        * terms.sum()
    )


@FEW
@given(samples(), st.floats(0.0, 1.0), ACCELERATIONS)
def test_direct_dynamics_undo_inverse_dynamics_with_every_term(
    sample, number, acceleration
):
    scene = loaded(sample, number)
    torque = InverseDynamics(scene).torque(
        sample.quaternion, sample.body_rate, acceleration
    )
    found = Dynamics.of(scene).derivative(*sample.state, *torque)[4:]
    error = np.abs(np.subtract(found, acceleration)).max()
    assert error <= rounding(scene, sample, acceleration, torque)


@FEW
@given(samples(), ACCELERATIONS)
def test_torques_are_those_of_the_paper(sample, gamma_ddot):
    scene = dataclasses.replace(sample.scene, moment=Moment(topic=True))
    at, moment = sample.posture, tuple(sample.moment.tolist())
    paper = sample.mechanism, at, sample.gamma_dot
    expected = virtual_work.inverse_dynamics(*paper, gamma_ddot, moment)
    t1, t2 = virtual_work.equation_of_motion(*paper)
    omega_dot = at.j @ gamma_ddot + virtual_work.bias(at, sample.gamma_dot).omega_dot
    body = tuple((sample.rotation.T @ omega_dot).tolist())
    found = InverseDynamics(scene).torque(
        sample.quaternion, sample.body_rate, body, moment
    )
    # Both lose to J and to M what the largest of the terms that meet allows.
    size = np.linalg.norm(t1) * np.linalg.norm(gamma_ddot) + np.linalg.norm(t2)
    size += np.linalg.norm(at.j) * np.linalg.norm(moment)
    assert np.abs(found - expected).max() <= 1e-12 * size * np.linalg.cond(at.j)


@pytest.mark.parametrize("sample", seeded_samples(84, 3), ids=range(3))
def test_the_holding_torque_is_the_slope_of_the_potential_energy(sample):
    scene = dataclasses.replace(laden(sample), friction=None)
    truth = Lagrange(laden(sample), sample.rotation)
    expected = -np.array(truth.loads(sample.gamma, np.zeros(3)))
    found = InverseDynamics(scene).gravity_torque(sample.quaternion)
    assert np.abs(found - expected).max() <= 1e-12 * np.abs(expected).max()


@pytest.mark.slow
@FEW
@given(samples(), st.floats(0.0, 1.0))
def test_the_equation_of_motion_is_the_papers_with_every_load(sample, number):
    scene, start = loaded(sample, number), np.array([sample.state])
    inverse, state = (
        InverseDynamics(scene),
        State.of(0, sample.state, (0.0,) * 18, (0.0,) * 3),
    )
    motion = Trajectory(scene, [0.0], start[:, :4], start[:, 4:], [sample.torque])
    mass, bias, gamma_ddot = (
        inverse.mass_matrix(state),
        inverse.bias(state),
        motion.gamma_ddot[0],
    )
    bound = 1e-12 * np.linalg.cond(sample.posture.j) ** 2
    terms = np.abs(mass) @ np.abs(gamma_ddot) + np.abs(bias)
    assert np.abs(mass @ gamma_ddot + bias - sample.torque).max() <= bound * terms.max()

    paper, still, moment = (
        (sample.mechanism, sample.posture),
        np.zeros(3),
        sample.moment,
    )
    inverse = InverseDynamics(sample.scene)
    t1, _ = virtual_work.equation_of_motion(*paper, sample.gamma_dot)
    assert np.abs(inverse.mass_matrix(state) + t1).max() <= bound * np.linalg.norm(t1)
    against = virtual_work.inverse_dynamics(*paper, still, still, moment)
    found = inverse.torque_of_moment(state, moment)
    size = math.hypot(*moment)  # the squares of tiny moments would underflow
    assert np.abs(found + against).max() <= bound * size


@pytest.mark.slow
def test_gamma_ddot_of_a_trajectory_is_the_slope_of_gamma_dot():
    motion = simulate("friction", lambda t: (math.sin(9.0 * t), 2.0 * t, -1.0), 0.5)
    times, h = np.linspace(0.1, 0.4, 7), 1e-4
    before, after = (motion.at(times + step).gamma_dot for step in (-h, h))
    found = motion.at(times).gamma_ddot
    assert (
        np.abs(found - (after - before) / (2.0 * h)).max() <= 1e-4 * np.abs(found).max()
    )


def test_shared_terms_do_not_lengthen_the_forward_program():
    assert ODE(Dynamics.of(load("example1"))).program.operations.total() <= 290


def test_near_a_serial_singularity_a_torque_is_finite_or_refused():
    """Towards t_1 = w_1 = (0, 0, 1), with e_1 = (0, 1, 0): about e_1, then about x to
    90 deg.
    """
    inverse = InverseDynamics(load("example1"))
    said = []
    for off in [*(10.0**-power for power in range(1, 18)), 0.0]:
        turn = Rotation.from_euler("yx", [0.5, 0.5 * math.pi - off])
        q = tuple(turn.as_quat().tolist())
        try:
            assert all(
                map(math.isfinite, inverse.torque(q, (0.1,) * 3, (1.0, 2.0, 3.0)))
            )
            said.append("torque")
        except SingularConfiguration as error:
            assert "serial" in str(error) and 0.0 <= error.measure <= 1e-10
            said.append("refused")
    assert said[0] == "torque" and said[-1] == "refused"
    assert said == sorted(said, reverse=True)


def test_a_parallel_singularity_is_told():
    scene, poses = folding_star()
    assert len(poses)
    for rotation in poses:
        q = tuple(quaternion_of(rotation).tolist())
        with pytest.raises(SingularConfiguration, match="parallel") as told:
            InverseDynamics(scene).torque(q, (0.0,) * 3, (1.0, 2.0, 3.0))
        assert abs(told.value.measure) < 1e-9


@pytest.mark.parametrize(
    ("q", "rate", "acceleration", "named"),
    [
        ((math.nan, 0.0, 0.0, 1.0), (0.0,) * 3, (0.0,) * 3, "finite"),
        ((0.0, 0.0, 0.0, 1.0), (math.inf, 0.0, 0.0), (0.0,) * 3, "finite"),
        ((0.0, 0.0, 0.0, 1.0), (0.0,) * 3, (0.0, 0.0, math.nan), "finite"),
        ((0.0, 0.0, 0.0, 0.0), (0.0,) * 3, (0.0,) * 3, "length > 0"),
    ],
)
def test_what_is_no_state_is_refused(q, rate, acceleration, named):
    with pytest.raises(InputError, match=named):
        InverseDynamics(load("example1")).torque(q, rate, acceleration)


def test_gravity_torque_takes_a_state_angles_or_a_quaternion():
    scene = load("gravity_payload")
    inverse, state = InverseDynamics(scene), Simulation(scene).state
    expected = inverse.torque(state.quaternion, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    assert np.abs(expected).max() > 0.1
    assert (
        inverse.gravity_torque(state)
        == inverse.gravity_torque(state.quaternion)
        == expected
    )
    assert inverse.gravity_torque(state.joints.gamma) == pytest.approx(
        expected, abs=1e-13
    )
    assert inverse.gravity_torque(np.array(state.joints.gamma)) == pytest.approx(
        expected, abs=1e-13
    )
    with pytest.raises(InputError, match="three angles gamma or a quaternion"):
        inverse.gravity_torque((0.1, 0.2))


POSES = np.random.default_rng(5).uniform(-0.12, 0.12, (23, 3)) + 0.785


@pytest.mark.parametrize("name", ["general", "example2_heavy", "gravity_payload"])
@pytest.mark.parametrize("kind", ["angles", "quaternions"])
def test_many_poses_have_the_bits_of_each(name, kind):
    moment = Moment(topic=True) if name == "gravity_payload" else None
    scene = dataclasses.replace(load(name), moment=moment)
    inverse, geometry = InverseDynamics(scene), Geometry.of(scene)
    poses = POSES + (np.array(scene.initial.gamma) - 0.785)
    if kind == "quaternions":
        rotations = [kinematics.admissible(geometry, row).rotation for row in poses]
        poses = quaternion_of(np.array(rotations))
    torques, masses = inverse.gravity_torque(poses), inverse.mass_matrix(poses)
    assert torques.shape == (23, 3)
    assert masses.shape == (23, 3, 3)
    assert (torques == [inverse.gravity_torque(row) for row in poses]).all()
    assert (masses == [inverse.mass_matrix(row) for row in poses]).all()
    assert (inverse.gravity_torque(poses.tolist()) == torques).all()


def test_many_poses_have_the_same_bits_without_llvmlite():
    pytest.importorskip("llvmlite", reason="needs llvmlite: pip install .[fast]")
    compiled = InverseDynamics(load("gravity_payload")).mass_matrix(POSES)
    with without_llvmlite():
        plain = InverseDynamics(load("gravity_payload")).mass_matrix(POSES)
    assert (compiled == plain).all()


def test_many_torques_that_hold_are_slopes_of_the_energy():
    samples_of_poses = seeded_samples(85, 2)
    for sample in samples_of_poses:
        scene = dataclasses.replace(laden(sample), friction=None)
        truth = Lagrange(laden(sample), sample.rotation)
        expected = -np.array(truth.loads(sample.gamma, np.zeros(3)))
        rows = np.tile(sample.quaternion, (3, 1))
        for torque in InverseDynamics(scene).gravity_torque(rows):
            assert np.abs(torque - expected).max() <= 1e-12 * np.abs(expected).max()


def test_no_poses_have_no_torques():
    inverse = InverseDynamics(load("example1"))
    assert inverse.gravity_torque(np.empty((0, 3))).shape == (0, 3)
    assert inverse.mass_matrix(np.empty((0, 4))).shape == (0, 3, 3)


@pytest.mark.parametrize("method", ["gravity_torque", "mass_matrix"])
def test_the_first_pose_of_many_without_a_torque_is_told(method):
    inverse = InverseDynamics(load("example1"))
    compute = getattr(inverse, method)
    for wrong, error, said in (
        ([[0.8, 0.8]], InputError, "rows of three angles gamma or of quaternions"),
        ([[0.8, 0.8, 0.8], [0.8, 0.8]], InputError, "at = "),
        ([[0.8, 0.8, 0.8], [0.8, 0.8, math.nan]], AssemblyError, "three finite"),
        ([["a", "b", "c"]], InputError, "at = "),
        (np.zeros((2, 2, 3)), InputError, "or rows of either"),
        ([[0.8, 0.8, 0.8], [9.0, 9.0, 0.0]], AssemblyError, r"gamma = \[9\. 9\. 0\.\]"),
        ([[0.0, 0.0, 0.0, 0.0]], InputError, "length > 0"),
    ):
        with pytest.raises(error, match=said):
            compute(wrong)
    scene, poses = folding_star()
    quaternion = quaternion_of(poses[0])
    with pytest.raises(SingularConfiguration, match="parallel"):
        getattr(InverseDynamics(scene), method)([quaternion.tolist()] * 2)
