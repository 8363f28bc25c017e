# SPDX-License-Identifier: Apache-2.0
"""Ten ratios of each release, and a page that shows how they went.

# --write: adds a row of this version to docs/ratios.csv
python -m benchmark.ratios [--write] [--tests]

Each ratio is of two things that run in turn, by processor time, so that machines and
loads differ less in them than in times. Functions have the names that asv looks for:
benchmark/asv.conf.json.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from datetime import date
from functools import partial
from pathlib import Path
from statistics import median
from typing import Any

from matplotlib.figure import Figure

import sst_ros
from benchmark import batch, kernel, sweep
from benchmark.front_door import own_steps
from benchmark.measure import DOCS, divide, fill_page, read_options, time_in_turn
from benchmark.peers.floor import find_floor
from benchmark.peers.task import Task
from sst_ros import Simulation, load_scene, simulate
from sst_ros.dynamics.traced_dynamics import ODE, Dynamics
from sst_ros.figures import BLUE, save_figure, styled
from sst_ros.report.results import data_frame, markdown, processor

ROUNDS, STARTS = 9, 3
LONGEST_S = 600.0
"""Processor time that `make test` may take: five minutes of two cores."""

FIRST = "from sst_ros import Simulation; Simulation('example2').step((0, 0, 0), 1)"


def _turns(
    calls: dict[str, Callable[[], Any]], clock: Any = time.process_time
) -> float:
    """Return the first of two calls over the second."""
    first, second = calls
    return divide(time_in_turn(calls, ROUNDS, clock=clock), first, second)


def _used_by(*arguments: str, starts: int = STARTS, **env: str) -> float:
    """Return the processor time of a program in Python [s], least of some."""
    seconds = []
    for _ in range(starts):
        before = os.times()
        subprocess.run(
            [sys.executable, *arguments],
            check=True,
            timeout=600,
            env=os.environ | env,
            stdout=subprocess.DEVNULL,
        )
        after = os.times()
        seconds.append(sum(after[2:4]) - sum(before[2:4]))
    return min(seconds)


def track_kernel_over_c() -> float:
    scene = load_scene("example2_heavy")
    start = Simulation(scene).state
    with tempfile.TemporaryDirectory() as folder:
        y = [*start.quaternion, *start.body_rate]
        calls = kernel._calls(ODE(Dynamics.of(scene), scene.torque), y, Path(folder))
        return _turns(
            {who: calls["dop853 step", who] for who in (kernel.LLVM, "C -O3")}
        )


def track_simulate_over_bound() -> float:
    floor, run = (
        find_floor(Task(), (1e-9,)),
        partial(simulate, load_scene("example2_heavy")),
    )
    assert floor.seconds is not None
    taken = median(time_in_turn({"": run}, ROUNDS, clock=time.process_time)[""])
    return taken / (floor.evaluations[1e-9] * floor.seconds)


def track_simulate_over_its_steps() -> float:
    scene = load_scene("example2_heavy")
    given: Any = {"scene": scene, "method": "dop853", "tolerance": 1e-9}
    return _turns({"simulate": partial(simulate, **given), "steps": own_steps(**given)})


def track_batch_over_c_simd() -> float:
    with tempfile.TemporaryDirectory() as folder:
        calls = batch._Work(load_scene("example2_heavy"), 2000, Path(folder)).calls
        return _turns({who: calls["dop853", who] for who in (batch.ONE, batch.FLOOR)})


def track_sweep_over_kernel() -> float:
    return sweep._ratios(26)["ratio to the kernel, processor time"]


def track_node_over_bare_loop() -> float:
    from benchmark import bare_loops
    from benchmark.nodes import Client

    with Client.start() as watch:
        node, loop = (
            median(
                bare_loops.measure(watch, name, 5.0, -1)["processor"] for _ in range(3)
            )
            for name in (bare_loops.NODE, bare_loops.LEAST)
        )
    return node / loop


def track_first_step_over_import_of_numpy() -> float:
    return _used_by("-c", FIRST) / _used_by("-c", "import numpy")


def track_command_over_import_of_numpy() -> float:
    return _used_by("-m", "sst_ros", "scene", "list") / _used_by("-c", "import numpy")


def track_size_over_a_megabyte() -> float:
    folder = Path(sst_ros.__file__).parent
    return sum(path.stat().st_size for path in folder.rglob("*.py")) / 1e6


def track_tests_over_ten_minutes() -> float:
    """Processor time of `make test`, with what its processes use, over LONGEST_S."""
    before = os.times()
    subprocess.run(["make", "test"], check=True, cwd=DOCS.parent, timeout=7200)
    return (sum(os.times()[2:4]) - sum(before[2:4])) / LONGEST_S


TRACKS = {
    name[6:].replace("_", " "): f
    for name, f in globals().items()
    if name[:6] == "track_"
}


@styled
def draw(rows: Any) -> Figure:
    """Draw each ratio over the releases."""
    figure = Figure(figsize=(12.0, 6.0))
    for axes, name in zip(figure.subplots(2, 5).flat, TRACKS, strict=True):
        axes.plot(rows.release, rows[name], "o-", color=BLUE)
        axes.set(title=name.replace(" over ", "\nover "), ylim=(0.0, None))
    return figure


def main(arguments: list[str] | None = None) -> int:
    """Measure all; print them, and write the row, the page and its picture."""
    import pandas as pd

    options = read_options("ratios", __doc__, arguments, write=False, tests=False)
    row: dict[str, Any] = {"release": sst_ros.__version__, "date": str(date.today())}
    for name, track in TRACKS.items():
        if options.tests or track is not track_tests_over_ten_minutes:
            row[name] = float(f"{track():.3g}")
            print(f"{name}: {row[name]}", flush=True)
    row["load"], row["processor"] = round(os.getloadavg()[0], 1), processor()
    if options.write:
        file, frame = DOCS / "ratios.csv", data_frame([row])
        if file.exists():
            old = pd.read_csv(file, dtype={"release": str})
            frame = pd.concat([old[old.release != row["release"]], frame])
        frame.to_csv(file, index=False)
        table = (
            frame.set_index("release")
            .T.rename_axis("ratio")
            .reset_index()
            .fillna("not yet")
        )
        fill_page(DOCS / "ratios.md", {"ratios": markdown(table)})
        save_figure(
            draw(frame.reindex(columns=["release", *TRACKS])), DOCS / "ratios.png"
        )
    return 0


if __name__ == "__main__":
    sys.exit(main())
