# SPDX-License-Identifier: Apache-2.0
"""A small share of the campaign that tries to break the program.

The whole is run by hand.
"""

import pytest

from benchmark.campaign.ledger import PARTS, Ledger, run_part
from sst_ros.errors import EXTRAS, SstError

ROS = {part for part, (room, _) in PARTS.items() if room == "nodes"}
LONG = {"bits", "estimates", "workers", "interrupts", "cold_threads", "surroundings"}
NEEDS = {
    "bits": ("llvmlite",),
    "damage": ("mcap", "rosbags"),
    "invariants": ("flint",),
    "messages": ("flint",),
    "saves": ("mcap", "rosbags"),
}
"""Optional packages of a part."""
QUICK = {"messages", *(PARTS.keys() - ROS - LONG)}


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
