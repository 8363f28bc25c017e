# SPDX-License-Identifier: Apache-2.0
"""What a prepared run costs beside the integration itself.

python -m benchmark.front_door

Example 2 at 1e-9 rad by collocation, compiled.
"""

from __future__ import annotations

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

ROUNDS = 50


def main() -> None:
    scene = load_scene("example2_heavy")
    profile = profile_of(scene.torque)
    task = Task(scene, profile, (0.0, 1.0), np.linspace(0.0, 1.0, 201), "gauss", 1e-9)
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


if __name__ == "__main__":
    main()
