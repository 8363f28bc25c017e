# SPDX-License-Identifier: Apache-2.0
"""The reference: it agrees with what is right, and sees what is not, where it is."""

import dataclasses

import numpy as np
import pytest
from bags import altered
from scipy.integrate import solve_ivp

from sst_ros.dynamics import kernel
from sst_ros.mechanism.frames import angle_between
from sst_ros.mechanism.geometry import Geometry
from sst_ros.recording import recording
from sst_ros.report import reference, states
from sst_ros.scene import scene


@pytest.fixture(scope="module")
def run(tmp_path_factory, bags, example2):
    return recording.read(bags.write(tmp_path_factory.mktemp("run") / "bag", example2))


@pytest.fixture(scope="module")
def integration(run):
    return reference.integration(run)


def test_the_integration_error_of_a_good_run_is_small_and_the_reference_tells_its_own(integration):
    for deviation in (integration.error, integration.own):
        for name in ("gamma", "gamma_dot", "orientation"):
            values = getattr(deviation, name)
            assert values.shape == (151,) and np.all(values < 1e-11)
    assert integration.own.gamma.max() > 0.0
    assert (integration.compared, integration.restarts_ns) == (151, ())
    assert integration.steps >= 2


def test_the_reference_agrees_with_scipy(run):
    """The recorded torques, tick by tick, through an integrator that is not ours."""
    model, y = kernel.model_of(run.scene), states.initial(run.scene)
    for start, torque in zip(run.ticks.start_ns[:100], run.ticks.torque[:100], strict=True):
        torques = tuple(torque.tolist())
        begin = start / 1e9
        y = solve_ivp(
            lambda t, y, torques=torques: kernel.derivative(model, tuple(y), torques),
            (begin, begin + 1e-3), y, "DOP853", rtol=1e-13, atol=1e-15,
        ).y[:, -1]  # fmt: skip
    assert angle_between(y[:4], run.quaternion[50]) < 1e-12


def test_the_error_of_a_bad_integrator_is_told_as_it_is(run):
    """A run whose samples are off by a known motion shows exactly that."""
    off = 1e-6 * np.sin(10.0 * run.seconds)[:, None] * [1.0, 0.5, -0.2]
    found = reference.integration(altered(run, gamma=run.gamma + off))
    assert np.allclose(found.error.gamma, np.abs(off[:, 0]), atol=1e-12)
    turned = altered(run, gamma=run.gamma + 2.0 * np.pi)
    assert reference.integration(turned).error.gamma.max() < 1e-11


def test_one_altered_sample_shows_at_its_moment(tmp_path, bags, example2, integration):
    def altered(message):
        position = message.position.copy()
        position[1] += 1e-7
        return dataclasses.replace(message, position=position)

    path = bags.write(tmp_path / "altered", bags.edited(example2, bags.JOINTS, 90, altered))
    error = reference.integration(recording.read(path)).error
    assert np.argmax(error.gamma) == 90
    assert abs(error.gamma[90] - 1e-7) < 1e-12
    others = np.arange(151) != 90
    assert np.array_equal(error.gamma[others], integration.error.gamma[others])


def test_one_altered_torque_shows_from_its_moment_on(tmp_path, bags, example2):
    def altered(message):
        message = dataclasses.replace(message, points=list(message.points))
        effort = message.points[0].effort + np.array([1e-3, 0.0, 0.0])
        message.points[0] = dataclasses.replace(message.points[0], effort=effort)
        return message

    path = bags.write(tmp_path / "altered", bags.edited(example2, bags.APPLIED, 90, altered))
    error = reference.integration(recording.read(path)).error
    assert error.gamma_dot[:90].max() < 1e-11
    assert error.gamma_dot[90:].min() > 1e-8


def test_lost_torques_make_the_reference_begin_again(tmp_path, bags, example2):
    lost = {40, 41, 42, 100}
    kept = [e for e in example2 if not (e.topic == bags.APPLIED and e.sample in lost)]
    run = recording.read(bags.write(tmp_path / "bag", kept))
    found = reference.integration(run)
    assert found.restarts_ns == (84_000_000, 200_000_000)
    assert run.ticks.gaps == 2
    assert set(np.flatnonzero(np.isnan(found.error.gamma))) == lost
    assert found.compared == 147
    assert np.nanmax(found.error.gamma) < 1e-11


def test_lost_samples_do_not_disturb(tmp_path, bags, example2):
    kept = [e for e in example2 if not (e.topic == bags.JOINTS and 40 <= e.sample < 50)]
    kept = [e for e in kept if not (e.topic == bags.ORIENTATION and e.sample == 60)]
    found = reference.integration(recording.read(bags.write(tmp_path / "bag", kept)))
    assert (found.compared, found.restarts_ns) == (141, ())
    assert np.nanmax(found.error.gamma) < 1e-11
    assert np.count_nonzero(np.isnan(found.error.orientation)) == 1


def test_a_lost_start_is_not_taken_for_an_error(tmp_path, bags, example2):
    kept = [e for e in example2 if not 0 <= e.sample < 10]
    run = recording.read(bags.write(tmp_path / "bag", kept))
    assert not states.begins(run)
    found = reference.integration(run)
    assert np.nanmax(found.error.gamma) < 1e-11 and found.compared == 140
    assert reference.ideal(run) is None


def test_a_wrong_start_is_an_error(run):
    """All samples are there, and they begin 1e-6 rad off: that is the simulator's doing."""
    found = reference.integration(altered(run, gamma=run.gamma + 1e-6))
    assert abs(found.error.gamma[0] - 1e-6) < 1e-12


def test_states_of_samples_are_whole(run):
    model = kernel.model_of(run.scene)
    for sample in (0, 75, 150):
        y = states.of_samples(Geometry.of(run.scene), run, [sample])[0].tolist()
        joints = kernel.joints(model, y)
        for name in ("gamma", "mu", "beta", "gamma_dot", "mu_dot", "beta_dot"):
            assert np.allclose(getattr(joints, name), getattr(run, name)[sample], atol=1e-13)


def test_the_ideal_is_the_motion_under_continuous_torques(run):
    found = reference.ideal(run)
    model, profile = kernel.model_of(run.scene), run.scene.torque.at
    solution = solve_ivp(
        lambda t, y: kernel.derivative(model, tuple(y), profile(t)),
        (0.0, 0.3), states.initial(run.scene), "DOP853", rtol=1e-13, atol=1e-15,
    )  # fmt: skip
    expected = angle_between(solution.y[:4, -1], run.quaternion[-1])
    assert abs(found.error.orientation[-1] - expected) < 1e-11
    assert 1e-4 < expected < 1e-2  # half a tick's delay of the hold
    assert found.own.gamma.max() < 1e-12


def test_a_scene_without_torques_has_no_ideal(run):
    bare = altered(run, scene=dataclasses.replace(run.scene, torque=None))
    assert reference.ideal(bare) is None


def test_long_ticks_are_cut_into_short_steps(run):
    """Ten ticks of 1 ms as one of 10 ms: the reference must not step over it in two."""
    ticks = recording.Ticks(
        run.ticks.start_ns[::10], run.ticks.end_ns[9::10], run.ticks.torque[::10]
    )
    found = reference.integration(altered(run, ticks=ticks))
    assert found.steps >= 20 and found.own.gamma[np.isfinite(found.own.gamma)].max() < 1e-12


def test_the_formulations_agree_and_a_wrong_kernel_is_seen(run, wrong_kernel):
    difference, count = states.check_with_paper(run)
    assert count == 20 and difference < 1e-12
    wrong_kernel(lambda right: [1.0000001 * x for x in right])
    assert 5e-8 < states.check_with_paper(run)[0] < 2e-7


def test_a_kernel_that_is_wrong_shows_in_the_integration_too(run, wrong_kernel):
    wrong_kernel(lambda right: [1.0000001 * x for x in right])
    assert reference.integration(run).error.gamma.max() > 1e-9


def test_example_1_keeps_to_its_centre(tmp_path, bags):
    run = recording.read(bags.write(tmp_path / "bag", bags.simulated(scene.load("example1"), 0.1)))
    found = reference.integration(run)
    assert np.max(found.error.orientation) < 1e-11
    assert states.check_with_paper(run)[0] < 1e-12
