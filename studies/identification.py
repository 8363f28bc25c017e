# SPDX-License-Identifier: Apache-2.0
"""The demo of identification: a wrong model, an exciting motion, and the identified model.

The nodes follow a designed motion with a model that is wrong, and record it. From the recording, as
encoders and torque sensors would give it, the model is identified; then the nodes follow another
motion with either model.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from sst_ros.control.reference_motions import reference_motion
from sst_ros.control.tracking import TrackingRecord
from sst_ros.demo import CONTROL_RATE, FOLLOWED, HOLD_S, empty_bag, follow
from sst_ros.identification.excitation import design
from sst_ros.identification.identify import identify
from sst_ros.identification.parameters import INERTIA, value_of
from sst_ros.plot.style import BLUE, SMALLEST_SHOWN, VERMILION, legend, save_figure, stack, styled
from sst_ros.recording.recording import read as read_bag
from sst_ros.report import tracking
from sst_ros.scene.scene import Scene, load
from sst_ros.scene.yaml_document import dump
from studies import parser, run

SHARE = 0.2
"""Part by which the inertia of each kind of body differs from the model."""

GUESS = {"gamma": {"viscous": 0.1, "coulomb": 0.1, "smoothing": 0.05}}
"""Friction of the model: half of what the actuators have, and none in the passive joints."""

UNKNOWN = ("star", "actuated_links", "intermediate_links", "friction.gamma",
           "friction.mu.viscous", "friction.beta.viscous")  # fmt: skip
COUNTS, NOISE = 65536, 0.01
"""Steps of an encoder per turn, and noise of the torques over their largest value."""

MODE = "feedforward_pd"
PICTURE, TABLE = "identification.png", "identification.txt"


def identification(out: Path, name: str = FOLLOWED) -> bool:
    """Identify a plant with wrong inertias and friction, and follow a motion before and after.

    Results lie in `out`: the scenes plant, model, exciting and identified, three bags, the table
    and the picture.

    Raises:
        SstError: a node failed or a motion is refused; names it.

    """
    out.mkdir(parents=True, exist_ok=True)
    given = load(name)
    model = dataclasses.replace(given.with_values({"friction": GUESS}), name=f"{name}_model")
    plant = unknown(given)
    designed = design(model, UNKNOWN)
    for key, scene in {"plant": plant, "model": model, "exciting": designed.scene}.items():
        (out / f"{key}.yaml").write_text(dump(scene), encoding="utf-8")
    print(f"{name}: bodies of the plant differ by {SHARE:.0%}, friction is not known", flush=True)
    _follow(out, "exciting")
    found = identify(measured(out / "exciting" / "bag"), model, UNKNOWN)
    identified = dataclasses.replace(found.scene, name=f"{name}_identified")
    (out / "identified.yaml").write_text(dump(identified), encoding="utf-8")
    print(found.table(), flush=True)
    for key in ("model", "identified"):
        _follow(out, key)
    print(compare(out, found.table()), flush=True)
    return True


def unknown(scene: Scene, share: float = SHARE) -> Scene:
    """Return a plant whose bodies differ from those of a scene: two kinds heavier, one lighter."""
    signs = {"star": 1.0, "actuated_links": -1.0, "intermediate_links": 1.0}
    parts = ("mass", *(f"inertia.{part}" for part in INERTIA))
    values = {
        f"{body}.{part}": (value_of(scene, f"{body}.{part}") or 0.0) * (1.0 + sign * share)
        for body, sign in signs.items() for part in parts
    }  # fmt: skip
    return dataclasses.replace(scene.with_values(values), name=f"{scene.name}_plant")


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


def compare(out: Path, identified: str) -> str:
    """Write the table and the picture of the tracking errors before and after; return the table."""
    folders = {"with the wrong model": "model", "with the identified model": "identified"}
    runs = {
        label: tracking.read_tracking(out / folder / "bag") for label, folder in folders.items()
    }
    lines, rms = [f"{'tracking error of gamma [rad]':32}{'RMS':>12}{'largest':>12}"], []
    for label, followed in runs.items():
        found = followed.metrics
        rms.append(float(np.sqrt(np.mean(found.rms**2))))
        lines.append(f"{label:32}{rms[-1]:12.3e}{found.largest.max():12.3e}")
    lines.append(f"{'ratio':32}{rms[0] / rms[1]:12.1f}")
    text = "\n".join(lines)
    (out / TABLE).write_text(f"{identified}\n{text}\n", encoding="utf-8")
    tracks = {label: followed.track for label, followed in runs.items()}
    title = f"Tracking error, {MODE.replace('_', ' + ')}: RMS {rms[0]:.1e} to {rms[1]:.1e} rad"
    save_figure(draw_tracking_errors(tracks, title), out / PICTURE)
    return text


@styled
def draw_tracking_errors(tracks: Mapping[str, TrackingRecord], title: str) -> Figure:
    """Draw the largest tracking error of the three joints over time, a curve for each run."""
    figure, (axes,) = stack(["largest error of γ [rad]"], 2.6)
    errors = {label: np.abs(track.error).max(axis=1) for label, track in tracks.items()}
    for (label, error), colour in zip(errors.items(), (VERMILION, BLUE), strict=True):
        shown = np.maximum(error, SMALLEST_SHOWN)
        axes.semilogy(tracks[label].time, shown, color=colour, linewidth=1.6, label=label)
    axes.set_ylim(min(float(np.quantile(error, 0.05)) for error in errors.values()) / 3.0,
                  max(float(error.max()) for error in errors.values()) * 2.0)  # fmt: skip
    axes.set_title(title, pad=22)
    legend(axes)
    return figure


def _follow(out: Path, model: str) -> None:
    """Follow the motion of a model's scene on the plant, and record it in a folder of its name."""
    path = out / f"{model}.yaml"
    seconds = reference_motion(load(path)).duration + HOLD_S
    seconds = math.ceil(seconds * CONTROL_RATE) / CONTROL_RATE
    bag = empty_bag(out / model)
    print(f"{model}: following for {seconds:g} s", flush=True)
    follow(str(out / "plant.yaml"), bag, MODE, seconds, model=str(path))


def main(words: Sequence[str] | None = None) -> int:
    """Run the demo from the command line."""
    what = "A model identified from a recorded motion, and the tracking error before and after."
    arguments = parser("identification", what, Path("demo_out/identify"))
    return run(lambda given: identification(given.out), arguments, words, careful=True)


if __name__ == "__main__":
    raise SystemExit(main())
