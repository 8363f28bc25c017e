# SPDX-License-Identifier: Apache-2.0
"""Choice of method and step: work bounds, switches told, resets, and budgets: every step ends."""

from __future__ import annotations

import time
from dataclasses import replace

import numpy as np
import pytest
from loaded_scenes import IGNORE, REST, run, viscous

from sst_ros.errors import Diverged, InputError, StepBudgetExceeded
from sst_ros.integration.codegen import numba_version
from sst_ros.integration.compiled_method import CompiledMethod
from sst_ros.integration.methods import DORMAND_PRINCE
from sst_ros.scene.loads import Friction, JointFriction
from sst_ros.scene.scene import Inertia, Link, load
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
    return replace(EXAMPLE2, star=star, actuated_links=links, intermediate_links=links, **IGNORE)


def rubbing(coulomb, smoothing):
    friction = JointFriction(gamma=Friction(coulomb=coulomb, smoothing=smoothing))
    return replace(load("friction"), friction=friction)


TOO_FAST = {
    "light star": (light(1e-12), (0.01, 0.01, 0.01), False),
    "huge torque": (light(0.2, 0.3), (1e9, 1e9, 1e9), False),
    "light star, compiled": (light(1e-12, 1e-6), (0.01, 0.01, 0.01), True),
}


@pytest.mark.parametrize(("scene", "torque", "compiled"), TOO_FAST.values(), ids=TOO_FAST)
def test_a_step_that_takes_too_much_ends_with_the_last_valid_state(scene, torque, compiled):
    """These steps took 73, 10 and 2.7 s before there was a budget."""
    if compiled and numba_version() is None:
        pytest.skip("needs numba")
    simulation = Simulation(scene, compiled=compiled)
    before = simulation.state
    for _ in range(2):  # the first one compiles
        began = time.process_time()
        with pytest.raises(StepBudgetExceeded, match=f"{simulation.step_budget} evaluations") as e:
            simulation.step(torque, MILLISECOND)
        lasted = time.process_time() - began
        assert isinstance(e.value, Diverged) and e.value.state == before == simulation.state
    assert lasted < 0.4  # 0.12 s here, beside whatever else runs
    simulation.step(REST, MILLISECOND)  # it can go on
    assert simulation.time_ns == MILLISECOND


@pytest.mark.parametrize(
    ("coulomb", "smoothing"), [(1e9, 1e-9), (5.0, 1e-12)], ids=["1e9 N m", "1e-12 rad/s"]
)
def test_sharp_coulomb_friction_is_stiff_from_the_first_step(coulomb, smoothing):
    """These steps took 18 and 2.1 s: explicit steps shrank before the spectrum was asked for."""
    simulation = Simulation(rubbing(coulomb, smoothing))
    for _ in range(3):
        simulation.step((1.0, 2.0, -1.0), MILLISECOND)
        assert simulation.method == "rodas4"
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


@pytest.mark.skipif(numba_version() is None, reason="needs numba")
def test_many_steps_in_one_call_return_to_python_within_the_budget(monkeypatch):
    counts, step_many = [], CompiledMethod.step_many

    def counted(self, h, count, *more):
        counts.append(count)
        return step_many(self, h, count, *more)

    monkeypatch.setattr(CompiledMethod, "step_many", counted)
    simulation = Simulation(EXAMPLE2, compiled=True, step_budget=1000)
    simulation.steps(REST, MILLISECOND, 200)
    assert max(counts) * 3 * len(DORMAND_PRINCE.a) <= 1000
    assert simulation.time_ns == 200 * MILLISECOND
