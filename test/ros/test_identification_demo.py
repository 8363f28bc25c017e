# SPDX-License-Identifier: Apache-2.0
"""Record with a wrong model, identify, follow with the identified one: by the nodes."""

import re

import pytest

from sst_ros import load_scene
from studies.identification import identification

pytestmark = [pytest.mark.ros, pytest.mark.slow, pytest.mark.timeout(600)]


def test_the_identified_model_tracks_twenty_times_better(tmp_path, domain_of_module):
    assert identification(tmp_path)
    text = (tmp_path / "identification.txt").read_text(encoding="utf-8")
    ratio = float(re.search(r"^ratio +([\d.]+)$", text, re.M)[1])
    assert ratio > 20.0
    plant, found = (load_scene(tmp_path / f"{name}.yaml") for name in ("plant", "identified"))
    for kind in ("gamma", "beta"):
        expected = getattr(plant.friction, kind).viscous
        assert getattr(found.friction, kind).viscous == pytest.approx(expected, rel=0.1)
    assert found.star.inertia.zz == pytest.approx(plant.star.inertia.zz, rel=0.05)
    assert (tmp_path / "identification.png").stat().st_size > 10_000
