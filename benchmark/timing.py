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
    told: Callable[[int, int], None] = lambda done, of: None,
) -> dict[Key, list[float]]:
    """Seconds of each call, one number a round.

    Every round times every call, so that what slows the machine for a while slows all of them.
    A call that is shorter than `shortest` is repeated until it is not, and divided.
    """
    repeats = {key: _repeats(call, shortest) for key, call in calls.items()}
    seconds: dict[Key, list[float]] = {key: [] for key in calls}
    collecting = gc.isenabled()
    gc.disable()
    try:
        for done in range(rounds):
            for key, call in calls.items():
                seconds[key].append(_timed(call, repeats[key]))
            gc.collect()
            told(done + 1, rounds)
    finally:
        if collecting:
            gc.enable()
    return seconds


def ratio(seconds: dict[Key, list[float]], first: Key, second: Key) -> float:
    """Median over the rounds of first / second: each quotient is of the same round."""
    return median(a / b for a, b in zip(seconds[first], seconds[second], strict=True))


def _repeats(call: Callable[[], Any], shortest: float) -> int:
    call()
    once = _timed(call, 1)
    return max(1, round(shortest / once)) if once < shortest else 1


def _timed(call: Callable[[], Any], repeats: int) -> float:
    begin = time.perf_counter()
    for _ in range(repeats):
        call()
    return (time.perf_counter() - begin) / repeats
