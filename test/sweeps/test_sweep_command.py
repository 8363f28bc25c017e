# SPDX-License-Identifier: Apache-2.0
"""`sst-ros sweep`: a study file to a folder of results, a summary and pictures."""

import pytest
from scipy.stats import spearmanr

from sst_ros.cli.commands import run_command
from sst_ros.sweeps.sweep import correlate, read_sweep

for module in ("pandas", "pyarrow", "matplotlib"):
    pytest.importorskip(module, reason="the command needs it")

STUDY = """
scene: example2_heavy
n: 240
steps: 30
chunk: 100
vary:
  star.inertia: {uniform: [0.8, 1.2], relative: true}
  initial.gamma: {uniform: [0.70, 0.87]}
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    path = tmp_path_factory.mktemp("sweep")
    (path / "study.yaml").write_text(STUDY)
    assert (
        run_command(["sweep", str(path / "study.yaml"), "--out", str(path / "out")])
        == 0
    )
    return path


@pytest.mark.slow
def test_its_summary_names_reasons_and_causes(folder, capsys):
    words = [
        "sweep",
        str(folder / "study.yaml"),
        "--out",
        str(folder / "out"),
        "--resume",
    ]
    assert run_command(words) == 0
    out = capsys.readouterr().out
    assert "240 runs of 1 s, 30 steps each" in out
    assert "gamma_1 > 1.570796 rad" in out
    assert out.index("star.inertia") < out.index("initial.gamma[1]")
    assert len(list((folder / "out").glob("part-*.parquet"))) == 3


def test_correlations_are_spearmans(folder):
    table = read_sweep(folder / "out")
    found = correlate(table)
    for name in table.attrs["inputs"]:
        assert found[name] == pytest.approx(
            spearmanr(table[name], table["status"] != 0).statistic
        )
    assert list(found.abs()) == sorted(found.abs(), reverse=True)


def test_plot_draws_the_pictures(folder, tmp_path, capsys, undrawn):
    assert (
        run_command(["sweep", "plot", str(folder / "out"), "--out", str(tmp_path)]) == 0
    )
    names = sorted(path.name for path in tmp_path.iterdir())
    assert names == ["distributions.png", "worst.png"]
    assert capsys.readouterr().out.count(".png") == 2


REFUSED = [
    (["nothing.yaml"], 1, "STUDY = 'nothing.yaml': must be a readable .yaml file"),
    (["study.yaml", "--out", "out"], 1, "exists already"),
    (["study.yaml", "--workers", "0"], 2, "must be a whole number from 1 to 1024"),
    (
        ["study.yaml", "--scheduler", "tcp://x:1", "--workers", "2"],
        2,
        "is for this machine",
    ),
    (["plot"], 2, "sst-ros sweep plot DIR"),
    (["plot", "nowhere"], 1, "must be a folder with files part-"),
]


@pytest.mark.parametrize(("words", "status", "message"), REFUSED)
def test_wrong_arguments_are_refused(
    folder, monkeypatch, capsys, words, status, message
):
    monkeypatch.chdir(folder)
    try:
        found = run_command(["sweep", *words])
    except SystemExit as ended:
        found = ended.code
    assert found == status
    assert message in capsys.readouterr().err
