# SPDX-License-Identifier: Apache-2.0
"""The workspace on the sphere: a row of three maps per manipulator, and paths of E.

The sphere is seen from outside along the middle of the base triangle, in the equal-area
projection of Lambert, so that equal patches are equal solid angles.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import lru_cache
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.colors import BoundaryNorm, LogNorm
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from matplotlib.tri import Triangulation
from numpy.typing import NDArray

from sst_ros.errors import refuse_unless
from sst_ros.figures import (
    BLUE,
    GREEN,
    GREY,
    INK,
    VERMILION,
    Looks,
    mark_ends,
    styled,
)
from sst_ros.mechanism import workspace
from sst_ros.mechanism.geometry import Array, Geometry, star_direction
from sst_ros.mechanism.workspace import OrientationMap
from sst_ros.scene.scene import Scene

if TYPE_CHECKING:  # the room needs python-flint
    from sst_ros.proof.zones import ProvenZone

CONDITIONS = (1.0, 1.1, 1.2, 1.5, 2.0, 3.0, 5.0, 10.0)
"""Levels of cond J; all above them have one colour."""
PLATEAU = 0.01
"""Values that are off the best one by this share of it count as the best, too."""
_ALARM = "#d1182b"
ZONE_DIVISIONS = 50
"""Divisions of an edge of the triangle on which a zone is drawn."""
_LEAST_TORSION_DEG = 1e-9
"""Range of the colours where no torsion is proven."""
_SIDE_POINTS = 61
"""Points by which a side of the base triangle is drawn, odd: one is its middle."""


@styled
def plot_workspace(*charts: OrientationMap, titles: Sequence[str] = ()) -> Figure:
    """Draw maps of `workspace`: free turn, condition of J, distance to nearest limit.

    Each map is a row of pictures, with a title if there are any.
    """
    are_maps = all(isinstance(chart, OrientationMap) for chart in charts)
    fits = are_maps and len(charts) > 0 and isinstance(titles, Sequence)
    fits = fits and len(titles) in (0, len(charts))
    requirement = "must be maps of `workspace`, and a title for each or none"
    arguments = (*charts, titles)
    refuse_unless("plot_workspace", ("charts, titles", arguments, fits, requirement))
    figure = Figure(figsize=(13.5, 4.3 * len(charts)))
    rows = figure.subfigures(len(charts), 1, squeeze=False)[:, 0]
    row_titles = titles or ["E on the base triangle"] * len(charts)
    for row, chart, title in zip(rows, charts, row_titles, strict=True):
        _draw_row(row, chart, title)
    return figure


def _draw_row(row: Any, chart: OrientationMap, title: str) -> None:
    """Draw the three pictures of a map, and the singularities in each."""
    faces = triangles(chart)
    a, b, c = (chart.s[faces[:, i]] for i in range(3))
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    reach = np.average((chart.turn > 0.0)[faces].mean(axis=1), weights=area)
    share = f"E reaches {100 * reach:.0f} % of the triangle"
    worst = chart.measures.cond_j[chart.measures.admissible].max(initial=1.0)
    least = f"cond J up to {worst:.2f}" if worst < 100 else "singular poses inside"
    heading = f"{title}: {share}; {least}"
    row.suptitle(heading, fontsize=12, fontweight="bold", color=INK)
    turn = np.where(chart.turn > 0.0, np.degrees(chart.turn), np.nan)
    margin = np.degrees(chart.best_margin)
    turn_axes, condition_axes, margin_axes = row.subplots(1, 3)
    _panel(turn_axes, chart, faces, turn, _angle_scale)
    _set_title(turn_axes, "Free turn of the star about OE")
    _panel(condition_axes, chart, faces, chart.best_cond_j, _condition_scale)
    _set_title(condition_axes, "Best condition of J over that turn")
    _panel(margin_axes, chart, faces, margin, _angle_scale)
    _set_title(margin_axes, "Distance to the nearest limit, best turn")
    poses = workspace.parallel_singularities(chart)
    ends = workspace.serial_singularities(chart.geometry)
    for singular, marker, size, colour, label in (
        (poses, ".", 2.2, _ALARM, "det J2 = 0 at some turn"),
        (ends, "o", 2.0, BLUE, "det J1 = 0 at the edge"),
    ):
        if len(singular):
            x, y = project(chart.geometry, star_direction(singular.rotation))
            condition_axes.plot(x, y, marker, markersize=size, color=colour, alpha=0.8)
            condition_axes.plot([], [], "o", markersize=4, color=colour, label=label)
            condition_axes.legend(loc="upper right", fontsize=8, frameon=False)


@styled
def plot_zone(zone: ProvenZone) -> Figure:
    """Draw what is proven of a zone on the workspace triangle.

    Of a cap the torsion at directions of E: how much of it is proven, and how much is
    neither proven nor refuted. A triangle between three directions has the colour of
    the one of which least is known. Of a box of actuator angles the directions of E.
    """
    is_zone = hasattr(zone, "turns_at")
    refuse_unless("plot_zone", ("zone", zone, is_zone, "must be of `certify_zone`"))
    geometry = Geometry.of(zone.scene)
    if zone.names[0] == "gamma_1":
        figure = Figure(figsize=(6.4, 5.6))
        axes = figure.subplots()
        _draw_statuses(axes, geometry, zone)
        axes.legend(loc="upper right", fontsize=8, frameon=False)
    else:
        figure = Figure(figsize=(10.5, 4.9))
        s, faces = workspace.triangle_directions(geometry, ZONE_DIVISIONS)
        _, open_torsion, proven_torsion = np.degrees(zone.turns_at(s)).T
        proven_axes, open_axes = figure.subplots(1, 2)
        x, y = project(geometry, s)
        mesh = Triangulation(x, y, faces)
        for axes, torsion, title in (
            (
                proven_axes,
                proven_torsion[faces].min(axis=1),
                "Proven torsion, at least",
            ),
            (
                open_axes,
                open_torsion[faces].max(axis=1),
                "Torsion neither proven nor refuted, at most",
            ),
        ):
            _draw_torsion(axes, mesh, torsion)
            _set_title(axes, title)
            draw_triangle(axes, geometry)
    figure.suptitle(f"{zone.scene.name}: {zone.shares}", fontsize=12, color=INK)
    return figure


def _draw_torsion(axes: Axes, mesh: Triangulation, torsion: Array) -> None:
    """Colour triangles by angles [deg], in steps, with a bar that says which."""
    most = max(float(torsion.max()), _LEAST_TORSION_DEG)
    levels = MaxNLocator(10).tick_values(0.0, most)
    steps = BoundaryNorm(levels, len(levels) - 1)
    colours = colormaps["viridis"].resampled(len(levels) - 1)
    filled = axes.tripcolor(mesh, facecolors=torsion, cmap=colours, norm=steps)
    bar = axes.figure.colorbar(filled, ax=axes, shrink=0.72, pad=0.02)
    bar.set_label("deg", fontsize=9)


def _draw_statuses(axes: Axes, geometry: Geometry, zone: ProvenZone) -> None:
    """Draw the direction of E in the middle of each box, by its status."""
    s = star_direction(zone.middles())
    for status, colour, label in (
        (-1, VERMILION, "refuted"),
        (0, GREY, "open"),
        (1, GREEN, "proven"),
    ):
        rows = zone.columns["status"] == status
        x, y = project(geometry, s[rows])
        axes.plot(x, y, ".", markersize=2.5, color=colour, label=label)
    draw_triangle(axes, geometry)


def triangles(chart: OrientationMap) -> NDArray[np.intp]:
    """Return the triangles between the directions of a map, shape (n, 3)."""
    # n divisions of an edge make (n + 1) (n + 2) / 2 directions.
    divisions = round((math.sqrt(8 * len(chart.s) + 1) - 3) / 2)
    _, faces = workspace.triangle_directions(chart.geometry, divisions)
    return faces


class _Scale(NamedTuple):
    """How the values of a map are drawn, and which of them is the best."""

    label: str
    levels: Sequence[float] | Array
    looks: Looks
    best: float
    best_text: str


def _angle_scale(degrees: Array) -> _Scale:
    """Return the scale of angles [deg], of which the largest is the best."""
    best = float(np.nanmax(degrees))
    levels = MaxNLocator(10).tick_values(0.0, best)
    return _Scale("deg", levels, {"cmap": "viridis"}, best, f"most {best:.0f}°")


def _condition_scale(conditions: Array) -> _Scale:
    """Return the scale of cond J, logarithmic from 1; the least is the best."""
    best = float(np.nanmin(conditions))
    norm = LogNorm(1.0, CONDITIONS[-1])
    looks: Looks = {"cmap": "magma_r", "norm": norm, "extend": "max"}
    return _Scale("cond J", CONDITIONS, looks, best, f"least {best:.2f}")


def _set_title(axes: Axes, title: str) -> None:
    axes.set_title(title, fontsize=10.5, color=INK, loc="center")


def _panel(
    axes: Axes,
    chart: OrientationMap,
    faces: NDArray[np.intp],
    values: Array,
    scale_of: Callable[[Array], _Scale],
) -> None:
    """Draw values at the directions of a map, shape (n,), and mark the best place."""
    x, y = project(chart.geometry, chart.s)
    axes.tripcolor(Triangulation(x, y, faces), 0.0 * x, cmap="Greys", vmin=-0.5, vmax=5)
    finite = np.isfinite(values)
    inside = finite[faces].all(axis=1)
    if inside.any():
        scale = scale_of(values)
        mesh = Triangulation(x, y, faces, mask=~inside)
        filled_values = np.where(finite, values, scale.best)
        filled = axes.tricontourf(
            mesh, filled_values, levels=scale.levels, **scale.looks
        )
        bar = axes.figure.colorbar(
            filled, ax=axes, shrink=0.72, pad=0.02, ticks=scale.levels
        )
        bar.set_label(scale.label, fontsize=9)
        bar.ax.tick_params(labelsize=8)
        bar.ax.set_yticklabels([f"{level:g}" for level in scale.levels])
        bar.ax.minorticks_off()
        # On a plateau the place that is farthest from the limits.
        plateau = np.abs(values - scale.best) <= PLATEAU * abs(scale.best)
        best = int(np.nanargmax(np.where(plateau, chart.best_margin, np.nan)))
        _mark_best(axes, x[best], y[best], scale.best_text)
    draw_triangle(axes, chart.geometry)


def _mark_best(axes: Axes, x: float, y: float, text: str) -> None:
    """Mark the best place of a map by a star with a text above it."""
    axes.plot(x, y, "*", markersize=13, color="white", markeredgecolor=INK)
    box = {"boxstyle": "round,pad=0.2", "fc": "white", "ec": "none", "alpha": 0.75}
    axes.annotate(
        text,
        (x, y),
        (0, 8),
        color=INK,
        textcoords="offset points",
        fontsize=9,
        ha="center",
        bbox=box,
    )


def sides(geometry: Geometry, points: int) -> Array:
    """Return points on the sides of the base triangle, shape (3, points, 3).

    They lie on the unit sphere.
    """
    angle = np.multiply.outer(geometry.arc, np.linspace(0.0, 1.0, points))[:, :, None]
    across = np.cross(geometry.w, geometry.v)
    return np.asarray(
        np.cos(angle) * geometry.v[:, None] + np.sin(angle) * across[:, None]
    )


def draw_triangle(axes: Axes, geometry: Geometry) -> None:
    """Draw the base triangle with its corners and the sense of gamma along its arcs."""
    reach = float(np.hypot(*project(geometry, geometry.v)).max())
    arrow = {"arrowstyle": "-|>", "color": INK, "lw": 1.5}
    middle = _SIDE_POINTS // 2
    for k, side in enumerate(sides(geometry, _SIDE_POINTS), 1):
        x, y = project(geometry, side)
        axes.plot(x, y, color=INK, lw=1.8, solid_capstyle="round")
        points = np.stack([x, y], axis=1)
        # gamma_k grows from P_k to P_k+1.
        axes.annotate("", points[middle + 2], points[middle - 2], arrowprops=arrow)
        axes.plot(x[0], y[0], "o", markersize=5, color=INK)
        _name_outside(axes, points[middle], f"$\\gamma_{k}$")
        _name_outside(axes, points[0], f"$P_{k}$")
    # Room for the names: below there is none.
    xlim = (-1.22 * reach, 1.22 * reach)
    ylim = (-0.86 * reach, 1.2 * reach)
    axes.set(aspect="equal", xlim=xlim, ylim=ylim)
    axes.set_axis_off()


def _name_outside(axes: Axes, point: Array, name: str) -> None:
    """Write a name next to a point, away from the middle of the triangle."""
    x, y = point * (1.0 + 0.1 / np.hypot(*point))
    axes.text(x, y, name, fontsize=12, color=INK, ha="center", va="center")


def project(geometry: Geometry, s: Array) -> tuple[Array, Array]:
    """Project unit vectors (..., 3) about the base triangle's middle, P_1 upward."""
    middle = geometry.v.sum(axis=0)
    outward = middle / np.linalg.norm(middle)
    up = geometry.v[0] - outward * (outward @ geometry.v[0])
    up = up / np.linalg.norm(up)
    scale = np.sqrt(2.0 / (1.0 + s @ outward))
    return scale * (s @ np.cross(up, outward)), scale * (s @ up)


@lru_cache(maxsize=4)
def _map(scene: Scene) -> OrientationMap:
    """Return a map that is fine enough for the background of paths."""
    return workspace.workspace(Geometry.of(scene), divisions=40, turns=72)


def draw_paths(scene: Scene, paths: Sequence[tuple[str, Array, Looks]]) -> Figure:
    """Draw paths of E over the map of the distance to the nearest limit.

    Paths are directions (n, 3) each. One path has its ends.
    """
    figure = Figure(figsize=(7.2, 5.6))
    axes = figure.subplots()
    chart = _map(scene)
    margin = np.degrees(chart.best_margin)
    _panel(axes, chart, triangles(chart), margin, _angle_scale)
    for name, s, looks in paths:
        x, y = project(chart.geometry, s)
        axes.plot(x, y, color="white", linewidth=4.0, zorder=1.9)  # seen on each colour
        axes.plot(x, y, label=name, **looks)
        if len(paths) == 1:
            mark_ends(axes, x, y)
    axes.legend(loc="upper left", fontsize=8, frameon=False)
    return figure
