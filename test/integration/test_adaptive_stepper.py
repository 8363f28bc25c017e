# SPDX-License-Identifier: Apache-2.0
"""Choice of method and step: work bounds, switches told, resets and budgets."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from loaded_scenes import IGNORE, REST, run, viscous

from sst_ros.errors import Diverged, StepBudgetExceeded, StrokeExceeded
from sst_ros.integration.compiled_method import CompiledMethod
from sst_ros.scene.scene import Initial, Stroke, Workspace, load
from sst_ros.simulation.simulation import Simulation

EXAMPLE2 = load("example2_heavy")
MILLISECOND = 1_000_000


@pytest.fixture
def pairs(monkeypatch):
    """Count attempts by method; a pair of RODAS4 makes 3 Jacobians and 18 evaluations."""
    counts = {}
    attempt = CompiledMethod.step_pair

    def counted(self, *arguments):
        counts[self.method.name] = counts.get(self.method.name, 0) + 1
        return attempt(self, *arguments)

    monkeypatch.setattr(CompiledMethod, "step_pair", counted)
    return counts


@pytest.mark.parametrize("coefficient", [1e3, 1e4, 1e5])
def test_a_stiff_second_takes_few_steps_whatever_the_stiffness(coefficient, pairs):
    """Steps that an explicit method would need for stability grow with the coefficient."""
    simulation = Simulation(viscous(coefficient), tolerance=1e-10, step_budget=10**6)
    simulation.step(REST, 1_000_000_000)
    assert simulation.method == "rodas4"
    fastest = np.abs(
        simulation._propagator.ode.eigenvalues(0.0, simulation._now.point.y, REST)
    ).max()
    explicit = fastest / 3.3  # DOPRI5 is stable on the negative axis up to about 3.3
    assert explicit > 0.6 * coefficient
    assert pairs["rodas4"] < min(350, explicit / 2)
    assert simulation.accepted_steps < (100 if coefficient == 1e5 else 300)
    assert pairs.get("dopri5", 0) + pairs.get("dop853", 0) < 60


def test_auto_returns_to_an_explicit_method_when_accuracy_asks_for_short_steps():
    """A torque that starts anew every 200 microseconds makes steps shorter than the decay."""
    simulation = Simulation(viscous(30.0, 5.0), tolerance=1e-9)
    for _ in range(10):
        simulation.step(REST, 100 * MILLISECOND)
    assert simulation.method == "rodas4"
    for _ in range(80):
        simulation.step((20.0, -20.0, 5.0), 200_000)
    last = simulation.changes[-1]
    assert last.method == "dopri5"
    assert last.reason.startswith("no longer stiff: step times rate is ")
    assert 1.0 < last.time < 1.02


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


def test_a_refused_step_leaves_no_trace_in_what_follows():
    one, other = Simulation(EXAMPLE2), Simulation(EXAMPLE2)
    with pytest.raises(Diverged):
        one.step((1e308, 0.0, 1e308), MILLISECOND)
    for simulation in (one, other):
        simulation.step((1.0, 2.0, 3.0), MILLISECOND)
    assert one.state == other.state
    assert one.changes == other.changes


def test_a_budget_of_evaluations_ends_what_would_not_end():
    simulation = Simulation(viscous(1e5), "dopri5", step_budget=1000)
    with pytest.raises(StepBudgetExceeded, match="1000 evaluations do not reach") as caught:
        simulation.step(REST, 1_000_000_000)
    assert caught.value.state is simulation.state
    assert simulation.state.time_ns == 0


def test_a_dip_beyond_an_end_inside_one_period_is_not_missed():
    """Braked so that gamma_1 goes less than a milliradian beyond and is back in the period."""
    free = Simulation(
        replace(
            EXAMPLE2, initial=Initial(gamma=(0.013, 0.5, 0.5), gamma_dot=(-0.5, 0.0, 0.0)), **IGNORE
        )
    )
    angles = []
    for _ in range(200):
        angles.append(free.step((3.0, 0.0, 0.0), MILLISECOND).joints.gamma[0])
    assert min(angles) < -1e-4
    assert angles[-1] > 0.05
    stopping = Simulation(
        replace(free.scene, stroke=Stroke(), workspace=Workspace(at_edge="ignore"))
    )
    with pytest.raises(StrokeExceeded, match="gamma_1 < 0") as caught:
        stopping.step((3.0, 0.0, 0.0), 200 * MILLISECOND)
    first = next(k for k, angle in enumerate(angles, 1) if angle < 0.0)
    assert (first - 1) * 1e-3 <= caught.value.time <= first * 1e-3
