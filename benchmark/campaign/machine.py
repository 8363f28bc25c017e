# SPDX-License-Identifier: Apache-2.0
"""Threads, processes, signals, files and streams: what a machine does to a program."""

from __future__ import annotations

import math
import random
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from concurrent.futures import Executor, ProcessPoolExecutor, ThreadPoolExecutor
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

import sst_ros
from benchmark import long_bag
from benchmark.campaign.ledger import Ledger
from benchmark.campaign.processor import communicate
from sst_ros import Trajectory, simulate
from sst_ros.recording import recording

RUNS = (
    ("example2", "auto"),
    ("friction", "dop853"),
    ("stiff", "auto"),
    ("elastic_stops", "auto"),
)


def run(number: int) -> bytes:
    """Return the bits of a short motion and of its states between the samples."""
    scene, method = RUNS[number % len(RUNS)]
    motion = simulate(scene, duration=0.05 + 0.01 * (number % 3), method=method)
    return b"".join(
        table.to_pandas().to_numpy().tobytes() for table in (motion, motion.at([0.02]))
    )


def workers(ledger: Ledger) -> None:
    """Simulate in threads, forked and spawned processes: the bits are those alone."""
    alone = [run(number) for number in range(12)]
    makers: list[Callable[[], Executor]] = [
        partial(ThreadPoolExecutor, n) for n in (2, 8)
    ]
    contexts = [get_context(name) for name in ("fork", "spawn")]
    makers += [
        partial(ProcessPoolExecutor, 2, mp_context=run_number)
        for run_number in contexts
    ]
    for number in ledger.numbers(24):
        numbers = ledger.rng.sample(range(12), 8)
        with ledger.case(f"workers {number}", bound=60.0):
            with makers[number % len(makers)]() as pool:
                run_bits = list(pool.map(run, numbers, timeout=300.0 * ledger.patience))
            for run_number, bits in zip(numbers, run_bits, strict=True):
                if bits != alone[run_number]:
                    ledger.add_finding(
                        "silent",
                        f"workers {number}: {RUNS[run_number % 4]} has other bits",
                    )


def _save(path: Path, duration: float) -> None:
    simulate("example2", duration=duration).save(path, overwrite=True)


def saves(ledger: Ledger) -> None:
    """Save different motions to one path at a time: what is there then is one of them,
    whole.
    """
    for number in ledger.numbers(40):
        suffix = (".csv", ".parquet")[number % 2]
        with TemporaryDirectory() as name, ThreadPoolExecutor(4) as pool:
            path = Path(name) / f"motion{suffix}"
            with ledger.case(f"saves {number}", bound=20.0):
                list(pool.map(partial(_save, path), (0.1, 0.2, 0.3, 0.4)))
                motion = Trajectory.load(path)
                expected = simulate("example2", duration=float(motion.t[-1]))
                left = [*Path(name).iterdir()]
                if not np.array_equal(motion.gamma, expected.gamma) or left != [path]:
                    ledger.add_finding(
                        "silent", f"saves {number}: {path.name} is of several motions"
                    )


def _flip(path: Path, rng: random.Random) -> None:
    """Flip a bit of a file, or cut it."""
    content = bytearray(path.read_bytes())
    position = rng.randrange(len(content))
    if rng.random() < 0.2:
        del content[position:]
    else:
        content[position] ^= 1 << rng.randrange(8)
    path.write_bytes(content)


def damage(ledger: Ledger) -> None:
    """Read files with one bit flipped or cut: an error of ours, or what was written.

    A table has no sum for each number, so that there a number may differ; a bag has.
    """
    rng = ledger.rng
    with TemporaryDirectory() as name:
        folder = Path(name)
        bag, motion = (
            long_bag.write(folder / "bag", 1.0),
            simulate("example2", duration=0.1),
        )
        tables = [folder / f"motion{suffix}" for suffix in (".csv", ".parquet")]
        for path in tables:
            motion.save(path)
        expected = recording.read(bag)
        for number in ledger.numbers(2000, least=20):
            copy = folder / "copy"
            chosen = rng.choice([*tables, bag, bag])
            (shutil.copytree if chosen is bag else shutil.copy)(chosen, copy)
            inside = rng.choice(sorted(copy.iterdir())) if chosen is bag else copy
            _flip(inside, rng)
            target = (
                copy
                if chosen is bag
                else copy.rename(folder / f"changed{chosen.suffix}")
            )
            with ledger.case(
                f"damage {number} of {chosen.name}/{inside.name}", bound=20.0
            ):
                if chosen is not bag:
                    Trajectory.load(target)
                else:
                    damaged = recording.read(target)
                    same = np.array_equal(
                        damaged.trajectory.gamma, expected.trajectory.gamma
                    )
                    if not same and not damaged.signals.bag.damage:
                        ledger.add_finding(
                            "silent",
                            f"damage {number}: {inside.name} differs in silence",
                        )
            (shutil.rmtree if target.is_dir() else Path.unlink)(target)


PACKAGE = f'File "{Path(sst_ros.__file__).parent}'
"""How a traceback names a line of ours."""

COMMANDS = (
    "scene show stiff",
    "simulate example2 --out motion.csv --force",
    "plan check reach",
)


def interrupts(ledger: Ledger) -> None:
    """Interrupt commands at random moments, close their streams: a line at most, no
    traceback.

    But the KeyboardInterrupt of Python's own start, before the first line of the
    package, is not ours.
    """
    rng = ledger.rng
    with TemporaryDirectory() as name:
        for number in ledger.cases(300, least=6):
            command = [sys.executable, "-m", "sst_ros", *rng.choice(COMMANDS).split()]
            if closed := rng.choice([(), (0,), (1,), (2,), (0, 1, 2)]):
                shut = " ".join(f"{descriptor}>&-" for descriptor in closed).replace(
                    "0>", "0<"
                )
                command = ["sh", "-c", f'exec "$@" {shut}', "sh", *command]
            pipes: dict[str, Any] = {
                "stdout": subprocess.PIPE,
                "stderr": subprocess.PIPE,
            }
            process = subprocess.Popen(command, cwd=name, text=True, **pipes)
            sent = rng.choice((signal.SIGINT, signal.SIGTERM, signal.SIGHUP, None))
            if sent is not None:
                # The wait is the experiment: the moment of the signal is random.
                time.sleep(rng.uniform(0.0, 1.5))
                process.send_signal(sent)
            label = f"{number}: {command[-3:]}, signal {sent}, closed {closed}"
            began = time.monotonic()
            try:
                _, error_text = communicate(process, 60.0 * ledger.patience)
            except subprocess.TimeoutExpired:
                ledger.add_finding("hangs", label)
                continue
            ledger.time(time.monotonic() - began, math.inf, label)
            # Not by the names of functions: Python's `site` has a `main`, too.
            early = (
                error_text.rstrip().endswith("KeyboardInterrupt")
                and PACKAGE not in error_text
            )
            if "Traceback" in error_text and not early:
                ledger.add_finding(
                    "tracebacks", f"{label}: {error_text.strip().splitlines()[-1]}"
                )
