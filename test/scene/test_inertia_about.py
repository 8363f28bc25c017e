# SPDX-License-Identifier: Apache-2.0
"""Inertias about the centre of mass: shifted to O when they are read."""

import numpy as np
import pytest

from sst_ros import Scene, arc_inertia, load_scene, simulate
from sst_ros.errors import InputError
from sst_ros.scene.bodies import Inertia, Link, Payload, Star
from sst_ros.scene.yaml_document import dump, read

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


def test_an_arc_about_its_centre_of_mass_is_the_arc_about_o():
    mass, radius = 0.4, 0.3
    begin, end = np.array([1.0, 0.0, 0.0]), np.array([0.6, 0.8, 0.0])
    about_o = arc_inertia(mass, radius, begin, end)
    half = 0.5 * np.arccos(begin @ end)
    middle = (begin + end) / np.linalg.norm(begin + end)
    centre = radius * np.sin(half) / half * middle
    shift = mass * (centre @ centre * np.eye(3) - np.outer(centre, centre))
    xx, yy, zz, xy, xz, yz = (about_o.matrix - shift)[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]
    own = Inertia(xx=xx, yy=yy, zz=zz, xy=xy, xz=xz, yz=yz)
    link = Link(mass=mass, centre=tuple(centre), inertia=own, inertia_about="centre_of_mass")
    np.testing.assert_allclose(link.inertia.matrix, about_o.matrix, atol=1e-17)


def test_a_document_moves_as_the_one_about_o():
    scene = load_scene("example2")
    values = {
        "star.mass": 0.5,
        "star.centre": [0.02, 0.03, 0.1],
        "gravity.acceleration": [0, 0, -9],
    }
    about_o = scene.with_values(values)
    c = np.array(values["star.centre"])
    own = about_o.star.inertia.matrix - 0.5 * (c @ c * np.eye(3) - np.outer(c, c))
    entries = {"xx": (0, 0), "yy": (1, 1), "zz": (2, 2), "xy": (0, 1), "xz": (0, 2), "yz": (1, 2)}
    about_centre = scene.with_values(
        {
            **values,
            **{f"star.inertia.{name}": own[place] for name, place in entries.items()},
            "star.inertia_about": "centre_of_mass",
        }
    )
    np.testing.assert_allclose(
        simulate(about_centre, duration=0.2).gamma[-1],
        simulate(about_o, duration=0.2).gamma[-1],
        atol=1e-12,
    )
    again = read(Scene, dump(about_centre), "again")
    assert again.star == about_centre.star


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"inertia": Inertia(**OWN)}, "inertia_about = 'centre_of_mass': needs .* mass > 0"),
        ({"mass": 1.0}, "inertia_about = 'centre_of_mass': needs an inertia"),
    ],
)
def test_it_needs_a_mass_and_an_inertia(given, said):
    with pytest.raises(InputError, match=said):
        Link(inertia_about="centre_of_mass", **given)


def test_other_points_are_refused():
    with pytest.raises(InputError, match="inertia_about = 'E': must be one of O, centre_of_mass"):
        Link(inertia_about="E")
