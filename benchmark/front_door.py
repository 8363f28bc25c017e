# SPDX-License-Identifier: Apache-2.0
"""What a user's call costs beside the steps that it contains.

python -m benchmark.front_door [--rounds 9]

One second of each class of scene, its 200 samples read; the first call in a new
process, a later one, and the calls of its compiled steps alone. MuJoCo's best setting
for Example 2 stands beside.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable, Sequence
from functools import partial
from statistics import median
from typing import Any, NamedTuple

from benchmark.measure import describe_machine, join_line, time_in_turn
from sst_ros import Simulation, Trajectory, load_scene, simulate
from sst_ros.integration.function_steps import FeedbackSteps, FunctionSteps, TimeSteps
from sst_ros.integration.method_steps import MethodSteps
from sst_ros.integration.point import Drive, Point
from sst_ros.state import State

PERIOD = 0.001
TICK_NS = 1_000_000


class Call(NamedTuple):
    """A public call: what it is, and its arguments."""

    name: str
    scene: str
    options: dict[str, Any]


def follow_time(t: float) -> tuple[float, float, float]:
    return 2.0 * t, 1.0 - t, 0.5


def damp(t: float, state: State) -> tuple[float, float, float]:
    first, second, third = state.joints.gamma_dot
    return -0.5 * first, -0.5 * second, -0.5 * third


CALLS = (
    Call("example2_heavy, auto, 1e-6", "example2_heavy", {"tolerance": 1e-6}),
    Call("example2_heavy, auto, 1e-9", "example2_heavy", {}),
    *(
        Call(f"example2_heavy, {method}", "example2_heavy", {"method": method})
        for method in ("dop853", "dopri5", "rk4", "rodas5p")
    ),
    Call("torque as a function of time", "example2_heavy", {"torque": follow_time}),
    Call("torque as a function of the state", "example2_heavy", {"torque": damp}),
    Call("elastic_stops, auto", "elastic_stops", {}),
    Call("friction, auto", "friction", {}),
    Call("friction, dop853", "friction", {"method": "dop853"}),
    Call("stiff, auto", "stiff", {}),
    Call(
        "a controller, 1000 periods",
        "example2_heavy",
        {"torque": damp, "control_period": PERIOD},
    ),
)


class StepCall(NamedTuple):
    """A call of compiled steps that a motion has made."""

    steps: MethodSteps | FunctionSteps
    t: float
    h: float
    at: Point
    drive: Drive
    other: Drive | None


def own_steps(**options: Any) -> Callable[[], None]:
    """Return a function that repeats the calls of compiled steps of a call of
    `simulate`.
    """
    calls: list[StepCall] = []
    originals = {
        kind: kind.pair
        for kind in (MethodSteps, FunctionSteps, TimeSteps, FeedbackSteps)
    }

    def record(kind: Any) -> Any:
        def pair(
            self: Any, t: float, h: float, at: Point, drive: Drive, other: Any = None
        ) -> Any:
            calls.append(StepCall(self, t, h, at, drive, other))
            return originals[kind](self, t, h, at, drive, other)

        return pair

    try:
        for kind in originals:
            kind.pair = record(kind)  # type: ignore[method-assign]
        simulate(**options)
    finally:
        for kind, pair in originals.items():
            kind.pair = pair  # type: ignore[method-assign]

    def repeat() -> None:
        for call in calls:
            call.steps.pair(call.t, call.h, call.at, call.drive, call.other)

    return repeat


def read_all(motion: Trajectory) -> None:
    """Read what a user plots."""
    _ = motion.quaternion, motion.gamma, motion.gamma_dot, motion.torque


def main(arguments: list[str] | None = None) -> int:
    """Measure and print; the exit status is 0."""
    parser = argparse.ArgumentParser("front_door", description=__doc__)
    parser.add_argument("--rounds", type=int, default=9)
    options = parser.parse_args(arguments)
    print("| call | first [ms] | later [ms] | its steps [ms] | ratio |")
    print("| --- | --- | --- | --- | --- |")
    for call in CALLS:
        print(measure(call, options.rounds), flush=True)
    print()
    print("\n".join(measure_steps(options.rounds)))
    print("\n" + join_line(describe_machine("numpy", "llvmlite")))
    return 0


def measure(call: Call, rounds: int) -> str:
    """Return a row of the table: processor time of a call, and of its steps alone."""
    given: dict[str, Any] = {"duration": 1.0, **call.options}
    scene = load_scene(call.scene)

    def whole() -> None:
        read_all(simulate(scene, **given))

    began = time.process_time()
    whole()
    first = time.process_time() - began
    calls = {"call": whole, "steps": own_steps(scene=scene, **given)}
    taken = time_in_turn(calls, rounds, clock=time.process_time)
    later, steps = median(taken["call"]), median(taken["steps"])
    figures = f"{1e3 * first:.1f} | {1e3 * later:.2f} | {1e3 * steps:.3f}"
    return f"| {call.name} | {figures} | {later / steps:.1f} |"


def measure_steps(rounds: int) -> Sequence[str]:
    """Return lines on single steps of a `Simulation`."""
    run = Simulation("example2_heavy")
    run.load_code()
    taken = time_in_turn(
        {"step": partial(_ticks, run, 100)}, rounds, clock=time.process_time
    )
    return [f"Simulation.step, 1 ms: {1e6 * median(taken['step']) / 100:.1f} us"]


def _ticks(run: Simulation, count: int) -> None:
    run.reset()
    for _ in range(count):
        run.step((0.1, -0.2, 0.3), TICK_NS)


if __name__ == "__main__":
    sys.exit(main())
