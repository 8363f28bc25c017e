# SPDX-License-Identifier: Apache-2.0
"""The study of accuracy: it tells the truth about the methods, and it catches lies."""

import csv
import dataclasses
import io
import itertools
import json

import numpy as np
import pytest
from matplotlib import image

from sst_ros.errors import InputError
from sst_ros.figures import save_figure
from sst_ros.integration.methods import METHODS
from sst_ros.integration.steps import explicit_step
from sst_ros.programs.expression import compile_program
from sst_ros.report import accuracy
from sst_ros.report.accuracy import (
    ABOVE_REFERENCE,
    ERROR_COLUMN,
    ERROR_TARGETS,
    FIXED,
    STUDY_COLUMNS,
    TOLERANCE_KIND,
    accuracy_page,
    accuracy_text,
    draw_accuracy,
    name_fastest,
    study_scene,
    write_accuracy_report,
)
from sst_ros.report.reference_solution import (
    EXACT_DOP853 as EXACT_STEP,
)
from sst_ros.report.reference_solution import (
    InitialValueProblem,
    run_extended,
    solve_reference,
)
from sst_ros.report.results import data_frame
from sst_ros.scene import scene
from sst_ros.scene.bodies import Inertia

SHORT = dataclasses.replace(scene.load("example2_heavy"), duration=0.2)
BRIEF = dataclasses.replace(SHORT, duration=0.1)
EXACT = np.finfo(np.longdouble).eps < 1e-18


def study_quickly(studied, longest_s):
    """Study a scene, with no finer settings after a run that took longer."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(accuracy, "LONGEST_RUN_S", longest_s)
        return study_scene(studied)


@pytest.fixture(scope="module")
def short():
    """Study of 0.2 s of Example 2."""
    return study_quickly(SHORT, 0.02)


def _rows(found, method, kind=FIXED):
    rows = found.rows
    return list(rows[(rows.method == method) & (rows.kind == kind)].itertuples())


@pytest.mark.slow
@pytest.mark.skipif(not EXACT, reason="long doubles are doubles here")
def test_the_reference_is_mpmaths_and_better_than_doubles(short):
    """At the same steps, so that only the arithmetic differs."""
    assert short.reference.own.orientation < 1e-16
    assert short.floor == ABOVE_REFERENCE * short.reference.own.orientation
    problem, library = (
        InitialValueProblem(SHORT),
        pytest.importorskip("mpmath").mp.clone(),
    )
    library.dps = 30
    names = ("sqrt", "sin", "cos", "atan2")
    slope = compile_program(
        problem.system.program, {name: getattr(library, name) for name in names}
    )
    y, h = [library.mpf(x) for x in problem.start], library.mpf(problem.interval) / 2
    for k in range(4):
        step = explicit_step(
            lambda t, y, _: slope(t, *y, *problem.drive),
            EXACT_STEP,
            k * h,
            h,
            y,
            [None] * 12,
        )
        new_y = step.state
        length = library.sqrt(sum(x * x for x in new_y[:4]))
        y = [*(x / length for x in new_y[:4]), *new_y[4:]]
    theirs = [np.longdouble(str(x)) for x in y]  # as text: with all digits
    assert np.abs(run_extended(problem, 2)[2] - theirs).max() < 1e-17


@pytest.mark.slow
def test_methods_show_their_order(short):
    for method, order in (("rk4", 4), ("dopri5", 5), ("dop853", 8), ("rodas5p", 5)):
        rows = [
            row
            for row in _rows(short, method)
            if 1e-12 < row.final_orientation_rad < 1e-4
        ]
        assert len(rows) > 1 or method == "dop853"
        slopes = [
            np.log(a.final_orientation_rad / b.final_orientation_rad)
            / np.log(a.setting / b.setting)
            for a, b in itertools.pairwise(rows)
        ]
        assert not slopes or max(slopes) == pytest.approx(order, abs=1.0), method


def test_every_row_is_whole(short):
    rows = short.rows
    assert set(rows.kind) == {FIXED, TOLERANCE_KIND} and not _rows(
        short, "rk4", TOLERANCE_KIND
    )
    assert set(rows.method) == set(METHODS) - {"auto"}
    assert (rows.failure == "").all()
    assert (rows.wall_min_s > 0.0).all() and rows.evaluations.min() > 0
    assert (rows.final_orientation_rad <= rows[ERROR_COLUMN]).all()
    assert short.best(1e-9)[ERROR_COLUMN] <= 1e-9


def test_what_it_writes_can_be_read(short, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(accuracy, "study_scene", lambda scene, visible: short)
    assert write_accuracy_report(["example2_heavy"], tmp_path) == [short]
    said, words = capsys.readouterr().out, name_fastest(short)
    assert words in said and words.startswith("1e-09 rad over 0.2 s: ")
    assert all(len(line) < 200 for line in said.splitlines())
    rows = list(csv.DictReader(io.StringIO((tmp_path / "accuracy.csv").read_text())))
    assert len(rows) == len(short.rows) and tuple(rows[0]) == STUDY_COLUMNS
    assert [float(row["wall_min_s"]) for row in rows] == short.rows.wall_min_s.tolist()
    read = json.loads((tmp_path / "accuracy.json").read_text())
    assert read["rows"][0]["method"] == "rk4" and "date" in read["report"]
    assert "accuracy_example2_heavy.png" in (tmp_path / "accuracy.md").read_text()
    pixels = image.imread(tmp_path / "accuracy_example2_heavy.png")
    assert (np.ptp(pixels[:, :, :3], axis=2) > 0.2).sum() > 2000


@pytest.mark.slow
def test_every_target_has_a_fastest_setting(short):
    assert tuple(short.fastest) == ERROR_TARGETS == (1e-3, 1e-6, 1e-9, 1e-12)


@pytest.mark.slow
def test_a_scene_that_rests_has_no_fastest_setting_and_is_drawn(tmp_path):
    """A controller drives it.

    No method errs, and a logarithm of that does not exist.
    """
    resting = dataclasses.replace(scene.load("point_to_point"), duration=0.004)
    found = study_quickly(resting, 0.002)
    assert found.rests and found.best(1e-6) is None and "rests" in name_fastest(found)
    said = accuracy_page([found])
    assert (
        "| point_to_point | at rest |" in said
        and "accuracy_point_to_point.png" not in said
    )
    assert found.reference.own.gamma_dot == 0.0
    assert (found.rows.largest_gamma_dot_rad_per_s == 0.0).any()
    save_figure(draw_accuracy(found), tmp_path / "picture.png")


def graded(study, *errors):
    """A study of one method whose errors are given, coarse to fine, a millisecond more
    each.
    """
    rows = [
        {
            "method": "dop853",
            "kind": FIXED,
            "setting": 0.5**k,
            "wall_min_s": 1e-3 * (k + 1),
        }
        | {ERROR_COLUMN: error}
        for k, error in enumerate(errors)
    ]
    return dataclasses.replace(study, rows=data_frame(rows, STUDY_COLUMNS))


@pytest.mark.parametrize(
    ("errors", "chosen"),
    [
        # the second is luck: its errors cancel
        ((1e-5, 2.8e-7, 3.1e-6, 5e-7, 1e-7), 3),
        ((1e-5, 2.8e-7, 1e-8, 1e-9), 1),
        ((1e-5, 1e-5, 2.8e-7), None),  # nothing finer was tried
        ((1e-7, None, 1e-8, 1e-9), 2),  # a failure in between
        ((1e-3, 1e-4), None),
    ],
)
def test_a_setting_counts_only_if_every_finer_one_is_as_good(short, errors, chosen):
    best = graded(short, *errors).best(1e-6)
    assert (None if best is None else best.setting) == (
        None if chosen is None else 0.5**chosen
    )


@pytest.mark.slow
def test_another_inertia_in_the_runs_is_seen(monkeypatch):
    """A part in 1e7 of the star's inertia: no method gets near the reference."""
    inertia = dataclasses.asdict(SHORT.star.inertia)
    inertia["zz"] *= 1.0 + 1e-7
    star = dataclasses.replace(SHORT.star, inertia=Inertia(**inertia))
    target = InitialValueProblem(dataclasses.replace(BRIEF, star=star))
    monkeypatch.setattr(accuracy, "solve_reference", lambda _: solve_reference(target))
    found = study_quickly(BRIEF, 0.005)
    assert 1e-10 < found.rows[ERROR_COLUMN].min() < 1e-6


@pytest.mark.slow
def test_failures_stay_in_sight(tmp_path):
    stiff = dataclasses.replace(scene.load("stiff"), duration=0.02)
    found = study_quickly(stiff, 0.005)
    assert not any(row.failure for row in _rows(found, "rodas5p"))
    failed = found.rows[found.rows.failure != ""]
    assert len(failed) and failed[ERROR_COLUMN].isna().all()
    assert accuracy_text(found).count("FAILED") == len(failed)
    assert found.rows.failure.str.contains("not finite|off by").sum() >= len(failed)
    save_figure(draw_accuracy(found), tmp_path / "picture.png")


@pytest.mark.slow
def test_a_run_that_stops_is_compared_up_to_its_end():
    problem = InitialValueProblem(scene.load("example2_stroke"))
    assert problem.seconds == pytest.approx(0.9) and "gamma_1 >" in problem.ends


def test_a_run_that_is_over_at_once_is_refused():
    start = dataclasses.replace(
        SHORT.initial, gamma=(0.0, 0.5, 0.5), gamma_dot=(-1.0, 0.0, 0.0)
    )
    with pytest.raises(InputError, match="over before it can be studied"):
        InitialValueProblem(dataclasses.replace(SHORT, initial=start))
