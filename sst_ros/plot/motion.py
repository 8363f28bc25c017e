# SPDX-License-Identifier: Apache-2.0
"""The motion of the star in figures, Figs. 8 to 14 of the paper; energy and work of a run.

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
from scipy.interpolate import CubicHermiteSpline

from sst_ros.dynamics.kernel import kinetic_energy, model_of, potential_energy
from sst_ros.mechanism.frames import rotation_matrix, zyz_angles
from sst_ros.mechanism.geometry import Array, Geometry
from sst_ros.mechanism.rates import body_rates
from sst_ros.plot.style import (
    BLUE,
    GREY,
    LINES,
    Looks,
    hide_zeros,
    leg_names,
    legend,
    lines,
    mark_ends,
    sides,
    span,
    stack,
    widen,
)
from sst_ros.recording.recording import Signals
from sst_ros.scene.scene import Scene
from sst_ros.state import NANOSECONDS

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
    solutions: Sequence[Solution],
    values: Sequence[Array],
    letters: str,
    label: str,
    least_span: float,
) -> Figure:
    """Draw columns over time; differences from the first solution below where there are several."""
    first, unit = solutions[0], label.split("[")[1].rstrip("]")
    if len(solutions) == 1:
        figure, (axes,) = stack([label], 3.2)
        lines(axes, first.seconds, values[0], list(letters), least_span=least_span)
        return figure
    figure, (above, below) = stack([label, f"difference from\n{first.name} [{unit}]"], 2.7)
    for solution, columns, style in zip(solutions, values, LINES, strict=False):
        curves = above.plot(solution.seconds, columns, **style)
        curves[0].set_label(solution.name)
        if solution is first:
            continue
        at, here, there = np.intersect1d(
            np.round(first.seconds, 9), np.round(solution.seconds, 9), return_indices=True
        )
        apart = np.abs(columns[there] - values[0][here]).max(axis=1)
        common = np.isfinite(apart).any()
        largest = f"{np.nanmax(apart):.1e} {unit}" if common else "no common times"
        below.plot(at, hide_zeros(apart), label=f"{solution.name}: {largest}", **style)
    widen(above, values[0], least_span)
    beside: Looks = {"textcoords": "offset points", "va": "center", "annotation_clip": False}
    for letter, column in zip(letters, values[0].T, strict=True):
        known = np.flatnonzero(np.isfinite(column))
        if len(letters) > 1 and len(known):  # beside the last value, where there are several
            place = first.seconds[known[-1]], column[known[-1]]
            above.annotate(letter, place, (4, 0), **beside)
    legend(above)
    below.set_yscale("log")
    below.legend(fontsize=8, loc="best", title="largest difference", title_fontsize=8)
    span([above, below], first.seconds)
    return figure


def path(scene: Scene, solutions: Sequence[Solution]) -> Figure:
    """Draw E over the base triangle, both at their own radius, and the triangle's image at E's."""
    figure = Figure(figsize=(6.4, 6.4))
    axes = figure.add_subplot(projection="3d")
    geometry = Geometry.of(scene)
    base, star = scene.base.radius, scene.star.radius
    outline = np.concatenate(sides(geometry, 40))
    axes.plot(*(base * outline).T, color=GREY, linewidth=1.6, label="base triangle P₁P₂P₃")
    if star != base:
        image = {"linewidth": 0.9, "linestyle": ":", "label": "its image on the sphere of E"}
        axes.plot(*(star * outline).T, color=GREY, **image)
    for name, point in zip(leg_names("P"), 1.14 * max(base, star) * geometry.v, strict=True):
        axes.text(*point, name, ha="center", va="center")
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
    limits = np.stack([middle - reach, middle + reach], axis=1).tolist()
    axes.set(**dict(zip(("xlim", "ylim", "zlim"), limits, strict=True)))
    centre = geometry.v.sum(axis=0)
    azimuth = np.degrees(np.arctan2(centre[1], centre[0]))
    height = np.degrees(np.arctan2(centre[2], np.hypot(centre[0], centre[1])))
    axes.view_init(elev=height - 8.0, azim=azimuth + 8.0)
    for axis in (axes.xaxis, axes.yaxis, axes.zaxis):
        axis.set_major_locator(MaxNLocator(5, steps=[1, 2, 5, 10], prune="both"))
    axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.06), ncol=3, fontsize=9)
    return figure


def energies(run: Signals, scene: Scene) -> tuple[Array, Array]:
    """Kinetic and potential energy at each sample [J], shape (n,); nan where it was lost."""
    quaternion = run.take("q_x", "q_y", "q_z", "q_w")
    rates = [run.legs(name) for name in ("gamma_dot", "mu_dot", "beta_dot")]
    known = np.isfinite(np.concatenate([quaternion, *rates], axis=1)).all(axis=1)
    turned = body_rates(Geometry.of(scene), quaternion[known], *(rate[known] for rate in rates))
    model, state = model_of(scene), (*quaternion[known].T, *turned.T)
    result = np.full((2, len(known)), np.nan)
    result[0, known] = kinetic_energy(model, state)
    result[1, known] = potential_energy(model, state)
    return result[0], result[1]


def work(run: Signals) -> Array:
    """Work of each actuator from the first sample to each [J], shape (n, 3).

    A torque that is held over a tick does work by the angle of that tick. Angles at the ends of
    ticks between samples are those of the cubic through angles and rates of both; where ticks are
    lost the work is nan from there on.
    """
    time, gamma, rate = run.time_ns("samples"), run.legs("gamma"), run.legs("gamma_dot")
    start, torque = run.time_ns("ticks"), run.legs("tau", "ticks")
    end = start + run.take("length", table="ticks")[:, 0].astype(np.int64)
    known = np.isfinite(gamma).all(axis=1) & np.isfinite(rate).all(axis=1)
    if np.count_nonzero(known) < 2:
        return np.full(gamma.shape, np.nan)
    angles = CubicHermiteSpline(time[known] / NANOSECONDS, gamma[known], rate[known])
    steps = torque * (angles(end / NANOSECONDS) - angles(start / NANOSECONDS))
    steps[1:][start[1:] != end[:-1]] = np.nan
    steps[start < time[0]] = 0.0
    total = np.concatenate([np.zeros((1, 3)), np.cumsum(steps, axis=0)])
    done = np.searchsorted(end, time, side="right")
    whole = (time == time[0]) | np.isin(time, end)
    return np.asarray(np.where(whole[:, None], total[done], np.nan))
