# SPDX-License-Identifier: Apache-2.0
"""What a prepared run costs beside the integration itself, and a command beside NumPy's import.

python -m benchmark.front_door

Example 2 at 1e-9 rad by collocation, compiled; the command is `sst-ros scene list`.
"""

from __future__ import annotations

import resource
import subprocess
import sys
import time
from collections.abc import Callable
from statistics import median

from sst_ros import Simulation, Trajectory, load_scene, prepare, simulate
from sst_ros.simulation.simulate_gauss import GaussMotion

ROUNDS, CALLS, STARTS = 50, 10, 9


def seconds(call: Callable[[], object]) -> float:
    """Time of a call, mean of several [s]."""
    began = time.perf_counter()
    for _ in range(CALLS):
        call()
    return (time.perf_counter() - began) / CALLS


def processor_seconds(*words: str) -> float:
    """Processor time of one start of Python [s]."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    subprocess.run([sys.executable, *words], stdout=subprocess.DEVNULL, check=True, timeout=60)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def main() -> None:
    scene = load_scene("example2_heavy")
    state = Simulation(scene).state
    assert scene.torque is not None
    motion = GaussMotion(scene, scene.torque, [*state.quaternion, *state.body_rate], 1.0, 1e-9)

    def whole() -> Trajectory:
        return simulate(scene, method="gauss", tolerance=1e-9)

    prepared = prepare(scene, method="gauss", tolerance=1e-9).run
    times = [(seconds(motion.run), seconds(prepared), seconds(whole)) for _ in range(ROUNDS)]
    alone, again, all_of_it = (1e6 * median(column) for column in zip(*times, strict=True))
    print(whole())
    print(f"integration {alone:.1f} us, prepare().run() {again:.1f}, simulate() {all_of_it:.0f}")
    ratio = median(b / a for a, b, _ in times)
    print(f"overhead {ratio - 1.0:.2f} times the integration (median of {ROUNDS} rounds)")
    starts = [
        (
            processor_seconds("-m", "sst_ros", "scene", "list"),
            processor_seconds("-c", "import numpy"),
        )
        for _ in range(STARTS)
    ]
    ratio = median(listing / numpy for listing, numpy in starts)
    print(
        f"sst-ros scene list: {ratio:.1f} times import numpy (median of {STARTS} rounds, limit 3)"
    )


if __name__ == "__main__":
    main()
