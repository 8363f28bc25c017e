# SPDX-License-Identifier: Apache-2.0
"""The catalogue of stiff and extreme cases, and those that need mpmath or singular
poses.
"""

from __future__ import annotations

import math
import time
from dataclasses import replace
from types import SimpleNamespace

import mpmath
import numpy as np
import pytest
from loaded_scenes import REST
from models import inertia_of
from slow_cases import slow_after

from sst_ros.dynamics import kernel
from sst_ros.errors import AssemblyError, RunStopped, SingularConfiguration, SstError
from sst_ros.mechanism.geometry import quaternion_of
from sst_ros.scene.loads import Initial
from sst_ros.scene.scene import load
from sst_ros.simulation.simulate import simulate
from sst_ros.simulation.simulation import Simulation
from studies import extreme
from studies.extreme import FACTOR, estimate_check, evaluate_case, run_case
from studies.extreme_cases import LOOSE, Case, apart, catalogue, tight_end
from studies.extreme_scenes import (
    about_e,
    bouncing_thrice,
    changed,
    near_singularity,
    singular_pose,
)

CASES = [case for case in catalogue() if not case.long]
EXAMPLE2 = load("example2_heavy")
LONGEST = 60.0
"""Seconds for any case on a busy machine: what must not happen is an endless loop."""


def finite(state):
    joints = [x for triple in state.joints for x in triple]
    return all(map(math.isfinite, (*state.quaternion, *state.body_rate, *joints)))


@pytest.mark.parametrize(
    "case",
    [
        pytest.param(case, marks=pytest.mark.slow if number % 9 else (), id=case.name)
        for number, case in enumerate(CASES)
    ],
)
def test_each_case_of_the_catalogue_has_its_value_or_its_refusal(case):
    began = time.perf_counter()
    done = run_case(case)
    assert time.perf_counter() - began < LONGEST
    if done.simulation is not None:
        assert finite(done.simulation.state)
        assert all(map(math.isfinite, done.simulation.conditioning.values()))
        assert math.isfinite(done.simulation.error_estimate)
    assert type(done.error).__name__ == (case.refusal or "NoneType"), str(done.error)
    if case.deviation is not None:
        assert case.deviation(case, done.simulation) < case.bound
    check = estimate_check(case, done)
    assert check.holds, check.verdict
    if check.true is None:
        assert check.verdict.startswith("none: ")
    elif check.true >= extreme.ROUNDING:
        assert check.true / FACTOR <= check.estimate <= FACTOR * check.true
    if isinstance(done.error, RunStopped):
        assert done.error.state is done.simulation.state
    if case.stop_time is not None:
        assert done.error.time == pytest.approx(case.stop_time(), rel=1e-10, abs=0.0)


@pytest.mark.slow
@pytest.mark.parametrize(
    "name",
    slow_after(
        1, ["three simultaneous contacts", "sharp Coulomb friction and three contacts"]
    ),
)
def test_three_contacts_are_three(name):
    (case,) = (case for case in CASES if case.name == name)
    motion = simulate(
        case.scene(), case.torque, case.steps * case.period_ns / 1e9, samples=2000
    )
    beyond = (motion.gamma > np.pi / 2) | (motion.gamma < 0.0)
    assert (beyond[1:] & ~beyond[:-1]).sum(axis=0).tolist() == [1, 1, 1]


def named(name):
    return next(case for case in CASES if case.name == name)


def test_forty_contacts_multiply_differences():
    """Why their error estimate is not checked: 5e5 times in half of the run."""
    changes = bouncing_thrice(1e4, 20.0)
    first, second, third = changes["initial"]["gamma"]
    other = {**changes["initial"], "gamma": (first + 1e-10, second, third)}
    ends = [
        tight_end(Case("", {**changes, "initial": initial}, REST, 5, 100_000_000))
        for initial in (changes["initial"], other)
    ]
    assert apart(*ends) > 1e5 * 1e-10


def test_an_error_estimate_that_is_far_off_fails_a_case(monkeypatch):
    case = named("time x 10")
    good = evaluate_case(case, plain=False)
    assert good.passed and good.run_loop and good.loose_error > 1e-3 * LOOSE
    distance = extreme.apart
    for factor in (0.01, 100.0):
        monkeypatch.setattr(
            extreme, "apart", lambda *ends, f=factor: f * distance(*ends)
        )
        bad = evaluate_case(case, plain=False)
        assert not bad.passed and "of the true error" in bad.result


def test_an_estimate_of_an_error_that_is_not_resolved_is_bounded(monkeypatch):
    case = named("base triangle of 0.1 rad")
    done = run_case(case)
    assert estimate_check(case, done).holds
    monkeypatch.setattr(Simulation, "error_estimate", 1e-9)
    monkeypatch.setattr(extreme, "ROUNDING", 1e-11)
    end = {name: getattr(done.simulation, name) for name in ("time_ns", "state")}
    accurate = SimpleNamespace(error_estimate=0.0, **end)
    assert not estimate_check(case, done._replace(simulation=accurate)).holds


LOOPED = (
    "time x 1e-06", "pushed outwards at an end of the stroke",
    "noise of 1 N m at 10 kHz", "control period of 333333 ns",
    "sampled PD control at 0.98 of the limit of its bandwidth",
    "three simultaneous contacts", "torque of 1e8 N m into a serial singularity",
)  # fmt: skip


@pytest.mark.parametrize("name", LOOPED)
def test_the_run_loop_ends_in_the_same_bits(name):
    direct, looped = run_case(named(name)), run_case(named(name), looped=True)
    assert looped.simulation.state == direct.simulation.state
    assert str(looped.error) == str(direct.error)


def test_a_run_loop_that_differs_fails_a_case(monkeypatch):
    case = named("control period of 333333 ns")
    shorter = replace(case, steps=case.steps - 1)
    monkeypatch.setattr(
        extreme,
        "run_case",
        lambda case, looped=False, **_: run_case(shorter if looped else case),
    )
    bad = evaluate_case(case, plain=False)
    assert (
        not bad.passed
        and bad.run_loop is False
        and "the run loop differs" in bad.result
    )


@pytest.mark.parametrize("scale", [1e-9, 1e-4, 1e4, 1e9])
def test_accelerations_at_any_ratio_of_inertias_are_mpmaths(scale):
    """M is a sum of positive terms up to 1e9 apart; what counts is the largest part."""
    scene = replace(
        EXAMPLE2,
        star=replace(
            EXAMPLE2.star, inertia=inertia_of(np.diag([0.39, 0.39, 0.26]) * scale)
        ),
    )
    simulation = Simulation(replace(scene, initial=Initial(gamma=(0.7, 0.8, 0.75))))
    y = (*simulation.state.quaternion, 0.3, -0.2, 0.4)
    model, torque = kernel.model_of(scene), (1.0, 2.0, -1.0)
    got = simulation.dynamics.derivative(*y, *torque)[4:7]
    with mpmath.workdps(50):
        exact = tuple(map(mpmath.mpf, y))
        truth = kernel.derivative(model, exact, tuple(map(mpmath.mpf, torque)))[4:7]
    wanted = [float(x) for x in truth]
    np.testing.assert_allclose(got, wanted, rtol=0, atol=1e-13 * np.abs(wanted).max())


def started(angle, spin):
    """Start about E beside a singular pose, with angular velocity about E [rad/s]."""
    return Simulation(changed(near_singularity(angle, spin)))


def test_rest_at_a_parallel_singularity_is_taken_and_stays():
    """There gamma tells the pose only to the root of rounding: two assemblies meet."""
    simulation = started(0.0, 0.0)
    assert abs(simulation.conditioning["det_j2"]) < 1e-7
    at = quaternion_of(singular_pose())
    assert np.abs(np.array(simulation.state.quaternion) - at).max() < 1e-7
    for _ in range(10):
        simulation.step(REST, 1_000_000)
    assert simulation.state.body_rate == REST


def test_a_moving_start_at_a_parallel_singularity_is_refused():
    """From gamma_dot alone the body rate came out as (1, -2.3, 1.9) rad/s, not (0, 0,
    1).
    """
    with pytest.raises(
        SingularConfiguration, match="does not determine the body rate"
    ) as caught:
        started(0.0, 1.0)
    assert abs(caught.value.measure) < 1e-7


@pytest.mark.parametrize("distance", [-0.03, 0.08, 0.2])
def test_a_moving_start_that_is_taken_has_the_rate_that_is_meant(distance):
    rate = started(distance, 1.0).state.body_rate
    np.testing.assert_allclose(rate, (0.0, 0.0, 1.0), rtol=0, atol=1e-6)


@pytest.mark.parametrize("distance", [1e-3, 1e-6, 1e-9])
def test_starts_near_a_parallel_singularity_are_right_or_refused(distance):
    try:
        simulation = started(distance, 0.0)
    except SstError as error:
        assert isinstance(error, AssemblyError)
        return
    # gamma determines the pose to rounding / distance there.
    at = quaternion_of(singular_pose() @ about_e(distance))
    assert np.abs(np.array(simulation.state.quaternion) - at).max() < 1e-14 / distance
