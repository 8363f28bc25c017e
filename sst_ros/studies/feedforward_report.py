# SPDX-License-Identifier: Apache-2.0
"""The study of feedforward on the terminal, in files, and as one page."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from sst_ros.control.controller_settings import MODES
from sst_ros.plot.feedforward import draw_feedforward
from sst_ros.studies.feedforward import (
    OPEN_LOOP,
    FeedforwardPlan,
    FeedforwardStudy,
    feedforward_study,
)
from sst_ros.studies.model_errors import SHARE
from sst_ros.studies.results import markdown, provenance, records, table, write
from sst_ros.studies.sampled_data import ORDERS

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from pandas import DataFrame

INTRODUCTION = """\
# How good feedforward is

Written by `python -m sst_ros study feedforward`; all figures are from the machine and the date
below.

Every control mode tracks the reference motion of the scene with every model error: bodies 20 % too
heavy or too light in the controller's model (masses and inertias together), friction or gravity
missing from it, commands delayed by some samples, encoders with a finite number of counts a turn
(they measure no rate: it is the difference of the last two angles), and noise on angle (1e-4 rad)
and rate (1e-2 rad/s). Plant and controller run in lockstep in one process. Errors are those of the
true state. A loop with feedback that, long after the motion has ended, swings by more than 2 % of
the longest path of a joint, or has a torque at its limit, does not come to rest: it has failed,
as one that leaves its stroke or its workspace. `sst_ros/studies/feedforward.py` and
`sampled_data.py` derive the theory.
"""


def report(plan: FeedforwardPlan, out: Path, *, workers: int | None = None) -> FeedforwardStudy:
    """Run a study; print it, and write feedforward.csv, .json, .md and .png into `out`.

    Raises:
        SstError: the scene has no motion or cannot start, or `out` cannot be written.

    """
    study = feedforward_study(plan, workers=workers, shown=True)
    print(text(study), flush=True)
    write(out, "feedforward", csv=study.loops, document=document(study), page=page(study),
          figures={"feedforward": figure(study)})  # fmt: skip
    return study


def rms_table(study: FeedforwardStudy) -> DataFrame:
    """Return RMS errors as texts by model error, bandwidth and mode, and pd / feedforward_pd."""
    footnotes = {
        (row.error, row.mode, None if row.mode == OPEN_LOOP else row.bandwidth_rad_per_s): number
        for number, row in enumerate(failed(study).itertuples(), start=1)
    }
    rows = []
    for error in study.loops.error.unique():
        for bandwidth in study.plan.bandwidths:
            row = {"error": error, "rad/s": f"{bandwidth:g}"}
            for mode in MODES:
                rms = study.rms(error, mode, bandwidth)
                again = mode == OPEN_LOOP and bandwidth != study.plan.bandwidths[0]
                key = (error, mode, None if mode == OPEN_LOOP else bandwidth)
                found = f"[{footnotes[key]}]" if rms is None else f"{rms:.1e}"
                row[mode] = "" if again else found
            benefit = study.benefit(error, bandwidth)
            rows.append({**row, "pd / feedforward_pd": f"{benefit:.3g}" if benefit else "-"})
    return table(rows)


def failed(study: FeedforwardStudy) -> DataFrame:
    """Return the loops that failed, in the order of their footnotes."""
    return study.loops[study.loops.failure != ""]


def title(study: FeedforwardStudy) -> str:
    """Return scene and settings in one line."""
    plan = study.plan
    return (
        f"Feedforward on {plan.scene.name}: {study.seconds:g} s of motion, control period "
        f"{plan.period_ns / 1e6:g} ms, damping ratio {plan.damping_ratio:g}, seed {plan.seed}"
    )


def findings(study: FeedforwardStudy) -> Iterator[str]:
    """Yield predictions of the theory beside what was found, line by line."""
    for at, order in study.orders().items():
        cells = ", ".join(f"{hold.error:.2e} rad at {1e3 * hold.period_s:g} ms"
                          for hold in study.holds.itertuples() if hold.at == at)  # fmt: skip
        yield (
            f"Exact model, feedforward alone, torque at the {at} of the hold: {cells}; order "
            f"{order:.3f}, theory {ORDERS[at]}"
        )
    yield (
        f"Torque as a function of time, nothing held: {study.unheld[0]:.1e} rad; error estimate "
        f"of the integrator {study.unheld[1]:.1e} rad"
    )
    for sign in "+-":
        error = f"inertia {sign}{SHARE:.0%}"
        for bandwidth in study.plan.bandwidths:
            benefit, bound = study.benefit(error, bandwidth), study.least_benefit(error, bandwidth)
            if benefit is not None and bound is not None:
                yield (
                    f"{error}, {bandwidth:g} rad/s: the error of feedforward_pd is {benefit:.2f} "
                    f"times smaller than that of pd with equal gains; theory: at least {bound:.2f}"
                )
    yield "Largest stable bandwidth of computed_torque [rad/s]: theory; without friction; as it is"
    for row in study.limits.itertuples():
        yield (
            f"  delay {row.delay}: {row.theory:8.1f} {row.ideal:9.1f} "
            f"({row.ideal / row.theory - 1.0:+.2%}) {row.real:9.1f}"
        )


def notes(study: FeedforwardStudy) -> Iterator[str]:
    """Yield what failed and what was left out, line by line."""
    for number, row in enumerate(failed(study).itertuples(), start=1):
        at = "" if row.mode == OPEN_LOOP else f" at {row.bandwidth_rad_per_s:g} rad/s"
        yield f"[{number}] {row.error}, {row.mode}{at}: {row.failure}"
    for name in study.left_out:
        yield f"Left out: {name}, which this scene cannot have."


def text(study: FeedforwardStudy) -> str:
    """Format a study for the terminal."""
    lines = [
        title(study), "", "RMS error of gamma [rad], by model error and bandwidth of the feedback",
        rms_table(study).to_string(index=False), "", *notes(study), "", *findings(study),
        provenance(),
    ]  # fmt: skip
    return "\n".join(lines) + "\n"


def page(study: FeedforwardStudy) -> str:
    """Write a study as one Markdown page."""
    lines = [
        INTRODUCTION, f"**{title(study)}.**", "", "![the study](feedforward.png)", "",
        "## Theory and findings", "", *(f"- {line.strip()}" for line in findings(study)), "",
        "## RMS error of gamma [rad]", "", markdown(rms_table(study)), "",
        *(f"- {line}" for line in notes(study)), "", provenance(), "",
    ]  # fmt: skip
    return "\n".join(lines)


def document(study: FeedforwardStudy) -> dict[str, Any]:
    """Return everything as JSON has it."""
    return {
        "scene": study.plan.scene.name,
        "motion_s": study.seconds,
        "left_out": list(study.left_out),
        "loops": records(study.loops),
        "holds": [
            {"at": at, "order": None if np.isnan(order) else order, "order_of_theory": ORDERS[at],
             "errors": records(study.holds[study.holds["at"] == at])}
            for at, order in study.orders().items()
        ],
        "exact_holds": dict(zip(("error", "estimate"), study.unheld, strict=True)),
        "limits": records(study.limits),
    }  # fmt: skip


def figure(study: FeedforwardStudy) -> Figure:
    """Draw the study."""
    reasons: dict[str, int] = {}
    for failure in failed(study).failure:
        first, _, last = failure.partition(": ")
        reason = last if "stopped at" in first else first
        reasons[reason] = reasons.get(reason, 0) + 1
    lines = [provenance()]
    if reasons:
        listed = "; ".join(f"{count} × {kind}" for kind, count in list(reasons.items())[:4])
        lines.insert(0, f"Failed: {listed}. The table and the CSV have the reason of each.")
    return draw_feedforward(
        study.loops,
        study.holds,
        study.limits,
        bandwidths=study.plan.bandwidths,
        orders={at: (order, ORDERS[at]) for at, order in study.orders().items()},
        unheld=study.unheld[0],
        title=title(study),
        footnote="\n".join(lines),
    )
