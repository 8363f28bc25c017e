# SPDX-License-Identifier: Apache-2.0
"""What `simulate` costs beside the integration itself: Example 2 at 1e-9 rad, compiled.

python -m benchmark.front_door
"""

import time
from statistics import median

from sst_ros import Simulation, load_scene, simulate
from sst_ros.integration.gauss_motion import GaussMotion

ROUNDS, CALLS = 50, 40


def seconds(call):
    began = time.perf_counter()
    for _ in range(CALLS):
        call()
    return (time.perf_counter() - began) / CALLS


def main():
    scene = load_scene("example2_heavy")
    state = Simulation(scene).state
    motion = GaussMotion(scene, scene.torque, [*state.quaternion, *state.body_rate], 1.0, 1e-9)

    def whole():
        return simulate(scene, method="gauss", tolerance=1e-9)

    found = whole()
    times = [(seconds(motion.run), seconds(whole)) for _ in range(ROUNDS)]
    alone, all_of_it = (1e6 * median(column) for column in zip(*times, strict=True))
    ratio = median(b / a for a, b in times)
    print(found)
    print(f"integration {alone:.1f} us, simulate() {all_of_it:.1f} us")
    print(f"overhead {ratio - 1.0:.2f} times the integration (median of {ROUNDS} rounds)")


if __name__ == "__main__":
    main()
