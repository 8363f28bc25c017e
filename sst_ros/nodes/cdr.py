# SPDX-License-Identifier: Apache-2.0
"""Serialised messages with fields at known places: CDR, little-endian (OMG DDS-XTypes, XCDR1).

`Publisher.publish` takes bytes. To convert a message object each time costs three times as much as
the rest of publishing it (docs/nodes.md has the figures).
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterable
from functools import partial

_ENCAPSULATION = b"\x00\x01\x00\x00"
_STAMP = struct.Struct("<iI")
_NANOSECONDS = 1_000_000_000

Write = Callable[..., None]
"""Writes numbers into their place in the message."""


class CdrMessage:
    """Bytes of a message; the methods append its fields in the order of its definition.

    Alignment counts from the end of the encapsulation header: numbers lie at multiples of their
    size.
    """

    def __init__(self) -> None:
        self._data = bytearray(_ENCAPSULATION)

    def header(self, frame_id: str) -> None:
        """Append a std_msgs/Header, whose stamp `stamped` writes."""
        self.time(0)
        self.string(frame_id)

    def time(self, nanoseconds: int) -> None:
        """Append a builtin_interfaces Time or Duration."""
        self._align(4)
        self._data += _STAMP.pack(*divmod(nanoseconds, _NANOSECONDS))

    def length(self, count: int) -> None:
        """Append the length of a sequence."""
        self._align(4)
        self._data += struct.pack("<I", count)

    def string(self, text: str) -> None:
        """Append a string: its length with the closing zero, the characters, zero."""
        encoded = text.encode() + b"\x00"
        self.length(len(encoded))
        self._data += encoded

    def strings(self, texts: Iterable[str]) -> None:
        """Append a sequence of strings."""
        listed = [*texts]
        self.length(len(listed))
        for text in listed:
            self.string(text)

    def doubles(self, count: int) -> Write:
        """Append `count` doubles, zero; the function writes their values."""
        self._align(8)
        place = len(self._data)
        self._data += bytes(8 * count)
        return partial(struct.Struct(f"<{count}d").pack_into, self._data, place)

    def double_sequence(self, count: int) -> Write:
        """Append a sequence of `count` doubles, zero; the function writes their values."""
        self.length(count)
        return self.doubles(count) if count else _nothing

    def stamped(self, nanoseconds: int) -> bytes:
        """Return the message with this stamp [ns] in the header that it begins with."""
        _STAMP.pack_into(self._data, len(_ENCAPSULATION), *divmod(nanoseconds, _NANOSECONDS))
        return bytes(self._data)

    def _align(self, size: int) -> None:
        self._data += bytes(-(len(self._data) - len(_ENCAPSULATION)) % size)


def _nothing() -> None:
    """Write no value."""
