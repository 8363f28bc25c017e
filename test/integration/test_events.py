# SPDX-License-Identifier: Apache-2.0
import math

import pytest

from sst_ros.integration.events import first_crossing


def crossing(margin, slope, h):
    return first_crossing(margin, slope, h)


def test_a_crossing_is_located_to_the_rounding_of_its_time():
    x = crossing(lambda t: math.cos(t), lambda t: -math.sin(t), 2.0)
    assert x == pytest.approx(math.pi / 2, abs=4e-16)


def test_a_dip_inside_the_step_is_found():
    x = crossing(lambda t: (t - 0.4) * (t - 0.6), lambda t: 2.0 * t - 1.0, 1.0)
    assert x == pytest.approx(0.4, abs=1e-15)


def test_a_minimum_above_zero_is_no_crossing():
    assert crossing(lambda t: (t - 0.5) ** 2 + 1e-9, lambda t: 2.0 * (t - 0.5), 1.0) is None


def test_leaving_an_end_is_no_crossing_and_coming_back_is():
    assert crossing(lambda t: t, lambda t: 1.0, 1.0) is None
    x = crossing(lambda t: t * (0.5 - t), lambda t: 0.5 - 2.0 * t, 1.0)
    assert x == pytest.approx(0.5, abs=1e-15)


def test_going_through_an_end_at_once_is_a_crossing_at_once():
    assert crossing(lambda t: -t, lambda t: -1.0, 1.0) == 0.0
    assert crossing(lambda t: -1e-15 - t, lambda t: -1.0, 1.0) == 0.0


def test_staying_inside_is_no_crossing():
    assert crossing(lambda t: 1.0 + t, lambda t: 1.0, 1.0) is None
    assert crossing(lambda t: 2.0 - t, lambda t: -1.0, 1.0) is None


def test_pushed_from_rest_through_an_end_is_a_crossing_at_once():
    assert crossing(lambda t: -t * t, lambda t: -2.0 * t, 1.0) == 0.0


def test_rest_at_an_end_is_no_crossing():
    assert crossing(lambda t: -1e-16, lambda t: 0.0, 1.0) is None


def test_rounding_on_the_way_inwards_is_no_crossing():
    """What has just left an end at almost no rate is off it by less than an angle's rounding."""
    assert crossing(lambda t: 1e-14 * t - 1e-16, lambda t: 1e-14, 1e-3) is None
