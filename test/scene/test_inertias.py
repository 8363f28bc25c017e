# SPDX-License-Identifier: Apache-2.0
"""Inertias: of thin arcs against sums over their points.

About the centre of mass, shifted to O.
"""

from dataclasses import asdict

import numpy as np
import pytest
from models import inertia_of

from sst_ros.errors import InputError
from sst_ros.scene.bodies import Inertia, Link, Payload, Star, arc_inertia
from sst_ros.scene.scene import Scene, load
from sst_ros.scene.yaml_document import dump, read


@pytest.mark.parametrize(
    ("begin", "end"),
    [
        ([1, 0, 0], [0, 2, 0]),
        ([1, 0.2, 0.1], [-0.5, 0.3, 1]),
        ([1, 0, 0], [-1, 0.1, 0]),
    ],
)
def test_an_arc_is_the_sum_of_its_points(begin, end):
    u, v = np.array(begin) / np.linalg.norm(begin), np.array(end) / np.linalg.norm(end)
    angle = np.arccos(u @ v)
    x, w = np.polynomial.legendre.leggauss(40)
    s = 0.5 * (x + 1.0)[:, None]
    points = 0.4 * (np.sin((1 - s) * angle) * u + np.sin(s * angle) * v) / np.sin(angle)
    masses = 2.6 * 0.5 * w
    wanted = np.einsum(
        "n,nij->ij", masses, np.einsum("n,ij->nij", (points**2).sum(1), np.eye(3))
    )
    wanted -= np.einsum("n,ni,nj->ij", masses, points, points)
    np.testing.assert_allclose(
        arc_inertia(2.6, 0.4, begin, end).matrix, wanted, atol=1e-15
    )


def test_three_arcs_are_the_star_of_example_2():
    """Three thin 90 degree arcs from E downwards, 2.6 kg in all, radius 0.4 m, times
    1.25.
    """
    parts = []
    for angle in np.radians([0, 120, 240]):
        end = [np.cos(angle), np.sin(angle), 0.0]
        parts.append(arc_inertia(2.6 / 3, 0.4, [0, 0, 1], end).matrix)
    np.testing.assert_allclose(
        1.25 * sum(parts), np.diag([0.39, 0.39, 0.26]), atol=1e-12
    )


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


MASS, CENTRE = 0.7, (0.1, -0.05, 0.2)
OWN = {"xx": 0.02, "yy": 0.03, "zz": 0.04, "xy": 1e-3, "xz": -2e-3, "yz": 5e-4}
ABOUT = {"mass": MASS, "centre": CENTRE, "inertia_about": "centre_of_mass"}
STAR = {"alpha_deg": (120.0,) * 3, "radius": 0.3}


@pytest.mark.parametrize("build", [lambda **given: Star(**STAR, **given), Link])
def test_the_shift_is_that_of_the_payload(build):
    body = build(inertia=Inertia(**OWN), **ABOUT)
    payload = Payload(mass=MASS, centre=CENTRE, inertia=Inertia(**OWN))
    assert body.inertia.matrix.tolist() == payload.about_o.tolist()
    assert body.inertia_about == "O"


def test_a_document_about_the_centre_of_mass_is_that_about_o():
    values = {
        "star.mass": 0.5,
        "star.centre": [0.02, 0.03, 0.1],
        "gravity.acceleration": [0, 0, -9],
    }
    about_o = load("example2").with_values(values)
    c = np.array(about_o.star.centre)
    own = about_o.star.inertia.matrix - 0.5 * (c @ c * np.eye(3) - np.outer(c, c))
    document = {
        "star.inertia": asdict(inertia_of(own)),
        "star.inertia_about": "centre_of_mass",
    }
    found = about_o.with_values(document)
    np.testing.assert_allclose(found.star.tensor, about_o.star.tensor, rtol=1e-15)
    assert read(Scene, dump(found), "again").star == found.star


@pytest.mark.parametrize(
    ("given", "said"),
    [
        (
            {"inertia": Inertia(**OWN), "inertia_about": "centre_of_mass"},
            "needs .* mass > 0",
        ),
        ({"mass": 1.0, "inertia_about": "centre_of_mass"}, "needs an inertia"),
        ({"inertia_about": "E"}, "must be one of O, centre_of_mass"),
    ],
)
def test_a_point_that_is_not_known_or_needs_more_is_refused(given, said):
    about = given["inertia_about"]
    with pytest.raises(InputError, match=f"inertia_about = '{about}': {said}"):
        Link(**given)
