# SPDX-License-Identifier: Apache-2.0
"""The pictures of a study: distributions, early ends, scatter matrix of the worst runs."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from sst_ros.extras import require
from sst_ros.host.output import write_into
from sst_ros.mechanism.geometry import Array
from sst_ros.plot.style import BLUE, GREY, VERMILION, save_figure, styled
from sst_ros.sweeps.chunk_task import correlate_early_ends, list_outputs

if TYPE_CHECKING:
    import pandas as pd

COLUMNS, MOST_INPUTS, MOST_RUNS = 4, 6, 200

MOST_POINTS = 2000
"""Of all runs in a scatter plot; the worst are drawn over them."""

Series = Mapping[str, Array]


def draw_pictures(table: pd.DataFrame, out: Path) -> list[Path]:
    """Draw the table of a study into a folder; return the paths.

    The worst runs are those that ended first; where none ended early, those with the largest
    tracking error, or with the outputs farthest from their medians.
    """
    outputs = list_outputs(table)
    ended = table["status"].to_numpy() != 0
    complete = {name: table[name].to_numpy()[~ended] for name in outputs}
    figures = {"distributions": draw_distributions(complete, table.attrs["units"])}
    correlations = correlate_early_ends(table)
    counts = {str(reason): int(count) for reason, count in table["reason"].value_counts().items()}
    if ended.any():
        figures["early_ends"] = draw_early_ends(dict(correlations), counts)
    score, title = _score(table, outputs)
    inputs = [name for name in table.attrs["inputs"] if table[name].nunique() > 1]
    ranks = require("pandas").Series(score, index=table.index).rank()
    strength = table[inputs].rank().corrwith(ranks).abs()
    shown = list(strength.sort_values(ascending=False).index[:MOST_INPUTS])
    if shown:
        columns = {name: table[name].to_numpy() for name in shown}
        figures["worst"] = draw_scatter(columns, np.argsort(score)[-MOST_RUNS:], title)
    with write_into(out, "sweep plot"):
        for name, figure in figures.items():
            save_figure(figure, out / f"{name}.png")
    return [out / f"{name}.png" for name in figures]


def _score(table: pd.DataFrame, outputs: list[str]) -> tuple[Array, str]:
    """How bad each run is, and what that means."""
    if (table["status"] != 0).any():
        ends = table["fault_time"].fillna(table["t"]).to_numpy()
        return -ends, f"The {MOST_RUNS} runs that ended first"
    errors = [name for name in outputs if name.startswith("error_max")]
    if errors:
        return table[errors].max(axis=1).to_numpy(), f"The {MOST_RUNS} largest tracking errors"
    numbers = table[outputs]
    apart = (numbers - numbers.median()).abs() / numbers.std().replace(0.0, 1.0)
    return apart.max(axis=1).to_numpy(), f"The {MOST_RUNS} runs farthest from the median"


@styled
def draw_distributions(outputs: Series, units: Mapping[str, str]) -> Figure:
    """Histograms of the outputs of the runs that reached the end."""
    rows = max(1, math.ceil(len(outputs) / COLUMNS))
    figure = Figure(figsize=(3.0 * COLUMNS, 2.2 * rows))
    for i, (name, values) in enumerate(outputs.items()):
        axes = figure.add_subplot(rows, COLUMNS, i + 1)
        finite = values[np.isfinite(values)]
        axes.hist(finite, 60, color=BLUE)
        axes.set_title(f"{name} [{units.get(name, '1')}]")
        axes.set_yticks([])
    return figure


@styled
def draw_early_ends(correlations: Mapping[str, float], counts: Mapping[str, int]) -> Figure:
    """Rank correlation of each input with an early end, and how runs ended."""
    figure = Figure(figsize=(11.0, 1.2 + 0.3 * max(len(correlations), len(counts), 4)))
    left, right = figure.subplots(1, 2)
    names = list(correlations)[::-1]
    left.barh(names, [correlations[name] for name in names], color=VERMILION)
    left.set_xlim(-1.0, 1.0)
    left.set_xticks([-1.0, -0.5, 0.0, 0.5, 1.0])
    left.set_title("Rank correlation of inputs with an early end")
    reasons = list(counts)[::-1]
    right.barh(reasons, [counts[reason] for reason in reasons], color=GREY)
    right.set_title("Runs by how they ended")
    right.set_xscale("symlog")
    return figure


@styled
def draw_scatter(inputs: Series, worst: NDArray[np.intp], title: str) -> Figure:
    """Scatter matrix of inputs: a sample of all runs, and the worst over it.

    Args:
        inputs: columns of all runs.
        worst: indices of the worst runs.
        title: what worst means.

    """
    names: Sequence[str] = list(inputs)
    size = max(len(names), 1)
    figure = Figure(figsize=(1.2 + 1.8 * size, 1.2 + 1.8 * size))
    some = slice(None, None, max(1, len(next(iter(inputs.values()), [])) // MOST_POINTS))
    for row, vertical in enumerate(names):
        for column, horizontal in enumerate(names):
            axes = figure.add_subplot(size, size, row * size + column + 1)
            x, y = inputs[horizontal], inputs[vertical]
            if row == column:
                for values, colour in ((x[some], GREY), (x[worst], VERMILION)):
                    axes.hist(values, 30, color=colour, alpha=0.6, density=True)
            else:
                axes.plot(x[some], y[some], ".", color=GREY, markersize=1)
                axes.plot(x[worst], y[worst], ".", color=VERMILION, markersize=3)
            axes.set_xlabel(horizontal if row == size - 1 else "", fontsize=7)
            axes.set_ylabel("" if column else vertical, fontsize=7)
            axes.tick_params(labelsize=6)
    figure.suptitle(title)
    return figure
