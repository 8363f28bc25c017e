# SPDX-License-Identifier: Apache-2.0
"""The reference held against equations that our code did not make.

test/lagrange.py has the mechanism by loop closure and Lagrange's equations alone, with
80 digits. At Gauss's nodes of the reference motion it gives gamma_ddot; two quadratures
give gamma_dot and gamma at the end. If both solve the same equations they agree: a
difference of the accelerations anywhere would show there.
"""

from __future__ import annotations

import runpy
import sys
import time
from typing import NamedTuple

import numpy as np
from numpy.polynomial import legendre

from benchmark.measure import DOCS
from benchmark.peers.task import DURATION, Task
from sst_ros.integration.method_steps import MethodSteps
from sst_ros.integration.methods import DOP853
from sst_ros.integration.point import Drive
from sst_ros.mechanism.geometry import rotation_matrix

NODES = 50
"""The polynomial through as many is the motion to 1e-13 rad, see `floor`."""

STEPS = 400
"""Of DOP853 a second: its error is that of doubles."""


class Agreement(NamedTuple):
    """Differences between the reference and Lagrange's equations.

    Attributes:
        acceleration: largest of gamma_ddot at a node, relative to the largest there.
        rate: of gamma_dot at the end [rad/s].
        angle: of gamma at the end [rad].

    """

    acceleration: float
    rate: float
    angle: float


def check_reference(task: Task, nodes: int = NODES) -> Agreement:
    """Compare the motion of the task with Lagrange's equations."""
    lagrange = runpy.run_path(str(DOCS.parent / "test" / "lagrange.py"))["Lagrange"]
    x, weights = legendre.leggauss(nodes)
    times, weights = DURATION * (x + 1.0) / 2.0, DURATION * weights / 2.0
    machine = MethodSteps(task.system, DOP853)
    worst = 0.0
    rate, angle = np.zeros(3), np.zeros(3)
    for t, weight in zip(times.tolist(), weights.tolist(), strict=True):
        y = state_at(machine, task, t)
        joints = np.array(task.dynamics.joints(*y[:7]))
        truth = lagrange(task.scene, rotation_matrix(np.array(y[:4])))
        torque = np.array(task.torque_at(t))
        exact = truth.acceleration(joints[:3], joints[9:12], torque).astype(float)
        own = task.kernel_answer(y, torque)
        worst = max(worst, float(np.abs(own - exact).max() / np.abs(exact).max()))
        rate += weight * exact
        angle += weight * (DURATION - t) * exact
    first, last = (
        np.array(task.dynamics.joints(*state_at(machine, task, t)[:7]))
        for t in (0.0, DURATION)
    )
    moved = first[:3] + DURATION * first[9:12] + angle
    return Agreement(
        worst,
        float(np.abs(first[9:12] + rate - last[9:12]).max()),
        float(np.abs(moved - last[:3]).max()),
    )


def state_at(machine: MethodSteps, task: Task, t: float) -> list[float]:
    """Return the state at a time."""
    if t == 0.0:
        return list(task.start)
    steps = max(1, round(STEPS * t))
    return machine.fixed(0.0, t / steps, steps, task.start, Drive(()))


def main() -> int:
    """Print the differences."""
    begin = time.process_time()
    agreement = check_reference(Task())
    print(
        f"Lagrange's equations at {NODES} nodes: gamma_ddot differs by"
        f" {agreement.acceleration:.0e} of its size, gamma_dot at the end by"
        f" {agreement.rate:.0e} rad/s, gamma by {agreement.angle:.0e} rad;"
        f" {time.process_time() - begin:.0f} s"
    )
    return 0


if __name__ == "__main__":
    sys.exit(main())
