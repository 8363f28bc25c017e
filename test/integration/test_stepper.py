# SPDX-License-Identifier: Apache-2.0
"""The loop: choice of method, work bounds, budgets, many ticks in a call with the bits
of each.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from loaded_scenes import IGNORE, REST, loaded, run, viscous
from slow_cases import slow_after

from benchmark.plain_python import without_llvmlite
from sst_ros.errors import (
    Diverged,
    InputError,
    RunStopped,
    StepBudgetExceeded,
    StrokeExceeded,
)
from sst_ros.integration.method_steps import PERIODS_AT_ONCE, MethodSteps
from sst_ros.integration.stepper import Stepper
from sst_ros.scene.bodies import Inertia, Link, Workspace
from sst_ros.scene.loads import Friction, Initial, JointFriction
from sst_ros.scene.scene import load
from sst_ros.simulation.simulation import Simulation

EXAMPLE2 = load("example2_heavy")
MILLISECOND = 1_000_000


@pytest.fixture
def pairs(monkeypatch):
    """Count attempts by method.

    A pair of Rodas5P makes 3 Jacobians and 24 evaluations.
    """
    counts = {}
    attempt = MethodSteps.pair

    def counted(self, *arguments, **options):
        counts[self.method.name] = counts.get(self.method.name, 0) + 1
        return attempt(self, *arguments, **options)

    monkeypatch.setattr(MethodSteps, "pair", counted)
    return counts


@pytest.mark.parametrize("coefficient", [1e3, 1e4, 1e5])
def test_a_stiff_second_takes_few_steps_whatever_the_stiffness(coefficient, pairs):
    """Steps an explicit method would need for stability grow with the coefficient."""
    simulation = Simulation(viscous(coefficient), tolerance=1e-10, step_budget=10**6)
    simulation.step(REST, 1_000_000_000)
    assert simulation.method == "rodas5p"
    fastest = np.abs(
        simulation._stepper.ode.eigenvalues(0.0, simulation._current.point.y, REST)
    ).max()
    explicit = fastest / 3.3  # DOPRI5 is stable on the negative axis up to about 3.3
    assert explicit > 0.6 * coefficient
    assert pairs["rodas5p"] < min(350, explicit / 2)
    assert simulation.accepted_steps < (100 if coefficient == 1e5 else 300)
    assert pairs.get("dopri5", 0) + pairs.get("dop853", 0) < 60


def test_a_reset_run_repeats_bit_by_bit_after_changes_of_method():
    simulation = Simulation(load("stiff"), tolerance=1e-9)
    ends = []
    for _ in range(2):
        run(simulation, 0.05, 0.01)
        ends.append((simulation.state, simulation.changes, simulation.error_estimate))
        simulation.reset()
        assert simulation.changes == []
    assert ends[0] == ends[1]
    assert ends[0][1]


def light(about_z, across=1.0):
    """A star without links that a small torque spins to 1e7 rad/s in a millisecond."""
    links = (Link(),) * 3
    star = replace(EXAMPLE2.star, inertia=Inertia(xx=across, yy=across, zz=about_z))
    return replace(
        EXAMPLE2, star=star, actuated_links=links, intermediate_links=links, **IGNORE
    )


def rubbing(coulomb, smoothing):
    friction = JointFriction(gamma=Friction(coulomb=coulomb, smoothing=smoothing))
    return replace(load("friction"), friction=friction)


TOO_FAST = {
    "light star": (light(1e-12), (0.01, 0.01, 0.01)),
    "huge torque": (light(0.2, 0.3), (1e9, 1e9, 1e9)),
    "light, thin star": (light(1e-12, 1e-6), (0.01, 0.01, 0.01)),
}


@pytest.mark.parametrize(("scene", "torque"), TOO_FAST.values(), ids=[*TOO_FAST])
def test_a_step_that_takes_too_much_keeps_the_last_valid_state(scene, torque, pairs):
    """These steps took 73, 10 and 2.7 s before there was a budget."""
    simulation = Simulation(scene)
    before = simulation.state
    with pytest.raises(
        StepBudgetExceeded, match=f"{simulation.step_budget} evaluations"
    ) as e:
        simulation.step(torque, MILLISECOND)
    assert isinstance(e.value, Diverged) and e.value.state == before == simulation.state
    assert simulation.evaluations <= simulation.step_budget
    assert sum(pairs.values()) < simulation.step_budget / 20  # one makes at least 20
    simulation.step(REST, MILLISECOND)  # it can go on
    assert simulation.time_ns == MILLISECOND


@pytest.mark.parametrize(
    ("coulomb", "smoothing"),
    [(1e9, 1e-9), (5.0, 1e-12)],
    ids=["1e9 N m", "1e-12 rad/s"],
)
def test_sharp_coulomb_friction_is_stiff_from_the_first_step(coulomb, smoothing):
    """These steps took 18 and 2.1 s: explicit steps shrank before the spectrum was
    asked for.
    """
    simulation = Simulation(rubbing(coulomb, smoothing))
    for _ in range(3):
        simulation.step((1.0, 2.0, -1.0), MILLISECOND)
        assert simulation.method == "rodas5p"
    # Friction holds: creep at rates of smoothing tau / coulomb.
    state = simulation.state
    assert max(map(abs, state.joints.gamma_dot)) < smoothing
    assert simulation.error_estimate < 1e-12


def test_the_budget_is_an_argument():
    simulation = Simulation(EXAMPLE2, step_budget=10)
    with pytest.raises(StepBudgetExceeded, match="10 evaluations do not reach the end"):
        simulation.step((1.0, 1.0, 1.0), 100 * MILLISECOND)
    with pytest.raises(InputError, match="step_budget = 0: must be > 0"):
        Simulation(EXAMPLE2, step_budget=0)


# Many ticks in one call: the bits, the faults and the book-keeping of one tick at a
# time.

TORQUES = ((0.3, -0.2, 0.1), (-1.5, 0.5, 2.0), (0.0, 0.0, 0.0), (4.0, 4.0, -4.0))

INWARDS = {
    "initial": Initial(gamma=(0.1, 0.8, 0.8), gamma_dot=(-2.0, 0.5, 0.1)),
    "workspace": Workspace(at_edge="ignore"),
}
CASES = {
    "example2_heavy": (EXAMPLE2, {}),
    "loaded": (loaded(), {}),
    "elastic": (replace(load("elastic_stops"), **INWARDS), {}),
    "stiff": (viscous(300.0), {"tolerance": 1e-9}),
    "rodas5p": (viscous(3.0), {"integrator": "rodas5p", "tolerance": 1e-8}),
    "rk4": (EXAMPLE2, {"integrator": "rk4"}),
    "steps in a tick": (load("swing"), {"tick": 20 * MILLISECOND}),
}


def told(simulation):
    """All that a run says of itself."""
    return (
        simulation.state,
        simulation.error_estimate,
        simulation.rate_error_estimate,
        simulation.energy_residual,
        simulation.changes,
        simulation.method,
        simulation.accepted_steps,
    )


def run_ticks(scene, at_once, ticks, tick=MILLISECOND, **how):
    """Ticks under torques that change every 60, `at_once` in a call.

    Also what ended it.
    """
    simulation = Simulation(scene, **how)
    for k in range(0, ticks, at_once):
        try:
            simulation.steps(TORQUES[k // 60 % 4], tick, at_once)
        except RunStopped as error:
            return told(simulation), str(error), error.time
    return told(simulation), None, None


@pytest.mark.parametrize("name", slow_after(2, CASES))
def test_the_bits_do_not_depend_on_how_many_ticks_go_into_a_call(name):
    scene, how = CASES[name]
    single = run_ticks(scene, 1, 120, **how)
    for at_once in (20, 60):
        assert run_ticks(scene, at_once, 120, **how) == single


@pytest.mark.parametrize("seed", range(12))
def test_ticks_of_random_runs_may_go_into_any_number_of_calls(seed):
    rng = np.random.default_rng(seed)
    scene = load(str(rng.choice(["swing", "example2_heavy", "elastic_stops"])))
    torque = tuple(rng.uniform(-3.0, 3.0, 3).tolist())
    tick = int(10 ** rng.uniform(4, 7.3))
    how = {
        "integrator": str(rng.choice(["auto", "dopri5", "dop853", "rk4"])),
        "tolerance": 10 ** rng.uniform(-13, -5),
        "step_budget": int(10 ** rng.uniform(1.3, 4)),
    }
    ends = []
    for most in (1, 16, 17, 64, 200):
        simulation = Simulation(scene, **how)
        stop = None
        left = 200
        while left and stop is None:
            count = min(most, left)
            try:
                simulation.steps(torque, tick, count)
            except RunStopped as error:
                stop = type(error), str(error), error.time
            left -= count
        # what a refused period has spent is charged, too
        ends.append((told(simulation), stop, simulation.evaluations))
    assert ends == ends[:1] * len(ends)


def test_even_ticks_need_no_loop_of_their_own(monkeypatch):
    simulation = Simulation("swing")
    monkeypatch.delattr(Stepper, "advance")
    simulation.steps((0.1, 0.0, 0.0), MILLISECOND, 4 * PERIODS_AT_ONCE)
    assert simulation.accepted_steps == 4 * PERIODS_AT_ONCE


@pytest.mark.parametrize("name", CASES)
def test_machine_code_gives_the_bits_of_plain_python(name):
    pytest.importorskip("llvmlite", reason="needs llvmlite: pip install .[fast]")
    scene, how = CASES[name]
    fast = run_ticks(scene, 60, 120, **how)
    with without_llvmlite():
        assert run_ticks(scene, 60, 120, **how) == fast


def test_a_fault_comes_at_its_tick_with_the_last_valid_state():
    ends = []
    for at_once in (1, 50):
        simulation = Simulation(EXAMPLE2)
        with pytest.raises(StrokeExceeded) as caught:
            for _ in range(10_000):
                simulation.steps((8.0, 0.0, 0.0), MILLISECOND, at_once)
        assert caught.value.state is simulation.state
        assert 0.0 <= caught.value.time - simulation.time_ns / 1e9 <= 1e-3
        ends.append((told(simulation), caught.value.time))
    assert ends[0] == ends[1]
    assert ends[0][0][0].time_ns % (50 * MILLISECOND)


def test_a_turn_beyond_an_end_is_seen_within_a_step():
    scene = replace(
        EXAMPLE2,
        initial=Initial(
            gamma=(math.pi / 2 - 0.005, 0.4, 1.0), gamma_dot=(0.5, 0.0, 0.0)
        ),
        workspace=Workspace(at_edge="ignore"),
    )
    fine = Simulation(scene, "dop853")
    with pytest.raises(StrokeExceeded) as expected:
        fine.steps((-10.0, 0.0, 0.0), MILLISECOND, 45)
    whole = Simulation(scene, "dop853", tolerance=1e-6)
    with pytest.raises(StrokeExceeded) as found:
        whole.step((-10.0, 0.0, 0.0), 45 * MILLISECOND)
    assert found.value.time == pytest.approx(expected.value.time, abs=1e-6)


def test_a_state_within_ticks_done_at_once_is_on_the_way():
    one, other = (Simulation(EXAMPLE2) for _ in range(2))
    one.steps((1.0, 2.0, 3.0), MILLISECOND, 20)
    other.step((1.0, 2.0, 3.0), 7 * MILLISECOND)
    found = one.within(7 * MILLISECOND)
    assert found.joints.gamma == pytest.approx(other.state.joints.gamma, abs=1e-12)
    assert one.state.time_ns == 20 * MILLISECOND
