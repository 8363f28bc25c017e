# SPDX-License-Identifier: Apache-2.0
"""What a user's call costs beside the steps that it contains.

python -m benchmark.front_door [--rounds 9] [--write]

One second of each class of scene, its 200 samples read. For each call: its first in a
new process, imports not counted; a later one; the calls of its compiled steps alone;
the calls of a user's function alone; and MuJoCo's best setting for the same second. All
in time of the processor. With --write the table becomes the first of docs/peers.md and
README.md.
"""

from __future__ import annotations

import argparse
import functools
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from functools import partial
from math import cos, sin
from statistics import median
from typing import Any, NamedTuple
from unittest import mock

from benchmark.measure import DOCS, describe_machine, fill_page, join_line, time_in_turn
from sst_ros import Simulation, Trajectory, load_scene, simulate
from sst_ros.integration import function_steps
from sst_ros.integration.method_steps import MethodSteps
from sst_ros.state import State

PERIOD = 0.001
TICK_NS = 1_000_000

ALLOWED_MS = 0.15
"""What a call may take besides 4 times its compiled steps and twice its functions."""


class MuJoCo(NamedTuple):
    """MuJoCo's best setting for an error, by `benchmark.peers`."""

    steps: int
    settle: float  # solref [s]
    mobility: float  # [1/kg]
    python: bool = False  # whether the torques are a function in Python


class Call(NamedTuple):
    """A public call: what it is, and its arguments."""

    name: str
    scene: str
    options: dict[str, Any]
    mujoco: MuJoCo | None = None


def follow_time(t: float) -> tuple[float, float, float]:
    """Return torques that change with the time."""
    return 0.5 * t, 0.3 - t, 0.2


def follow_sines(t: float) -> tuple[float, float, float]:
    """Return sines of the time."""
    return 0.3 * sin(5.0 * t), 0.2 * cos(3.0 * t), -0.1 * sin(7.0 * t)


def damp(t: float, state: State) -> tuple[float, float, float]:
    """Return constant torques, less some of the rates."""
    first, second, third = state.joints.gamma_dot
    return 0.4 - 0.5 * first, -0.2 - 0.5 * second, 0.3 - 0.5 * third


HEAVY = "example2_heavy"
CALLS = (
    Call("Example 2 to 1e-6 rad", HEAVY, {"tolerance": 1e-6}, MuJoCo(160, 0.01, 10.0)),
    Call("Example 2 to 1e-9 rad", HEAVY, {}, MuJoCo(3460, 0.003, 0.1)),
    *(
        Call(f"Example 2, {method}", HEAVY, {"method": method})
        for method in ("dop853", "dopri5", "rk4", "rodas5p")
    ),
    Call(
        "torque as a function of time, 1e-6 rad",
        HEAVY,
        {"torque": follow_time, "tolerance": 1e-6},
        MuJoCo(160, 0.01, 10.0, python=True),
    ),
    Call("torque as a function of time, 1e-9 rad", HEAVY, {"torque": follow_time}),
    Call(
        "torque of sines of the time, 1e-6 rad",
        HEAVY,
        {"torque": follow_sines, "tolerance": 1e-6},
    ),
    Call("torque as a function of the state", HEAVY, {"torque": damp}),
    Call("elastic stops, auto", "elastic_stops", {}),
    Call("friction, auto", "friction", {}),
    Call("friction, dop853", "friction", {"method": "dop853"}),
    Call("stiff, auto", "stiff", {}),
    Call(
        "a controller, 1000 periods", HEAVY, {"torque": damp, "control_period": PERIOD}
    ),
)


class Recorder:
    """A function whose calls are noted."""

    def __init__(self, function: Callable[..., Any], calls: list[Any]) -> None:
        self._function, self._calls = function, calls
        functools.update_wrapper(self, function)

    def __call__(self, *arguments: Any) -> Any:
        self._calls.append((self._function, arguments))
        return self._function(*arguments)


class OwnCalls(NamedTuple):
    """The calls that a call of `simulate` has made of what it cannot do without."""

    steps: list[Any]  # of compiled steps
    functions: list[Any]  # of the user's function


def record_calls(**options: Any) -> OwnCalls:
    """Note the calls of compiled steps, and of a user's function, of `simulate`."""
    own = OwnCalls([], [])
    pair = MethodSteps.pair

    def record_pair(self: MethodSteps, *arguments: Any) -> Any:
        own.steps.append((partial(pair, self), arguments))
        return pair(self, *arguments)

    def record_compiled(compiler: Any) -> Any:
        def compile_it(*arguments: Any) -> dict[str, Any]:
            compiled = compiler(*arguments)
            return {name: Recorder(one, own.steps) for name, one in compiled.items()}

        return compile_it

    torque = options.get("torque")
    if callable(torque):
        options = options | {"torque": _record_function(torque, own.functions)}
    by_stage = record_compiled(function_steps.compile_by_stage)
    stages = record_compiled(function_steps.compile_stages)
    with (
        mock.patch.object(MethodSteps, "pair", record_pair),
        mock.patch.object(function_steps, "compile_by_stage", by_stage),
        mock.patch.object(function_steps, "compile_stages", stages),
    ):
        simulate(**options)
    return own


def _record_function(function: Callable[..., Any], calls: list[Any]) -> Any:
    """Return a function that is called as another one, whose calls are noted."""

    @functools.wraps(function)
    def recorded(*arguments: Any) -> Any:
        calls.append((function, arguments))
        return function(*arguments)

    return recorded


def repeat(calls: Sequence[Any]) -> Callable[[], None]:
    """Return a function that makes calls again."""

    def run() -> None:
        for function, arguments in calls:
            function(*arguments)

    return run


def own_steps(**options: Any) -> Callable[[], None]:
    """Return a function that repeats the compiled steps of a call of `simulate`."""
    return repeat(record_calls(**options).steps)


def read_all(motion: Trajectory) -> None:
    """Read what a user plots."""
    _ = motion.quaternion, motion.gamma, motion.gamma_dot, motion.torque


class Row(NamedTuple):
    """Processor times of a call [ms]."""

    name: str
    first: float  # in a new process
    later: float
    steps: float  # its compiled steps alone
    functions: float  # calls of the user's function alone
    mujoco: float | None

    @property
    def ratio(self) -> float:
        """The call without what is allowed besides, over its compiled steps."""
        return (self.later - ALLOWED_MS - 2.0 * self.functions) / self.steps

    @property
    def short(self) -> str:
        """The row in README.md, "" where it has none."""
        if self.name not in SHORT:
            return ""
        mujoco = "-" if self.mujoco is None else f"{self.mujoco:.1f} ms"
        return f"| {self.name} | {self.later:.1f} ms | {mujoco} |"

    def __str__(self) -> str:
        functions = f"{self.functions:.3f}" if self.functions else "-"
        mujoco = "-" if self.mujoco is None else f"{self.mujoco:.2f}"
        times = f"{self.first:.0f} | {self.later:.2f} | {self.steps:.3f}"
        return f"| {self.name} | {times} | {functions} | {self.ratio:.1f} | {mujoco} |"


SHORT = (
    "Example 2 to 1e-6 rad",
    "Example 2 to 1e-9 rad",
    "torque as a function of time, 1e-6 rad",
    "elastic stops, auto",
    "friction, auto",
)
"""Rows that README.md has."""

SHORT_HEAD = """\
| one second, 200 samples read | `simulate` | MuJoCo, best setting, without samples |
| --- | ---: | ---: |"""

HEAD = """\
| one second, 200 samples read [ms] | first call | later | its steps alone \
| its functions alone | ratio | MuJoCo |
| --- | ---: | ---: | ---: | ---: | ---: | ---: |"""
"""The ratio is that of `Row.ratio`, which is to be at most 4."""


def main(arguments: list[str] | None = None) -> int:
    """Measure and print; the exit status is 0."""
    parser = argparse.ArgumentParser("front_door", description=__doc__)
    parser.add_argument("--rounds", type=int, default=9)
    parser.add_argument("--write", action="store_true", help="docs/peers.md, README.md")
    parser.add_argument(
        "--first", type=int, help="time the first call of one row alone"
    )
    options = parser.parse_args(arguments)
    if options.first is not None:
        print(time_first(CALLS[options.first]))
        return 0
    print(HEAD)
    rows = []
    for number, call in enumerate(CALLS):
        rows.append(measure(number, call, options.rounds))
        print(rows[-1], flush=True)
    machine = join_line(describe_machine("numpy", "llvmlite", "mujoco"))
    end = f"\n{measure_steps(options.rounds)}\n\nMeasured: {machine}."
    print(end)
    if options.write:
        table = "\n".join([HEAD, *map(str, rows), end])
        fill_page(DOCS / "peers.md", {"calls": table})
        short = [row.short for row in rows if row.short]
        fill_page(DOCS.parent / "README.md", {"calls": "\n".join([SHORT_HEAD, *short])})
    return 0


def measure(number: int, call: Call, rounds: int) -> Row:
    """Return a row of the table."""
    scene = load_scene(call.scene)
    options: dict[str, Any] = {"scene": scene, "duration": 1.0, **call.options}

    def whole() -> None:
        read_all(simulate(**options))

    command = [sys.executable, "-m", "benchmark.front_door", "--first", str(number)]
    child = subprocess.run(command, check=True, capture_output=True, text=True)
    first = float(child.stdout)
    whole()
    own = record_calls(**options)
    calls = {"later": whole, "steps": repeat(own.steps)}
    if own.functions:
        calls["functions"] = repeat(own.functions)
    if call.mujoco is not None:
        calls["mujoco"] = _prepare_mujoco(call.mujoco)
    times = time_in_turn(calls, rounds, shortest=0.02, clock=time.process_time)
    taken = {name: 1e3 * median(seconds) for name, seconds in times.items()}
    later, steps = taken["later"], taken["steps"]
    functions, mujoco = taken.get("functions", 0.0), taken.get("mujoco")
    return Row(call.name, 1e3 * first, later, steps, functions, mujoco)


def time_first(call: Call) -> float:
    """Return the processor time of a call in a process that has called nothing [s]."""
    scene = load_scene(call.scene)
    began = time.process_time()
    read_all(simulate(scene, **{"duration": 1.0, **call.options}))
    return time.process_time() - began


def _prepare_mujoco(setting: MuJoCo) -> Callable[[], Any]:
    """Return MuJoCo's run of the second, of which it hands out the end alone."""
    from benchmark.peers import mujoco_peer
    from benchmark.peers.task import Task

    runner = mujoco_peer.Python if setting.python else mujoco_peer.Compiled
    arguments = Task(), "RK4", setting.mobility, setting.settle, setting.steps
    return runner(*arguments).run


def measure_steps(rounds: int) -> str:
    """Return a line on single steps of a `Simulation`."""
    run = Simulation(HEAVY)
    run.load_code()
    taken = time_in_turn(
        {"step": partial(_ticks, run, 100)}, rounds, clock=time.process_time
    )
    return f"`Simulation.step`, 1 ms: {1e6 * median(taken['step']) / 100:.1f} us."


def _ticks(run: Simulation, count: int) -> None:
    run.reset()
    for _ in range(count):
        run.step((0.1, -0.2, 0.3), TICK_NS)


if __name__ == "__main__":
    sys.exit(main())
