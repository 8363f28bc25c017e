# SPDX-License-Identifier: Apache-2.0
"""Deadlines against a clock that the test moves.

Parameters that may change during a run.
"""

import dataclasses
import math

import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from runtime.bench import HandClock

from sst_ros.errors import InputError
from sst_ros.runtime.settings import SimulatorParameters
from sst_ros.runtime.tick_loop import Pacer

MS = 1_000_000
CHANGEABLE = [
    name
    for name in SimulatorParameters.CHANGEABLE
    if not SimulatorParameters.SPECS[name].shape  # three numbers, as those of a scene
]


class Hand(HandClock):
    """A clock that a sleeper moves on, to the nanosecond."""

    def __init__(self, now=5 * MS):
        self.now, self.slept = now, []

    def sleep(self, seconds):
        self.slept.append(seconds)
        self.now += round(seconds * 1e9)


@pytest.fixture
def hand():
    return Hand()


def never():
    return False


@pytest.fixture
def paced(hand):
    """A pacer with deadlines 1 ms apart, if not told otherwise, from now on."""

    def begin(period_ns=MS, speed=1.0, tolerance_ns=0):
        found = Pacer(period_ns, speed, hand, tolerance_ns)
        found.start()
        return found

    return begin


@pytest.fixture
def pacer(paced):
    return paced()


def test_one_sleep_may_end_in_several_ticks(hand, pacer):
    assert [Pacer(MS, speed, hand).together for speed in (0.0, 0.5, 1.0, 2.6)] == [
        1,
        1,
        2,
        5,
    ]
    assert Pacer(MS, 1.0, hand, tolerance_ns=200 * MS).together == 1
    assert pacer.wait(never, 2) and hand.now == 7 * MS
    hand.now += 3 * MS + 100_000  # 1.1 ms after the last of the next two
    assert pacer.wait(never, 2)
    assert (pacer.missed, pacer.late_ns) == (1, 1_100_000)


def test_an_overrun_drops_time_without_a_burst(hand, pacer):
    hand.now += 1_900_000
    assert pacer.wait(never)
    assert (pacer.missed, pacer.late_ns) == (0, 900_000)
    assert pacer.wait(never)
    hand.now += 4 * MS + 400_000
    assert pacer.wait(never)
    assert (pacer.missed, pacer.overruns) == (3, 1)
    before = hand.now
    pacer.wait(never)  # on the old grid, at once a whole wait
    assert (hand.now, pacer.missed) == (before + 600_000, 3)


def test_what_is_excused_is_no_miss_and_costs_its_lateness_only(hand, pacer):
    for waited, late in ((1_700_000, 0), (2_300_000, 300_000), (100_000, 0)):
        before = hand.now
        hand.now += waited
        pacer.excuse(2)
        assert pacer.wait(never, 2)
        assert (hand.now, pacer.missed) == (before + 2 * MS + late, 0)


@pytest.mark.parametrize("speed", [0.5, 1.0, 3.0, 7.0])
def test_deadlines_are_absolute_and_stretch_without_drift(hand, paced, speed):
    pacer = paced(speed=speed)
    for k in range(1, 7001):
        hand.now += 100_000  # the work of a tick
        assert pacer.wait(never)
        assert hand.now == 5 * MS + round(k * MS / speed)
    assert pacer.missed == 0


def test_as_fast_as_possible_never_sleeps(hand, paced):
    pacer = paced(speed=0.0)
    pacer.excuse(2)
    assert all(pacer.wait(never, 2) for _ in range(100))
    assert hand.slept == []
    assert not pacer.wait(lambda: True)


def test_a_long_wait_can_be_interrupted(hand, paced):
    pacer = paced(10_000 * MS)
    assert not pacer.wait(lambda: hand.now > 105 * MS)
    assert hand.now <= 155 * MS


def test_a_change_of_speed_makes_no_burst(hand, paced):
    pacer = paced(speed=0.001)
    hand.now += 999 * MS
    pacer.change(1.0)
    before = hand.now
    pacer.wait(never)
    assert hand.now == before + MS and pacer.missed == 0


def test_a_coarse_clock_is_run_through_and_a_leap_dropped(hand, paced):
    pacer = paced(tolerance_ns=200 * MS)
    hand.now += 10 * MS
    for _ in range(10):
        pacer.wait(never)
    assert (pacer.missed, hand.slept) == (0, [])
    hand.now += 1000 * MS
    pacer.wait(never)
    assert pacer.missed == 999


def test_a_clock_that_goes_back_starts_anew(hand, pacer):
    hand.now -= 3 * MS
    pacer.wait(never)
    assert (pacer.jumps, pacer.missed, hand.now) == (1, 0, 3 * MS)


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
    clock = Hand(1_700_000_000_000_000_000)
    pacer = Pacer(10**9 // rate, 1.0, clock)
    pacer.change(factor)
    asked = [False] * 3 + [True]
    pacer.wait(lambda: asked.pop(0), 3)
    assert pacer.late_ns >= 0 and all(0 < seconds < 1e9 for seconds in clock.slept)
