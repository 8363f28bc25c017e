# SPDX-License-Identifier: Apache-2.0
"""`study`, `sweep`: robustness of controllers, and many runs of a scene by a study file."""

from __future__ import annotations

import argparse
from pathlib import Path

from sst_ros.cli.parsing import (
    Commands,
    add_out,
    add_scene_name,
    command,
    free_out,
    group,
    integer_from,
)
from sst_ros.errors import InputError, Problem


def add_study(commands: Commands) -> None:
    """Add `study` to the command line."""
    feedforward = command(
        group(commands, "study", "robustness of controllers to model errors"),
        "feedforward", _feedforward, "compare all control schemes under all model errors",
        description="Every mode of control against every error of its model, delay, encoders and "
        "noise; the order of the hold; the largest stable bandwidth. On all cores; the same bits "
        "on any number of them.",
    )  # fmt: skip
    add_scene_name(
        feedforward, "--scene", default="reach",
        help="scene with a motion: name, or path of a .yaml file; default: reach",
    )  # fmt: skip
    feedforward.add_argument(
        "--period", type=float, default=1e-3, help="control period [s]; default: 0.001"
    )
    feedforward.add_argument(
        "--bandwidths", type=float, nargs="+", default=[20.0, 60.0, 180.0], metavar="W",
        help="of the feedback [rad/s]; default: 20 60 180",
    )  # fmt: skip
    feedforward.add_argument(
        "--damping-ratio", type=float, default=1.0, help="of the feedback; default: 1"
    )
    feedforward.add_argument("--seed", type=int, default=8, help="of the noise; default: 8")
    feedforward.add_argument("--workers", type=int, help="processes; default: one a core")
    add_out(feedforward, "folder of feedforward.csv, .json, .md and .png", "feedforward_out")


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


def _feedforward(options: argparse.Namespace) -> None:
    problems = []
    if not 1e-6 <= options.period <= 1.0:
        problems.append(Problem("--period", options.period, "must be from 1e-6 to 1 s"))
    if options.seed < 0:
        problems.append(Problem("--seed", options.seed, "must be >= 0"))
    if options.workers is not None and options.workers < 1:
        problems.append(Problem("--workers", options.workers, "must be >= 1"))
    if problems:
        raise InputError("study", problems)
    out = free_out(options, "feedforward_out")
    from sst_ros.scene.scene import load
    from sst_ros.studies.feedforward import FeedforwardPlan
    from sst_ros.studies.feedforward_report import report

    plan = FeedforwardPlan(
        load(options.scene),
        period_ns=round(options.period * 1e9),
        bandwidths=tuple(dict.fromkeys(options.bandwidths)),
        damping_ratio=options.damping_ratio,
        seed=options.seed,
    )
    report(plan, out, workers=options.workers)


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
