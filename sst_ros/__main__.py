# SPDX-License-Identifier: Apache-2.0
# PYTHON_ARGCOMPLETE_OK
"""The command `sst-ros`, and `python -m sst_ros`, which is the same."""

from __future__ import annotations

import sys

NODES = ("simulator", "torque_player", "inverse_dynamics", "recorder", "viewer")


def main(arguments: list[str] | None = None) -> int:
    """Run a command or a node; return the exit status.

    While modules are imported, and once the command has ended, a SIGINT ends the
    process of a command at once and in silence: a KeyboardInterrupt there would come
    out of them as it is, or as an ImportError of numpy's.
    """
    command_line = sys.argv[1:] if arguments is None else arguments
    try:
        from sst_ros.nodes import signals

        if command_line and command_line[0] in NODES:
            signals.handle()
        elif arguments is None:
            signals.interrupt(at_once=True)
        from sst_ros.cli.commands import run_command

        if arguments is None:
            signals.interrupt(at_once=False)
        status = run_command(command_line)
        if arguments is None:
            signals.interrupt(at_once=True)
    except KeyboardInterrupt:  # just before `run_command`, or a second one within it
        return 130
    return status


if __name__ == "__main__":
    sys.exit(main())
