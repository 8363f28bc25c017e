# SPDX-License-Identifier: Apache-2.0
"""The path of E on the sphere, seen from outside, with the edge of the workspace.

The projection is that of the workspace maps: equal patches are equal solid angles.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.tri import Triangulation
from numpy.typing import NDArray

from sst_ros.mechanism import workspace
from sst_ros.mechanism.frames import rotation_matrix
from sst_ros.mechanism.geometry import Array, Geometry
from sst_ros.plot.style import BLUE, mark_ends
from sst_ros.plot.workspace import View, frame
from sst_ros.recording.signals import Signals
from sst_ros.scene.scene import Scene

LEVELS = (5, 10, 20, 30)
_DIVISIONS, _TURNS = 40, 72


def sphere(run: Signals, scene: Scene) -> Figure:
    """Draw the path of E over how far the best turn of the star keeps from every limit."""
    figure, axes, view = ground(scene)
    x, y = view.flat(directions(run))
    axes.plot(x, y, color=BLUE, linewidth=1.8, label="path of E")
    mark_ends(axes, x, y)
    axes.legend(loc="upper left", fontsize=8, frameon=False)
    return figure


def ground(scene: Scene) -> tuple[Figure, Axes, View]:
    """Draw the base triangle, where E cannot be, and lines of equal distance to the limits."""
    geometry = Geometry.of(scene)
    view = View(geometry)
    figure = Figure(figsize=(6.4, 5.6))
    axes = figure.subplots()
    s, faces, margin = _margins(scene)
    mesh = Triangulation(*view.flat(s), faces)
    beyond = np.isnan(margin)
    if beyond.any():
        out = Triangulation(mesh.x, mesh.y, faces[beyond[faces].any(axis=1)])
        axes.tripcolor(out, np.zeros(len(s)), cmap="Greys", vmin=-0.5, vmax=2.0)
        axes.plot([], [], "s", color="#cccccc", label="E cannot be there")
    inside = Triangulation(mesh.x, mesh.y, faces, mask=beyond[faces].any(axis=1))
    levels = [level for level in LEVELS if np.nanmin(margin) < level < np.nanmax(margin)]
    if levels:
        drawn = axes.tricontour(inside, np.nan_to_num(margin), levels=levels, colors="#999999",
                                linewidths=0.7)  # fmt: skip
        axes.clabel(drawn, fontsize=7, fmt="%g°")
        axes.plot([], [], color="#999999", linewidth=0.7, label="distance to the nearest limit")
    frame(axes, view)
    return figure, axes, view


def directions(run: Signals) -> Array:
    """Direction of E in {B} at each sample, shape (n, 3)."""
    return rotation_matrix(run.take("q_x", "q_y", "q_z", "q_w"))[:, :, 2]


@lru_cache(maxsize=4)
def _margins(scene: Scene) -> tuple[Array, NDArray[np.intp], Array]:
    s, faces = workspace.triangle_directions(Geometry.of(scene), _DIVISIONS)
    chart = workspace.over_orientations(Geometry.of(scene), s, turns=_TURNS)
    return s, faces, np.degrees(chart.best_margin)
