# SPDX-License-Identifier: Apache-2.0
"""`scene check` warns of inertias that no body of the mass and radius given can have."""

import pytest

from sst_ros.__main__ import main
from sst_ros.cli.runs import implausible
from sst_ros.scene.scene import load, names
from sst_ros.scene.yaml_document import dump


@pytest.mark.parametrize("name", names())
def test_a_shipped_mass_fits_its_inertia(name):
    assert implausible(load(name)) == []


def test_a_star_too_heavy_for_its_mass_is_warned_of(tmp_path, capsys):
    """1.25 times thin arcs of 2.6 kg: the trace is 1.04 kg m^2, 2 m r^2 for 3.25 kg."""
    scene = load("example2_heavy")
    assert implausible(scene) == []  # without a mass
    assert implausible(scene.with_values({"star.mass": 3.25})) == []
    path = tmp_path / "heavy.yaml"
    path.write_text(dump(scene.with_values({"star.mass": 2.6})), encoding="utf-8")
    assert main(["scene", "check", str(path)]) == 0
    valid, warning = capsys.readouterr().out.splitlines()
    assert valid == f"{path}: valid, with warnings"
    assert warning == (
        f"{path}: warning: star.inertia: its trace is 1.04 kg m^2; a body of star.mass = 2.6 kg "
        "within star.radius = 0.4 m has at most 2 m r^2 = 0.832 kg m^2"
    )


def test_thin_arcs_are_at_the_bound():
    assert implausible(load("example2").with_values({"star.mass": 2.6})) == []
    assert implausible(load("example2").with_values({"star.mass": 2.59})) != []
