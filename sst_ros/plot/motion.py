# SPDX-License-Identifier: Apache-2.0
"""The motion of the star in figures, Figs. 8 to 14 of the paper.

Each figure takes any number of solutions: a run, the continuous solution, an independent engine.
Several are drawn over each other, with their differences from the first below, on a logarithmic
axis.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from sst_ros.mechanism.geometry import Array, Geometry, rotation_matrix, zyz_angles
from sst_ros.plot import style
from sst_ros.plot.style import BLUE, GREY, LINES, Looks
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
        """ZYZ angles [deg] without jumps, over lost samples too, shape (n, 3)."""
        angles = zyz_angles(rotation_matrix(self.quaternion))
        if self.euler is not None:
            angles = np.where(np.isfinite(self.euler), self.euler, angles)
        for column in angles.T:
            known = np.isfinite(column)
            column[known] = np.unwrap(column[known])
        return np.asarray(np.degrees(angles))

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
    return _over_time(solutions, values, "xyz", "position of E in {B} [m]", LEAST_POSITION_M)


def angle(solutions: Sequence[Solution], which: int) -> Figure:
    """Draw one of the ZYZ angles over time: 0 theta, 1 phi, 2 psi."""
    letter = "θφψ"[which]
    values = [each.degrees[:, which : which + 1] for each in solutions]
    return _over_time(solutions, values, letter, f"{letter} [deg]", LEAST_ANGLE_DEG)


def _over_time(
    solutions: Sequence[Solution], values: Sequence[Array], letters: str, label: str, least: float
) -> Figure:
    """Draw columns over time; differences from the first solution below where there are several."""
    first, unit = solutions[0], label.split("[")[1].rstrip("]")
    if len(solutions) == 1:
        figure, (axes,) = style.stack([label], 3.2)
        style.lines(axes, first.seconds, values[0], list(letters), least_span=least)
        return figure
    figure, (above, below) = style.stack([label, f"difference from\n{first.name} [{unit}]"], 2.7)
    for solution, columns, looks in zip(solutions, values, LINES, strict=False):
        above.plot(solution.seconds, columns, **looks)[0].set_label(solution.name)
        if solution is first:
            continue
        at, here, there = np.intersect1d(
            np.round(first.seconds, 9), np.round(solution.seconds, 9), return_indices=True
        )
        apart = np.abs(columns[there] - values[0][here]).max(axis=1)
        known = np.isfinite(apart).any()
        largest = f"{np.nanmax(apart):.1e} {unit}" if known else "no common times"
        below.plot(at, style.hide_zeros(apart), label=f"{solution.name}: {largest}", **looks)
    style.widen(above, values[0], least)
    beside: Looks = {"textcoords": "offset points", "va": "center", "annotation_clip": False}
    for letter, column in zip(letters, values[0].T, strict=True):
        finite = np.flatnonzero(np.isfinite(column))
        if len(letters) > 1 and len(finite):  # beside the last value, where there are several
            place = first.seconds[finite[-1]], column[finite[-1]]
            above.annotate(letter, place, (4, 0), **beside)
    style.legend(above)
    below.set_yscale("log")
    below.legend(fontsize=8, loc="best", title="largest difference", title_fontsize=8)
    return figure


def path(scene: Scene, solutions: Sequence[Solution]) -> Figure:
    """Draw E over the base triangle, both at their own radius, and the triangle's image at E's."""
    figure = Figure(figsize=(6.4, 6.4))
    axes = figure.add_subplot(projection="3d")
    geometry = Geometry.of(scene)
    base, star = scene.base.radius, scene.star.radius
    outline = np.concatenate(style.sides(geometry, 40))
    axes.plot(*(base * outline).T, color=GREY, linewidth=1.6, label="base triangle P₁P₂P₃")
    if star != base:
        image = {"linewidth": 0.9, "linestyle": ":", "label": "its image on the sphere of E"}
        axes.plot(*(star * outline).T, color=GREY, **image)
    names = style.leg_names("P")
    for name, point in zip(names, 1.14 * max(base, star) * geometry.v, strict=True):
        axes.text(*point, name, ha="center", va="center")
    several = len(solutions) > 1
    for solution, looks in zip(solutions, LINES, strict=False):
        name = solution.name if several else "path of E"
        given = looks if several else {"color": BLUE, "linewidth": 1.8}
        axes.plot(*solution.position(scene).T, label=name, **given)
    position = solutions[0].position(scene)
    known = position[np.isfinite(position[:, 0])]
    style.mark_ends(axes, *known.T)
    axes.set(xlabel="x [m]", ylabel="y [m]", zlabel="z [m]")
    axes.set_box_aspect((1, 1, 1))
    shown = np.concatenate([base * outline, star * outline, known])
    middle, reach = 0.5 * (shown.min(axis=0) + shown.max(axis=0)), np.ptp(shown, axis=0).max()
    low, high = middle - 0.5 * reach, middle + 0.5 * reach
    axes.set(**dict(zip(("xlim", "ylim", "zlim"), zip(low, high, strict=True), strict=True)))
    x, y, z = geometry.v.sum(axis=0)
    height, azimuth = np.degrees(np.arctan2(z, np.hypot(x, y))), np.degrees(np.arctan2(y, x))
    axes.view_init(elev=height - 8.0, azim=azimuth + 8.0)
    for axis in (axes.xaxis, axes.yaxis, axes.zaxis):
        axis.set_major_locator(MaxNLocator(5, steps=[1, 2, 5, 10], prune="both"))
    axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.06), ncol=3, fontsize=9)
    return figure
