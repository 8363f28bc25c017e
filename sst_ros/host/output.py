# SPDX-License-Identifier: Apache-2.0
"""What a long command leaves and shows: its folder of results, tables, and a bar while it works.

A folder is named after the recording, and is never written over unasked. A file that
others may read has its name when it is whole. Tables of numbers are Parquet, NPZ or
CSV: the first two hold every bit, texts about the table, and a checksum of both;
Parquet has the checksums of its pages besides, for other readers. CSV has the columns
alone, for other programs.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import sys
import uuid
import zlib
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sst_ros.errors import (
    MissingDependency,
    check_regular,
    refusal,
    refuse_errors,
    refuse_unless,
    require,
)

TEMPORARY = ".part-"
"""How the name of a file begins that is not whole yet, or that a killed process has left."""

SUFFIXES = (".parquet", ".csv", ".npz")
_CHECKSUM = "sst_ros_checksum"
_BAG_SUFFIXES = (".mcap", ".db3")
_PARTS = 50


def results_folder(bag: Path, kind: str) -> Path:
    """Return the default folder of the results of a recording, beside it: BAG_kind."""
    path = bag.resolve() if bag.name in ("", "..") else bag
    name = path.stem if path.suffix in _BAG_SUFFIXES else path.name
    return path.with_name(f"{name}_{kind}")


def require_free(
    out: Path, origin: str, *, force: bool = False, option: str = "--out"
) -> Path:
    """Return `out`, a file or a folder to be written, if nothing there would be overwritten.

    An InputError names `origin`, the command that writes, and `option`, which gave
    `out`: that is a file, or a folder that is not empty, and `force` is not set; or it
    cannot be read.
    """
    with refuse_errors(
        origin, option, str(out), "must be a path that can be written", OSError
    ):
        taken = any(out.iterdir()) if out.is_dir() else out.exists()
    allowed = f"exists already: choose another {option}, or overwrite it with --force"
    refuse_unless(origin, (option, str(out), force or not taken, allowed))
    return out


@contextmanager
def write_into(out: Path, origin: str) -> Iterator[None]:
    """Make the folder `out` for a block that writes into it, or raise an InputError of `origin`."""
    with refuse_errors(
        origin, "--out", str(out), "must be a folder that can be written", OSError
    ):
        out.mkdir(parents=True, exist_ok=True)
        yield


@contextmanager
def hold_folder(out: Path, origin: str) -> Iterator[None]:
    """Make the folder `out` for a block that alone writes into it.

    Remove it if it stays empty.

    Raises InputError of `origin` where another writer has it, in this process or
    another.
    """
    with write_into(out, origin):
        lock = os.open(out, os.O_RDONLY | os.O_DIRECTORY)
    try:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            allowed = "is being written by another run: wait until that has ended"
            raise refusal(origin, "--out", str(out), allowed) from None
        except OSError:  # a network file system may not lock folders
            pass
        yield
    finally:
        os.close(lock)
        with contextlib.suppress(OSError):  # it is not empty
            out.rmdir()


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


class Bar:
    """A bar that shows how much of something is done, where `shown` and stderr is a terminal."""

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
    size = size or max(1, total // _PARTS)
    bar = Bar(label, shown)
    for start in range(0, total, size):
        done = min(start + size, total)
        yield slice(start, done)
        bar.draw(done / total)


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


def write_table(
    columns: Mapping[str, NDArray[Any]],
    path: Path,
    about: Mapping[str, Mapping[str, str]],
    texts: Mapping[str, str] | None = None,
) -> None:
    """Write columns of equal length, shape (n,), whole numbers or doubles.

    The suffix of the path, one of SUFFIXES, says what the file is. Parquet keeps texts
    about each column, as its unit, and about the table, NPZ the latter; nan is no value
    in Parquet and CSV, which need pyarrow and pandas.
    """
    texts = dict(texts or {})
    texts[_CHECKSUM] = compute_checksum(texts, columns)
    with replace_file(path) as own:
        if path.suffix == ".npz":
            named: dict[str, Any] = {**columns, **texts}
            with own.open("wb") as file:
                np.savez(file, **named)
        elif path.suffix == ".csv":
            # pandas writes the fewest digits that read back as the same bits.
            require("pandas").DataFrame(columns).to_csv(
                own, index=False, lineterminator="\n"
            )
        else:
            pyarrow, parquet = require("pyarrow"), require("pyarrow.parquet")
            arrays = [
                pyarrow.array(column, from_pandas=True) for column in columns.values()
            ]
            fields = [
                pyarrow.field(name, array.type, metadata=about[name])
                for name, array in zip(columns, arrays, strict=True)
            ]
            whole = pyarrow.Table.from_arrays(
                arrays, schema=pyarrow.schema(fields, texts)
            )
            parquet.write_table(whole, own, write_page_checksum=True)


def load_table(
    path: Path, columns: Sequence[str], texts: Sequence[str]
) -> tuple[dict[str, NDArray[Any]], dict[str, str]]:
    """Read columns, shape (n,), and texts of a Parquet or NPZ file of any name.

    Parquet of earlier versions has no checksum.

    Raises:
        KeyError: a column or a text is not in the file.
        ValueError: it is another file, it cannot be read, or it is damaged.
        MissingDependency: pyarrow is not installed.

    """
    try:
        check_regular(path)
        with path.open("rb") as file:
            zipped = file.read(2) == b"PK"
        if zipped:
            with np.load(path, allow_pickle=False) as source:
                numbers = {name: source[name] for name in columns}
                found = {name: str(source[name]) for name in (*texts, _CHECKSUM)}
        else:
            parquet = require("pyarrow.parquet")
            with parquet.ParquetFile(path, page_checksum_verification=True) as source:
                table = source.read()
            numbers = {name: table[name].to_numpy() for name in columns}
            raw = table.schema.metadata or {}
            found = {key.decode(): text.decode() for key, text in raw.items()}
        asked = {name: found[name] for name in texts}
    except (KeyError, MissingDependency):
        raise
    except Exception as error:  # pyarrow and zipfile raise anything on bad bytes
        raise ValueError(" ".join(str(error).split())) from None
    checksum = compute_checksum(asked, numbers)
    if found.get(_CHECKSUM, checksum) != checksum:
        raise ValueError("its checksum is another")
    return numbers, asked


def compute_checksum(
    texts: Mapping[str, str], columns: Mapping[str, NDArray[Any]]
) -> str:
    """CRC-32 of texts and of the bits of columns."""
    checksum = zlib.crc32("".join(texts.values()).encode())
    for column in columns.values():
        checksum = zlib.crc32(column.tobytes(), checksum)
    return f"{checksum:08x}"
