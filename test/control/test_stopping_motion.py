# SPDX-License-Identifier: Apache-2.0
"""A motion that is slowed down to rest on its own path."""

import numpy as np
import pytest

from sst_ros import load_scene, reference_motion
from sst_ros.control.reference import StoppingMotion

BEGIN, DURATION = 0.4, 0.25


def test_it_begins_with_the_motion_and_ends_at_rest_on_its_path():
    motion = reference_motion(load_scene("reach"))
    stopping = StoppingMotion(motion, BEGIN, DURATION)
    first, last = stopping.at(0.0), stopping.at(DURATION)
    assert first == motion.at(BEGIN)
    end = motion.at(BEGIN + 0.5 * DURATION)
    assert last.gamma == pytest.approx(end.gamma, abs=1e-15)
    assert last.quaternion == pytest.approx(end.quaternion, abs=1e-15)
    for name in ("gamma_dot", "gamma_ddot", "body_rate", "body_acceleration"):
        assert getattr(last, name) == pytest.approx((0.0, 0.0, 0.0), abs=1e-14), name
    assert stopping.at(DURATION + 1.0).gamma == last.gamma


@pytest.mark.parametrize(
    ("name", "derivative"),
    [("gamma", "gamma_dot"), ("gamma_dot", "gamma_ddot"), ("body_rate", "body_acceleration")],
)
def test_its_rates_are_derivatives(name, derivative):
    stopping = StoppingMotion(reference_motion(load_scene("reach")), BEGIN, DURATION)
    for time in np.linspace(0.01, DURATION - 0.01, 7):
        after, before = (np.array(getattr(stopping.at(time + h), name)) for h in (1e-5, -1e-5))
        slope = (after - before) / 2e-5
        assert getattr(stopping.at(time), derivative) == pytest.approx(slope, abs=1e-6)


def test_what_ends_during_the_stop_rests_at_its_end():
    motion = reference_motion(load_scene("reach"))
    stopping = StoppingMotion(motion, motion.duration - 0.05, DURATION)
    end = motion.at(motion.duration)
    assert stopping.at(DURATION).gamma == end.gamma
    assert stopping.at(0.2).gamma_dot == (0.0, 0.0, 0.0)
