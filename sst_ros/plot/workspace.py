# SPDX-License-Identifier: Apache-2.0
"""The workspace on the sphere: maps, a row of three for each manipulator; ground for a path of E.

The sphere is seen from outside along the middle of the base triangle, in the equal-area
projection of Lambert, so that equal patches are equal solid angles.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import lru_cache
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm, Normalize
from matplotlib.figure import Figure
from matplotlib.tri import LinearTriInterpolator, Triangulation
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from sst_ros.mechanism import workspace
from sst_ros.mechanism.geometry import Array, Geometry
from sst_ros.mechanism.workspace import OrientationMap, triangle_directions
from sst_ros.plot.style import BLUE, GREY, INK, Looks, sides, styled
from sst_ros.scene.scene import Scene

WORST_COND = 10.0  # from this cond J on the colour stays the same
LABEL_INSET = math.radians(5.0)  # less far from a side of the triangle a contour has no label
_ALARM = "#d1182b"


@styled
def plot_workspace(*charts: OrientationMap, titles: Sequence[str] = ()) -> Figure:
    """Draw maps of `workspace`: free turn, condition of J and distance to the nearest limit.

    Each map is a row of pictures, with a title if there are any.
    """
    figure = Figure(figsize=(13.5, 4.3 * len(charts)))
    rows = figure.subfigures(len(charts), 1, squeeze=False)[:, 0]
    names = titles or ["E on the base triangle"] * len(charts)
    for row, chart, title in zip(rows, charts, names, strict=True):
        divisions = round((math.sqrt(8 * len(chart.s) + 1) - 3) / 2)
        _row(row, chart, triangle_directions(chart.geometry, divisions)[1], title)
    return figure


def _row(figure: Any, chart: OrientationMap, faces: NDArray[np.intp], title: str) -> None:
    view = View(chart.geometry)
    poses = workspace.parallel_singularities(chart)
    a, b, c = (chart.s[faces[:, i]] for i in range(3))
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    reach = np.average((chart.turn > 0.0)[faces].mean(axis=1), weights=area)
    share = f"E reaches {100 * reach:.0f} % of the triangle"
    worst = chart.measures.cond_j[chart.measures.admissible].max(initial=1.0)
    least = f"cond J up to {worst:.2f}" if worst < 100 else "singular poses inside"
    figure.suptitle(f"{title}: {share}; {least}", fontsize=12, fontweight="bold", color=INK)
    turn = np.where(chart.turn > 0.0, np.degrees(chart.turn), np.nan)
    margin = np.degrees(chart.best_margin)
    left, axes, right = figure.subplots(1, 3)
    for panel, name, values in (
        (left, "Free turn of the star about OE", turn),
        (axes, "Best condition of J over that turn", chart.best_cond_j),
        (right, "Distance to the nearest limit, best turn", margin),
    ):
        _panel(panel, view, chart, faces, values, condition=panel is axes)
        panel.set_title(name, fontsize=10.5, color=INK, loc="center")
    ends = workspace.serial_singularities(chart.geometry)
    for found, marker, size, colour, label in (
        (poses, ".", 2.2, _ALARM, "det J2 = 0 at some turn"),
        (ends, "o", 2.0, BLUE, "det J1 = 0 at the edge"),
    ):
        if len(found):
            x, y = view.flat(found.rotation[:, :, 2])
            axes.plot(x, y, marker, markersize=size, color=colour, alpha=0.8)
            axes.plot([], [], "o", markersize=4, color=colour, label=label)
            axes.legend(loc="upper right", fontsize=8, frameon=False)


def _panel(
    axes: Axes,
    view: View,
    chart: OrientationMap,
    faces: NDArray[np.intp],
    values: Array,
    *,
    condition: bool,
) -> None:
    """Draw values (n,): angles [deg], or cond J: logarithmic, from 1, and the least is the best."""
    x, y = view.flat(chart.s)
    mesh = Triangulation(x, y, faces)
    axes.tripcolor(mesh, np.zeros(len(x)), cmap="Greys", vmin=-0.5, vmax=5)
    known = np.isfinite(values)
    if known.any():
        low, high = float(np.nanmin(values)), float(np.nanmax(values))
        norm = LogNorm(1.0, WORST_COND) if condition else Normalize(0.0, high)
        # Values go on past the edge of the workspace, and the picture is cut there.
        nearest = cKDTree(chart.s[known]).query(chart.s)[1]
        whole = np.where(known, values, values[known][nearest])
        inside = chart.measures.margin.max(axis=1)
        edge = axes.tricontourf(mesh, inside, levels=[0.0, np.pi], alpha=0.0)
        looks: Looks = {"norm": norm, "shading": "gouraud", "rasterized": True}
        filled = axes.tripcolor(mesh, whole, cmap="magma_r" if condition else "viridis", **looks)
        lines = _contours(axes, mesh, whole, condition)
        inset = LinearTriInterpolator(mesh, np.arcsin((chart.s @ chart.geometry.w.T).min(axis=1)))
        for label in lines[1:]:
            label.set_visible(bool(inset(*label.get_position()).filled(0.0) > LABEL_INSET))
        if not known.all():
            for part in (filled, *lines):
                part.set_clip_path(edge.get_paths()[0], axes.transData)
        above = "max" if condition and high > WORST_COND else "neither"
        bar = axes.figure.colorbar(filled, ax=axes, shrink=0.72, pad=0.02, extend=above)
        bar.set_label("cond J" if condition else "deg", fontsize=9)
        bar.ax.tick_params(labelsize=8)
        if condition:
            bar.set_ticks([1, 1.5, 2, 3, 5, 10], labels=["1", "1.5", "2", "3", "5", "10"])
            bar.ax.minorticks_off()
        # On a plateau the place that is farthest from the limits.
        goal = low if condition else high
        near = np.abs(values - goal) <= 0.01 * abs(goal)
        best = int(np.nanargmax(np.where(near, chart.best_margin, np.nan)))
        place = x[best], y[best]
        axes.plot(*place, "*", markersize=13, color="white", markeredgecolor=INK)
        text = f"least {goal:.2f}" if condition else f"most {goal:.0f}°"
        box = {"boxstyle": "round,pad=0.2", "fc": "white", "ec": "none", "alpha": 0.75}
        beside: Looks = {"textcoords": "offset points", "fontsize": 9, "ha": "center", "bbox": box}
        axes.annotate(text, place, (0, 8), color=INK, **beside)
    draw_triangle(axes, view)


def _contours(axes: Axes, mesh: Triangulation, values: Array, condition: bool) -> list[Any]:
    top = float(np.nanmax(values))
    step = 5 if top < 45 else 10 if top < 75 else 20
    levels = [1.1, 1.2, 1.5, 2.0, 3.0, 5.0] if condition else list(range(step, 360, step))
    inside = [level for level in levels if np.nanmin(values) < level < top]
    if not inside:
        return []
    lines = axes.tricontour(mesh, values, levels=inside, colors="white", linewidths=0.8)
    return [lines, *axes.clabel(lines, fontsize=7.5, fmt="%g" if condition else "%g°")]


def draw_triangle(axes: Axes, view: View) -> None:
    """Draw the base triangle with its corners and the sense of gamma along its arcs."""
    geometry = view.geometry
    reach = max(float(np.hypot(*view.flat(v))) for v in geometry.v)
    arrow = {"arrowstyle": "-|>", "color": INK, "lw": 1.5}
    for k, side in enumerate(sides(geometry, 61)):
        x, y = view.flat(side)
        axes.plot(x, y, color=INK, lw=1.8, solid_capstyle="round")
        # gamma_k grows from P_k to P_k+1.
        axes.annotate("", (x[32], y[32]), (x[28], y[28]), arrowprops=arrow)
        corner, middle = np.array([x[0], y[0]]), np.array([x[30], y[30]])
        axes.plot(*corner, "o", markersize=5, color=INK)
        for point, name in ((middle, f"$\\gamma_{k + 1}$"), (corner, f"$P_{k + 1}$")):
            x, y = point * (1.0 + 0.1 / np.hypot(*point))
            axes.text(x, y, name, fontsize=12, color=INK, ha="center", va="center")
    axes.set_aspect("equal")
    axes.set_xlim(-1.22 * reach, 1.22 * reach)
    axes.set_ylim(-0.86 * reach, 1.2 * reach)
    axes.set_axis_off()


class View:
    """Equal-area projection about the middle of the base triangle, P_1 upward."""

    def __init__(self, geometry: Geometry) -> None:
        self.geometry = geometry
        middle = geometry.v.sum(axis=0)
        self.out = middle / np.linalg.norm(middle)
        up = geometry.v[0] - self.out * (self.out @ geometry.v[0])
        self.up = up / np.linalg.norm(up)
        self.right = np.cross(self.up, self.out)

    def flat(self, s: Array) -> tuple[Array, Array]:
        """Project unit vectors (..., 3)."""
        scale = np.sqrt(2.0 / (1.0 + s @ self.out))
        return scale * (s @ self.right), scale * (s @ self.up)


LEVELS = (5, 10, 20, 30)
_DIVISIONS, _TURNS = 40, 72


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
        looks: Looks = {"levels": levels, "colors": GREY, "linewidths": 0.7, "alpha": 0.7}
        drawn = axes.tricontour(inside, np.nan_to_num(margin), **looks)
        axes.clabel(drawn, fontsize=7, fmt="%g°")
        axes.plot([], [], color=GREY, linewidth=0.7, label="distance to the nearest limit")
    draw_triangle(axes, view)
    return figure, axes, view


@lru_cache(maxsize=4)
def _margins(scene: Scene) -> tuple[Array, NDArray[np.intp], Array]:
    s, faces = workspace.triangle_directions(Geometry.of(scene), _DIVISIONS)
    chart = workspace.over_orientations(Geometry.of(scene), s, turns=_TURNS)
    return s, faces, np.degrees(chart.best_margin)
