# SPDX-License-Identifier: Apache-2.0
"""Demo of identification: a wrong model, an exciting motion, the identified model.

The nodes follow a designed motion with a model that is wrong, and record it. From the
recording, as encoders and torque sensors would give it, the model is identified; then
the nodes follow another motion with either model.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from sst_ros.demo import FOLLOWED, follow
from sst_ros.figures import BLUE, VERMILION, hide_zeros, legend, stack, styled
from sst_ros.identification.excitation import design
from sst_ros.identification.identify import identify
from sst_ros.recording.recording import read as read_bag
from sst_ros.report import tracking
from sst_ros.report.results import publish
from sst_ros.scene.scene import Scene, load
from sst_ros.scene.yaml_document import dump
from studies import run
from studies.control_loop import SHARE, make_heavier

GUESS = {"gamma": {"viscous": 0.1, "coulomb": 0.1, "smoothing": 0.05}}
"""Friction of the model: half of the actuators', and none in the passive joints."""

UNKNOWN = ("star", "actuated_links", "intermediate_links", "friction.gamma",
           "friction.mu.viscous", "friction.beta.viscous")  # fmt: skip
COUNTS, NOISE = 65536, 0.01
"""Steps of an encoder per turn, and noise of the torques over their largest value."""

MODE = "feedforward_pd"


def identification(out: Path, name: str = FOLLOWED) -> bool:
    """Identify a plant, and follow a motion before and after.

    Inertias and friction of the first model are wrong. Results lie in `out`: the scenes
    plant, model, exciting and identified, three bags, the table and the picture.

    Raises:
        SstError: a node failed or a motion is refused; names it.

    """
    out.mkdir(parents=True, exist_ok=True)
    given = load(name)
    model = dataclasses.replace(
        given.with_values({"friction": GUESS}), name=f"{name}_model"
    )
    plant = unknown(given)
    designed = design(model, UNKNOWN)
    for key, scene in {
        "plant": plant,
        "model": model,
        "exciting": designed.scene,
    }.items():
        (out / f"{key}.yaml").write_text(dump(scene), encoding="utf-8")
    print(
        f"{name}: bodies of the plant differ by {SHARE:.0%}, friction is not known",
        flush=True,
    )
    _follow(out, "exciting")
    found = identify(measured(out / "exciting" / "bag"), model, UNKNOWN)
    identified = dataclasses.replace(found.scene, name=f"{name}_identified")
    (out / "identified.yaml").write_text(dump(identified), encoding="utf-8")
    print(found.table(), flush=True)
    for key in ("model", "identified"):
        _follow(out, key)
    print(compare(out, found.table()), flush=True)
    return True


def unknown(scene: Scene) -> Scene:
    """Return a scene's plant with other bodies: two kinds heavier, one lighter."""
    heavier = make_heavier(scene, 1.0 + SHARE, ("star", "intermediate_links"))
    plant = make_heavier(heavier, 1.0 - SHARE, ("actuated_links",))
    return dataclasses.replace(plant, name=f"{scene.name}_plant")


def measured(bag: Path, seed: int = 0) -> dict[str, object]:
    """Read a recording as encoders and torque sensors would have given it."""
    motion = read_bag(bag).trajectory
    step = 2.0 * math.pi / COUNTS
    noise = np.random.default_rng(seed).normal(size=(len(motion.t) - 1, 3))
    torque = motion.torque[1:] + noise * NOISE * np.abs(motion.torque).max(axis=0)
    return {
        "t": motion.t, "gamma": step * np.round(motion.gamma / step), "torque": torque,
        "held": True, "quaternion": motion.quaternion[0],
    }  # fmt: skip


@styled
def compare(out: Path, identified: str) -> str:
    """Write the table and the picture of the tracking errors before and after.

    Return the table.
    """
    lines, rms = [f"{'tracking error of gamma [rad]':32}{'RMS':>12}{'largest':>12}"], []
    figure, (axes,) = stack(["largest error of γ [rad]"], 2.6)
    for kind, folder, colour in (
        ("wrong", "model", VERMILION),
        ("identified", "identified", BLUE),
    ):
        followed = tracking.read_tracking(out / folder / "bag")
        found, label = followed.metrics, f"with the {kind} model"
        rms.append(float(np.sqrt(np.mean(found.rms**2))))
        lines.append(f"{label:32}{rms[-1]:12.3e}{found.largest.max():12.3e}")
        error = hide_zeros(np.abs(followed.track.error).max(axis=1))
        axes.semilogy(
            followed.track.time, error, color=colour, linewidth=1.6, label=label
        )
    text = "\n".join([*lines, f"{'ratio':32}{rms[0] / rms[1]:12.1f}"])
    named = f"Tracking error, {MODE.replace('_', ' + ')}"
    axes.set_title(f"{named}: RMS {rms[0]:.1e} to {rms[1]:.1e} rad", pad=22)
    legend(axes)
    publish(out, "identification", {".txt": f"{identified}\n{text}\n", ".png": figure})
    return text


def _follow(out: Path, model: str) -> None:
    """Follow the motion of a model's scene on the plant, and record it.

    The record lies in a folder of its name.
    """
    print(f"following {model}", flush=True)
    follow(str(out / "plant.yaml"), out / model, MODE, model=str(out / f"{model}.yaml"))


def main(words: Sequence[str] | None = None) -> int:
    """Run the demo from the command line."""
    out = Path("demo_out/identify")
    return run(
        lambda given: identification(given.out),
        "identification",
        out,
        words,
        careful=True,
    )


if __name__ == "__main__":
    raise SystemExit(main())
