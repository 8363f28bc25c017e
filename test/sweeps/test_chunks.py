# SPDX-License-Identifier: Apache-2.0
"""What chunks of a study share, and the checksum of their files."""

import pytest

from sst_ros import load_scene
from sst_ros.dynamics import traced_dynamics
from sst_ros.integration import batch_step
from sst_ros.sweeps import sweep as sweeps
from sst_ros.sweeps.sweep import PreparedSweep
from sst_ros.sweeps.sweep_study import SweepStudy

pyarrow = pytest.importorskip("pyarrow", reason="needs pyarrow: pip install .[record]")

VARY = {"star.inertia": ("uniform", 0.9, 1.1, "relative")}


def test_chunks_share_the_programs_of_their_study(monkeypatch):
    study = SweepStudy(load_scene("example2_heavy"), VARY, n=96, seed=1, chunk=32)
    ready = PreparedSweep(study, 16)
    first = ready.chunk(0)

    def refuse(*arguments, **options):
        raise AssertionError("traced again")

    monkeypatch.setattr(batch_step, "trace", refuse)
    monkeypatch.setattr(traced_dynamics, "trace", refuse)
    assert ready.chunk(1).num_rows == first.num_rows == 32


@pytest.mark.parametrize("chunks", [1, 3])
def test_texts_of_a_column_are_those_of_arrow(chunks):
    parts = [["a", "b", "a"], ["c", "a"], []][:chunks]
    for kind in (
        pyarrow.string(),
        pyarrow.dictionary(pyarrow.int32(), pyarrow.string()),
    ):
        column = pyarrow.chunked_array(
            [pyarrow.array(part, pyarrow.string()).cast(kind) for part in parts]
        )
        assert sweeps._read_texts(column) == column.to_pylist()
