# SPDX-License-Identifier: Apache-2.0
"""Draw the workspace of the paper's manipulator and of a general one.

    python examples/workspace.py [workspace.png]

Where can E be, how far can the star turn there, how well do the actuators hold it, and how far
is the nearest limit? Singular poses are printed, and marked in the picture.
"""

import sys

import numpy as np

from sst_ros.mechanism import singularities, workspace
from sst_ros.mechanism.geometry import Geometry
from sst_ros.plot.workspace import draw

MANIPULATORS = {
    "Isotropic: v = I, α = 120°, 120°, 120°": Geometry.build(np.eye(3), np.radians([120] * 3)),
    "General: v = I, α = 210°, 75°, 75°": Geometry.build(np.eye(3), np.radians([210, 75, 75])),
    "General: unequal arcs, α = 140°, 100°, 120°": Geometry.build(
        [[1, 0, 0.1], [-0.2, 1, 0.1], [0.1, 0.3, 1]], np.radians([140, 100, 120])
    ),
}


def main(path: str) -> None:
    """Map, report, draw."""
    charts, meshes = [], []
    for title, geometry in MANIPULATORS.items():
        s, faces = workspace.triangle_directions(geometry, divisions=60)
        charts.append(workspace.over_orientations(geometry, s, turns=180, progress=True))
        meshes.append(faces)
        print(f"{title}\n{singularities.report(geometry, charts[-1])}\n")
    draw(charts, meshes, list(MANIPULATORS)).savefig(path, dpi=110)
    print(f"drew {path}")


if __name__ == "__main__":
    main(sys.argv[1] if len(sys.argv) > 1 else "workspace.png")
