# SPDX-License-Identifier: Apache-2.0
"""`report`: judge a recorded run, or the methods."""

from __future__ import annotations

import argparse
from pathlib import Path

from sst_ros import scene
from sst_ros.cli import Commands, group


def add(commands: Commands) -> None:
    """Add the command to the command line."""
    kinds = group(commands.add_parser("report", help="judge a recorded run, or the methods"))
    run = kinds.add_parser("run", help="error against run time of a bag")
    run.add_argument("bag", type=Path, help="folder of the bag")
    run.add_argument("--out", type=Path, help="folder of the results; default: beside the bag")
    run.set_defaults(run=_run)
    accuracy = kinds.add_parser("accuracy", help="error against cost of every method and step")
    accuracy.add_argument(
        "--scene", nargs="+", metavar="S", help="names, or paths of .yaml files; default: all"
    )
    accuracy.add_argument(
        "--out", type=Path, default=Path("accuracy_out"), help="folder of the results"
    )
    accuracy.add_argument("--mpmath", action="store_true", help="reference in 30 digits, slow")
    accuracy.set_defaults(run=_accuracy)
    stability = kinds.add_parser("stability", help="stiff and extreme cases, largest steps")
    stability.add_argument(
        "--out", type=Path, default=Path("stability_out"), help="folder of the results"
    )
    stability.set_defaults(run=_stability)


def _run(options: argparse.Namespace) -> None:
    from sst_ros.report.run import report
    from sst_ros.report.table import table

    print(table(report(options.bag, options.out or options.bag.parent / "report")))


def _accuracy(options: argparse.Namespace) -> None:
    from sst_ros.studies.accuracy_report import report
    from sst_ros.studies.high_precision import EXTENDED, MPMATH

    kind = MPMATH if options.mpmath else EXTENDED
    report(options.scene or scene.names(), options.out, kind=kind)


def _stability(options: argparse.Namespace) -> int:
    from sst_ros.studies.stability_report import report

    return 0 if report(options.out) else 1
