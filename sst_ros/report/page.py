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

from sst_ros.report.figures import BLUE, GREEN, GREY, LINES, STYLE, VERMILION
from sst_ros.report.jitter import Timing
from sst_ros.report.recording import Recording
from sst_ros.report.reference import Comparison
from sst_ros.report.table import made_line, table

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
    """Write the page as one PNG with six pictures."""
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(12.0, 10.2))
        grid = figure.subplots(3, 2)
        _error(grid[0, 0], recording, integration)
        _energy(grid[0, 1], recording, timing)
        _pace(grid[1, 0], recording, timing)
        _histogram(grid[1, 1], timing)
        _losses(grid[2, 0], recording, timing, summary)
        _latency(grid[2, 1], recording, timing)
        for axes in (*grid[:, 0], grid[0, 1], grid[2, 1]):
            axes.set_xlabel("time t [s]")
            axes.set_xlim(0.0, recording.seconds[-1])
        seconds = f"{recording.seconds[-1]:g} s, {len(recording.time_ns)} samples"
        figure.suptitle(f"Run of {recording.scene.name}: {seconds}", fontsize=13)
        figure.supxlabel(made_line(summary), fontsize=7, color="#555555")
        figure.savefig(path)


def _error(axes: Axes, recording: Recording, integration: Comparison) -> None:
    axes.set_title("Integration error, against the same torques", loc="left")
    own, error = integration.own, integration.error
    floor = np.fmax.reduce([own.gamma, own.gamma_dot, own.orientation])
    axes.fill_between(recording.seconds, SMALLEST, np.fmax(floor, SMALLEST), color=GREY,
                      alpha=0.3, linewidth=0.0, label="reference's own")  # fmt: skip
    quantities = (("γ [rad]", error.gamma), ("γ̇ [rad/s]", error.gamma_dot),
                  ("orientation [rad]", error.orientation))  # fmt: skip
    for (name, values), line in zip(quantities, LINES, strict=True):
        axes.plot(recording.seconds, np.where(values > 0.0, values, np.nan), label=name, **line)
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
    axes.plot(recording.seconds, timing.energy, color=BLUE, linewidth=1.4)
    return None


def _pace(axes: Axes, recording: Recording, timing: Timing) -> None:
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


def _losses(axes: Axes, recording: Recording, timing: Timing, summary: dict[str, Any]) -> None:
    axes.set_title("Losses so far", loc="left")
    axes.set_ylabel("count")
    rows = (("samples lost", timing.lost_s), ("gaps between applied torques", timing.gaps_s))
    for (name, times), line in zip(rows, LINES, strict=False):
        steps = np.concatenate([[0.0], np.sort(times), [recording.seconds[-1]]])
        counts = np.concatenate([np.arange(len(times) + 1), [len(times)]])
        axes.step(steps, counts, where="post", label=f"{name}: {len(times)}", **line)
    missed = summary["ticks_missed"]
    told = "not recorded" if missed is None else f"{missed}"
    axes.plot([], [], " ", label=f"ticks missed, by the simulator: {told}")
    axes.set_ylim(0.0, max(1.0, 1.6 * max(len(timing.lost_s), len(timing.gaps_s))))
    axes.yaxis.set_major_locator(MaxNLocator(5, integer=True))
    axes.legend(fontsize=8, loc="upper left")


def _latency(axes: Axes, recording: Recording, timing: Timing) -> None:
    axes.set_title("From a command's reception to the stamp of its tick", loc="left")
    axes.set_ylabel("latency [µs]")
    if not len(timing.latency_us):
        return _nothing(axes, "not known")
    axes.plot(timing.latency_s, timing.latency_us, ".", color=BLUE, markersize=3)
    axes.set_xlim(0.0, recording.seconds[-1])
    return None


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
        _picture(page, "error, energy, pace, jitter, losses and latency over the run"),
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
