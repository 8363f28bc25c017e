# SPDX-License-Identifier: Apache-2.0
"""The report of stability: verdicts, largest steps, and their picture."""

import dataclasses
import math
import re

import numpy as np
import pytest
from matplotlib import image
from missing_packages import needs

from sst_ros.dynamics.traced_dynamics import ODE
from sst_ros.figures import save_figure
from sst_ros.integration.method_steps import MethodSteps
from sst_ros.integration.methods import METHODS
from sst_ros.integration.point import Drive
from sst_ros.report.scene_summary import eigenvalues
from sst_ros.simulation.simulation import Simulation
from studies.extreme import (
    draw_regions,
    evaluate_case,
    limits_of_theory,
    page,
    prove_case,
)
from studies.extreme_cases import catalogue
from studies.extreme_scenes import FREE, POSE, changed, start

CASES = catalogue()
AMPLITUDE = 1e-4
"""Distance of the springs from their rest [rad]: so small that the motion is linear."""


def damped(coefficient):
    """The scene `stiff` with another viscous coefficient.

    Its fastest eigenvalue is real.
    """
    return changed({"friction": {"gamma": {"viscous": coefficient}}}, "stiff")


def oscillating(stiffness):
    """A star on springs, without damping; its eigenvalues are imaginary."""
    springs = [
        {"joint": f"gamma_{k + 1}", "stiffness": stiffness, "rest": angle - AMPLITUDE}
        for k, angle in enumerate(POSE)
    ]
    return changed({**FREE, **start(POSE), "springs": springs, "torque": None})


@np.errstate(all="ignore")
def growth(scene, method, product):
    """Largest rate after 400 steps whose length times the fastest eigenvalue is
    `product`.
    """
    simulation, rate = Simulation(scene), np.abs(eigenvalues(scene)).max()
    integrator = MethodSteps(ODE(simulation.dynamics), METHODS[method])
    begin = [*simulation.state.quaternion, *simulation.state.body_rate]
    try:
        end = integrator.fixed(0.0, product / rate, 400, begin, Drive((0.0,) * 3))
    except (ArithmeticError, ValueError):
        return math.inf
    return np.nan_to_num(math.hypot(*end[4:7]), nan=math.inf)


@pytest.mark.parametrize(
    ("method", "family", "coefficient", "reach"),
    [
        ("rk4", damped, 1e3, 2.785),
        ("dopri5", damped, 1e3, 3.307),
        ("dop853", damped, 1e3, 6.394),
        ("rk4", oscillating, 1e3, 2.0 * math.sqrt(2.0)),
        ("rk4", oscillating, 1e6, 2.0 * math.sqrt(2.0)),
        ("dop853", oscillating, 1e3, 5.96),
    ],
)
def test_steps_are_stable_up_to_the_ends_of_the_intervals(
    method, family, coefficient, reach
):
    """The ends of the real and imaginary stability intervals, Hairer & Wanner, section
    IV.2.
    """
    scene = family(coefficient)
    values = eigenvalues(scene)
    # Rates of the oscillation at its amplitude; at rest the damped family has a rate of
    # its own.
    most = 10.0
    if family is oscillating:
        assert np.abs(values.real).max() < 1e-3 * np.abs(values).max()
        most *= AMPLITUDE * np.abs(values).max()
    assert (
        growth(scene, method, 0.98 * reach) < most < growth(scene, method, 1.02 * reach)
    )


def test_the_implicit_method_is_stable_everywhere():
    assert growth(damped(1e5), "rodas5p", 4e5) < 10.0


def test_right_and_wrong_results_are_distinguished():
    case = next(case for case in CASES if case.deviation is not None and case.bound)
    good = evaluate_case(case, plain=False)
    assert good.passed and good.deviation <= case.bound and good.closure < 1e-12
    bad = evaluate_case(
        dataclasses.replace(case, deviation=lambda *_: 2.0 * case.bound), plain=False
    )
    assert not bad.passed
    for run in ("same_bits", "run_loop"):
        assert not dataclasses.replace(good, **{run: False}).passed
    refused = next(case for case in CASES if case.refusal)
    assert evaluate_case(refused, plain=False).passed
    wrong = dataclasses.replace(refused, refusal="Diverged")
    assert not evaluate_case(wrong, plain=False).passed
    text = page([good, bad])
    assert "2 cases, 1 failed" in text and "**FAILED**" in text
    off = dataclasses.replace(good, same_bits=False)
    assert "**differ**" in page([off]) and not off.passed
    assert "rodas5p: A-stable and L-stable" in "\n".join(limits_of_theory())


@pytest.mark.slow
def test_the_figure_shows_every_method(tmp_path):
    figure = draw_regions({"a": np.array([-1 + 1j])})
    save_figure(figure, tmp_path / "regions.png")
    pixels = image.imread(tmp_path / "regions.png")
    assert (np.ptp(pixels[:, :, :3], axis=2) > 0.1).sum() > 2000
    assert [
        axes.get_title("left").partition(":")[0] for axes in figure.axes[:4]
    ] == list(METHODS)


LONG_PROOF = (needs("flint"), pytest.mark.slow)


@pytest.mark.parametrize(
    ("name", "said"),
    [
        # passes no limit, which a first look cannot say
        pytest.param("time x 10", r"\d\.\de-12 rad", marks=LONG_PROOF),
        pytest.param("square wave of 2 N m", r"\d\.\de-1[56] rad", marks=LONG_PROOF),
        pytest.param(
            "stops of 1000 N m/rad",
            r"\d\.\de-12 rad",
            marks=LONG_PROOF,
        ),
        ("start at a corner that cannot be assembled", "-: there is no motion"),
        (
            "sampled PD control at 0.98 of the limit of its bandwidth",
            "-: its torques .*",
        ),
    ],
)
def test_a_case_is_proven_or_the_reason_is_said(name, said):
    assert re.fullmatch(
        said, prove_case(next(case for case in CASES if case.name == name))
    )
