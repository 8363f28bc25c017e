# SPDX-License-Identifier: Apache-2.0
"""Pictures of a study: output distributions, scatter matrix of the worst runs."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from numpy.typing import NDArray

from sst_ros.figures import BLUE, GREY, VERMILION, styled
from sst_ros.report.results import publish
from sst_ros.sweeps.sweep import correlate, list_outputs

PANEL_COLUMNS = 4  # of the page of distributions
MOST_INPUTS = 6  # of a scatter matrix: those that matter most
MOST_RUNS = 200  # that are marked as the worst
MOST_POINTS = 2000  # of all runs in a scatter plot; the worst are drawn over them


def draw_pictures(table: pd.DataFrame, out: Path) -> list[Path]:
    """Draw the table of a study into a folder; return the paths.

    The worst runs are those that ended first; where none ended early, those with the
    largest tracking error, or with the outputs farthest from their medians.
    """
    complete = table.loc[table["status"] == 0, list_outputs(table)]
    figures = {"distributions.png": draw_distributions(complete, table.attrs["units"])}
    score, title = _score(table)
    names = correlate(table, score).index[:MOST_INPUTS].tolist()
    if names:
        worst = np.argsort(score.to_numpy())[-MOST_RUNS:]
        figures["worst.png"] = draw_scatter(table[names], worst, title)
    publish(out, "sweep plot", figures)
    return [out / name for name in figures]


def _score(table: pd.DataFrame) -> tuple[pd.Series, str]:
    """Return how bad each run is, and what that means."""
    if (table["status"] != 0).any():
        end_time = table["fault_time"].fillna(table["t"])
        return -end_time, f"The {MOST_RUNS} runs that ended first"
    numbers = table[list_outputs(table)]
    errors = numbers.filter(like="error_max")
    if len(errors.columns):
        return errors.max(axis=1), f"The {MOST_RUNS} largest tracking errors"
    apart = (numbers - numbers.median()).abs() / numbers.std().replace(0.0, 1.0)
    return apart.max(axis=1), f"The {MOST_RUNS} runs farthest from the median"


@styled
def draw_distributions(outputs: pd.DataFrame, units: Mapping[str, str]) -> Figure:
    """Histograms of the outputs of the runs that reached the end."""
    rows = max(1, math.ceil(len(outputs.columns) / PANEL_COLUMNS))
    figure = Figure(figsize=(3.0 * PANEL_COLUMNS, 2.2 * rows))
    for i, (name, values) in enumerate(outputs.items()):
        axes = figure.add_subplot(rows, PANEL_COLUMNS, i + 1)
        axes.hist(values[np.isfinite(values)], 60, color=BLUE)
        axes.set(title=f"{name} [{units.get(str(name), '1')}]", yticks=[])
    return figure


@styled
def draw_scatter(inputs: pd.DataFrame, worst: NDArray[np.intp], title: str) -> Figure:
    """Draw a scatter matrix of inputs: a sample of all runs, the worst over it.

    The worst runs are given by their positions.
    """
    size = len(inputs.columns)
    figure = Figure(figsize=(1.2 + 1.8 * size, 1.2 + 1.8 * size))
    grid = figure.subplots(size, size, squeeze=False)
    sample = inputs.iloc[:: max(1, len(inputs) // MOST_POINTS)]
    layers = (sample, GREY, 1), (inputs.iloc[worst], VERMILION, 3)  # with marker sizes
    for (row, column), axes in np.ndenumerate(grid):
        vertical = inputs.columns[row]
        horizontal = inputs.columns[column]
        for runs, colour, markersize in layers:
            if row == column:
                axes.hist(runs[vertical], 30, color=colour, alpha=0.6, density=True)
            else:
                place = runs[horizontal], runs[vertical]
                axes.plot(*place, ".", color=colour, markersize=markersize)
        axes.set_xlabel(horizontal if row == size - 1 else "", fontsize=7)
        axes.set_ylabel("" if column else vertical, fontsize=7)
        axes.tick_params(labelsize=6)
    figure.suptitle(title)
    return figure
