# SPDX-License-Identifier: Apache-2.0
"""Stability of one scene: steps, runs with other numbers, what is said of them."""

import dataclasses
import json
import math

import numpy as np
import pytest
from matplotlib import image
from missing_packages import needs
from slow_cases import slow_after

from sst_ros import __main__ as cli
from sst_ros.integration.methods import METHODS
from sst_ros.mechanism import kinematics, workspace
from sst_ros.mechanism.geometry import Geometry, rotation_matrix
from sst_ros.report import stability
from sst_ros.report.stability import (
    CHANGED_RUNS,
    draw_stability,
    examine_stability,
    stability_page,
)
from sst_ros.scene.scene import Scene, load
from sst_ros.simulation.simulate import simulate

EXAMPLE2 = dataclasses.replace(load("example2_stroke"), duration=0.2)
FEW = ("as-it-is", "stroke", "singularity")


@pytest.fixture(scope="module")
def found():
    return examine_stability(EXAMPLE2, FEW)


def changed(name, scene=EXAMPLE2):
    return CHANGED_RUNS[name][1](scene, simulate(scene, duration=0.02))


def test_each_run_ends_within_its_estimate_or_with_a_named_fault(found):
    assert found.runs.name.tolist() == list(FEW) and found.passed
    whole, stroke, singular = found.runs.itertuples()
    assert (
        whole.result == "reached the end" and 0.0 < whole.error <= 10.0 * whole.estimate
    )
    assert stroke.result.startswith("stopped at t = 0.0000")
    # which lies beyond the stroke
    assert singular.passed and "initial.gamma" in singular.result


def careless(tolerance):
    return {"tolerance": max(tolerance, 1e-2 * (tolerance > 1e-10))}, tolerance


def unsure(tolerance):
    return {"tolerance": tolerance}, math.nan


@pytest.mark.parametrize(
    ("kind", "only", "passes"),
    slow_after(
        1,
        [
            (careless, "as-it-is", False),
            (unsure, "as-it-is", False),
            (unsure, "stroke", True),
        ],
    ),
)
def test_a_run_that_is_wrong_or_unsure_of_itself_fails(monkeypatch, kind, only, passes):
    """A run that ends where it starts has no estimate and needs none."""
    honest = stability.simulate

    def simulate(scene, tolerance, **options):
        given, estimate = kind(tolerance)
        motion = honest(scene, **given, **options)
        motion.run = dataclasses.replace(motion.run, error_estimate=estimate)
        return motion

    monkeypatch.setattr(stability, "simulate", simulate)
    report = examine_stability(
        dataclasses.replace(load("example2_stroke"), duration=0.5), [only]
    )
    assert report.runs.passed.tolist() == [report.passed] == [passes]
    assert ("| **FAILED** |" in stability_page(report)) is not passes
    assert f"1 runs, {0 if passes else 1} failed" in stability_page(report)


def test_the_numbers_are_10_and_100_times_those_of_the_scene():
    torque = EXAMPLE2.torque.amplitude
    assert changed("torque").torque.amplitude == tuple(10.0 * each for each in torque)
    moving = dataclasses.replace(EXAMPLE2.initial, gamma_dot=(0.1, 0.2, -0.3))
    faster = changed("rates", dataclasses.replace(EXAMPLE2, initial=moving))
    assert faster.initial.gamma_dot == pytest.approx((1.0, 2.0, -3.0))
    hung, rough = load("gravity_payload"), load("friction")
    for before, after in zip(
        hung.springs, changed("stiffness", hung).springs, strict=True
    ):
        assert after.stiffness == 100.0 * before.stiffness
    bouncing = load("elastic_stops")
    assert (
        changed("stiffness", bouncing).stroke.stiffness
        == 100.0 * bouncing.stroke.stiffness
    )
    after = changed("friction", rough).friction
    assert after.gamma.coulomb == 100.0 * rough.friction.gamma.coulomb
    assert after.beta.viscous == 100.0 * rough.friction.beta.viscous
    assert after.beta.smoothing == rough.friction.beta.smoothing
    assert changed("stiffness") == "the scene has no springs and no elastic stops"
    assert changed("friction") == "the scene has no friction"


def measures_at_start(scene):
    geometry = Geometry.of(scene)
    rotation = rotation_matrix(np.array(scene.initial.orientation))
    gamma, _, _ = kinematics.inverse(geometry, rotation)
    return workspace.measures(geometry, gamma, rotation)


@pytest.mark.parametrize("kind", slow_after(1, ["stroke", "edge", "reach"]))
def test_a_run_at_a_limit_starts_there_and_goes_into_it(kind):
    scene = changed(kind)
    assert isinstance(scene, Scene)
    assert 0.0 <= getattr(measures_at_start(scene), kind) < 1e-9
    report = examine_stability(EXAMPLE2, [kind])
    assert report.passed and report.runs.result[0].startswith("stopped at t = 0.0000")


def test_a_run_beside_a_singularity_starts_beside_it():
    measured = measures_at_start(changed("singularity"))
    assert min(abs(measured.det_j1), abs(measured.det_j2)) < 2e-3


@pytest.mark.slow
def test_the_steps_are_those_of_the_eigenvalues(found):
    assert len(found.steps) == 50 and found.steps.t_s.iloc[-1] == EXAMPLE2.duration
    assert (found.steps.rodas5p == math.inf).all()
    stiff = examine_stability(
        dataclasses.replace(load("stiff"), duration=0.01), ["as-it-is"]
    )
    for name, reach in (("rk4", 2.785), ("dopri5", 3.307)):
        assert (stiff.steps[name] * stiff.steps.decay).to_numpy() == pytest.approx(
            reach, rel=3e-3
        )
    assert "rodas5p: every step is stable." in stability_page(stiff)


def test_the_figure_and_the_page_show_every_method_and_run(found):
    said = stability_page(found)
    assert all(f"- {name}: " in said for name in METHODS)
    assert all(f"| {name} | {CHANGED_RUNS[name][0]} | yes |" in said for name in FEW)
    lines = {
        line.get_label() for axes in draw_stability(found).axes for line in axes.lines
    }
    assert {"rk4", "dopri5", "dop853", "rodas5p: every step", "decay"} <= lines


@pytest.mark.slow
@needs("zstandard", "rosbags")
def test_the_command_tells_its_time_and_writes_its_files(tmp_path, capsys):
    words = [
        "report",
        "stability",
        "example1",
        "--only",
        "as-it-is",
        "friction",
        "--out",
    ]
    assert cli.main([*words, str(tmp_path / "out")]) == 0
    said = capsys.readouterr().out
    assert said.startswith("2 runs of 0.523599 s, each at two tolerances: about ")
    made = {path.name for path in (tmp_path / "out").iterdir()}
    assert made == {f"stability.{kind}" for kind in ("csv", "json", "md", "png")}
    document = json.loads((tmp_path / "out" / "stability.json").read_text())
    assert [run["passed"] for run in document["runs"]] == [True, None]
    assert len(document["steps"]) == 50 and document["steps"][0]["rodas5p"] is None
    pixels = image.imread(tmp_path / "out" / "stability.png")
    assert (np.ptp(pixels[:, :, :3], axis=2) > 0.2).sum() > 1000
    out = str(tmp_path / "nothing to draw below")
    assert cli.main([*words[:3], "--only", "friction", "--out", out]) == 0
    capsys.readouterr()
    assert cli.main([*words[:3], "--only", "frictio"]) == 1
    said = capsys.readouterr().err
    assert "--only = 'frictio': must be one of as-it-is" in said
    assert "did you mean 'friction'?" in said
