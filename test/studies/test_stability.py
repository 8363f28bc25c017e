# SPDX-License-Identifier: Apache-2.0
"""The report of stability: verdicts, largest steps, and their picture."""

import dataclasses
import math

import numpy as np
import pytest
from matplotlib import image

from sst_ros.integration.methods import METHODS
from sst_ros.plot.style import save_figure
from sst_ros.report.results import data_frame
from sst_ros.report.step_advice import stability_function
from studies import stability_limits
from studies.extreme import page
from studies.extreme_cases import catalogue
from studies.extreme_runs import evaluate_case
from studies.stability_limits import (
    LONGEST_S,
    LargestStep,
    bisect_step,
    draw_largest_steps,
    draw_regions,
    eigenvalues,
    faults,
    largest_step,
    limits_of_theory,
    oscillating,
    regions,
)

CASES = catalogue()


def test_a_bound_is_found_to_one_per_cent():
    assert bisect_step(lambda h: h <= 3e-4) == pytest.approx(3e-4, rel=0.01)
    assert bisect_step(lambda h: True) == LONGEST_S
    assert np.isnan(bisect_step(lambda h: False))


@pytest.mark.parametrize(("method", "reach"), [("rk4", 2.785), ("dopri5", 3.307)])
def test_the_largest_step_is_that_of_the_theory(method, reach):
    """The ends of the real stability intervals, Hairer & Wanner, section IV.2."""
    found = largest_step("decay", METHODS[method], 1e3)
    assert found.step * found.rate == pytest.approx(reach, rel=0.02)


@pytest.mark.parametrize("stiffness", [1e3, 1e6])
def test_the_largest_step_of_oscillations_is_that_of_the_theory(stiffness):
    """2 sqrt(2) on the imaginary axis, for RK4."""
    values = eigenvalues(oscillating(stiffness))
    assert np.abs(values.real).max() < 1e-3 * np.abs(values).max()
    found = largest_step("oscillation", METHODS["rk4"], stiffness)
    assert found.step * found.rate == pytest.approx(2.0 * math.sqrt(2.0), rel=0.02)


def test_the_implicit_method_is_stable_everywhere():
    assert largest_step("decay", METHODS["rodas4"], 1e5).step == LONGEST_S


@pytest.mark.parametrize("method", METHODS.values(), ids=METHODS)
def test_stability_functions_agree_with_the_exponential_to_the_order(method):
    for direction in (-1.0, 1j, 0.6 + 0.8j):
        z = 0.1 * direction * np.array([1.0, 0.5])
        errors = np.abs(stability_function(method, z) - np.exp(z))
        if errors.min() > 1e-15:
            order = math.log2(errors[0] / errors[1]) - 1.0
            assert order == pytest.approx(method.order, abs=0.3) or order > method.order


def test_rodas4_is_a_stable_and_l_stable():
    rodas = METHODS["rodas4"]
    axis = np.abs(stability_function(rodas, 1j * np.geomspace(1e-4, 1e12, 400_001)))
    assert axis.max() <= 1.0 + 1e-14
    left = -np.geomspace(1e-4, 1e12, 400)[:, None] * np.exp(1j * np.linspace(-1.57, 1.57, 99))
    assert np.abs(stability_function(rodas, left)).max() <= 1.0 + 1e-14
    assert abs(stability_function(rodas, np.array([-1e12 + 0j]))[0]) < 1e-10


def changed(values, share):
    """Yield tables of coefficients, each with another one that is not zero changed by a part."""
    for i, value in enumerate(values):
        parts = changed(value, share) if isinstance(value, tuple) else [value * (1.0 + share)]
        for part in parts if isinstance(value, tuple) or value else ():
            yield (*values[:i], part, *values[i + 1 :])


@pytest.mark.parametrize("method", METHODS.values(), ids=METHODS)
def test_a_coefficient_that_is_wrong_in_the_seventh_digit_is_seen(method, monkeypatch):
    assert list(stability_limits.method_faults(method)) == []
    # Of rodas4 the rest is seen in its order of convergence (test_orders) only.
    tables = ("a",) if method is METHODS["rodas4"] else ("a", "b", "c", "error", "damping")
    for name in tables:
        for values in changed(getattr(method, name), 1e-7):
            wrong = dataclasses.replace(method, **{name: values})
            assert list(stability_limits.method_faults(wrong)), (name, values)
    monkeypatch.setitem(METHODS, method.name, wrong)
    assert any(line.startswith(f"WARNING: {method.name}") for line in faults())


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
    assert "rodas4: A-stable and L-stable" in "\n".join(limits_of_theory())


def test_the_figures_show_every_method(tmp_path):
    steps = [
        {"family": family, "method": method, "rate": 4.0 * c,
         "step": LONGEST_S if method == "rodas4" else 1.0 / c}
        for family in ("decay", "oscillation") for method in METHODS for c in (1e1, 1e3, 1e5)
    ]  # fmt: skip
    drawn = {
        "steps": draw_largest_steps(data_frame(steps), "made today"),
        "regions": draw_regions(*regions(points=81), {"a": np.array([-1 + 1j])}, "made today"),
    }
    for name, figure in drawn.items():
        save_figure(figure, tmp_path / f"{name}.png")
        pixels = image.imread(tmp_path / f"{name}.png")
        assert (np.ptp(pixels[:, :, :3], axis=2) > 0.1).sum() > 2000
