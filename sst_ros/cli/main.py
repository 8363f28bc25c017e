# SPDX-License-Identifier: Apache-2.0
"""The command `sst-ros`: a command or a node is run, and its errors become an exit status."""

from __future__ import annotations

import importlib
import os
import sys
import traceback

from sst_ros.cli.commands import NODES, PROGRAM, function, parser
from sst_ros.errors import SstError, printable
from sst_ros.extras import explanation, require

FAILED, BUG, INTERRUPTED = 1, 3, 130


def run_command(words: list[str]) -> int:
    """Run a command or a node; return the exit status. Errors are one line on stderr."""
    debug, words = _without_debug(words)
    try:
        status = _run(words)
        print(end="", flush=True)  # does nothing where stdout was closed before the start
    except (Exception, KeyboardInterrupt) as error:
        if debug:
            traceback.print_exc()
        status, message = failure(error)
        if isinstance(error, OSError):
            _abandon_stdout()
        for line in message.splitlines():
            print(f"{PROGRAM}: {printable(line)}", file=sys.stderr)
    return status


def _run(words: list[str]) -> int:
    if "_ARGCOMPLETE" in os.environ:
        importlib.import_module("argcomplete").autocomplete(parser())
    if words and words[0] in NODES:
        status: int = function("nodes.process:run")(words)
        return status
    commands = parser()
    options, unknown = commands.parse_known_args(words)
    if unknown:
        options.parser.error(f"unrecognized arguments: {' '.join(unknown)}")
    if options.command is None:
        commands.print_help()
        return 0
    for module in options.entry.needs:
        require(module)
    done: int | None = function(options.entry.run)(options)
    return done or 0


def _without_debug(words: list[str]) -> tuple[bool, list[str]]:
    """Take --debug out of the arguments, wherever it is before those of ROS."""
    end = words.index("--ros-args") if "--ros-args" in words else len(words)
    kept = [word for word in words[:end] if word != "--debug"]
    return len(kept) < end, [*kept, *words[end:]]


def _abandon_stdout() -> None:
    """Keep Python from failing once more, when it ends, on a stdout that takes nothing."""
    try:
        print(end="", flush=True)
    except (OSError, ValueError):
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)


def failure(error: BaseException) -> tuple[int, str]:
    """Return the exit status and the message, "" for none."""
    message, status = "", FAILED
    if isinstance(error, KeyboardInterrupt):
        message, status = "interrupted", INTERRUPTED
    elif isinstance(error, SstError):
        message = str(error)
    elif isinstance(error, ModuleNotFoundError) and (said := explanation(error)):
        message = said
    elif isinstance(error, OSError) and not isinstance(error, BrokenPipeError):
        where = f"{error.filename}: " if error.filename is not None else ""
        message = f"{where}{error.strerror or error}"
    elif isinstance(error, UnicodeError):
        message = f"text cannot be encoded or decoded: {error}"
    elif isinstance(error, MemoryError):
        message = "not enough memory"
    elif type(error).__module__.partition(".")[0] in ("rclpy", "rosbags"):
        message = " ".join(str(error).split())
    elif not isinstance(error, BrokenPipeError):
        bug = " ".join(f"{type(error).__name__}: {error}".split())
        return BUG, f"internal error, please report it with the output of --debug: {bug}"
    return status, message
