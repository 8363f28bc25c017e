# SPDX-License-Identifier: Apache-2.0
"""Friction: phase portrait with and without
=========================================

The same torques act on Example 2 with and without viscous, Coulomb and Stribeck
friction.
"""

import matplotlib.pyplot as plt
import numpy as np

from sst_ros import load_scene, simulate

rough = load_scene("friction")
times = np.linspace(0.0, 1.0, 501)
motions = {
    "no friction": simulate("example2", t_eval=times),
    "friction": simulate(rough, t_eval=times, tolerance=1e-6),
}

figure, axes = plt.subplots(1, 3, figsize=(9.0, 3.4), layout="constrained")
for (name, motion), style in zip(motions.items(), ("-", "--"), strict=True):
    for k in range(3):
        axes[k].plot(
            np.degrees(motion.gamma[:, k]), motion.gamma_dot[:, k], style, label=name
        )
        axes[k].set_xlabel(f"γ{'₁₂₃'[k]} [deg]")
axes[0].set_ylabel("rate [rad/s]")
axes[0].legend(fontsize=8)
figure.savefig("friction.png")
