# SPDX-License-Identifier: Apache-2.0
"""Draw docs/readings.png: how well readings determine lost inertias.

Readings are of the paper's figures, the inertias those it does not give.
Run `python -m tools.reading_figure`.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure
from scipy.spatial.transform import Rotation

from benchmark.measure import DOCS
from sst_ros.figures import BLUE, GREY, INK, save_figure, styled
from sst_ros.identification.simulation_fit import describe_combination
from sst_ros.mechanism.geometry import Array, rotation_matrix, zyz_angles
from sst_ros.scene.scene import load
from sst_ros.scene.yaml_document import find_number
from sst_ros.simulation.simulate import simulate

ERROR = math.radians(1.0)
READINGS = 26
"""Points that one can read off a curve of a second."""

INERTIAS = {
    "star.inertia.xx": "I_{xx}",
    "star.inertia.yy": "I_{yy}",
    "star.inertia.zz": "I_{zz}",
    "actuated_links.inertia.zz": "I_a",
    "intermediate_links.inertia.xx": "I_{p,xx}",
    "intermediate_links.inertia.yy": "I_{p,yy}",
    "intermediate_links.inertia.zz": "I_{p,zz}",
}
ZYZ = "theta", "phi", "psi"
RATE = {"initial.gamma_dot": r"\dot{\gamma}"}
PANELS = (
    (
        "Fig. 9: ψ of Example 1; the initial rate is lost as well",
        "example1",
        ("psi",),
        True,
    ),
    (
        "Figs. 12 to 14: θ, φ, ψ of Example 2",
        "example2",
        ("theta", "phi", "psi"),
        False,
    ),
    ("Figs. 10, 11: position of E in Example 2", "example2", ("x", "y", "z"), False),
)
LEAST, MOST = 1e-3, 1e2
"""Range of the relative standard deviations that are shown."""


def determined(name: str, read: tuple[str, ...], rate: bool) -> tuple[list[str], Array]:
    """Return combinations of an example's lost numbers, and their relative deviations.

    Readings are of ZYZ angles, or of coordinates of E, whose error is that of an angle
    by the radius.
    """
    scene = load(name)
    words = INERTIAS | (RATE if rate else {})
    t = np.linspace(0.0, scene.duration or 1.0, READINGS + 1)[1:]
    motion = simulate(scene, t_eval=t, sensitivities=[*words])
    rotation = rotation_matrix(motion.quaternion)
    if read == ("x", "y", "z"):
        # of R z by turns in {E}
        by_turn = rotation @ np.cross(np.eye(3), [0.0, 0.0, 1.0]).T
    else:
        h = 1e-5  # of central differences [rad]: rounding and truncation are below 1e-9
        turns = Rotation.from_rotvec(h * np.vstack([np.eye(3), -np.eye(3)])).as_matrix()
        ahead, back = np.split(zyz_angles(rotation[:, None] @ turns), 2, axis=1)
        angles = np.angle(np.exp(1j * (ahead - back))).swapaxes(1, 2) / (2.0 * h)
        by_turn = angles[:, [ZYZ.index(key) for key in read]]
    # All legs alike: derivatives add up.
    slopes = np.stack(
        [
            find_number(scene, key) * motion.sensitivities[key].rotation.sum(axis=2)
            for key in words
        ],
        axis=2,
    )
    _, singular, rows = np.linalg.svd(
        (by_turn @ slopes).reshape(-1, len(words)) / ERROR
    )
    relative = 1.0 / np.maximum(singular, 1e-9)
    labels = (describe_combination(row, tuple(words.values())) for row in rows)
    powers = [re.sub(r"(\S+)\^([+-][\d.]+)", r"$\1^{\2}$", label) for label in labels]
    return powers, relative


@styled
def draw_determined(panels: Sequence[tuple[str, Sequence[str], Array]]) -> Figure:
    """Draw how well readings determine combinations of parameters.

    There is a panel for each figure read. It has a title, labels of the combinations
    and their relative standard deviations, rising; those beyond MOST are counted below
    the others.
    """
    known = [int(np.sum(deviations < MOST)) for _, _, deviations in panels]
    both = zip(known, panels, strict=True)
    rows = [count + (count < len(labels)) for count, (_, labels, _) in both]
    figure = Figure(figsize=(8.2, 1.2 + 0.3 * sum(rows) + 0.45 * len(rows)))
    grid = figure.subplots(
        len(panels), 1, sharex=True, squeeze=False, height_ratios=rows
    )[:, 0]
    every = zip(grid, known, rows, panels, strict=True)
    for axes, count, size, (name, labels, deviations) in every:
        places, shown = np.arange(count), deviations[:count]
        colours = [BLUE if value < 1.0 else GREY for value in shown]
        axes.barh(
            places, shown - LEAST, left=LEAST, height=0.62, log=True, color=colours
        )
        for place, value in zip(places.tolist(), shown.tolist(), strict=True):
            text = f"{value:.1%}" if value < 1.0 else "open"
            white = {"facecolor": "white", "edgecolor": "none", "pad": 0.8}
            axes.text(1.15 * value, place, text, va="center", fontsize=8, bbox=white)
        axes.axvline(1.0, color=INK, linewidth=0.9, linestyle="--", zorder=0)
        rest = f"{len(labels) - count} more combinations: not determined at all"
        axes.set_yticks(range(size), [*labels[:count], rest][:size], fontsize=8)
        axes.set_ylim(size - 0.5, -0.5)
        axes.grid(axis="y", visible=False)
        axes.set_title(name, fontsize=10)
        axes.set_xlim(LEAST, MOST)
    error = f"{READINGS} readings with an error of 1 deg"
    grid[-1].set_xlabel(f"relative standard deviation ({error})")
    title = "What readings of the figures determine: combinations of the lost numbers"
    figure.suptitle(title, fontsize=11)
    return figure


def main() -> None:
    """Draw and print."""
    panels = []
    for title, name, read, rate in PANELS:
        labels, relative = determined(name, read, rate)
        panels.append((title, labels, relative))
        for label, value in zip(labels, relative.tolist(), strict=True):
            print(f"{name} {value:10.3g}  {label}")
    save_figure(draw_determined(panels), DOCS / "readings.png")


if __name__ == "__main__":
    main()
