# SPDX-License-Identifier: Apache-2.0
"""Command line: `python -m sst_ros COMMAND ...`."""

from __future__ import annotations

import argparse
import importlib
import sys

from sst_ros.errors import SstError

COMMANDS = (
    "compile",
    "demo",
    "describe",
    "export",
    "plan",
    "plot",
    "report",
    "recover",
    "scene",
    "study",
    "view",
)
NODES = ("simulator", "torque_player", "inverse_dynamics", "recorder", "viewer")


def main(arguments: list[str] | None = None) -> int:
    """Run a command; return the exit status."""
    given = sys.argv[1:] if arguments is None else arguments
    if given and given[0] in NODES:
        status: int = importlib.import_module(f"sst_ros.nodes.{given[0]}").main(given)
        return status
    options = parser().parse_args(given)
    try:
        done: int = options.run(options) or 0
    except SstError as error:
        print(f"sst_ros: {error}", file=sys.stderr)
        return 1
    return done


def parser() -> argparse.ArgumentParser:
    """Build the parser of all commands."""
    result = argparse.ArgumentParser(
        prog="python -m sst_ros",
        description=__doc__,
        epilog=f"Nodes, which take --ros-args: {', '.join(NODES)}.",
    )
    commands = result.add_subparsers(dest="command", required=True, metavar="COMMAND")
    for name in COMMANDS:
        importlib.import_module(f"sst_ros.cli.{name}").add(commands)
    return result


if __name__ == "__main__":
    sys.exit(main())
