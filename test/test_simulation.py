# SPDX-License-Identifier: Apache-2.0
"""A run: its energy, its clock, its start and every way in which it ends."""

from __future__ import annotations

import json
import math
import warnings
from dataclasses import replace

import numpy as np
import pytest
from loaded_scenes import IGNORE, REST
from models import seeded_samples
from programs import python
from slow_cases import slow_after, slow_except

from sst_ros.dynamics import kernel
from sst_ros.dynamics.kernel import kinetic_energy
from sst_ros.errors import (
    AmbiguousAssembly,
    Diverged,
    InputError,
    NoAdmissibleAssembly,
    RunStopped,
    StrokeExceeded,
    WorkspaceLeft,
)
from sst_ros.mechanism.geometry import quaternion_of
from sst_ros.scene.bodies import Workspace
from sst_ros.scene.loads import Actuators, Initial, Moment
from sst_ros.scene.scene import load
from sst_ros.simulation.simulation import Simulation

MILLISECOND = 1_000_000
EXAMPLE2 = load("example2_heavy")


def energy(simulation):
    model, state = kernel.model_of(simulation.scene), simulation.state
    return kinetic_energy(model, (*state.quaternion, *state.body_rate))


def end_of(scene, torque):
    """Step by milliseconds.

    Return the error that ends the run at the last valid state.
    """
    simulation = Simulation(scene)
    with pytest.raises(RunStopped) as caught:
        for _ in range(1000):
            before = simulation.state
            simulation.step(torque, MILLISECOND)
    assert caught.value.state is before is simulation.state
    assert 0.0 <= caught.value.time - before.time_ns / 1e9 <= 1e-3
    return caught.value


@pytest.mark.parametrize("driven", [False, True])
@pytest.mark.parametrize("seed", range(4))
def test_energy_grows_by_the_work_of_constant_torques(seed, driven):
    """The work is tau . (gamma - gamma_0), exactly.

    DOP853 at 1 ms errs below rounding.
    """
    (sample,) = seeded_samples(seed + 60, 1)
    torque = tuple((sample.torque / 10.0).tolist()) if driven else REST
    initial = Initial(gamma=sample.gamma, gamma_dot=sample.gamma_dot / 2.0)
    simulation = Simulation(replace(sample.scene, initial=initial, **IGNORE), "dop853")
    start, before = energy(simulation), simulation.state
    for _ in range(100 if driven else 200):
        simulation.step(torque, MILLISECOND)
    after = simulation.state
    assert np.abs(np.subtract(after.quaternion, before.quaternion)).max() > 0.01
    work = np.dot(torque, np.subtract(after.joints.gamma, before.joints.gamma))
    assert abs(work) > 1e-4 if driven else work == 0.0
    assert energy(simulation) - start == pytest.approx(
        work, abs=1e-13 * (start + driven)
    )


@pytest.mark.parametrize(
    ("gamma", "ends"), [((0.7, 0.8, 0.9), {}), ((1.3, 1.4, 1.58), IGNORE)]
)
def test_the_start_is_the_scenes_outside_an_ignored_stroke_too(gamma, ends):
    initial = Initial(gamma=gamma, gamma_dot=(0.1, -0.2, 0.3))
    state = Simulation(replace(EXAMPLE2, initial=initial, **ends)).state
    assert state.time_ns == 0
    assert state.torque == REST
    np.testing.assert_allclose(state.joints.gamma, initial.gamma, atol=1e-14)
    np.testing.assert_allclose(state.joints.gamma_dot, initial.gamma_dot, atol=1e-14)


def test_time_is_counted_in_whole_nanoseconds():
    simulation = Simulation(replace(EXAMPLE2, **IGNORE))
    steps = [333_333, 1, 999_999_7, 7, 1_234_567]
    for dt_ns in 20 * steps:
        simulation.step(REST, dt_ns)
    simulation.steps(REST, np.int32(2_000_000), np.int8(100))  # their product overflows
    assert simulation.state.time_ns == 20 * sum(steps) + 200_000_000
    assert isinstance(simulation.state.time_ns, int)


@pytest.mark.parametrize("kind", [np.float32, np.int64, int])
def test_torques_and_moments_of_any_type_act_as_floats(kind):
    """In plain Python those of float32 would make float32 of the state."""
    scene = replace(EXAMPLE2, moment=Moment(topic=True))
    given, floats = (kind(1), kind(0), kind(-2)), (1.0, 0.0, -2.0)
    for torque, expected in ((given, floats), (lambda _: given, lambda _: floats)):
        found = Simulation(scene).step(torque, MILLISECOND, given)
        assert found == Simulation(scene).step(expected, MILLISECOND, floats)
        assert {type(x) for x in (*found.quaternion, *found.torque)} == {float}


def test_a_torque_function_of_time_is_asked_at_simulated_times():
    simulation, asked = Simulation(EXAMPLE2), []
    for _ in range(3):
        simulation.step(lambda t: asked.append(t) or REST, MILLISECOND)
    assert min(asked) == 0.0
    assert max(asked) == pytest.approx(0.003, abs=1e-15)


@pytest.mark.parametrize(
    ("leg", "sign"), [(0, -1.0), (1, -1.0), (2, -1.0), (1, 1.0), (2, 1.0)]
)
def test_each_end_of_each_stroke_stops_the_run(leg, sign):
    torque = tuple(5.0 * sign * (k == leg) for k in range(3))
    error = end_of(replace(EXAMPLE2, workspace=Workspace(at_edge="ignore")), torque)
    assert isinstance(error, StrokeExceeded)
    assert error.reason == f"gamma_{leg + 1} {'< 0' if sign < 0 else '> 1.570796 rad'}"


def test_the_largest_beta_stops_the_run():
    error = end_of(
        replace(EXAMPLE2, workspace=Workspace(beta_max_deg=40.0)), EXAMPLE2.torque.at
    )
    assert isinstance(error, WorkspaceLeft)
    assert error.reason.startswith("beta_") and error.reason.endswith("> 0.698132 rad")
    assert max(error.state.joints.beta) < np.radians(40.0)


@pytest.mark.parametrize("push", [1e308, -1e308], ids=str)
def test_a_motion_that_no_step_resolves_is_refused_without_trace(push):
    simulation, other = Simulation(EXAMPLE2), Simulation(EXAMPLE2)
    simulation.step(REST, MILLISECOND)
    before, estimate = simulation.state, simulation.error_estimate
    with pytest.raises(
        Diverged, match=r"do not resolve it \(sin_mu = 1, det_j2 = -1\)"
    ) as caught:
        simulation.step((push, 0.0, push), MILLISECOND)
    assert simulation.state is before is caught.value.state
    assert simulation.error_estimate == estimate
    for torque in (REST, (1.0, 2.0, 3.0)):
        other.step(torque, MILLISECOND)
    assert simulation.step((1.0, 2.0, 3.0), MILLISECOND) == other.state
    assert simulation.changes == other.changes


THREE, WHOLE = "must be three finite numbers", "whole nanoseconds"
REFUSED = [
    *(
        ((torque,), f"torque = .*: {THREE}")
        for torque in (1.0, None, "abc", (1.0, 2.0))
    ),
    *((((0.0, bad, 0.0),), f"torque = .*: {THREE}") for bad in (math.nan, math.inf)),
    *(
        ((REST, dt), f"dt_ns = .*{WHOLE}")
        for dt in (1e-3, math.nan, True, "1", None, 0, -5)
    ),
    *(((REST, 1, n), "count = .*a whole number") for n in (-1, 0, math.nan, 1.5, True)),
    ((REST, 1, 1, (0.0, math.nan, 0.0)), f"moment = .*: {THREE}"),
]


@pytest.mark.parametrize(("arguments", "said"), REFUSED)
def test_arguments_of_a_step_are_refused_by_name(arguments, said):
    simulation = Simulation(EXAMPLE2)
    with pytest.raises(InputError, match=said):
        simulation.steps(*(*arguments, *(MILLISECOND, 1)[len(arguments) - 1 :]))
    assert simulation.state.time_ns == 0


def test_a_start_without_admissible_assembly_is_refused():
    with pytest.raises(NoAdmissibleAssembly, match="gamma = "):
        Simulation(replace(EXAMPLE2, initial=Initial(gamma=(0.05, 0.05, 1.5))))


@pytest.mark.parametrize(
    "name", slow_except(["example2_heavy"], ["example2_heavy", "impacts", "friction"])
)
def test_a_state_within_the_last_step_is_that_of_a_shorter_step(name):
    scene = load(name)
    torque = scene.torque.at
    simulation, other = Simulation(scene), Simulation(scene)
    for one in (simulation, other):
        one.steps(torque, 100 * MILLISECOND, 9)
    simulation.step(torque, 100 * MILLISECOND)
    end, estimate = simulation.state, simulation.error_estimate
    found = simulation.within(930 * MILLISECOND)
    expected = other.step(torque, 30 * MILLISECOND)
    np.testing.assert_allclose(found.joints.gamma, expected.joints.gamma, atol=1e-8)
    assert found.time_ns == expected.time_ns
    assert simulation.state is end
    assert simulation.error_estimate == estimate
    assert simulation.within(900 * MILLISECOND).time_ns == 900 * MILLISECOND
    with pytest.raises(InputError, match="time_ns = 1: must lie in the last step"):
        simulation.within(1)


def test_a_scene_names_the_assembly_that_it_means():
    star = replace(EXAMPLE2.star, alpha_deg=(210.0, 75.0, 75.0))
    initial = Initial(gamma=tuple(np.radians([75.0, 74.0, 71.0])))
    scene = replace(EXAMPLE2, star=star, initial=initial)
    with pytest.raises(AmbiguousAssembly, match="with the orientations") as caught:
        Simulation(scene)
    for candidate in caught.value.candidates:
        wanted = tuple(quaternion_of(candidate.rotation).tolist())
        named = replace(scene, initial=replace(initial, orientation=wanted))
        found = Simulation(named).state.quaternion
        np.testing.assert_allclose(found, wanted, atol=1e-15)


def test_what_the_same_constants_move_is_traced_once():
    scene = load("friction")
    again = Simulation(replace(scene, initial=Initial(gamma=(0.7, 0.7, 0.7))))
    assert again.dynamics is Simulation(scene).dynamics
    assert Simulation(load("swing")).dynamics is not again.dynamics


def test_no_torque_gives_a_warning_and_a_wrong_one_is_refused():
    simulation = Simulation(EXAMPLE2)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        simulation.steps(EXAMPLE2.torque, 10 * MILLISECOND, 50)
        simulation.step(lambda t: (t, 0.0, 1.0), MILLISECOND)
    # and not Diverged
    with pytest.raises(InputError, match="must return three torques"):
        simulation.step(lambda t: (t, t), MILLISECOND)


LIMITED = replace(EXAMPLE2, actuators=Actuators(torque_limit=2.0))
ALIKE = {
    "constant": (EXAMPLE2, (0.1, 0.2, -0.3), 0.0),
    "clamped sine": (LIMITED, EXAMPLE2.torque, 0.0),
    "sine": (EXAMPLE2, EXAMPLE2.torque, 3e-10),
    "sine and friction": (load("friction"), load("friction").torque, 3e-10),
}


@pytest.mark.parametrize(
    ("scene", "torque", "within"), slow_after(3, ALIKE.values()), ids=ALIKE
)
def test_a_torque_moves_as_its_function_does(scene, torque, within):
    one, other = Simulation(scene), Simulation(scene)
    one.steps(torque, 10 * MILLISECOND, 50)
    other.steps(getattr(torque, "at", lambda t: torque), 10 * MILLISECOND, 50)
    assert one.state.torque == pytest.approx(other.state.torque, abs=1e-13)
    assert one.state.quaternion == pytest.approx(
        other.state.quaternion, abs=within, rel=0.0
    )
    # it has kinks inside steps
    assert one.error_estimate < (1e-7 if scene is LIMITED else 1e-8)
    if within == 0.0:
        assert one.state == other.state
    middle = one.time_ns - 4 * MILLISECOND
    expected = other.within(middle).quaternion
    assert one.within(middle).quaternion == pytest.approx(
        expected, abs=within or 1e-12, rel=0.0
    )


def test_a_state_within_many_steps_takes_the_budget_of_each():
    simulation = Simulation(EXAMPLE2, step_budget=300)
    simulation.steps(EXAMPLE2.torque, 10 * MILLISECOND, 50)
    there = Simulation(EXAMPLE2)
    there.steps(EXAMPLE2.torque, 10 * MILLISECOND, 49)
    there.step(EXAMPLE2.torque, 6 * MILLISECOND)
    assert simulation.within(there.time_ns).quaternion == there.state.quaternion


BITS = """
import json, sys
if %s:
    sys.modules["llvmlite"] = None
from sst_ros import Simulation
found = {}
for name in ("example2", "gravity_payload", "fast_spin"):
    simulation = Simulation(name, "dopri5")
    states = [simulation.step((0.1, -0.05, 0.02), 1_000_000) for _ in range(100)]
    found[name] = [*states[-1].quaternion, *states[-1].body_rate]
print(json.dumps(found))
"""


@pytest.mark.slow
def test_bits_depend_on_the_c_library_only_as_the_page_says():
    """glibc chooses sin, cos and atan2 by FMA and AVX2.

    LLVM's target changes nothing.
    """
    pytest.importorskip("llvmlite", reason="needs llvmlite: pip install .[fast]")
    without = {"GLIBC_TUNABLES": "glibc.cpu.hwcaps=-AVX2,-FMA,-FMA4"}
    plain, other = (
        json.loads(python(BITS % True, env=env).stdout) for env in ({}, without)
    )
    assert json.loads(python(BITS % False, env={}).stdout) == plain
    for name, row in plain.items():
        np.testing.assert_allclose(other[name], row, rtol=1e-11, atol=1e-13)
