# SPDX-License-Identifier: Apache-2.0
"""docs/commands.md and docs/columns.md, from the declarations that the program runs by.

`python -m tools.command_tables` writes them; a test holds the files against this module.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator
from pathlib import Path

from sst_ros.cli.commands import NODES, parser
from sst_ros.recording.topic_tables import TABLES, TIMES, Column

_COMMANDS = """# The command line

<!-- Written by `python -m tools.command_tables`. -->

    sst-ros COMMAND ...

`python -m sst_ros COMMAND ...` is the same without an installation. Exit status 0 is success, 1 an
error, reported in one line on stderr (or as described below), 2 a command that is not
understood, 3 an internal error; `--debug` prints the traceback. No command overwrites earlier
results without `--force`. `sst-ros COMMAND --help` describes a command.

Where [argcomplete](https://pypi.org/project/argcomplete/) is installed,
`eval "$(register-python-argcomplete sst-ros)"` completes commands, options and names of scenes.

Nodes are started by the same command and take the arguments of ROS nodes,
`--ros-args -p name:=value`, and plain options `--name value`:
{nodes}.
Their parameters are in [the reference of nodes](nodes.md).
"""

_COLUMNS = """# Columns of exported tables

<!-- Written by `python -m tools.command_tables`. -->

`sst-ros export BAG` and `sst_ros.recording.export.frame` give a table for what has rows
of its own. A table, or a column, whose topic is not in the bag is left out; a lost message is
an empty cell (CSV) or NaN. Columns in ns are whole numbers, all others doubles with all their bits.

Every table begins with

{times}
"""

_MEANINGS = {
    "samples": "A row for each state of the run.",
    "ticks": "A row for each step of the simulator, with what acted over it.",
    "commands": "A row for each command without a stamp.",
    "commands_stamped": "A row for each command with a stamp.",
    "external_moment": "A row for each external moment that was sent.",
}


def commands() -> str:
    """Write the reference of the command line as Markdown."""
    nodes = ", ".join(f"`{name}`" for name in NODES)
    return "\n".join([_COMMANDS.format(nodes=nodes), *_commands(parser(), "")])


def _commands(of: argparse.ArgumentParser, path: str) -> Iterator[str]:
    for action in of._actions:
        if not isinstance(action, argparse._SubParsersAction):
            continue
        helps = {choice.dest: choice.help or "" for choice in action._choices_actions}
        for name, command in action.choices.items():
            if name in NODES:
                continue
            below = list(_commands(command, f"{path}{name} "))
            if not below:
                text = helps[name][:1].upper() + helps[name][1:]
                yield f"## {path}{name}\n\n{text}.\n\n{_arguments(command)}"
            yield from below


def _arguments(command: argparse.ArgumentParser) -> str:
    rows = []
    for action in command._actions:
        if isinstance(action, argparse._HelpAction):
            continue
        shown = action.metavar or action.dest.upper()
        name = action.option_strings[-1] if action.option_strings else str(shown)
        if action.option_strings and action.nargs != 0:
            values = "{" + ",".join(map(str, action.choices)) + "}" if action.choices else shown
            name += f" {values}"
        name += " ..." if action.nargs in ("*", "+") else ""
        rows.append(f"| `{name}` | {(action.help or '').replace('|', ',')} |")
    if not rows:
        return "No arguments.\n"
    return "\n".join(["| argument | what |", "| --- | --- |", *rows, ""])


def columns() -> str:
    """Write the reference of exported columns as Markdown."""
    parts = [_COLUMNS.format(times=_table(TIMES))]
    for name, sources in TABLES.items():
        listed = [column for source in sources for column in source.columns]
        parts.append(f"## {name}\n\n{_MEANINGS[name]}\n\n{_table(listed)}")
    return "\n".join(parts)


def _table(listed: tuple[Column, ...] | list[Column]) -> str:
    rows = [f"| `{c.name}` | {c.what} | {c.unit} | {c.topic or '-'} |" for c in listed]
    return "\n".join(["| column | what | unit | topic |", "| --- | --- | --- | --- |", *rows, ""])


PAGES = {"commands.md": commands, "columns.md": columns}


def main() -> int:
    """Write the pages into the source tree."""
    folder = Path(__file__).resolve().parents[1] / "docs"
    for name, write in PAGES.items():
        (folder / name).write_text(write(), encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
