# SPDX-License-Identifier: Apache-2.0
"""What a step of many scenarios costs: machine code in lanes, and the same program in C
with SIMD.

python -m benchmark.batch [--scene example2_heavy] [--scenarios 10000] [--rounds 9]
"""

from __future__ import annotations

import copy
import os
import sys
import tempfile
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from benchmark import c_floor
from benchmark.measure import (
    Costs,
    describe_machine,
    join_line,
    read_options,
    time_in_turn,
)
from sst_ros.integration.batch import Batch, block_width
from sst_ros.integration.batch_step import Block, ColumnStep, advance_blocks
from sst_ros.integration.methods import DOP853, RK4, Tableau
from sst_ros.scene import scene as scenes
from sst_ros.scene.scene import Scene

METHODS = {"rk4": RK4, "dop853": DOP853}
SIMD = ("-O3", "-march=native", "-fno-math-errno", "-fno-trapping-math")
"""The last two change no bit.

Without them gcc leaves square roots and choices scalar.
"""

FLAGS = {
    "C SIMD": SIMD,
    "C SIMD, no fma": (*SIMD, "-ffp-contract=off"),
    "C SIMD, -ffast-math": (*SIMD, "-ffast-math"),
}
ONE, ALL, FLOOR, PLAIN = "1 thread", "all cores", "C SIMD", "C SIMD, no fma"
AT_MOST_C = 1.2
STEP, STEPS = 1e-3, 20
SPREAD = 0.05


def main(arguments: list[str] | None = None) -> int:
    """Measure, print, and say whether the targets are met.

    The exit status is 0 either way.
    """
    options = read_options(
        "batch", __doc__, arguments, scene="example2_heavy", scenarios=10_000, rounds=9
    )
    scene = scenes.load(options.scene)
    with_c = c_floor.has_gcc()
    with tempfile.TemporaryDirectory() as folder:
        work = _Work(scene, options.scenarios, Path(folder) if with_c else None)
        seconds = time_in_turn(work.calls, options.rounds, shortest=5e-3)
    host = describe_machine("numpy", "llvmlite")
    if with_c:
        host["gcc"] = c_floor.read_version()
    counts = {
        key: STEPS * options.scenarios * len(METHODS[key[0]].b) for key in seconds
    }
    costs = Costs(seconds, counts, FLOOR)
    print(f"Scene {options.scene}, {options.scenarios} scenarios.")
    print(
        "Time per evaluation and scenario: a step with limits and error, over its"
        " stages."
    )
    print(
        f"Medians of {options.rounds} interleaved rounds; ratios are medians of"
        " quotients.\n"
    )
    print("\n".join(work.notes), "\n")
    costs.print()
    for name in METHODS:
        for floor in (FLOOR, PLAIN):
            costs.judge(name, ONE, floor, AT_MOST_C)
    print("\n" + join_line(host))
    return 0


class _Work:
    """What is timed, by (method, who): STEPS steps of all scenarios."""

    def __init__(self, scene: Scene, number: int, folder: Path | None) -> None:
        self.calls: dict[tuple[str, str], Callable[[], Any]] = {}
        self.notes: list[str] = []
        self._scene, self._number, self._profile = (
            scene,
            number,
            scene.torque is not None,
        )
        centre = np.array(scene.initial.gamma)
        self._gamma = centre + np.random.default_rng(1).uniform(
            -SPREAD, SPREAD, (number, 3)
        )
        for name, method in METHODS.items():
            self._add(name, method, folder)

    def _add(self, name: str, method: Tableau, folder: Path | None) -> None:
        batch = Batch(self._scene, method, profile=self._profile)
        y, code = batch.initial(self._gamma, (0.0, 0.0, 0.0))
        given = batch.drives((0.0, 0.0, 0.0), self._number)

        def start() -> tuple[np.ndarray, ...]:
            number = self._number
            return (
                y.copy(),
                given,
                code.copy(),
                np.full(number, np.nan),
                np.zeros(number),
            )

        def run(threads: int) -> Any:
            arrays = start()
            batch.advance(0, STEPS, STEP, *arrays, threads=threads)
            return arrays

        self.calls[name, ONE] = partial(run, 1)
        self.calls[name, ALL] = partial(run, len(os.sched_getaffinity(0)))
        if folder is not None:
            self._add_c(name, batch.programs, start, run(1), folder)

    def _add_c(
        self,
        name: str,
        programs: ColumnStep,
        start: Callable[[], Any],
        expected: tuple[np.ndarray, ...],
        folder: Path,
    ) -> None:
        width = block_width(self._number)
        begins = range(0, self._number, width)
        for index, (who, flags) in enumerate(FLAGS.items()):
            in_c = copy.copy(programs)
            program = programs.traced["advance"]
            in_c.advance = c_floor.RowsInC(
                program, 2, folder, f"{name}_{index}", *flags
            )

            def run(in_c: ColumnStep = in_c) -> Any:
                arrays = start()
                advance_blocks(Block(in_c, width), begins, 0, STEPS, STEP, *arrays)
                return arrays

            apart = float(np.abs(run()[0] - expected[0]).max())
            if not apart < 1e-12:
                raise RuntimeError(
                    f"{who} {name} is not the same program: {apart:.1e} apart"
                )
            same = (
                "the bits of the batch"
                if apart == 0.0
                else f"{apart:.0e} from the batch"
            )
            loop = "vectorised" if in_c.advance.vectorised else "did NOT vectorise"
            self.notes.append(
                f"{name}, {who} ({' '.join(flags)} -fopenmp-simd): gcc {loop} the loop;"
                f" {same}."
            )
            self.calls[name, who] = run


if __name__ == "__main__":
    sys.exit(main())
