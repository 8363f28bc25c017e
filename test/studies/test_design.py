# SPDX-License-Identifier: Apache-2.0
"""The design study against random orientations, random parts, and a brute search of the
front.
"""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sst_ros.mechanism import kinematics, workspace
from sst_ros.mechanism.geometry import Geometry
from studies.design import (
    ENCODER_ERROR,
    PART_ERROR,
    Design,
    evaluate,
    find_front,
    isotropy,
    orientation_error,
)

DESIGN = Design(85.0, 95.0, 80.0, 110.0, 130.0, 1.2)


@pytest.mark.slow
def test_the_workspace_is_the_share_of_random_orientations():
    geometry, found = Geometry.of(DESIGN.scene()), evaluate(DESIGN)
    rotation = Rotation.random(
        200_000, random_state=np.random.default_rng(3)
    ).as_matrix()
    gamma = kinematics.inverse(geometry, rotation)[0]
    measured = workspace.measures(geometry, gamma, rotation)
    share = 100.0 * measured.admissible.mean()
    assert found.workspace == pytest.approx(share, rel=0.05)
    index = (1.0 / measured.cond_j[measured.admissible]).mean()
    assert found.conditioning == pytest.approx(index, rel=0.03)


@pytest.mark.slow
def test_the_error_is_that_of_random_parts():
    """Assemblies of 2,000 manipulators with errors of all places, at the same measured
    angles.
    """
    scene = DESIGN.scene()
    geometry, gamma = Geometry.of(scene), np.add(scene.initial.gamma, [0.1, -0.1, 0.05])
    rotation = kinematics.admissible(geometry, gamma).rotation
    rng, turns = np.random.default_rng(4), []
    for _ in range(2000):
        v = geometry.v + PART_ERROR / (0.35 * 1.2) * rng.normal(size=(3, 3))
        alpha = geometry.alpha + PART_ERROR / (0.4 * 1.2) * np.append(
            rng.normal(size=2), 0.0
        )
        made = Geometry.build(v, alpha)
        angles = gamma + ENCODER_ERROR * rng.normal(size=3)
        turned = kinematics.admissible(made, angles).rotation
        turns.append(Rotation.from_matrix(rotation.T @ turned).as_rotvec())
    expected = np.sqrt(np.mean(np.sum(np.square(turns), axis=1)))
    assert orientation_error(DESIGN, geometry, rotation[None])[0] == pytest.approx(
        expected, rel=0.06
    )


def test_the_front_is_what_nothing_betters():
    costs = np.array([[1.0, 2.0], [2.0, 1.0], [2.0, 2.0], [1.0, 2.0], [0.5, 3.0]])
    assert find_front(costs).tolist() == [True, True, False, True, True]


def test_the_isotropic_design_has_the_index_one():
    found = dict(isotropy())
    assert found[90.0] == pytest.approx(1.0, abs=1e-12)
    assert max(index for arc, index in found.items() if arc != 90.0) < 0.9
