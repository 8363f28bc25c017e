# SPDX-License-Identifier: Apache-2.0
"""Numbers of a track against closed forms."""

import numpy as np
import pytest

from sst_ros.control.controller import SETTLING_BAND, TRACK, TrackingMetrics, track_of
from sst_ros.report.results import render

TIME = np.linspace(0.0, 2.0, 2001)


def track(error, gamma=None, **given):
    """A track of the same error in all joints.

    Gamma rises over the first second by default.
    """
    gamma = np.minimum(TIME, 1.0) if gamma is None else gamma
    columns = {"gamma": gamma, "gamma_dot": np.gradient(gamma), "error": error}
    columns |= {name: np.zeros_like(TIME) for name in ("feedforward", "feedback")}
    columns |= {
        "torque": given.get("feedforward", 0.0) + given.get("feedback", 0.0 * TIME)
    }
    columns |= given
    parts = (np.outer(columns[name], [1, 1, 1]) for name in TRACK.names[1:])
    return track_of(np.column_stack([TIME, *parts]))


def test_errors_of_a_sine():
    found = TrackingMetrics(track(0.3 * np.sin(2.0 * np.pi * TIME)))
    assert found.rms == pytest.approx(0.3 / np.sqrt(2.0), rel=1e-3)
    assert found.largest == pytest.approx(0.3, rel=1e-5)
    assert found.last == pytest.approx(0.0, abs=1e-15)
    assert found.samples == 2001


def test_settling_time_of_a_decay_after_the_motion():
    error = 0.5 * np.exp(-np.maximum(TIME - 1.0, 0.0) / 0.1)
    found = TrackingMetrics(track(error))
    assert found.band == pytest.approx(SETTLING_BAND)  # the way is 1 rad
    assert found.settling == pytest.approx(0.1 * np.log(0.5 / SETTLING_BAND), abs=2e-3)


def test_settling_time_is_unknown_where_it_is_not_seen():
    # never settles
    assert TrackingMetrics(track(np.full_like(TIME, 0.5))).settling is None
    endless = track(0.0 * TIME, gamma=TIME)  # the motion never ends
    assert TrackingMetrics(endless).settling is None
    assert TrackingMetrics(track(0.0 * TIME)).settling == 0.0


def test_shares_are_those_of_the_torque_and_sum_to_one():
    feedforward = 3.0 * np.sin(2.0 * np.pi * TIME[:-1])
    feedback = np.cos(2.0 * np.pi * TIME[:-1])
    whole = track(
        0.0 * TIME,
        feedforward=np.append(feedforward, 0.0),
        feedback=np.append(feedback, 0.0),
    )
    found = TrackingMetrics(whole)
    assert found.shares[0] == pytest.approx(0.9) and found.shares[1] == pytest.approx(
        0.1
    )
    assert found.torque_rms == pytest.approx(np.sqrt(5.0), rel=1e-3)
    nothing = TrackingMetrics(track(0.0 * TIME))
    assert np.isnan(nothing.shares).all()


def test_the_table_says_what_it_knows():
    found = TrackingMetrics(track(0.0 * TIME, gamma=TIME), limited=7)
    lines = render("tracking.txt", found=found)
    assert "nan" not in lines
    assert "7  (of 2001)" in lines
    assert lines.count("\n") == 10


@pytest.mark.parametrize("size", [1, 7, 400, 1500])
def test_a_record_in_parts_has_the_metrics_of_the_whole(size):
    error = 0.5 * np.exp(-np.maximum(TIME - 1.0, 0.0) / 0.1)
    whole, found = (
        track(error, feedforward=np.sin(TIME), feedback=np.cos(TIME)),
        TrackingMetrics(None, 3),
    )
    for first in range(0, len(TIME), size):
        found.add(whole[first : first + size])
    expected = TrackingMetrics(whole, 3)
    for name in {name for name in dir(expected) if name[0] != "_"} - {"add"}:
        assert getattr(found, name) == pytest.approx(
            getattr(expected, name), rel=1e-12
        ), name
