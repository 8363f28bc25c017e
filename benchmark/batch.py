# SPDX-License-Identifier: Apache-2.0
"""What a step of many scenarios costs: numba, the same text in C with SIMD, and NumPy columns.

python -m benchmark.batch [--scene example2_heavy] [--scenarios 10000] [--rounds 9]
"""

from __future__ import annotations

import os
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from benchmark import c_floor
from benchmark.measure import Costs, describe_machine, join_line, read_options, time_in_turn
from sst_ros.dynamics import kernel
from sst_ros.dynamics.traced_dynamics import Dynamics
from sst_ros.integration.batch import Batch
from sst_ros.integration.batch_source import SIMD_WIDTH
from sst_ros.integration.methods import DOP853, RK4, Tableau
from sst_ros.scene import scene as scenes
from sst_ros.scene.bodies import Link, Star
from sst_ros.scene.scene import Scene

METHODS = {"rk4": RK4, "dop853": DOP853}
SIMD = ("-O3", "-march=native", "-fno-math-errno", "-fno-trapping-math")
"""The last two change no bit; without them gcc leaves square roots and choices scalar."""

FLAGS = {
    "C SIMD": SIMD,
    "C SIMD, no fma": (*SIMD, "-ffp-contract=off"),
    "C SIMD, -ffast-math": (*SIMD, "-ffast-math"),
}
ONE, ALL, FLOOR, PLAIN = "numba, 1 thread", "numba, all cores", "C SIMD", "C SIMD, no fma"
COLUMNS = "NumPy columns"
AT_MOST_C, AT_LEAST_COLUMNS = 1.5, 20
STEP, STEPS = 1e-3, 20
SPREAD = 0.05

COUNT = 100
"""Scenarios whose parameters differ, for what varying them costs."""

TENSOR = ("xx", "yy", "zz", "xy", "xz", "yz")
STAR, BODIES = "numba, 1 thread, star.inertia varied", "numba, 1 thread, all bodies varied"

State = tuple[Any, ...]


def main(arguments: list[str] | None = None) -> int:
    """Measure, print, and say whether the targets are met; the exit status is 0 either way."""
    options = read_options(
        "batch", __doc__, arguments, scene="example2_heavy", scenarios=10_000, rounds=9
    )
    scene = scenes.load(options.scene)
    with_c = c_floor.has_gcc()
    with tempfile.TemporaryDirectory() as folder:
        work = _Work(scene, options.scenarios, Path(folder) if with_c else None)
        seconds = time_in_turn(work.calls, options.rounds, shortest=5e-3)
    host = describe_machine("numpy", "numba", "llvmlite")
    if with_c:
        host["gcc"] = c_floor.read_version()
    counts = {
        (name, who): (1 if who == COLUMNS else STEPS) * options.scenarios * len(METHODS[name].b)
        for name, who in seconds
    }
    costs = Costs(seconds, counts, FLOOR)
    print(f"Scene {options.scene}, {options.scenarios} scenarios in blocks of {SIMD_WIDTH} lanes.")
    print("Time per evaluation and scenario: a step with limits and error, over its stages.")
    print(f"Medians of {options.rounds} interleaved rounds; ratios are medians of quotients.\n")
    print("\n".join(work.notes), "\n")
    costs.print()
    for name in METHODS:
        for floor in (FLOOR, PLAIN):
            costs.judge(name, ONE, floor, AT_MOST_C)
        for who in (STAR, BODIES):
            print(f"{name}: {who} over fixed {costs.ratio(name, who, ONE):.2f}")
        for ours in (ALL, ONE):
            costs.judge(name, COLUMNS, ours, AT_LEAST_COLUMNS, least=True)
    print("\n" + join_line(host))
    return 0


class _Work:
    """What is timed, by (method, who): STEPS steps of all scenarios; NumPy does one."""

    def __init__(self, scene: Scene, number: int, folder: Path | None) -> None:
        self.calls: dict[tuple[str, str], Callable[[], Any]] = {}
        self.notes: list[str] = []
        self._scene, self._number, self._profile = scene, number, scene.torque is not None
        centre = np.array(scene.initial.gamma)
        self._gamma = centre + np.random.default_rng(1).uniform(-SPREAD, SPREAD, (number, 3))
        for name, method in METHODS.items():
            self._add(name, method, folder)

    def _add(self, name: str, method: Tableau, folder: Path | None) -> None:
        batch = Batch(self._scene, method, profile=self._profile)
        y, code = batch.start(self._gamma, (0.0, 0.0, 0.0))
        given = batch.drives((0.0, 0.0, 0.0), self._number)

        def start(given: np.ndarray = given) -> tuple[np.ndarray, ...]:
            number = self._number
            return y.copy(), given, code.copy(), np.full(number, np.nan), np.zeros(number)

        def run(threads: int, batch: Batch = batch, given: np.ndarray = given) -> Any:
            arrays = start(given)
            batch.advance(0, STEPS, STEP, *arrays, threads=threads)
            return arrays

        self.calls[name, ONE] = partial(run, 1)
        self.calls[name, ALL] = partial(run, len(os.sched_getaffinity(0)))
        for who, parameters in vary(self._scene).items():
            # The parameters of a hundred scenarios, again and again.
            began = time.perf_counter()
            varied = Batch(self._scene, method, profile=self._profile, parameters=parameters)
            each = 1e3 * (time.perf_counter() - began) / COUNT
            few = varied.drives((0.0, 0.0, 0.0), COUNT)
            many = few[:, np.arange(self._number) % COUNT].copy()
            self.notes.append(f"{name}, {who}: {len(few)} numbers, {each:.1f} ms to prepare one.")
            self.calls[name, who] = partial(run, 1, varied, many)
        if folder is not None:
            self._add_c(name, method, batch, start, run(1)[0], folder)
        dynamics, columns = Dynamics.of(self._scene), tuple(y.copy())
        slope = _columns(dynamics, self._scene)
        self.calls[name, COLUMNS] = partial(_step, method, slope, 0.0, columns)

    def _add_c(
        self, name: str, method: Tableau, batch: Batch, start: Callable[[], Any],
        expected: np.ndarray, folder: Path,
    ) -> None:  # fmt: skip
        size = len(batch.model.ode.state)
        text, loops = c_floor.write_batch(
            batch.model.program, batch.model.limit_distances, method, size
        )
        blocks = -(-self._number // SIMD_WIDTH)
        for index, (who, flags) in enumerate(FLAGS.items()):
            library, done = c_floor.compile_batch(text, folder, f"{name}_{index}", *flags)

            def run(library: Any = library) -> Any:
                arrays = start()
                pointers = (array.ctypes.data for array in arrays)
                library.batch(STEP, 0, STEPS, 0, blocks, self._number, *pointers)
                return arrays

            apart = float(np.abs(run()[0] - expected).max())
            if not apart < 1e-12:
                raise RuntimeError(f"{who} {name} is not the same program: {apart:.1e} apart")
            same = "the bits of numba" if apart == 0.0 else f"{apart:.0e} from numba"
            self.notes.append(
                f"{name}, {who} ({' '.join(flags)} -fopenmp-simd): gcc vectorised {done} of {loops}"
                f" loops over lanes; {same}."
            )
            self.calls[name, who] = run


def vary(scene: Scene) -> dict[str, dict[str, np.ndarray]]:
    """Numbers that differ between scenarios: rotations and stretches of all bodies, by a little."""
    rng = np.random.default_rng(2)
    bodies: dict[str, Star | Link] = {"star": scene.star}
    for kind in ("actuated_links", "intermediate_links"):
        bodies |= {f"{kind}[{k}]": link for k, link in enumerate(getattr(scene, kind))}
    turn = rng.uniform(-1.0, 1.0, (COUNT, 1)) * (1.0, -1.0, 0.0)
    everything = {
        "base.v": scene.base.v + rng.uniform(-1e-3, 1e-3, (COUNT, 3, 3)),
        "star.alpha_deg": scene.star.alpha_deg + turn,
    }
    for name, body in bodies.items():
        if body.inertia is not None:
            size = 0.1 * (body.inertia.xx + body.inertia.yy + body.inertia.zz)
            for i, key in enumerate(TENSOR):
                rows = size * ((i < 3) + rng.uniform(-0.1, 0.1, COUNT))
                everything[f"{name}.inertia.{key}"] = getattr(body.inertia, key) + rows
    star = {f"star.inertia.{key}": everything[f"star.inertia.{key}"] for key in TENSOR[:3]}
    return {STAR: star, BODIES: everything}


def _columns(dynamics: Dynamics, scene: Scene) -> Callable[..., State]:
    """The kernel as it is written, on one column a number."""
    torque = scene.torque

    def slope(t: float, *y: Any) -> State:
        tau = (0.0, 0.0, 0.0)
        if torque is not None:
            rows = zip(torque.amplitude, torque.frequency, torque.phase, strict=True)
            tau = tuple(a * np.sin(f * t + p) for a, f, p in rows)
        return kernel.derivative(dynamics.model, y, tau)

    return slope


def _step(method: Tableau, slope: Callable[..., State], t: float, y: State) -> State:
    """One step of all columns, without limits and error estimates."""
    stages: list[State] = []

    def combined(weights: Sequence[float], j: int) -> Any:
        return sum(w * k[j] for w, k in zip(weights, stages, strict=False) if w)

    for row, node in zip(method.a, method.c, strict=True):
        at = tuple(x + STEP * combined(row, j) for j, x in enumerate(y)) if stages else y
        stages.append(slope(t + node * STEP, *at))
    new = [x + STEP * combined(method.b, j) for j, x in enumerate(y)]
    length = np.sqrt(sum(x * x for x in new[:4]))
    return tuple(x / length for x in new[:4]) + tuple(new[4:])


if __name__ == "__main__":
    sys.exit(main())
