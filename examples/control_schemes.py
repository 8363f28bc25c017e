# SPDX-License-Identifier: Apache-2.0
"""Computed torque, PD and feedforward compared
============================================

Path tracking of the scene ``reach`` by five control schemes whose model has a star 10 %
too heavy.
"""

import matplotlib.pyplot as plt
import numpy as np

from sst_ros import (
    Controller,
    ControllerSettings,
    load_scene,
    reference_motion,
    simulate,
)

scene = load_scene("reach")
model = scene.with_values(
    {
        f"star.inertia.{ii}": 1.1 * getattr(scene.star.inertia, ii)
        for ii in ("xx", "yy", "zz")
    }
)
motion = reference_motion(scene)
period = 4e-3

figure, axes = plt.subplots(figsize=(6.5, 4.5), layout="constrained")
for mode in ("pd", "gravity_pd", "feedforward", "feedforward_pd", "computed_torque"):
    settings = ControllerSettings(mode=mode, bandwidth=60.0)
    run = simulate(
        scene, Controller(model, motion, settings, period), control_period=period
    )
    desired = np.array([motion.at(t).gamma for t in run.t])
    error = np.abs(run.gamma - desired).max(axis=1)
    axes.semilogy(run.t[1:], error[1:], label=f"{mode}: {error.max():.1e} rad")
axes.set(
    xlabel="time t [s]", ylabel="tracking error, largest of γ [rad]", ylim=(1e-7, 1.0)
)
axes.grid(alpha=0.3)
axes.legend(fontsize=8, title="largest error", loc="lower right")
figure.savefig("control_schemes.png")
