# SPDX-License-Identifier: Apache-2.0
"""The reference: it agrees with what is right, and sees what is not, where it is.

Terms that the paper has not are compared rightly, or said not to be comparable.
"""

from dataclasses import replace

import numpy as np
import pytest
from bags import SCENE, altered, edited, with_moment
from loaded_scenes import loaded
from scipy.integrate import solve_ivp
from slow_cases import slow_after

from sst_ros.dynamics import kernel
from sst_ros.dynamics.initial_state import initial_state
from sst_ros.mechanism.geometry import Geometry, angle_between
from sst_ros.recording import recording
from sst_ros.report import reference
from sst_ros.report.run import evaluate_run
from sst_ros.scene import scene, yaml_document
from sst_ros.scene.loads import Actuators, Moment


@pytest.fixture(scope="module")
def run(example2_bag):
    return recording.read(example2_bag)


@pytest.fixture(scope="module")
def integration(run):
    return reference.integration(run)


def solve(derivative, span, start):
    return solve_ivp(derivative, span, start, "DOP853", rtol=1e-13, atol=1e-15).y[:, -1]


def start_of(some):
    return initial_state(some, Geometry.of(some))


def test_integration_errors_of_run_and_reference_are_small(
    integration,
):
    for deviation in (integration.error, integration.own):
        for name in ("gamma", "gamma_dot", "orientation"):
            values = getattr(deviation, name)
            assert values.shape == (151,) and np.all(values < 1e-11)
    assert integration.own.gamma.max() > 0.0
    assert (integration.compared, integration.restarts_ns) == (151, ())
    assert integration.steps >= 1


def test_the_reference_agrees_with_scipy(run):
    """The recorded torques, tick by tick, through an integrator that is not ours."""
    model, y = kernel.model_of(run.scene), start_of(run.scene)
    for start, torque in zip(
        run.ticks.start_ns[:100], run.ticks.torque[:100], strict=True
    ):
        torques, span = tuple(torque.tolist()), (start / 1e9, start / 1e9 + 1e-3)
        y = solve(
            lambda t, y, torques=torques: kernel.derivative(model, tuple(y), torques),
            span,
            y,
        )
    assert angle_between(y[:4], run.quaternion[50]) < 1e-12


def test_the_error_of_a_bad_integrator_is_told_as_it_is(run):
    """A run whose samples are off by a known motion shows exactly that, from its start
    on.
    """
    off = 1e-6 * np.cos(10.0 * run.seconds)[:, None] * [1.0, 0.5, -0.2]
    found = reference.integration(altered(run, gamma=run.gamma + off))
    assert np.allclose(found.error.gamma, np.abs(off[:, 0]), atol=1e-12)
    turned = altered(run, gamma=run.gamma + 2.0 * np.pi)
    assert reference.integration(turned).error.gamma.max() < 1e-11


LOST = [
    ("APPLIED", {40, 41, 42, 100}, (84_000_000, 200_000_000), 147),
    ("JOINTS", {*range(40, 50)}, (), 141),
    ("ORIENTATION", {60}, (), 151),
]


@pytest.mark.parametrize(("topic", "lost", "restarts", "compared"), LOST)
def test_what_is_lost_is_not_compared_and_no_error(
    read, bags, example2, topic, lost, restarts, compared
):
    """Where torques are lost, the reference begins again.

    From right states, as the errors tell.
    """
    of = getattr(bags, topic)
    run = read([e for e in example2 if not (e.topic == of and e.sample in lost)])
    found = reference.integration(run)
    assert (found.compared, found.restarts_ns) == (compared, restarts)
    assert run.ticks.gaps == len(restarts)
    assert np.nanmax(found.error.gamma) < 1e-11
    unknown = found.error.orientation if topic == "ORIENTATION" else found.error.gamma
    missing = set(np.flatnonzero(np.isnan(unknown)))
    assert missing == (set() if topic == "JOINTS" else lost)


def test_after_an_unresolved_tick_the_next_sample_is_begun_at(run):
    torque = run.ticks.torque.copy()
    torque[40] = 1e13
    found = reference.integration(altered(run, ticks=replace(run.ticks, torque=torque)))
    assert np.flatnonzero(np.isnan(found.error.gamma)).tolist() == [21]
    assert (found.compared, found.restarts_ns) == (150, ()) and np.nanmax(
        found.error.gamma
    ) < 1e-11


def test_a_lost_start_is_not_taken_for_an_error(read, example2):
    run = read([e for e in example2 if not 0 <= e.sample < 10])
    assert not reference.begins(run) and reference.ideal(run) is None
    found = reference.integration(run)
    assert np.nanmax(found.error.gamma) < 1e-11 and found.compared == 140


def test_the_ideal_is_the_motion_under_continuous_torques(run):
    found = reference.ideal(run)
    model, profile = kernel.model_of(run.scene), run.scene.torque.at
    start = start_of(run.scene)
    end = solve(
        lambda t, y: kernel.derivative(model, tuple(y), profile(t)), (0.0, 0.3), start
    )
    expected = angle_between(end[:4], run.quaternion[-1])
    assert abs(found.error.orientation.iloc[-1] - expected) < 1e-11
    assert 1e-4 < expected < 1e-2  # half a tick's delay of the hold
    assert found.own.gamma.max() < 1e-12
    assert reference.ideal(altered(run, scene=replace(run.scene, torque=None))) is None


def test_long_ticks_are_cut_into_short_steps(run):
    """Ten ticks of 1 ms as one of 10 ms: the reference must not step over it in two."""
    ticks = recording.Ticks(
        run.ticks.start_ns[::10], run.ticks.end_ns[9::10], run.ticks.torque[::10]
    )
    found = reference.integration(altered(run, ticks=ticks))
    assert (
        found.steps >= 10
        and found.own.gamma[np.isfinite(found.own.gamma)].max() < 1e-12
    )


def test_a_wrong_kernel_is_seen_by_the_integration(run, wrong_kernel):
    wrong_kernel(lambda right: [1.0000001 * x for x in right])
    assert reference.integration(run).error.gamma.max() > 1e-9


def test_example_1_keeps_to_its_centre(read, bags):
    run = read(bags.simulated(scene.load("example1"), 0.1))
    found = reference.integration(run)
    assert np.max(found.error.orientation) < 1e-11


def judged(run):
    """The comparisons and the notes of a report."""
    _, integration, ideal, summary = evaluate_run(run)
    return integration, ideal, " ".join(summary["notes"])


@pytest.fixture
def recorded(read, bags):
    def record(some, seconds=0.1, change=lambda entries: entries):
        return read(change(bags.simulated(some, seconds)))

    return record


EXAMPLE2 = scene.load("example2")
LOADED = replace(loaded(), moment=Moment(value=(0.1, 0.2, 0.3)))


@pytest.mark.parametrize(
    "some",
    slow_after(
        2,
        [
            LOADED,
            scene.load("friction"),
            replace(LOADED, actuators=Actuators(rotor_inertia=1e-4, gear_ratio=10.0)),
            replace(EXAMPLE2, actuators=Actuators(torque_limit=2.5)),
            replace(
                EXAMPLE2, actuators=Actuators(time_constant=0.02, torque_limit=2.5)
            ),
        ],
    ),
    ids=["loads", "steps in a tick", "loads and rotors", "limit", "lag and limit"],
)
def test_loads_and_actuators_are_compared_as_they_are(recorded, some):
    integration, ideal, notes = judged(recorded(some))
    assert np.abs(integration.energy).max() < 1e-9
    assert integration.compared == 51
    assert (
        integration.error.gamma.max() < 1e-9
        and integration.error.gamma_dot.max() < 1e-8
    )
    assert ideal.error.gamma.max() < 1e-2
    assert ("the actuators lag" in notes) == bool(
        some.actuators and some.actuators.time_constant
    )


def test_a_lagging_run_begins_again_from_the_efforts_of_a_sample(recorded, bags):
    def lose(entries):
        return [e for e in entries if not (e.topic == bags.APPLIED and e.sample == 20)]

    run = recorded(
        replace(EXAMPLE2, actuators=Actuators(time_constant=0.02)), change=lose
    )
    integration = reference.integration(run)
    assert integration.restarts_ns == (40_000_000,)
    assert integration.compared == 50 and np.nanmax(integration.error.gamma) < 1e-9


PUSHED = replace(EXAMPLE2, moment=Moment(value=(0.3, -0.2, 0.1)))


def from_topic(entries):
    """Turn a recording under a constant moment into one of a scene that takes it from a
    topic.
    """
    text = yaml_document.dump(replace(PUSHED, moment=Moment(topic=True)))
    return edited(entries, SCENE, -1, lambda message: replace(message, data=text))


@pytest.mark.slow
def test_a_recorded_moment_is_used(recorded):
    moment = PUSHED.moment.value
    run = recorded(
        PUSHED, change=lambda entries: with_moment(from_topic(entries), moment)
    )
    assert run.ticks.moment.tolist() == [list(moment)] * 100
    integration, ideal, notes = judged(run)
    assert integration.compared == 51 and integration.error.gamma.max() < 1e-9
    assert ideal is None and "no ideal to compare with" in notes
    wrong = replace(run.ticks, moment=1.01 * run.ticks.moment)
    assert reference.integration(altered(run, ticks=wrong)).error.gamma.max() > 1e-7


def test_an_unrecorded_moment_is_told_and_nothing_is_compared(recorded):
    integration, ideal, notes = judged(recorded(PUSHED, change=from_topic))
    assert integration.compared == 0 and ideal is None
    assert "is not recorded: nothing is compared" in notes
