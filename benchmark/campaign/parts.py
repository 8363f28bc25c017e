# SPDX-License-Identifier: Apache-2.0
"""The parts of the campaign, by name. A module of its own: worker processes import it."""

from __future__ import annotations

import importlib
import time

from benchmark.campaign.ledger import Budget, Ledger

PARTS = {
    "documents": "scenes", "extremes": "scenes", "invariants": "scenes", "bits": "scenes",
    "command_lines": "commands", "surroundings": "commands",
    "damages": "recordings", "recorder_kills": "recordings",
    "messages": "nodes", "floods": "nodes", "services": "nodes", "parameters": "nodes",
    "stuck": "nodes", "node_kills": "nodes", "clock": "nodes", "starts": "nodes",
}  # fmt: skip
FUNCTIONS = {"recorder_kills": "kills", "node_kills": "kills"}


def run(part: str, share: float, seed: int, patience: float = 1.0) -> Ledger:
    """Run one part in this process."""
    module = importlib.import_module(f"benchmark.campaign.{PARTS[part]}")
    began = time.monotonic()
    try:
        ledger: Ledger = getattr(module, FUNCTIONS.get(part, part))(Budget(share, patience), seed)
    except Exception as error:
        ledger = Ledger(part)
        ledger.found("tracebacks", f"the part itself ended: {type(error).__name__}: {error}")
    ledger.seconds = time.monotonic() - began
    return ledger
