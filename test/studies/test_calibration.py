# SPDX-License-Identifier: Apache-2.0
"""The study of the error estimate: a case of each class, and the table of its page."""

import pytest

from sst_ros.report.results import data_frame
from studies.estimate import CLASSES, measure, summarise


@pytest.mark.parametrize("name", CLASSES)
def test_the_estimate_holds_in_a_case_of_each_class(name):
    row = next(
        row for row in (measure((name, 5, k)) for k in range(6)) if row["state"] == "resolved"
    )
    assert row["error"] <= 3.0 * row["estimate"]
    assert row["status"] == 2 or row["error"] <= 3.0 * row["tolerance"]


def test_a_case_depends_on_its_seed_and_number_alone():
    one, other = (measure(("jump", 5, 3)) for _ in range(2))
    assert one == other


def test_the_table_counts_what_is_too_small():
    rows = [
        {"class": "smooth", "state": "resolved", "estimate": e, "error": 1e-9,
         "tolerance": 1e-10, "status": 0}
        for e in (1e-11, 2e-10, 2e-9)
    ]  # fmt: skip
    found = summarise(data_frame(rows)).iloc[0]
    assert found[["below 1/3", "below 1/10", "beyond 3 tolerances"]].tolist() == [2, 1, 3]
