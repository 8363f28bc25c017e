# SPDX-License-Identifier: Apache-2.0
"""The report of a run that tracked a reference, from its bag alone."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from sst_ros.control.tracking import table
from sst_ros.plot.run_figures import draw_tracking
from sst_ros.plot.style import save_figure
from sst_ros.report import tracking

PICTURE, TABLE = "tracking.png", "tracking.txt"


def report(bag: Path, out: Path) -> str:
    """Evaluate a recorded run: write the table and the picture into `out`, return the table.

    Raises:
        InputError: the bag is no whole recording of a run that tracked a reference.

    """
    tracked = tracking.read(bag)
    found = tracking.metrics(tracked)
    out.mkdir(parents=True, exist_ok=True)
    name = tracked.recording.scene.name
    lines = [f"Tracking of {name}, from {bag}", "", table(found)]
    if np.isfinite(tracked.orientation_error).any():
        worst = float(np.nanmax(tracked.orientation_error))
        lines.append(f"{'orientation, largest [rad]':26}{worst:10.3e}\n")
    text = "\n".join(lines)
    (out / TABLE).write_text(text, encoding="utf-8")
    title = f"Tracking of {name}: {found.seconds:g} s, {found.samples} samples"
    track = tracked.track
    figure = draw_tracking(
        track.time, track.gamma, track.error, tracked.orientation_error,
        (track.feedforward, track.feedback), title,
    )  # fmt: skip
    save_figure(figure, out / PICTURE)
    return text
