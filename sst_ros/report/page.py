# SPDX-License-Identifier: Apache-2.0
"""A recorded run on one page: the overview, and an HTML file that needs nothing beside it."""

from __future__ import annotations

import base64
import html
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from sst_ros.mechanism.geometry import Array
from sst_ros.plot.run_figures import (
    NOT_RECORDED,
    ErrorCurves,
    OverviewPanel,
    curve_panel,
    draw_error_panel,
    draw_latency,
    draw_losses,
    draw_overview,
    draw_pace,
    draw_periods,
    draw_used,
    missing,
)
from sst_ros.plot.style import positive
from sst_ros.recording.recording import Recording
from sst_ros.report.reference import Comparison
from sst_ros.report.text import made_line, table
from sst_ros.report.timing import Timing

ESTIMATES = (
    "integration error", "its estimate by the simulator",
    "hold error if torques are those of the start", "the same, of the middle",
)  # fmt: skip

_STYLE = """
body { font: 15px/1.45 system-ui, sans-serif; margin: 2em auto; max-width: 1100px; color: #222;
       padding: 0 1em; }
img { max-width: 100%; } pre { background: #f6f6f6; padding: 1em; overflow-x: auto;
       font-size: 12.5px; } .some { display: flex; flex-wrap: wrap; }
.some img { width: 50%; } footer { color: #666; font-size: 12px; }
"""


def error_curves(comparison: Comparison) -> ErrorCurves:
    """Return a comparison as curves."""
    error, own = comparison.error, comparison.own
    floor = np.fmax.reduce([own.gamma, own.gamma_dot, own.orientation])
    return ErrorCurves(error.gamma, error.gamma_dot, error.orientation, floor)


def overview(
    recording: Recording, integration: Comparison, timing: Timing, summary: dict[str, Any]
) -> Figure:
    """Draw a run on one page."""
    seconds, count = recording.seconds, len(recording.time_ns)
    losses: dict[str, tuple[Array, Array] | None] = {
        name: (np.sort(times), np.arange(1.0, len(times) + 1.0))
        for name, times in (("samples lost", timing.lost_s),
                            ("gaps between applied torques", timing.gaps_s))
    }  # fmt: skip
    at, missed, ticks, step_us, *estimates = timing.reported.T
    known, timed = np.isfinite(missed), step_us > 0.0
    losses["ticks missed"] = (at[known], missed[known]) if known.any() else None
    used = 1e-6 * ticks * step_us
    # Reports come once a second: between them, and from the start, the steps cost the same.
    at_samples = np.interp(seconds, [0.0, *at], [0.0, *used]) if len(at) else np.full(count, np.nan)
    found = np.fmax.accumulate(integration.error.orientation)
    errors = [(at_samples, found), *((used, estimate) for estimate in estimates)]
    drawn = any((np.isfinite(positive(y)) & np.isfinite(x)).any() for x, y in errors)
    error, latency, effort = error_curves(integration), timing.latency, recording.effort_difference
    return draw_overview(
        [
            OverviewPanel(
                "Integration error, against the same torques",
                partial(draw_error_panel, seconds=seconds, error=error, legend=True),
                "" if np.isfinite(error.gamma).any() else "nothing could be compared",
            ),
            curve_panel("Energy residual", "energy residual [J]", seconds, timing.energy),
            OverviewPanel(
                "Real-time factor (recorder clock)",
                partial(draw_pace, seconds=timing.pace_s, pace=timing.pace), missing(timing.pace),
            ),
            OverviewPanel(
                "Period between received samples",
                partial(draw_periods, period_us=timing.period_us, nominal_us=timing.nominal_us),
                missing(timing.period_us), over_time=False,
            ),
            OverviewPanel(
                "Cumulative losses", partial(draw_losses, losses=losses, end=seconds[-1])
            ),
            OverviewPanel(
                "Latency: reception of a command to the step that applies it",
                partial(draw_latency, seconds=latency.time_s, latency_us=latency.received_us),
                missing(latency.received_us),
            ),
            curve_panel(
                "Delay of samples", "delay, less the shortest [ms]", seconds, timing.late_us / 1e3
            ),
            curve_panel(
                "Effort of joint_states against applied torque", "largest difference [N m]",
                seconds, effort,
                reason=missing(effort) or ("" if np.nanmax(effort) else "no difference"),
            ),
            OverviewPanel(
                "Error against computing time used, over the run",
                partial(
                    draw_used, estimates=dict(zip(ESTIMATES, errors, strict=True)), reports=len(at)
                ),
                "" if drawn else NOT_RECORDED, over_time=False,
            ),
            curve_panel(
                "Computing time of a step, mean since the start", "time [µs]",
                at[timed], step_us[timed], marker="o",
            ),
        ],
        seconds[-1],
        f"Run of {recording.scene.name}: {seconds[-1]:g} s, {count} samples",
        made_line(summary["report"]),
    )  # fmt: skip


def write(summary: dict[str, Any], page: Path, pictures: Sequence[Path], out: Path) -> None:
    """Write the page as HTML with all pictures inside."""
    unknown = "".join(f"<li>{html.escape(words)}</li>" for words in summary["unknown"])
    name = html.escape(str(summary["scene"]))
    parts = [
        "<!doctype html>\n<html lang='en'><head><meta charset='utf-8'>",
        f"<title>Run of {name}</title><style>{_STYLE}</style></head><body>",
        f"<h1>Run of {name}</h1>",
        _picture(
            page,
            "error, energy, real-time factor, timing, losses, latency and efforts over the run",
        ),
        f"<h2>What the recording does not contain</h2><ul>{unknown}</ul>" if unknown else "",
        f"<h2>Numbers</h2><pre>{html.escape(table(summary))}</pre>",
        "<h2>Motion</h2><div class='some'>",
        *(_picture(path, path.stem.replace("_", " ")) for path in pictures),
        f"</div><footer>{html.escape(made_line(summary['report']))}</footer></body></html>\n",
    ]
    out.write_text("\n".join(parts), encoding="utf-8")


def _picture(path: Path, words: str) -> str:
    data = base64.b64encode(path.read_bytes()).decode("ascii")
    return f"<img alt='{html.escape(words)}' src='data:image/png;base64,{data}'>"
