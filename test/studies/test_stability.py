# SPDX-License-Identifier: Apache-2.0
"""The report of stability: verdicts, largest steps, and their picture."""

import dataclasses

import numpy as np
import pytest
from matplotlib import image

from sst_ros import scene
from sst_ros.integration.methods import METHODS
from sst_ros.plot.stability import draw
from sst_ros.studies import extreme_cases
from sst_ros.studies.initial_value_problem import InitialValueProblem
from sst_ros.studies.stability import (
    LONGEST_S,
    Stable,
    bisected,
    judge,
    largest_step,
    viscous,
)
from sst_ros.studies.stability_report import lines

CASES = list(extreme_cases.cases())


def test_a_bound_is_found_to_one_per_cent():
    assert bisected(lambda h: h <= 3e-4) == pytest.approx(3e-4, rel=0.01)
    assert bisected(lambda h: True) == LONGEST_S
    assert np.isnan(bisected(lambda h: False))


@pytest.mark.parametrize(("method", "reach"), [("rk4", 2.785), ("dopri5", 3.307)])
def test_the_largest_step_is_that_of_the_theory(method, reach):
    """The ends of the real stability intervals, Hairer & Wanner, section IV.2."""
    problem = InitialValueProblem(viscous(scene.load("stiff"), 1e3))
    assert largest_step(problem, METHODS[method]) * 4237.0 == pytest.approx(reach, rel=0.02)


def test_the_implicit_method_is_stable_everywhere():
    problem = InitialValueProblem(viscous(scene.load("stiff"), 1e5))
    assert largest_step(problem, METHODS["rodas4"]) == LONGEST_S


def test_right_and_wrong_are_told_apart():
    case = next(case for case in CASES if case.deviation is not None and case.bound)
    good = judge(case)
    assert good.sound and good.deviation <= case.bound and good.closure < 1e-12
    bad = judge(dataclasses.replace(case, deviation=lambda _: 2.0 * case.bound))
    assert not bad.sound
    refused = next(case for case in CASES if case.refusal)
    assert judge(refused).sound
    assert not judge(dataclasses.replace(refused, refusal="Diverged")).sound
    text = "\n".join(lines([good, bad], [Stable("rk4", 1.0, 100.0, 0.02)]))
    assert "1 of them wrong" in text and "WRONG" in text and "20 (2.00)" in text


def test_the_picture_shows_every_method(tmp_path):
    steps = [
        Stable(method, c, 4.0 * c, LONGEST_S if method == "rodas4" else 1.0 / c)
        for method in METHODS
        for c in (1e1, 1e3, 1e5)
    ]
    draw(steps, "made today", tmp_path / "picture.png")
    pixels = image.imread(tmp_path / "picture.png")
    assert (np.ptp(pixels[:, :, :3], axis=2) > 0.2).sum() > 2000
