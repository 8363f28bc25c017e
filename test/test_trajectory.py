# SPDX-License-Identifier: Apache-2.0
"""Trajectory: derived quantities against the states of Simulation, files to the bit,
at(t).
"""

import copy
import pickle
import random
import threading
from dataclasses import replace

import numpy as np
import pytest
from slow_cases import slow_after

from sst_ros.errors import InputError
from sst_ros.scene.loads import Actuators
from sst_ros.scene.scene import load
from sst_ros.scene.torque_profile import PolynomialTorque, TorqueTable
from sst_ros.simulation.simulate import simulate
from sst_ros.simulation.trajectory import RunRecord, Trajectory

EXAMPLE2 = load("example2_heavy")
ARRAYS = (
    "t", "quaternion", "body_rate", "torque", "gamma", "mu", "beta", "gamma_dot",
    "mu_dot", "beta_dot", "euler_zyz", "energy",
)  # fmt: skip


@pytest.fixture(scope="module")
def run():
    return simulate("general", duration=0.2, t_eval=np.linspace(0.0, 0.2, 41))


@pytest.fixture(params=["parquet", "npz"])
def path(request, tmp_path):
    """A file of each form that keeps all."""
    pytest.importorskip("pyarrow", reason="files need pyarrow")
    return tmp_path / f"run.{request.param}"


def test_angles_and_rates_are_those_of_the_states(run):
    bare = Trajectory(run.scene, run.t, run.quaternion, run.body_rate, run.torque)
    for name in ("gamma", "mu", "beta", "gamma_dot", "mu_dot", "beta_dot"):
        np.testing.assert_allclose(
            getattr(bare, name), getattr(run, name), rtol=1e-13, atol=1e-14
        )


def test_energy_and_closure(run):
    assert abs(run.energy_residual) < 1e-9
    assert run.closure_error < 1e-14
    assert run.energy.shape == run.t.shape


def test_shapes_units_and_names_in_tables(run):
    table = run.to_pandas()
    assert list(table) == list(table.attrs["units"])
    np.testing.assert_array_equal(table["gamma_2"], run.gamma[:, 1])
    assert table.attrs["units"]["body_rate_x"] == "rad/s"


def test_labelled_arrays(run):
    pytest.importorskip("xarray", reason="xarray is optional")
    found = run.to_xarray()
    np.testing.assert_array_equal(found["gamma"].sel(leg=2), run.gamma[:, 1])
    assert found["torque"].attrs["units"] == "N m"


def test_a_file_keeps_every_bit_the_scene_and_the_figures(run, path):
    run.save(path)
    again = Trajectory.load(path)
    for name in ARRAYS:
        one, other = getattr(run, name), getattr(again, name)
        assert one.tobytes() == np.ascontiguousarray(other).tobytes(), name
    assert again.scene == run.scene
    for name in ("status", "message", "method", "error_estimate", "energy_residual"):
        assert getattr(again, name) == getattr(run, name)
    np.testing.assert_allclose(
        again.at(0.1234).gamma, run.at(0.1234).gamma, rtol=0, atol=1e-12
    )
    with pytest.raises(InputError, match=r"exists"):
        run.save(path)
    run.save(path, overwrite=True)


def test_a_copy_and_another_process_get_every_bit_of_the_samples():
    run = simulate("example2", duration=0.2)
    for again in (copy.deepcopy(run), pickle.loads(pickle.dumps(run))):
        for name in ARRAYS:
            assert getattr(again, name).tobytes() == getattr(run, name).tobytes(), name
        assert again.energy_residual == run.energy_residual and repr(again) == repr(run)
        np.testing.assert_allclose(
            again.at(0.1234).gamma, run.at(0.1234).gamma, rtol=0, atol=1e-9
        )


class OldPickle:
    """A trajectory as versions pickled it in which nothing stood in a record."""

    def __init__(self, motion):
        names = (
            "scene", "t", "quaternion", "body_rate", "torque", "_joints", "gaps", "law",
            "status", "message", "method", "error_estimate", "evaluations", "step",
        )  # fmt: skip
        self.values = {name: getattr(motion, name) for name in names}
        self.values["_residual"] = motion.energy_residual
        self.values["_parameters"] = ()
        self.values["dense"] = None

    def __reduce__(self):
        return object.__new__, (Trajectory,), self.values


def test_a_pickle_of_a_version_without_records_is_read(run):
    again = pickle.loads(pickle.dumps(OldPickle(run)))
    for name in ("quaternion", "gamma", "torque", "energy"):
        assert getattr(again, name).tobytes() == getattr(run, name).tobytes(), name
    assert again.energy_residual == run.energy_residual and repr(again) == repr(run)
    for name in ("status", "message", "method", "error_estimate", "evaluations"):
        assert getattr(again, name) == getattr(run, name), name
    np.testing.assert_allclose(again.at(0.1234).gamma, run.at(0.1234).gamma, atol=1e-12)
    assert not again.quaternion.flags.writeable


def test_a_slice_and_samples_at_other_times_share_the_record(run):
    assert run[3:9].run is run.run and run.at(0.05).run is run.run
    assert run[3:9].energy_residual == run.energy_residual


def test_a_record_refuses_a_status_that_is_none():
    for status in (3, True, 1.0, "0"):
        with pytest.raises(InputError, match=r"status = .*: must be one of"):
            RunRecord(status=status)


def test_a_csv_is_the_table_and_other_suffixes_are_refused(run, tmp_path):
    pytest.importorskip("pandas")
    run.save(tmp_path / "run.csv")
    found = np.genfromtxt(tmp_path / "run.csv", delimiter=",", names=True)
    assert list(found.dtype.names) == list(run.to_pandas())
    assert np.array_equal(found.tolist(), run.to_pandas())
    for name in ("run.dat", "run", "run.csv.gz"):
        with pytest.raises(InputError, match=r"must end in .parquet or .csv or .npz"):
            run.save(tmp_path / name)
    with pytest.raises(InputError, match=r"must be writable"):
        run.save(tmp_path / "nowhere" / "run.csv")
    assert [path.name for path in tmp_path.iterdir()] == ["run.csv"]


def test_what_is_no_trajectory_is_refused(run, tmp_path):
    pytest.importorskip("pyarrow", reason="files need pyarrow")
    (tmp_path / "text.parquet").write_text("no table")
    run.save(tmp_path / "run.csv")
    np.savez(tmp_path / "other.npz", t=run.t)
    for name in ("text.parquet", "absent.parquet", "run.csv", "other.npz"):
        with pytest.raises(InputError, match=r"must be a trajectory"):
            Trajectory.load(tmp_path / name)


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("flips", slow_after(1, [120, 600]))
def test_a_flipped_bit_is_refused_or_changes_nothing(run, path, flips):
    generator, refused = random.Random(1), 0
    run.save(path)
    whole = path.read_bytes()
    for _ in range(flips):
        changed, at = bytearray(whole), generator.randrange(len(whole))
        changed[at] ^= 1 << generator.randrange(8)
        path.write_bytes(changed)
        try:
            again = Trajectory.load(path)
        except InputError:
            refused += 1
            continue
        same = all(
            np.array_equal(getattr(again, name), getattr(run, name)) for name in ARRAYS
        )
        assert same and again.scene == run.scene and repr(again) == repr(run), (
            f"byte {at}"
        )
    assert refused > flips * 2 / 3


@pytest.mark.slow
def test_parallel_saves_to_one_path_never_break_a_reader(run, path):
    motions = run, run.at(run.t[::2])
    run.save(path)
    writers = [
        threading.Thread(
            target=lambda m=m: [m.save(path, overwrite=True) for _ in range(20)]
        )
        for m in motions * 2
    ]
    for writer in writers:
        writer.start()
    lengths = set()
    while any(writer.is_alive() for writer in writers):
        lengths.add(len(Trajectory.load(path)))
    assert lengths and lengths <= {len(one) for one in motions}
    assert [one.name for one in path.parent.iterdir()] == [path.name]


PROFILES = {
    "sine": None,
    "numbers": (0.5, -0.2, 0.3),
    "table": TorqueTable([0.0, 0.03, 0.11], [[1, 0, 0], [0, 1, 0], [0.2, 0, 1]]),
    "pieces": PolynomialTorque(
        [[[20, 0, 9], [-4, 1, 0]], [[1, 2, 3], [3, 2, 1]]], [0.0, 0.1, 0.3]
    ),
    "function": lambda t: (np.cos(9.0 * t), t, -t),
}


LIMITED = replace(EXAMPLE2, actuators=Actuators(torque_limit=0.5))
CASES = {name: (EXAMPLE2, torque) for name, torque in PROFILES.items()}
CASES["clamped"] = (
    LIMITED,
    TorqueTable([0.0, 0.03], [[2.0, 0.0, 0.0], [-2.0, 1.0, 0.0]]),
)


@pytest.mark.parametrize(("scene", "torque"), CASES.values(), ids=CASES)
def test_between_samples_it_is_as_accurate_as_at_them(scene, torque):
    times = [0.0123, 0.0717, 0.1001, 0.1777]
    coarse, direct = (
        simulate(scene, torque, 0.2, t_eval=at, tolerance=1e-12)
        for at in (np.linspace(0.0, 0.2, 6), times)
    )
    found = coarse.at(times)
    np.testing.assert_allclose(found.quaternion, direct.quaternion, rtol=0, atol=1e-11)
    np.testing.assert_allclose(found.body_rate, direct.body_rate, rtol=0, atol=1e-10)
    np.testing.assert_allclose(found.torque, direct.torque, rtol=0, atol=1e-12)
    with pytest.raises(InputError, match=r"must be times from 0 to 0.2"):
        coarse.at(0.3)


@pytest.mark.parametrize("rows", [slice(None, 5), slice(2, None, 3), slice(-4, -1)])
def test_a_slice_has_its_samples_and_goes_on_between_them(run, rows):
    part = run[rows]
    for name in (
        "t",
        "quaternion",
        "body_rate",
        "torque",
        "gamma",
        "beta_dot",
        "energy",
    ):
        assert np.array_equal(getattr(part, name), getattr(run, name)[rows])
    middle = 0.5 * (part.t[0] + part.t[-1])
    np.testing.assert_allclose(
        part.at(middle).gamma, run.at(middle).gamma, rtol=0, atol=1e-11
    )
    for wrong in (3, slice(5, 5), slice(None, None, -1)):
        with pytest.raises(InputError, match=r"trajectory: (rows|t) = "):
            run[wrong]


def test_samples_under_held_torques_need_nothing_else():
    """As those of a recording: each torque is that of the interval that ends there."""
    times, torques = np.arange(11) / 100, [(0.1 * k, 0.5, -0.3) for k in range(10)]
    run, wanted = (
        simulate(
            EXAMPLE2, TorqueTable(times[:10], torques), 0.1, t_eval=t, tolerance=1e-12
        )
        for t in (times, [0.034567])
    )
    found = Trajectory(EXAMPLE2, run.t, run.quaternion, run.body_rate, run.torque).at(
        0.034567
    )
    np.testing.assert_allclose(found.quaternion, wanted.quaternion, atol=1e-12)
    assert found.torque[0].tolist() == list(torques[3])


@pytest.mark.parametrize("name", ["t", "quaternion", "body_rate", "torque"])
def test_arrays_are_read_only(run, name):
    for found in (run, simulate("example2_heavy"), run.at([0.1, 0.2])):
        with pytest.raises(ValueError, match="read-only"):
            getattr(found, name)[0] *= 1000.0


def at_rest(times, n):
    quaternion = np.tile([0.0, 0.0, 0.0, 1.0], (n, 1))
    rest = np.zeros((len(times), 3))
    return Trajectory(EXAMPLE2, times, quaternion, rest, rest), quaternion


def test_what_is_given_to_a_trajectory_can_change_without_it():
    t = np.array([0.0, 1.0])
    found, quaternion = at_rest(t, 2)
    t *= 5.0
    quaternion[:] = 7.0
    assert found.t.tolist() == [0.0, 1.0]
    assert found.quaternion.max() == 1.0


@pytest.mark.parametrize(
    ("times", "n", "said"),
    [
        ([0.0, 1.0, 0.5], 3, r"t = (.|\n)*ascending"),
        ([0.0, 0.0], 2, r"t = (.|\n)*ascending"),
        ([1.0, 0.0], 2, r"t = (.|\n)*ascending"),
        ([0.0, 1.0], 1, r"quaternion(.|\n)*must have the shape"),
    ],
)
def test_misfits_are_refused(times, n, said):
    with pytest.raises(InputError, match=said):
        at_rest(times, n)


@pytest.mark.parametrize(
    "torque", [lambda t: (t, 0.0, 0.1), lambda t, state: (t, 0.0, 0.1)]
)
def test_a_loaded_run_under_a_function_has_only_its_samples(torque, tmp_path):
    pytest.importorskip("pyarrow", reason="files need pyarrow")
    run = simulate("example2", torque, 0.2, t_eval=[0.0, 0.1, 0.2])
    run.save(tmp_path / "run.parquet")
    again = Trajectory.load(tmp_path / "run.parquet")
    assert again.at([0.1]).quaternion.tobytes() == run.quaternion[1:2].tobytes()
    with pytest.raises(InputError, match=r"not in the file"):
        again.at(0.05)
    assert "<table>" in again._repr_html_()


def test_a_picture_and_a_summary_for_notebooks(run):
    pytest.importorskip("matplotlib", reason="pictures need matplotlib")
    assert [len(axes.lines) for axes in run.plot().axes] == [3, 3, 3, 1]
    assert "<table>" in run._repr_html_()
    assert "<svg" in run._repr_html_()


def test_reactions_are_columns_of_tables_and_files_on_demand(tmp_path):
    motion = simulate("gravity_payload", duration=0.05, samples=4)
    table = motion.to_pandas(reactions=True)
    assert len(table.columns) == len(motion.to_pandas().columns) + 54
    assert table.attrs["units"]["moment_revolute_2_z"] == "N m"
    column = motion.reactions.revolute.moment[:, 1, 2]
    assert table["moment_revolute_2_z"].to_numpy() == pytest.approx(column, abs=0.0)
    motion.save(tmp_path / "motion.csv", reactions=True)
    text = (tmp_path / "motion.csv").read_text(encoding="utf-8")
    assert "force_prismatic_3_y" in text.splitlines()[0]
    for name in ("motion.npz", "motion.parquet"):
        with pytest.raises(InputError, match="csv alone"):
            motion.save(tmp_path / name, reactions=True)
        motion.save(tmp_path / name)
        again = Trajectory.load(tmp_path / name)
        assert np.all(again.reactions.revolute.moment[:, 1, 2] == column)


def test_held_torques_are_drawn_as_steps_and_gaps_are_left_open():
    times = np.array([0.0, 0.013, 0.02])
    rows = np.array([[0.1, 0.0, 0.0], [-0.2, 0.1, 0.0], [0.0, 0.0, 0.3]])
    table = TorqueTable(times, rows)
    motion = simulate("example2", table, 0.03, samples=4)
    line = motion.plot().axes[2].get_lines()[0]
    seconds, torque = line.get_data()
    for k, time in enumerate(times[1:], start=1):
        at = np.flatnonzero(seconds == time)
        assert torque[at[0]] == rows[k - 1, 0] and torque[at[-1]] == rows[k, 0]
    parts = Trajectory(
        motion.scene,
        motion.t,
        motion.quaternion,
        motion.body_rate,
        motion.torque,
        gaps=[[motion.t[1], motion.t[2]]],
    )
    angles = parts.plot().axes[0].get_lines()[0].get_ydata()
    assert np.flatnonzero(np.isnan(angles)).tolist() == [2]
    torque = parts.plot().axes[2].get_lines()[0].get_ydata()  # held up to its sample
    assert torque[0] == motion.torque[1, 0] and np.isnan(torque).any()
    assert np.isnan(parts.reactions.plot().axes[0].get_lines()[0].get_ydata()).any()
