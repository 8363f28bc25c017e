# SPDX-License-Identifier: Apache-2.0
"""The parts of the campaign, and what each has tried and found."""

from __future__ import annotations

import contextlib
import importlib
import math
import random
import time
from collections.abc import Iterator
from dataclasses import dataclass, field

from sst_ros.errors import SstError

KINDS = {
    "hangs": "hangs",
    "tracebacks": "tracebacks",
    "silent": "silent differences",
    "lost": "lost",
}
"""Kinds of findings, and the heads of their columns."""


@dataclass
class Ledger:
    """What one part may try, and counts of what it has found.

    Attributes:
        what: what was tried, as the table shows it.
        share: share of the full count of cases, 1 for the whole campaign.
        seed: of all random choices.
        patience: factor of all bounds of time; a busy machine needs more than 1.
        tried: how many cases.
        hangs: calls beyond their bound.
        tracebacks: errors that are not one of ours, or a traceback on a terminal.
        silent: differences that nothing reported.
        lost: messages lost beyond what the design allows.
        notes: what a finding was, one line each.

    """

    what: str
    share: float = 1.0
    seed: int = 0
    patience: float = 1.0
    tried: int = 0
    hangs: int = 0
    tracebacks: int = 0
    silent: int = 0
    lost: int = 0
    seconds: float = 0.0
    longest_s: float = 0.0
    notes: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.rng = random.Random(self.seed)

    def numbers(self, full: int, least: int = 1) -> range:
        """Return numbers of the cases to try, of `full` in the whole campaign."""
        return range(max(least, round(full * self.share)))

    def cases(self, full: int, least: int = 1) -> Iterator[int]:
        """Yield these numbers, and count each as a case."""
        for number in self.numbers(full, least):
            self.tried += 1
            yield number

    def add_finding(self, column: str, note: str, count: int = 1) -> None:
        """Count a finding of one of KINDS."""
        setattr(self, column, getattr(self, column) + count)
        self.notes.append(f"{column}: {note}"[:400])

    def time(self, took: float, bound: float, case_name: str) -> None:
        """Keep how long something took [s]; beyond its bound it is a hang."""
        self.longest_s = max(self.longest_s, took if math.isfinite(took) else 0.0)
        if took > bound * self.patience:
            self.add_finding("hangs", f"{case_name}: {took:.2f} s")

    @property
    def sound(self) -> bool:
        """Whether nothing was found."""
        return not any(getattr(self, column) for column in KINDS)

    @contextlib.contextmanager
    def case(self, name: str, bound: float) -> Iterator[None]:
        """Try one case in this process: our own errors are answers, others are
        findings.

        Its time is that of the processor: other work on the machine does not count.
        """
        self.tried += 1
        began = time.process_time()
        try:
            yield
        except SstError:
            pass
        except Exception as error:
            self.add_finding("tracebacks", f"{name}: {type(error).__name__}: {error}")
        self.time(time.process_time() - began, bound, name)


PARTS = {
    "invariants": ("scenes", "random scenes: invariants over 0.1 s"),
    "bits": ("scenes", "random scenes: machine code against plain Python"),
    "estimates": ("scenes", "error estimates: twelve classes of scenes, all methods"),
    "workers": ("machine", "simulations in threads, forked and spawned processes"),
    "saves": ("machine", "saves to one path at a time"),
    "damage": ("machine", "files with a bit flipped, or cut"),
    "interrupts": ("machine", "commands with signals, and without streams"),
    "command_lines": ("commands", "command lines"),
    "surroundings": ("commands", "surroundings: home, disk, locale, user"),
    "cold_threads": ("users", "first use in threads of a new process"),
    "user_functions": ("users", "exceptions of a user's function"),
    "foreign_files": ("users", "foreign scenes, studies, tables and motions"),
    "sweep_parts": ("users", "parts of sweeps flipped, cut, copied, swapped, added"),
    "measurements": ("users", "measurements of wrong signs, units, legs, faults"),
    "message_orders": ("nodes", "messages of two topics in every order"),
    "recorder_kills": ("nodes", "recorders killed with -9"),
    "messages": ("nodes", "hostile messages"),
    "parameters": ("nodes", "parameters set at run time"),
    "stuck": ("nodes", "steps that do not end"),
    "node_kills": ("nodes", "players and controllers killed with -9"),
    "starts": ("nodes", "starts and stops"),
}
"""Module of each part, a function of a ledger, and what it tries."""


def run_part(part_name: str, share: float, seed: int, patience: float = 1.0) -> Ledger:
    """Run one part in this process."""
    room, description = PARTS[part_name]
    ledger, began = Ledger(description, share, seed, patience), time.monotonic()
    try:
        module = importlib.import_module(f"benchmark.campaign.{room}")
        getattr(module, part_name)(ledger)
    except Exception as error:
        ledger.add_finding(
            "tracebacks", f"the part itself ended: {type(error).__name__}: {error}"
        )
    ledger.seconds = time.monotonic() - began
    return ledger
