# SPDX-License-Identifier: Apache-2.0
"""How all benchmarks measure and say it: times in rounds, the machine, tables, pages,
JSON.
"""

from __future__ import annotations

import argparse
import datetime
import gc
import os
import platform
import time
from collections.abc import Callable, Hashable, Sequence
from importlib import metadata
from pathlib import Path
from statistics import median
from typing import Any, TypeVar

from sst_ros.progress import slices
from sst_ros.report.results import data_frame, markdown, processor

Key = TypeVar("Key", bound=Hashable)
DOCS = Path(__file__).parents[1] / "docs"


def read_options(
    name: str, doc: str | None, arguments: list[str] | None = None, **defaults: Any
) -> argparse.Namespace:
    """Read the options of a benchmark: flags where the default is False, else values of
    its type.

    A default that is a type stands for an option that may be left out.
    """
    parser = argparse.ArgumentParser(
        prog=f"python -m benchmark.{name}",
        description=doc,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    for key, default in defaults.items():
        option = f"--{key.replace('_', '-')}"
        if default is False:
            parser.add_argument(option, action="store_true")
        elif isinstance(default, type):
            parser.add_argument(option, type=default)
        else:
            parser.add_argument(
                option, type=type(default), default=default, help="%(default)s"
            )
    return parser.parse_args(arguments)


def time_in_turn(
    calls: dict[Key, Callable[[], Any]],
    rounds: int = 9,
    shortest: float = 2e-3,
    clock: Callable[[], float] = time.perf_counter,
    shown: bool = False,
) -> dict[Key, list[float]]:
    """Seconds of each call, one number a round.

    Every round times every call, so that what slows the machine for a while slows all
    of them. A call that is shorter than `shortest` is repeated until it is not, and
    divided. A `clock` of processor time leaves out what others do on the machine
    meanwhile, which long calls would otherwise have more of than short ones; it is for
    work of one thread.
    """
    repeats = {
        key: _count_repeats(call, shortest, clock) for key, call in calls.items()
    }
    seconds: dict[Key, list[float]] = {key: [] for key in calls}
    collecting = gc.isenabled()
    gc.disable()
    try:
        for _ in slices(rounds, 1, "rounds of times", shown):
            for key, call in calls.items():
                seconds[key].append(_time(call, repeats[key], clock))
            gc.collect()
    finally:
        if collecting:
            gc.enable()
    return seconds


def divide(seconds: dict[Key, list[float]], first: Key, second: Key) -> float:
    """Median over the rounds of first / second: each quotient is of the same round."""
    return median(a / b for a, b in zip(seconds[first], seconds[second], strict=True))


def _count_repeats(
    call: Callable[[], Any], shortest: float, clock: Callable[[], float]
) -> int:
    call()
    once = _time(call, 1, clock)
    return max(1, round(shortest / once)) if once < shortest else 1


def _time(call: Callable[[], Any], repeats: int, clock: Callable[[], float]) -> float:
    begin = clock()
    for _ in range(repeats):
        call()
    return (clock() - begin) / repeats


def describe_machine(*packages: str) -> dict[str, str]:
    """Date, processor, load and versions.

    Packages that are not installed are left out.
    """
    host = {
        "date": datetime.datetime.now(datetime.timezone.utc).strftime(
            "%Y-%m-%d %H:%M UTC"
        ),
        "processor": processor(),
        "cores": str(len(os.sched_getaffinity(0))),
        "load": f"{os.getloadavg()[0]:.2f} at the end, over 1 min",
        "python": platform.python_version(),
        "system": f"{platform.system()} {platform.release()}",
    }
    for package in packages:
        try:
            host[package] = metadata.version(package)
        except metadata.PackageNotFoundError:
            continue
    return host


def join_line(host: dict[str, str]) -> str:
    """Return the machine in one line of text."""
    return ", ".join(f"{key} {value}" for key, value in host.items())


def format_columns(columns: Sequence[dict[str, str]]) -> str:
    """Return Markdown with a row for each key and a column for each run."""
    keys = list(dict.fromkeys(key for column in columns for key in column))
    name, *heads = (column[keys[0]] for column in [{keys[0]: keys[0]}, *columns])
    rows = [
        {name: key, **dict(zip(heads, (c.get(key, "") for c in columns), strict=True))}
        for key in keys[1:]
    ]
    return markdown(data_frame(rows))


class Costs:
    """What pieces of work cost by who does them, and their ratios to a floor.

    Args:
        seconds: of each (work, who), one number a round.
        counts: how many units of work that was.
        floor: who does the least.

    """

    def __init__(
        self,
        seconds: dict[tuple[str, str], list[float]],
        counts: dict[tuple[str, str], int],
        floor: str,
    ) -> None:
        self._ns = {
            key: [1e9 * one / counts[key] for one in taken]
            for key, taken in seconds.items()
        }
        self.floor = floor

    def ratio(self, work: str, name: str, reference: str) -> float | None:
        """Median over the rounds of a cost over another's.

        None where one is not known.
        """
        if (work, name) not in self._ns or (work, reference) not in self._ns:
            return None
        return divide(self._ns, (work, name), (work, reference))

    def judge(self, work: str, name: str, reference: str, target: float) -> None:
        """Print whether a ratio of at most `target` is met."""
        value = self.ratio(work, name, reference)
        if value is not None:
            verdict = "met" if value <= target else "MISSED"
            ratio = f"{work}: {name} over {reference} {value:.2f}"
            print(f"{ratio}, target {target}: {verdict}")

    def print(self) -> None:
        """Print the medians, and the ratios to the floor where they are known."""
        print(f"{'work':18}{'who':38}{'ns':>10}{'over ' + self.floor:>16}")
        for work, name in self._ns:
            over = self.ratio(work, name, self.floor)
            said = "" if over is None else f"{over:.2f}"
            print(f"{work:18}{name:38}{median(self._ns[work, name]):10.1f}{said:>16}")
        print()


def fill(text: str, sections: dict[str, str]) -> str:
    """Return a page with new parts, each between <!-- begin NAME --> and <!-- end NAME
    -->.
    """
    for name, section in sections.items():
        begin, end = f"<!-- begin {name} -->\n", f"<!-- end {name} -->"
        before, _, rest = text.partition(begin)
        _, found, after = rest.partition(end)
        if not found:
            raise ValueError(f"a page needs a part {name}")
        text = f"{before}{begin}{section}\n{end}{after}"
    return text


def fill_page(page: Path, sections: dict[str, str], out: Path | None = None) -> None:
    """Write a page, by default in its place, with new parts; its other text stays."""
    text = fill(page.read_text(encoding="utf-8"), sections)
    (out or page).write_text(text, encoding="utf-8")
