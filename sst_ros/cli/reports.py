# SPDX-License-Identifier: Apache-2.0
"""Commands that evaluate and draw: recorded runs, the integration methods, the demo."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from sst_ros import demo
from sst_ros.cli.commands import free_out, function, results_folder
from sst_ros.errors import refuse_unless
from sst_ros.files import replace_file, require_free
from sst_ros.plot import compare, pictures
from sst_ros.recording.recording import read_signals
from sst_ros.scene.scene import load, names


def report_run(options: argparse.Namespace) -> None:
    """Evaluate a recorded run."""
    folder = free_out(options, results_folder(options.bag, "report"))
    write = function("report.run_page:write_run_report")
    summary = write(
        options.bag, folder, damaged=options.damaged, namespace=options.namespace
    )
    if options.verbose:
        print(function("report.run:summary_table")(summary))
    print(function("report.run:summary_text")(summary, str(folder)), end="")


def report_accuracy(options: argparse.Namespace) -> None:
    """Measure the error and the run time of every method."""
    folder = free_out(options, "accuracy_out")
    function("report.accuracy:write_accuracy_report")(options.scenes or names(), folder)


def report_stability(options: argparse.Namespace) -> int:
    """Find the stable steps along a motion, and run the scene with other numbers."""
    folder = free_out(options, "stability_out")
    write = function("report.stability:write_stability_report")
    return 0 if write(load(options.scene), folder, options.only) else 1


def draw_pictures(options: argparse.Namespace) -> int:
    """Draw a recorded run, or list the pictures."""
    if options.list:
        for name, picture in pictures.RUN_PICTURES.items():
            print(f"{name:<18}{picture.title}; needs {', '.join(picture.needs)}")
        print(f"{'sst-ros compare':<18}{', '.join(compare.COMPARISON_PICTURES)}")
        return 0
    if options.compare:
        print("plot --compare is deprecated: use sst-ros compare", file=sys.stderr)
        options.bags = list(options.compare)
        if options.bag is not None:
            options.bags.insert(0, options.bag)
        options.csv = None
        options.namespace = [options.namespace] if options.namespace else []
        return compare_runs(options)
    if options.bag is None:
        options.parser.error("name a BAG")
    folder = free_out(options, results_folder(options.bag, "plots"))
    run = read_signals(options.bag, namespace=options.namespace)
    return _tell(*pictures.draw_run(run, folder, options.only))


def compare_runs(options: argparse.Namespace) -> int:
    """Print and draw how recorded runs differ from the first."""
    folder = free_out(options, results_folder(options.bags[0], "compared"))
    if options.csv is not None:
        require_free(options.csv, "compare", force=options.force)
    runs = [
        read_signals(bag, namespace=namespace)
        for bag, namespace in _pair(options.bags, options.namespace)
    ]
    drawn = compare.draw_comparison(runs, folder, options.only)
    print(compare.difference_text(runs))
    if options.csv is not None:
        with replace_file(options.csv) as path:
            compare.differences(runs).to_csv(path, lineterminator="\n")
        print(options.csv)
    return _tell(*drawn)


def _pair(bags: list[Path], namespaces: list[str]) -> list[tuple[Path, str | None]]:
    """Return each compared run by its bag and its namespace.

    The namespace is None for the only run of a bag.
    """
    if not namespaces:
        return [(bag, None) for bag in bags]
    if len(bags) == 1:
        bags = bags * len(namespaces)
    if len(namespaces) == 1:
        namespaces = namespaces * len(bags)
    requirement = f"must be one, or one for each of {len(bags)} bags"
    fits = len(namespaces) == len(bags)
    refuse_unless("compare", ("--namespace", namespaces, fits, requirement))
    return list(zip(bags, namespaces, strict=True))


def _tell(paths: list[Path], missing: dict[str, str]) -> int:
    """Print which pictures were drawn, and which not; return the exit status."""
    for path in paths:
        print(path)
    for name, reason in missing.items():
        print(f"{name}: {reason}")
    return 0 if paths else 1


def _demonstrate_control(options: argparse.Namespace) -> None:
    """Have the controller follow a motion in each mode; evaluate each run."""
    target = free_out(options, "demo_out/feedforward")
    name = options.scene or demo.FOLLOWED
    write = function("report.tracking:write_tracking_report")
    for mode in options.mode or demo.DEMO_MODES:
        print(f"{name}, {mode}: {load(name).description}", flush=True)
        bag = demo.follow(name, target / mode, mode)
        print(write(bag, target / mode), flush=True)


def run_demo(options: argparse.Namespace) -> None:
    """Run the paper's examples by the nodes, or follow a motion; evaluate each run."""
    if options.kind == "feedforward":
        _demonstrate_control(options)
        return
    if options.scene or options.mode:
        options.parser.error("--scene and --mode are options of `demo feedforward`")
    target = free_out(options, "demo_out")
    for name in demo.EXAMPLES:
        folder = target if name == "example2" else target / name  # the main job
        print(f"{name}: {load(name).description}", flush=True)
        bag = demo.record(name, folder)
        summary = function("report.run_page:write_run_report")(bag, folder)
        print(function("report.run:summary_text")(summary, str(folder)), flush=True)
        proven = function("report.accuracy:proven_error")(name)
        print(f"Error of simulate on {name}, proven to be below: {proven}", flush=True)
