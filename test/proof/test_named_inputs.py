# SPDX-License-Identifier: Apache-2.0
"""Ranges that once were accepted and ignored hold at corners of the truth.

What is too wide says so, with a width that would do; this one is then compared.
"""

import re
import sys

import pytest
from mpmath import mp, mpf
from slow_cases import slow_except

from sst_ros import certify

sys.path.insert(0, __file__.rpartition("/")[0])
import quad_truth as truth
from test_events import documents
from test_independent_truth import change

END = 0.0625  # s
ABOUT_CENTRE = {
    "alpha_deg": ["120", "120", "120"],
    "radius": "0.4",
    "mass": "2.6",
    "centre": ["0.0", "0.01", "0.05"],
    "inertia": {"xx": "0.312", "yy": "0.312", "zz": "0.20"},
    "inertia_about": "centre_of_mass",
}
CASES = {
    "arcs of the star": ({}, {"star.alpha_deg[0]": 0.5}),
    "limit of torques": (
        {"actuators": {"torque_limit": "2.0"}},
        {"actuators.torque_limit": 0.4},
    ),
    "mass of what is shifted": ({"star": ABOUT_CENTRE}, {"star.mass": 0.2}),
    "centre of what is shifted": ({"star": ABOUT_CENTRE}, {"star.centre[1]": 0.02}),
    "interval": ({"star": ABOUT_CENTRE}, {"star.inertia.zz": (0.1999, 0.2002)}),
    "arcs of the base": (
        {"base": {"arcs_deg": ["88.3", "91.7", "94.1"], "radius": "0.35"}},
        {"base.arcs_deg[0]": 1e-3},
    ),
    "restitution of stops": (
        {
            "stroke": {
                "at_end": "elastic",
                "stiffness": "9000",
                "restitution": "0.6",
                "impact_rate": "1.0",
            },
            "initial": {
                "gamma": ["0.02", "0.11", "0.09"],
                "gamma_dot": ["-1.2", "0.3", "-0.2"],
            },
        },
        {"stroke.restitution": 1e-4},
    ),
}


@pytest.mark.parametrize("case", slow_except(["interval"], CASES))
def test_a_range_that_acts_holds_at_its_corners(case):
    changes, ranges = CASES[case]
    ignore = {"workspace": {"at_edge": "ignore"}}
    changes = ignore | changes
    if "stroke" not in changes:
        changes["stroke"] = {"at_end": "ignore"}
    scene, texts = documents("example2_heavy", changes)
    given = {"duration": END, "t_eval": [END], "tolerance": 1e-8}
    proven = certify(scene, ranges=ranges, **given)
    if proven.reason:
        share = float(re.search(r"([\d.]+) of their width", proven.reason)[1])
        ranges = {key: share * width for key, width in ranges.items()}
        proven = certify(scene, ranges=ranges, **given)
    assert not proven.reason
    near, farthest = proven.trajectory.quaternion[0], mpf(0)
    for side in (-1, 1):
        with mp.workdps(truth.DIGITS):
            document = change(texts, ranges, lambda side=side: side)
        (state,), _ = truth.motion(document, near, [END])
        assert max(truth.ratios(proven, 0, state).values()) <= 1.0
        with mp.workdps(truth.DIGITS):
            apart = truth.angle(state.quaternion, proven.trajectory.quaternion[0])
        farthest = max(farthest, apart)
    assert farthest > 1e-7  # the range acts: without it the bound would be below this
