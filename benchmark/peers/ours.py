# SPDX-License-Identifier: Apache-2.0
"""sst_ros: the public call, and fixed steps of each method, compiled and plain Python."""

from __future__ import annotations

from functools import partial

import numpy as np

from benchmark.peers.study import Engine, Series, Setting, list_steps
from benchmark.peers.task import DURATION, Moving, Pose, Task
from sst_ros import Trajectory, prepare
from sst_ros.integration.compiled_method import CompiledMethod
from sst_ros.integration.methods import DOP853, DORMAND_PRINCE, RK4
from sst_ros.simulation.simulate_gauss import Collocation, PreparedMotion

ENGINE, PACKAGE = "sst_ros", "numba"
PUBLIC = "prepare().run()"
"""Name of the series of the public call, from which all ratios to other engines are."""

# Ladders end where rounding begins: below 2e-14 rad the doubles of the reference are seen.
METHODS = {
    "DOP853": (DOP853, 5, 80),
    "Dormand-Prince 5": (DORMAND_PRINCE, 6, 500),
    "RK4": (RK4, 6, 3000),
}


def series(task: Task, quick: bool) -> list[Series]:
    """`simulate` itself, the methods inside of it under numba, and DOP853 without."""

    def acceleration(at: Moving) -> np.ndarray:
        return task.kernel_answer(at.y, at.torque)

    def add(name: str, settings: list[Setting], python: str = "nowhere") -> None:
        found.append(Series(ENGINE, name, python, 1e-12, acceleration, settings))

    found: list[Series] = []
    public = [
        Setting(f"tolerance {tolerance:.1e} rad", 0, partial(_Public, task, tolerance))
        for tolerance in (10.0 ** -np.arange(3.0, 13.1, 0.5)).tolist()
    ]
    add(f"{PUBLIC}, Gauss collocation of order 16, numba", public)
    for name, (tableau, first, last) in METHODS.items():
        machine = CompiledMethod(task.system, tableau, compiled=True)
        ladder = (first, last, 1.6 if quick else 1.15)
        add(f"{name}, numba", list_steps(*ladder, partial(_Steps, task, machine)))
    for nodes in (8, 12):
        method = Collocation(task.system, nodes)
        few = [
            Setting(f"{n} steps of {m} iterations", n * m, partial(_Few, task, method, n, m))
            for n in range(2, 13)
            for m in range(1, 9)
        ]
        add(f"Gauss collocation, order {2 * nodes}, numba", few)
    plain = partial(_Steps, task, CompiledMethod(task.system, DOP853, compiled=False))
    ladder = (5, 80, 2.0 if quick else 1.3)
    add("DOP853, plain Python", list_steps(*ladder, plain), "everywhere")
    return found


class _Public(Engine):
    """What a user calls again and again, with a `Trajectory` returned.

    The motion is prepared before, as other engines have their data laid out.
    """

    def __init__(self, task: Task, tolerance: float) -> None:
        prepared = prepare(task.scene, duration=DURATION, method="gauss", tolerance=tolerance)
        self._task, self.run = task, prepared.run
        self.run()

    def pose(self, end: Trajectory) -> Pose:
        return self._task.pose_of([*end.quaternion[-1], *end.body_rate[-1]])


class _Few(Engine):
    """Few long steps of collocation; how often each is iterated is part of the setting.

    Numbers are laid out before, as MuJoCo's and Pinocchio's data are; `run` is the whole second,
    from the start, torques at all nodes included, in one call from Python.
    """

    def __init__(self, task: Task, method: Collocation, steps: int, iterations: int) -> None:
        h = DURATION / steps
        self._motion = PreparedMotion(method, steps, iterations)
        self._motion.begin(0.0, h, task.start)
        self._task, self.run = task, self._motion.run

    def pose(self, end: object) -> Pose:
        return self._task.pose_of(self._motion.states[-1].tolist())


class _Steps(Engine):
    """Fixed steps of a method."""

    def __init__(self, task: Task, machine: CompiledMethod, steps: int) -> None:
        self._task, self._machine, self._steps = task, machine, steps

    def run(self) -> list[float]:
        return self._machine.step_fixed(
            0.0, DURATION / self._steps, self._steps, self._task.start, []
        )

    def pose(self, end: list[float]) -> Pose:
        return self._task.pose_of(end)
