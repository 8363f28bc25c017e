# SPDX-License-Identifier: Apache-2.0
"""
Monte Carlo: uncertain inertia
==============================

2000 manipulators with uncertain stars in one batch: how many leave the stroke?
"""

import matplotlib.pyplot as plt
import numpy as np

from sst_ros import Batch, load_scene

scene = load_scene("example2_heavy")
spread = np.random.default_rng(1).normal(1.0, 0.1, 2000)
inertia = {
    f"star.inertia.{ii}": getattr(scene.star.inertia, ii) * spread
    for ii in ("xx", "yy", "zz")
}
batch = Batch(scene, profile=True, parameters=inertia)
runs = batch.run(scene.initial.gamma, scene.initial.gamma_dot, step=1e-3, count=1000)
left = np.char.startswith(runs.message, "gamma")
print(f"{left.mean():.1%} leave the stroke")

figure, axes = plt.subplots(figsize=(6.5, 4.0), layout="constrained")
axes.hist(
    [spread[~left], spread[left]], 40, stacked=True, label=["stay", "leave the stroke"]
)
axes.set(xlabel="inertia of the star / nominal value", ylabel="manipulators")
axes.legend()
figure.savefig("monte_carlo.png")
