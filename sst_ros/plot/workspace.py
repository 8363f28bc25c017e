# SPDX-License-Identifier: Apache-2.0
"""The workspace on the sphere: maps, a row of three for each manipulator, and the path of a run.

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
from sst_ros.mechanism.frames import rotation_matrix
from sst_ros.mechanism.geometry import Array, Geometry
from sst_ros.mechanism.workspace import OrientationMap, triangle_directions
from sst_ros.plot.style import BLUE, mark_ends
from sst_ros.recording.signals import Signals
from sst_ros.scene.scene import Scene

WORST_COND = 10.0
"""cond J from which on the colour stays the same."""

LABEL_INSET = math.radians(5.0)
"""Distance from a side of the triangle below which a contour has no label."""

_INK, _PALE, _ALARM = "#222222", "#ececec", "#d1182b"


def plot_workspace(*charts: OrientationMap, titles: Sequence[str] = ()) -> Figure:
    """Draw maps of `workspace`: free turn, condition of J and distance to the nearest limit.

    Args:
        charts: a row of pictures each.
        titles: a name for each; by default none.

    """
    figure = Figure(figsize=(13.5, 4.3 * len(charts)), layout="constrained")
    rows = figure.subfigures(len(charts), 1, squeeze=False)[:, 0]
    names = titles or ["E on the base triangle"] * len(charts)
    for row, chart, title in zip(rows, charts, names, strict=True):
        divisions = round((math.sqrt(8 * len(chart.s) + 1) - 3) / 2)
        _row(row, chart, triangle_directions(chart.geometry, divisions)[1], title)
    return figure


def _row(figure: Any, chart: OrientationMap, faces: NDArray[np.intp], title: str) -> None:
    view = View(chart.geometry)
    poses = workspace.parallel_singularities(chart)
    share = f"E reaches {100 * _reached(chart, faces):.0f} % of the triangle"
    worst = chart.measures.cond_j[chart.measures.admissible].max(initial=1.0)
    least = f"cond J up to {worst:.2f}" if worst < 100 else "singular poses inside"
    figure.suptitle(f"{title}: {share}; {least}", fontsize=12, fontweight="bold", color=_INK)
    turn = np.where(chart.turn > 0.0, np.degrees(chart.turn), np.nan)
    panels = [
        ("Free turn of the star about OE", "deg", turn, "viridis", (0.0, None)),
        ("Best condition of J over that turn", "cond J", chart.best_cond_j, "magma_r",
         (1.0, WORST_COND)),
        ("Distance to the nearest limit, best turn", "deg", np.degrees(chart.best_margin),
         "viridis", (0.0, None)),
    ]  # fmt: skip
    for axes, (name, unit, values, colours, limits) in zip(
        figure.subplots(1, 3), panels, strict=True
    ):
        _panel(axes, view, chart, faces, values, colours, limits, unit)
        axes.set_title(name, fontsize=10.5, color=_INK)
        if unit == "cond J" and len(poses):
            x, y = view.flat(poses.rotation[:, :, 2])
            axes.plot(x, y, ".", markersize=2.2, color=_ALARM, alpha=0.8)
            axes.plot([], [], "o", markersize=4, color=_ALARM, label="det J2 = 0 at some turn")
        if unit == "cond J":
            ends = workspace.serial_singularities(chart.geometry)
            if len(ends):
                x, y = view.flat(ends.rotation[:, :, 2])
                axes.plot(x, y, "o", markersize=2, color="#1b6ca8", label="det J1 = 0 at the edge")
            if len(poses) or len(ends):
                axes.legend(loc="upper right", fontsize=8, frameon=False)


def _reached(chart: OrientationMap, faces: NDArray[np.intp]) -> float:
    """Part of the triangle's area that E can be on."""
    a, b, c = (chart.s[faces[:, i]] for i in range(3))
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    return float(np.average((chart.turn > 0.0)[faces].mean(axis=1), weights=area))


def _panel(
    axes: Axes,
    view: View,
    chart: OrientationMap,
    faces: NDArray[np.intp],
    values: Array,
    colours: str,
    limits: tuple[float, float | None],
    unit: str,
) -> None:
    x, y = view.flat(chart.s)
    axes.tripcolor(Triangulation(x, y, faces), np.zeros(len(x)), cmap="Greys", vmin=-0.5, vmax=5)
    mesh = Triangulation(x, y, faces)
    known = np.isfinite(values)
    if known.any():
        scale = LogNorm if limits[1] else Normalize
        norm = scale(limits[0], limits[1] or np.nanmax(values))
        # Values go on past the edge of the workspace, and the picture is cut there.
        nearest = cKDTree(chart.s[known]).query(chart.s)[1]
        whole = np.where(known, values, values[known][nearest])
        edge = axes.tricontourf(
            mesh, chart.measures.margin.max(axis=1), levels=[0.0, np.pi], alpha=0.0
        )
        filled = axes.tripcolor(
            mesh, whole, cmap=colours, shading="gouraud", norm=norm, rasterized=True
        )
        lines = _contours(axes, mesh, whole, limits)
        inset = LinearTriInterpolator(mesh, np.arcsin((chart.s @ chart.geometry.w.T).min(axis=1)))
        for label in lines[1:]:
            label.set_visible(bool(inset(*label.get_position()).filled(0.0) > LABEL_INSET))
        if not known.all():
            for part in (filled, *lines):
                part.set_clip_path(edge.get_paths()[0], axes.transData)
        above = limits[1] is not None and np.nanmax(values) > limits[1]
        bar = axes.figure.colorbar(
            filled, ax=axes, shrink=0.72, pad=0.02, extend="max" if above else "neither"
        )
        bar.set_label(unit, fontsize=9)
        bar.ax.tick_params(labelsize=8)
        if limits[1]:
            bar.set_ticks([1, 1.5, 2, 3, 5, 10], labels=["1", "1.5", "2", "3", "5", "10"])
            bar.ax.minorticks_off()
        # On a plateau the place that is farthest from the limits.
        goal = np.nanmin(values) if unit == "cond J" else np.nanmax(values)
        near = np.abs(values - goal) <= 0.01 * abs(goal)
        best = int(np.nanargmax(np.where(near, chart.best_margin, np.nan)))
        axes.plot(x[best], y[best], "*", markersize=13, color="white", markeredgecolor=_INK)
        label = f"least {goal:.2f}" if unit == "cond J" else f"most {goal:.0f}°"
        axes.annotate(
            label, (x[best], y[best]), (0, 8), textcoords="offset points", fontsize=9,
            color=_INK, ha="center",
            bbox={"boxstyle": "round,pad=0.2", "fc": "white", "ec": "none", "alpha": 0.75},
        )  # fmt: skip
    frame(axes, view)


def _contours(
    axes: Axes, mesh: Triangulation, values: Array, limits: tuple[float, float | None]
) -> list[Any]:
    top = limits[1] or float(np.nanmax(values))
    step = 5 if top < 45 else 10 if top < 75 else 20
    levels = [1.1, 1.2, 1.5, 2.0, 3.0, 5.0] if limits[1] else list(range(step, 360, step))
    inside = [lv for lv in levels if np.nanmin(values) < lv < np.nanmax(values)]
    if not inside:
        return []
    lines = axes.tricontour(mesh, values, levels=inside, colors="white", linewidths=0.8)
    return [lines, *axes.clabel(lines, fontsize=7.5, fmt="%g" if limits[1] else "%g°")]


def frame(axes: Axes, view: View) -> None:
    """Draw the base triangle with its corners and the sense of gamma along its arcs."""
    geometry = view.geometry
    reach = max(float(np.hypot(*view.flat(v))) for v in geometry.v)
    for k in range(3):
        along = np.linspace(0.0, geometry.arc[k], 60)[:, None]
        arc = np.cos(along) * geometry.v[k]
        arc = arc + np.sin(along) * np.cross(geometry.w[k], geometry.v[k])
        x, y = view.flat(arc)
        axes.plot(x, y, color=_INK, lw=1.8, solid_capstyle="round")
        # gamma_k grows from P_k to P_k+1.
        axes.annotate("", (x[32], y[32]), (x[28], y[28]),
                      arrowprops={"arrowstyle": "-|>", "color": _INK, "lw": 1.5})  # fmt: skip
        corner = np.array(view.flat(geometry.v[k]))
        axes.plot(*corner, "o", markersize=5, color=_INK)
        _beside(axes, np.array([x[30], y[30]]), f"$\\gamma_{k + 1}$")
        _beside(axes, corner, f"$P_{k + 1}$")
    axes.set_aspect("equal")
    axes.set_xlim(-1.22 * reach, 1.22 * reach)
    axes.set_ylim(-0.86 * reach, 1.2 * reach)
    axes.set_axis_off()


def _beside(axes: Axes, point: Array, label: str) -> None:
    """Write a label outward of a point on the triangle."""
    x, y = point * (1.0 + 0.1 / np.hypot(*point))
    axes.text(x, y, label, fontsize=12, color=_INK, ha="center", va="center")


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
