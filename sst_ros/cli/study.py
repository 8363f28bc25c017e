# SPDX-License-Identifier: Apache-2.0
"""`sweep`: many runs of a scene by a study file."""

from __future__ import annotations

import argparse
from pathlib import Path

from sst_ros.cli.parsing import (
    Commands,
    command,
    free_out,
    integer_from,
)


def add_sweep(commands: Commands) -> None:
    """Add `sweep` to the command line."""
    sweep = command(
        commands, "sweep", _sweep, "many runs of a scene with varied numbers",
        description="Run a study of many runs. `sst-ros sweep plot DIR` draws its results.",
    )  # fmt: skip
    sweep.add_argument(
        "study", type=Path, metavar="STUDY", help="study as a .yaml file; or the word plot"
    )
    sweep.add_argument(
        "folder", type=Path, nargs="?", metavar="DIR", help="with plot: folder of results"
    )
    sweep.add_argument(
        "--out", type=Path, help="folder of the results; default: STUDY_sweep, or with plot DIR"
    )
    sweep.add_argument(
        "--scheduler", metavar="ADDRESS", help="Dask scheduler, as tcp://host:8786; default: none"
    )
    sweep.add_argument("--workers", type=integer_from(1, 1024), help="threads; default: one a core")
    sweep.add_argument(
        "--resume", action="store_true", help="compute only the chunks that are missing in --out"
    )


def _sweep(options: argparse.Namespace) -> None:
    if str(options.study) == "plot":
        return _plot(options)
    if options.folder is not None:
        options.parser.error("DIR is an argument of `sweep plot`; give --out DIR")
    if options.scheduler and options.workers:
        options.parser.error("--workers is for this machine; a scheduler has workers of its own")
    out = options.out or options.study.with_name(f"{options.study.stem}_sweep")
    if not options.resume:
        free_out(options, out)
    from sst_ros.sweeps.sweep import run_study
    from sst_ros.sweeps.sweep_study import SweepStudy
    from sst_ros.sweeps.sweep_summary import summary

    study, client = SweepStudy.read(options.study), None
    if options.scheduler:
        from sst_ros.sweeps.cluster_engine import connect

        client = connect(options.scheduler)
    try:
        table = run_study(
            study, out, client=client, workers=options.workers or 0, resume=options.resume
        )
    finally:
        if client is not None:
            client.close(timeout=5)
    print(summary(table))
    print(f"Results in {out}; `sst-ros sweep plot {out}` draws them.")
    return None


def _plot(options: argparse.Namespace) -> None:
    given = {"--scheduler": options.scheduler, "--workers": options.workers}
    if options.folder is None or any(given.values()) or options.resume:
        options.parser.error("usage: sst-ros sweep plot DIR [--out DIR]")
    from sst_ros.sweeps.parts import read_sweep
    from sst_ros.sweeps.sweep_pictures import draw

    for path in draw(read_sweep(options.folder), options.out or options.folder):
        print(path)
