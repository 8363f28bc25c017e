# SPDX-License-Identifier: Apache-2.0
"""Each part of a study's results knows its study, its number and its checksum."""

import shutil

import numpy as np
import pyarrow
import pyarrow.parquet as parquet
import pytest

from sst_ros.errors import InputError
from sst_ros.scene.scene import load
from sst_ros.sweeps.sweep import hold_folder, read_sweep, run_study
from sst_ros.sweeps.sweep_study import SweepStudy

VARY = {"star.mass": ("uniform", 1.5, 2.5)}
STUDY = SweepStudy(load("example2_heavy"), VARY, n=96, seed=7, steps=20, chunk=32)


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    out = tmp_path_factory.mktemp("whole") / "out"
    return out, run_study(STUDY, out)


@pytest.fixture
def copied(whole, tmp_path):
    shutil.copytree(whole[0], tmp_path / "out")
    return tmp_path / "out"


def part(folder, index):
    return folder / f"part-{index:07d}.parquet"


def flip_a_bit(folder):
    """Flip the lowest bit of a mantissa in the file's bytes."""
    table = parquet.read_table(part(folder, 1))
    number = np.float64(table["star.mass"][5].as_py()).tobytes()
    content = bytearray(part(folder, 1).read_bytes())
    assert content.count(number) == 1
    content[content.index(number)] ^= 1
    part(folder, 1).write_bytes(content)


def change_a_type(folder):
    """Write texts for numbers of texts, as a flipped bit of the schema makes it."""
    table = parquet.read_table(part(folder, 1))
    place = table.column_names.index("reason")
    texts = table["reason"].cast(pyarrow.string())
    other = table.set_column(place, "reason", texts)
    assert other.schema.metadata == table.schema.metadata
    parquet.write_table(other, part(folder, 1))


def change_a_name(folder):
    """Rename a column, as a flipped bit of the schema does."""
    table = parquet.read_table(part(folder, 1))
    names = [name.replace("energy", "enepgy") for name in table.column_names]
    other = table.rename_columns(names).replace_schema_metadata(table.schema.metadata)
    parquet.write_table(other, part(folder, 1))


def copy(folder):
    shutil.copy(part(folder, 0), part(folder, 1))


def swap(folder):
    part(folder, 0).rename(folder / "x")
    part(folder, 1).rename(part(folder, 0))
    (folder / "x").rename(part(folder, 1))


def add_a_stray_part(folder):
    shutil.copy(part(folder, 0), part(folder, 7))


def add_a_second_name(folder):
    shutil.copy(part(folder, 0), folder / "part-0000000 (copy).parquet")


@pytest.mark.parametrize(
    "read", [read_sweep, lambda out: run_study(STUDY, out, resume=True)]
)
@pytest.mark.parametrize(
    ("change", "said"),
    [
        (flip_a_bit, "part-0000001.parquet.* is damaged"),
        (change_a_name, "part-0000001.parquet.* is damaged"),
        (change_a_type, "part-0000001.parquet.* is damaged"),
        (copy, "part-0000001.parquet.* was written as part-0000000"),
        (swap, "part-0000000.parquet.* was written as part-0000001"),
        (add_a_stray_part, "part-0000007.parquet.* was written as part-0000000"),
        (add_a_second_name, "copy.* was written as part-0000000"),
    ],
)
def test_a_changed_part_is_refused(copied, read, change, said):
    change(copied)
    with pytest.raises(InputError, match=said):
        read(copied)


def test_a_part_beyond_the_last_is_refused(copied):
    shorter = SweepStudy(load("example2_heavy"), VARY, n=64, seed=7, steps=20, chunk=32)
    with pytest.raises(InputError, match=r"of another study|none of the 2 parts"):
        run_study(shorter, copied, resume=True)


def test_a_cut_part_is_computed_again_and_stays_in_the_table(copied, whole):
    part(copied, 2).write_bytes(part(copied, 2).read_bytes()[:500])
    with pytest.raises(InputError, match=r"part-0000002.parquet.* is not whole"):
        read_sweep(copied)
    assert run_study(STUDY, copied, resume=True).equals(whole[1])


def test_whole_results_are_read_to_the_bit(whole):
    assert read_sweep(whole[0]).equals(whole[1])


def test_a_second_writer_of_a_folder_is_refused(tmp_path):
    out = tmp_path / "out"
    for resume in (False, True):
        refused = pytest.raises(InputError, match="is being written by another run")
        with hold_folder(out, "sweep"), refused:
            run_study(STUDY, out, resume=resume)
        assert not out.exists()
