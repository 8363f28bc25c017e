# SPDX-License-Identifier: Apache-2.0
"""Model predictive control at 500 Hz
==================================

The scene ``reach`` follows a spiral that asks for more torque than its actuators have.
A controller that plans 0.2 s ahead with these limits is compared with computed torque,
with and without noise.

Every 2 ms CasADi predicts and linearises the motion under the last plan. A quadratic
program in its 30 torques, with the limits as bounds, corrects the plan: one real-time
iteration (Diehl et al., J. Process Control 12 (2002) 577-585). Needs the extra
``casadi``.
"""

import time

import casadi
import matplotlib.pyplot as plt
import numpy as np
from scipy.spatial.transform import Rotation

import sst_ros
from sst_ros import Controller, ControllerSettings, State, equations, load_scene

PERIOD, STAGE, STAGES = 2e-3, 2e-2, 10  # of control and of the plan [s]
# [N m], where 15.2 are asked for; run, motion [s]
LIMIT, DURATION, SPIRAL = 11.0, 1.3, 0.8
# of measurements, standard deviation [rad], [rad/s]
ANGLE_NOISE, RATE_NOISE = 2e-4, 1e-2
ANGLES, RATES, TORQUES = 1e5, 1e2, 1e-2  # weights of squared errors, of squared torques

changes = {"actuators.torque_limit": LIMIT, "motion.spiral.duration": SPIRAL}
scene = load_scene("reach").with_values(changes)
joints = equations(scene, "numpy", outputs=["joints"]).joints
motion = sst_ros.reference_motion(scene)
grid = [motion.at(t) for t in PERIOD * np.arange(round((DURATION + 0.3) / PERIOD))]
goal = np.array([[*at.gamma, *at.gamma_dot] for at in grid])


def predict():
    """Return the function of a state and a plan: joints of each stage, and what changes
    them.
    """
    model = equations(scene, "casadi", outputs=["derivative", "joints"])
    y, torque = casadi.SX.sym("y", 7), casadi.SX.sym("torque", 3)
    slope, total = model.derivative(y, torque), 0.0
    for part, weight in ((0.5, 1.0), (0.5, 2.0), (1.0, 2.0), (0.0, 1.0)):  # RK4
        total = total + STAGE / 6.0 * weight * slope
        slope = model.derivative(y + STAGE * part * slope, torque)
    after = y + total
    actuators = casadi.vertcat(model.joints(y)[:3], model.joints(y)[9:12])
    of_state = casadi.Function(
        "of_state", [y], [actuators, casadi.jacobian(actuators, y)]
    )
    slopes = casadi.jacobian(after, y), casadi.jacobian(after, torque)
    results = [after, *slopes, *of_state(after)]
    return casadi.Function("step", [y, torque], results).mapaccum(STAGES)


class Predictive:
    """A function of time and state that keeps its plan from period to period."""

    def __init__(self):
        self.predict, self.plan, self.seconds = predict(), np.zeros((STAGES, 3)), []
        n = 3 * STAGES
        pattern = {"h": casadi.Sparsity.dense(n, n), "a": casadi.Sparsity(0, n)}
        self.solver = casadi.conic("qp", "daqp", pattern)
        self.weights = np.tile([ANGLES] * 3 + [RATES] * 3, STAGES)

    def __call__(self, t, state):
        """Return the torques of a period [N m]."""
        begin = time.perf_counter()
        found = self.predict([*state.quaternion, *state.body_rate], self.plan.T)
        _, a, b, x, c = (part.full() for part in found)
        effects, change = [], np.zeros((7, 3 * STAGES))
        for k in range(STAGES):
            now, row = slice(3 * k, 3 * k + 3), slice(7 * k, 7 * k + 7)
            change = a[:, row] @ change
            change[:, now] = b[:, now]
            effects.append(c[:, row] @ change)
        effect = np.concatenate(effects)
        ahead = round(t / PERIOD) + round(STAGE / PERIOD) * np.arange(1, STAGES + 1)
        error = x.T.ravel() - goal[ahead].ravel()
        weighted, old = effect.T * self.weights, self.plan.ravel()
        hessian = weighted @ effect + TORQUES * np.eye(3 * STAGES)
        slope = weighted @ error + TORQUES * old
        better = self.solver(h=hessian, g=slope, lbx=-LIMIT - old, ubx=LIMIT - old)["x"]
        self.plan = np.clip(old + better.full().ravel(), -LIMIT, LIMIT).reshape(
            STAGES, 3
        )
        self.seconds.append(time.perf_counter() - begin)
        return self.plan[0]


def measured(state, noise):
    """Return a state as sensors show it; `noise` are six numbers."""
    turn = Rotation.from_quat(state.quaternion) * Rotation.from_rotvec(
        ANGLE_NOISE * noise[:3]
    )
    y = np.concatenate([turn.as_quat(), state.body_rate + RATE_NOISE * noise[3:]])
    return State.of(state.time_ns, y.tolist(), joints(y).tolist(), state.torque)


figure, axes = plt.subplots(2, 1, figsize=(6.5, 6.0), sharex=True, layout="constrained")
errors, seconds = {}, []
settings = ControllerSettings(mode="computed_torque", bandwidth=60.0)
for word, size in (("no noise", 0.0), ("noise", 1.0)):
    laws = {
        "computed torque": Controller(scene, motion, settings, PERIOD),
        "MPC": Predictive(),
    }
    for name, law in laws.items():
        rng = np.random.default_rng(1)

        def control(t, state, law=law, size=size, rng=rng):
            """Control by what sensors show."""
            return law(t, measured(state, size * rng.normal(size=6)))

        run = sst_ros.simulate(scene, control, DURATION, control_period=PERIOD)
        error = np.abs(run.gamma - goal[: len(run.t), :3]).max(axis=1)
        errors[name, word] = error.max()
        axes[0].semilogy(run.t, error, label=f"{name}, {word}: {error.max():.1e} rad")
        if size == 0.0:
            axes[1].plot(run.t, run.torque[:, 0], label=name)
        seconds += getattr(law, "seconds", [])
median, slow = 1e3 * np.percentile(seconds, [50, 99])
print(f"a period takes {median:.2f} ms, 99 % of them less than {slow:.2f} ms")
axes[0].set(ylabel="tracking error, largest of γ [rad]", ylim=(1e-6, 30.0))
axes[1].hlines([-LIMIT, LIMIT], 0.0, DURATION, "k", "dashed", lw=0.5)
axes[1].set(xlabel="time t [s]", ylabel="torque of actuator 1 [N m]")
for axis in axes:
    axis.grid(alpha=0.3)
    axis.legend(fontsize=8, loc="upper right")
figure.savefig("mpc.png")
