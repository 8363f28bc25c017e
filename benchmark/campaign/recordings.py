# SPDX-License-Identifier: Apache-2.0
"""Recordings: flipped bytes, cuts, and recorders that are killed."""

from __future__ import annotations

import shutil
import signal
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from benchmark.campaign.ledger import Ledger
from benchmark.campaign.nodes import start
from benchmark.nodes import own_domain
from sst_ros.errors import SstError
from sst_ros.recording import bag_writer
from sst_ros.recording.recording import Recording, read

SAMPLE_NS = 2_000_000


@contextmanager
def _recorded(seconds: float) -> Iterator[Path]:
    """Record a run of scene `swing`, which moves by itself; give the bag."""
    with tempfile.TemporaryDirectory() as name, own_domain(compiled=False):
        bag = Path(name) / "bag"
        recorder = start("recorder", output=bag)
        heard = ["joint_states", "~/orientation", "~/applied_torques", "~/scene"]
        given: dict[str, Any] = {"wait_for_subscribers": heard, "subscriber_timeout": 30.0}
        simulator = start("simulator", scene="swing", duration=seconds, **given)
        try:
            simulator.wait(timeout=60)
            recorder.end(signal.SIGINT, 20.0)
            yield bag
        finally:
            for process in (simulator, recorder):
                process.end(signal.SIGKILL, 20.0)


def _same(one: Recording, other: Recording) -> bool:
    return len(one.time_ns) == len(other.time_ns) and all(
        np.array_equal(getattr(one, name), getattr(other, name), equal_nan=True)
        for name in ("time_ns", "gamma", "gamma_dot", "effort", "quaternion")
    )


def damages(ledger: Ledger) -> None:
    """Flip single bytes of a recording and cut it: no number may change without a word."""
    rng = ledger.rng
    with _recorded(2.0) as bag:
        whole = read(bag)
        (file,) = bag.glob("*.mcap")
        data = file.read_bytes()
        for number in ledger.numbers(500, least=10):
            place, bit = rng.randrange(len(data)), 1 << rng.randrange(8)
            changed = bytearray(data)
            changed[place] ^= bit
            _try(ledger, f"flip {number} of byte {place}", bag, file, bytes(changed), whole)
        for number in ledger.numbers(100, least=3):
            length = rng.randrange(len(data))
            _try(ledger, f"cut {number} at byte {length}", bag, file, data[:length], whole)


def _try(ledger: Ledger, name: str, bag: Path, file: Path, data: bytes, whole: Recording) -> None:
    file.write_bytes(data)
    with ledger.case(f"read, {name}", bound=10.0):
        found = read(bag)
        if not _same(found, whole):
            ledger.found("silent", f"{name}: numbers differ")
    saved = bag.with_name("bag_recovered")
    shutil.rmtree(saved, ignore_errors=True)
    with ledger.case(f"recover, {name}", bound=10.0):
        result = bag_writer.recover(bag)
        again = read(result.bag)
        # What was saved has to be a part of what was recorded, bit by bit. Times of a recording
        # count from its first sample, which may be lost.
        kept = np.isin(whole.start_ns + whole.time_ns, again.start_ns + again.time_ns)
        if not np.array_equal(whole.gamma[kept], again.gamma):
            ledger.found("silent", f"{name}: recovered numbers differ")
        missing = len(whole.time_ns) - len(again.time_ns)
        if missing and not (result.cut or getattr(result, "lost", False)):
            ledger.found("lost", f"{name}: {missing} samples missing and not reported", missing)
    shutil.rmtree(saved, ignore_errors=True)


def recorder_kills(ledger: Ledger) -> None:
    """Kill the recorder at random moments: all but the last chunk comes back."""
    for number in ledger.cases(34):
        with tempfile.TemporaryDirectory() as name, own_domain(compiled=False):
            bag = Path(name) / "bag"
            recorder = start("recorder", output=bag)
            simulator = start("simulator", scene="swing", duration=0.0)
            try:
                deadline = time.monotonic() + 30
                while time.monotonic() < deadline and _size(bag) < 50_000:
                    time.sleep(0.01)
                # The wait is the experiment: the moment of the kill is random.
                time.sleep(ledger.rng.uniform(1.5, 4.0))
                size = _size(bag)
                recorder.kill()
                recorder.wait()
                steps = np.diff(read(bag_writer.recover(bag).bag).time_ns)
                if not np.all(steps == SAMPLE_NS):
                    note = f"kill {number}: gaps inside what was recovered, {size} bytes"
                    ledger.found("lost", note)
            except SstError as error:
                ledger.found("lost", f"kill {number}: {error}")
            finally:
                for process in (simulator, recorder):
                    process.end(signal.SIGKILL, 20.0)


def _size(bag: Path) -> int:
    return sum(path.stat().st_size for path in bag.glob("*.mcap"))
