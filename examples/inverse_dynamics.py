# SPDX-License-Identifier: Apache-2.0
"""Inverse dynamics of Example 1
=============================

The torques of a simulated motion are computed back from orientation, angular velocity
and angular acceleration, and compared with those that were applied, 1.13 sin 12t.
"""

import matplotlib.pyplot as plt
import numpy as np

from sst_ros import InverseDynamics, load_scene, simulate

scene = load_scene("example1")
h, times = 1e-4, np.linspace(0.01, 0.51, 101)
motion = simulate(scene, tolerance=1e-12)
before, at, after = (motion.at(times + shift) for shift in (-h, 0.0, h))
acceleration = (after.body_rate - before.body_rate) / (2.0 * h)

inverse = InverseDynamics(scene)
torque = np.array(
    [
        inverse.torque(*state)
        for state in zip(at.quaternion, at.body_rate, acceleration, strict=True)
    ]
)
applied = 1.13 * np.sin(12.0 * times)

figure, (above, below) = plt.subplots(
    2, 1, sharex=True, figsize=(6.5, 5.0), layout="constrained"
)
above.plot(times, applied, linewidth=5, alpha=0.4, label="applied, 1.13 sin 12t")
above.plot(times, torque[:, 0], label="inverse dynamics, τ₁")
above.set(ylabel="torque [N m]")
above.legend(loc="upper right")
below.semilogy(times, np.abs(torque - applied[:, None]).max(axis=1))
below.set(xlabel="time t [s]", ylabel="difference [N m]")
figure.savefig("inverse_dynamics.png")
