# SPDX-License-Identifier: Apache-2.0
"""Our trace of the kernel beside CasADi's: operations left, and what an evaluation then costs.

pip install casadi; python -m benchmark.tracers [--rounds 15]
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from statistics import median
from typing import Any

import numpy as np

from benchmark import machine
from benchmark.timing import interleaved
from sst_ros.dynamics.traced_dynamics import ODE, Dynamics, compiled
from sst_ros.scene import scene as scenes
from sst_ros.simulation.simulation import Simulation

SCENES = ("example2_heavy", "general", "gravity_payload", "friction")
AGREE = 1e-12
REPEATS = 1000


def main(arguments: list[str] | None = None) -> int:
    """Print a row a scene; the exit status is 1 where the two do not agree."""
    parser = argparse.ArgumentParser(prog="python -m benchmark.tracers", description=__doc__)
    parser.add_argument("--rounds", type=int, default=15)
    rounds = parser.parse_args(arguments).rounds
    try:
        import casadi
    except ImportError:
        print("casadi is missing: pip install casadi", file=sys.stderr)
        return 1
    casadi.GlobalOptions.setNumpyMode(1)
    # How the kernel has functions beyond + - * / taken on numbers of other kinds: `elementary`.
    casadi.SX.traced = lambda self, name, *given: getattr(casadi, name)(*(given or (self,)))
    print(f"{'scene':18}{'operations':>12}{'casadi SX':>12}{'and its cse':>12}", end="")
    print(f"{'plain us':>12}{'numba us':>12}{'casadi us':>12}")
    for name in SCENES:
        print(_row(casadi, name, rounds), flush=True)
    print("\n" + machine.line(machine.described("casadi", "numba")))
    return 0


def _row(casadi: Any, name: str, rounds: int) -> str:
    import numba

    scene = scenes.load(name)
    system = ODE(Dynamics.of(scene), scene.torque)
    start = Simulation(scene).state
    drive = len(system.drive)
    given = [0.0, *start.quaternion, *start.body_rate, *(0.0,) * drive]
    symbols = [casadi.SX.sym(f"x{i}") for i in range(len(given))]
    slope = casadi.vertcat(*system.derivative(*symbols))
    whole, shared = (
        casadi.Function("slope", [casadi.vertcat(*symbols)], [each])
        for each in (slope, casadi.cse(slope))
    )
    plain = compiled(system.program)
    fast = numba.njit(error_model="numpy")(plain)
    ours, theirs = np.array(plain(*given)), np.array(shared(given)).ravel()
    apart = float(np.max(np.abs(ours - theirs) / (1.0 + np.abs(ours))))
    if not apart < AGREE:
        raise SystemExit(f"{name}: the two differ by {apart:.1e}")
    seconds = interleaved(
        {
            "plain": _repeated(lambda: plain(*given)),
            "numba": _inside(numba, fast, given),
            "casadi": _by_casadi(shared, given),
        },
        rounds,
    )
    times = "".join(f"{1e6 * median(seconds[who]) / REPEATS:12.2f}" for who in seconds)
    counts = (sum(system.program.operations.values()), _count(casadi, whole))
    return f"{name:18}{counts[0]:12}{counts[1]:12}{_count(casadi, shared):12}{times}"


def _repeated(call: Callable[[], Any]) -> Callable[[], None]:
    def repeat() -> None:
        for _ in range(REPEATS):
            call()

    return repeat


def _inside(numba: Any, fast: Any, given: list[float]) -> Callable[[], Any]:
    """REPEATS evaluations in compiled code, each at another time."""
    text = f"def loop(n, {', '.join(f'x{i}' for i in range(len(given)))}):\n    total = 0.0\n"
    inputs = ", ".join(["x0 + i * 1e-9", *(f"x{i}" for i in range(1, len(given)))])
    text += f"    for i in range(n):\n        total += fast({inputs})[4]\n    return total\n"
    names: dict[str, Any] = {"fast": fast}
    exec(text, names)
    loop = numba.njit(names["loop"])
    return lambda: loop(REPEATS, *given)


def _by_casadi(function: Any, given: list[float]) -> Callable[[], None]:
    """Its virtual machine, by the call with least in between."""
    buffer, evaluate = function.buffer()
    into, out = np.array(given), np.zeros(function.size1_out(0))
    buffer.set_arg(0, memoryview(into))
    buffer.set_res(0, memoryview(out))

    def call(kept: Any = (buffer, into, out)) -> None:  # casadi has only their addresses
        evaluate()

    return _repeated(call)


def _count(casadi: Any, function: Any) -> int:
    free = (casadi.OP_INPUT, casadi.OP_OUTPUT, casadi.OP_CONST)
    return sum(function.instruction_id(i) not in free for i in range(function.n_instructions()))


if __name__ == "__main__":
    sys.exit(main())
