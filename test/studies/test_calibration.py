# SPDX-License-Identifier: Apache-2.0
"""The study of the error estimate: a case of each class."""

import pytest

from studies.estimate import CLASSES, measure


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
