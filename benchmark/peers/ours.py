# SPDX-License-Identifier: Apache-2.0
"""sst_ros: the public call, and fixed steps of each method, compiled and plain Python."""

from __future__ import annotations

import numpy as np

from benchmark.peers.study import Run, Series, Setting, make_ladder
from benchmark.peers.task import DURATION, Moving, Pose, Task
from sst_ros import prepare
from sst_ros.integration.compiled_method import CompiledMethod
from sst_ros.integration.gauss import Collocation
from sst_ros.integration.methods import DOP853, DORMAND_PRINCE, RK4, Tableau

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
    factor = 1.6 if quick else 1.15
    found = [_public(task)]
    for name, (tableau, first, last) in METHODS.items():
        found.append(
            _series(task, f"{name}, numba", tableau, True, make_ladder(first, last, factor))
        )
    found += [_collocation(task, nodes) for nodes in (8, 12)]
    plain = make_ladder(5, 80, 2.0 if quick else 1.3)
    return [*found, _series(task, "DOP853, plain Python", DOP853, False, plain)]


def _public(task: Task) -> Series:
    """What a user calls again and again, with a `Trajectory` returned.

    The motion is prepared before, as other engines have their data laid out.
    """

    def acceleration(at: Moving) -> np.ndarray:
        return task.kernel_answer(at.y, at.torque)

    def setting(tolerance: float) -> Setting:
        def setup() -> Run:
            run = prepare(task.scene, duration=DURATION, method="gauss", tolerance=tolerance).run

            def poses(pieces: int) -> list[Pose]:
                motion = run()
                return [task.pose_of([*motion.quaternion[-1], *motion.body_rate[-1]])]

            run()
            return Run(run, poses)

        return Setting(f"tolerance {tolerance:.1e} rad", 0, setup, samples=False)

    settings = [setting(10.0**-power) for power in np.arange(3.0, 13.1, 0.5)]
    name = f"{PUBLIC}, Gauss collocation of order 16, numba"
    return Series(ENGINE, name, "nowhere", 1e-12, acceleration, settings)


def _collocation(task: Task, nodes: int) -> Series:
    """Few long steps; how often each is iterated is part of the setting.

    Numbers are laid out before, as MuJoCo's and Pinocchio's data are; `run` is the whole second,
    from the start, torques at all nodes included, in one call from Python.
    """
    method = Collocation(task.system, nodes)

    def acceleration(at: Moving) -> np.ndarray:
        return task.kernel_answer(at.y, at.torque)

    def setting(steps: int, iterations: int) -> Setting:
        def prepare() -> Run:
            motion = method.prepare(0.0, DURATION / steps, steps, task.start, iterations=iterations)

            def poses(pieces: int) -> list[Pose]:
                motion.run()
                return [task.pose_of(motion.end)]

            return Run(motion.run, poses)

        label = f"{steps} steps of {iterations} iterations"
        return Setting(label, steps * iterations, prepare, samples=False)

    settings = [setting(n, m) for n in range(2, 13) for m in range(1, 9)]
    name = f"Gauss collocation, order {2 * nodes}, numba"
    return Series(ENGINE, name, "nowhere", 1e-12, acceleration, settings)


def _series(task: Task, name: str, tableau: Tableau, compiled: bool, counts: list[int]) -> Series:
    machine = CompiledMethod(task.system, tableau, compiled=compiled)

    def acceleration(at: Moving) -> np.ndarray:
        return task.kernel_answer(at.y, at.torque)

    def setting(steps: int) -> Setting:
        def whole() -> list[float]:
            return machine.step_fixed(0.0, DURATION / steps, steps, task.start, [])

        def poses(pieces: int) -> list[Pose]:
            y, found = task.start, []
            for piece in range(pieces):
                y = machine.step_fixed(
                    piece * DURATION / pieces, DURATION / steps, steps // pieces, y, []
                )
                found.append(task.pose_of(y))
            return found

        return Setting(f"{steps} steps", steps, lambda: Run(whole, poses))

    where = "nowhere" if compiled else "everywhere"
    return Series(ENGINE, name, where, 1e-12, acceleration, [setting(n) for n in counts])
