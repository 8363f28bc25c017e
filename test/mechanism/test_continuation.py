# SPDX-License-Identifier: Apache-2.0
"""A branch is followed without jumps, through the edge of the workspace, up to a
singularity.
"""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mechanism.closed_chains import FOLDING, ISOTROPIC, random_geometry, random_pose
from scipy.spatial.transform import Rotation

from sst_ros.errors import AssemblyError, SingularConfiguration
from sst_ros.mechanism import continuation, kinematics


def nearest_gap(geometry, gamma, rotation):
    """Distance to the nearest assembly."""
    found = kinematics.direct(geometry, gamma)
    return min((np.abs(one.rotation - rotation).max() for one in found), default=np.inf)


def beta_and_det_j2(geometry, gamma, rotations):
    r = kinematics.carriage_directions(geometry, gamma)
    return kinematics.describe_assemblies(geometry, r, rotations)[1:3]


def test_a_loop_in_gamma_comes_back_to_the_start():
    x = np.linspace(0, 2 * np.pi, 60)
    gamma = np.pi / 4 + 0.25 * np.stack(
        [np.sin(x), np.sin(2 * x), np.cos(x) - 1], axis=1
    )
    rotations, _ = continuation.follow(ISOTROPIC, gamma)
    np.testing.assert_allclose(rotations[-1], rotations[0], atol=1e-14)
    for row in range(0, 60, 5):
        assert nearest_gap(ISOTROPIC, gamma[row], rotations[row]) < 1e-13
    _, det_j2 = beta_and_det_j2(ISOTROPIC, gamma, rotations)
    assert np.all(det_j2 * det_j2[0] > 0)
    assert not rotations.flags.writeable


def test_the_edge_of_the_workspace_is_no_obstacle():
    """s crosses the plane of P_1's leg: beta_1 goes through 0 and every joint stays
    smooth.
    """
    home = kinematics.admissible(ISOTROPIC, [np.pi / 4] * 3)
    r1 = kinematics.carriage_directions(ISOTROPIC, [np.pi / 4] * 3)[0]
    axis = np.cross(home.rotation[:, 2], r1)
    # the last is exactly on the edge
    share = np.append(np.linspace(0.0, 1.3, 200), 1.0)
    turns = np.multiply.outer(home.beta[0] * share, axis / np.linalg.norm(axis))
    rotations = Rotation.from_rotvec(turns).as_matrix() @ home.rotation
    gamma, _, beta = kinematics.inverse(ISOTROPIC, rotations)
    assert beta[0, 0] > 0 > beta[-2, 0] and abs(beta[-1, 0]) < 1e-15
    followed, sigma = continuation.follow(ISOTROPIC, gamma)
    np.testing.assert_allclose(followed, rotations, atol=1e-13)
    own_beta, _ = beta_and_det_j2(ISOTROPIC, gamma, followed)
    np.testing.assert_allclose(own_beta, beta, atol=1e-12)
    assert sigma.min() > 0.1


def test_a_parallel_singularity_ends_the_branch_and_says_so():
    """Spin about s at fixed s until det J2 = 0: the geometry 210, 75, 75 deg has such
    poses.
    """
    rng = np.random.default_rng(0)
    ended = 0
    for _ in range(40):
        gamma, rotation = random_pose(rng, FOLDING)
        ends = gamma + rng.normal(size=3)
        path = gamma + np.linspace(0, 1, 8)[:, None] * (ends - gamma)
        try:
            rotations, _ = continuation.follow(FOLDING, path, rotation)
        except SingularConfiguration as error:
            ended += 1
            assert isinstance(error, continuation.BranchEnds)
            assert 0 < error.measure <= continuation.LEAST_SIGMA
            # rows of J2 are unit vectors
            assert abs(error.det_j2) <= 1.5 * error.measure
            assert 1 <= error.row < 8
            r = kinematics.carriage_directions(FOLDING, error.gamma)
            assert (
                np.abs(np.sum(r * (FOLDING.e @ error.rotation.T), axis=1)).max()
                <= 1e-14
            )
            # The fold is right there: a little further on the pair of assemblies is
            # gone.
            beyond = error.gamma + 1e-7 * (ends - gamma)
            assert nearest_gap(FOLDING, beyond, error.rotation) > 1e-5
            assert "parallel singularity" in str(error)
        else:
            _, det_j2 = beta_and_det_j2(FOLDING, path, rotations)
            assert np.all(det_j2 * det_j2[0] > 0)
    assert ended >= 4


@pytest.mark.slow
@settings(max_examples=25)
@given(st.integers(0, 2**32 - 1))
def test_coarse_and_fine_sampling_follow_the_same_branch(seed):
    rng = np.random.default_rng(seed)
    geometry = random_geometry(rng)
    gamma, rotation = random_pose(rng, geometry)
    end = gamma + rng.normal(size=3) * 0.5
    fine = gamma + np.linspace(0, 1, 101)[:, None] * (end - gamma)
    try:
        rotations, sigma = continuation.follow(geometry, fine, rotation)
    except continuation.BranchEnds:
        with pytest.raises(continuation.BranchEnds):
            continuation.follow(geometry, [gamma, end], rotation)
        return
    np.testing.assert_allclose(
        continuation.advance(geometry, rotation, gamma, end), rotations[-1], atol=1e-9
    )
    # No jump: R turns by no more than omega = J gamma_dot allows.
    steps = np.linalg.norm(np.diff(rotations, axis=0), axis=(1, 2)) / np.sqrt(2)
    allowed = np.linalg.norm(end - gamma) / 100 / np.minimum(sigma[1:], sigma[:-1])
    assert np.all(steps <= 1.5 * allowed + 1e-12)


def test_what_is_no_assembly_is_refused():
    with pytest.raises(AssemblyError, match="close the loops"):
        continuation.follow(ISOTROPIC, [[0.7, 0.7, 0.7]], np.eye(3))
    with pytest.raises(AssemblyError, match="rows of three"):
        continuation.follow(ISOTROPIC, [0.7, 0.7, 0.7])
