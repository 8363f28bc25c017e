# SPDX-License-Identifier: Apache-2.0
"""SciPy's solve_ivp on the paper's matrix equations in NumPy, as most would write it
first.
"""

from __future__ import annotations

from functools import partial

import numpy as np

from benchmark.peers.study import Engine, Failed, Series, Setting
from benchmark.peers.task import DURATION, Moving, Pose, Task
from sst_ros.mechanism import kinematics, virtual_work
from sst_ros.mechanism.geometry import rotation_matrix

ENGINE, PACKAGE = "SciPy on the paper's form", "scipy"


def series(task: Task, quick: bool) -> list[Series]:
    """Two states: (gamma, gamma_dot) with direct kinematics, and (q, gamma_dot)
    without.
    """
    ladder = [10.0**-power for power in ((3, 6, 9) if quick else range(2, 13))]

    def acceleration(at: Moving) -> np.ndarray:
        """The worse of both.

        The paper's form is the truth of all others: the kernel checks it.
        """
        kernel, forms = task.kernel_answer(at.y, at.torque), (_Joints, _Quaternion)
        both = [form(task, 1e-3).acceleration(at) - kernel for form in forms]
        return max(both, key=lambda found: float(np.linalg.norm(found))) + at.answer

    return [
        Series(ENGINE, f"DOP853, state {name}", "everywhere", 1e-12, acceleration, [
            Setting(f"rtol = atol = {tolerance:.0e}", 0, partial(form, task, tolerance))
            for tolerance in ladder
        ])
        for name, form in (("(γ, γ̇)", _Joints), ("(q, γ̇)", _Quaternion))
    ]  # fmt: skip


class _Joints(Engine):
    """State (gamma, gamma_dot): each evaluation finds the admissible assembly."""

    def __init__(self, task: Task, tolerance: float) -> None:
        self.task, self.tolerance = task, tolerance
        self.mechanism = virtual_work.Mechanism.of(task.scene)
        self.start = self.state_of(task.start[:4], task.gamma, np.zeros(3))

    def state_of(
        self, quaternion: list[float], gamma: np.ndarray, rate: np.ndarray
    ) -> np.ndarray:
        return np.array([*gamma, *rate])

    def slope(self, t: float, x: np.ndarray) -> np.ndarray:
        at = virtual_work.posture(self.task.geometry, x[:3])
        answer = virtual_work.direct_dynamics(
            self.mechanism, at, x[3:], self.task.torque_at(t)
        )
        return np.concatenate([x[3:], answer])

    def acceleration(self, at: Moving) -> np.ndarray:
        gamma = kinematics.inverse(
            self.task.geometry, rotation_matrix(np.array(at.y[:4]))
        )[0]
        rate = np.array([at.velocity[f"g{k}"] for k in range(3)])
        return self.slope(at.time, self.state_of(at.y[:4], gamma, rate))[-3:]

    def run(self) -> np.ndarray:
        from scipy.integrate import solve_ivp

        span, tolerance = (0.0, DURATION), self.tolerance
        found = solve_ivp(
            self.slope, span, self.start, "DOP853", rtol=tolerance, atol=tolerance
        )
        if not found.success:
            raise Failed(found.message)
        return np.asarray(found.y[:, -1])

    def pose(self, end: np.ndarray) -> Pose:
        return Pose(
            kinematics.admissible(self.task.geometry, end[:3]).rotation, end[:3]
        )


class _Quaternion(_Joints):
    """State (q, gamma_dot): gamma follows from R, no root finding."""

    def state_of(
        self, quaternion: list[float], gamma: np.ndarray, rate: np.ndarray
    ) -> np.ndarray:
        return np.array([*quaternion, *rate])

    def slope(self, t: float, x: np.ndarray) -> np.ndarray:
        pose = self.pose(x)
        at = virtual_work.posture(self.task.geometry, pose.gamma, pose.rotation)
        answer = virtual_work.direct_dynamics(
            self.mechanism, at, x[4:], self.task.torque_at(t)
        )
        ox, oy, oz = at.j @ x[4:]
        qx, qy, qz, qw = x[:4]
        turned = (
            ox * qw + oy * qz - oz * qy, oy * qw + oz * qx - ox * qz,
            oz * qw + ox * qy - oy * qx, -ox * qx - oy * qy - oz * qz,
        )  # fmt: skip
        return np.concatenate([0.5 * np.array(turned), answer])

    def pose(self, end: np.ndarray) -> Pose:
        rotation = rotation_matrix(end[:4] / np.linalg.norm(end[:4]))
        return Pose(rotation, kinematics.inverse(self.task.geometry, rotation)[0])
