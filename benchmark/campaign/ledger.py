# SPDX-License-Identifier: Apache-2.0
"""The parts of the campaign, and what each has tried and found."""

from __future__ import annotations

import contextlib
import importlib
import time
from collections.abc import Iterator
from dataclasses import dataclass, field

HANG_S = 1.0
"""A call that takes longer than this is a hang, unless its part states another bound."""

KINDS = ("hangs", "tracebacks", "silent", "lost")


@dataclass
class Ledger:
    """Counts of one part.

    Attributes:
        what: what was tried, as the table shows it.
        patience: factor of all bounds of time; a busy machine needs more than 1.
        tried: how many cases.
        hangs: calls beyond their bound.
        tracebacks: errors that are not one of ours, or a traceback on a terminal.
        silent: differences that nothing reported.
        lost: messages lost beyond what the design allows.
        notes: what a finding was, one line each.

    """

    what: str
    patience: float = 1.0
    tried: int = 0
    hangs: int = 0
    tracebacks: int = 0
    silent: int = 0
    lost: int = 0
    seconds: float = 0.0
    longest_s: float = 0.0
    notes: list[str] = field(default_factory=list)

    def found(self, kind: str, note: str, count: int = 1) -> None:
        """Count a finding of one of KINDS."""
        setattr(self, kind, getattr(self, kind) + count)
        self.notes.append(f"{kind}: {note}"[:400])

    @property
    def sound(self) -> bool:
        """Whether nothing was found."""
        return not any(getattr(self, kind) for kind in KINDS)

    @contextlib.contextmanager
    def case(
        self, name: str, allowed: tuple[type[BaseException], ...], bound: float = HANG_S
    ) -> Iterator[None]:
        """Try one case in this process: errors of `allowed` are answers, others are findings.

        Its time is that of the processor: other work on the machine does not count.
        """
        self.tried += 1
        began = time.process_time()
        try:
            yield
        except allowed:
            pass
        except Exception as error:
            self.found("tracebacks", f"{name}: {type(error).__name__}: {error}")
        took = time.process_time() - began
        self.longest_s = max(self.longest_s, took)
        if took > bound * self.patience:
            self.found("hangs", f"{name}: {took:.2f} s")


class Budget:
    """How much of a part is run, and how long it may take.

    Args:
        share: share of the full count of cases, 1 for the whole campaign.
        patience: factor of all bounds of time.

    """

    def __init__(self, share: float, patience: float = 1.0) -> None:
        self.share, self.patience = share, patience

    def ledger(self, what: str) -> Ledger:
        """Open the ledger of a part."""
        return Ledger(what, self.patience)

    def cases(self, full: int, least: int = 1) -> range:
        """Return numbers of the cases to try, of `full` in the whole campaign."""
        return range(max(least, round(full * self.share)))


ROOMS = {
    "scenes": "documents extremes invariants bits",
    "commands": "command_lines surroundings",
    "recordings": "damages recorder_kills",
    "nodes": "messages floods services parameters stuck node_kills clock starts",
}
PARTS = {part: room for room, parts in ROOMS.items() for part in parts.split()}
"""Name and module of each part, a function of a budget and a seed."""


def run_part(part: str, share: float, seed: int, patience: float = 1.0) -> Ledger:
    """Run one part in this process."""
    module = importlib.import_module(f"benchmark.campaign.{PARTS[part]}")
    began = time.monotonic()
    try:
        ledger: Ledger = getattr(module, part)(Budget(share, patience), seed)
    except Exception as error:
        ledger = Ledger(part)
        ledger.found("tracebacks", f"the part itself ended: {type(error).__name__}: {error}")
    ledger.seconds = time.monotonic() - began
    return ledger
