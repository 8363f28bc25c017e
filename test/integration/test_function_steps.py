# SPDX-License-Identifier: Apache-2.0
"""Steps under functions: how often these are called, and what lies inside of a step."""

import math

import numpy as np
import pytest

from sst_ros import load_scene, simulate
from sst_ros.integration.function_steps import TimeSteps
from sst_ros.integration.methods import DOP853, METHODS, Tableau

SCENE = load_scene("example2_heavy")
EXPLICIT = [method for method in METHODS.values() if isinstance(method, Tableau)]


class Counted:
    """A function of the time that counts its calls."""

    def __init__(self, function):
        self.calls, self._function = 0, function

    def __call__(self, t):
        self.calls += 1
        return self._function(t)


class CountedFeedback(Counted):
    """A function of the time and the state that counts its calls."""

    def __call__(self, t, state):
        self.calls += 1
        return self._function(t, state)


def smooth(t):
    return 0.5 * math.sin(3.0 * t), 0.3 - t, 0.2 * math.exp(-t)


def clipped(t):
    return min(0.5 * math.sin(3.0 * t), 0.3), 0.3 - t, 0.2


def damped(t, state):
    first, second, third = state.joints.gamma_dot
    return 0.4 - 0.5 * first, -0.2 - 0.5 * second, 0.3 - 0.5 * third


def stepped(motion, torque, method):
    """The same samples, each by steps that end there."""
    return simulate(
        SCENE,
        torque,
        1.0,
        t_eval=motion.t,
        method=method,
        tolerance=1e-12,
        breaks=motion.t[1:-1],
    )


@pytest.mark.parametrize("method", EXPLICIT, ids=lambda method: method.name)
@pytest.mark.parametrize("function", [smooth, clipped])
def test_samples_under_a_function_of_time_are_accurate_as_steps(method, function):
    motion = simulate(SCENE, function, 1.0, method=method.name, tolerance=1e-8)
    truth = stepped(motion, function, method.name)
    np.testing.assert_allclose(motion.quaternion, truth.quaternion, atol=1e-8)
    np.testing.assert_allclose(motion.gamma_dot, truth.gamma_dot, atol=1e-7)
    np.testing.assert_array_equal(motion.torque, [function(t) for t in motion.t])


@pytest.mark.parametrize("rate", [0.5, 3.0, 30.0])
def test_samples_ask_a_smooth_function_a_few_times_in_each_step(rate):
    """Whatever their number; and each asks for the torque that it shows."""
    function = Counted(
        lambda t: (0.5 * math.sin(rate * t), 0.3 * math.cos(rate * t), 0.2)
    )
    simulate(SCENE, function, 1.0, samples=1)
    alone = function.calls
    simulate(SCENE, function, 1.0, samples=3000)
    inside = function.calls - 2 * alone - 2999
    assert 0 < inside <= 1.2 * alone


def test_equal_times_of_a_step_are_asked_for_once():
    """A step and its two halves: twelve stages each, of which five times are equal."""
    function = Counted(smooth)
    motion = simulate(SCENE, function, 1e-3, samples=1, method="dop853")
    assert motion.evaluations == 36
    assert function.calls == 36 - 3 + 2  # and the torques of two samples


def test_samples_under_a_feedback_function_cost_less_than_steps():
    function = CountedFeedback(damped)
    coarse = simulate(SCENE, function, 1.0, samples=1, method="dop853")
    alone = function.calls
    motion = simulate(SCENE, function, 1.0, samples=200, method="dop853")
    inside = function.calls - 2 * alone
    assert inside < 199 + alone
    truth = stepped(motion, damped, "dop853")
    np.testing.assert_allclose(motion.quaternion, truth.quaternion, atol=2e-9)
    np.testing.assert_array_equal(motion.quaternion[-1], coarse.quaternion[-1])


def draw_function(rng):
    """Sines, with a kink, a jump or a pulse anywhere in most of them."""
    size, rate, phase = (
        rng.uniform(-0.5, 0.5, 3),
        rng.uniform(0.0, 40.0, 3),
        rng.random(),
    )
    moment, length = rng.uniform(0.0, 1.0), 10.0 ** rng.uniform(-3.0, -0.5)
    change = [
        lambda t: 0.0,
        lambda t: max(t - moment, 0.0),
        lambda t: float(t >= moment),
        lambda t: float(moment <= t < moment + length),
    ][rng.integers(4)]
    strength = rng.uniform(0.1, 1.0)

    def function(t):
        first, second, third = (size * np.sin(rate * t + phase)).tolist()
        return first, second + strength * change(t), third

    return function


@pytest.mark.parametrize("seed", range(20))
def test_torques_for_samples_are_those_of_the_function(seed, monkeypatch):
    """In all stages of the steps to all samples."""
    rng, compared = np.random.default_rng(seed), []
    function = draw_function(rng)
    compute = TimeSteps._torques_inside

    def compare(self, steps, counts, x):
        torques = compute(self, steps, counts, x)
        begins = np.repeat([step.drive.start + step.t for step in steps], counts)
        times = begins[:, None] + np.multiply.outer(x, self.method.c)
        called = np.array([function(t) for t in times.ravel().tolist()])
        np.testing.assert_allclose(torques.reshape(-1, 3), called, rtol=0.0, atol=1e-12)
        compared.append(len(called))
        return torques

    monkeypatch.setattr(TimeSteps, "_torques_inside", compare)
    method = rng.choice([method.name for method in EXPLICIT])
    tolerance = 10.0 ** -rng.integers(4, 10)
    samples = int(10.0 ** rng.uniform(0.5, 3.0))
    simulate(SCENE, function, 1.0, samples=samples, method=method, tolerance=tolerance)
    assert sum(compared) > samples


def dense_error(h):
    """Largest error inside a step of the pendulum's linear equation, whose truth is
    known.
    """
    method, dense = DOP853, DOP853.dense

    def slope(y):
        return np.array([y[1], -y[0]])

    def truth(x):
        return np.array(
            [math.cos(x) + 0.3 * math.sin(x), 0.3 * math.cos(x) - math.sin(x)]
        )

    begin, slopes = truth(0.0), []
    for weights in method.a:
        total = sum((w * k for w, k in zip(weights, slopes, strict=True)), np.zeros(2))
        slopes.append(slope(begin + h * total))
    end = begin + h * (np.array(method.b) @ slopes)
    slopes.append(slope(end))
    for weights in dense.a:
        slopes.append(slope(begin + h * (np.array(weights) @ slopes)))
    terms = [end - begin]
    terms.append(h * slopes[0] - terms[0])
    terms.append(terms[0] - terms[1] - h * slopes[12])
    terms += [h * (np.array(weights) @ slopes) for weights in dense.weights]
    errors = []
    for share in np.linspace(0.0, 1.0, 41):
        total = np.zeros(2)
        for number in reversed(range(len(terms))):
            total = (1.0 - share if number % 2 else share) * (terms[number] + total)
        errors.append(np.abs(begin + total - truth(share * h)).max())
    return max(errors)


def test_dense_output_has_order_seven():
    errors = [dense_error(h) for h in (0.4, 0.8)]
    assert 7.6 < math.log2(errors[1] / errors[0]) < 8.4
