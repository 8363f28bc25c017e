# SPDX-License-Identifier: Apache-2.0
"""Figs. 8 to 14 of the paper: the path and position of E and the ZYZ angles.

Each takes any number of solutions: a run, the continuous solution, an independent engine. Several
are drawn over each other, with their differences from the first below, on a logarithmic axis.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from sst_ros.mechanism.frames import rotation_matrix, zyz_angles
from sst_ros.mechanism.geometry import Array, Geometry
from sst_ros.plot.style import BLUE, GREY, LINES, lines, mark_ends, positive, span, widen
from sst_ros.scene.scene import Scene

NUMBERS = {
    "example1": {"position_of_E": 8, "psi": 9},
    "example2": {"path_of_E": 10, "position_of_E": 11, "theta": 12, "phi": 13, "psi": 14},
}
"""Number of a picture in the paper, by the name of the scene."""

ASSUMPTION = "assumed inertias: the paper's are lost"

LEAST_POSITION_M, LEAST_ANGLE_DEG = 0.05, 1.0
"""An axis never shows less than this, so that rounding is a flat line."""


class Solution(NamedTuple):
    """One solution of the motion: its name, times [s] (n,), quaternions (n, 4), ZYZ angles (n, 3).

    Angles are in rad; where they are nan those of the quaternion are drawn.
    """

    name: str
    seconds: Array
    quaternion: Array
    euler: Array | None = None

    @property
    def degrees(self) -> Array:
        """ZYZ angles [deg] without jumps, shape (n, 3)."""
        computed = zyz_angles(rotation_matrix(self.quaternion))
        if self.euler is not None:
            computed = np.where(np.isfinite(self.euler), self.euler, computed)
        return np.asarray(np.degrees(_unwrapped(computed)))

    def position(self, scene: Scene) -> Array:
        """Position of E in {B} [m], shape (n, 3)."""
        return np.asarray(scene.star.radius * rotation_matrix(self.quaternion)[:, :, 2])


def caption(name: str, title: str, scene: str | None) -> tuple[str, str]:
    """Return the stem of a picture's file and its title.

    The paper's figures have their number and name the assumption behind them.
    """
    title += f", {scene}" if scene else ""
    number = NUMBERS.get(scene or "", {}).get(name)
    if number is None:
        return name, title
    return f"fig{number:02d}_{name}", f"{title}\nFig. {number} of the paper; {ASSUMPTION}"


def position_of_e(scene: Scene, solutions: Sequence[Solution]) -> Figure:
    """Draw the coordinates of E over time."""
    values = [each.position(scene) for each in solutions]
    return _over_time(solutions, values, "xyz", "position of E in {B} [m]", "m", LEAST_POSITION_M)


def angle(solutions: Sequence[Solution], which: int) -> Figure:
    """Draw one of the ZYZ angles over time: 0 theta, 1 phi, 2 psi."""
    letter = "θφψ"[which]
    values = [each.degrees[:, which : which + 1] for each in solutions]
    return _over_time(solutions, values, letter, f"{letter} [deg]", "deg", LEAST_ANGLE_DEG)


def _over_time(
    solutions: Sequence[Solution],
    values: Sequence[Array],
    letters: str,
    label: str,
    unit: str,
    least_span: float,
) -> Figure:
    """Draw columns over time; differences from the first solution below where there are several."""
    first = solutions[0]
    if len(solutions) == 1:
        figure = Figure(figsize=(7.0, 4.2))
        axes = figure.subplots()
        lines(axes, first.seconds, values[0], list(letters), least_span=least_span)
        axes.set_xlabel("time t [s]")
        axes.set_ylabel(label)
        return figure
    figure = Figure(figsize=(7.0, 6.4))
    above, below = figure.subplots(2, 1, sharex=True, height_ratios=(3, 2))
    for solution, columns, style in zip(solutions, values, LINES, strict=False):
        above.plot(solution.seconds, columns, label=solution.name, **style)
    widen(above, values[0], least_span)
    _name_columns(above, first.seconds, values[0], letters)
    handles, names = above.get_legend_handles_labels()
    unique = dict(zip(names, handles, strict=True))
    above.legend(unique.values(), unique.keys(), loc="lower right", bbox_to_anchor=(1.0, 1.0),
                 ncol=len(unique), fontsize=8, frameon=False, borderaxespad=0.1)  # fmt: skip
    above.set_ylabel(label)
    for solution, columns, style in list(zip(solutions, values, LINES, strict=False))[1:]:
        at, here, there = np.intersect1d(
            np.round(first.seconds, 9), np.round(solution.seconds, 9), return_indices=True
        )
        apart = np.abs(columns[there] - values[0][here]).max(axis=1)
        below.plot(at, positive(apart), label=f"{solution.name}: {_largest(apart, unit)}", **style)
    below.set_yscale("log")
    below.set_ylabel(f"difference from\n{first.name} [{unit}]")
    below.set_xlabel("time t [s]")
    below.legend(fontsize=8, loc="best", title="largest difference", title_fontsize=8)
    span([above, below], first.seconds)
    return figure


def _largest(apart: Array, unit: str) -> str:
    return f"{np.nanmax(apart):.1e} {unit}" if np.isfinite(apart).any() else "no common times"


def _name_columns(axes: Axes, seconds: Array, columns: Array, letters: str) -> None:
    """Write the letter of each column beside its last value, where there are several."""
    if len(letters) == 1:
        return
    for letter, column in zip(letters, columns.T, strict=True):
        known = np.flatnonzero(np.isfinite(column))
        if len(known):
            axes.annotate(letter, (seconds[known[-1]], column[known[-1]]), (4, 0),
                          textcoords="offset points", va="center",
                          annotation_clip=False)  # fmt: skip


def path(scene: Scene, solutions: Sequence[Solution]) -> Figure:
    """Draw E over the base triangle, both at their own radius, and the triangle's image at E's."""
    figure = Figure(figsize=(6.4, 6.4))
    axes = figure.add_subplot(projection="3d")
    geometry = Geometry.of(scene)
    base, star = scene.base.radius, scene.star.radius
    outline = triangle(geometry)
    axes.plot(*(base * outline).T, color=GREY, linewidth=1.6, label="base triangle P₁P₂P₃")
    if star != base:
        axes.plot(*(star * outline).T, color=GREY, linewidth=0.9, linestyle=":",
                  label="its image on the sphere of E")  # fmt: skip
    for index, point in enumerate(1.14 * max(base, star) * geometry.v):
        axes.text(*point, f"P{'₁₂₃'[index]}", ha="center", va="center")
    several = len(solutions) > 1
    for solution, style in zip(solutions, LINES, strict=False):
        name = solution.name if several else "path of E"
        looks = style if several else {"color": BLUE, "linewidth": 1.8}
        axes.plot(*solution.position(scene).T, label=name, **looks)
    position = solutions[0].position(scene)
    known = position[np.isfinite(position[:, 0])]
    mark_ends(axes, *known.T)
    axes.set(xlabel="x [m]", ylabel="y [m]", zlabel="z [m]")
    axes.set_box_aspect((1, 1, 1))
    shown = np.concatenate([base * outline, star * outline, known])
    middle = 0.5 * (shown.min(axis=0) + shown.max(axis=0))
    reach = 0.5 * float(np.ptp(shown, axis=0).max())
    low, high = middle - reach, middle + reach
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), zlim=(low[2], high[2]))
    centre = geometry.v.sum(axis=0)
    azimuth = np.degrees(np.arctan2(centre[1], centre[0]))
    height = np.degrees(np.arctan2(centre[2], np.hypot(centre[0], centre[1])))
    axes.view_init(elev=height - 8.0, azim=azimuth + 8.0)
    for axis in (axes.xaxis, axes.yaxis, axes.zaxis):
        axis.set_major_locator(MaxNLocator(5, steps=[1, 2, 5, 10], prune="both"))
    axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.06), ncol=3, fontsize=9)
    return figure


def triangle(geometry: Geometry) -> Array:
    """Points of the closed base triangle on the unit sphere, shape (n, 3)."""
    share = np.linspace(0.0, 1.0, 40)[:, None]
    sides = []
    for k in range(3):
        along: Array = geometry.arc[k] * share
        across = np.cross(geometry.w[k], geometry.v[k])
        sides.append(np.cos(along) * geometry.v[k] + np.sin(along) * across)
    return np.asarray(np.concatenate(sides))


def _unwrapped(angles: Array) -> Array:
    """Take out whole turns between samples, over lost samples too; shape (n, 3)."""
    result: Array = angles.copy()
    for column in range(3):
        known = np.isfinite(result[:, column])
        result[known, column] = np.unwrap(result[known, column])
    return result
