# SPDX-License-Identifier: Apache-2.0
"""Inertia of thin arcs against sums over their points."""

import numpy as np
import pytest

from sst_ros.errors import InputError
from sst_ros.scene.bodies import arc_inertia


@pytest.mark.parametrize(
    ("begin", "end"),
    [([1, 0, 0], [0, 2, 0]), ([1, 0.2, 0.1], [-0.5, 0.3, 1]), ([1, 0, 0], [-1, 0.1, 0])],
)
def test_an_arc_is_the_sum_of_its_points(begin, end):
    u, v = np.array(begin) / np.linalg.norm(begin), np.array(end) / np.linalg.norm(end)
    angle = np.arccos(u @ v)
    x, w = np.polynomial.legendre.leggauss(40)
    s = 0.5 * (x + 1.0)[:, None]
    points = 0.4 * (np.sin((1 - s) * angle) * u + np.sin(s * angle) * v) / np.sin(angle)
    masses = 2.6 * 0.5 * w
    wanted = np.einsum("n,nij->ij", masses, np.einsum("n,ij->nij", (points**2).sum(1), np.eye(3)))
    wanted -= np.einsum("n,ni,nj->ij", masses, points, points)
    np.testing.assert_allclose(arc_inertia(2.6, 0.4, begin, end).matrix, wanted, atol=1e-15)


def test_three_arcs_are_the_star_of_example_2():
    """Three thin 90 degree arcs from E downwards, 2.6 kg in all, radius 0.4 m, times 1.25."""
    parts = []
    for angle in np.radians([0, 120, 240]):
        end = [np.cos(angle), np.sin(angle), 0.0]
        parts.append(arc_inertia(2.6 / 3, 0.4, [0, 0, 1], end).matrix)
    np.testing.assert_allclose(1.25 * sum(parts), np.diag([0.39, 0.39, 0.26]), atol=1e-12)


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ((0.0, 0.4, [1, 0, 0], [0, 1, 0]), "mass"),
        ((1.0, -0.4, [1, 0, 0], [0, 1, 0]), "radius"),
        ((1.0, 0.4, [1, 0, 0], [-2, 0, 0]), "opposite"),
        ((1.0, 0.4, [1, 0], [0, 1]), "two directions"),
    ],
)
def test_what_is_no_arc_is_refused(arguments, said):
    with pytest.raises(InputError, match=said):
        arc_inertia(*arguments)
