# SPDX-License-Identifier: Apache-2.0
"""Least effort from rest to rest, with exact gradients
====================================================

SciPy chooses 15 held torques that turn the star to given actuator angles with the least
effort. The derivatives of its end by the torques come from the variational equations,
in place of differences.
"""

import matplotlib.pyplot as plt
import numpy as np
from scipy.optimize import minimize

from sst_ros import TorqueTable, load_scene, simulate

FREE = {"stroke.at_end": "ignore", "workspace.at_edge": "ignore", "torque": None}
scene = load_scene("example2_heavy").with_values(FREE)
# rad, rad, s
START, GOAL, END = np.array([0.8, 0.8, 0.8]), np.array([1.0, 0.6, 0.9]), 1.0
TIMES = np.linspace(0.0, END, 5, endpoint=False)
calls = 0  # of simulate


def move(x, sensitivities=()):
    """Motion under the torques x, each row held until the next time."""
    global calls
    calls += 1
    table = TorqueTable(TIMES, x.reshape(-1, 3))
    start = (START, np.zeros(3))
    return simulate(
        scene, table, END, initial=start, t_eval=[END], sensitivities=sensitivities
    )


def miss(x):
    """Distance of angles and rates from the goal at the end."""
    end = move(x)
    return np.append(end.gamma[0] - GOAL, end.gamma_dot[0])


def slope(x):
    """Differentiate `miss` by the torques: shape (6, 15)."""
    end = move(x, ["torque"]).sensitivities["torque"]
    return np.vstack([end.gamma[0], end.gamma_dot[0]])


def effort(x):
    """Mean square of the torques, and its gradient."""
    return x @ x / x.size, 2.0 * x / x.size


found, motions, errors = {}, {}, {}
for name, exact in (("differences", {}), ("exact derivatives", {"jac": slope})):
    calls, goal = 0, {"type": "eq", "fun": miss} | exact
    found[name] = minimize(
        effort, np.zeros(15), jac=True, method="SLSQP", constraints=[goal], tol=1e-10
    )
    motions[name], errors[name] = calls, np.abs(miss(found[name].x)).max()
    print(
        f"{name}: {calls} motions, largest error at the end {errors[name]:.1e} rad,"
        " rad/s"
    )

table = TorqueTable(TIMES, found["exact derivatives"].x.reshape(-1, 3))
motion = simulate(scene, table, END, initial=(START, np.zeros(3)))
figure, (above, below) = plt.subplots(
    2, 1, sharex=True, figsize=(6.5, 5.0), layout="constrained"
)
for k in range(3):
    (line,) = above.plot(motion.t, motion.gamma[:, k], label=f"leg {k + 1}")
    above.plot(END, GOAL[k], "o", color=line.get_color())
    below.step(motion.t, table.values(motion.t)[:, k], where="post")
above.set(ylabel="angle γ [rad]", title="least effort from rest to rest")
above.legend()
below.set(xlabel="time t [s]", ylabel="torque τ [N m]")
for axes in (above, below):
    axes.grid(alpha=0.3)
figure.savefig("minimum_effort.png")
