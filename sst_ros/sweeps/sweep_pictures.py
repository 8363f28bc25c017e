# SPDX-License-Identifier: Apache-2.0
"""The pictures of a study: distributions, early ends, scatter matrix of the worst runs."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from sst_ros.extras import require
from sst_ros.host.output import writing
from sst_ros.mechanism.geometry import Array
from sst_ros.plot import sweep
from sst_ros.plot.style import save_figure
from sst_ros.sweeps.sweep_summary import early_end_correlations, output_columns

if TYPE_CHECKING:
    import pandas as pd

MOST_INPUTS, WORST = 6, 200


def draw(table: pd.DataFrame, out: Path) -> list[Path]:
    """Draw the table of a study into a folder; return the paths.

    The worst runs are those that ended first; where none ended early, those with the largest
    tracking error, or with the outputs farthest from their medians.
    """
    outputs = output_columns(table)
    ended = table["status"].to_numpy() != 0
    complete = {name: table[name].to_numpy()[~ended] for name in outputs}
    figures = {"distributions": sweep.distributions(complete, table.attrs["units"])}
    correlations = early_end_correlations(table)
    counts = {str(reason): int(count) for reason, count in table["reason"].value_counts().items()}
    if ended.any():
        figures["early_ends"] = sweep.early_ends(dict(correlations), counts)
    score, title = _badness(table, outputs)
    worst = np.argsort(score)[-min(WORST, len(score)) :]
    inputs = [name for name in table.attrs["inputs"] if table[name].nunique() > 1]
    ranks = require("pandas").Series(score, index=table.index).rank()
    strength = table[inputs].rank().corrwith(ranks).abs()
    shown = list(strength.sort_values(ascending=False).index[:MOST_INPUTS])
    if shown:
        columns = {name: table[name].to_numpy() for name in shown}
        figures["worst"] = sweep.worst_runs(columns, worst, title)
    with writing(out, "sweep plot"):
        for name, figure in figures.items():
            save_figure(figure, out / f"{name}.png")
    return [out / f"{name}.png" for name in figures]


def _badness(table: pd.DataFrame, outputs: list[str]) -> tuple[Array, str]:
    """How bad each run is, and what that means."""
    if (table["status"] != 0).any():
        ends = table["fault_time"].fillna(table["t"]).to_numpy()
        return -ends, f"The {WORST} runs that ended first"
    errors = [name for name in outputs if name.startswith("error_max")]
    if errors:
        return table[errors].max(axis=1).to_numpy(), f"The {WORST} largest tracking errors"
    numbers = table[outputs]
    apart = (numbers - numbers.median()).abs() / numbers.std().replace(0.0, 1.0)
    return apart.max(axis=1).to_numpy(), f"The {WORST} runs farthest from the median"
