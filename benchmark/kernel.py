# SPDX-License-Identifier: Apache-2.0
"""What one step costs: machine code by LLVM, plain Python, and C from the same traced
program.

python -m benchmark.kernel [--scene example2_heavy] [--rounds 15]
"""

from __future__ import annotations

import ctypes
import sys
import tempfile
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from statistics import median
from typing import Any

from benchmark import c_floor
from benchmark.measure import (
    Costs,
    describe_machine,
    join_line,
    read_options,
    time_in_turn,
)
from benchmark.plain_python import without_llvmlite
from sst_ros.dynamics.traced_dynamics import ODE, Dynamics
from sst_ros.integration.method_steps import MethodSteps
from sst_ros.integration.methods import DOP853, DORMAND_PRINCE, RK4
from sst_ros.integration.point import Drive
from sst_ros.scene import scene as scenes
from sst_ros.simulation.simulation import Simulation

METHODS = {"rk4": RK4, "dopri5": DORMAND_PRINCE, "dop853": DOP853}
FLAGS = {"C -O3": ("-O3",), "C -O3 -march=native": ("-O3", "-march=native")}
LLVM, PLAIN = "LLVM, with its call from Python", "plain Python"
STEPS, STEP = 1000, 1e-4
AT_MOST_C, AT_MOST_PLAIN = 1.3, 60e-6


def main(arguments: list[str] | None = None) -> int:
    """Measure, print, and say whether the targets are met.

    The exit status is 0 either way.
    """
    options = read_options(
        "kernel", __doc__, arguments, scene="example2_heavy", rounds=15
    )
    scene = scenes.load(options.scene)
    system = ODE(Dynamics.of(scene), scene.torque)
    start = Simulation(scene).state
    y = [*start.quaternion, *start.body_rate]
    if len(system.state) != 7 or system.drive:
        sys.exit("needs a scene with a torque, without lag or moment from a topic")
    with_c = c_floor.has_gcc()
    with tempfile.TemporaryDirectory() as folder:
        calls = _calls(system, y, Path(folder) if with_c else None)
        seconds = time_in_turn(
            calls, options.rounds, shortest=5e-3, clock=time.process_time
        )
    host = describe_machine("numpy", "llvmlite")
    if with_c:
        host["gcc"] = c_floor.read_version()
    counts = {key: STEPS // 10 if key[1] == PLAIN else STEPS for key in seconds}
    costs = Costs(seconds, counts, "C -O3")
    size = sum(system.program.operations.values())
    print(
        f"Scene {options.scene}: {size} operations an evaluation, torques as sines"
        " included."
    )
    print(
        f"Processor time: medians of {options.rounds} interleaved rounds, and of"
        " quotients.\n"
    )
    costs.print()
    for work in dict.fromkeys(work for work, _ in seconds):
        costs.judge(work, LLVM, "C -O3", AT_MOST_C)
    plain = median(seconds["rk4 step", PLAIN]) / counts["rk4 step", PLAIN]
    met = "met" if plain <= AT_MOST_PLAIN else "MISSED"
    print(f"plain rk4 step {1e6 * plain:.1f} us, target {1e6 * AT_MOST_PLAIN:g}: {met}")
    print("\n" + join_line(host))
    return 0


def _calls(
    system: ODE, y: list[float], folder: Path | None
) -> dict[tuple[str, str], Callable[[], Any]]:
    """What is timed, by (work, who): STEPS steps each, fewer of plain Python."""
    calls: dict[tuple[str, str], Callable[[], Any]] = {}
    for name, method in METHODS.items():
        fast, plain = MethodSteps(system, method), MethodSteps(system, method)
        fast.load()
        with without_llvmlite():
            plain.load()
        work = f"{name} step"
        calls[work, LLVM] = partial(fast.fixed, 0.0, STEP, STEPS, y, Drive(()))
        calls[work, PLAIN] = partial(plain.fixed, 0.0, STEP, STEPS // 10, y, Drive(()))
        if folder is not None:
            _add_c(
                calls, c_floor.write_step(system.program, method), y, folder, name, fast
            )
    return calls


def _add_c(
    calls: Any, text: str, y: list[float], folder: Path, name: str, fast: MethodSteps
) -> None:
    array = ctypes.c_double * len(y)
    expected = fast.fixed(0.0, STEP, STEPS, y, Drive(()))
    for index, (who, flags) in enumerate(FLAGS.items()):
        library = c_floor.compile_step(text, folder, f"{name}_{index}", *flags)
        state, error = array(*y), array()
        library.march(0.0, STEP, STEPS, state, error)
        apart = max(abs(a - b) for a, b in zip(state, expected, strict=True))
        if not apart < 1e-12:
            raise RuntimeError(
                f"{who} {name} is not the same program: {apart:.1e} apart"
            )

        def march(library: Any = library, error: Any = error) -> Any:
            return library.march(0.0, STEP, STEPS, array(*y), error)

        calls[f"{name} step", who] = march


if __name__ == "__main__":
    sys.exit(main())
