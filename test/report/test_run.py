# SPDX-License-Identifier: Apache-2.0
"""The report as a whole: summary, table and pictures."""

import dataclasses
import json
import math

import numpy as np
import pytest
from matplotlib import image

from sst_ros.errors import InputError
from sst_ros.recording import recording
from sst_ros.report.run import evaluate, report, summary_table
from sst_ros.scene import scene


@pytest.fixture(scope="module")
def whole(tmp_path_factory, bags, example2):
    """Report of a whole run: summary and folder."""
    folder = tmp_path_factory.mktemp("report")
    return report(bags.record(folder / "bag", example2), folder / "out"), folder / "out"


def _numbers(value):
    if isinstance(value, dict):
        value = list(value.values())
    if isinstance(value, list):
        return [number for entry in value for number in _numbers(entry)]
    return [value] if isinstance(value, (int, float)) else []


def test_the_summary_is_written_whole_and_finite(whole):
    summary, out = whole

    def refuse(word):
        raise AssertionError(word)

    text = (out / "summary.json").read_text(encoding="utf-8")
    assert json.loads(text, parse_constant=refuse) == summary
    assert len(_numbers(summary)) > 30 and all(map(math.isfinite, _numbers(summary)))
    expected = {
        "scene": "example2", "phase": "finished", "fault": "", "ticks": 300, "ticks_missed": 0,
        "samples_published": 151, "samples_recorded": 151, "samples_lost": 0, "stamp_gaps": 0,
        "samples_recorded_percent": 100.0, "sample_period_s": 0.002, "tick_period_s": 0.001,
        "step_mean_us": 160.5, "effort_difference_max_N_m": 0.0, "notes": [], "topics_missing": [],
    }  # fmt: skip
    assert {key: summary[key] for key in expected} == expected
    assert summary["integration_error_gamma_rad"] < 1e-11
    assert 0.0 < summary["integration_reference_error_gamma_rad"] < 1e-11
    assert 1e-6 < summary["ideal_difference_gamma_rad"] < 1e-2
    assert summary["formulation_difference_relative"] < 1e-12


def test_the_table_says_it_all_in_line(whole):
    summary, _ = whole
    text = summary_table(summary)
    for word in ("ticks done", "ticks missed", "real-time factor", "samples lost", "(a)", "(b)"):
        assert word in text
    assert f"{summary['integration_error_gamma_rad']:.2e}" in text
    assert f"{summary['ideal_difference_gamma_dot_rad_per_s']:.2e}" in text
    assert "NumPy" in text.split("\n\n")[-1]
    assert all(len(line) < 140 for line in text.splitlines())


def test_the_pictures_are_pictures(whole):
    summary, out = whole
    assert summary["pictures"] == [
        "fig10_path_of_E.png", "fig11_position_of_E.png", "fig12_theta.png", "fig13_phi.png",
        "fig14_psi.png", "torques.png", "error.png",
    ]  # fmt: skip
    for name in summary["pictures"]:
        assert (out / name).stat().st_size > 10_000
        pixels = image.imread(out / name)
        assert pixels.shape[0] > 500 and pixels.shape[1] > 800
        coloured = np.ptp(pixels[:, :, :3], axis=2) > 0.2
        assert coloured.sum() > 500, f"{name} shows no curve"


def test_loss_is_counted_and_survived(tmp_path, bags, example2):
    lost = {20, 21, 60, 150}  # the last one can only be missed by what was published
    kept = [e for e in bags.without(example2, bags.COMMANDS) if e.sample not in lost]
    summary = evaluate(recording.read(bags.write(tmp_path / "bag", kept))).summary
    assert summary["samples_published"] == 151 and summary["samples_recorded"] == 147
    assert (summary["samples_lost"], summary["stamp_gaps"]) == (4, 2)
    assert summary["samples_missing_between_stamps"] == 3
    assert summary["samples_recorded_percent"] == pytest.approx(100.0 * 147 / 151)
    assert summary["restarts_at_s"] == [0.044, 0.122]
    assert summary["integration_error_gamma_rad"] < 1e-11
    assert any("began again 2 times" in note for note in summary["notes"])
    assert "Note: torques are missing" in summary_table(summary)


def test_what_is_not_recorded_is_unknown(tmp_path, bags, example2):
    kept = bags.without(example2, bags.DIAGNOSTICS, bags.EULER, bags.COMMANDS)
    summary = evaluate(recording.read(bags.write(tmp_path / "bag", kept))).summary
    assert summary["ticks"] is summary["real_time_factor"] is summary["phase"] is None
    assert summary["samples_lost"] == 0
    assert summary["topics_missing"] == ["euler_zyz", "diagnostics", "commands"]
    assert any("no diagnostics" in note for note in summary["notes"])
    assert any("euler_zyz is not recorded" in note for note in summary["notes"])
    line = next(line for line in summary_table(summary).splitlines() if "ticks done" in line)
    assert line.split()[-1] == "-"


def test_a_fault_is_told_and_the_run_judged_up_to_it(tmp_path, bags, undrawn):
    start = scene.Initial(gamma=(1.5, 0.785, 0.785), gamma_dot=(1.0, 0.0, 0.0))
    near = dataclasses.replace(scene.load("example2_heavy"), name="near_the_end", initial=start)
    entries = bags.simulated(near, 0.3)
    summary = report(bags.write(tmp_path / "bag", entries), tmp_path / "out")
    assert summary["phase"] == "fault" and summary["fault"].startswith("stopped at t = 0.0")
    assert summary["ticks"] == 5 and summary["samples_recorded"] == 4  # at 0, 2, 4 and 5 ms
    assert summary["sample_period_s"] == 0.002 and summary["stamp_gaps"] == 0
    assert summary["integration_error_gamma_rad"] < 1e-11
    assert any("ended by a fault" in note for note in summary["notes"])
    assert summary["fault"] in summary_table(summary)
    assert "path_of_E.png" in summary["pictures"]  # no figure number outside the examples


def test_a_folder_that_cannot_be_written_is_refused(tmp_path, bags, example2):
    bag = bags.write(tmp_path / "bag", example2)
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(InputError, match=r"out = .*must be a folder that can be written"):
        report(bag, tmp_path / "file")
