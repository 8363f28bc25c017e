# SPDX-License-Identifier: Apache-2.0
"""Settings of Fast DDS, the default middleware, beyond its defaults. Others ignore them.

By default a reliable writer asks its readers every 3 s what has arrived, and then removes 1500
samples at once while the publisher waits: one to three milliseconds, hence missed ticks. Five times
a second it takes a fifteenth of that; more often it would cost a thread that wakes for each topic.

By default a reliable writer also wakes its thread for events after each message and reader, to
ignore requests for it for a time of zero: half of what publishing costs. With 50 ms (the element's
name is spelt as Fast DDS spells it) the thread wakes 20 times a second; a message that was lost is
repeated that much later.
"""

from __future__ import annotations

import os
import time
from collections.abc import Iterable
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from rclpy.duration import Duration
from rclpy.publisher import Publisher

_FIRST_RCLPY_ON_FAST_DDS_3 = 9
"""Of ROS 2 Kilted."""

_ACKNOWLEDGE_S = 1.2
"""A subscriber that was killed never acknowledges: a node ends within 2 s of a signal."""


def configure() -> None:
    """Select our profile of Fast DDS, unless the user has selected one. Before `rclpy.init`."""
    names = ("FASTRTPS_DEFAULT_PROFILES_FILE", "FASTDDS_DEFAULT_PROFILES_FILE")
    if any(os.environ.get(name) for name in names):
        return
    generation = _generation()
    profile = Path(__file__).with_name(f"fast_dds_{generation}.xml")
    os.environ[names[generation - 2]] = str(profile)


def _generation() -> int:
    """2 or 3: they differ in the names of the variable and of the setting."""
    try:
        major = int(version("rclpy").partition(".")[0])
    except (PackageNotFoundError, ValueError):
        return 3
    return 3 if major >= _FIRST_RCLPY_ON_FAST_DDS_3 else 2


def finish(publishers: Iterable[Publisher[Any]]) -> None:
    """Wait a while until the subscribers have received what was published."""
    deadline = time.monotonic() + _ACKNOWLEDGE_S
    for publisher in publishers:
        left = max(0.0, deadline - time.monotonic())
        publisher.wait_for_all_acked(Duration(seconds=left))
