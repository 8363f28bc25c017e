# SPDX-License-Identifier: Apache-2.0
"""`sweep` on this machine: rows equal runs of their own, files are whole, and studies
resume.
"""

import dataclasses
import sys

import numpy as np
import pytest
from slow_cases import slow_after

import sst_ros
from sst_ros import InputError, Simulation, load_scene, simulate
from sst_ros.sweeps import sweep as engine
from sst_ros.sweeps.sweep import PreparedSweep, SweepFailed, run_study
from sst_ros.sweeps.sweep_study import SweepStudy

for module in ("pandas", "pyarrow"):
    pytest.importorskip(module, reason="a sweep needs it")

SCENE = load_scene("example2_heavy")
VARY = {
    "star.inertia": ("uniform", 0.7, 1.2, "relative"),
    "initial.gamma": ("uniform", 0.7, 0.85),
    "torque.amplitude": ("normal", 4.0, 0.5),
}
STUDY = SweepStudy(SCENE, VARY, n=300, seed=7, steps=40, chunk=64)


def same(one, other):
    """Compare two tables bit by bit."""
    assert one["reason"].tolist() == other["reason"].tolist()
    one, other = (each.drop(columns="reason").to_records() for each in (one, other))
    assert one.dtype == other.dtype and one.tobytes() == other.tobytes()


@pytest.fixture(scope="module")
def table():
    return run_study(STUDY, None)


def test_a_row_is_a_run_of_its_scene(table):
    for row in (0, 64, 299):
        one = table.loc[row]
        inertia = one["star.inertia"] * np.array([0.39, 0.39, 0.26])
        values = {
            f"star.inertia.{ii}": x
            for ii, x in zip(("xx", "yy", "zz"), inertia, strict=True)
        }
        gamma, amplitude = (
            [one[f"{key}[{k}]"] for k in range(3)]
            for key in ("initial.gamma", "torque.amplitude")
        )
        values |= {"initial.gamma": gamma, "torque.amplitude": amplitude}
        scene = SCENE.with_values(values)
        motion = simulate(scene, t_eval=[one["t"]], tolerance=1e-11)
        found = one[[f"gamma_{k}" for k in (1, 2, 3)]].astype(float)
        np.testing.assert_allclose(found, motion.gamma[0], atol=1e-8)


def test_early_ends_have_their_reason(table):
    ended = table[table["status"] == 1]
    assert 0 < len(ended) < len(table)
    assert ended["reason"].str.match(r"(gamma|beta)_\d [<>] ").all()
    assert np.all(ended["fault_time"] >= ended["t"])
    assert np.all(ended["fault_time"] <= ended["t"] + 1.0 / 40 + 1e-12)


@pytest.mark.parametrize("changes", slow_after(1, [{"chunk": 300}, {"chunk": 17}]))
def test_neither_chunks_nor_workers_change_a_bit(table, changes):
    study = dataclasses.replace(STUDY, **changes)
    same(run_study(study, None, workers=1 if changes["chunk"] == 17 else 3), table)


def test_the_tolerance_chooses_the_number_of_steps():
    counts = []
    for tolerance in (1e-6, 1e-9):
        ready = PreparedSweep(
            dataclasses.replace(STUDY, steps=None, tolerance=tolerance)
        )
        assert ready.pilot_error <= tolerance
        counts.append(ready.steps)
    assert counts[0] < counts[1] < 64


def test_extremes_are_those_of_a_run():
    study = dataclasses.replace(STUDY, n=3, outputs=("gamma", "extremes"))
    found, ready = run_study(study, None), PreparedSweep(study)
    scenarios, starts, _ = ready.scenarios(study.draw(0, 3))
    batch, rate = ready.batch.with_parameters(scenarios), np.zeros((3, 3))
    runs = batch.run(
        starts["initial.gamma"], rate, step=1.0 / 40, count=40, keep_every=1
    )
    gamma = runs.kept.gamma[..., 1]
    assert gamma.shape == (41, 3)
    assert found["gamma_max_2"].tolist() == gamma.max(axis=0).tolist()
    assert found["gamma_min_2"].tolist() == gamma.min(axis=0).tolist()


def test_constant_torques_take_the_place_of_the_scenes():
    found = sst_ros.sweep(
        SCENE,
        {"star.inertia.zz": [0.26, 0.3]},
        torque=(0.1, 0.2, -0.1),
        duration=0.2,
        steps=20,
    )
    simulation = Simulation(SCENE, "dop853")
    simulation.step((0.1, 0.2, -0.1), 200_000_000)
    np.testing.assert_allclose(
        found["gamma_1"][0], simulation.state.joints.gamma[0], atol=1e-11
    )


def test_rows_that_make_no_scene_are_reported_and_stop_no_other():
    vary = {
        "star.inertia.zz": ("normal", 0.26, 0.2),
        "star.inertia.xx": ("uniform", 0.38, 0.39),
    }
    found = sst_ros.sweep(SCENE, vary, n=40, steps=20)
    zz, xx = found["star.inertia.zz"], found["star.inertia.xx"]
    wrong = (zz <= 0.0) | (zz > xx + 0.39)
    assert 0 < wrong.sum() < 40
    assert found["reason"][wrong].str.startswith("no scene: star.inertia").all()
    assert found["gamma_1"][wrong].isna().all()
    assert not found["reason"][~wrong].str.startswith("no scene").any()


def test_a_table_is_checked_before_it_runs_row_by_row(table):
    some = table.loc[[5, 200, 17], table.attrs["inputs"]]
    again = sst_ros.sweep(SCENE, some, steps=40)
    for name in ("gamma_1", "body_rate_z", "energy"):
        assert np.array_equal(
            again[name].to_numpy(), table.loc[[5, 200, 17], name], equal_nan=True
        )
    with pytest.raises(InputError, match=r"makes no scene.*star\.inertia"):
        sst_ros.sweep(
            SCENE, some.assign(**{"star.inertia": [1.0, -1.0, 1.0]}), steps=40
        )


def test_ends_of_ranges_that_make_no_scene_are_refused_first():
    with pytest.raises(
        InputError, match=r"makes no scene.*no principal moment may exceed"
    ):
        sst_ros.sweep(SCENE, {"star.inertia.zz": ("uniform", 0.2, 0.9)}, n=10)


def test_files_are_whole_and_explain_themselves(table, tmp_path):
    found = run_study(STUDY, tmp_path / "out")
    same(found, table)
    names = sorted(path.name for path in (tmp_path / "out").iterdir())
    assert names == [f"part-{i:07d}.parquet" for i in range(5)]
    about = engine.read_about(tmp_path / "out" / names[0])
    units, study = about["units"], about["study"]
    assert about["version"] == sst_ros.__version__
    assert (units["gamma_dot_1"], units["star.inertia"]) == ("rad/s", "1")
    assert (study["seed"], study["scene"]["name"]) == (7, "example2_heavy")
    assert about["steps"] == 40


def test_resume_computes_only_what_is_missing(table, tmp_path, monkeypatch):
    out = tmp_path / "out"
    run_study(STUDY, out)
    (out / "part-0000001.parquet").unlink()
    cut = out / "part-0000003.parquet"
    cut.write_bytes(cut.read_bytes()[:1000])
    (out / ".part-left").write_text("of a killed process")
    calls, compute = [], PreparedSweep.chunk
    monkeypatch.setattr(
        PreparedSweep,
        "chunk",
        lambda self, index: calls.append(index) or compute(self, index),
    )
    same(run_study(STUDY, out, resume=True), table)
    assert sorted(calls) == [1, 3]
    assert not (out / ".part-left").exists()
    with pytest.raises(InputError, match="is of another study or version"):
        run_study(dataclasses.replace(STUDY, seed=8), out, resume=True)
    with pytest.raises(InputError, match="exists already"):
        run_study(STUDY, out)


@pytest.mark.slow
def test_a_full_disk_leaves_whole_files_and_the_study_resumes(
    table, tmp_path, monkeypatch
):
    out, write, written = tmp_path / "out", engine.write_part, []

    def full(table, folder, index, about):
        if len(written) == 2:
            raise OSError(28, "No space left on device")
        written.append(index)
        write(table, folder, index, about)

    monkeypatch.setattr(sys.modules[run_study.__module__], "write_part", full)
    with pytest.raises(SweepFailed, match="No space left on device"):
        run_study(STUDY, out, workers=1)
    monkeypatch.undo()
    assert len(list(out.glob("part-*"))) == 2
    same(run_study(STUDY, out, resume=True), table)


@pytest.mark.filterwarnings("ignore:overflow encountered", "ignore:invalid value")
def test_a_scenario_that_diverges_keeps_to_itself():
    """Friction that fixed explicit steps cannot resolve makes its numbers infinite."""
    scene = SCENE.with_values({"friction.gamma.viscous": 0.1})
    vary = {"friction.gamma.viscous": [0.1, 1e8, 0.2]}
    found = sst_ros.sweep(scene, vary, steps=40)
    assert found["status"].tolist() == [0, -1, 0]
    assert found["reason"][1] == "not finite"
    alone = sst_ros.sweep(scene, {"friction.gamma.viscous": [0.1, 0.2]}, steps=40)
    assert alone["gamma_1"].tolist() == found["gamma_1"][[0, 2]].tolist()
    assert np.isfinite(found["quaternion_x"]).all()
