# SPDX-License-Identifier: Apache-2.0
"""`report`: evaluate a recorded run or the integration methods."""

from __future__ import annotations

import argparse
from pathlib import Path

from sst_ros.cli.parsing import Commands, add_out, add_scene, group
from sst_ros.output_folder import require_free, results_folder


def add(commands: Commands) -> None:
    """Add the command to the command line."""
    kinds = group(
        commands.add_parser("report", help="evaluate a recorded run or the integration methods")
    )
    run = kinds.add_parser("run", help="evaluate a recorded run")
    run.add_argument("bag", type=Path, help="folder of the bag")
    add_out(run, "folder of the results", "BAG_report, beside the bag")
    run.add_argument("--verbose", action="store_true", help="print all figures")
    run.add_argument(
        "--damaged", action="store_true", help="evaluate the intact part of a damaged recording"
    )
    run.set_defaults(run=_run)
    accuracy = kinds.add_parser(
        "accuracy", help="work-precision diagrams: error against cost of every method and step"
    )
    add_scene(
        accuracy, "--scene", nargs="+", metavar="S",
        help="names, or paths of .yaml files; default: all",
    )  # fmt: skip
    accuracy.add_argument("--all", action="store_true", help="all shipped scenes, the default")
    add_out(accuracy, "folder of the results", "accuracy_out")
    accuracy.add_argument("--mpmath", action="store_true", help="reference in 30 digits, slow")
    accuracy.add_argument(
        "--control", action="store_true",
        help="error against control rate, method and hold in the run loop; scenes with torques,"
        " default: example2 friction",
    )  # fmt: skip
    accuracy.add_argument("--nodes", action="store_true", help="with --control: real nodes, too")
    accuracy.set_defaults(run=_accuracy)
    stability = kinds.add_parser("stability", help="stiff and extreme cases, largest steps")
    add_out(stability, "folder of the results", "stability_out")
    stability.add_argument(
        "--long", action="store_true", help="1e5 s of swinging and a thousand contacts too, minutes"
    )
    stability.set_defaults(run=_stability)


def _run(options: argparse.Namespace) -> None:
    out = options.out or results_folder(options.bag, "report")
    require_free(out, "report", force=options.force)
    from sst_ros.report.run import report
    from sst_ros.report.table import table
    from sst_ros.report.verdict import text

    summary = report(options.bag, out, damaged=options.damaged)
    if options.verbose:
        print(table(summary))
    print(text(summary, str(out)), end="")


def _accuracy(options: argparse.Namespace) -> None:
    out = require_free(options.out or Path("accuracy_out"), "report", force=options.force)
    if options.control:
        _control(options, out)
        return
    from sst_ros.scene.scene import names
    from sst_ros.studies.accuracy_report import report
    from sst_ros.studies.reference_solution import EXTENDED, MPMATH

    kind = MPMATH if options.mpmath else EXTENDED
    report(names() if options.all else options.scene or names(), out, kind=kind)


def _control(options: argparse.Namespace, out: Path) -> None:
    from sst_ros import demo
    from sst_ros.studies.control_rate_report import SCENES, report

    def record(name: str, bag: Path, rate: int, hold: str) -> None:
        demo.record(name, demo.empty_bag(bag.parent, bag.name), rate=rate, hold=hold)

    report(options.scene or SCENES, out, record=record if options.nodes else None)


def _stability(options: argparse.Namespace) -> int:
    out = require_free(options.out or Path("stability_out"), "report", force=options.force)
    from sst_ros.studies.stability_report import report

    return 0 if report(out, long=options.long) else 1
