# SPDX-License-Identifier: Apache-2.0
"""Robots driven step by step: as `Batch.run` and as `Simulation`, row by row."""

from dataclasses import replace

import numpy as np
import pytest
from slow_cases import slow_after

from sst_ros import Batch, Simulation, load_scene
from sst_ros.errors import InputError
from sst_ros.scene.loads import Initial

SCENE = replace(load_scene("example2_heavy"), torque=None)
REST = (0.0, 0.0, 0.0)


def starts(number):
    return np.random.default_rng(3).uniform(0.7, 0.85, (number, 3))


@pytest.mark.parametrize("by", ["machine code", "NumPy"])
def test_steps_have_the_bits_of_a_run_and_of_a_simulation(by, without_machine_code):
    if by == "NumPy":
        without_machine_code()
    gamma, torque = starts(5), (0.3, -0.2, 0.1)
    batch = Batch(SCENE)
    session = batch.start(gamma, step=2e-3)
    for _ in range(20):
        state = session.step(torque)
    run = batch.run(gamma, REST, torque, step=2e-3, count=20)
    assert np.array_equal(state.quaternion, run.quaternion)
    assert np.array_equal(state.body_rate, run.body_rate)
    np.testing.assert_allclose(state.gamma, run.gamma, rtol=0.0, atol=1e-15)
    alone = Simulation(replace(SCENE, initial=Initial(gamma=tuple(gamma[3]))), "dop853")
    for _ in range(20):
        alone.step(torque, 2_000_000)
    assert np.array_equal(alone.state.quaternion, state.quaternion[3])
    assert np.array_equal(alone.state.body_rate, state.body_rate[3])


def test_a_robot_that_ends_waits_until_it_is_reset():
    session = Batch(SCENE).start(starts(9), step=0.01)
    torque = np.zeros((9, 3))
    torque[4] = (200.0, 0.0, 0.0)
    for _ in range(100):
        state = session.step(torque)
    assert np.flatnonzero(state.code).tolist() == [4]
    assert 0.0 < session.fault_time[4] < 1.0
    assert "gamma_1 >" in session.result().message[4]
    before = state.quaternion.copy()
    session.step(torque)
    assert np.array_equal(before[4], state.quaternion[4])
    session.reset([4])
    np.testing.assert_allclose(state.gamma[4], starts(9)[4], atol=1e-12)
    assert not state.code.any()
    first = session.fault_time.copy()
    assert np.isnan(first).all()
    for _ in range(100):
        session.step(torque)
    alone = Batch(SCENE).run(starts(9)[4:5], REST, torque[4:5], step=0.01, count=100)
    assert session.fault_time[4] == pytest.approx(alone.fault_time[0], abs=1e-6)


@pytest.mark.slow
def test_threads_and_other_numbers_of_robots_change_no_bit():
    many, few = starts(2000), 5
    session, alone = (
        Batch(SCENE).start(rows, step=2e-3) for rows in (many, many[-few:])
    )
    for _ in range(3):
        both = session.step((0.1, 0.2, 0.3)), alone.step((0.1, 0.2, 0.3))
    for whole, part in zip(*both, strict=True):
        assert np.array_equal(whole[-few:], part)


@pytest.mark.parametrize(
    ("call", "said"),
    [
        (
            lambda of: of.step(np.zeros((4, 3))),
            r"torque = \(4, 3\): must have the shape",
        ),
        (lambda of: of.step((np.nan, 0.0, 0.0)), "(?s)torque = .*must be finite"),
        (lambda of: of.reset([9]), r"rows = \[9\]: must be whole numbers from 0 to 8"),
        (lambda of: of.reset([0], gamma=(np.nan,) * 3), "(?s)gamma = .*must be finite"),
        (
            lambda of: of.reset([0, 1], gamma=np.ones((3, 3))),
            r"gamma = \(3, 3\): must have the shape \(3,\) or \(2, 3\)",
        ),
        (lambda of: of.reset(4), "rows = 4: must be whole numbers"),
        (lambda of: of.reset(["a"]), r"rows = \['a'\]: must be whole numbers"),
    ],
)
def test_bad_arguments_are_refused_by_name(call, said):
    session = Batch(SCENE).start(starts(9), step=0.01)
    before = session.state.quaternion.copy()
    with pytest.raises(InputError, match=said):
        call(session)
    assert np.array_equal(session.state.quaternion, before)


def test_a_batch_with_its_own_torques_takes_no_others():
    with pytest.raises(InputError, match="profile = True: must be False"):
        Batch(load_scene("example2_heavy"), profile=True).start(starts(2), step=0.01)


@pytest.mark.parametrize("by", ["machine code", "NumPy"])
def test_robots_that_begin_again_have_the_bits_of_a_new_session(
    by, without_machine_code
):
    if by == "NumPy":
        without_machine_code()
    number = 1500 if by == "machine code" else 40
    gamma, later = starts(number), starts(number)[::-1] + 0.01
    rows = np.arange(3, number, 7)
    session = Batch(SCENE).start(gamma, step=2e-3)
    fresh = Batch(SCENE).start(later[rows], step=2e-3)
    torque = np.random.default_rng(1).uniform(-0.3, 0.3, (number, 3))
    for _ in range(4):
        session.step(torque)
    state = session.reset(rows, gamma=later[rows])
    for name in ("gamma", "gamma_dot", "quaternion", "body_rate"):
        assert np.array_equal(getattr(state, name)[rows], getattr(fresh.state, name))
    for _ in range(3):
        state, expected = session.step(torque), fresh.step(torque[rows])
    for name in ("gamma", "gamma_dot", "quaternion", "body_rate"):
        assert np.array_equal(getattr(state, name)[rows], getattr(expected, name))
    untouched = Batch(SCENE).start(gamma[:3], step=2e-3)
    for _ in range(7):
        expected = untouched.step(torque[:3])
    assert np.array_equal(state.quaternion[:3], expected.quaternion)


@pytest.mark.parametrize("limit", slow_after(1, [None, 0.2]))
def test_torques_of_any_kind_act_alike_and_are_clamped(limit):
    scene = SCENE.with_values({"actuators": {"torque_limit": limit} if limit else None})
    torque = np.float64(np.float32(np.linspace(-0.5, 0.5, 27).reshape(9, 3)))
    ends = []
    for kind in (torque, torque.astype(np.float32), torque.tolist(), torque.T.copy().T):
        session = Batch(scene).start(starts(9), step=2e-3)
        ends.append(session.step(kind).quaternion.copy())
        clamped = np.clip(torque, -limit, limit) if limit else torque
        assert np.array_equal(session.result().torque, clamped)
    for end in ends[1:]:
        assert np.array_equal(end, ends[0])
