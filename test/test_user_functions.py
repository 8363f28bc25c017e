# SPDX-License-Identifier: Apache-2.0
"""Functions of users: their exceptions come out, and what they cost has a bound."""

import math
import random

import numpy as np
import pytest
from programs import python
from slow_cases import slow_after, slow_except

from sst_ros import Simulation, load_scene, simulate
from sst_ros.errors import InputError

SWING = load_scene("swing")


class Mine(Exception):
    """An exception of a user's own."""


def interpolate(t):
    from scipy.interpolate import interp1d

    return interp1d([0.0, 0.05], [[0.0] * 3] * 2, axis=0)(t)


def raise_mine():
    raise Mine


RAISED = {
    "interpolation range": (lambda: interpolate(0.06), ValueError),
    "division": (lambda: 1.0 / 0.0, ZeroDivisionError),
    "overflow": (lambda: math.exp(1000.0), OverflowError),
    "domain": (lambda: math.sqrt(-1.0), ValueError),
    "singular": (lambda: np.linalg.inv(np.zeros((3, 3))), np.linalg.LinAlgError),
    "stop": (lambda: next(iter(())), StopIteration),
    "key": (lambda: {}["key"], KeyError),
    "index": (lambda: [][0], IndexError),
    "attribute": (lambda: None.missing, AttributeError),
    "type": (lambda: None + 1, TypeError),
    "assertion": (lambda: pytest.fail("seen"), pytest.fail.Exception),
    "interrupt": (lambda: (_ for _ in ()).throw(KeyboardInterrupt), KeyboardInterrupt),
    "own": (raise_mine, Mine),
}


def function_of(action, late, feedback):
    """Torques that are smooth, until `action` is done at a time.

    With or without the state.
    """

    def torque(t, state=None):
        if t > late:
            action()
        return (0.1, -0.1, 0.05)

    return (lambda t, state: torque(t, state)) if feedback else (lambda t: torque(t))


def call(function, how):
    if how == "held":
        return simulate(SWING, function, 0.1, control_period=0.01)
    if how == "memoryless":
        return simulate(SWING, function, 0.1, control_period=0.01, memoryless=True)
    if how == "stepped":
        run = Simulation(SWING)
        return [run.step(function, 5_000_000) for _ in range(20)]
    return simulate(SWING, function, 0.1, method=how)


@pytest.mark.parametrize(
    "how", ["auto", "dop853", "rk4", "rodas5p", "held", "memoryless", "stepped"]
)
@pytest.mark.parametrize("name", RAISED)
def test_the_exception_of_a_function_comes_out_of_every_call(name, how):
    """At a random moment: in a first or later stage, a rejected step or a sample."""
    action, kind = RAISED[name]
    draw = random.Random(f"{name} {how}")
    for _ in range(3):
        feedback = how != "stepped" and draw.random() < 0.5
        late = draw.choice((-1.0, draw.uniform(0.0, 0.09)))
        with pytest.raises(kind) as caught:
            call(function_of(action, late, feedback), how)
        assert any(entry.name == "torque" for entry in caught.traceback)


def test_one_exception_of_a_step_comes_out_and_the_state_stays():
    calls = []

    def torque(t):
        calls.append(t)
        if len(calls) == 7:
            raise ZeroDivisionError("once")
        return (0.1, 0.0, 0.0)

    run, other = Simulation(SWING), Simulation(SWING)
    before = run.state
    with pytest.raises(ZeroDivisionError, match="once"):
        run.step(torque, 1_000_000)
    assert run.state == before
    assert run.step(torque, 1_000_000) == other.step(
        lambda t: (0.1, 0.0, 0.0), 1_000_000
    )


def test_a_result_that_is_not_finite_is_refused_or_rejects_steps():
    with pytest.raises(
        InputError, match=r"torque\(0\) = \(nan, 0, 0\): must be three finite"
    ):
        simulate(SWING, lambda t: (math.nan, 0, 0), 0.1)


def switch(t, state):
    return [-2.0 if rate > 0.0 else 2.0 for rate in state.joints.gamma_dot]


def smooth_switch(t, state):
    return [-2.0 * math.tanh(rate / 0.05) for rate in state.joints.gamma_dot]


@pytest.mark.parametrize(
    "most", [50_000, pytest.param(1_000_000, marks=pytest.mark.slow)]
)
def test_torques_that_switch_with_the_state_end_with_advice(most, monkeypatch):
    """Each second of them had no end: the steps shrink at every crossing."""
    if most != 1_000_000:
        monkeypatch.setattr("sst_ros.simulation.simulate._FUNCTION_BUDGET", most)
    motion = simulate(SWING, switch, 0.3, tolerance=1e-10)
    assert motion.status == -1 and motion.evaluations <= most
    assert (
        "give control_period" in motion.message
        and "smooth the switch" in motion.message
    )
    assert np.isfinite(motion.quaternion).all()


@pytest.mark.parametrize("method", ["dop853", "dopri5", "rodas5p"])
def test_a_budget_spent_near_a_limit_ends_a_motion_by_status(method, monkeypatch):
    """Spent by the last sample, the budget came out as an error."""

    def push(t, state):
        return 0.5 * t + 0.01 * state.joints.gamma_dot[0], 0.3, 0.2

    whole = simulate("example2_stroke", push, 2.0, method=method, tolerance=1e-4)
    assert whole.status == 1
    for most in range(whole.evaluations - 100, whole.evaluations + 1):
        monkeypatch.setattr("sst_ros.simulation.simulate._FUNCTION_BUDGET", most)
        motion = simulate("example2_stroke", push, 2.0, method=method, tolerance=1e-4)
        assert motion.status in (-1, 1)
        if motion.status == 1:  # by the last run, or by one before
            assert abs(motion.t[-1] - whole.t[-1]) < 1e-4


def test_a_looser_tolerance_costs_less():
    costs = [
        simulate(SWING, switch, 0.02, tolerance=tol).evaluations for tol in (1e-3, 1e-7)
    ]
    assert costs[0] < 0.5 * costs[1]
    assert costs[0] < 100_000


def test_the_advice_works():
    assert simulate(SWING, smooth_switch, 0.3, tolerance=1e-6).success
    held = simulate(SWING, switch, 0.3, control_period=1e-3)
    assert held.status in (0, 2) and held.t[-1] == 0.3


COLD = """
from concurrent.futures import ThreadPoolExecutor
from sst_ros import simulate, Simulation

def run(number):
    motion = simulate("friction", duration=0.05)
    step = Simulation("friction").step((0.1, 0.0, -0.1), 1_000_000)
    return motion.quaternion.tobytes(), motion.gamma_dot.tobytes(), step

with ThreadPoolExecutor(8) as pool:
    results = list(pool.map(run, range(8)))
assert all(result == results[0] for result in results)
assert run(0) == results[0]
print("same")
"""


@pytest.mark.parametrize("attempt", slow_after(1, range(3)))
def test_the_first_use_may_be_in_threads_of_a_new_process(attempt):
    assert python(COLD).stdout.strip() == "same"


@pytest.mark.parametrize(
    "name", slow_except(["no HOME"], ["plain", "no HOME", "read-only HOME"])
)
def test_a_new_process_needs_no_home(name, tmp_path):
    environments = {
        "plain": {},
        "no HOME": {"HOME": ""},
        "read-only HOME": {"HOME": "/proc"},
    }
    code = "import sst_ros; print(sst_ros.simulate('swing', duration=0.1).status)"
    assert python(code, env=environments[name]).stdout.strip() == "0"


def test_steps_under_two_drives_cost_what_they_evaluate():
    def hold(t, state):
        return 0.1, 0.2, -0.1

    runs = [
        simulate(SWING, hold, 0.1, control_period=0.01, memoryless=memoryless)
        for memoryless in (False, True)
    ]
    assert runs[0].quaternion.tolist() == runs[1].quaternion.tolist()
    assert runs[0].evaluations == runs[1].evaluations
