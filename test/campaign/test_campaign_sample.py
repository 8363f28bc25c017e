# SPDX-License-Identifier: Apache-2.0
"""A small share of the campaign that tries to break the program.

The whole is run by hand.
"""

import signal
import sys
import time
from subprocess import Popen, TimeoutExpired

import pytest

from benchmark.campaign.ledger import PARTS, Ledger, run_part
from benchmark.campaign.processor import communicate, wait_for_end
from sst_ros.errors import EXTRAS, SstError

ROS = {part for part, (room, _) in PARTS.items() if room == "nodes"}
LONG = {
    *("bits", "cold_threads", "command_lines", "estimates", "foreign_files"),
    *("interrupts", "invariants", "messages", "surroundings", "workers"),
}
NEEDS = {
    "bits": ("llvmlite",),
    "damage": ("mcap", "rosbags"),
    "invariants": ("flint",),
    "messages": ("flint",),
    "saves": ("mcap", "rosbags"),
    "sweep_parts": ("pyarrow",),
}
"""Optional packages of a part."""
QUICK = PARTS.keys() - ROS - LONG


@pytest.mark.parametrize(
    "part",
    [
        part if part in QUICK else pytest.param(part, marks=pytest.mark.slow)
        for part in sorted(PARTS)
    ],
)
def test_nothing_is_found_in_a_share_of(part):
    if part in ROS:
        pytest.importorskip("rclpy", reason="needs rclpy: pip install .[ros]")
    for module in NEEDS.get(part, ()):
        reason = f"needs {module}: pip install .[{EXTRAS[module]}]"
        pytest.importorskip(module, reason=reason)
    # Other tests run at the same time: only what takes ten times its bound is a hang
    # here.
    ledger = run_part(part, 0.02, seed=7, patience=10.0)
    assert ledger.tried > 0
    assert ledger.sound, "\n".join(ledger.notes)


def test_a_finding_is_counted_and_named():
    ledger = Ledger("nothing")
    with ledger.case("a wrong error", bound=1.0):
        raise KeyError("x")
    with ledger.case("an answer", bound=1.0):
        raise SstError
    assert (ledger.tried, ledger.tracebacks, ledger.sound) == (2, 1, False)
    assert "a wrong error" in ledger.notes[0]


@pytest.mark.slow
def test_waits_for_a_processor_are_no_hang():
    """A process that waits for its turn is not late, one that sleeps is."""
    turns = """if True:
        import os, time
        os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
        while time.thread_time() < 0.3:
            pass
        """
    crowd = [Popen([sys.executable, "-c", turns], text=True) for _ in range(8)]
    began = time.monotonic()
    assert wait_for_end(crowd[0], 600.0) < 0.5 * (time.monotonic() - began)
    for process in crowd:
        process.wait()
    sleeper = Popen([sys.executable, "-c", "import time; time.sleep(3600)"])
    with pytest.raises(TimeoutExpired):
        communicate(sleeper, 1.0)
    assert sleeper.returncode == -signal.SIGKILL
