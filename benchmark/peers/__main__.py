# SPDX-License-Identifier: Apache-2.0
"""Error against processor time on one second of Example 2, for sst_ros and its peers.

python -m benchmark.peers [--quick] [--rounds N] [--only ENGINE ...] [--out FOLDER]
[--no-page]
"""

from __future__ import annotations

import argparse
import importlib
import importlib.util
import sys
import time
from pathlib import Path

from benchmark.measure import DOCS
from benchmark.peers import results
from benchmark.peers.floor import find_floor
from benchmark.peers.study import TARGETS, Series, run_study, solve_task
from benchmark.peers.task import Task
from sst_ros.programs.llvm import llvmlite_version

MODULES = {
    "ours": "llvmlite",
    "mujoco_peer": "mujoco",
    "pinocchio_peer": "pinocchio",
    "casadi_peer": "casadi",
    "scipy_peer": "scipy",
}
"""Who brings series, and the module without which it has none."""


def main(arguments: list[str] | None = None) -> int:
    """Run the study; the exit status is 1 where an engine fails its gate."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmark.peers", description=__doc__
    )
    parser.add_argument("--quick", action="store_true", help="smaller sweep, 3 rounds")
    parser.add_argument("--rounds", type=int, help="rounds of timing (9; quick: 3)")
    parser.add_argument(
        "--only", nargs="+", choices=MODULES, help="these engines and ours"
    )
    parser.add_argument(
        "--out", type=Path, default=DOCS, help="folder of peers.md and the rest"
    )
    parser.add_argument(
        "--no-page", action="store_true", help="table on the terminal only"
    )
    options = parser.parse_args(arguments)
    if llvmlite_version() is None:
        parser.error("needs llvmlite, which compiles our side: pip install llvmlite")
    begin = time.monotonic()
    task = Task()
    series, missing = collect(task, options.quick, options.only)
    truth = solve_task(task)
    rounds = options.rounds or (3 if options.quick else 9)
    curves = run_study(task, truth, series, rounds)
    least = find_floor(task, TARGETS)
    seconds = time.monotonic() - begin
    result = results.Results(
        curves, missing, truth, rounds, options.quick, seconds, least
    )
    print("\n\n".join(result.parts().values()))
    if not options.no_page:
        options.out.mkdir(parents=True, exist_ok=True)
        results.write(result, options.out)
        print(f"\nWritten: {options.out}/peers.md, .png, .csv, .json")
        if options.out == DOCS and not (options.quick or options.only):
            results.write_readme()
            print("Written: the table of README.md")
    return 0 if all(curve.passed for curve in curves) else 1


def collect(
    task: Task, quick: bool, only: list[str] | None = None
) -> tuple[list[Series], dict[str, str]]:
    """Series of all engines that are installed, and why the others have none."""
    found: list[Series] = []
    missing: dict[str, str] = {}
    for name, needed in MODULES.items():
        if only and name not in ("ours", *only):
            continue
        module = importlib.import_module(f"benchmark.peers.{name}")
        if importlib.util.find_spec(needed) is None:
            missing[module.ENGINE] = f"not installed (pip install {module.PACKAGE})"
            continue
        found += module.series(task, quick)
    return found, missing


if __name__ == "__main__":
    sys.exit(main())
