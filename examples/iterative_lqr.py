# SPDX-License-Identifier: Apache-2.0
"""Iterative LQR
=============

A swing of the star under gravity from rest to rest: each iteration linearises the
motion once, by its sensitivities, and improves the held torques and their feedback by a
linear-quadratic regulator.
"""

import matplotlib.pyplot as plt
import numpy as np

from sst_ros import TorqueTable, load_scene, simulate

FREE = {"stroke.at_end": "ignore", "workspace.at_edge": "ignore", "torque": None}
scene = load_scene("gravity_payload").with_values(FREE)
GOAL = np.array([1.0, 0.6, 0.9, 0.0, 0.0, 0.0])  # angles [rad], then rates [rad/s]
N, PERIOD, WEIGHT = 20, 0.05, 1e7  # of the error at the end, over that of the torques
TIMES = PERIOD * np.arange(N + 1)
START = ([0.8, 0.8, 0.8], [0.0, 0.0, 0.0])
PARAMETERS = ("initial.gamma", "initial.gamma_dot", "torque")


def linearise(u):
    """Return states x, shape (N + 1, 6), and A, B of dx[k + 1] = A[k] dx[k] + B[k]
    du[k].
    """
    table = TorqueTable(TIMES[:N], u)
    motion = simulate(
        scene,
        table,
        initial=START,
        duration=TIMES[-1],
        t_eval=TIMES,
        sensitivities=PARAMETERS,
    )
    parts = [motion.sensitivities[name] for name in PARAMETERS]
    slopes = [np.hstack([part.gamma, part.gamma_dot]) for part in parts]
    flow = np.concatenate(slopes[:2], axis=2)
    a = flow[1:] @ np.linalg.inv(flow[:-1])
    b = [slopes[2][k + 1][:, 3 * k : 3 * k + 3] for k in range(N)]
    return np.hstack([motion.gamma, motion.gamma_dot]), a, b


def improve(x, a, b, u):
    """Return changes of torques, shape (N, 3), and gains, shape (N, 3, 6), of least
    cost.
    """
    p, steps, gains = WEIGHT * np.eye(6), np.zeros((N, 3)), np.zeros((N, 3, 6))
    slope = p @ (x[N] - GOAL)
    for k in reversed(range(N)):
        cross, inner = b[k].T @ p @ a[k], np.eye(3) + b[k].T @ p @ b[k]
        steps[k] = -np.linalg.solve(inner, u[k] + b[k].T @ slope)
        gains[k] = -np.linalg.solve(inner, cross)
        slope, p = (
            a[k].T @ slope + cross.T @ steps[k],
            a[k].T @ p @ a[k] + cross.T @ gains[k],
        )
    return steps, gains


torques, errors, changes = np.zeros((N, 3)), [], []
figure, axes = plt.subplots(figsize=(6.5, 4.5), layout="constrained")
for iteration in range(6):
    x, a, b = linearise(torques)
    steps, gains = improve(x, a, b, torques)
    held = []

    def control(t, state, x=x, torques=torques + steps, gains=gains, held=held):
        """Correct the torques of a period by the state at its beginning."""
        k = round(t / PERIOD)
        now = np.concatenate([state.joints.gamma, state.joints.gamma_dot])
        held.append(torques[k] + gains[k] @ (now - x[k]))
        return held[-1]

    simulate(scene, control, TIMES[-1], initial=START, control_period=PERIOD)
    errors.append(np.abs(x[N] - GOAL).max())
    changes.append(np.abs(held - torques).max())
    print(
        f"{iteration}: error at the end {errors[-1]:.1e}, largest change"
        f" {changes[-1]:.1e} N m"
    )
    torques = np.array(held)
    axes.plot(
        TIMES, x[:, 0], label=f"iteration {iteration}: {errors[-1]:.0e} rad, rad/s"
    )
axes.plot(TIMES[-1], GOAL[0], "ko", label="goal")
axes.set(xlabel="time t [s]", ylabel="angle of actuator 1, γ [rad]")
axes.grid(alpha=0.3)
axes.legend(fontsize=8, title="largest error at the end")
figure.savefig("iterative_lqr.png")
