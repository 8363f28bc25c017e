# SPDX-License-Identifier: Apache-2.0
"""The pictures of a run: the paper's Figs. 8 to 14, the torques, and error over run time."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from sst_ros.mechanism.frames import rotation_matrix, zyz_angles
from sst_ros.mechanism.geometry import Array, Geometry
from sst_ros.recording.recording import Recording
from sst_ros.recording.time_series import NANOSECONDS, Integers
from sst_ros.report.reference import Comparison, Deviation
from sst_ros.scene.scene import Scene

BLUE, VERMILION, GREEN, GREY = "#0072B2", "#D55E00", "#009E73", "#666666"
"""Colours that the colour-blind can tell apart (Okabe and Ito); line styles tell them apart too."""

LINES: tuple[dict[str, Any], ...] = (
    {"color": BLUE, "linestyle": "-", "linewidth": 2.6},
    {"color": VERMILION, "linestyle": "--", "linewidth": 1.8},
    {"color": GREEN, "linestyle": ":", "linewidth": 1.8},
)
"""Curves that may coincide: each is thinner than the one below it, so that all can be seen."""

STYLE: Any = {
    "figure.dpi": 150,
    "savefig.dpi": 150,
    "figure.constrained_layout.use": True,
    "font.size": 10,
    "axes.titlesize": 11,
    "axes.grid": True,
    "axes.formatter.useoffset": False,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "grid.alpha": 0.35,
    "legend.framealpha": 0.85,
    "lines.solid_capstyle": "butt",
}

NUMBERS = {
    "example1": {"position_of_E": 8, "psi": 9},
    "example2": {"path_of_E": 10, "position_of_E": 11, "theta": 12, "phi": 13, "psi": 14},
}
"""Which picture is which figure of the paper, by the name of the scene."""

TITLES = {
    "path_of_E": "Path of point E",
    "position_of_E": "Position of point E",
    "theta": "The angle θ",
    "phi": "The angle φ",
    "psi": "The angle ψ",
    "torques": "Applied torques",
    "error": "Error over the time of the run",
}

SIZE = (7.0, 4.2)
SMALLEST_SHOWN = 1e-17


def draw(
    recording: Recording, integration: Comparison, ideal: Comparison | None, out: Path
) -> list[Path]:
    """Write all pictures of a run as PNG files into the folder `out` and return their paths."""
    scene, seconds, ticks = recording.scene, recording.seconds, recording.ticks
    position = scene.star.radius * rotations(recording.quaternion)[:, :, 2]
    degrees = angles(recording.quaternion, recording.euler)
    pictures: dict[str, Callable[[], Figure]] = {
        "path_of_E": lambda: path(scene, position),
        "position_of_E": lambda: position_of_e(seconds, position),
        "theta": lambda: angle(seconds, degrees, 0),
        "phi": lambda: angle(seconds, degrees, 1),
        "psi": lambda: angle(seconds, degrees, 2),
        "torques": lambda: torques(ticks.start_ns, ticks.end_ns, ticks.torque),
        "error": lambda: _errors(seconds, integration, ideal),
    }
    paths = []
    with mpl.rc_context(STYLE):
        for name, make in pictures.items():
            figure = make()
            numbered, title = named(name, scene.name)
            figure.suptitle(title, fontsize=11)
            paths.append(out / f"{numbered}.png")
            figure.savefig(paths[-1])
    return paths


def named(name: str, scene: str | None) -> tuple[str, str]:
    """Name the file and the title of one of TITLES; the paper's figures bear their numbers."""
    title = TITLES[name] + (f", {scene}" if scene else "")
    number = NUMBERS.get(scene or "", {}).get(name)
    if number is None:
        return name, title
    return f"fig{number:02d}_{name}", f"{title} (Fig. {number} of the paper)"


def rotations(quaternion: Array) -> Array:
    """Rotations R, shape (n, 3, 3), of quaternions (n, 4); nan stays nan."""
    result = np.full((len(quaternion), 3, 3), np.nan)
    whole = np.isfinite(quaternion[:, 0])
    result[whole] = rotation_matrix(quaternion[whole])
    return result


def angles(quaternion: Array, euler: Array) -> Array:
    """ZYZ angles [deg] without jumps, shape (n, 3): as recorded, else of the orientation."""
    recorded = np.where(np.isfinite(euler), euler, zyz_angles(rotations(quaternion)))
    return np.asarray(np.degrees(_unwrapped(recorded)))


def position_of_e(seconds: Array, position: Array) -> Figure:
    """Draw the coordinates of E [m], shape (n, 3), over time."""
    return curves(seconds, position, ("x", "y", "z"), "position of E in {B} [m]", 0.05)


def angle(seconds: Array, degrees: Array, which: int) -> Figure:
    """Draw one of the ZYZ angles [deg], shape (n, 3), over time."""
    letter = "θφψ"[which]
    return curves(seconds, degrees[:, which : which + 1], (letter,), f"{letter} [deg]", 1.0)


def curves(
    seconds: Array, values: Array, names: Sequence[str], label: str, least_span: float
) -> Figure:
    """Draw columns over time; an axis never shows less than `least_span`, so rounding is flat."""
    figure = Figure(figsize=SIZE)
    axes = figure.subplots()
    for column, name, line in zip(values.T, names, LINES, strict=False):
        axes.plot(seconds, column, label=name, **line)
    low, high = float(np.nanmin(values)), float(np.nanmax(values))
    if high - low < least_span:
        middle = 0.5 * (low + high)
        axes.set_ylim(middle - 0.5 * least_span, middle + 0.5 * least_span)
    axes.set_xlim(seconds[0], seconds[-1])
    axes.set_xlabel("time t [s]")
    axes.set_ylabel(label)
    if len(names) > 1:
        legend_above(axes)
    return figure


def torques(start_ns: Integers, end_ns: Integers, torque: Array) -> Figure:
    """Draw the torques of ticks [N m], shape (n, 3), as they were held."""
    return curves(*held(start_ns, end_ns, torque), ("τ₁", "τ₂", "τ₃"), "torque τ [N m]", 0.1)


def held(start_ns: Integers, end_ns: Integers, values: Array) -> tuple[Array, Array]:
    """Return times [s] and values that draw what each tick held; a gap is nan."""
    times = np.stack([start_ns, end_ns], axis=1).ravel() / NANOSECONDS
    steps = np.repeat(values, 2, axis=0)
    gaps = 2 * (np.flatnonzero(start_ns[1:] != end_ns[:-1]) + 1)
    return np.insert(times, gaps, times[gaps]), np.insert(steps, gaps, np.nan, axis=0)


def path(scene: Scene, position: Array) -> Figure:
    """Draw E over the base triangle, both at their own radius, and the triangle's image at E's."""
    figure = Figure(figsize=(6.4, 5.8))
    axes = figure.add_subplot(projection="3d")
    geometry = Geometry.of(scene)
    base, star = scene.base.radius, scene.star.radius
    outline = triangle(geometry)
    axes.plot(*(base * outline).T, color=GREY, linewidth=1.6, label="base triangle P₁P₂P₃")
    if star != base:
        image = "its image on the sphere of E"
        axes.plot(*(star * outline).T, color=GREY, linewidth=0.9, linestyle=":", label=image)
    for index, point in enumerate(1.08 * max(base, star) * geometry.v):
        axes.text(*point, f"P{'₁₂₃'[index]}", ha="center", va="center")
    axes.plot(*position.T, color=BLUE, linewidth=1.8, label="path of E")
    whole = position[np.isfinite(position[:, 0])]
    axes.plot(*whole[:1].T, "o", color=GREEN, markersize=7, label="start", linestyle="none")
    axes.plot(*whole[-1:].T, "s", color=VERMILION, markersize=5, label="end", linestyle="none")
    axes.set(xlabel="x [m]", ylabel="y [m]", zlabel="z [m]")
    axes.set_box_aspect((1, 1, 1))
    shown = np.concatenate([base * outline, star * outline, whole])
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
    axes.legend(loc="upper center", bbox_to_anchor=(0.5, 0.0), ncol=3, fontsize=9)
    return figure


def _errors(seconds: Array, integration: Comparison, ideal: Comparison | None) -> Figure:
    """Draw (a) and (b), each over the error of its reference, on logarithmic axes."""
    panels = [("(a) integration error, against the same torques", integration)]
    if ideal is not None:
        panels.append(("(b) against continuous torques", ideal))
    figure = Figure(figsize=(7.0, 1.0 + 3.1 * len(panels)))
    grid = figure.subplots(len(panels), 1, sharex=True, squeeze=False)
    for axes, (title, comparison) in zip(grid[:, 0], panels, strict=True):
        floor = np.fmax.reduce(_columns(comparison.own))
        axes.fill_between(
            seconds, SMALLEST_SHOWN, np.fmax(floor, SMALLEST_SHOWN), color=GREY, alpha=0.3,
            linewidth=0.0, label="reference's own error (largest of the three)",
        )  # fmt: skip
        names = ("γ [rad]", "γ̇ [rad/s]", "orientation [rad]")
        for values, name, line in zip(_columns(comparison.error), names, LINES, strict=True):
            axes.plot(seconds, np.where(values > 0.0, values, np.nan), label=name, **line)
        axes.set_yscale("log")
        axes.set_title(title, loc="left")
        axes.set_ylabel("largest difference")
        axes.set_xlim(seconds[0], seconds[-1])
        axes.set_ylim(bottom=SMALLEST_SHOWN)
    grid[-1, 0].set_xlabel("time t [s]")
    grid[0, 0].legend(loc="lower right", fontsize=8, ncol=2)
    return figure


def _columns(deviation: Deviation) -> tuple[Array, Array, Array]:
    return deviation.gamma, deviation.gamma_dot, deviation.orientation


def legend_above(axes: Axes) -> None:
    """Put the legend where no curve can be."""
    axes.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), ncol=3, borderaxespad=0.2)


def triangle(geometry: Geometry) -> Array:
    """Points of the closed base triangle on the unit sphere, shape (n, 3)."""
    share = np.linspace(0.0, 1.0, 40)[:, None]
    sides = []
    for k in range(3):
        angle: Array = geometry.arc[k] * share
        across = np.cross(geometry.w[k], geometry.v[k])
        sides.append(np.cos(angle) * geometry.v[k] + np.sin(angle) * across)
    return np.asarray(np.concatenate(sides))


def _unwrapped(angles: Array) -> Array:
    """Take out whole turns between samples, over lost samples too; shape (n, 3)."""
    result: Array = angles.copy()
    for column in range(3):
        known = np.isfinite(result[:, column])
        result[known, column] = np.unwrap(result[known, column])
    return result
