# SPDX-License-Identifier: Apache-2.0
"""Parameters that may be set while a run goes on: what is accepted can be run."""

import dataclasses
import math

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from sst_ros.errors import InputError
from sst_ros.runtime.pacing import Pacer
from sst_ros.runtime.settings import SimulatorParameters

CHANGEABLE = SimulatorParameters.CHANGEABLE


class Clock:
    def __init__(self):
        self.now = 1_700_000_000_000_000_000

    def now_ns(self):
        return self.now

    def sleep(self, ns):
        assert 0 < ns < 1e9
        self.now += ns


@pytest.mark.parametrize("name", CHANGEABLE)
@given(value=st.floats())
@example(value=5e-324)
@example(value=1e-3)
@example(value=1e308)
def test_what_is_accepted_is_in_bounds(name, value):
    try:
        changed = dataclasses.replace(SimulatorParameters(), **{name: value})
    except InputError as error:
        assert name in str(error)
        assert not (value == 0.0 or 1e-3 <= value <= 1000.0)
        return
    most = 1000.0 if name == "real_time_factor" else 1e6
    assert value == 0.0 or 1e-3 <= value <= most
    assert math.isfinite(getattr(changed, name))


@given(st.floats(1e-3, 1000.0), st.sampled_from([1, 1000, 100_000]))
def test_every_real_time_factor_has_deadlines(factor, rate):
    clock = Clock()
    pacer = Pacer(10**9 // rate, 1.0, clock)
    pacer.change(factor)
    asked = [False] * 3 + [True]
    pacer.wait(lambda: asked.pop(0), 3)
    assert pacer.late_ns >= 0
