# SPDX-License-Identifier: Apache-2.0
"""Operations and time of one evaluation of the right-hand side, by scene.

    python -m benchmark.scenes [--markdown]

`bare` is a kernel that was written without any optional term (test/mechanism/bare_kernel.py) on
the bodies of example2_heavy. Every round times every program once, in an order that changes, and
ratios are taken within a round; what is told is the median of the rounds. `python` runs the flat
function in the interpreter, `numba` the same source compiled, in a loop of compiled code.
"""

from __future__ import annotations

import argparse
import importlib.util
import platform
import random
import statistics
import sys
import time
from collections.abc import Callable
from importlib import metadata
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "test"))

from mechanism.bare_kernel import program_of  # noqa: E402

from sst_ros.dynamics.expression import Program  # noqa: E402
from sst_ros.dynamics.traced_dynamics import Dynamics  # noqa: E402
from sst_ros.scene.scene import load, names  # noqa: E402

PLAIN = "example2_heavy"
ROUNDS = 41
CALLS = {"python": 400, "numba": 20_000}


def programs() -> dict[str, Program]:
    """The bare kernel and every shipped scene."""
    return {"bare": program_of(load(PLAIN))} | {
        name: Dynamics.of(load(name)).program for name in names()
    }


def inputs(program: Program) -> tuple[float, ...]:
    """A regular state away from every end, moving, under torques."""
    state = (-0.1759, 0.4247, 0.3399, 0.8205, 0.4, -0.3, 0.2)
    return (*state, *(0.1 * (i + 1) for i in range(len(program.inputs) - 7)))


def in_python(program: Program) -> Callable[[], float]:
    """Seconds of a call, by a loop in the interpreter."""
    from sst_ros.dynamics.traced_dynamics import compiled

    function, at = compiled(program), inputs(program)

    def once() -> float:
        began = time.perf_counter()
        for _ in range(CALLS["python"]):
            function(*at)
        return (time.perf_counter() - began) / CALLS["python"]

    return once


def in_numba(program: Program) -> Callable[[], float]:
    """Seconds of a call, by a compiled loop in which each call needs the one before."""
    import math

    import numba

    space = {name: getattr(math, name) for name in ("sqrt", "tanh", "exp", "atan2")}
    exec(program.source("function"), space)
    function = numba.njit(error_model="numpy")(space["function"])
    arguments = ", ".join(f"at[{i}]" for i in range(1, len(program.inputs)))
    loop = "def loop(at, count):\n    x = at[0]\n    for _ in range(count):\n"
    loop += (
        f"        out = function(x, {arguments})\n        x = at[0] + 1e-9 * out[4]\n    return x\n"
    )
    names_of_loop = {"function": function}
    exec(loop, names_of_loop)
    run, at = numba.njit(names_of_loop["loop"]), np.array(inputs(program))
    run(at, 1)

    def once() -> float:
        began = time.perf_counter()
        run(at, CALLS["numba"])
        return (time.perf_counter() - began) / CALLS["numba"]

    return once


def measure(timers: dict[str, Callable[[], float]]) -> dict[str, tuple[float, float]]:
    """Median seconds of each timer, and median of its ratio to the bare kernel's."""
    order, rounds = list(timers), []
    for _ in range(ROUNDS):
        random.shuffle(order)
        rounds.append({name: timers[name]() for name in order})
    return {
        name: (
            statistics.median(times[name] for times in rounds),
            statistics.median(times[name] / times["bare"] for times in rounds),
        )
        for name in timers
    }


def machine() -> str:
    """Processor and versions."""
    model = platform.processor() or platform.machine()
    information = Path("/proc/cpuinfo")
    if information.exists():
        lines = information.read_text(encoding="utf-8").splitlines()
        model = next((x.split(":")[1].strip() for x in lines if x.startswith("model name")), model)
    packages = ["numpy", *(["numba"] if importlib.util.find_spec("numba") else [])]
    versions = ", ".join(f"{name} {metadata.version(name)}" for name in packages)
    return f"{model}; {platform.system()}; Python {platform.python_version()}, {versions}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--markdown", action="store_true", help="write the table as Markdown")
    markdown = parser.parse_args().markdown
    traced = programs()
    ways = {"python": in_python}
    if importlib.util.find_spec("numba"):
        ways["numba"] = in_numba
    results = {
        way: measure({name: make(program) for name, program in traced.items()})
        for way, make in ways.items()
    }
    heads = ["scene", "operations", *(x for way in ways for x in (f"{way} [us]", "ratio to bare"))]
    rows = [heads]
    for name, program in traced.items():
        row = [name, str(program.operations.total())]
        for result in results.values():
            row += [f"{1e6 * result[name][0]:.3f}", f"{result[name][1]:.3f}"]
        rows.append(row)
    widths = [max(len(row[i]) for row in rows) for i in range(len(heads))]
    if markdown:
        rows.insert(1, ["-" * width for width in widths])
    print(machine(), f"\nmedians of {ROUNDS} rounds\n")
    for row in rows:
        cells = [f"{cell:<{width}}" for cell, width in zip(row, widths, strict=True)]
        print(f"| {' | '.join(cells)} |" if markdown else "  ".join(cells).rstrip())


if __name__ == "__main__":
    main()
