# SPDX-License-Identifier: Apache-2.0
"""The command `identify`: a recording to a scene, a scene to a motion, and refusals."""

from dataclasses import replace

import pytest
from bags import simulated

from sst_ros import load_scene
from sst_ros.cli.commands import run_command
from sst_ros.scene.loads import Actuators
from sst_ros.scene.yaml_document import dump


def test_a_recording_becomes_a_scene(written, example2, tmp_path, capsys):
    bag = written(example2)
    out = tmp_path / "identified.yaml"
    words = ["identify", str(bag), "--parameters", "star", "--out", str(out)]
    assert run_command(words) == 0
    printed = capsys.readouterr().out
    assert "star.inertia.zz" in printed and f"wrote {out}" in printed
    found, given = load_scene(out), load_scene("example2")
    for part in ("xx", "yy", "zz"):
        expected = getattr(given.star.inertia, part)
        assert getattr(found.star.inertia, part) == pytest.approx(expected, rel=1e-3)
    assert dict(found.provenance)["star"].startswith("identified")
    assert run_command(words) == 1
    assert "exists already" in capsys.readouterr().err


@pytest.mark.parametrize(
    "actuators", [pytest.param(None, marks=pytest.mark.slow), Actuators(time_constant=0.02)]
)
def test_a_recording_is_fitted_by_simulation(written, tmp_path, capsys, actuators):
    recorded = replace(load_scene("example2"), actuators=actuators)
    guess = tmp_path / "guess.yaml"
    changed = recorded.with_values({"star.inertia.zz": 0.25})
    guess.write_text(dump(changed), encoding="utf-8")
    bag = written(simulated(recorded, 0.3))
    words = ["identify", str(bag), "--scene", str(guess), "--method", "simulation"]
    out = tmp_path / "identified.yaml"
    assert run_command([*words, "--parameters", "star.inertia.zz", "--out", str(out)]) == 0
    assert "known to" in capsys.readouterr().out
    expected = recorded.star.inertia.zz
    assert load_scene(out).star.inertia.zz == pytest.approx(expected, rel=1e-8)
    assert run_command(words) == 1
    assert "must be keys of numbers of the scene" in capsys.readouterr().err
    assert run_command([*words, "--parameters", "star.inertia.zz", "--cutoff", "3"]) == 1
    assert "takes no cutoff" in capsys.readouterr().err


def test_a_scene_becomes_a_motion(tmp_path, capsys):
    out = tmp_path / "exciting.yaml"
    words = ["identify", "design", "example2", "--duration", "1", "--harmonics", "3"]
    assert run_command([*words, "--parameters", "star", "--out", str(out)]) == 0
    assert "condition number" in capsys.readouterr().out
    assert load_scene(out).motion.kind == "waypoints"


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["design"], "must be given after design"),
        (["bag", "reach"], "only there"),
        (["design", "reach", "--cutoff", "3"], "is no option of identify design"),
        (["design", "reach", "--method", "simulation"], "is no option of identify design"),
        (["bag", "--seed", "3"], "is no option of identify BAG"),
        (["nowhere"], "nowhere"),
    ],
)
def test_what_does_not_fit_is_refused(words, message, capsys):
    assert run_command(["identify", *words]) == 1
    assert message in capsys.readouterr().err
