# SPDX-License-Identifier: Apache-2.0
"""Models that are wrong, and nothing else about them; encoders, noise and delays."""

import dataclasses

import numpy as np
import pytest

from sst_ros.control.controller import ControlChannel, Measurement
from sst_ros.control.inverse_dynamics import InverseDynamics
from sst_ros.dynamics.initial_state import initial_state
from sst_ros.mechanism.geometry import Geometry
from sst_ros.scene.scene import Actuators, load
from studies.control_loop import ChannelState, make_heavier, model_errors

REACH, EXAMPLE2 = load("reach"), load("example2_heavy")
BODY_RATE, ACCELERATION = (0.4, -0.7, 0.9), (3.0, 2.0, -5.0)


def torque(scene):
    start = initial_state(scene, Geometry.of(scene))[:4]
    return np.array(InverseDynamics(scene).torque(tuple(start), BODY_RATE, ACCELERATION))


def test_bodies_that_weigh_more_need_torques_as_much_larger():
    """All torques but those of friction are linear in masses and inertias."""
    rotors = dataclasses.replace(REACH, actuators=Actuators(rotor_inertia=1e-4, gear_ratio=10.0))
    scene = dataclasses.replace(rotors, friction=None)
    np.testing.assert_allclose(torque(make_heavier(scene, 1.2)), 1.2 * torque(scene), rtol=1e-12)


def test_the_factor_one_changes_nothing():
    assert make_heavier(REACH, 1.0) == REACH


def test_every_error_is_one_and_the_first_is_none():
    errors = list(model_errors())
    assert [e.name for e in errors if not e.changes(REACH)] == ["nominal"] == [errors[0].name]
    assert len({error.name for error in errors}) == len(errors)


def test_what_a_plant_has_not_cannot_be_unknown():
    cannot = [e.name for e in model_errors() if not e.changes(EXAMPLE2)]
    assert cannot == ["nominal", "friction unknown", "gravity missing"]


@pytest.mark.parametrize("error", list(model_errors()), ids=lambda error: error.name)
def test_an_error_keeps_the_motion(error):
    model = error.model(REACH)
    kept = ("base", "initial", "motion", "stroke", "workspace")
    assert all(getattr(model, key) == getattr(REACH, key) for key in kept)


GAMMA, RATE = (0.7, 0.8, 0.9), (0.1, -0.2, 0.3)


def test_a_channel_that_loses_nothing_changes_nothing():
    wire = ChannelState(ControlChannel(), 0)
    assert wire.measure(GAMMA, RATE) == Measurement(GAMMA, RATE)
    assert wire.delayed((1.0, 2.0, 3.0)) == (1.0, 2.0, 3.0)


@pytest.mark.parametrize("delay", [0, 1, 5])
def test_commands_come_late_by_whole_samples_and_the_first_one_waits(delay):
    wire = ChannelState(ControlChannel(delay=delay), 0)
    came = [wire.delayed((float(k), 0.0, 0.0))[0] for k in range(10)]
    assert came == [max(k - delay, 0) for k in range(10)]


def test_an_encoder_counts_and_knows_rates_from_counts_alone():
    period, counts = 1e-3, 1000
    step = 2.0 * np.pi / counts
    wire = ChannelState(ControlChannel(period=period, counts=counts), 0)
    seen, rates = [], []
    for k in range(200):
        angle = 0.5 + 3.0 * k * period
        measured = wire.measure((angle,) * 3, (3.0,) * 3)
        gamma, rate = measured.gamma, measured.gamma_dot
        assert abs(gamma[0] - angle) <= 0.5 * step * (1.0 + 1e-9)
        assert gamma[0] / step == pytest.approx(round(gamma[0] / step), abs=1e-9)
        seen.append(gamma[0])
        rates.append(rate[0])
    np.testing.assert_allclose(rates[1:], np.diff(seen) / period, atol=1e-9)
    assert np.mean(rates) == pytest.approx(3.0, abs=step / (200 * period))


def test_noise_has_its_deviation_and_repeats_by_seed():
    def drawn(seed):
        wire = ChannelState(ControlChannel(angle_noise=1e-3, rate_noise=0.1), seed)
        seen = (wire.measure(GAMMA, RATE) for _ in range(4000))
        return np.array([(one.gamma, one.gamma_dot) for one in seen])

    first = drawn(3)
    # The deviation of 12 000 numbers is known to 1 / sqrt(2 n) = 0.65 %.
    assert np.std(first[:, 0] - GAMMA) == pytest.approx(1e-3, rel=0.03)
    assert np.std(first[:, 1] - RATE) == pytest.approx(0.1, rel=0.03)
    assert np.array_equal(first, drawn(3))
    assert not np.array_equal(first, drawn(4))
