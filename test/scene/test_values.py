# SPDX-License-Identifier: Apache-2.0
"""Scenes with other values by key."""

import numpy as np
import pytest

from sst_ros.errors import InputError
from sst_ros.scene.scene import load

EXAMPLE2 = load("example2_heavy")


def test_numbers_lists_sections_and_choices():
    other = EXAMPLE2.with_values(
        {
            "star.inertia.zz": np.float64(0.3),
            "base.v": np.array(EXAMPLE2.base.v) + 0.01,
            "actuated_links.inertia.xx": 0.02,
            "actuated_links[1].inertia.zz": 0.021,
            "star.mass": 2.6,
            "gravity.acceleration": (0.0, 0.0, -9.81),
            "stroke.at_end": "ignore",
            "torque": None,
            "initial.gamma_dot": 0.5,
            "initial.gamma[1]": 0.25,
        }
    )
    assert other.star.inertia.zz == 0.3
    assert other.base.v[0] == (1.01, 0.01, 0.01)
    assert [link.inertia.xx for link in other.actuated_links] == [0.02] * 3
    assert [link.inertia.zz for link in other.actuated_links] == [0.018375, 0.021, 0.018375]
    assert other.gravity.acceleration == (0.0, 0.0, -9.81)
    assert other.initial.gamma_dot == (0.5, 0.5, 0.5)
    assert other.initial.gamma == (EXAMPLE2.initial.gamma[0], 0.25, EXAMPLE2.initial.gamma[2])
    assert (other.stroke.at_end, other.torque) == ("ignore", None)
    assert EXAMPLE2.star.inertia.zz == 0.26
    assert EXAMPLE2.with_values({}) == EXAMPLE2


@pytest.mark.parametrize(
    ("values", "said"),
    [
        ({"star.inertai.zz": 1.0}, "star.inertai"),
        ({"star.inertia.zz": -1.0}, "star.inertia"),
        ({"star.inertia.zz": "much"}, "must be a finite number"),
        ({"springs[0].rest": 1.0}, r"springs\[0\].rest = 1.0: names nothing"),
        ({"name.first": 1.0}, "names nothing"),
        ({"star.inertia.zz": {1, 2}}, "star.inertia.zz"),
        ({"star.inertia.zz": object()}, "star.inertia.zz = .*: must be a finite number"),
    ],
)
def test_what_makes_no_scene_is_refused(values, said):
    with pytest.raises(InputError, match=said):
        EXAMPLE2.with_values(values)
