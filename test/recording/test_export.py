# SPDX-License-Identifier: Apache-2.0
"""Tables of a bag, against the bag read message by message by rosbags alone, to the bits."""

import csv
import functools
import re
from pathlib import Path

import numpy as np
import pytest
from rosbags.rosbag2 import Reader

from sst_ros import __main__ as cli
from sst_ros.errors import InputError
from sst_ros.extras import MissingDependency
from sst_ros.recording.recording import export, read_signals
from sst_ros.recording.topic_tables import TABLES, TIMES

pytest.importorskip("pandas")
parquet = pytest.importorskip("pyarrow.parquet", reason="needs pyarrow: pip install .[record]")
ROOT = Path(__file__).parents[2]


def home(t):
    return np.full(3, 0.7853981633974483) + 0.1 * t, np.full(3, 0.1)


@pytest.fixture(scope="module")
def lossy(tmp_path_factory, bags, example2):
    """A bag with everything in it but some messages."""
    lost = {(bags.EULER, 3), (bags.ERROR, 5), (bags.JOINTS, 7)}
    kept = [e for e in bags.tracked(example2, home) if (e.topic, e.sample) not in lost]
    return bags.write(tmp_path_factory.mktemp("lossy") / "bag", kept)


def messages(bags, path, topic):
    """Contents and times of reception of a topic."""
    with Reader(path) as reader:
        connections = [c for c in reader.connections if c.topic == topic]
        return [
            (bags.STORE.deserialize_cdr(raw, connection.msgtype), received)
            for connection, received, raw in reader.messages(connections)
        ]


def stamp(message):
    return message.header.stamp.sec * 10**9 + message.header.stamp.nanosec


def expected_samples(bags, path):
    """Rows of numbers by stamp, as a user would read them from the bag."""
    rows = {}
    for topic, what, torque in (
        (bags.JOINTS, "", "tau"),
        (bags.DESIRED, "_desired", "tau_feedforward"),
        (bags.ERROR, "_error", "tau_feedback"),
    ):
        for message, _ in messages(bags, path, topic):
            row = rows.setdefault(stamp(message), {})
            for i, joint in enumerate(message.name):
                kind, leg = joint.split("_")
                row[f"{kind}{what}_{leg}_rad"] = message.position[i]
                row[f"{kind}_dot{what}_{leg}_rad_per_s"] = message.velocity[i]
                if kind == "gamma":
                    row[f"{torque}_{leg}_N_m"] = message.effort[i]
    for message, _ in messages(bags, path, bags.ORIENTATION):
        q = message.quaternion
        rows.setdefault(stamp(message), {}).update(q_x=q.x, q_y=q.y, q_z=q.z, q_w=q.w)
    for message, _ in messages(bags, path, bags.EULER):
        v = message.vector
        rows[stamp(message)].update(theta_rad=v.x, phi_rad=v.y, psi_rad=v.z)
    del rows[0]  # states before the run
    return rows


def expected_ticks(bags, path):
    rows = {}
    for message, _ in messages(bags, path, bags.APPLIED):
        start = stamp(message)
        for point in message.points if start else ():
            after = point.time_from_start
            end = stamp(message) + after.sec * 10**9 + after.nanosec
            efforts = zip(("tau_1_N_m", "tau_2_N_m", "tau_3_N_m"), point.effort, strict=True)
            rows[start] = {"length_ns": end - start, **dict(efforts)}
            start = end
    return rows


def check(rows, expected, start):
    """Compare rows of a table, key to number or None, with what the bag says."""
    assert [row["stamp_ns"] for row in rows] == sorted(expected)
    for row in rows:
        assert row["time_ns"] == row["stamp_ns"] - start
        said = {key: value for key, value in row.items() if value is not None}
        wanted = expected[row["stamp_ns"]]
        assert set(said) == {*wanted, "time_ns", "stamp_ns", "received_ns"}
        for key, value in wanted.items():
            assert np.float64(said[key]).tobytes() == np.float64(value).tobytes(), key


def read_rows(form, bag, folder, table):
    """Rows of a table, key to number or None, as a user gets them."""
    if form == "csv":
        with (folder / f"{table}.csv").open(encoding="utf-8", newline="") as file:
            return [
                {k: int(x) if k[-3:] == "_ns" else float(x) if x else None for k, x in row.items()}
                for row in csv.DictReader(file)
            ]
    if form == "parquet":
        rows = parquet.read_table(folder / f"{table}.parquet").to_pylist()
    else:
        rows = read_signals(bag).table(table).reset_index().to_dict("records")
    return [{key: None if x != x else x for key, x in row.items()} for row in rows]


@pytest.mark.parametrize("form", ["csv", "parquet", "pandas"])
def test_tables_hold_the_bits_of_the_bag(form, lossy, bags, tmp_path):
    if form != "pandas":
        paths = export(lossy, tmp_path / "out", form)
        names = [f"{name}.{form}" for name in ("samples", "ticks", "commands")]
        assert [path.name for path in paths] == names
    read = functools.partial(read_rows, form, lossy, tmp_path / "out")
    check(read("samples"), expected_samples(bags, lossy), bags.START_NS)
    check(read("ticks"), expected_ticks(bags, lossy), bags.START_NS)
    ((command, received),) = messages(bags, lossy, bags.COMMANDS)
    assert read("commands") == [
        {
            "time_ns": received - bags.START_NS, "stamp_ns": 0, "received_ns": received,
            **{f"tau_{k}_N_m": command.data[k - 1] for k in (1, 2, 3)},
        }
    ]  # fmt: skip


def test_columns_say_what_they_are(lossy, tmp_path):
    samples, text = read_signals(lossy).table(), "rate of gamma [rad/s], from joint_states"
    name = "gamma_dot_1_rad_per_s"
    assert set(samples.attrs) == {samples.index.name, *samples.columns}
    assert samples.attrs[name] == text
    field = parquet.read_schema(export(lossy, tmp_path, "parquet")[0]).field(name)
    assert field.metadata == {b"unit": b"rad/s", b"description": text.encode()}
    with pytest.raises(InputError, match="must be one of those in the bag: samples, ticks"):
        read_signals(lossy).table("moments")


def test_a_bag_of_one_topic_is_enough(written, bags, example2, tmp_path, capsys):
    path = written([entry for entry in example2 if entry.topic == bags.APPLIED])
    assert cli.main(["export", str(path), "--out", str(tmp_path / "out")]) == 0
    assert capsys.readouterr().out.split() == [str(tmp_path / "out" / "ticks.csv")]
    rows = read_rows("csv", path, tmp_path / "out", "ticks")
    check(rows, expected_ticks(bags, path), bags.START_NS)


def test_a_bag_without_any_is_refused(written, bags, example2):
    path = written([entry for entry in example2 if entry.topic == bags.DIAGNOSTICS])
    with pytest.raises(InputError, match="must have at least one of /joint_states"):
        export(path, path.parent / "out")


def test_a_moment_over_a_tick_is_a_column(written, bags, example2):
    moment = {f"moment_{axis}_N_m": 0.5 + k for k, axis in enumerate("xyz")}

    def moved(entry):
        if entry.topic != bags.APPLIED:
            return entry
        torque = [point.effort.tolist() for point in entry.content.points]
        names = [*bags.NAMES[:3], "moment_x", "moment_y", "moment_z"]
        held = [[*t, *moment.values()] for t in torque]
        fresh = bags.torque_entry(held, stamp(entry.content), entry.received_ns, entry.sample)
        object.__setattr__(fresh.content, "joint_names", names)
        return fresh

    table = read_signals(written([moved(entry) for entry in example2])).table("ticks")
    assert {name: table[name].unique().tolist() for name in moment} == {
        name: [value] for name, value in moment.items()
    }


def test_every_column_is_documented():
    page = (ROOT / "docs" / "columns.md").read_text(encoding="utf-8")
    columns = [*TIMES, *(c for parts in TABLES.values() for part in parts for c in part.columns)]
    for column in columns:
        assert re.search(rf"^\| `{column.name}` \| {re.escape(column.what)}", page, re.M)


def test_without_a_library_its_name_is_told(lossy, tmp_path, monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "pyarrow", None)
    with pytest.raises(MissingDependency, match=r"pyarrow is not installed.*sst_ros\[record\]"):
        export(lossy, tmp_path / "out", "parquet")
