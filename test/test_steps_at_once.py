# SPDX-License-Identifier: Apache-2.0
"""Many ticks in one call: the bits, the faults and the book-keeping of one tick at a time."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
from loaded_scenes import loaded, viscous

from sst_ros.errors import RunStopped, StrokeExceeded
from sst_ros.integration.codegen import numba_version
from sst_ros.integration.compiled_method import CompiledMethod
from sst_ros.scene.scene import Initial, Workspace, load
from sst_ros.simulation.simulation import Simulation

MILLISECOND = 1_000_000
TORQUES = ((0.3, -0.2, 0.1), (-1.5, 0.5, 2.0), (0.0, 0.0, 0.0), (4.0, 4.0, -4.0))

INWARDS = {
    "initial": Initial(gamma=(0.1, 0.8, 0.8), gamma_dot=(-2.0, 0.5, 0.1)),
    "workspace": Workspace(at_edge="ignore"),
}
CASES = {
    "example2_heavy": (load("example2_heavy"), {}),
    "loaded": (loaded(), {}),
    "elastic": (replace(load("elastic_stops"), **INWARDS), {}),
    "stiff": (viscous(300.0), {"tolerance": 1e-9}),
    "rodas4": (viscous(3.0), {"integrator": "rodas4", "tolerance": 1e-8}),
    "rk4": (load("example2_heavy"), {"integrator": "rk4"}),
}
needs_numba = pytest.mark.skipif(numba_version() is None, reason="numba is missing")
BY_NUMBA = [
    pytest.param(name, marks=() if name == "example2_heavy" else pytest.mark.slow) for name in CASES
]


@pytest.fixture
def glided(monkeypatch):
    """Count the ticks that were done without a look at each."""
    counts, step_many = [], CompiledMethod.step_many

    def counted(self, h, count, *more):
        found = step_many(self, h, count, *more)
        counts.append((count, found[0]))
        return found

    monkeypatch.setattr(CompiledMethod, "step_many", counted)
    return counts


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


def run(scene, at_once, ticks, **how):
    """Ticks under torques that change every 60, `at_once` in a call; also what ended it."""
    simulation = Simulation(scene, **how)
    for k in range(0, ticks, at_once):
        try:
            simulation.steps(TORQUES[k // 60 % 4], MILLISECOND, at_once)
        except RunStopped as error:
            return told(simulation), str(error), error.time
    return told(simulation), None, None


def held_against_single_ticks(name, ticks, glided, *, compiled):
    scene, how = CASES[name]
    one = run(scene, 1, ticks, compiled=compiled, **how)
    assert max(done for _, done in glided) == 1
    glided.clear()
    for at_once in (20, 60):
        assert run(scene, at_once, ticks, compiled=compiled, **how) == one
    if name in ("example2_heavy", "loaded", "rk4"):
        assert (60, 60) in glided
    if name == "elastic":
        assert any(0 < done < count for count, done in glided)
    return one


@pytest.mark.parametrize("name", CASES)
def test_the_bits_do_not_depend_on_how_many_ticks_go_into_a_call(name, glided):
    held_against_single_ticks(name, 120, glided, compiled=False)


@needs_numba
@pytest.mark.parametrize("name", BY_NUMBA)
def test_numba_gives_the_bits_of_plain_python_however_many_ticks(name, glided):
    fast = held_against_single_ticks(name, 120, glided, compiled=True)
    assert fast == run(CASES[name][0], 20, 120, compiled=False, **CASES[name][1])


@pytest.mark.parametrize("compiled", [False, pytest.param(True, marks=needs_numba)])
def test_a_fault_comes_at_its_tick_with_the_last_valid_state(compiled):
    ends = []
    for at_once in (1, 50):
        simulation = Simulation(load("example2_heavy"), compiled=compiled)
        with pytest.raises(StrokeExceeded) as caught:
            for _ in range(10_000):
                simulation.steps((8.0, 0.0, 0.0), MILLISECOND, at_once)
        assert caught.value.state is simulation.state
        assert 0.0 <= caught.value.time - simulation.time_ns / 1e9 <= 1e-3
        ends.append((told(simulation), caught.value.time))
    assert ends[0] == ends[1]
    assert ends[0][0][0].time_ns % (50 * MILLISECOND)


@pytest.mark.parametrize("compiled", [False, pytest.param(True, marks=needs_numba)])
def test_a_turn_beyond_an_end_is_seen_though_the_step_begins_and_ends_inside(compiled):
    scene = replace(
        load("example2_heavy"),
        initial=Initial(gamma=(math.pi / 2 - 0.005, 0.4, 1.0), gamma_dot=(0.5, 0.0, 0.0)),
        workspace=Workspace(at_edge="ignore"),
    )
    fine = Simulation(scene, "dop853", compiled=compiled)
    with pytest.raises(StrokeExceeded) as expected:
        fine.steps((-10.0, 0.0, 0.0), MILLISECOND, 45)
    whole = Simulation(scene, "dop853", tolerance=1e-6, compiled=compiled)
    with pytest.raises(StrokeExceeded) as found:
        whole.step((-10.0, 0.0, 0.0), 45 * MILLISECOND)
    assert found.value.time == pytest.approx(expected.value.time, abs=1e-6)


def test_a_state_within_ticks_that_were_done_at_once_is_on_the_way():
    one, other = (Simulation(load("example2_heavy")) for _ in range(2))
    one.steps((1.0, 2.0, 3.0), MILLISECOND, 20)
    other.step((1.0, 2.0, 3.0), 7 * MILLISECOND)
    found = one.within(7 * MILLISECOND)
    assert found.joints.gamma == pytest.approx(other.state.joints.gamma, abs=1e-12)
    assert one.state.time_ns == 20 * MILLISECOND
