# SPDX-License-Identifier: Apache-2.0
# PYTHON_ARGCOMPLETE_OK
"""The command `sst-ros`, and `python -m sst_ros`, which is the same."""

from __future__ import annotations

import sys

from sst_ros.nodes import signals

NODES = ("simulator", "torque_player", "inverse_dynamics", "recorder", "viewer")


def main(arguments: list[str] | None = None) -> int:
    """Run a command or a node; return the exit status."""
    given = sys.argv[1:] if arguments is None else arguments
    if given and given[0] in NODES:
        signals.handle()
    try:
        from sst_ros.cli.commands import run_command
    except KeyboardInterrupt:
        return 130
    return run_command(given)


if __name__ == "__main__":
    sys.exit(main())
