# SPDX-License-Identifier: Apache-2.0
"""A bar on the terminal that shows how much of a long computation is done."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Iterator
from typing import TypeVar

Result = TypeVar("Result")
_DEFAULT_PARTS = 50


class Bar:
    """A bar that shows how much is done, where `shown` and stderr is a terminal."""

    def __init__(self, label: str, shown: bool) -> None:
        self._label, self._percent = label, -1
        self._drawn = shown and sys.stderr.isatty()

    def draw(self, share: float, text: str = "") -> None:
        """Show that this share is done, from 0 to 1, and a text."""
        percent = int(100.0 * share)
        if self._drawn and percent != self._percent:
            self._percent, bar = percent, "#" * (40 * percent // 100)
            line = f"\r{self._label} [{bar:40}] {percent:3d} %" + (
                f" {text:60.60}" if text else ""
            )
            print(line, end="\n" if percent == 100 else "", file=sys.stderr, flush=True)


def slices(total: int, size: int, label: str, shown: bool) -> Iterator[slice]:
    """Yield slices of `size`, 0 for some fifty.

    Where `shown`, draw a bar on a terminal.
    """
    size = size or max(1, total // _DEFAULT_PARTS)
    bar = Bar(label, shown)
    for start in range(0, total, size):
        done = min(start + size, total)
        yield slice(start, done)
        bar.draw(done / total)


def follow(results: Iterable[Result], total: int, label: str) -> Iterator[Result]:
    """Yield results as they arrive.

    With a label, draw how many of `total` are there.
    """
    bar = Bar(label, bool(label))
    for done, result in enumerate(results, start=1):
        yield result
        bar.draw(done / total)
