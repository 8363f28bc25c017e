# SPDX-License-Identifier: Apache-2.0
"""Try to break sst_ros; print counts of what was tried and found.

python -m benchmark.campaign                 # the whole, 15 to 25 minutes on two cores
python -m benchmark.campaign --share 0.03    # a sample of it
python -m benchmark.campaign --only bits invariants
python -m benchmark.campaign --write         # and write docs/robustness.md
"""

from __future__ import annotations

import argparse
import os
import platform
import sys
import time
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor, as_completed
from datetime import date
from multiprocessing import get_context

from benchmark.campaign.ledger import KINDS, PARTS, Ledger, run_part
from benchmark.measure import DOCS, fill_page
from sst_ros.report.results import data_frame, markdown

PAGE = DOCS / "robustness.md"


def format_ledgers(ledgers: list[Ledger]) -> str:
    """Return the table of all parts, Markdown."""
    rows = [
        {
            "what was tried": ledger.what,
            "cases": ledger.tried,
            **{name: getattr(ledger, attribute) for attribute, name in KINDS.items()},
            "longest [s]": f"{ledger.longest_s:.2f}",
        }
        for ledger in ledgers
    ]
    return markdown(data_frame(rows))


def run_apart(part_name: str, share: float, seed: int, patience: float) -> Ledger:
    """Run a part in a new process: what it leaves in memory is no other's."""
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as process:
        return process.submit(run_part, part_name, share, seed, patience).result()


def main() -> int:
    """Run the campaign; exit with 1 where anything was found."""
    parser = argparse.ArgumentParser(
        description=__doc__, prog="python -m benchmark.campaign"
    )
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.add_argument(
        "--share", type=float, default=1.0, help="share of all cases, 0 to 1"
    )
    parser.add_argument(
        "--seed", type=int, default=2026, help="seed of all random choices"
    )
    parser.add_argument("--only", nargs="+", choices=sorted(PARTS), help="parts to run")
    parser.add_argument(
        "--patience", type=float, default=1.0, help="factor of bounds of time"
    )
    parser.add_argument("--processes", type=int, default=2, help="parts at once")
    parser.add_argument("--write", action="store_true", help=f"write {PAGE.name}")
    options = parser.parse_args()
    part_names = options.only or list(PARTS)
    began = time.monotonic()
    ledger_of_part: dict[str, Ledger] = {}
    with ThreadPoolExecutor(options.processes) as pool:
        # The longest first: `bits` compiles 200 scenes, then the nodes.
        long_first = sorted(
            part_names,
            key=lambda part_name: (part_name != "bits", PARTS[part_name][0] != "nodes"),
        )
        waiting = {
            pool.submit(
                run_apart, part_name, options.share, options.seed, options.patience
            ): part_name
            for part_name in long_first
        }
        for future in as_completed(waiting):
            part_name = waiting[future]
            ledger_of_part[part_name] = ledger = future.result()
            mark = "ok" if ledger.sound else "FOUND"
            summary = (
                f"{part_name}: {mark}, {ledger.tried} cases, {ledger.seconds:.0f} s"
            )
            notes = "".join(f"\n    {note}" for note in ledger.notes[:20])
            print(
                f"[{len(ledger_of_part)}/{len(part_names)}] {summary}{notes}",
                flush=True,
            )
    ledgers = [ledger_of_part[part_name] for part_name in part_names]
    text = format_ledgers(ledgers)
    minutes = (time.monotonic() - began) / 60
    print(
        f"\n{text}\n\nseed {options.seed}, share {options.share:g}, {minutes:.1f}"
        " minutes"
    )
    if options.write:
        provenance = (
            f"Seed {options.seed}, share {options.share:g} of all cases, {minutes:.0f}"
            f" minutes, bounds of time times {options.patience:g}, load"
            f" {os.getloadavg()[0]:.0f} at the end, {platform.machine()}, Python"
            f" {platform.python_version()}, {date.today()}."
        )
        fill_page(PAGE, {"results": f"{text}\n\n{provenance}"})
    return 0 if all(ledger.sound for ledger in ledgers) else 1


if __name__ == "__main__":
    sys.exit(main())
