# SPDX-License-Identifier: Apache-2.0
"""The report of stability: verdicts, largest steps, and their picture."""

import dataclasses
import math

import numpy as np
import pytest
from matplotlib import image

from sst_ros.integration.methods import METHODS
from sst_ros.plot.style import save_figure
from studies.extreme import page
from studies.extreme_cases import catalogue
from studies.extreme_runs import evaluate_case
from studies.stability_limits import (
    FAMILIES,
    LONGEST_S,
    LargestStep,
    draw_regions,
    eigenvalues,
    largest_step,
    limits_of_theory,
)

CASES = catalogue()


@pytest.mark.parametrize(
    ("family", "method", "coefficient", "reach"),
    [
        ("decay", "rk4", 1e3, 2.785),
        ("decay", "dopri5", 1e3, 3.307),
        ("oscillation", "rk4", 1e3, 2.0 * math.sqrt(2.0)),
        ("oscillation", "rk4", 1e6, 2.0 * math.sqrt(2.0)),
    ],
)
def test_the_largest_step_is_that_of_the_theory(family, method, coefficient, reach):
    """The ends of the real and imaginary stability intervals, Hairer & Wanner, section IV.2."""
    values = eigenvalues(FAMILIES[family][0](coefficient))
    if family == "oscillation":
        assert np.abs(values.real).max() < 1e-3 * np.abs(values).max()
    found = largest_step(family, METHODS[method], coefficient)
    assert found.step * found.rate == pytest.approx(reach, rel=0.02)


def test_the_implicit_method_is_stable_everywhere():
    assert largest_step("decay", METHODS["rodas5p"], 1e5).step == LONGEST_S


def test_right_and_wrong_results_are_distinguished():
    case = next(case for case in CASES if case.deviation is not None and case.bound)
    good = evaluate_case(case, compiled=False)
    assert good.passed and good.deviation <= case.bound and good.closure < 1e-12
    bad = evaluate_case(
        dataclasses.replace(case, deviation=lambda *_: 2.0 * case.bound), compiled=False
    )
    assert not bad.passed
    for run in ("same_bits", "run_loop"):
        assert not dataclasses.replace(good, **{run: False}).passed
    refused = next(case for case in CASES if case.refusal)
    assert evaluate_case(refused, compiled=False).passed
    wrong = dataclasses.replace(refused, refusal="Diverged")
    assert not evaluate_case(wrong, compiled=False).passed
    steps = [LargestStep(family, "rk4", 1.0, 100.0, 0.02) for family in ("decay", "oscillation")]
    text = page([good, bad], steps)
    assert "2 cases, 1 failed" in text and "**FAILED**" in text and "20 (2.00)" in text
    off = dataclasses.replace(good, same_bits=False)
    assert "**differ**" in page([off], steps) and not off.passed
    assert "rodas5p: A-stable and L-stable" in "\n".join(limits_of_theory())


def test_the_figure_shows_every_method(tmp_path):
    figure = draw_regions({"a": np.array([-1 + 1j])}, "made today")
    save_figure(figure, tmp_path / "regions.png")
    pixels = image.imread(tmp_path / "regions.png")
    assert (np.ptp(pixels[:, :, :3], axis=2) > 0.1).sum() > 2000
    assert [axes.get_title("left").partition(":")[0] for axes in figure.axes[:4]] == list(METHODS)
