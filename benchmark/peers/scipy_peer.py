# SPDX-License-Identifier: Apache-2.0
"""SciPy's solve_ivp on the paper's matrix equations in NumPy, as most would write it first."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from benchmark.peers.study import Failed, Run, Series, Setting
from benchmark.peers.task import DURATION, Moving, Pose, Task
from sst_ros.mechanism import kinematics, virtual_work
from sst_ros.mechanism.frames import rotation_matrix

ENGINE, PACKAGE = "SciPy on the paper's form", "scipy"

Slope = Callable[[float, np.ndarray], np.ndarray]


def series(task: Task, quick: bool) -> list[Series]:
    """Two states: (gamma, gamma_dot) with direct kinematics, and (q, gamma_dot) without."""
    ladder = [10.0**-power for power in ((3, 6, 9) if quick else range(2, 13))]
    paper = _Paper(task)
    forms = (
        ("DOP853, state (γ, γ̇)", paper.joint_slope, paper.joint_start, paper.joint_pose),
        ("DOP853, state (q, γ̇)", paper.quaternion_slope, paper.quaternion_start,
         paper.quaternion_pose),
    )  # fmt: skip
    found = []
    for name, slope, start, pose in forms:
        settings = [_setting(slope, start, pose, tolerance) for tolerance in ladder]
        found.append(Series(ENGINE, name, "everywhere", 1e-12, paper.acceleration, settings))
    return found


class _Paper:
    def __init__(self, task: Task) -> None:
        self.task = task
        self.mechanism = virtual_work.Mechanism.of(task.scene)
        self.joint_start = np.array([*task.gamma, 0.0, 0.0, 0.0])
        self.quaternion_start = np.array([*task.start[:4], 0.0, 0.0, 0.0])

    def joint_slope(self, t: float, x: np.ndarray) -> np.ndarray:
        """Of (gamma, gamma_dot): the admissible assembly is found at every evaluation."""
        at = virtual_work.posture(self.task.geometry, x[:3])
        answer = virtual_work.direct_dynamics(self.mechanism, at, x[3:], self.task.torque_at(t))
        return np.concatenate([x[3:], answer])

    def joint_pose(self, x: np.ndarray) -> Pose:
        return Pose(kinematics.admissible(self.task.geometry, x[:3]).rotation, x[:3])

    def quaternion_slope(self, t: float, y: np.ndarray) -> np.ndarray:
        """Of (q, gamma_dot): gamma follows from R, no root finding."""
        rotation = rotation_matrix(y[:4] / np.linalg.norm(y[:4]))
        gamma = kinematics.inverse(self.task.geometry, rotation)[0]
        at = virtual_work.posture(self.task.geometry, gamma, rotation)
        answer = virtual_work.direct_dynamics(self.mechanism, at, y[4:], self.task.torque_at(t))
        ox, oy, oz = at.j @ y[4:]
        x, y_, z, w = y[:4]
        turned = (
            ox * w + oy * z - oz * y_, oy * w + oz * x - ox * z,
            oz * w + ox * y_ - oy * x, -ox * x - oy * y_ - oz * z,
        )  # fmt: skip
        return np.concatenate([0.5 * np.array(turned), answer])

    def quaternion_pose(self, y: np.ndarray) -> Pose:
        rotation = rotation_matrix(y[:4] / np.linalg.norm(y[:4]))
        return Pose(rotation, kinematics.inverse(self.task.geometry, rotation)[0])

    def acceleration(self, at: Moving) -> np.ndarray:
        """Of the quaternion form; what it is held against is the same equations, so see `gate`."""
        rotation = rotation_matrix(np.array(at.y[:4]))
        gamma = kinematics.inverse(self.task.geometry, rotation)[0]
        rate = np.array([at.velocity[f"g{k}"] for k in range(3)])
        here = np.array([*at.y[:4], *rate])
        both = [self.quaternion_slope(at.time, here)[4:],
                self.joint_slope(at.time, np.array([*gamma, *rate]))[3:]]  # fmt: skip
        kernel = self.task.kernel_answer(at.y, at.torque)
        worst = max(both, key=lambda found: float(np.linalg.norm(found - kernel)))
        # The paper's form is the truth of all others; the kernel checks it.
        return worst - kernel + at.answer


def _setting(
    slope: Slope, start: np.ndarray, pose: Callable[[np.ndarray], Pose], tolerance: float
) -> Setting:
    def prepare() -> Run:
        from scipy.integrate import solve_ivp

        def whole(times: np.ndarray | None = None) -> np.ndarray:
            found = solve_ivp(
                slope, (0.0, DURATION), start, method="DOP853", t_eval=times, rtol=tolerance,
                atol=tolerance,
            )  # fmt: skip
            if not found.success:
                raise Failed(found.message)
            return np.asarray(found.y.T)

        def poses(pieces: int) -> list[Pose]:
            times = DURATION * np.arange(1, pieces + 1) / pieces
            return [pose(y) for y in whole(times)]

        return Run(whole, poses)

    return Setting(f"rtol = atol = {tolerance:.0e}", 0, prepare)
