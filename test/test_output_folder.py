# SPDX-License-Identifier: Apache-2.0
from pathlib import Path

import pytest
from missing_packages import needs

from sst_ros.__main__ import main
from sst_ros.cli.commands import results_folder
from sst_ros.errors import InputError
from sst_ros.files import require_free


@pytest.mark.parametrize(
    ("bag", "folder"),
    [
        ("runs/first", "runs/first_report"),
        ("runs/first/", "runs/first_report"),
        ("runs/2026.11.22", "runs/2026.11.22_report"),
        ("runs/first.mcap", "runs/first_report"),
        ("first", "first_report"),
    ],
)
def test_results_bear_the_name_of_the_recording(bag, folder):
    assert results_folder(Path(bag), "report") == Path(folder)


def test_the_current_folder_as_a_recording_has_a_name(tmp_path, monkeypatch):
    (tmp_path / "run").mkdir()
    monkeypatch.chdir(tmp_path / "run")
    assert results_folder(Path(), "plots") == tmp_path / "run_plots"


def test_what_is_there_is_overwritten_only_with_force(tmp_path):
    assert require_free(tmp_path / "new", "export") == tmp_path / "new"
    assert require_free(tmp_path, "export") == tmp_path, "an empty folder is free"
    (tmp_path / "earlier.csv").write_text("1\n")
    for taken in (tmp_path, tmp_path / "earlier.csv"):
        with pytest.raises(InputError, match="--force"):
            require_free(taken, "export")
        assert require_free(taken, "export", force=True) == taken


@pytest.mark.parametrize(
    "words",
    [
        ["export", "{bag}"],
        pytest.param(["plot", "{bag}"], marks=needs("rosbags", "zstandard")),
        pytest.param(["report", "run", "{bag}"], marks=needs("rosbags", "zstandard")),
        pytest.param(["demo"], marks=needs("rosbags", "mcap")),
    ],
    ids=["export", "plot", "report", "demo"],
)
def test_every_command_refuses_to_overwrite_before_it_reads(words, tmp_path, capsys):
    out = tmp_path / "out"
    out.mkdir()
    (out / "samples.csv").write_text("kept\n")
    given = [word.format(bag=tmp_path / "bag") for word in words]
    assert main([*given, "--out", str(out)]) == 1
    said = capsys.readouterr().err
    assert "--force" in said and str(out) in said
    assert [path.read_text() for path in out.iterdir()] == ["kept\n"]
