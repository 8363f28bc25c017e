# SPDX-License-Identifier: Apache-2.0
"""Serialized messages (CDR) read field by field, each field of many messages at once.

Where a field lies follows from the lengths and names before it. Messages of a simulator have the
same ones, so that a million of them are read like one; those that differ are told apart.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

Bytes = NDArray[np.uint8]
Result = TypeVar("Result")

_HEAD = 4
_PADDING = 3


class Malformed(ValueError):
    """The bytes are no message of the type that they should be."""


class Columns:
    """Fields of messages of one length, in order.

    Args:
        rows: a message a row, shape (n, length).

    Raises:
        Malformed: by any method, where a message is too short, or no CDR.

    """

    def __init__(self, rows: Bytes) -> None:
        self._rows = rows
        self._at = _HEAD
        if rows.shape[1] < _HEAD or rows[:, 0].any() or (rows[:, 1] > 1).any():
            raise Malformed("invalid or unsupported CDR encapsulation")
        self._order = "<" if self._same(rows[:, 1]) else ">"

    def numbers(self, kind: str, count: int = 1) -> NDArray[Any]:
        """Read `count` numbers of each message, shape (n, count); kind is i4, u4 or f8."""
        size = int(kind[1:])
        if count:
            self._at += (_HEAD - self._at) % size
        raw = self._take(size * count)
        return (
            np.ascontiguousarray(raw).view(f"{self._order}{kind}").reshape(len(self._rows), count)
        )

    def length(self) -> int:
        """Read the length of a sequence or a text."""
        return int(self._same(self.numbers("u4")[:, 0]))

    def sequence(self) -> NDArray[Any]:
        """Read a sequence of doubles, shape (n, its length)."""
        return self.numbers("f8", self.length())

    def text(self) -> str:
        """Read a text."""
        raw = self._take(self.length())
        if (raw != raw[0]).any():
            raise _Mixed(np.unique(raw, axis=0, return_inverse=True)[1].reshape(-1))
        try:
            return raw[0, :-1].tobytes().decode()
        except UnicodeDecodeError as error:
            raise Malformed(str(error)) from None

    def texts(self) -> tuple[str, ...]:
        """Read a sequence of texts."""
        return tuple(self.text() for _ in range(self.length()))

    def nanoseconds(self) -> NDArray[np.int64]:
        """Read a Time or Duration [ns], shape (n,)."""
        seconds = self.numbers("i4")[:, 0].astype(np.int64)
        return np.asarray(seconds * 1_000_000_000 + self.numbers("u4")[:, 0])

    def stamp(self) -> NDArray[np.int64]:
        """Read a Header's stamp [ns], shape (n,); the name of the frame is passed over."""
        stamp = self.nanoseconds()
        self.text()
        return stamp

    def end(self) -> None:
        """Check that nothing is left but padding."""
        if self._at + _PADDING < self._rows.shape[1]:
            raise Malformed("longer than a message of this type")

    def _take(self, size: int) -> Bytes:
        self._at, start = self._at + size, self._at
        if self._at > self._rows.shape[1]:
            raise Malformed("shorter than a message of this type")
        return self._rows[:, start : self._at]

    def _same(self, values: NDArray[Any]) -> Any:
        """Return the value that decides where the next field is."""
        if (values != values[0]).any():
            raise _Mixed(values)
        return values[0]


class _Mixed(Exception):
    """Messages of different layout are among each other; `by` tells them apart."""

    def __init__(self, by: NDArray[Any]) -> None:
        super().__init__()
        self.by = by


def read(
    received: NDArray[np.int64], rows: Bytes, fields: Callable[[Columns], Result]
) -> Iterator[tuple[NDArray[np.int64], Result]]:
    """Yield what `fields` reads, once for each layout there is, with the receptions [ns].

    Args:
        received: a number for each message, shape (n,).
        rows: messages of one length, shape (n, length).
        fields: reads the fields of all messages that it is given; it must have no other effect.

    Raises:
        Malformed: a message is not of the type that it should be.

    """
    try:
        columns = Columns(rows)
        result = fields(columns)
        columns.end()
    except _Mixed as mixed:
        for value in np.unique(mixed.by):
            part = mixed.by == value
            yield from read(received[part], rows[part], fields)
    else:
        yield received, result
