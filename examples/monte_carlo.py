# SPDX-License-Identifier: Apache-2.0
"""Monte Carlo of a batch: 2000 manipulators with uncertain stars, and how many leave the stroke.

python examples/monte_carlo.py [monte_carlo.png]
"""

import sys

import matplotlib.pyplot as plt
import numpy as np

from sst_ros import Batch, load_scene

scene = load_scene("example2_heavy")
spread = np.random.default_rng(1).normal(1.0, 0.1, 2000)
inertia = {
    f"star.inertia.{ii}": getattr(scene.star.inertia, ii) * spread for ii in ("xx", "yy", "zz")
}
batch = Batch(scene, profile=True, parameters=inertia)
runs = batch.run(scene.initial.gamma, scene.initial.gamma_dot, step=1e-3, count=1000)
left = np.char.startswith(runs.message, "gamma")
print(f"{left.mean():.1%} leave the stroke")
plt.hist([spread[~left], spread[left]], 40, stacked=True, label=["stay", "leave the stroke"])
plt.xlabel("inertia of the star over its nominal value")
plt.legend()
plt.savefig(sys.argv[1] if len(sys.argv) > 1 else "monte_carlo.png")
