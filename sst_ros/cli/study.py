# SPDX-License-Identifier: Apache-2.0
"""`study`: robustness of controllers to model errors, delay and noise."""

from __future__ import annotations

import argparse
from pathlib import Path

from sst_ros.cli.parsing import Commands, add_out, add_scene, group
from sst_ros.errors import InputError, Problem
from sst_ros.output_folder import require_free


def add(commands: Commands) -> None:
    """Add the command to the command line."""
    kinds = group(commands.add_parser("study", help="robustness of controllers to model errors"))
    feedforward = kinds.add_parser(
        "feedforward",
        help="compare all control schemes under all model errors",
        description="Every mode of control against every error of its model, delay, encoders and "
        "noise; the order of the hold; the largest stable bandwidth. On all cores; the same bits "
        "on any number of them.",
    )
    add_scene(
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
    feedforward.set_defaults(run=_feedforward)


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
    out = require_free(options.out or Path("feedforward_out"), "study", force=options.force)
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
