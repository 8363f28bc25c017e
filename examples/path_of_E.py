# SPDX-License-Identifier: Apache-2.0
"""Path of E on the sphere
=======================

The scene ``spiral`` is tracked by a computed-torque controller; the path of E is drawn
on the base triangle.
"""

import matplotlib.pyplot as plt
import numpy as np

from sst_ros import (
    Controller,
    ControllerSettings,
    Geometry,
    load_scene,
    reference_motion,
    simulate,
)
from sst_ros.mechanism.geometry import rotation_matrix

scene = load_scene("spiral")
geometry, reference = Geometry.of(scene), reference_motion(scene)
settings = ControllerSettings(mode="computed_torque", bandwidth=60.0)
motion = simulate(
    scene, Controller(scene, reference, settings, 5e-3), control_period=5e-3
)
E = np.array([rotation_matrix(q)[:, 2] for q in motion.quaternion])

figure = plt.figure(figsize=(6.0, 5.5), layout="constrained")
axes = figure.add_subplot(projection="3d")
x = np.linspace(0.0, 1.0, 40)[:, None]
for k in range(3):
    side = (1.0 - x) * geometry.v[k] + x * geometry.v[(k + 1) % 3]
    axes.plot(*(side / np.linalg.norm(side, axis=1, keepdims=True)).T, color="k")
    axes.text(*(1.08 * geometry.v[k]), f"P{k + 1}")
shown = axes.scatter(*E.T, c=motion.t, s=3)
figure.colorbar(shown, label="time t [s]", shrink=0.7)
axes.set(xlabel="x", ylabel="y", zlabel="z")
axes.set_aspect("equal")
axes.view_init(35, 45)
figure.savefig("path_of_E.png")
