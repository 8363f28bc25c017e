# SPDX-License-Identifier: Apache-2.0
"""The command line: wrong words, hostile paths, hostile surroundings."""

from __future__ import annotations

import math
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from benchmark.campaign.ledger import Ledger
from benchmark.campaign.processor import communicate
from benchmark.nodes import own_domain

COMMAND_BOUND_S = 30.0
"""A refusal takes a second.

A command that does its work takes longer beside other work.
"""


def sst_ros(
    ledger: Ledger,
    arguments: Sequence[str],
    *,
    folder: Path,
    env: Mapping[str, str] | None = None,
    bound: float = COMMAND_BOUND_S,
    fails: bool | None = None,
    user: int | None = None,
) -> None:
    """Run the command line.

    Count a hang, a traceback, a long message or a wrong exit status.
    """
    ledger.tried += 1
    name, began = " ".join(arguments)[:120], time.perf_counter()
    try:
        process = subprocess.Popen(
            [sys.executable, "-m", "sst_ros", *arguments],
            cwd=folder,
            env={**os.environ, **(env or {})},
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            errors="backslashreplace",
            user=user,
            stdin=subprocess.DEVNULL,
        )
        _, error_text = communicate(process, bound * ledger.patience)
    except subprocess.TimeoutExpired:
        ledger.add_finding("hangs", f"{name}: no end within its bound")
        return
    except (ValueError, OSError) as error:  # words that no process can be given
        ledger.tried -= 1
        ledger.notes.append(f"not started: {name!r}: {error}")
        return
    ledger.time(time.perf_counter() - began, math.inf, name)
    status = process.returncode
    if "Traceback (most recent call last)" in error_text:
        ledger.add_finding(
            "tracebacks", f"{name}: {error_text.strip().splitlines()[-1]}"
        )
    elif fails is not None and fails == (status == 0):
        ledger.add_finding("silent", f"{name}: exit status {status}")
    elif status < 0:
        ledger.add_finding("tracebacks", f"{name}: ended by signal {-status}")


VERBS = (
    *("compile", "demo", "describe", "export", "plan", "plot", "report", "recover"),
    *("scene", "study", "view"),
)

WRONG = [
    line.split()
    for line in """
nosuchverb
simulatr
--nosuchoption
scene show
scene show nosuchscene
scene show /
scene show /dev/null
scene check /proc/self/mem
compile example2 --integrator nope
demo --out /etc/passwd
demo --scene reach
plan check reach --csv /proc/x
plan check reach --csv /tmp
report run /nonexistent
report run /etc
report accuracy nosuchscene
export /nonexistent
plot /nonexistent
recover /nonexistent
view /nonexistent --port -1
view --scene swing --port 99999
describe nosuchscene
simulator --scene nosuchscene
simulator --bogus
simulator --ros-args -p nonexist:=1
simulator --ros-args -p rate:=0
simulator --ros-args -p rate:=nan
simulator --ros-args -p real_time_factor:=5e-324
simulator --ros-args --params-file /nonexistent
recorder --ros-args -p output:=/proc/bag
torque_player --ros-args -p scene:=nosuchscene
inverse_dynamics --ros-args -p mode:=nosuchmode
""".splitlines()[1:]
]
WRONG += [
    ["scene", "check", "\udcff"],
    ["simulator", "--ros-args", "-r", "__node:=not a name"],
    ["recorder", "--ros-args", "-p", "topics:=['a b']"],
]


def command_lines(ledger: Ledger) -> None:
    """Give wrong words to every verb: one line and a status other than 0, or usage."""
    rng = ledger.rng
    with own_domain(), tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "folder").mkdir()
        (folder / "empty.yaml").write_text("")
        (folder / "binary.yaml").write_bytes(os.urandom(300))
        count = len(ledger.numbers(150, least=4))
        for arguments in (
            WRONG if ledger.share >= 1 else rng.sample(WRONG, min(len(WRONG), count))
        ):
            sst_ros(ledger, arguments, folder=folder, fails=True)
        words_of = [
            "",
            "-",
            "--",
            "folder",
            "empty.yaml",
            "binary.yaml",
            "example2",
            "-1",
            "nan",
        ]
        words_of += [
            "--out",
            "--force",
            "--scene",
            "\x1b[31m",
            "a" * 300,
            "../..",
            "~",
            "'",
        ]
        for _ in range(count - ledger.tried):
            verb = rng.choice(VERBS)
            arguments = [
                verb,
                "--nosuchoption",
                *rng.choices(words_of, k=rng.randint(0, 3)),
            ]
            sst_ros(ledger, arguments, folder=folder, fails=True)


def surroundings(ledger: Ledger) -> None:
    """Run commands without a home, on a full disk, in plain ASCII, as another user."""
    nobody = 65534 if os.geteuid() == 0 else None
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        folder.chmod(0o777)
        readonly = folder / "readonly"
        readonly.mkdir(mode=0o555)
        show, run, full = (
            "scene show example2",
            "simulate example2 --duration 0.1",
            "TMPDIR",
        )
        cases: dict[str, tuple[str, dict[str, str], int | None]] = {
            "no HOME": ("scene list", {"HOME": ""}, None),
            "HOME that is not there": (show, {"HOME": "/nonexistent"}, None),
            "read-only HOME": (run, {"HOME": str(readonly)}, nobody),
            "TMPDIR that is not there": (
                "scene list",
                {"TMPDIR": "/nonexistent"},
                None,
            ),
            "plain ASCII": (show, {"LANG": "C", "LC_ALL": "C"}, None),
            "ASCII output": ("scene list", {"PYTHONIOENCODING": "ascii"}, None),
            "temporary files in a full disk": (run, {full: "/dev/full"}, None),
            "temporary files in a file": (run, {full: "/etc/passwd"}, None),
            "another user": ("scene list", {"HOME": str(folder)}, nobody),
            "no columns": ("scene list", {"COLUMNS": "0", "TERM": "dumb"}, None),
        }
        labels = [*cases]
        ledger.rng.shuffle(labels)
        for label in labels[: len(ledger.numbers(len(cases), least=4))]:
            command_line, env, user = cases[label]
            before = len(ledger.notes)
            sst_ros(
                ledger,
                command_line.split(),
                folder=folder,
                env=env,
                user=user,
                bound=60.0,
            )
            ledger.notes[before:] = [
                f"{label}: {note}" for note in ledger.notes[before:]
            ]
        for verb in (["scene", "list"], ["scene", "show", "stiff"], ["--help"]):
            ledger.tried += 1
            with Path("/dev/full").open("w") as disk:
                command = [sys.executable, "-m", "sst_ros", *verb]
                pipes: dict[str, Any] = {
                    "stdout": disk,
                    "stderr": subprocess.PIPE,
                    "text": True,
                }
                process = subprocess.run(
                    command, cwd=folder, timeout=60.0 * ledger.patience, **pipes
                )
            if "Traceback" in process.stderr:
                note = f"{' '.join(verb)} into a full disk: {process.stderr[-200:]}"
                ledger.add_finding("tracebacks", note)
