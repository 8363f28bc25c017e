# SPDX-License-Identifier: Apache-2.0
"""What a long command leaves and shows: its folder of results, and a bar while it works.

A folder is named after the recording, and is never written over unasked. A file that others may
read has its name when it is whole.
"""

from __future__ import annotations

import os
import sys
import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from sst_ros.errors import InputError, Problem, refuse_unless

TEMPORARY = ".part-"
"""How the name of a file begins that is not whole yet, or that a killed process has left."""

_BAG_SUFFIXES = (".mcap", ".db3")
_PARTS = 50


def results_folder(bag: Path, kind: str) -> Path:
    """Return the default folder of the results of a recording, beside it: BAG_kind."""
    path = bag.resolve() if bag.name in ("", "..") else bag
    name = path.stem if path.suffix in _BAG_SUFFIXES else path.name
    return path.with_name(f"{name}_{kind}")


def require_free(out: Path, origin: str, *, force: bool = False, option: str = "--out") -> Path:
    """Return `out`, a file or a folder to be written, if nothing there would be overwritten.

    An InputError names `origin`, the command that writes, and `option`, which gave `out`: that is
    a file, or a folder that is not empty, and `force` is not set; or it cannot be read.
    """
    try:
        taken = any(out.iterdir()) if out.is_dir() else out.exists()
    except OSError as error:
        allowed = f"must be a path that can be written ({error})"
        raise InputError(origin, [Problem(option, str(out), allowed)]) from None
    allowed = f"exists already: choose another {option}, or overwrite it with --force"
    refuse_unless(origin, (option, str(out), force or not taken, allowed))
    return out


@contextmanager
def write_into(out: Path, origin: str) -> Iterator[None]:
    """Make the folder `out` for a block that writes into it, or raise an InputError of `origin`."""
    try:
        out.mkdir(parents=True, exist_ok=True)
        yield
    except OSError as error:
        allowed = f"must be a folder that can be written ({error})"
        raise InputError(origin, [Problem("--out", str(out), allowed)]) from None


@contextmanager
def replace_file(path: Path) -> Iterator[Path]:
    """Give a block a name of its own to write to; what it wrote then becomes `path` at once.

    A reader of `path` has the earlier file or the later one, even if several processes write it,
    and after a power cut.
    """
    own = path.with_name(f"{TEMPORARY}{uuid.uuid4().hex}")
    try:
        yield own
        with own.open("rb") as file:
            os.fsync(file.fileno())
        own.replace(path)
    finally:
        own.unlink(missing_ok=True)


class Bar:
    """A bar that shows how much of something is done, where `shown` and stderr is a terminal."""

    def __init__(self, label: str, shown: bool) -> None:
        self._label, self._percent = label, -1
        self._drawn = shown and sys.stderr.isatty()

    def draw(self, share: float, text: str = "") -> None:
        """Show that this share is done, from 0 to 1, and a text."""
        percent = int(100.0 * share)
        if not self._drawn or percent == self._percent:
            return
        self._percent = percent
        bar = "#" * (40 * percent // 100)
        end = "\n" if percent == 100 else ""
        more = f" {text:60.60}" if text else ""
        line = f"\r{self._label} [{bar:40}] {percent:3d} %{more}"
        print(line, end=end, file=sys.stderr, flush=True)


def slices(total: int, size: int, label: str, shown: bool) -> Iterator[slice]:
    """Yield slices of `size`, 0 for some fifty; where `shown`, draw a bar on a terminal."""
    size = size or max(1, total // _PARTS)
    bar = Bar(label, shown)
    for start in range(0, total, size):
        done = min(start + size, total)
        yield slice(start, done)
        bar.draw(done / total)
