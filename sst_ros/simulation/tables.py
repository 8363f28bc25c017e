# SPDX-License-Identifier: Apache-2.0
"""Tables of numbers in files: Parquet, NPZ or CSV.

Parquet and NPZ hold every bit, texts about the table, and a checksum of both. Parquet
also has the checksums of its pages, for other readers. CSV has the columns alone, for
other programs.
"""

from __future__ import annotations

import zlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from sst_ros.errors import MissingDependency, check_regular, require
from sst_ros.files import replace_file

SUFFIXES = (".parquet", ".csv", ".npz")
_CHECKSUM = "sst_ros_checksum"


def write_table(
    columns: Mapping[str, NDArray[Any]],
    path: Path,
    about: Mapping[str, Mapping[str, str]],
    texts: Mapping[str, str] | None = None,
) -> None:
    """Write columns of equal length, shape (n,), whole numbers or doubles.

    The suffix of the path, one of SUFFIXES, gives the form of the file. Parquet keeps
    `about`, texts about each column such as its unit, and `texts` about the table; NPZ
    keeps the latter. In Parquet and CSV, which need pyarrow and pandas, nan is a
    missing value.
    """
    texts = dict(texts or {})
    texts[_CHECKSUM] = compute_checksum(texts, columns)
    with replace_file(path) as file_path:
        if path.suffix == ".npz":
            entries: dict[str, Any] = {**columns, **texts}
            with file_path.open("wb") as file:
                np.savez(file, **entries)
        elif path.suffix == ".csv":
            # pandas writes the fewest digits that read back as the same bits.
            frame = require("pandas").DataFrame(columns)
            frame.to_csv(file_path, index=False, lineterminator="\n")
        else:
            _write_parquet(columns, file_path, about, texts)


def _write_parquet(
    columns: Mapping[str, NDArray[Any]],
    path: Path,
    about: Mapping[str, Mapping[str, str]],
    texts: Mapping[str, str],
) -> None:
    pyarrow = require("pyarrow")
    parquet = require("pyarrow.parquet")
    arrays = []
    fields = []
    for name, column in columns.items():
        array = pyarrow.array(column, from_pandas=True)
        arrays.append(array)
        fields.append(pyarrow.field(name, array.type, metadata=about[name]))
    schema = pyarrow.schema(fields, texts)
    table = pyarrow.Table.from_arrays(arrays, schema=schema)
    parquet.write_table(table, path, write_page_checksum=True)


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
        # Opened here: NumPy leaves a damaged file open that it has opened itself.
        with path.open("rb") as file:
            zipped = file.read(2) == b"PK"
            if zipped:
                file.seek(0)
                numbers, stored_texts = _read_npz(file, columns, texts)
        if not zipped:
            parquet = require("pyarrow.parquet")
            with parquet.ParquetFile(path, page_checksum_verification=True) as source:
                table = source.read()
            numbers = {name: table[name].to_numpy() for name in columns}
            raw = table.schema.metadata or {}
            stored_texts = {key.decode(): text.decode() for key, text in raw.items()}
        requested_texts = {name: stored_texts[name] for name in texts}
    except (KeyError, MissingDependency):
        raise
    except Exception as error:  # pyarrow and zipfile raise anything on bad bytes
        raise ValueError(" ".join(str(error).split())) from None
    checksum = compute_checksum(requested_texts, numbers)
    if stored_texts.get(_CHECKSUM, checksum) != checksum:
        raise ValueError("its checksum is another")
    return numbers, requested_texts


def _read_npz(
    file: BinaryIO, columns: Sequence[str], texts: Sequence[str]
) -> tuple[dict[str, NDArray[Any]], dict[str, str]]:
    """Read columns and texts, with the checksum, of an NPZ file."""
    with np.load(file, allow_pickle=False) as source:
        numbers = {name: source[name] for name in columns}
        stored_texts = {name: str(source[name]) for name in (*texts, _CHECKSUM)}
    return numbers, stored_texts


def compute_checksum(
    texts: Mapping[str, str], columns: Mapping[str, NDArray[Any]]
) -> str:
    """Return the CRC-32 of texts and of the bits of columns, in hexadecimal."""
    checksum = zlib.crc32("".join(texts.values()).encode())
    for column in columns.values():
        checksum = zlib.crc32(np.ascontiguousarray(column).data, checksum)
    return f"{checksum:08x}"
