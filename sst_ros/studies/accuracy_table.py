# SPDX-License-Identifier: Apache-2.0
"""A study of accuracy as text, as CSV, as JSON, and as one sentence of advice."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Iterator
from dataclasses import asdict
from typing import Any

from sst_ros.report.summary import made_on
from sst_ros.studies.accuracy import Row, Study

TARGET = 1e-9
"""Error of the orientation that the advice is for [rad]."""

COLUMNS = (
    "scene", "method", "kind", "setting", "evaluations", "wall_min_s", "wall_median_s",
    "final_orientation_rad", "final_gamma_rad", "final_gamma_dot_rad_per_s",
    "largest_orientation_rad", "largest_gamma_rad", "largest_gamma_dot_rad_per_s",
    "energy_residual_J", "closure_residual", "below_floor", "failure",
)  # fmt: skip


def advice(study: Study, target: float = TARGET) -> str:
    """Tell in one sentence what to use."""
    best = study.best(target)
    if best is None:
        reached = [row.largest.orientation for row in study.rows if row.largest]
        least = f"the least is {min(reached):.0e} rad" if reached else "every one failed"
        return f"No way that was tried reaches {target:.0e} rad; {least}."
    return (
        f"{target:.0e} rad over {study.seconds:g} s: {best.method}, {setting(best)}, "
        f"{milliseconds(best.wall_s[0])}."
    )


def milliseconds(seconds: float) -> str:
    """Tell a time to two digits."""
    time = 1e3 * seconds
    return f"{time:.2g} ms" if time < 99.5 else f"{time:.0f} ms"


def setting(row: Row) -> str:
    """Tell the length of the steps, or the tolerance."""
    if row.kind == "tolerance":
        return f"tolerance {row.setting:.0e}"
    return f"{1e3 * row.setting:g} ms steps"


def made(study: Study) -> str:
    """Machine, versions and date in one line."""
    on = made_on()
    numba = f", numba {on['numba']}" if study.compiled else ", plain Python"
    return (
        f"sst_ros {on['sst_ros']}, Python {on['python']}{numba}, NumPy {on['numpy']}, "
        f"{on['processor']}, {on['processors']} cores, {on['platform']}, {on['date']}"
    )


def text(study: Study) -> str:
    """Format a study for the terminal."""
    return "\n".join(line.rstrip() for line in _lines(study)) + "\n"


def _lines(study: Study) -> Iterator[str]:
    own = study.reference.own
    end = f" ({study.ends})" if study.ends else ""
    yield f"Accuracy of {study.scene} over {study.seconds:g} s{end}, scene's own torques"
    yield f"Reference: {study.reference.how}; its own error: {own.orientation:.1e} rad, " + (
        f"{own.gamma:.1e} rad, {own.gamma_dot:.1e} rad/s"
    )
    if study.formulation is not None:
        yield f"Kernel against the paper's equations: {study.formulation:.1e} (relative)"
    yield ""
    yield (
        f"{'method':8}{'step, tolerance':>17}{'evaluations':>13}{'min [ms]':>10}{'median':>10}"
        f"{'turn, end':>11}{'largest':>10}{'gamma':>10}{'rate':>10}{'energy':>10}{'closure':>10}"
    )
    yield (
        f"{'':8}{'':17}{'':13}{'':10}{'[ms]':>10}{'[rad]':>11}{'[rad]':>10}{'[rad]':>10}"
        f"{'[rad/s]':>10}{'[J]':>10}{'':>10}"
    )
    hidden = 0
    for row in study.rows:
        count = "-" if row.evaluations is None else str(row.evaluations)
        head = f"{row.method:8}{setting(row):>17}{count:>13}"
        if row.failure or row.final is None or row.largest is None:
            yield f"{head}  FAILED: {row.failure[:90]}"
            continue
        below = row.largest.orientation < study.floor
        hidden += below
        told = (row.largest.orientation, row.largest.gamma, row.largest.gamma_dot, row.energy)
        cells = "".join("         -" if x is None else f"{x:10.1e}" for x in (*told, row.closure))
        yield (
            f"{head}{1e3 * row.wall_s[0]:10.3g}{1e3 * row.wall_s[1]:10.3g}"
            f"{row.final.orientation:11.1e}{cells}{' *' if below else ''}"
        )
    yield ""
    if hidden:
        yield (
            f"* {hidden} rows lie below {study.floor:.0e} rad, 100 times the reference's own "
            "error, and are not plotted."
        )
    yield from (f"WARNING: {warning}." for warning in study.warnings)
    yield advice(study)
    yield made(study)


def records(study: Study) -> Iterator[dict[str, Any]]:
    """Yield a flat mapping for each row, keys as in COLUMNS."""
    for row in study.rows:
        final = (*asdict(row.final).values(),) if row.final else (None,) * 3
        largest = (*asdict(row.largest).values(),) if row.largest else (None,) * 3
        below = None if row.largest is None else row.largest.orientation < study.floor
        values = (study.scene, row.method, row.kind, row.setting, row.evaluations, *row.wall_s,
                  *final, *largest, row.energy, row.closure, below, row.failure)  # fmt: skip
        yield dict(zip(COLUMNS, values, strict=True))


def as_csv(studies: list[Study]) -> str:
    """Write the rows of all studies as CSV."""
    out = io.StringIO()
    writer = csv.DictWriter(out, COLUMNS, lineterminator="\n")
    writer.writeheader()
    for study in studies:
        writer.writerows(records(study))
    return out.getvalue()


def as_json(studies: list[Study]) -> str:
    """Write everything as JSON."""
    documents = [
        {
            "scene": study.scene,
            "seconds": study.seconds,
            "ends": study.ends,
            "compiled": study.compiled,
            "reference": study.reference.how,
            "reference_own_error": asdict(study.reference.own),
            "formulation_difference_relative": study.formulation,
            "advice": advice(study),
            "warnings": list(study.warnings),
            "rows": list(records(study)),
        }
        for study in studies
    ]
    whole = {"studies": documents, "report": made_on()}
    return json.dumps(whole, indent=2, allow_nan=False) + "\n"
