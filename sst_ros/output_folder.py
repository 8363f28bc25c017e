# SPDX-License-Identifier: Apache-2.0
"""The folder that results are written into."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from sst_ros.errors import InputError, Problem


@contextmanager
def writing(out: Path, origin: str) -> Iterator[None]:
    """Make the folder `out` for a block that writes into it.

    Raises:
        InputError: it cannot be written; `origin` says whose input it is.

    """
    try:
        out.mkdir(parents=True, exist_ok=True)
        yield
    except OSError as error:
        allowed = f"must be a folder that can be written ({error})"
        raise InputError(origin, [Problem("out", str(out), allowed)]) from None
