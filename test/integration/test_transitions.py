# SPDX-License-Identifier: Apache-2.0
"""Steps do not leap over the rates within which Coulomb friction changes its sign.

Cases 43 and 11 of the class "sharp friction", seed 1, of `studies.estimate`. Truth:
SciPy's DOP853 in plain Python, with the hyperbolic tangent of the C library.
"""

import math

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from slow_cases import slow_after

from sst_ros import load_scene, simulate
from sst_ros.dynamics import kernel
from sst_ros.dynamics.initial_state import start_of
from sst_ros.dynamics.model import transitions_of
from sst_ros.integration.events import (
    largest_passed,
    share_before_leap,
)
from sst_ros.mechanism.geometry import angle_between
from studies.estimate import CLASSES

END = 0.3


def case_of(number):
    rng = np.random.default_rng([1, number, *b"sharp_friction"])
    rng.choice(5), rng.uniform()  # method and tolerance, given below
    return CLASSES["sharp_friction"](rng)


def truth_of(case, monkeypatch):
    model, sine = kernel.model_of(case.scene), case.torque

    def slope(t, y):
        rows = zip(sine.amplitude, sine.frequency, sine.phase, strict=True)
        torque = [size * math.sin(rate * t + phase) for size, rate, phase in rows]
        return kernel.derivative(model, tuple(y.tolist()), torque)

    start = np.array(start_of(case.scene)[:7])
    with monkeypatch.context() as patch:
        patch.setattr(kernel, "tanh", math.tanh)
        exact = solve_ivp(
            slope, (0.0, END), start, "DOP853", rtol=1e-13, atol=1e-14, max_step=1e-3
        )
    return exact.y[:4, -1]


@pytest.mark.parametrize(
    ("number", "method", "tolerance"),
    slow_after(
        1, [(11, "dop853", 3.576108161385493e-10), (43, "auto", 1.9413158686750797e-05)]
    ),
)
def test_the_estimate_covers_the_error_where_friction_is_sharp(
    number, method, tolerance, monkeypatch
):
    """Where steps leapt over the change, it was 0.65 and 0.88 of the error."""
    case = case_of(number)
    found = simulate(
        case.scene,
        case.torque,
        END,
        t_eval=[END],
        method=method,
        tolerance=tolerance,
    )
    error = angle_between(found.quaternion[-1], truth_of(case, monkeypatch))
    assert found.status == 0
    assert 1.5 * error < found.error_estimate < 3.0 * error
    assert error < tolerance


def test_only_joints_with_dry_friction_have_transitions():
    kept = transitions_of(load_scene("friction"), 1e-8)
    assert [each.rate for each in kept] == [9, 10, 11, 12, 13, 14]
    assert 1.0 - math.tanh(kept[0].edge / 0.02) == pytest.approx(1e-8, rel=1e-6)
    assert transitions_of(load_scene("example2"), 1e-8) == ()
    assert transitions_of(load_scene("friction"), 1e300) == ()  # steps of RK4
    sharp = {"friction.gamma.smoothing": 1e-8}
    finer = load_scene("friction").with_values(sharp)  # than local errors
    assert [each.rate for each in transitions_of(finer, 1e-6)] == [12, 13, 14]


@pytest.mark.parametrize(
    ("before", "after", "leaps"),
    [(9.0, -9.0, True), (-9.0, 9.0, True), (9.0, 0.0, True), (0.0, 9.0, True),
     (9.0, 5.0, False), (-5.0, -9.0, False), (0.01, -0.01, False)],
)  # fmt: skip
def test_a_step_leaps_if_it_passes_more_than_the_width(before, after, leaps):
    transitions = transitions_of(load_scene("friction"), 1e-8)
    begin, end = [0.0] * 18, [0.0] * 18
    begin[10], end[10] = before, after
    assert (largest_passed(transitions, begin, end) > 1.0) == leaps
    if leaps:
        share = share_before_leap(transitions, begin, end)
        assert 0.0 < share < 1.0
        end[10] = before + share * (after - before)
        assert 0.0 < largest_passed(transitions, begin, end) < 1.0


def test_a_joint_that_rests_between_steps_costs_few_evaluations():
    """Rates that fall and then stay are far from linear: a leap is halved."""
    friction = {"gamma": {"coulomb": 0.5, "smoothing": 1e-4, "viscous": 0.1}}
    start = {"initial.gamma_dot": (0.05, -0.03, 0.04)}
    scene = load_scene("example2").with_values({"friction": friction, **start})
    found = simulate(scene, (0.0, 0.0, 0.0), 1.0, samples=1, tolerance=1e-6)
    assert found.status == 0
    assert abs(found.body_rate[-1]).max() < 1e-6
    assert found.evaluations < 30_000
