# SPDX-License-Identifier: Apache-2.0
"""
Parameter identification from encoders and torques
==================================================

Inertia and friction of the scene ``reach`` from encoder counts and noisy torques. The
bars are 95 % intervals; the model to start from is wrong in two numbers.
"""

import matplotlib.pyplot as plt
import numpy as np

from sst_ros import InverseDynamics, identify, load_scene, reference_motion

CUTOFF = 10.0  # Hz; the default, 42 Hz here, would bias zz, which hardly moves
COUNT, NOISE = 2.0 * np.pi / 65536, 0.02  # rad, N m
NAMES = (
    "star.inertia.xx",
    "star.inertia.yy",
    "star.inertia.zz",
    "friction.gamma.viscous",
)

plant = load_scene("reach")
motion, model = reference_motion(plant), InverseDynamics(plant)
t = np.arange(0.0, 1.2, 1e-3)
references = [motion.at(time) for time in t.tolist()]
gamma = COUNT * np.round(np.array([one.gamma for one in references]) / COUNT)
torque = np.array([model.reference_torque(one) for one in references])
torque += np.random.default_rng(1).normal(0.0, NOISE, torque.shape)

guess = plant.with_values({"star.inertia.zz": 0.25, "friction.gamma.viscous": 0.1})
data = {"t": t, "gamma": gamma, "torque": torque}
found = identify(data, guess, parameters=["star", "friction"], cutoff=CUTOFF)
print(found.table())

rows = [list(found.labels).index(name) for name in NAMES]
inertia = plant.star.inertia
true = np.array([inertia.xx, inertia.yy, inertia.zz, plant.friction.gamma.viscous])
given = np.array([0.312, 0.312, 0.25, 0.1])
figure, axes = plt.subplots(figsize=(6.5, 3.6), layout="constrained")
estimate, interval = (
    np.array(x)[rows] / true for x in (found.estimate, 1.96 * found.deviation)
)
axes.errorbar(
    estimate, range(4), xerr=interval, fmt="o", capsize=4, label="identified, 95 %"
)
axes.plot(given / true, range(4), "x", label="model to start from")
axes.axvline(1.0, color="k", linestyle=":")
axes.set_yticks(range(4), NAMES)
axes.set_xlabel("value / true value")
axes.legend()
figure.savefig("identification.png")
