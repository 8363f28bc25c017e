# SPDX-License-Identifier: Apache-2.0
"""Model predictive control at 500 Hz
==================================

The scene ``reach`` follows a spiral that asks for more torque than its actuators have:
by a plan 0.2 s ahead with these limits, and by computed torque, with and without noise.

Every 2 ms a quadratic program corrects the last plan, 30 torques within the limits, by
CasADi's linearisation: a real-time iteration (Diehl et al., J. Process Control, 2002).
"""

import time

import casadi as ca
import matplotlib.pyplot as plt
import numpy as np
from scipy.spatial.transform import Rotation

import sst_ros
from sst_ros import Controller, State, equations, load_scene

PERIOD, STAGE, STAGES = 2e-3, 2e-2, 10  # of control and of the plan [s]
LIMIT = 11.0  # of the torques, where 15.2 are asked for [N m]
DURATION, SPIRAL = 1.3, 0.8  # of the run and of the motion [s]
ANGLE_NOISE, RATE_NOISE = 2e-4, 1e-2  # standard deviations [rad], [rad/s]
ANGLES, RATES, TORQUES = 1e5, 1e2, 1e-2  # weights of squared errors and torques

changes = {"actuators.torque_limit": LIMIT, "motion.spiral.duration": SPIRAL}
scene = load_scene("reach").with_values(changes)
joints = equations(scene, "numpy", outputs=["joints"]).joints
motion = sst_ros.reference_motion(scene)
grid = [motion.at(t) for t in PERIOD * np.arange(round((DURATION + 0.3) / PERIOD))]
goal = np.array([[*at.gamma, *at.gamma_dot] for at in grid])


def predict():
    """Return a function of state and plan: joints of each stage, and derivatives."""
    model = equations(scene, "casadi", outputs=["derivative", "joints"])
    y, torque = ca.SX.sym("y", 7), ca.SX.sym("torque", 3)
    slope, total = model.derivative(y, torque), 0.0
    for part, weight in ((0.5, 1.0), (0.5, 2.0), (1.0, 2.0), (0.0, 1.0)):  # RK4
        total = total + STAGE / 6.0 * weight * slope
        slope = model.derivative(y + STAGE * part * slope, torque)
    after = y + total
    actuators = ca.vertcat(model.joints(y)[:3], model.joints(y)[9:12])
    observe = ca.Function("observe", [y], [actuators, ca.jacobian(actuators, y)])
    slopes = ca.jacobian(after, y), ca.jacobian(after, torque)
    results = [after, *slopes, *observe(after)]
    return ca.Function("step", [y, torque], results).mapaccum(STAGES)


class Predictive:
    """A function of time and state that keeps its plan from period to period."""

    def __init__(self):
        self.predict, self.plan, self.seconds = predict(), np.zeros((STAGES, 3)), []
        n = 3 * STAGES
        pattern = {"h": ca.Sparsity.dense(n, n), "a": ca.Sparsity(0, n)}
        self.solver = ca.conic("qp", "daqp", pattern)
        self.weights = np.tile([ANGLES] * 3 + [RATES] * 3, STAGES)

    def __call__(self, t, state):
        """Return the torques of a period [N m]."""
        begin = time.thread_time()
        results = self.predict([*state.quaternion, *state.body_rate], self.plan.T)
        _, a, b, x, c = (result.full() for result in results)
        effects, change = [], np.zeros((7, 3 * STAGES))
        for k in range(STAGES):
            torques, states = slice(3 * k, 3 * k + 3), slice(7 * k, 7 * k + 7)
            change = a[:, states] @ change
            change[:, torques] = b[:, torques]
            effects.append(c[:, states] @ change)
        effect = np.concatenate(effects)
        ahead = round(t / PERIOD) + round(STAGE / PERIOD) * np.arange(1, STAGES + 1)
        error = x.T.ravel() - goal[ahead].ravel()
        old, weighted = self.plan.ravel(), effect.T * self.weights
        hessian = weighted @ effect + TORQUES * np.eye(len(old))
        slope = weighted @ error + TORQUES * old
        bounds = {"lbx": -LIMIT - old, "ubx": LIMIT - old}
        correction = self.solver(h=hessian, g=slope, **bounds)["x"].full().ravel()
        self.plan = np.clip(old + correction, -LIMIT, LIMIT).reshape(STAGES, 3)
        self.seconds.append(time.thread_time() - begin)
        return self.plan[0]


def measured(state, noise):
    """Return a state as sensors show it; `noise` are six numbers."""
    error = Rotation.from_rotvec(ANGLE_NOISE * noise[:3])
    turn = Rotation.from_quat(state.quaternion) * error
    y = np.concatenate([turn.as_quat(), state.body_rate + RATE_NOISE * noise[3:]])
    return State.of(state.time_ns, y.tolist(), joints(y).tolist(), state.torque)


figure, axes = plt.subplots(2, 1, figsize=(6.5, 6.0), sharex=True, layout="constrained")
seconds = []
errors = {}
settings = sst_ros.ControllerSettings(mode="computed_torque", bandwidth=60.0)
for word, size in (("no noise", 0.0), ("noise", 1.0)):
    predictive, computed = Predictive(), Controller(scene, motion, settings, PERIOD)
    for name, law in (("computed torque", computed), ("MPC", predictive)):
        rng = np.random.default_rng(1)

        def control(t, state, law=law, size=size, rng=rng):
            """Control by what sensors show."""
            return law(t, measured(state, size * rng.normal(size=6)))

        run = sst_ros.simulate(scene, control, DURATION, control_period=PERIOD)
        error = np.abs(run.gamma - goal[: len(run.t), :3]).max(axis=1)
        errors[name, word] = error.max()
        axes[0].semilogy(run.t, error, label=f"{name}, {word}: {error.max():.1e} rad")
        axes[1].plot(run.t, run.torque[:, 0], lw=0.8, label=f"{name}, {word}")
    seconds += predictive.seconds
median, slow = 1e3 * np.percentile(seconds, [50, 99])
print(f"a period takes {median:.2f} ms, 99 % of them less than {slow:.2f} ms")
axes[0].set(ylabel="tracking error, largest of γ [rad]", ylim=(1e-6, 30.0))
axes[1].hlines([-LIMIT, LIMIT], 0.0, DURATION, "k", "dashed", lw=0.5)
axes[1].set(xlabel="time t [s]", ylabel="torque of actuator 1 [N m]")
for axis in axes:
    axis.legend(fontsize=8, loc="upper right")
figure.savefig("mpc.png")
