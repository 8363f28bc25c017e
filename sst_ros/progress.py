# SPDX-License-Identifier: Apache-2.0
"""A bar on the terminal that shows how much of a long computation is done."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Iterator
from typing import TypeVar

Result = TypeVar("Result")
_DEFAULT_PARTS = 50


class Bar:
    """A bar on the terminal that shows how much is done, if it is visible."""

    def __init__(self, label: str, visible: bool) -> None:
        self._label = label
        self._percent = -1
        self._visible = visible and sys.stderr.isatty()

    def draw(self, share: float, text: str = "") -> None:
        """Show that this share is done, from 0 to 1, and a text."""
        if not self._visible:
            return
        percent = int(100.0 * share)
        if percent == self._percent:
            return
        self._percent = percent
        bar = "#" * (40 * percent // 100)
        line = f"\r{self._label} [{bar:40}] {percent:3d} %"
        if text:
            line += f" {text:60.60}"
        print(line, end="\n" if percent == 100 else "", file=sys.stderr, flush=True)


def slices(total: int, size: int, label: str, visible: bool) -> Iterator[slice]:
    """Yield slices of `size`, 0 for some fifty; draw a bar if it is `visible`."""
    size = size or max(1, total // _DEFAULT_PARTS)
    bar = Bar(label, visible)
    for start in range(0, total, size):
        end = min(start + size, total)
        yield slice(start, end)
        bar.draw(end / total)


def follow(results: Iterable[Result], total: int, label: str) -> Iterator[Result]:
    """Yield results as they arrive.

    With a label, draw how many of `total` have arrived.
    """
    bar = Bar(label, bool(label))
    for count, result in enumerate(results, start=1):
        yield result
        bar.draw(count / total)
