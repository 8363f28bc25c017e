# SPDX-License-Identifier: Apache-2.0
"""Torque profiles: sines as the scene writes them, tables as the file has them."""

from __future__ import annotations

import math
import os

import pytest
from hypothesis import given
from hypothesis import strategies as st
from models import FAST

from sst_ros.errors import InputError
from sst_ros.scene.scene import load
from sst_ros.scene.torque_profile import TorqueTable
from sst_ros.sweeps.variations import read_table

HEADER = "time,tau_1,tau_2,tau_3\n"


def written(folder, text, encoding="utf-8"):
    path = folder / "torques.csv"
    path.write_bytes(text.encode(encoding))
    return path


@FAST
@given(st.floats(0.0, 10.0))
def test_torques_of_example_2_are_the_printed_ones(t):
    """4 sin 18t, 5 cos 12t, 3 cos 24t.

    Phases of pi/2 cost rounding of angles up to 240.
    """
    first, second, third = load("example2_heavy").torque.at(t)
    assert first == pytest.approx(4.0 * math.sin(18.0 * t), abs=1e-13)
    assert second == pytest.approx(5.0 * math.cos(12.0 * t), abs=5e-13)
    assert third == pytest.approx(3.0 * math.cos(24.0 * t), abs=5e-13)


def test_rows_hold_until_the_next_and_none_acts_before_the_first(tmp_path):
    profile = TorqueTable.read(written(tmp_path, HEADER + "0.5,1,2,3\n1.0,-4,5e-1,6\n"))
    assert profile.times[-1] == 1.0
    assert profile(math.nextafter(0.5, 0.0)) == profile(-1.0) == (0.0, 0.0, 0.0)
    assert (
        profile(0.5)
        == profile(0.75)
        == profile(math.nextafter(1.0, 0.0))
        == (1.0, 2.0, 3.0)
    )
    assert profile(1.0) == profile(9.0) == (-4.0, 0.5, 6.0)


def test_spaces_and_windows_line_ends_are_taken(tmp_path):
    text = "time, tau_1, tau_2, tau_3\r\n0, 1, 2, 3\r\n"
    assert TorqueTable.read(written(tmp_path, text))(0.0) == (1.0, 2.0, 3.0)


@pytest.mark.parametrize(
    "text",
    [
        "\ufeff" + HEADER + "0,1,2,3\n",  # as spreadsheets write it
        HEADER + "0,1,2,3\n\n",
        HEADER + "0,1,2,3\r\n,,,\r\n \r\n",
        "tau_3,note,time,tau_1,tau_2\n3,first,0,1,2\n",
        "tau_2,time,tau_1,tau_3\n2.,+0,1e0,.3e1",
    ],
)
def test_a_table_as_other_programs_write_it(tmp_path, text):
    profile = TorqueTable.read(written(tmp_path, text))
    assert profile(0.0) == (1.0, 2.0, 3.0) and profile.times.tolist() == [0.0]


@pytest.mark.parametrize(
    "number", ["1_0", "\u0661", "\uff11", "0x1", "1e", "infinity", "1e400"]
)
def test_numbers_are_those_of_scenes(tmp_path, number):
    with pytest.raises(
        InputError, match=r"line 2: row = .*must be four finite numbers"
    ):
        TorqueTable.read(written(tmp_path, HEADER + f"0,1,{number},3\n"))


@pytest.mark.parametrize("header", ["time,tau_1,tau_2", "time,tau_1,tau_1,tau_2,tau_3"])
def test_each_column_is_there_once(tmp_path, header):
    with pytest.raises(InputError, match=r"line 1: header = .*: must be time, tau_1"):
        TorqueTable.read(written(tmp_path, header + "\n0,1,2,3,4\n"))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", r"line 1: header = None: must be time, tau_1, tau_2, tau_3"),
        ("0,1,2,3\n", r"line 1: header = \['0', .*: must be time, tau_1, tau_2, tau_3"),
        ("t,tau_1,tau_2,tau_3\n", r"line 1: header = \['t', .*: must be time,"),
        (HEADER, r"rows = 0: must be one or more"),
        (
            HEADER + "0,1,2\n",
            r"line 2: row = \['0', '1', '2'\]: must be four finite numbers",
        ),
        (HEADER + "0,1,2,3,4\n", r"line 2: row = .*: must be four finite numbers"),
        (HEADER + "0,1,2,x\n", r"line 2: row = .*'x'\]: must be four finite numbers"),
        (
            HEADER + "0,1,2,nan\n",
            r"line 2: row = .*'nan'\]: must be four finite numbers",
        ),
        (HEADER + "0,1,inf,3\n", r"line 2: row = .*: must be four finite numbers"),
        (HEADER + "nan,1,2,3\n", r"line 2: row = .*: must be four finite numbers"),
        (
            HEADER + "0,1,2,3\n\n1,1,2,3\n",
            r"line 3: row = \[\]: must be four finite numbers",
        ),
        (
            HEADER + "0,1,2,3\n0,1,2,3\n",
            r"line 3: time = 0\.0: must be > 0 s, the last",
        ),
        (
            HEADER + "1,1,2,3\n0.5,1,2,3\n",
            r"line 3: time = 0\.5: must be > 1 s, the last",
        ),
        (HEADER + '"0\n', r"line 2: row = .*: must be four finite numbers"),
        (HEADER + "1" * 200_000, r"must be readable .*field larger"),
    ],
)
def test_refused_tables(tmp_path, text, message):
    with pytest.raises(InputError, match=message):
        TorqueTable.read(written(tmp_path, text))


@pytest.mark.parametrize(
    ("rows", "lines"),
    [
        ("0,1,2,x\n1,1,2,3\n1,1,2,3\n2,,,\n", [2, 4, 5]),
        ('0,1,2,"3\n"\n1,1,2,x\n', [4]),  # a field spans two lines
    ],
)
def test_all_bad_rows_are_told_with_their_lines_in_the_file(tmp_path, rows, lines):
    with pytest.raises(InputError) as caught:
        TorqueTable.read(written(tmp_path, HEADER + rows))
    assert [problem.line for problem in caught.value.problems] == lines


def test_files_that_cannot_be_read_are_told(tmp_path):
    with pytest.raises(InputError, match=r"none\.csv.*must be readable .*No such file"):
        TorqueTable.read(tmp_path / "none.csv")
    with pytest.raises(InputError, match=r"must be readable"):
        TorqueTable.read(written(tmp_path, HEADER, encoding="utf-16"))


@FAST
@given(st.text(st.characters(codec="utf-8"), max_size=80))
def test_arbitrary_rows_are_a_profile_or_refused(tmp_path_factory, text):
    path = written(tmp_path_factory.getbasetemp(), HEADER + text, encoding="utf-8")
    try:
        profile = TorqueTable.read(path)
    except InputError:
        return
    last = profile.times[-1]
    assert all(map(math.isfinite, (*profile(last), last)))


@pytest.mark.timeout(20)
@pytest.mark.parametrize("kind", ["fifo", "/dev/zero"])
def test_a_pipe_or_a_device_is_refused_at_once(tmp_path, kind):
    path = tmp_path / "torques.csv"
    if kind == "fifo":
        os.mkfifo(path)
    else:
        path.symlink_to(kind)
    with pytest.raises(InputError, match=r"torques\.csv.* no regular file"):
        TorqueTable.read(path)
    with pytest.raises(InputError, match=r"table.* no regular file"):
        read_table(path)
