# SPDX-License-Identifier: Apache-2.0
"""The gates of the peers benchmark: who may be compared, on what, against which truth.

Engines that are not installed are skipped; nothing is timed here.
"""

import importlib
import json
import shutil

import numpy as np
import pytest
from docs.blocks import ROOT

from benchmark.peers.task import Task, find_relative, turn_between


def peer(name):
    """Import a module that may need numba or Matplotlib."""
    return importlib.import_module(f"benchmark.peers.{name}")


@pytest.fixture(autouse=True)
def without_loop_in_cpp(request, monkeypatch):
    """It takes minutes to compile."""
    if request.node.get_closest_marker("slow") is None:
        monkeypatch.setattr(peer("pinocchio_peer"), "compile_loop", lambda: None)


@pytest.fixture(scope="module")
def task():
    return Task()


def test_kernel_and_paper_agree_where_engines_are_gated(task):
    for at in task.moving:
        assert np.linalg.norm(list(at.velocity.values())) > 0.5
        assert find_relative(task.kernel_answer(at.y, at.torque), at.answer) < 1e-12


def test_reference_and_lagrange_solve_the_same_equations(task):
    from benchmark.peers.independent import check_reference

    assert check_reference(task, 5).acceleration < 1e-13


@pytest.mark.slow
def test_gate_of_the_loop_in_cpp(task):
    pytest.importorskip("pinocchio")
    if shutil.which("g++") is None:
        pytest.skip("no C++ compiler")
    compiled = peer("pinocchio_peer").series(task, quick=True)[2:]
    assert [series.name for series in compiled] == [
        "RK4 in a C++ loop",
        "DOP853 in a C++ loop",
    ]
    for series in compiled:
        assert series.gate(task) <= series.tolerance, series.name


@pytest.mark.parametrize("module", ["casadi", "mujoco", "pinocchio", "scipy"])
def test_gate(task, module):
    pytest.importorskip(module)
    for series in peer(f"{module}_peer").series(task, quick=True):
        assert series.gate(task) <= series.tolerance, series.name


def test_gate_sees_a_wrong_inertia(task):
    """One inertia wrong by 1e-3 must not get through."""
    pytest.importorskip("pinocchio")
    wrong = Task()
    wrong.tensors["i2"] = 1.001 * wrong.tensors["i2"]
    series = peer("pinocchio_peer").series(wrong, quick=True)[0]
    assert series.gate(task) > series.tolerance


@pytest.mark.slow
def test_our_headline_is_the_public_call(task):
    """Every setting ends within its tolerance of the finest one, and no other series
    counts.
    """
    pytest.importorskip("llvmlite")
    ours = peer("ours")
    first, *others = ours.series(task, quick=True)
    assert first.name.startswith(ours.PUBLIC)
    assert not any(series.name.startswith(ours.PUBLIC) for series in others)
    ends = [
        (engine := setting.make()).pose(engine.run()).rotation
        for setting in first.settings
    ]
    for setting, end in zip(first.settings, ends, strict=True):
        tolerance = float(setting.label.split()[1])
        assert turn_between(end, ends[-1]) <= tolerance + 1e-13


def test_the_table_has_times_and_their_ratio_to_ours():
    study, results = peer("study"), peer("results")
    truth, floor = study.Reference(None, 0.0, ""), peer("floor").Floor({}, None)
    rows = []
    ours = peer("ours")
    names = {
        (ours.ENGINE, ours.PUBLIC): 1e-5,
        (peer("scipy_peer").ENGINE, "DOP853"): 1e-3,
    }
    for (engine, name), seconds in names.items():
        series = study.Series(engine, name, "nowhere", 1e-12, None)
        point = study.Point(
            study.Setting("one", 0, None), 1e-12, 1e-12, seconds=[seconds] * 3
        )
        rows.append(study.Curve(series, 0.0, [point]))
    found = results.Results(rows, {}, truth, 3, True, 1.0, floor).tables()["series"]
    ours, other = found.to_numpy().tolist()
    assert set(ours[4:]) == {"0.01 (1 x)"} and set(other[4:]) == {"1 (100 x)"}


def test_the_readme_has_the_table_of_the_published_results():
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    results = json.loads((ROOT / "docs" / "peers.json").read_text(encoding="utf-8"))
    filled = peer("results").fill_readme(text, results)
    assert filled == text, "run python -m benchmark.peers.results"
    page = (ROOT / "docs" / "peers.md").read_text(encoding="utf-8")
    assert results["machine"]["date"] in page
    for row in results["reached"]:
        if row["method"] == "best of all" and row["ms"] is not None:
            assert f"{row['ms']:.3g}" in page


def test_the_picture_shows_the_best_settings(tmp_path):
    pytest.importorskip("matplotlib")
    pandas = pytest.importorskip("pandas")
    results = peer("results")
    rows = pandas.DataFrame(
        {"median_ms": [2.0, 1.0, 3.0], "error_at_end_rad": [1.0, 3.0, 2.0]}
    )
    assert results.find_front(rows) == ([1.0, 2.0], [3.0, 1.0])
    for name in ("peers.csv", "peers.json"):
        shutil.copy(ROOT / "docs" / name, tmp_path)
    results.draw(tmp_path)
    assert (tmp_path / "peers.png").stat().st_size > 30_000
