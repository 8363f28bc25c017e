# SPDX-License-Identifier: Apache-2.0
"""Handles of rclpy that stay in use: to enter and leave one each time costs as much as its work.

A handle in use outlives its node, and then other nodes believe for 20 s that the node is there.
"""

from __future__ import annotations

from contextlib import ExitStack
from typing import Any

_IN_USE = ExitStack()


def keep(handle: Any) -> Any:
    """Have a publisher's or reader's handle in use from now on."""
    _IN_USE.enter_context(handle)
    return handle


def release() -> None:
    """Let go of all that is kept, before its node is destroyed."""
    _IN_USE.close()
