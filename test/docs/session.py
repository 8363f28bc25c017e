# SPDX-License-Identifier: Apache-2.0
"""A reader who types what a page says: a folder, and a terminal for each node."""

import ast
import os
import shlex
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

from docs.blocks import ROOT, commands

from docs import installed
from sst_ros.cli.commands import NODE_HELP
from sst_ros.errors import InputError

PYTHONS = (".venv/bin/python", "python", "python3")
COMMAND = "sst-ros"
LIMIT_S = 200.0
FEWER = ("n=1_000_000", "n=10_000")
"""A million runs take half a minute, and pass the same lines."""
RECORDED_BYTES = 20_000
DOCUMENTED = (ast.Module, ast.ClassDef, ast.FunctionDef)


class Terminal:
    """A command that runs until it is stopped, and a file of what it says."""

    def __init__(self, line, words, log, given):
        self.words, self.log = words, log
        with log.open("w") as file:
            self.process = subprocess.Popen(
                ["bash", "-c", f"exec {line}"],
                stdout=file,
                stderr=subprocess.STDOUT,
                **given,
            )

    def wait_for(self, condition):
        """Wait until the condition holds or the command has ended."""
        deadline = time.monotonic() + LIMIT_S
        while not condition() and self.process.poll() is None:
            assert time.monotonic() < deadline, self
            time.sleep(0.05)

    def end(self):
        self.wait_for(lambda: False)
        assert self.process.returncode == 0, self

    def __str__(self):
        return (
            f"{shlex.join(self.words)}:"
            f" {self.process.returncode}\n{self.log.read_text()}"
        )


class Session:
    """Runs blocks in order.

    What a node was told to write is there for the next command.
    """

    def __init__(self, folder: Path, domain: int | None):
        self.folder = folder
        (folder / ".venv").symlink_to(sys.prefix)
        shutil.copytree(ROOT / "examples", folder / "examples")
        shutil.copy(
            ROOT / "config" / "scenes" / "general.yaml", folder / "my_scene.yaml"
        )
        self.environment = {
            **os.environ,
            "PATH": os.pathsep.join(
                [str(Path(sys.prefix) / "bin"), os.environ["PATH"]]
            ),
            "MPLBACKEND": "agg",
        }
        self._domain = domain
        self._terminals = []

    def run(self, block):
        """Run a block, or check it where it needs more than a plain machine."""
        first = block.text.lstrip().partition("\n")[0]
        if (
            block.language in ("python", "yaml")
            and first.startswith("# ")
            and "." in first
        ):
            self._file(first.removeprefix("# ").strip(), block)
        elif block.language == "python":
            self.settle()
            self._done([sys.executable, "-c", block.text.replace(*FEWER)], block)
        elif block.language in ("bash", "sh", "console") or _is_shell(block):
            for line in commands(block.text):
                self._line(line, block)
        else:
            assert block.language in (
                "",
                "text",
                "yaml",
                "diff",
            ) or block.language.startswith("{"), (
                f"{block}: nobody knows what to do with {block.language}"
            )

    def settle(self):
        """Wait for what ends by itself, for recorders to have something, and press
        Ctrl-C.
        """
        for terminal in self._terminals:
            self._wait_ready(terminal)
        for terminal in self._terminals:
            if _ends_by_itself(terminal.words):
                try:
                    terminal.end()
                except AssertionError as error:
                    raise AssertionError(
                        "\n".join(map(str, self._terminals))
                    ) from error
        for terminal in self._terminals:
            if "recorder" in terminal.words:
                files = (self.folder / _value(terminal.words, "output")).glob
                terminal.wait_for(
                    lambda files=files: (
                        sum(p.stat().st_size for p in files("*.mcap")) > RECORDED_BYTES
                    )
                )
        for terminal in self._terminals:
            if terminal.process.poll() is None:
                terminal.process.send_signal(signal.SIGINT)
                terminal.end()
        self._terminals = []

    def close(self):
        """Leave no process behind."""
        for terminal in self._terminals:
            terminal.process.kill()
            terminal.process.wait()

    def _file(self, name, block):
        shown = ROOT / name
        if shown.exists() and name.endswith(".py"):
            theirs = _program(shown.read_text(encoding="utf-8"))
            assert _program(block.text) == theirs, f"{block} is not {name}"
            return
        path = self.folder / name
        path.write_text(block.text, encoding="utf-8")

    def _line(self, line, block):
        words = shlex.split(line)
        if words[0] == COMMAND:
            line = line.replace(COMMAND, "python -m sst_ros", 1)
            words = shlex.split(line)
        if words[0] in installed.KINDS:
            try:
                installed.check(line)
            except (AssertionError, InputError, KeyError, ValueError, OSError) as error:
                raise AssertionError(f"{block}: {line}: {error!r}") from error
        elif words[0] in PYTHONS and self._stays(words):
            self._start(line, words)
        else:
            self.settle()
            self._done(["bash", "-euo", "pipefail", "-c", line], block)

    def _done(self, argv, block):
        given = {"cwd": self.folder, "env": self.environment, "timeout": LIMIT_S}
        done = subprocess.run(argv, capture_output=True, text=True, **given)
        assert done.returncode == 0, f"{block}: {argv[-1]}\n{done.stdout}{done.stderr}"

    def _stays(self, words):
        """Tell whether a command runs until it is stopped, as nodes do."""
        if words[1] == "-m":
            return words[2] == "sst_ros" and words[3] in (*NODE_HELP, "view")
        return "rclpy.spin" in (self.folder / words[1]).read_text(encoding="utf-8")

    def _start(self, line, words):
        assert self._domain is not None, "nodes need a ROS domain"
        if words[1] == "-m" and words[3] != "view":
            installed.run(words[3:])
        log = self.folder / f"terminal_{len(list(self.folder.glob('terminal_*')))}"
        given = {"cwd": self.folder, "env": self.environment}
        self._terminals.append(Terminal(line, words, log, given))

    def _wait_ready(self, terminal):
        """Wait until a node listens to Ctrl-C, and a recorder to its simulator."""
        if terminal.words[1] == "-m":
            terminal.wait_for(terminal.log.read_text)
        if "recorder" in terminal.words and any(
            "simulator" in t.words for t in self._terminals
        ):
            terminal.wait_for(lambda: "ready" in terminal.log.read_text())


def _value(words, parameter):
    """Value of a node's parameter, as a plain option or as --ros-args has it."""
    if f"--{parameter}" in words:
        return words[words.index(f"--{parameter}") + 1]
    (value,) = (w.partition(":=")[2] for w in words if w.startswith(f"{parameter}:="))
    return value


def _ends_by_itself(words):
    given = any(word == "--duration" or word.startswith("duration:=") for word in words)
    return given or "torque_player" in words


def _is_shell(block):
    """Tell whether a block without a language is one of commands."""
    if block.language or not block.text.strip():
        return False
    first = {line.split()[0] for line in commands(block.text)}
    return first <= {*installed.KINDS, *PYTHONS, COMMAND}


def _program(text):
    """Syntax tree of a program without its docstrings."""
    tree = ast.parse(text)
    for node in ast.walk(tree):
        if isinstance(node, DOCUMENTED) and ast.get_docstring(node, False) is not None:
            del node.body[0]
    return ast.dump(tree)
