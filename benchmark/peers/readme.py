# SPDX-License-Identifier: Apache-2.0
"""The README's table of accuracy and speed, from docs/peers.json.

python -m benchmark.peers.readme
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[2]
README, RESULTS = ROOT / "README.md", ROOT / "docs" / "peers.json"
BEGIN, END = "<!-- begin speed -->\n", "<!-- end speed -->"
ROWS = {
    "sst_ros": "sst_ros, {}",
    "MuJoCo": "MuJoCo, best setting",
    "Pinocchio": "Pinocchio, DOP853 in a Python loop",
    "SciPy on the paper's form": "SciPy on the paper's equations in NumPy",
}
TARGETS = (1e-6, 1e-9)


def table(results: dict[str, Any]) -> str:
    """Rows of Markdown: processor time of the best setting, and how many times ours it is."""
    best = {
        (row["engine"], row["error_rad"]): row
        for row in results["reached"]
        if row["method"] == "best of all"
    }
    public = any(row["method"].startswith("simulate()") for row in results["reached"])
    call = "a call of `simulate`" if public else "Gauss collocation behind `simulate`"
    lines = [
        f"| Example 2, one second, {results['machine']['date'][:10]} | to 1e-6 rad | to 1e-9 rad |",
        "| --- | ---: | ---: |",
    ]
    for engine, name in ROWS.items():
        cells = [_cell(best.get((engine, target))) for target in TARGETS]
        lines.append(f"| {name.format(call)} | {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"


def _cell(row: dict[str, Any] | None) -> str:
    if row is None or row["ms"] is None:
        return "-"
    time, ratio = (float(f"{row[key]:.2g}") for key in ("ms", "over_ours"))
    return f"{time:g} ms" + ("" if ratio == 1.0 else f" ({ratio:,.0f} x)")


def written(text: str, results: dict[str, Any]) -> str:
    """Return the text of the README with the table of these results."""
    before, _, rest = text.partition(BEGIN)
    return before + BEGIN + table(results) + END + rest.partition(END)[2]


def write() -> None:
    """Bring the README up to date."""
    results = json.loads(RESULTS.read_text(encoding="utf-8"))
    README.write_text(written(README.read_text(encoding="utf-8"), results), encoding="utf-8")


if __name__ == "__main__":
    write()
