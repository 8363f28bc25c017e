# SPDX-License-Identifier: Apache-2.0
"""Elastic stops at the ends of the stroke
=========================================

The actuators of the scene ``impacts`` bounce off stiff stops with Hunt-Crossley
damping.
"""

import matplotlib.pyplot as plt
import numpy as np

from sst_ros import Geometry, load_scene, simulate

scene = load_scene("impacts")
motion = simulate(
    scene, duration=2.2, t_eval=np.linspace(0.0, 2.2, 441), tolerance=1e-6
)
ends = np.degrees(Geometry.of(scene).arc)
print(motion.message, motion.method)

figure, axes = plt.subplots(3, 1, sharex=True, figsize=(6.5, 6.0), layout="constrained")
for k in range(3):
    axes[k].plot(motion.t, np.degrees(motion.gamma[:, k]))
    axes[k].axhline(0.0, color="k", linestyle=":")
    axes[k].axhline(ends[k], color="k", linestyle=":")
    axes[k].set_ylabel(f"γ{'₁₂₃'[k]} [deg]")
axes[2].set_xlabel("time t [s]")
axes[0].set_title("Ends of the stroke dotted")
figure.savefig("elastic_stops.png")
