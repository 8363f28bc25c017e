# SPDX-License-Identifier: Apache-2.0
"""A message that is serialised once; afterwards only its numbers are written anew, in its bytes.

rclpy converts every field of a message each time it is published, which costs three times as much
as the rest of publishing it.
"""

from __future__ import annotations

import math
from bisect import bisect_left
from collections.abc import Callable, Sequence
from functools import partial
from struct import Struct
from typing import Any

from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.publisher import Publisher
from rclpy.serialization import deserialize_message, serialize_message

from sst_ros.nodes import raw_handles

Write = Callable[..., None]
Send = Callable[[bytes], None]

_NANOSECONDS = 1_000_000_000
_STAMP = 4
"""Where a stamp is in messages that begin with one: behind the encapsulation's four bytes."""


def marks(count: int, first: int = 0) -> list[float]:
    """Numbers to put into a message for `Template.place` to find."""
    return [math.pi * (first + k + 1) for k in range(count)]


def _serialised(message: Any) -> bytes:
    """Serialise without what rclpy leaves behind the end: it estimates the size from above."""
    whole: bytes = serialize_message(message)

    def is_whole(size: int) -> bool:
        try:
            deserialize_message(whole[:size], type(message))
        except rclpy_implementation.RMWError:
            return False
        return True

    return whole[: bisect_left(range(len(whole) + 1), True, key=is_whole)]


class Template:
    """The bytes of a message.

    Args:
        message: its numbers that will change are `marks`, no two the same.

    """

    def __init__(self, message: Any) -> None:
        self._bytes = bytearray(_serialised(message))
        self._order = "<" if self._bytes[1] & 1 else ">"
        self._stamp = Struct(f"{self._order}iI")

    def place(self, values: Sequence[float]) -> Write:
        """Find doubles that stand side by side; the function takes others to write there."""
        struct = Struct(f"{self._order}{len(values)}d")
        now = struct.pack(*values)
        if self._bytes.count(now) != 1:
            raise ValueError(f"{values} does not stand once in the message")
        return partial(struct.pack_into, self._bytes, self._bytes.index(now))

    def __bytes__(self) -> bytes:
        """Give the message as it is."""
        return bytes(self._bytes)

    def stamped(self, nanoseconds: int) -> bytes:
        """Give the message with this stamp."""
        self._stamp.pack_into(self._bytes, _STAMP, *divmod(nanoseconds, _NANOSECONDS))
        return bytes(self._bytes)


class Outlet:
    """A topic for bytes.

    Attributes:
        send: publishes a message's bytes.
        readers: tells how many read it now. What nobody reads need not be made: unless the topic
            is latched nobody gets it later.

    """

    def __init__(self, publisher: Publisher) -> None:
        handle = raw_handles.keep(publisher.handle)
        self.send: Send = handle.publish_raw
        self.readers: Callable[[], int] = handle.get_subscription_count
