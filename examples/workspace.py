# SPDX-License-Identifier: Apache-2.0
"""Workspace of a design
=====================

Where can E be, how far can the star turn there, how well do the actuators hold it, and
how far is the nearest limit? Singular poses are printed, and marked in the picture.
"""

import numpy as np

from sst_ros import Geometry, plot_workspace, workspace
from sst_ros.mechanism.workspace import report_singularities

MANIPULATORS = {
    "Isotropic: v = I, α = 120°, 120°, 120°": Geometry.build(
        np.eye(3), np.radians([120] * 3)
    ),
    "General: v = I, α = 210°, 75°, 75°": Geometry.build(
        np.eye(3), np.radians([210, 75, 75])
    ),
    "General: unequal arcs, α = 140°, 100°, 120°": Geometry.build(
        [[1, 0, 0.1], [-0.2, 1, 0.1], [0.1, 0.3, 1]], np.radians([140, 100, 120])
    ),
}

charts = [workspace(geometry, progress=True) for geometry in MANIPULATORS.values()]
for (title, geometry), chart in zip(MANIPULATORS.items(), charts, strict=True):
    print(f"{title}\n{report_singularities(geometry, chart)}\n")

figure = plot_workspace(*charts, titles=list(MANIPULATORS))
figure.savefig("workspace.png", dpi=110)
