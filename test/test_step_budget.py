# SPDX-License-Identifier: Apache-2.0
"""Every step ends: within its budget of evaluations, or with the last valid state."""

import time
from dataclasses import replace

import pytest

from sst_ros.errors import Diverged, InputError, StepBudgetExceeded
from sst_ros.integration.codegen import numba_version
from sst_ros.integration.compiled_method import CompiledMethod
from sst_ros.integration.methods import DORMAND_PRINCE
from sst_ros.scene.loads import Friction, JointFriction, Stroke, Workspace
from sst_ros.scene.scene import Inertia, Link, load
from sst_ros.simulation.simulation import Simulation

MILLISECOND = 1_000_000
EXAMPLE2 = load("example2_heavy")


def light(about_z, across=1.0):
    """A star without links that a small torque spins to 1e7 rad/s in a millisecond."""
    links = (Link(),) * 3
    star = replace(EXAMPLE2.star, inertia=Inertia(xx=across, yy=across, zz=about_z))
    free = {"stroke": Stroke(at_end="ignore"), "workspace": Workspace(at_edge="ignore")}
    return replace(EXAMPLE2, star=star, actuated_links=links, intermediate_links=links, **free)


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
    simulation.step((0.0, 0.0, 0.0), MILLISECOND)  # it can go on
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
    simulation = Simulation("example2_heavy", step_budget=10)
    with pytest.raises(StepBudgetExceeded, match="10 evaluations do not reach the end"):
        simulation.step((1.0, 1.0, 1.0), 100 * MILLISECOND)
    with pytest.raises(InputError, match="step_budget = 0: must be > 0"):
        Simulation("example2_heavy", step_budget=0)


@pytest.mark.skipif(numba_version() is None, reason="needs numba")
def test_many_steps_in_one_call_return_to_python_within_the_budget(monkeypatch):
    counts, step_many = [], CompiledMethod.step_many

    def counted(self, h, count, *more):
        counts.append(count)
        return step_many(self, h, count, *more)

    monkeypatch.setattr(CompiledMethod, "step_many", counted)
    simulation = Simulation("example2_heavy", compiled=True, step_budget=1000)
    simulation.steps((0.0, 0.0, 0.0), MILLISECOND, 200)
    assert max(counts) * 3 * len(DORMAND_PRINCE.a) <= 1000
    assert simulation.time_ns == 200 * MILLISECOND
