# SPDX-License-Identifier: Apache-2.0
"""What a prepared run costs beside the integration itself, and a command beside NumPy's import.

python -m benchmark.front_door

Example 2 at 1e-9 rad by collocation, compiled; the command is `sst-ros scene list`.
"""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Callable
from functools import partial
from statistics import median

import numpy as np

from benchmark.measure import divide, time_in_turn
from sst_ros import load_scene, prepare, simulate
from sst_ros.scene.torque_profile import profile_of
from sst_ros.simulation.simulate_gauss import CollocatedMotion
from sst_ros.simulation.stepped_motion import Task

ROUNDS, STARTS = 50, 9
LIST, NUMPY = ("-m", "sst_ros", "scene", "list"), ("-c", "import numpy")


def start(*words: str) -> None:
    """Start Python."""
    subprocess.run([sys.executable, *words], stdout=subprocess.DEVNULL, check=True, timeout=60)


def used_by_children() -> float:
    """Processor time of all processes that were started [s]."""
    used = os.times()
    return used.children_user + used.children_system


def main() -> None:
    scene = load_scene("example2_heavy")
    profile = profile_of(scene.torque)
    task = Task(scene, profile, (0.0, 1.0), np.array([0.0, 1.0]), "gauss", 1e-9)
    whole = partial(simulate, scene, method="gauss", tolerance=1e-9)
    calls: dict[str, Callable[[], object]] = {
        "integration": CollocatedMotion(task).compute,
        "prepare().run()": prepare(scene, method="gauss", tolerance=1e-9).run,
        "simulate()": whole,
    }
    print(whole())
    times = time_in_turn(calls, ROUNDS, clock=time.process_time)
    print(", ".join(f"{name} {1e6 * median(taken):.1f} us" for name, taken in times.items()))
    ratio = divide(times, "prepare().run()", "integration")
    print(f"overhead {ratio - 1.0:.2f} times the integration (median of {ROUNDS} rounds)")
    starts = time_in_turn(
        {words: partial(start, *words) for words in (LIST, NUMPY)}, STARTS, clock=used_by_children
    )
    ratio = divide(starts, LIST, NUMPY)
    print(
        f"sst-ros scene list: {ratio:.1f} times import numpy (median of {STARTS} rounds, limit 3)"
    )


if __name__ == "__main__":
    main()
