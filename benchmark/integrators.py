# SPDX-License-Identifier: Apache-2.0
"""Time to reach an error on stiff and smooth scenes: every method, plain Python and numba.

python -m benchmark.integrators [--plain]

Steps are fixed and double until the orientation at the end is right to the error; the time is the
median of repeats, in seconds of the processor, and methods are timed in turn. Ratios within one run
are what counts. Truth: RODAS4 in many short steps.
"""

from __future__ import annotations

import argparse
import math
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from statistics import median

from benchmark.measure import describe_machine, join_line, time_in_turn
from sst_ros.dynamics.traced_dynamics import ODE, Dynamics
from sst_ros.integration.compiled_method import CompiledMethod
from sst_ros.integration.methods import METHODS, RODAS4
from sst_ros.mechanism.frames import angle_between
from sst_ros.scene.scene import Friction, JointFriction, Scene, Spring, Stroke, Workspace, load
from sst_ros.simulation.simulation import Simulation

REPEATS = 7
MOST_STEPS = 2**20
AT_LEAST = 5
RESTS = (0.9, 0.7, 0.8)


def sprung(stiffness: float, damping: float) -> Scene:
    springs = [Spring(joint=f"gamma_{k + 1}", stiffness=stiffness, rest=RESTS[k]) for k in range(3)]
    return replace(
        load("example2_heavy"),
        springs=tuple(springs),
        friction=JointFriction(gamma=Friction(viscous=damping)),
        torque=None,
    )


def scenes() -> Iterator[tuple[str, Scene, float]]:
    """Name, scene and length [s] of each."""
    stroke, workspace = Stroke(at_end="ignore"), Workspace(at_edge="ignore")
    free = replace(load("example2_heavy"), stroke=stroke, workspace=workspace)
    yield "viscous 1e3, 1 s", sprung(500.0, 1e3), 1.0
    yield "viscous 1e5, 1 s", sprung(500.0, 1e5), 1.0
    yield "PD 1e6, 1e4, 0.1 s", sprung(1e6, 1e4), 0.1
    yield "example2_heavy, 1 s", free, 1.0


def counts_for(
    machine: CompiledMethod,
    arguments: tuple[list[float], tuple[float, ...], float],
    truth: Sequence[float],
    wanted: float,
    most: int,
) -> int | None:
    """Smallest power of two of steps that reaches the error; None where none does."""
    y, drive, span = arguments
    count = 4
    while count <= most:
        try:
            end = machine.step_fixed(0.0, span / count, count, y, drive)
        except (ArithmeticError, ValueError):
            end = [math.nan] * 4
        if angle_between(end[:4], truth[:4]) <= wanted:  # nan is not
            return count
        count *= 2
    return None


def compare(name: str, scene: Scene, span: float, wanted: float, compiled: bool) -> None:
    """Print the steps and the time of every method to an error [rad] on a scene."""
    dynamics = Dynamics.of(scene)
    system = ODE(dynamics, scene.torque)
    state = Simulation(replace(scene, torque=None)).state
    y = [*state.quaternion, *state.body_rate]
    drive = (0.0, 0.0, 0.0)[: len(system.drive)]
    arguments = (y, drive, span)
    best = CompiledMethod(system, RODAS4, compiled=True)
    truth = best.step_fixed(0.0, span / 2**15, 2**15, y, drive)
    machines = {m.name: CompiledMethod(system, m, compiled=compiled) for m in METHODS.values()}
    most = MOST_STEPS if compiled else 2**13
    counts = {k: counts_for(m, arguments, truth, wanted, most) for k, m in machines.items()}
    runs: dict[str, Callable[[], object]] = {
        k: partial(machines[k].step_fixed, 0.0, span / n, n, y, drive)
        for k, n in counts.items()
        if n is not None
    }
    seconds = time_in_turn(runs, REPEATS, clock=time.process_time)
    times = {name: median(taken) for name, taken in seconds.items()}
    how = "numba" if compiled else "plain"
    for key, count in counts.items():
        taken = f"{1e3 * times[key]:10.3f} ms" if key in times else f"    > {most} steps"
        print(f"{name:20} {how:6} {wanted:.0e}  {key:8} {count or '-':>8} steps {taken}")
    explicit = [times[k] for k in times if k != "rodas4"]
    if explicit and "rodas4" in times:
        ratio = min(explicit) / times["rodas4"]
        stiff = wanted == 1e-6 and not name.startswith("example2_heavy")
        target = f", target {AT_LEAST}: {'met' if ratio >= AT_LEAST else 'MISSED'}" if stiff else ""
        print(f"{name:20} {how:6} {wanted:.0e}  best explicit / rodas4 = {ratio:.3g}{target}")


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m benchmark.integrators", description=__doc__)
    parser.add_argument("--plain", action="store_true", help="time plain Python too: minutes")
    options = parser.parse_args()
    for compiled in (True, False) if options.plain else (True,):
        for name, scene, span in scenes():
            for wanted in (1e-6, 1e-9):
                compare(name, scene, span, wanted, compiled)
    print("\n" + join_line(describe_machine("numpy", "numba")))
    return 0


if __name__ == "__main__":
    sys.exit(main())
