# SPDX-License-Identifier: Apache-2.0
"""Ratios of releases: ten, each on the page and in the table; a worse one is seen."""

import pandas as pd
import pytest

import sst_ros
from benchmark import ratios
from benchmark.measure import DOCS


def test_the_page_and_its_table_have_all_ten_of_this_release():
    text = (DOCS / "ratios.md").read_text(encoding="utf-8")
    table = pd.read_csv(DOCS / "ratios.csv", dtype={"release": str}).set_index(
        "release"
    )
    assert len(ratios.TRACKS) == 10
    for name in ratios.TRACKS:
        assert text.count(f"| {name} |") == 1 + (name in table)
    last = table.loc[sst_ros.__version__].reindex(ratios.TRACKS).astype(float)
    assert (last > 0.0).sum() >= 9  # that of `make test` is measured when it is idle


def test_a_change_between_releases_is_drawn():
    rows = [
        {"release": f"0.{k}.0"} | dict.fromkeys(ratios.TRACKS, 1.0 + k) for k in (0, 1)
    ]
    axes = ratios.draw(pd.DataFrame(rows)).axes
    assert len(axes) == len(ratios.TRACKS)
    assert all([*one.lines[0].get_ydata()] == [1.0, 2.0] for one in axes)


def test_the_size_is_that_of_the_source():
    assert 0.5 < ratios.track_size_over_a_megabyte() < 2.0


@pytest.mark.slow
def test_a_command_takes_a_few_times_as_long_as_importing_numpy():
    assert 0.5 < ratios.track_command_over_import_of_numpy() < 4.0
