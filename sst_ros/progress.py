# SPDX-License-Identifier: Apache-2.0
"""Long work in slices, with a bar on a terminal and silence in a pipe."""

from __future__ import annotations

import sys
from collections.abc import Iterator

_PARTS = 50


def slices(total: int, size: int, label: str, shown: bool) -> Iterator[slice]:
    """Yield slices of `size`, 0 for some fifty; where `shown`, draw a bar on a terminal."""
    size = size or max(1, total // _PARTS)
    drawn = shown and sys.stderr.isatty()
    for start in range(0, total, size):
        done = min(start + size, total)
        yield slice(start, done)
        if drawn:
            bar = "#" * (40 * done // total)
            end = "\n" if done == total else ""
            print(f"\r{label} [{bar:40}] {100 * done // total:3d} %", end=end, file=sys.stderr)
