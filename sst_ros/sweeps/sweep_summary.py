# SPDX-License-Identifier: Apache-2.0
"""What a study shows, as text: how runs ended, which inputs explain it, ranges of the outputs."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import pandas as pd


SHOWN = 8
NOT_OUTPUTS = ("status", "reason", "t", "fault_time", "local_error")


def summarize(table: pd.DataFrame) -> str:
    """Return a text of the table of a study."""
    counts = table["reason"].value_counts()
    steps, length = table.attrs["steps"], table.attrs["duration"]
    lines = [f"{len(table)} runs of {length:g} s, {steps} steps each"]
    lines += [f"  {count:>10}  {reason}" for reason, count in counts.items() if count]
    causes = correlate_early_ends(table)
    if len(causes):
        lines.append("Rank correlation of inputs with an early end:")
        lines += [f"  {value:>10.3f}  {name}" for name, value in causes.head(SHOWN).items()]
    outputs = table.loc[table["status"] == 0, list_outputs(table)]
    if len(outputs):
        shown = outputs.describe(percentiles=[0.01, 0.99]).T[["mean", "std", "1%", "99%"]]
        shown["unit"] = [table.attrs["units"].get(name, "") for name in shown.index]
        lines.append(shown.to_string(float_format="{:.6g}".format))
    return "\n".join(lines)


def list_outputs(table: pd.DataFrame) -> list[str]:
    """Names of the outputs of a study."""
    known = (*table.attrs["inputs"], *NOT_OUTPUTS)
    return [name for name in table.columns if name not in known]


def correlate_early_ends(table: pd.DataFrame) -> pd.Series:
    """Spearman's rank correlation of each input with an early end, largest first.

    Empty where all runs ended alike, or no input differs.
    """
    early = (table["status"] != 0).astype(float)
    inputs = [name for name in table.attrs["inputs"] if table[name].nunique() > 1]
    if early.nunique() < 2 or not inputs:
        return table[[]].sum()
    ranks = table[inputs].rank()
    found = ranks.corrwith(early.rank())
    return found.reindex(found.abs().sort_values(ascending=False).index)
