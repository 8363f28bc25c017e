# SPDX-License-Identifier: Apache-2.0
"""The registry of pictures of a recorded run: what each shows, what it needs, how it is drawn."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import NamedTuple

from matplotlib.figure import Figure

from sst_ros.errors import InputError, Problem
from sst_ros.host.output import write_into
from sst_ros.plot import motion, workspace
from sst_ros.plot.motion import Solution
from sst_ros.plot.style import envelope, save_figure, styled
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


def solution(run: Signals) -> Solution:
    """Return the recorded motion of the star."""
    quaternion = run.take("q_x", "q_y", "q_z", "q_w")
    euler = run.take("theta", "phi", "psi") if "euler_zyz" not in run.missing else None
    curves = quaternion.T if euler is None else [*quaternion.T, *euler.T]
    rows = envelope(curves, len(quaternion))
    shown = None if euler is None else euler[rows]
    return Solution("run", run.seconds()[rows], quaternion[rows], shown)


def _angle(which: int) -> Callable[[Signals, Scene | None], Figure]:
    return lambda run, _: motion.angle([solution(run)], which)


JOINTS, ORIENTATION, TICKS, S = "joint_states", "orientation", "applied_torques", SCENE.key
PICTURES = {
    "path_of_E": Picture(
        "Path of point E", (ORIENTATION, S),
        lambda run, scene: motion.path(scene, [solution(run)]),
    ),
    "position_of_E": Picture(
        "Position of point E", (ORIENTATION, S),
        lambda run, scene: motion.position_of_e(scene, [solution(run)]),
    ),
    "theta": Picture("The angle θ", (ORIENTATION,), _angle(0)),
    "phi": Picture("The angle φ", (ORIENTATION,), _angle(1)),
    "psi": Picture("The angle ψ", (ORIENTATION,), _angle(2)),
    "tracking": Picture("Desired and measured angles", (JOINTS, "reference"), motion.tracking),
    "tracking_error": Picture("Tracking error", ("tracking_error",), motion.tracking_error),
    "control_torques": Picture(
        "Torques of the controller", ("reference", "tracking_error"), motion.control_torques
    ),
    "torques": Picture("Torques", (TICKS,), motion.applied_and_commanded),
    "power": Picture("Power of the actuators", (JOINTS,), motion.power),
    "work": Picture("Work of the actuators", (JOINTS, TICKS), motion.actuator_work),
    "energy": Picture("Energy", (JOINTS, ORIENTATION, TICKS, S), motion.energy),
    "joint_angles": Picture("Joint angles", (JOINTS,), motion.joint_angles),
    "joint_rates": Picture("Joint rates", (JOINTS,), motion.joint_rates),
    "phase": Picture("Phase portraits of the actuators", (JOINTS,), motion.phase),
    "margins": Picture("Distance to the limits", (JOINTS, S), motion.margins),
    "sphere": Picture("Path of E in the workspace", (ORIENTATION, S), workspace.sphere),
}  # fmt: skip


@styled
def draw(
    run: Signals, out: Path, only: Sequence[str] = (), formats: Sequence[str] = FORMATS
) -> tuple[list[Path], dict[str, str]]:
    """Write the pictures of a run into the folder `out`.

    Args:
        run: the recorded topics.
        out: folder, made if it is not there.
        only: names of PICTURES; none for all that the bag allows.
        formats: suffixes of the files.

    Returns:
        The paths written, and for each picture that could not be drawn what is missing.

    Raises:
        InputError: a name is unknown, or `out` cannot be written.

    """
    paths: list[Path] = []
    missing: dict[str, str] = {}
    for name in known(only, PICTURES) or list(PICTURES):
        picture = PICTURES[name]
        if absent := [key for key in picture.needs if key in run.missing]:
            missing[name] = "the bag has no " + ", no ".join(absent)
            continue
        scene = run.scene.name if run.scene else None
        stem, title = motion.caption(name, picture.title, scene)
        figure = picture.make(run, run.scene)  # type: ignore[arg-type]
        paths += save(figure, title, out, stem, formats)
    return paths, missing


def save(
    figure: Figure, title: str, out: Path, stem: str, formats: Sequence[str] = FORMATS
) -> list[Path]:
    """Write a figure under a title, as PDF and PNG if `formats` names no others.

    Raises:
        InputError: `out` cannot be written.

    """
    figure.suptitle(title, fontsize=11)
    paths = [out / f"{stem}.{form}" for form in formats]
    with write_into(out, "plot"):
        save_figure(figure, *paths)
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
