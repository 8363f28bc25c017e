# SPDX-License-Identifier: Apache-2.0
import math

import pytest

from sst_ros.integration.events import first_crossing

FOUND = {
    "a crossing, to the rounding of its time": (math.cos, lambda t: -math.sin(t), 2.0, math.pi / 2),
    "a dip inside": (lambda t: (t - 0.4) * (t - 0.6), lambda t: 2.0 * t - 1.0, 1.0, 0.4),
    "leaving an end and back": (lambda t: t * (0.5 - t), lambda t: 0.5 - 2.0 * t, 1.0, 0.5),
    "through an end at once": (lambda t: -t, lambda t: -1.0, 1.0, 0.0),
    "from beyond it by rounding": (lambda t: -1e-15 - t, lambda t: -1.0, 1.0, 0.0),
    "pushed from rest through an end": (lambda t: -t * t, lambda t: -2.0 * t, 1.0, 0.0),
}
NONE = {
    "a minimum above zero": (lambda t: (t - 0.5) ** 2 + 1e-9, lambda t: 2.0 * (t - 0.5), 1.0),
    "leaving an end": (lambda t: t, lambda t: 1.0, 1.0),
    "inside, away": (lambda t: 1.0 + t, lambda t: 1.0, 1.0),
    "inside, towards an end": (lambda t: 2.0 - t, lambda t: -1.0, 1.0),
    "rest at an end": (lambda t: -1e-16, lambda t: 0.0, 1.0),
    # What has just left an end at almost no rate is off it by less than an angle's rounding.
    "rounding on the way inwards": (lambda t: 1e-14 * t - 1e-16, lambda t: 1e-14, 1e-3),
}


@pytest.mark.parametrize(("margin", "slope", "h", "at"), FOUND.values(), ids=FOUND)
def test_a_crossing_is_found(margin, slope, h, at):
    found = first_crossing(margin, slope, h)
    assert found == (pytest.approx(at, abs=4e-16) if at else 0.0)


@pytest.mark.parametrize(("margin", "slope", "h"), NONE.values(), ids=NONE)
def test_what_stays_inside_is_no_crossing(margin, slope, h):
    assert first_crossing(margin, slope, h) is None
