# SPDX-License-Identifier: Apache-2.0
"""Monte Carlo over time: a band of uncertainty
============================================

500 initial states of one scene: median, 5th and 95th percentile of an actuator angle
over time.
"""

import matplotlib.pyplot as plt
import numpy as np

from sst_ros import Batch, load_scene

scene = load_scene("swing")
random = np.random.default_rng(2)
start = np.array(scene.initial.gamma) + random.normal(0.0, 0.02, (500, 3))
runs = Batch(scene).run(
    start,
    scene.initial.gamma_dot,
    torque=(0.0, 0.0, 0.0),
    step=2e-3,
    count=1000,
    keep_every=10,
)
time, angle = runs.kept.t[:, 0], np.degrees(runs.kept.gamma[:, :, 0])
low, median, high = np.percentile(angle, [5, 50, 95], axis=1)

figure, axes = plt.subplots(figsize=(6.5, 4.0), layout="constrained")
axes.fill_between(time, low, high, alpha=0.3, label="5 to 95 %")
axes.plot(time, median, label="median")
axes.set(
    xlabel="time t [s]",
    ylabel="γ₁ [deg]",
    title="swing: σ = 0.02 rad in each initial angle",
)
axes.legend(loc="upper right")
figure.savefig("uncertainty_band.png")
