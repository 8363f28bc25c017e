# SPDX-License-Identifier: Apache-2.0
"""Wall times that can be compared on a machine that others use too: rounds, then medians."""

from __future__ import annotations

import gc
import time
from collections.abc import Callable, Hashable
from statistics import median
from typing import Any, TypeVar

Key = TypeVar("Key", bound=Hashable)


def interleaved(
    calls: dict[Key, Callable[[], Any]],
    rounds: int = 9,
    shortest: float = 2e-3,
    progress: Callable[[int, int], None] = lambda done, of: None,
    clock: Callable[[], float] = time.perf_counter,
) -> dict[Key, list[float]]:
    """Seconds of each call, one number a round.

    Every round times every call, so that what slows the machine for a while slows all of them.
    A call that is shorter than `shortest` is repeated until it is not, and divided. A `clock` of
    processor time leaves out what others do on the machine meanwhile, which long calls would
    otherwise have more of than short ones; it is for work of one thread.
    """
    repeats = {key: _repeats(call, shortest, clock) for key, call in calls.items()}
    seconds: dict[Key, list[float]] = {key: [] for key in calls}
    collecting = gc.isenabled()
    gc.disable()
    try:
        for done in range(rounds):
            for key, call in calls.items():
                seconds[key].append(_timed(call, repeats[key], clock))
            gc.collect()
            progress(done + 1, rounds)
    finally:
        if collecting:
            gc.enable()
    return seconds


def ratio(seconds: dict[Key, list[float]], first: Key, second: Key) -> float:
    """Median over the rounds of first / second: each quotient is of the same round."""
    return median(a / b for a, b in zip(seconds[first], seconds[second], strict=True))


def _repeats(call: Callable[[], Any], shortest: float, clock: Callable[[], float]) -> int:
    call()
    once = _timed(call, 1, clock)
    return max(1, round(shortest / once)) if once < shortest else 1


def _timed(call: Callable[[], Any], repeats: int, clock: Callable[[], float]) -> float:
    begin = clock()
    for _ in range(repeats):
        call()
    return (clock() - begin) / repeats
