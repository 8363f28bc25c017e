# SPDX-License-Identifier: Apache-2.0
"""Command line: `python -m sst_ros COMMAND ...`."""

from __future__ import annotations

import argparse
import importlib
import json
import sys
from pathlib import Path

from sst_ros import scene
from sst_ros.errors import SstError
from sst_ros.json_schema import json_schema

NODES = ("simulator", "torque_player", "recorder")


def main(arguments: list[str] | None = None) -> int:
    """Run a command; return the exit status."""
    given = sys.argv[1:] if arguments is None else arguments
    if given and given[0] in NODES:
        status: int = importlib.import_module(f"sst_ros.nodes.{given[0]}").main(given)
        return status
    options = _parser().parse_args(given)
    try:
        done: int = options.run(options) or 0
    except SstError as error:
        print(f"sst_ros: {error}", file=sys.stderr)
        return 1
    return done


def _demo(options: argparse.Namespace) -> int:
    from sst_ros.demo import demo

    return demo(options.out)


def _report_run(options: argparse.Namespace) -> None:
    from sst_ros.report.run import report
    from sst_ros.report.table import table

    print(table(report(options.bag, options.out or options.bag.parent / "report")))


def _report_accuracy(options: argparse.Namespace) -> None:
    from sst_ros.report.accuracy_run import report
    from sst_ros.report.precise import EXTENDED, MPMATH

    kind = MPMATH if options.mpmath else EXTENDED
    report(options.scene or scene.names(), options.out, kind=kind)


def _report_stability(options: argparse.Namespace) -> int:
    from sst_ros.report.stability_run import report

    return 0 if report(options.out) else 1


def _recover(options: argparse.Namespace) -> None:
    from sst_ros.nodes.recovery import recover

    bag, messages, cut = recover(options.bag, options.out)
    print(
        f"{messages} messages recovered into {bag}" + (", the recording is cut off" if cut else "")
    )


def _scene_list(_: argparse.Namespace) -> None:
    for name in scene.names():
        print(f"{name:<18}{scene.load(name).description}")


def _scene_show(options: argparse.Namespace) -> None:
    from sst_ros.report.sheet import sheet

    print(sheet(scene.load(options.scene)), end="")


def _scene_check(options: argparse.Namespace) -> int:
    from sst_ros.report.check import check

    failed = 0
    for path in options.files:
        try:
            check(path)
            print(f"{path}: valid")
        except SstError as error:
            failed = 1
            print(error)
    return failed


def _scene_schema(_: argparse.Namespace) -> None:
    print(json.dumps(json_schema(scene.Scene, "sst_ros scene"), indent=2))


def _scene_keys(_: argparse.Namespace) -> None:
    from sst_ros.report.keys import keys

    print(keys(), end="")


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m sst_ros",
        description=__doc__,
        epilog=f"Nodes, which take --ros-args: {', '.join(NODES)}.",
    )
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    demo = commands.add_parser("demo", help="run the paper's examples through the nodes")
    demo.add_argument("--out", type=Path, default=Path("demo_out"), help="folder of the results")
    demo.set_defaults(run=_demo)

    report = _group(commands.add_parser("report", help="judge a recorded run, or the methods"))
    run = report.add_parser("run", help="error against run time of a bag")
    run.add_argument("bag", type=Path, help="folder of the bag")
    run.add_argument("--out", type=Path, help="folder of the results; default: beside the bag")
    run.set_defaults(run=_report_run)
    accuracy = report.add_parser("accuracy", help="error against cost of every method and step")
    accuracy.add_argument(
        "--scene", nargs="+", metavar="S", help="names, or paths of .yaml files; default: all"
    )
    accuracy.add_argument(
        "--out", type=Path, default=Path("accuracy_out"), help="folder of the results"
    )
    accuracy.add_argument("--mpmath", action="store_true", help="reference in 30 digits, slow")
    accuracy.set_defaults(run=_report_accuracy)
    stability = report.add_parser("stability", help="stiff and extreme cases, largest steps")
    stability.add_argument(
        "--out", type=Path, default=Path("stability_out"), help="folder of the results"
    )
    stability.set_defaults(run=_report_stability)

    recovery = commands.add_parser("recover", help="save what a killed recorder has written")
    recovery.add_argument("bag", type=Path, help="folder of the bag")
    recovery.add_argument("--out", type=Path, help="folder of the new bag; default: beside the old")
    recovery.set_defaults(run=_recover)

    scenes = _group(commands.add_parser("scene", help="look at scenes"))
    scenes.add_parser("list", help="the scenes that come with sst_ros").set_defaults(
        run=_scene_list
    )
    show = scenes.add_parser("show", help="what a scene is made of and what it costs")
    show.add_argument("scene", help="name, or path of a .yaml file")
    show.set_defaults(run=_scene_show)
    check = scenes.add_parser("check", help="tell every fault of scene files")
    check.add_argument("files", nargs="+", type=Path, metavar="FILE")
    check.set_defaults(run=_scene_check)
    schema = scenes.add_parser("schema", help="JSON schema for editors")
    schema.set_defaults(run=_scene_schema)
    keys = scenes.add_parser("keys", help="reference of all keys, as Markdown")
    keys.set_defaults(run=_scene_keys)
    return parser


def _group(parser: argparse.ArgumentParser) -> argparse._SubParsersAction[argparse.ArgumentParser]:
    return parser.add_subparsers(dest="kind", required=True, metavar="KIND")


if __name__ == "__main__":
    sys.exit(main())
