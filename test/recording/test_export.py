# SPDX-License-Identifier: Apache-2.0
"""Tables of a bag, against the messages that were written into it, to the bits."""

import numpy as np
import pytest

from sst_ros import __main__ as cli
from sst_ros.errors import InputError, MissingDependency
from sst_ros.recording.recording import export, read_signals
from sst_ros.state import nanoseconds

pd = pytest.importorskip("pandas")
parquet = pytest.importorskip(
    "pyarrow.parquet", reason="needs pyarrow: pip install .[record]"
)


@pytest.fixture(scope="module")
def kept(bags, example2):
    """Everything that a run sends, but some messages."""
    lost = {(bags.EULER, 3), (bags.ERROR, 5), (bags.JOINTS, 7)}
    sent = bags.tracked(
        example2, lambda t: (np.full(3, 0.7 + 0.1 * t), np.full(3, 0.1))
    )
    return [entry for entry in sent if (entry.topic, entry.sample) not in lost]


@pytest.fixture(scope="module")
def lossy(tmp_path_factory, bags, kept):
    return bags.write(tmp_path_factory.mktemp("lossy") / "bag", kept)


def expected_samples(bags, entries):
    """Rows of numbers by stamp, of the messages that are samples of the run."""
    rows = {}
    names = {
        bags.JOINTS: ("", "tau"),
        bags.DESIRED: ("_desired", "tau_feedforward"),
        bags.ERROR: ("_error", "tau_feedback"),
    }
    for entry in entries:
        if entry.sample < 0 or entry.topic == bags.APPLIED:
            continue
        message = entry.content
        row = rows.setdefault(nanoseconds(message.header.stamp), {})
        if entry.topic == bags.ORIENTATION:
            q = message.quaternion
            row.update(q_x=q.x, q_y=q.y, q_z=q.z, q_w=q.w)
        elif entry.topic == bags.EULER:
            v = message.vector
            row.update(theta_rad=v.x, phi_rad=v.y, psi_rad=v.z)
        else:
            what, torque = names[entry.topic]
            for i, joint in enumerate(message.name):
                kind, leg = joint.split("_")
                row[f"{kind}{what}_{leg}_rad"] = message.position[i]
                row[f"{kind}_dot{what}_{leg}_rad_per_s"] = message.velocity[i]
                if kind == "gamma":
                    row[f"{torque}_{leg}_N_m"] = message.effort[i]
    return rows


def expected_ticks(bags, entries):
    rows = {}
    for message in (entry.content for entry in entries if entry.topic == bags.APPLIED):
        begin = start = nanoseconds(message.header.stamp)
        for point in message.points:
            end = begin + nanoseconds(point.time_from_start)
            efforts = zip(
                ("tau_1_N_m", "tau_2_N_m", "tau_3_N_m"), point.effort, strict=True
            )
            rows[start] = {"length_ns": end - start, **dict(efforts)}
            start = end
    return rows


def check(table, rows, start):
    """Compare a table with what the messages say; nan stands for what was lost."""
    found = table.set_index("stamp_ns").drop(columns="received_ns")
    assert np.array_equal(found.pop("time_ns"), found.index - start)
    expected = pd.DataFrame.from_dict(rows, orient="index").sort_index()
    assert (
        set(found) == set(expected) and found.index.tolist() == expected.index.tolist()
    )
    bits, expected_bits = (
        one[list(found)].fillna(1e99).to_numpy(float).tobytes()
        for one in (found, expected)
    )
    assert bits == expected_bits


def load(form, bag, folder, table):
    """A table as a user gets it."""
    if form == "csv":
        texts = pd.read_csv(folder / f"{table}.csv", dtype=str)
        return texts.astype(
            {name: int if name.endswith("_ns") else float for name in texts}
        )
    if form == "parquet":
        return pd.read_parquet(folder / f"{table}.parquet")
    return read_signals(bag).table(table).reset_index()


@pytest.mark.parametrize("form", ["csv", "parquet", "pandas"])
def test_tables_hold_the_bits_of_the_bag(form, lossy, kept, bags, tmp_path):
    names = ("samples", "ticks", "commands")
    if form != "pandas":
        paths = export(lossy, tmp_path / "out", form)
        assert [path.name for path in paths] == [f"{name}.{form}" for name in names]
    samples, ticks, commands = (
        load(form, lossy, tmp_path / "out", name) for name in names
    )
    check(samples, expected_samples(bags, kept), bags.START_NS)
    check(ticks, expected_ticks(bags, kept), bags.START_NS)
    (sent,) = (entry for entry in kept if entry.topic == bags.COMMANDS)
    times = {"time_ns": sent.received_ns - bags.START_NS, "stamp_ns": 0}
    torque = {f"tau_{k}_N_m": x for k, x in enumerate(sent.content.data, 1)}
    assert commands.to_dict("records") == [
        {**times, "received_ns": sent.received_ns, **torque}
    ]


def test_columns_say_what_they_are(lossy, tmp_path):
    samples, text = (
        read_signals(lossy).table(),
        "rate of gamma [rad/s], from joint_states",
    )
    name = "gamma_dot_1_rad_per_s"
    assert set(samples.attrs) == {samples.index.name, *samples.columns}
    assert samples.attrs[name] == text
    field = parquet.read_schema(export(lossy, tmp_path, "parquet")[0]).field(name)
    assert field.metadata == {b"unit": b"rad/s", b"description": text.encode()}
    with pytest.raises(
        InputError, match="must be one of those in the bag: samples, ticks"
    ):
        read_signals(lossy).table("moments")


def test_a_bag_of_one_topic_is_enough(written, bags, example2, tmp_path, capsys):
    path = written([entry for entry in example2 if entry.topic == bags.APPLIED])
    assert cli.main(["export", str(path), "--out", str(tmp_path / "out")]) == 0
    assert capsys.readouterr().out.split() == [str(tmp_path / "out" / "ticks.csv")]
    ticks = load("csv", path, tmp_path / "out", "ticks")
    check(ticks, expected_ticks(bags, example2), bags.START_NS)


def test_a_bag_without_any_is_refused(written, bags, example2):
    path = written([entry for entry in example2 if entry.topic == bags.DIAGNOSTICS])
    with pytest.raises(InputError, match="must have at least one of /joint_states"):
        export(path, path.parent / "out")


def test_a_moment_over_a_tick_is_a_column(written, bags, example2):
    moment = {"moment_x_N_m": 0.5, "moment_y_N_m": 1.5, "moment_z_N_m": 2.5}
    table = read_signals(written(bags.with_moment(example2, [*moment.values()]))).table(
        "ticks"
    )
    assert (table[[*moment]] == moment).all(axis=None)


def test_without_a_library_its_name_is_told(lossy, tmp_path, monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "pyarrow", None)
    with pytest.raises(
        MissingDependency, match=r"pyarrow is not installed.*sst_ros\[record\]"
    ):
        export(lossy, tmp_path / "out", "parquet")
