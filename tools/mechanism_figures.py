# SPDX-License-Identifier: Apache-2.0
"""Draw the pictures of the mechanism: geometry.png and the paper's Figs. 4 to 7.

    python -m tools.mechanism_figures [FOLDER]

All directions come from the kinematics of one pose of the paper's isotropic
manipulator.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import FancyBboxPatch
from numpy.typing import ArrayLike

from sst_ros import load_scene
from sst_ros.figures import BLUE, GREEN, GREY, INK, VERMILION
from sst_ros.mechanism import kinematics
from sst_ros.mechanism.geometry import Array, Geometry
from sst_ros.mechanism.virtual_work import link_frames, posture

GAMMA = np.array([0.95, 0.62, 0.80])
"""The pose of all pictures [rad]: no two lines of geometry.png fall together in it."""
VIEW = (1.0, 0.72, 0.42)
HALO = {"facecolor": "white", "edgecolor": "none", "alpha": 0.85, "pad": 0.8}


def great_circle(
    start: Array, end: Array, share: float = 1.0, points: int = 60
) -> Array:
    """Return points of the great circle from one unit vector towards another.

    The shape is (points, 3).
    """
    angle = np.arccos(np.clip(start @ end, -1.0, 1.0))
    across = end - (start @ end) * start
    across = across / np.linalg.norm(across)
    turn = np.linspace(0.0, share * angle, points)[:, None]
    return np.asarray(np.cos(turn) * start + np.sin(turn) * across)


class SphereDrawing:
    """The unit sphere in parallel projection along a direction."""

    def __init__(self, axes: Axes, view: ArrayLike, *, outline: bool = True) -> None:
        self.axes = axes
        out = np.asarray(view, dtype=float) / np.linalg.norm(view)
        right = np.cross([0.0, 0.0, 1.0], out)
        self.right = right / np.linalg.norm(right)
        self.up = np.cross(out, self.right)
        if outline:
            turn = np.linspace(0.0, 2.0 * np.pi, 200)
            axes.plot(np.cos(turn), np.sin(turn), color="#cccccc", lw=1.0)
        axes.set_aspect("equal")
        axes.set_axis_off()

    def flat(self, points: ArrayLike) -> Array:
        """Project points, shape (..., 3), to (..., 2)."""
        given = np.asarray(points, dtype=float)
        return np.stack([given @ self.right, given @ self.up], axis=-1)

    def curve(self, points: ArrayLike, **style: object) -> None:
        """Draw a curve of points, shape (n, 3)."""
        flat = self.flat(points)
        self.axes.plot(flat[:, 0], flat[:, 1], **style)  # type: ignore[arg-type]

    def arrow(self, start: Array, end: Array, colour: str, label: str, shift: ArrayLike,
              width: float = 1.4) -> None:  # fmt: skip
        """Draw a vector with its name beside its tip."""
        a, b = self.flat(start), self.flat(end)
        style = {
            "arrowstyle": "-|>",
            "color": colour,
            "lw": width,
            "shrinkA": 0,
            "shrinkB": 0,
        }
        self.axes.annotate("", (b[0], b[1]), (a[0], a[1]), arrowprops=style)
        self.text(end, label, shift, colour)

    def text(self, at: Array, label: str, shift: ArrayLike, colour: str = INK,
             size: float = 13) -> None:  # fmt: skip
        """Write a name beside a point, on a white ground so that no line crosses it."""
        x, y = self.flat(at) + np.asarray(shift)
        self.axes.text(x, y, label, color=colour, fontsize=size, ha="center",
                       va="center", bbox=HALO, zorder=5)  # fmt: skip

    def legend(self, *entries: tuple[str, float, str, str]) -> None:
        """Explain lines below the drawing: colour, width, style, text of each."""
        for colour, width, style, label in entries:
            self.axes.plot([], [], color=colour, lw=width, ls=style, label=label)
        self.axes.legend(
            loc="upper center", bbox_to_anchor=(0.5, 0.02), frameon=False, fontsize=10
        )

    def outward(self, at: Array, length: float) -> Array:
        """Return the projected direction from the centre to a point, of this length."""
        flat = self.flat(at)
        return np.asarray(length * flat / np.linalg.norm(flat))


def _pose() -> tuple[Geometry, Array, Array, Array]:
    """Geometry, R, r (3, 3), t (3, 3) of the pose that all pictures show."""
    geometry = Geometry.of(load_scene("example2"))
    rotation = kinematics.admissible(geometry, GAMMA).rotation
    r = kinematics.carriage_directions(geometry, GAMMA)
    return geometry, rotation, r, geometry.e @ rotation.T


def _mechanism(sheet: SphereDrawing, *, labels: bool = True) -> None:
    """Draw the base triangle, the strokes, the star and its arcs."""
    geometry, rotation, r, _ = _pose()
    s, origin = rotation[:, 2], np.zeros(3)
    for k in range(3):
        v, after = geometry.v[k], geometry.v[(k + 1) % 3]
        sheet.curve(great_circle(v, after), color=GREY, lw=2.2)
        sheet.curve(great_circle(v, r[k]), color=BLUE, lw=4.0, alpha=0.85)
        sheet.curve([origin, v], color=GREY, lw=0.8, ls=":")
        reach = min(1.45, np.pi / 2.2 / np.arccos(s @ r[k]))
        sheet.curve(great_circle(s, r[k], reach), color=VERMILION, lw=2.0, ls="--")
        sheet.curve(great_circle(s, r[k]), color=VERMILION, lw=2.6)
        sheet.axes.plot(*sheet.flat(r[k]), "s", color=INK, ms=7)
        if labels:
            sheet.text(v, f"$P_{k + 1}$", sheet.outward(v, 0.085))
    sheet.axes.plot(*sheet.flat(s), "o", color=INK, ms=8)


def _angle(sheet: SphereDrawing, at: Array, first: Array, second: Array, radius: float,
           label: str, place: float, shift: ArrayLike = (0, 0)) -> None:  # fmt: skip
    """Draw the angle at a point of the sphere between two great circles."""
    a, b = (end - (end @ at) * at for end in (first, second))
    fan = great_circle(a / np.linalg.norm(a), b / np.linalg.norm(b))
    sheet.curve(np.cos(radius) * at + np.sin(radius) * fan, color=GREEN, lw=1.8)
    sheet.text(np.cos(place) * at + np.sin(place) * fan[30], label, shift, GREEN, 14)


def geometry_picture() -> Figure:
    """Draw the manipulator with the names of its angles and vectors."""
    geometry, rotation, r, t = _pose()
    s, origin = rotation[:, 2], np.zeros(3)
    figure = Figure(figsize=(7.4, 6.6), layout="constrained")
    sheet = SphereDrawing(figure.subplots(), VIEW)
    _mechanism(sheet)
    sheet.arrow(origin, s, INK, "$\\mathbf{s}$", (-0.13, 0.02))
    sheet.arrow(origin, r[0], INK, "$\\mathbf{r}_1$", (-0.28, 0.13))
    sheet.arrow(origin, 0.55 * geometry.w[0], BLUE, "$\\mathbf{w}_1$", (0.08, 0.02))
    sheet.arrow(origin, 0.55 * t[0], VERMILION, "$\\mathbf{t}_1$", (0.06, -0.045))
    sheet.text(
        great_circle(geometry.v[0], r[0])[34], "$\\gamma_1$", (-0.02, -0.085), BLUE, 15
    )
    sheet.text(great_circle(s, r[0])[28], "$\\beta_1$", (0.085, -0.05), VERMILION, 15)
    for k, label in ((1, "$\\gamma_2$"), (2, "$\\gamma_3$")):
        middle = great_circle(geometry.v[k], r[k])[30]
        sheet.text(middle, label, sheet.outward(middle, 0.1), BLUE, 15)
    _angle(sheet, s, r[0], r[1], 0.13, "$\\alpha_1$", 0.24, (0.02, 0.0))
    _angle(sheet, r[0], geometry.v[0], s, 0.13, "$\\mu_1$", 0.13, (-0.16, -0.015))
    shifts = (
        (0.03, 0.08),
        (0.085, -0.06),
        (0.11, -0.01),
        (-0.07, 0.085),
        (-0.06, -0.06),
    )
    for at, name, shift in zip(
        (s, *r, origin), ("E", "R_1", "R_2", "R_3", "O"), shifts, strict=True
    ):
        sheet.text(at, f"${name}$", shift)
    sheet.legend(
        (GREY, 2.2, "-", "base: fixed spherical triangle"),
        (BLUE, 4.0, "-", "stroke of an actuator: from $P_k$ to its carriage $R_k$"),
        (VERMILION, 2.6, "--", "star: three arcs that slide through the carriages"),
    )
    return figure


def frames_picture() -> Figure:
    """Fig. 4: base frame {B} and frame {E} of the star, both with their origin in O."""
    geometry, rotation, _, _ = _pose()
    figure = Figure(figsize=(7.0, 6.4), layout="constrained")
    sheet = SphereDrawing(figure.subplots(), VIEW)
    _mechanism(sheet, labels=False)
    base = np.stack(
        [geometry.v[0], np.cross(geometry.w[0], geometry.v[0]), geometry.w[0]]
    )
    for end, colour, name, shift in (
        (1.12 * base[0], BLUE, "$x$ along $v_1$", (-0.05, -0.07)),
        (1.12 * base[1], BLUE, "$y$", (0.08, -0.02)),
        (1.12 * base[2], BLUE, "$z$ along $w_1$", (0.06, 0.07)),
        (0.95 * rotation[:, 0], VERMILION, "$u = t_1 \\times s$", (-0.02, -0.07)),
        (0.95 * rotation[:, 1], VERMILION, "$v = t_1$", (0.09, -0.05)),
        (0.95 * rotation[:, 2], VERMILION, "$w = s$", (0.02, 0.1)),
    ):
        sheet.arrow(np.zeros(3), end, colour, name, shift, 2.2)
    sheet.legend(
        (BLUE, 2.2, "-", "{B}: fixed base frame"),
        (VERMILION, 2.2, "-", "{E}: frame of the star, $R = [u, v, w]$"),
    )
    return figure


def leg_frames_picture() -> Figure:
    """Fig. 5: the frames {0k}, {1k} and {2k} of leg 1."""
    geometry, _, _, _ = _pose()
    at = posture(geometry, GAMMA)
    first, second = link_frames(at)
    v, w = geometry.v[0], geometry.w[0]
    figure = Figure(figsize=(12.0, 4.4), layout="constrained")
    frames = (
        ("{0k}, fixed to the base", np.stack([v, np.cross(w, v), w], axis=1), GREY,
         ("$v_k$", "$w_k \\times v_k$", "$w_k$")),
        ("{1k}, actuated link: {0k} turned by $\\gamma_k$ about z", first[0], BLUE,
         ("$r_k$", "$w_k \\times r_k$", "$w_k$")),
        ("{2k}, intermediate link: {1k} turned by $-\\mu_k$ about x", second[0],
         VERMILION, ("$r_k$", "$t_k \\times r_k$", "$t_k$")),
    )  # fmt: skip
    for axes, (title, frame, colour, names) in zip(
        figure.subplots(1, 3), frames, strict=True
    ):
        sheet = SphereDrawing(axes, [0.9, 0.95, 0.55], outline=False)
        sheet.curve(great_circle(geometry.v[0], geometry.v[1]), color="#bbbbbb", lw=2.0)
        sheet.curve(
            great_circle(at.rotation[:, 2], at.r[0], 1.3), color="#f0b890", lw=2.0
        )
        sheet.axes.plot(*sheet.flat(at.r[0]), "s", color=INK, ms=6)
        sheet.text(at.r[0], "$R_k$", (0.2, 0.03), INK, 12)
        for axis, letter, name in zip(frame.T, "xyz", names, strict=True):
            end = 1.05 * axis
            # A name needs more room beside a tip than above it.
            shift = sheet.outward(end, 0.2) * (1.6 if len(name) > 6 else 1.0, 1.0)
            sheet.arrow(np.zeros(3), end, colour, f"${letter}$: {name}", shift, 2.2)
        axes.set_title(title, fontsize=10)
        axes.set_xlim(-1.5, 1.6)
        axes.set_ylim(-1.3, 1.4)
    return figure


def planes_picture() -> Figure:
    """Fig. 6: E is on the base triangle if above all three planes O P_k P_k+1."""
    geometry, rotation, _, _ = _pose()
    s = rotation[:, 2]
    figure = Figure(figsize=(10.5, 4.2), layout="constrained")
    sheets = [SphereDrawing(axes, VIEW) for axes in figure.subplots(1, 3)]
    for count, sheet in enumerate(sheets, 1):
        grid = _grid()
        inside = np.all(grid @ geometry.w[:count].T > 0, axis=1)
        front = grid @ np.cross(sheet.right, sheet.up) > 0
        flat = sheet.flat(grid[inside & front])
        sheet.axes.plot(flat[:, 0], flat[:, 1], ".", color="#cfe3f0", ms=2.5, zorder=0)
        for k in range(3):
            v, after = geometry.v[k], geometry.v[(k + 1) % 3]
            sheet.curve(
                great_circle(v, after), color=BLUE if k < count else "#bbbbbb", lw=2.4
            )
            sheet.curve([v, np.zeros(3)], color=GREY, lw=0.8, ls=":")
            sheet.text(v, f"$P_{k + 1}$", sheet.outward(v, 0.13), INK, 11)
        sheet.axes.plot(*sheet.flat(s), "o", color=VERMILION, ms=7)
        sheet.text(s, "$E$", (0.1, 0.09), VERMILION, 12)
        planes = ", ".join(f"$w_{k + 1}^T s > 0$" for k in range(count))
        sheet.axes.set_title(planes, fontsize=11)
    return figure


def _grid(count: int = 9000) -> Array:
    """Points spread evenly over the sphere (Fibonacci lattice), shape (count, 3)."""
    number = np.arange(count) + 0.5
    height, turn = 1.0 - 2.0 * number / count, np.pi * (1.0 + 5.0**0.5) * number
    width = np.sqrt(1.0 - height**2)
    return np.stack([width * np.cos(turn), width * np.sin(turn), height], axis=1)


STEPS = (
    (
        "torques, initial $\\dot\\gamma$, initial $\\gamma$",
        "scene, Simulation.step",
        "",
    ),
    ("direct kinematics", "kinematics.direct", "up to 8 orientations"),
    ("admissible solution", "kinematics.admissible", "Eq. 4"),
    ("direct velocity analysis", "virtual_work.posture", "Eqs. 9 to 23"),
    ("direct acceleration analysis", "virtual_work.bias", "Eqs. 24 to 49"),
    ("direct link Jacobian matrices", "virtual_work.link_jacobians", "Eqs. 50 to 62"),
    ("dynamics equations", "virtual_work.equation_of_motion", "Eqs. 63 to 92"),
    (
        "$\\ddot\\gamma$, integrated to the motion",
        "virtual_work.direct_dynamics",
        "Eq. 90",
    ),
)
"""The steps of Fig. 7, the functions that take them, and their equations."""


def flow_chart() -> Figure:
    """Fig. 7: the steps of the direct dynamics, with the functions that take them."""
    figure = Figure(figsize=(7.6, 7.4), layout="constrained")
    axes = figure.subplots()
    arrow = {"arrowstyle": "-|>", "color": INK, "lw": 1.2}
    for row, (step, function, equations) in enumerate(STEPS):
        y = -row
        axes.add_patch(
            FancyBboxPatch((0.0, y - 0.3), 3.6, 0.6,
                           boxstyle="round,pad=0.02,rounding_size=0.08",
                           facecolor="#eaf2f8", edgecolor=BLUE)
        )  # fmt: skip
        axes.text(1.8, y, step, ha="center", va="center", fontsize=11)
        axes.text(
            3.85, y + 0.1, function, va="center", fontsize=9.5, family="monospace"
        )
        axes.text(3.85, y - 0.15, equations, va="center", fontsize=9, color=GREY)
        if row:
            axes.annotate("", (1.8, y + 0.33), (1.8, y + 0.67), arrowprops=arrow)
    axes.set_xlim(-0.1, 7.0)
    axes.set_ylim(-len(STEPS) + 0.5, 0.5)
    axes.set_axis_off()
    return figure


PICTURES = {
    "geometry.png": geometry_picture,
    "paper_fig4.png": frames_picture,
    "paper_fig5.png": leg_frames_picture,
    "paper_fig6.png": planes_picture,
    "paper_fig7.png": flow_chart,
}


def main(folder: str = "docs") -> None:
    """Draw all pictures into a folder."""
    for name, draw in PICTURES.items():
        draw().savefig(Path(folder) / name, dpi=130)


if __name__ == "__main__":
    main(*sys.argv[1:])
