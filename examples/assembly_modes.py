# SPDX-License-Identifier: Apache-2.0
"""Direct kinematics: assembly modes
=================================

All real solutions of the direct kinematics for the same actuator angles. Each gives a
direction of E; the admissible one lies on the base triangle.
"""

import matplotlib.pyplot as plt
import numpy as np

from sst_ros import Geometry, direct_kinematics, load_scene

geometry = Geometry.of(load_scene("general"))
gamma = np.array([0.9, 0.7, 0.8])  # rad
assemblies = direct_kinematics(geometry, gamma)
print(
    len(assemblies),
    "assembly modes,",
    sum(a.admissible for a in assemblies),
    "admissible",
)


def arc(a, b):
    """Points on the great circle from a to b, shape (40, 3)."""
    x = np.linspace(0.0, 1.0, 40)[:, None]
    points = (1.0 - x) * a + x * b
    return points / np.linalg.norm(points, axis=1, keepdims=True)


figure = plt.figure(figsize=(6.0, 5.5), layout="constrained")
axes = figure.add_subplot(projection="3d")
u, v = np.mgrid[0 : 2 * np.pi : 25j, 0 : np.pi : 13j]
axes.plot_wireframe(
    np.cos(u) * np.sin(v), np.sin(u) * np.sin(v), np.cos(v), color="0.9", linewidth=0.5
)
for k in range(3):
    axes.plot(*arc(geometry.v[k], geometry.v[(k + 1) % 3]).T, color="k")
for mode, assembly in enumerate(assemblies, 1):
    # Modes half a turn about E apart have the same E: the later of two is the smaller
    # marker.
    name = f"mode {mode}{', admissible' if assembly.admissible else ''}"
    axes.scatter(*assembly.rotation[:, 2], s=250 / mode, depthshade=False, label=name)
axes.set(
    xlabel="x",
    ylabel="y",
    zlabel="z",
    title="E of each assembly mode; base triangle black",
)
axes.set_aspect("equal")
axes.view_init(25, 40)
axes.legend(fontsize=8, loc="upper left")
figure.savefig("assembly_modes.png")
