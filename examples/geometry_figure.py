# SPDX-License-Identifier: Apache-2.0
"""Draw the manipulator with the names of its angles and vectors, from its own kinematics.

    python examples/geometry_figure.py [geometry.png]

docs/geometry.png is this picture.
"""

import sys

import numpy as np
from matplotlib.figure import Figure

from sst_ros import load_scene
from sst_ros.mechanism import kinematics
from sst_ros.mechanism.geometry import Geometry
from sst_ros.plot.paper_figures import BLUE, GREEN, GREY, VERMILION

GAMMA = np.array([0.95, 0.62, 0.80])  # rad
INK = "#222222"
VIEW = np.array([1.0, 0.72, 0.42])


def along(start, end, share=1.0, points=60):
    """Points of the great circle from one unit vector towards another, shape (points, 3)."""
    angle = np.arccos(np.clip(start @ end, -1.0, 1.0))
    across = end - (start @ end) * start
    across /= np.linalg.norm(across)
    turn = np.linspace(0.0, share * angle, points)[:, None]
    return np.cos(turn) * start + np.sin(turn) * across


class Sheet:
    """The sphere seen from afar along VIEW."""

    def __init__(self, axes):
        self.axes = axes
        out = VIEW / np.linalg.norm(VIEW)
        right = np.cross([0.0, 0.0, 1.0], out)
        self.right = right / np.linalg.norm(right)
        self.up = np.cross(out, self.right)

    def flat(self, points):
        """Project points, shape (..., 3), to (..., 2)."""
        points = np.asarray(points)
        return np.stack([points @ self.right, points @ self.up], axis=-1)

    def curve(self, points, **style):
        """Draw a curve of points, shape (n, 3)."""
        self.axes.plot(*self.flat(points).T, **style)

    def arrow(self, start, end, colour, label, shift):
        """Draw a vector with its name beside its tip."""
        a, b = self.flat(start), self.flat(end)
        style = {"arrowstyle": "-|>", "color": colour, "lw": 1.3, "shrinkA": 0, "shrinkB": 0}
        self.axes.annotate("", b, a, arrowprops=style)
        self.text(end, label, shift, colour)

    def text(self, at, label, shift, colour=INK, size=13):
        """Write a name beside a point."""
        place = self.flat(at) + np.asarray(shift)
        self.axes.text(*place, label, color=colour, fontsize=size, ha="center", va="center")


def draw(path):
    """Draw one pose of the paper's isotropic manipulator."""
    geometry = Geometry.of(load_scene("example2"))
    rotation = kinematics.admissible(geometry, GAMMA).rotation
    s, r = rotation[:, 2], kinematics.carriage_directions(geometry, GAMMA)
    t = geometry.e @ rotation.T
    figure = Figure(figsize=(7.4, 6.6), layout="constrained")
    axes = figure.subplots()
    sheet = Sheet(axes)
    turn = np.linspace(0.0, 2.0 * np.pi, 200)
    axes.plot(np.cos(turn), np.sin(turn), color="#cccccc", lw=1.0)
    origin = np.zeros(3)
    for k in range(3):
        v, after = geometry.v[k], geometry.v[(k + 1) % 3]
        sheet.curve(along(v, after), color=GREY, lw=2.2)
        sheet.curve(along(v, r[k]), color=BLUE, lw=4.0, alpha=0.85)
        sheet.curve([origin, v], color=GREY, lw=0.8, ls=":")
        sheet.text(v, f"$P_{k + 1}$", 0.075 * sheet.flat(v) / np.linalg.norm(sheet.flat(v)))
        reach = min(1.45, np.pi / 2.2 / np.arccos(s @ r[k]))
        sheet.curve(along(s, r[k], reach), color=VERMILION, lw=2.0, ls="--")
        sheet.curve(along(s, r[k]), color=VERMILION, lw=2.6)
        axes.plot(*sheet.flat(r[k]), "s", color=INK, ms=7)
    axes.plot(*sheet.flat(s), "o", color=INK, ms=8)
    sheet.arrow(origin, s, INK, "$\\mathbf{s}$", (-0.10, -0.02))
    sheet.arrow(origin, r[0], INK, "$\\mathbf{r}_1$", (-0.28, 0.19))
    sheet.arrow(origin, 0.55 * geometry.w[0], BLUE, "$\\mathbf{w}_1$", (0.05, 0.02))
    sheet.arrow(origin, 0.55 * t[0], VERMILION, "$\\mathbf{t}_1$", (0.05, -0.03))
    sheet.text(along(geometry.v[0], r[0])[34], "$\\gamma_1$", (-0.02, -0.075), BLUE, 15)
    sheet.text(along(s, r[0])[26], "$\\beta_1$", (0.06, -0.03), VERMILION, 15)
    for k, label in ((1, "$\\gamma_2$"), (2, "$\\gamma_3$")):
        middle = along(geometry.v[k], r[k])[30]
        sheet.text(middle, label, 0.085 * sheet.flat(middle) / np.linalg.norm(sheet.flat(middle)),
                   BLUE, 15)  # fmt: skip
    _angle(sheet, s, r[0], r[1], 0.13, GREEN, "$\\alpha_1$", 0.20)
    _angle(sheet, r[0], geometry.v[0], s, 0.13, GREEN, "$\\mu_1$", 0.21)
    sheet.text(s, "$E$", (0.03, 0.06))
    sheet.text(r[0], "$R_1$", (0.075, -0.05))
    sheet.text(r[1], "$R_2$", (0.085, 0.0))
    sheet.text(r[2], "$R_3$", (-0.075, 0.03))
    sheet.text(origin, "$O$", (-0.05, -0.05))
    for colour, width, style, label in (
        (GREY, 2.2, "-", "base: fixed spherical triangle"),
        (BLUE, 4.0, "-", "stroke of an actuator: from $P_k$ to its carriage $R_k$"),
        (VERMILION, 2.6, "--", "star: three arcs that slide through the carriages"),
    ):
        axes.plot([], [], color=colour, lw=width, ls=style, label=label)
    axes.legend(loc="upper center", bbox_to_anchor=(0.5, 0.02), frameon=False, fontsize=10)
    axes.set_aspect("equal")
    axes.set_axis_off()
    figure.savefig(path, dpi=150)


def _angle(sheet, at, first, second, radius, colour, label, place):
    """Draw the angle at a point of the sphere between two great circles."""
    a, b = (along(at, end)[-1] - (along(at, end)[-1] @ at) * at for end in (first, second))
    a, b = a / np.linalg.norm(a), b / np.linalg.norm(b)
    fan = along(a, b)
    sheet.curve(np.cos(radius) * at + np.sin(radius) * fan, color=colour, lw=1.8)
    sheet.text(np.cos(place) * at + np.sin(place) * fan[30], label, (0, 0), colour, 14)


if __name__ == "__main__":
    draw(sys.argv[1] if len(sys.argv) > 1 else "geometry.png")
