# SPDX-License-Identifier: Apache-2.0
"""Command line: `python -m sst_ros COMMAND ...`."""

from __future__ import annotations

import argparse
import importlib
import sys
from pathlib import Path

from sst_ros.errors import SstError

NODES = ("simulator", "torque_player", "recorder")


def main(arguments: list[str] | None = None) -> int:
    """Run a command; return the exit status."""
    given = sys.argv[1:] if arguments is None else arguments
    if given and given[0] in NODES:
        status: int = importlib.import_module(f"sst_ros.nodes.{given[0]}").main(given)
        return status
    options = _parser().parse_args(given)
    try:
        if options.command == "demo":
            from sst_ros.demo import demo

            return demo(options.out)
        from sst_ros.report.run import report

        print(report(options.bag, options.out or options.bag.parent / "report"))
    except SstError as error:
        print(f"sst_ros: {error}", file=sys.stderr)
        return 1
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m sst_ros",
        description=__doc__,
        epilog=f"Nodes, which take --ros-args: {', '.join(NODES)}.",
    )
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    demo = commands.add_parser("demo", help="run the paper's examples through the nodes")
    demo.add_argument("--out", type=Path, default=Path("demo_out"), help="folder of the results")
    report = commands.add_parser("report", help="judge a recorded run").add_subparsers(
        dest="kind", required=True, metavar="KIND"
    )
    run = report.add_parser("run", help="error against run time of a bag")
    run.add_argument("bag", type=Path, help="folder of the bag")
    run.add_argument("--out", type=Path, help="folder of the results; default: beside the bag")
    return parser


if __name__ == "__main__":
    sys.exit(main())
