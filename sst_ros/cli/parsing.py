# SPDX-License-Identifier: Apache-2.0
"""Parsers of the command line: the nearest name for a wrong one, and arguments that recur."""

from __future__ import annotations

import argparse
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any, NoReturn, TypeAlias

from sst_ros.errors import InputError, Problem, printable, suggestion
from sst_ros.host.output import require_free

Commands: TypeAlias = "argparse._SubParsersAction[Parser]"
Run: TypeAlias = Callable[[argparse.Namespace], "int | None"]


class Parser(argparse.ArgumentParser):
    """A parser whose errors suggest the nearest command, option or choice."""

    def __init__(self, **options: Any) -> None:
        options.setdefault("allow_abbrev", False)
        super().__init__(**options)
        self.set_defaults(parser=self)  # that of the innermost command remains

    def error(self, message: str) -> NoReturn:
        """Print the usage and the error, and exit with status 2."""
        super().error(printable(message) + self._suggestion(message))

    def _suggestion(self, message: str) -> str:
        wrong = re.search(r"invalid choice: '([^']*)'|unrecognized arguments: (\S+)", message)
        if wrong is None:
            return ""
        known = [str(choice) for action in self._actions for choice in action.choices or ()]
        known += self._option_string_actions
        return suggestion(wrong[1] or wrong[2].partition("=")[0], known)


def command(commands: Commands, name: str, run: Run | None, what: str, **options: Any) -> Parser:
    """Add a command whose options `run` gets, and which is described by `what` in the help."""
    parser = commands.add_parser(name, help=what, **options)
    parser.set_defaults(run=run)
    return parser


def group(commands: Commands, name: str, what: str) -> Commands:
    """Add a command that has commands of its own."""
    parser = commands.add_parser(name, help=what)
    return parser.add_subparsers(dest="kind", required=True, metavar="KIND")


def add_scene_name(parser: Parser, *words: str, **options: Any) -> None:
    """Add an argument that is a scene; shells complete it where argcomplete is installed."""
    options.setdefault("help", "name of a scene, or path of a .yaml file")
    action: Any = parser.add_argument(*words, **options)
    action.completer = _scene_names


def add_out(parser: Parser, what: str, default: str) -> None:
    """Add `--out` and `--force`, which `free_out` obeys."""
    parser.add_argument("--out", type=Path, help=f"{what}; default: {default}")
    parser.add_argument("--force", action="store_true", help="overwrite earlier results in --out")


def free_out(options: argparse.Namespace, default: str | Path) -> Path:
    """Return the path of `--out`, or the default, if nothing there would be overwritten.

    Raises:
        InputError: there are earlier results, and `--force` is not given.

    """
    out = options.out or Path(default)
    return require_free(out, options.command, force=getattr(options, "force", False))


def refuse(options: argparse.Namespace, option: str, value: object, allowed: str) -> NoReturn:
    """Refuse the value of an option.

    Raises:
        InputError: always.

    """
    raise InputError(options.command, [Problem(option, value, allowed)])


def integer_from(least: int, most: int) -> Any:
    """Return a type for `add_argument`: a whole number in a range."""

    def convert(text: str) -> int:
        try:
            value = int(text)
        except ValueError:
            value = least - 1
        if not least <= value <= most:
            allowed = f"must be a whole number from {least} to {most}, not {text!r}"
            raise argparse.ArgumentTypeError(allowed)
        return value

    return convert


def _scene_names(**_: object) -> list[str]:
    from sst_ros.scene.scene import names

    return names()
