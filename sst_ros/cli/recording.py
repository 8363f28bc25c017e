# SPDX-License-Identifier: Apache-2.0
"""`report`, `plot`, `export`, `recover`: what is made of recorded runs; reports of the methods."""

from __future__ import annotations

import argparse
from pathlib import Path

from sst_ros.cli.parsing import Commands, add_out, add_scene_name, command, free_out, group
from sst_ros.host.output import results_folder


def add_report(commands: Commands) -> None:
    """Add `report` to the command line."""
    kinds = group(commands, "report", "evaluate a recorded run or the integration methods")
    run = command(kinds, "run", _report, "evaluate a recorded run")
    run.add_argument("bag", type=Path, help="folder of the bag")
    add_out(run, "folder of the results", "BAG_report, beside the bag")
    run.add_argument("--verbose", action="store_true", help="print all figures")
    run.add_argument(
        "--damaged", action="store_true", help="evaluate the intact part of a damaged recording"
    )
    what = "work-precision diagrams: error against cost of every method and step"
    accuracy = command(kinds, "accuracy", _accuracy, what)
    add_scene_name(
        accuracy, "--scene", nargs="+", metavar="S",
        help="names, or paths of .yaml files; default: all",
    )  # fmt: skip
    accuracy.add_argument("--all", action="store_true", help="all shipped scenes, the default")
    add_out(accuracy, "folder of the results", "accuracy_out")
    accuracy.add_argument("--mpmath", action="store_true", help="reference in 30 digits, slow")


def add_plot(commands: Commands) -> None:
    """Add `plot` to the command line."""
    plot = command(commands, "plot", _plot, "draw recorded runs, as PDF and PNG")
    plot.add_argument("bags", type=Path, nargs="*", metavar="BAG", help="folder of the bag")
    add_out(plot, "folder of the pictures", "BAG_plots, beside the first bag")
    plot.add_argument("--only", nargs="+", default=[], metavar="NAME", help="draw only these")
    plot.add_argument("--list", action="store_true", help="list the pictures, and draw none")
    plot.add_argument(
        "--compare", nargs="+", type=Path, default=[], metavar="BAG",
        help="overlay runs and print their differences from the first",
    )  # fmt: skip


def add_export(commands: Commands) -> None:
    """Add `export` to the command line."""
    export = command(commands, "export", _export, "write a recorded run as CSV or Parquet")
    export.add_argument("bag", type=Path, metavar="BAG", help="folder of the bag")
    export.add_argument(
        "--format", choices=("csv", "parquet"), default="csv", help="default: csv", dest="form"
    )
    add_out(export, "folder of the tables", "BAG_tables, beside the bag")


def add_recover(commands: Commands) -> None:
    """Add `recover` to the command line."""
    what = "write a valid recording from a truncated or damaged one"
    recovery = command(commands, "recover", _recover, what)
    recovery.add_argument("bag", type=Path, help="folder of the bag")
    recovery.add_argument("--out", type=Path, help="folder of the new bag; default: beside the old")


def _report(options: argparse.Namespace) -> None:
    out = free_out(options, results_folder(options.bag, "report"))
    from sst_ros.report.run import report
    from sst_ros.report.text import table, text

    summary = report(options.bag, out, damaged=options.damaged)
    if options.verbose:
        print(table(summary))
    print(text(summary, str(out)), end="")


def _accuracy(options: argparse.Namespace) -> None:
    out = free_out(options, "accuracy_out")
    from sst_ros.report.accuracy import report
    from sst_ros.report.reference_solution import EXTENDED, MPMATH
    from sst_ros.scene.scene import names

    kind = MPMATH if options.mpmath else EXTENDED
    report(names() if options.all else options.scene or names(), out, kind=kind)


def _plot(options: argparse.Namespace) -> int:
    if options.list:
        from sst_ros.plot import compare, pictures

        for name, picture in pictures.PICTURES.items():
            print(f"{name:<18}{picture.title}; needs {', '.join(picture.needs)}")
        print(f"{'with --compare':<18}{', '.join(compare.PICTURES)}")
        return 0
    bags = [*options.bags, *options.compare]
    if not bags or (len(bags) > 1 and not options.compare):
        options.parser.error("name one BAG, or several with --compare")
    out = free_out(options, results_folder(bags[0], "plots"))
    from sst_ros.plot import compare, pictures
    from sst_ros.recording import signals

    runs = [signals.read(bag) for bag in bags]
    if options.compare:
        print(compare.table(runs))
        paths, missing = compare.draw(runs, out, options.only)
    else:
        paths, missing = pictures.draw(runs[0], out, options.only)
    for path in paths:
        print(path)
    for name, why in missing.items():
        print(f"{name}: {why}")
    return 0 if paths else 1


def _export(options: argparse.Namespace) -> None:
    out = free_out(options, results_folder(options.bag, "tables"))
    from sst_ros.recording.export import export

    for path in export(options.bag, out, options.form, force=options.force):
        print(path)


def _recover(options: argparse.Namespace) -> None:
    from sst_ros.recording.bag_writer import recover

    found = recover(options.bag, options.out)
    print(f"{found.messages} messages recovered into {found.bag}, {found.lost} known to be lost")
    for line in found.damage:
        print(f"  {line}")
