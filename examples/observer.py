# SPDX-License-Identifier: Apache-2.0
"""Rates from encoders by an extended Kalman filter
================================================

Encoders measure the three actuator angles at 500 Hz. The filter estimates angles and
rates of the scene ``gravity_payload``, under torques with a disturbance that it knows
by its variance alone. It predicts by a step of ``Simulation`` from its estimate, and
its covariance by the discrete pair (A, B) of ``linearize``.

The normalised estimation error squared (NEES) shows whether the covariance that a
filter states is that of its errors: 95 % of the averages over the runs then lie between
the dashed lines (Bar-Shalom, Li & Kirubarajan, Estimation with Applications to Tracking
and Navigation, Wiley 2001, section 5.4).
"""

import matplotlib.pyplot as plt
import numpy as np
from scipy.stats import chi2

from sst_ros import Simulation, equilibrium, linearize, load_scene

PERIOD, STEPS, RUNS = 2e-3, 100, 20
# standard deviations: of an angle [rad], of a held torque [N m]
ENCODER, DISTURBANCE = 2e-4, 0.3
FIRST = np.diag([ENCODER**2] * 3 + [0.05**2] * 3)  # covariance of the first estimate

scene = load_scene("gravity_payload")
rest = equilibrium(scene, [0.8, 0.7, 0.8])
START = np.array([*rest.joints.gamma, 0.4, -0.3, 0.2])
MEASURED, NOISE = np.eye(3, 6), ENCODER**2 * np.eye(3)
rng = np.random.default_rng(5)


def begin(x):
    """Return a simulation that begins with the angles and rates x, shape (6,)."""
    return Simulation(
        scene.with_values({"initial": {"gamma": x[:3], "gamma_dot": x[3:]}})
    )


def coordinates(state):
    """Return angles and rates of the actuators, shape (6,)."""
    return np.concatenate([state.joints.gamma, state.joints.gamma_dot])


def run():
    """Return errors of the estimate, shape (STEPS, 6), standard deviations of it, and
    the NEES.
    """
    plant, p = begin(START), FIRST
    x = rng.multivariate_normal(START, FIRST)
    errors, deviations, nees = [], [], []
    for _ in range(STEPS):
        torque = rest.torque + DISTURBANCE * rng.normal(size=3)
        truth = coordinates(plant.step(torque, round(1e9 * PERIOD)))
        model = linearize(scene, (x[:3], x[3:]), rest.torque, dt=PERIOD)
        x = coordinates(begin(x).step(rest.torque, round(1e9 * PERIOD)))
        p = model.A @ p @ model.A.T + DISTURBANCE**2 * model.B @ model.B.T
        gain = np.linalg.solve(MEASURED @ p @ MEASURED.T + NOISE, MEASURED @ p).T
        x = x + gain @ (truth[:3] + ENCODER * rng.normal(size=3) - x[:3])
        p = p - gain @ MEASURED @ p
        errors.append(x - truth)
        deviations.append(np.sqrt(np.diag(p)))
        nees.append(errors[-1] @ np.linalg.solve(p, errors[-1]))
    return np.array(errors), np.array(deviations), np.array(nees)


runs = [run() for _ in range(RUNS)]
average = np.mean([nees for *_, nees in runs], axis=0)
low, high = chi2.ppf([0.025, 0.975], 6 * RUNS) / RUNS
inside = np.mean((average > low) & (average < high))
print(f"{100 * inside:.0f} % of the averages are between the lines")

figure, axes = plt.subplots(2, 1, figsize=(6.5, 5.5), sharex=True, layout="constrained")
t = PERIOD * np.arange(1, STEPS + 1)
for errors, *_ in runs:
    axes[0].plot(t, errors[:, 3], color="tab:blue", lw=0.5)
_, deviations, _ = runs[0]
axes[0].plot(
    t, 2.0 * deviations[:, 3], "k--", t, -2.0 * deviations[:, 3], "k--", lw=1.0
)
axes[0].set(
    ylabel="error of the rate 1 [rad/s]", ylim=(-0.1, 0.1), title="±2 stated deviations"
)
axes[1].plot(t, average, label=f"average of {RUNS} runs, {100 * inside:.0f} % inside")
axes[1].hlines([low, high], 0.0, t[-1], "k", "dashed", lw=1.0)
axes[1].set(xlabel="time t [s]", ylabel="NEES of 6 numbers", ylim=(0.0, 12.0))
axes[1].legend(fontsize=8)
for axis in axes:
    axis.grid(alpha=0.3)
figure.savefig("observer.png")
