# SPDX-License-Identifier: Apache-2.0
"""Folders and files that a command writes, and the templates of their texts.

Nothing is written over unasked. A file that others may read gets its name when it is
whole.
"""

from __future__ import annotations

import os
import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from sst_ros.errors import refuse_errors, refuse_unless

TEMPORARY = ".part-"
"""How the name of a file begins that is not whole yet.

A killed process may have left it.
"""


def require_free(
    target: Path, origin: str, *, force: bool = False, option: str = "--out"
) -> Path:
    """Return the path `target` if writing there overwrites nothing.

    Raises InputError of `origin`, the command that writes, and `option`, which gave the
    path: where it is a file, or a folder that is not empty, and `force` is not set; and
    where it cannot be read.
    """
    with refuse_errors(
        origin, option, str(target), "must be a path that can be written", OSError
    ):
        taken = any(target.iterdir()) if target.is_dir() else target.exists()
    requirement = (
        f"exists already: choose another {option}, or overwrite it with --force"
    )
    refuse_unless(origin, (option, str(target), force or not taken, requirement))
    return target


@contextmanager
def write_into(target: Path, origin: str) -> Iterator[None]:
    """Make the folder `target` for a block that writes into it.

    An InputError of `origin` is raised where it cannot be written.
    """
    with refuse_errors(
        origin, "--out", str(target), "must be a folder that can be written", OSError
    ):
        target.mkdir(parents=True, exist_ok=True)
        yield


@contextmanager
def replace_file(path: Path) -> Iterator[Path]:
    """Give a block a name of its own to write to.

    What it wrote then becomes `path` at once.

    A reader of `path` has the earlier file or the later one, even if several processes
    write it, and after a power cut.
    """
    own = path.with_name(f"{TEMPORARY}{uuid.uuid4().hex}")
    try:
        yield own
        with own.open("rb") as file:
            os.fsync(file.fileno())
        own.replace(path)
    finally:
        own.unlink(missing_ok=True)


def load_templates(room: str) -> Any:
    """Return the Jinja templates in the folder of a room; HTML and XML are escaped."""
    import jinja2  # what only reads and writes files needs none

    return jinja2.Environment(
        loader=jinja2.PackageLoader(f"sst_ros.{room}"),
        autoescape=jinja2.select_autoescape(["html", "xml"], default_for_string=False),
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
