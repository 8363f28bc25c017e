# SPDX-License-Identifier: Apache-2.0
"""Every picture of a recorded run: what it shows, what it needs, how it is drawn."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import NamedTuple

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure

from sst_ros.errors import InputError, Problem
from sst_ros.output_folder import writing
from sst_ros.plot import control, energy, motion, paper_figures, sphere
from sst_ros.recording.signals import Signals
from sst_ros.recording.topic_tables import SCENE
from sst_ros.scene.scene import Scene

FORMATS = ("pdf", "png")


class Picture(NamedTuple):
    """A picture of a run.

    Attributes:
        title: what it shows.
        needs: keys of the topics without which it cannot be drawn.
        make: draws it; the scene is there if it is needed.

    """

    title: str
    needs: tuple[str, ...]
    make: Callable[[Signals, Scene], Figure]


def _position(run: Signals, scene: Scene) -> np.ndarray:
    return np.asarray(scene.star.radius * sphere.directions(run))


def _angle(which: int) -> Callable[[Signals, Scene | None], Figure]:
    def make(run: Signals, _: Scene | None) -> Figure:
        lost = np.full((len(run.seconds()), 3), np.nan)
        euler = run.take("theta", "phi", "psi") if "euler_zyz" not in run.missing else lost
        degrees = paper_figures.angles(run.take("q_x", "q_y", "q_z", "q_w"), euler)
        return paper_figures.angle(run.seconds(), degrees, which)

    return make


JOINTS, TURN, TICKS, S = "joint_states", "orientation", "applied_torques", SCENE.key
PICTURES = {
    "path_of_E": Picture(
        "Path of point E",
        (TURN, S),
        lambda run, scene: paper_figures.path(scene, _position(run, scene)),
    ),
    "position_of_E": Picture(
        "Position of point E", (TURN, S),
        lambda run, scene: paper_figures.position_of_e(run.seconds(), _position(run, scene)),
    ),
    "theta": Picture("The angle θ", (TURN,), _angle(0)),
    "phi": Picture("The angle φ", (TURN,), _angle(1)),
    "psi": Picture("The angle ψ", (TURN,), _angle(2)),
    "tracking": Picture(
        "Desired and measured angles", (JOINTS, "reference"), control.tracking
    ),
    "tracking_error": Picture("Tracking error", ("tracking_error",), control.tracking_error),
    "control_torques": Picture(
        "Torques of the controller", ("reference", "tracking_error"), control.control_torques
    ),
    "torques": Picture("Torques", (TICKS,), control.applied_and_commanded),
    "power": Picture("Power of the actuators", (JOINTS,), energy.power),
    "work": Picture("Work of the actuators", (JOINTS, TICKS), energy.actuator_work),
    "energy": Picture("Energy", (JOINTS, TURN, TICKS, S), energy.energy),
    "joint_angles": Picture("Joint angles", (JOINTS,), motion.joint_angles),
    "joint_rates": Picture("Joint rates", (JOINTS,), motion.joint_rates),
    "phase": Picture("Phase portraits of the actuators", (JOINTS,), motion.phase),
    "margins": Picture("Distance to the limits", (JOINTS, S), motion.margins),
    "sphere": Picture("Path of E in the workspace", (TURN, S), sphere.sphere),
}  # fmt: skip


def draw(run: Signals, out: Path, only: Sequence[str] = ()) -> tuple[list[Path], dict[str, str]]:
    """Write the pictures of a run as PDF and PNG into the folder `out`.

    Args:
        run: what was recorded.
        out: folder, made if it is not there.
        only: names of PICTURES; none for all that the bag allows.

    Returns:
        The paths written, and for each picture that could not be drawn what is missing.

    Raises:
        InputError: a name is unknown, or `out` cannot be written.

    """
    chosen = known(only, PICTURES) or list(PICTURES)
    paths: list[Path] = []
    missing: dict[str, str] = {}
    for name in chosen:
        picture = PICTURES[name]
        if absent := [key for key in picture.needs if key in run.missing]:
            missing[name] = "the bag has no " + ", no ".join(absent)
            continue
        scene = run.scene.name if run.scene else None
        stem, title = name, picture.title + (f", {scene}" if scene else "")
        if name in paper_figures.TITLES:
            stem, title = paper_figures.named(name, scene)
        with mpl.rc_context(paper_figures.STYLE):
            figure = picture.make(run, run.scene)  # type: ignore[arg-type]
            paths += save(figure, title, out, stem)
    return paths, missing


def save(figure: Figure, title: str, out: Path, stem: str) -> list[Path]:
    """Write a figure as PDF and PNG under a title.

    Raises:
        InputError: `out` cannot be written.

    """
    figure.suptitle(title, fontsize=11)
    paths = [out / f"{stem}.{form}" for form in FORMATS]
    with writing(out, "plot"):
        for path in paths:
            figure.savefig(path)
    return paths


def known(only: Iterable[str], names: Iterable[str]) -> list[str]:
    """Return the names that are asked for.

    Raises:
        InputError: one of them is none of `names`.

    """
    allowed = "must be one of " + ", ".join(names)
    problems = [Problem("only", name, allowed) for name in only if name not in names]
    if problems:
        raise InputError("plot", problems)
    return list(only)
