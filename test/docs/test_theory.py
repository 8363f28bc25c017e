# SPDX-License-Identifier: Apache-2.0
"""What docs/theory.md says of the paper's print."""

from pathlib import Path

import numpy as np
import pytest
from mechanism.test_paper_equations import Paper, legs
from models import seeded_samples

from sst_ros.mechanism import kinematics
from sst_ros.mechanism.geometry import Geometry
from sst_ros.scene.scene import load

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "theory.md").read_text(encoding="utf-8")
ISOTROPIC = Geometry.build(np.eye(3), np.radians([120.0, 120.0, 120.0]))
HOME = np.full(3, np.pi / 4)


PRINTED = {
    "Eq. 31 ends in t": legs(lambda p, k: k.N @ k.td - k.t @ p.omega),
    "signs of Eq. 33": legs(
        lambda p, k: (
            k.c * k.gdd
            - k.N @ p.omegad
            - k.gd * k.mud * k.tw
            + k.betad * (k.r @ p.omega)
        )
    ),
}
"""The forms that hold are in test/mechanism/test_paper_equations.py."""


@pytest.fixture(scope="module")
def general():
    return Paper(*seeded_samples(1, 1))


@pytest.mark.parametrize("name", PRINTED)
def test_the_printed_form_does_not_hold(name, general):
    assert max(abs(PRINTED[name](general))) > 0.1


def test_the_quotient_of_eq_2_breaks_where_the_star_does_not():
    # E on the side P1 P2, where R_1 is too: beta_1 = 0.
    s = np.array([1.0, 1.0, 0.0]) / np.sqrt(2.0)
    rotation = np.stack(
        [np.cross([0.0, 0.0, 1.0], s), np.array([0.0, 0.0, 1.0]), s], axis=1
    )
    r = kinematics.carriage_directions(ISOTROPIC, HOME)[0]
    assert np.linalg.norm(np.cross(s, r)) < 1e-15
    np.testing.assert_allclose(
        np.linalg.norm(ISOTROPIC.e @ rotation.T, axis=1), 1.0, atol=1e-15
    )


def test_the_other_sense_of_the_star_has_no_admissible_assembly():
    def admissible(geometry):
        return [a for a in kinematics.direct(geometry, HOME) if a.admissible]

    assert len(admissible(ISOTROPIC)) == 1
    arrays = {
        name: getattr(ISOTROPIC, name)
        for name in ("v", "w", "alpha", "arc", "beta_max")
    }
    other = Geometry(e=ISOTROPIC.e * [-1.0, 1.0, 1.0], **arrays)
    turn = np.arctan2(np.cross(other.e[0], other.e[1])[2], other.e[0] @ other.e[1])
    assert turn == pytest.approx(-np.radians(120.0))
    assert admissible(other) == []


def test_the_assumed_inertias_are_those_of_the_scenes():
    star, thin = load("example2_heavy").star.inertia, load("example2").star.inertia
    assert f"diag({thin.xx:g}, {thin.yy:g}, {thin.zz:g})" in PAGE
    assert thin == load("example1").star.inertia == load("example2_stroke").star.inertia
    assert star.xx / thin.xx == pytest.approx(1.25)
    link = load("example2").intermediate_links[0].inertia
    assert (
        f"diag({link.xx:.0e}, {link.yy:g}, {link.zz:g})".replace("e-06", "e-6") in PAGE
    )
    assert f"{load('example1').initial.gamma_dot[0]!r}" in PAGE
