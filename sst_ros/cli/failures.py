# SPDX-License-Identifier: Apache-2.0
"""What the command line prints for an exception, and its exit status."""

from __future__ import annotations

from sst_ros.errors import SstError
from sst_ros.extras import explanation

FAILED, BUG, INTERRUPTED = 1, 3, 130


def failure(error: BaseException) -> tuple[int, str]:
    """Return the exit status and the message, "" for none."""
    message = _message(error)
    if message is not None:
        return (INTERRUPTED if isinstance(error, KeyboardInterrupt) else FAILED), message
    bug = " ".join(f"{type(error).__name__}: {error}".split())
    return BUG, f"internal error, please report it with the output of --debug: {bug}"


def _message(error: BaseException) -> str | None:
    """Return the message for an error that is not a fault of this program, else None."""
    if isinstance(error, KeyboardInterrupt):
        return "interrupted"
    if isinstance(error, BrokenPipeError):
        return ""
    if isinstance(error, SstError):
        return str(error)
    if isinstance(error, ModuleNotFoundError):
        return explanation(error)
    if isinstance(error, OSError):
        where = f"{error.filename}: " if error.filename is not None else ""
        return f"{where}{error.strerror or error}"
    if isinstance(error, UnicodeError):
        return f"text cannot be encoded or decoded: {error}"
    if isinstance(error, MemoryError):
        return "not enough memory"
    if type(error).__module__.partition(".")[0] in ("rclpy", "rosbags"):
        return " ".join(str(error).split())
    return None
