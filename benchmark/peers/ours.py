# SPDX-License-Identifier: Apache-2.0
"""sst_ros: the public call with its samples, fixed steps of each method, and plain
Python.
"""

from __future__ import annotations

from functools import partial

import numpy as np

from benchmark.peers.study import Engine, Series, Setting, list_steps
from benchmark.peers.task import DURATION, Moving, Pose, Task
from benchmark.plain_python import without_llvmlite
from sst_ros import Trajectory, simulate
from sst_ros.integration.method_steps import MethodSteps
from sst_ros.integration.methods import DOP853, DORMAND_PRINCE, RK4
from sst_ros.integration.point import Drive

ENGINE, PACKAGE = "sst_ros", "llvmlite"
PUBLIC = "simulate()"
"""Name of the series of the public call, from which all ratios to other engines are."""

# Ladders end where rounding begins: below 2e-14 rad the doubles of the reference are
# seen.
METHODS = {
    "DOP853": (DOP853, 5, 80),
    "Dormand-Prince 5": (DORMAND_PRINCE, 6, 500),
    "RK4": (RK4, 6, 3000),
}


def series(task: Task, quick: bool) -> list[Series]:
    """`simulate` itself, the methods inside of it, and DOP853 in plain Python."""

    def acceleration(at: Moving) -> np.ndarray:
        return task.kernel_answer(at.y, at.torque)

    def add(name: str, settings: list[Setting], python: str = "nowhere") -> None:
        found.append(Series(ENGINE, name, python, 1e-12, acceleration, settings))

    found: list[Series] = []
    public = [
        Setting(f"tolerance {tolerance:.1e} rad", 0, partial(_Public, task, tolerance))
        for tolerance in (10.0 ** -np.arange(3.0, 13.1, 0.5)).tolist()
    ]
    add(f"{PUBLIC} with 200 samples", public)
    for name, (tableau, first, last) in METHODS.items():
        machine = MethodSteps(task.system, tableau)
        machine.load()
        ladder = (first, last, 1.6 if quick else 1.15)
        add(name, list_steps(*ladder, partial(_Steps, task, machine)))
    machine = MethodSteps(task.system, DOP853)
    with without_llvmlite():
        machine.load()
    plain = partial(_Steps, task, machine)
    ladder = (5, 80, 2.0 if quick else 1.3)
    add("DOP853, plain Python", list_steps(*ladder, plain), "everywhere")
    return found


class _Public(Engine):
    """What a user calls: a `Trajectory` with its samples is returned."""

    def __init__(self, task: Task, tolerance: float) -> None:
        self._task = task
        self.run = partial(simulate, task.scene, duration=DURATION, tolerance=tolerance)
        self.run()

    def pose(self, end: Trajectory) -> Pose:
        return self._task.pose_of([*end.quaternion[-1], *end.body_rate[-1]])


class _Steps(Engine):
    """Fixed steps of a method."""

    def __init__(self, task: Task, machine: MethodSteps, steps: int) -> None:
        self._task, self._machine, self._steps = task, machine, steps

    def run(self) -> list[float]:
        return self._machine.fixed(
            0.0, DURATION / self._steps, self._steps, self._task.start, Drive(())
        )

    def pose(self, end: list[float]) -> Pose:
        return self._task.pose_of(end)
