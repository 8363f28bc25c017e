# SPDX-License-Identifier: Apache-2.0
"""Headers of messages: names of frames, the mark of a state that is no sample, stamps."""

from __future__ import annotations

from typing import Any

from sst_ros.state import NANOSECONDS

BASE_FRAME = "base_link"
"""Root of the robot (REP 105): frame {B} of the paper."""

IDLE_FRAME_ID = "idle"
"""header.frame_id of joint_states that show a state before the run, in a pause or in a fault."""


def is_idle(stamp_ns: int, frame_id: str) -> bool:
    """Return whether a joint_states message shows a state and is not a sample of a run.

    Recordings of version 0.1 mark such messages by the stamp zero.
    """
    return stamp_ns == 0 or frame_id == IDLE_FRAME_ID


def nanoseconds(stamp: Any) -> int:
    """Return a Time or Duration as one number [ns]."""
    return int(stamp.sec) * NANOSECONDS + int(stamp.nanosec)
