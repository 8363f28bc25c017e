# SPDX-License-Identifier: Apache-2.0
"""A recorded run on one page: a picture, and an HTML file that needs nothing beside it."""

from __future__ import annotations

import base64
import html
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from sst_ros.mechanism.geometry import Array
from sst_ros.plot.downsampling import extremes, floor
from sst_ros.plot.paper_figures import BLUE, GREEN, GREY, LINES, STYLE, VERMILION
from sst_ros.recording.recording import Recording
from sst_ros.report.reference import Comparison
from sst_ros.report.table import made_line, table
from sst_ros.report.timing import Timing

SMALLEST = 1e-17

_STYLE = """
body { font: 15px/1.45 system-ui, sans-serif; margin: 2em auto; max-width: 1100px; color: #222;
       padding: 0 1em; }
img { max-width: 100%; } pre { background: #f6f6f6; padding: 1em; overflow-x: auto;
       font-size: 12.5px; } .some { display: flex; flex-wrap: wrap; }
.some img { width: 50%; } footer { color: #666; font-size: 12px; }
"""


def draw(
    recording: Recording,
    integration: Comparison,
    timing: Timing,
    summary: dict[str, Any],
    path: Path,
) -> None:
    """Write the page as one PNG with eight pictures."""
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(12.0, 13.4))
        grid = figure.subplots(4, 2)
        _error(grid[0, 0], recording, integration)
        _energy(grid[0, 1], recording, timing)
        _pace(grid[1, 0], timing)
        _histogram(grid[1, 1], timing)
        _losses(grid[2, 0], recording, timing)
        _latency(grid[2, 1], timing)
        _late(grid[3, 0], recording, timing)
        _effort(grid[3, 1], recording)
        for axes in (*grid[:, 0], *grid[[0, 2, 3], 1]):
            axes.set_xlabel("time t [s]")
            axes.set_xlim(0.0, recording.seconds[-1])
        seconds = f"{recording.seconds[-1]:g} s, {len(recording.time_ns)} samples"
        figure.suptitle(f"Run of {recording.scene.name}: {seconds}", fontsize=13)
        figure.supxlabel(made_line(summary), fontsize=7, color="#555555")
        figure.savefig(path)


def _error(axes: Axes, recording: Recording, integration: Comparison) -> None:
    axes.set_title("Integration error, against the same torques", loc="left")
    lowest, error = floor(integration.own), integration.error
    rows = extremes([lowest], len(lowest))
    axes.fill_between(recording.seconds[rows], SMALLEST, np.fmax(lowest[rows], SMALLEST),
                      color=GREY, alpha=0.3, linewidth=0.0, label="reference's own")  # fmt: skip
    quantities = (("γ [rad]", error.gamma), ("γ̇ [rad/s]", error.gamma_dot),
                  ("orientation [rad]", error.orientation))  # fmt: skip
    for (name, values), line in zip(quantities, LINES, strict=True):
        _line(axes, recording.seconds, np.where(values > 0.0, values, np.nan), label=name, **line)
    axes.set_yscale("log")
    axes.set_ylim(bottom=SMALLEST)
    axes.set_ylabel("largest difference")
    if np.isfinite(error.gamma).any():
        axes.legend(fontsize=8, ncol=2, loc="lower right")
    else:
        _nothing(axes, "nothing could be compared")


def _energy(axes: Axes, recording: Recording, timing: Timing) -> None:
    axes.set_title("Energy that nobody has put in", loc="left")
    axes.set_ylabel("energy residual [J]")
    if timing.energy is None or not np.isfinite(timing.energy).any():
        return _nothing(axes, "not known")
    _line(axes, recording.seconds, timing.energy, color=BLUE, linewidth=1.4)
    return None


def _pace(axes: Axes, timing: Timing) -> None:
    axes.set_title("Pace by the recorder's clock", loc="left")
    axes.set_ylabel("real-time factor")
    if not len(timing.pace):
        return _nothing(axes, "not known")
    axes.plot(timing.pace_s, timing.pace, color=BLUE, marker=".", linewidth=1.2)
    axes.axhline(1.0, color=GREY, linewidth=0.9, linestyle="--")
    low, high = float(timing.pace.min()), float(timing.pace.max())
    reach = max(0.02, 1.1 * max(abs(high - 1.0), abs(low - 1.0)))
    if reach < 0.9:
        axes.set_ylim(1.0 - reach, 1.0 + reach)
    return None


def _histogram(axes: Axes, timing: Timing) -> None:
    axes.set_title("Period between received samples", loc="left")
    axes.set_xlabel("period less its nominal [µs]")
    axes.set_ylabel("samples")
    if not len(timing.period_us):
        return _nothing(axes, "not known")
    off = timing.period_us - timing.nominal_us
    reach = max(1.0, 1.05 * float(np.abs(off).max()))
    axes.hist(off, bins=np.linspace(-reach, reach, 81).tolist(), color=BLUE, log=True)
    axes.set_ylim(bottom=0.5)
    marks = (("p99", 99.0, VERMILION, "--"), ("p99.9", 99.9, GREEN, ":"))
    for name, share, colour, line in marks:
        value = float(np.percentile(off, share))
        axes.axvline(value, color=colour, linestyle=line, linewidth=1.5, label=name)
    told = (f"nominal {timing.nominal_us:g} µs\nmin {timing.period_us.min():.1f}\n"
            f"mean {timing.period_us.mean():.1f}\nmax {timing.period_us.max():.1f}\n"
            f"p99 {np.percentile(timing.period_us, 99.0):.1f}\n"
            f"p99.9 {np.percentile(timing.period_us, 99.9):.1f}")  # fmt: skip
    axes.text(0.02, 0.96, told, transform=axes.transAxes, va="top", fontsize=8.5)
    axes.legend(fontsize=8, loc="upper right")
    return None


def _losses(axes: Axes, recording: Recording, timing: Timing) -> None:
    axes.set_title("Losses so far", loc="left")
    axes.set_ylabel("count")
    rows = [(name, np.sort(times), np.arange(1.0, len(times) + 1.0), len(times))
            for name, times in (("samples lost", timing.lost_s),
                                ("gaps between applied torques", timing.gaps_s))]  # fmt: skip
    if len(timing.missed):
        last = int(timing.missed[-1])
        rows.append(("ticks missed, by the simulator", timing.missed_s, timing.missed, last))
    else:
        axes.plot([], [], " ", label="ticks missed: not recorded")
    for (name, times, counts, last), line in zip(rows, LINES, strict=False):
        few = extremes([counts], len(counts)) if len(counts) else slice(0)
        steps = np.concatenate([[0.0], times[few], [recording.seconds[-1]]])
        shown = np.concatenate([[0.0], counts[few], [last]])
        axes.step(steps, shown, where="post", label=f"{name}: {last}", **line)
    axes.set_ylim(0.0, max(1.0, 1.6 * max(last for *_, last in rows)))
    axes.yaxis.set_major_locator(MaxNLocator(5, integer=True))
    axes.legend(fontsize=8, loc="upper left")


def _latency(axes: Axes, timing: Timing) -> None:
    axes.set_title("From a command's reception to the step that applies it", loc="left")
    axes.set_ylabel("latency [µs]")
    found = timing.latency
    if not len(found.time_s):
        return _nothing(axes, "not known")
    rows = extremes([found.received_us], len(found.time_s))
    axes.plot(found.time_s[rows], found.received_us[rows], ".", color=BLUE, markersize=3)
    axes.set_ylim(bottom=min(0.0, 1.05 * float(found.received_us.min())))
    return None


def _late(axes: Axes, recording: Recording, timing: Timing) -> None:
    axes.set_title("How far samples come behind the promptest one", loc="left")
    axes.set_ylabel("received later, by its stamp [ms]")
    _line(axes, recording.seconds, timing.late_us / 1e3, color=BLUE, linewidth=1.2)


def _effort(axes: Axes, recording: Recording) -> None:
    axes.set_title("Effort of joint_states against the applied torque", loc="left")
    axes.set_ylabel("largest difference [N m]")
    off = recording.effort_difference
    if not np.isfinite(off).any():
        return _nothing(axes, "not known")
    _line(axes, recording.seconds, off, color=BLUE, linewidth=1.4)
    axes.set_ylim(bottom=0.0)
    if not np.nanmax(off):
        axes.set_ylim(0.0, 1.0)
        _nothing(axes, "none")
    return None


def _line(axes: Axes, seconds: Array, values: Array, **style: Any) -> None:
    """Draw a curve with no more points than can be seen."""
    rows = extremes([values], len(values))
    axes.plot(seconds[rows], values[rows], **style)


def _nothing(axes: Axes, words: str) -> None:
    axes.text(0.5, 0.5, words, transform=axes.transAxes, ha="center", color=GREY, fontsize=12)


def write(summary: dict[str, Any], page: Path, pictures: Sequence[Path], out: Path) -> None:
    """Write the page as HTML with all pictures inside."""
    told = "".join(f"<li>{html.escape(words)}</li>" for words in summary["not_told"])
    name = html.escape(str(summary["scene"]))
    parts = [
        "<!doctype html>\n<html lang='en'><head><meta charset='utf-8'>",
        f"<title>Run of {name}</title><style>{_STYLE}</style></head><body>",
        f"<h1>Run of {name}</h1>",
        _picture(page, "error, energy, pace, jitter, losses, latency and efforts over the run"),
        f"<h2>What the recording does not tell</h2><ul>{told}</ul>" if told else "",
        f"<h2>Numbers</h2><pre>{html.escape(table(summary))}</pre>",
        "<h2>Motion</h2><div class='some'>",
        *(_picture(path, path.stem.replace("_", " ")) for path in pictures),
        f"</div><footer>{html.escape(made_line(summary))}</footer></body></html>\n",
    ]
    out.write_text("\n".join(parts), encoding="utf-8")


def _picture(path: Path, words: str) -> str:
    data = base64.b64encode(path.read_bytes()).decode("ascii")
    return f"<img alt='{html.escape(words)}' src='data:image/png;base64,{data}'>"
