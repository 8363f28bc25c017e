# SPDX-License-Identifier: Apache-2.0
"""Files of a trajectory that others have made, with a valid checksum, are checked as
any input.
"""

import json

import numpy as np
import pytest

from sst_ros import simulate
from sst_ros.errors import InputError
from sst_ros.simulation.tables import load_table, write_table
from sst_ros.simulation.trajectory import Trajectory
from sst_ros.state import MOTION_UNITS

KEY = "sst_ros"


@pytest.fixture(scope="module")
def saved(tmp_path_factory):
    path = tmp_path_factory.mktemp("saved") / "run.npz"
    simulate("example2_heavy", duration=0.05, samples=5).save(path)
    return path


def crafted(saved, folder, suffix, change):
    columns, texts = load_table(saved, list(MOTION_UNITS), [KEY])
    columns = {name: np.array(column) for name, column in columns.items()}
    about = json.loads(texts[KEY])
    about = change(columns, about) or about
    path = folder / f"crafted{suffix}"
    units = {name: {"unit": unit} for name, unit in MOTION_UNITS.items()}
    write_table(columns, path, units, {KEY: json.dumps(about)})
    return path


def put(name, value):
    return lambda columns, about: about.update({name: value})


def drop(name):
    return lambda columns, about: about.pop(name) and None


def spoil(name, value):
    def change(columns, about):
        columns[name][1] = value

    return change


def cut(columns, about):
    columns["gamma_1"] = columns["gamma_1"][:-1]


def turn(columns, about):
    """Conjugate the orientations: they are of length 1, and of another pose."""
    for part in "xyz":
        columns[f"quaternion_{part}"] *= -1.0


def stretch(columns, about):
    for part in "xyzw":
        columns[f"quaternion_{part}"] *= 1.5


METADATA = {
    "no mapping": (lambda columns, about: [1], "format = None: must be 1"),
    "no format": (drop("format"), "format = None: must be 1"),
    "no scene": (drop("scene"), "KeyError: 'scene'"),
    "scene": (put("scene", 3), "its metadata"),
    "another scene": (put("scene", "name: x"), "is missing"),
    "torque": (put("torque", [1, 2]), "its metadata"),
    "kind of torque": (put("torque", {"kind": "x"}), "its metadata"),
    "status": (put("status", "well"), "status = 'well'"),
    "figure": (put("error_estimate", "small"), "error_estimate = 'small'"),
    "message": (put("message", None), "message = None"),
    "gaps": (put("gaps", [[2, 1]]), "gaps = .*must be rising pairs"),
}
NUMBERS = {
    "nan": (spoil("gamma_dot_2", np.nan), r"gamma_dot_2 = 'nan': must be finite"),
    "infinite": (spoil("t", np.inf), "t = 'nan': must be finite"),
    "descending": (spoil("t", 0.0), "ascending times"),
    "pose": (turn, r"quaternion = .*must close the loops"),
    "length": (stretch, r"quaternion = 0\.5.*: must be of length 1"),
}


@pytest.mark.parametrize("suffix", [".npz", ".parquet"])
@pytest.mark.parametrize(
    ("change", "said"), (METADATA | NUMBERS).values(), ids=METADATA | NUMBERS
)
def test_a_foreign_file_is_refused(saved, tmp_path, suffix, change, said):
    path = crafted(saved, tmp_path, suffix, change)
    with pytest.raises(InputError, match=said) as caught:
        Trajectory.load(path)
    if said != "is missing":
        assert "\n" not in str(caught.value)


def test_columns_of_unequal_length_are_refused(saved, tmp_path):
    with pytest.raises(
        InputError, match=r"gamma_1 = \(5,\): must have the shape \(6,\)"
    ):
        Trajectory.load(crafted(saved, tmp_path, ".npz", cut))


@pytest.mark.timeout(20)
def test_a_device_is_refused_at_once(tmp_path):
    path = tmp_path / "run.npz"
    path.symlink_to("/dev/zero")
    with pytest.raises(InputError, match="it is no regular file"):
        Trajectory.load(path)


def test_an_unchanged_copy_is_read(saved, tmp_path):
    again = Trajectory.load(
        crafted(saved, tmp_path, ".npz", lambda columns, about: None)
    )
    assert np.array_equal(again.gamma, Trajectory.load(saved).gamma)


def test_a_name_that_is_too_long_is_refused(saved, tmp_path):
    path = tmp_path / f"{'x' * 300}.npz"
    with pytest.raises(InputError, match="must be writable"):
        Trajectory.load(saved).save(path)
    with pytest.raises(InputError, match="File name too long"):
        Trajectory.load(path)
