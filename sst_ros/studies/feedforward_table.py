# SPDX-License-Identifier: Apache-2.0
"""A study of feedforward as text, as CSV and as JSON."""

from __future__ import annotations

import csv
import io
import json
import math
from collections.abc import Iterator
from dataclasses import asdict
from typing import Any

import numpy as np

from sst_ros.control.controller_settings import INSTANTS, MODES
from sst_ros.report.summary import made_on
from sst_ros.studies.feedforward import OPEN_LOOP, Outcome, Study
from sst_ros.studies.hold_order import Hold
from sst_ros.studies.model_errors import SHARE
from sst_ros.studies.sampled_data import ORDERS, slope

COLUMNS = (
    "scene", "error", "mode", "bandwidth_rad_per_s", "damping_ratio", "period_s", "seed",
    "rms_rad", "largest_rad", "settling_s", "torque_rms_Nm", "torque_largest_Nm",
    "feedforward_share", "feedback_share", "samples_limited", "failure",
)  # fmt: skip


def rows(study: Study) -> Iterator[list[str]]:
    """Yield the table, heads first: RMS error by error, bandwidth and mode, and pd over both."""
    yield ["error", "rad/s", *MODES, "pd / feedforward_pd"]
    marks = {id(outcome): f"[{n}]" for n, outcome in enumerate(failed(study), start=1)}
    for error in dict.fromkeys(outcome.error for outcome in study.outcomes):
        for bandwidth in study.plan.bandwidths:
            cells = []
            for mode in MODES:
                outcome = study.of(error, mode, None if mode == OPEN_LOOP else bandwidth)
                told = marks.get(id(outcome)) or f"{outcome.rms:.1e}"
                again = mode == OPEN_LOOP and bandwidth != study.plan.bandwidths[0]
                cells.append("" if again else told)
            benefit = study.benefit(error, bandwidth)
            cells.append("-" if benefit is None else f"{benefit:.3g}")
            yield [error, f"{bandwidth:g}", *cells]


def failed(study: Study) -> list[Outcome]:
    """Return what failed, in the order of its footnotes."""
    return [outcome for outcome in study.outcomes if outcome.failure]


def text(study: Study) -> str:
    """Format a study for the terminal."""
    return "\n".join(line.rstrip() for line in _lines(study)) + "\n"


def _lines(study: Study) -> Iterator[str]:
    yield title(study)
    yield ""
    yield "RMS error of gamma [rad], by what the controller has wrong and the feedback's bandwidth"
    for first, second, *cells in rows(study):
        yield (
            f"{first:18}{second:>6}"
            + "".join(f"{cell:>17}" for cell in cells[:-1])
            + (f"{cells[-1]:>21}")
        )
    yield ""
    yield from notes(study)
    yield ""
    yield from shown(study)
    yield made(study)


def notes(study: Study) -> Iterator[str]:
    """Tell what failed and what was left out, line by line."""
    for number, outcome in enumerate(failed(study), start=1):
        at = "" if outcome.bandwidth is None else f" at {outcome.bandwidth:g} rad/s"
        yield f"[{number}] {outcome.error}, {outcome.mode}{at}: {outcome.failure}"
    for name in study.left_out:
        yield f"Left out: {name}, which this scene cannot have."


def shown(study: Study) -> Iterator[str]:
    """Tell what theory predicts and what was found, line by line."""
    for at in INSTANTS:
        found = of_instant(study, at)
        cells = ", ".join(f"{h.error:.2e} rad at {1e3 * h.period_s:g} ms" for h in found)
        yield (
            f"Right model, feedforward alone, torque at the {at} of the hold: {cells}; order "
            f"{order(found):.3f}, theory {ORDERS[at]}"
        )
    yield (
        f"Exact holds (torque as a function of time): {study.exact.error:.1e} rad; the integrator "
        f"tells an error of {study.exact.estimate:.1e} rad"
    )
    for sign in "+-":
        error = f"inertia {sign}{SHARE:.0%}"
        for bandwidth in study.plan.bandwidths:
            benefit, bound = study.benefit(error, bandwidth), study.least_benefit(error, bandwidth)
            if benefit is not None and bound is not None:
                yield (
                    f"{error}, {bandwidth:g} rad/s: feedforward_pd errs {benefit:.2f} times less "
                    f"than pd with equal gains; linear theory: at least {bound:.2f}"
                )
    yield "Largest stable bandwidth of computed_torque [rad/s]: theory; without friction; as it is"
    for ideal, real in study.limits:
        yield (
            f"  delay {ideal.delay}: {ideal.theory:8.1f} {ideal.simulated:9.1f} "
            f"({ideal.simulated / ideal.theory - 1.0:+.2%}) {real.simulated:9.1f}"
        )


def of_instant(study: Study, at: str) -> list[Hold]:
    """Return the holds of one instant, by period."""
    return [hold for hold in study.holds if hold.at == at]


def order(holds: list[Hold]) -> float:
    """Power of the period with which the error falls; nan for fewer than two periods."""
    if len(holds) < 2:
        return math.nan
    return slope([hold.period_s for hold in holds], [hold.error for hold in holds])


def title(study: Study) -> str:
    """Tell what was studied."""
    plan = study.plan
    return (
        f"Feedforward on {plan.scene.name}: {study.seconds:g} s of motion, control period "
        f"{plan.period_ns / 1e6:g} ms, damping ratio {plan.damping_ratio:g}, seed {plan.seed}"
    )


def made(study: Study) -> str:
    """Machine, versions and date in one line."""
    on = made_on()
    numba = f", numba {on['numba']}" if on["numba"] else ", plain Python"
    return (
        f"sst_ros {on['sst_ros']}, Python {on['python']}{numba}, NumPy {on['numpy']}, "
        f"{on['processor']}, {on['processors']} cores, {on['platform']}, {on['date']}"
    )


def records(study: Study) -> Iterator[dict[str, Any]]:
    """Yield a flat mapping for each loop, keys as in COLUMNS."""
    plan = study.plan
    for outcome in study.outcomes:
        found = outcome.tracking
        told: list[Any] = [None] * 8
        if found is not None:
            power = found.torque_rms**2
            shares = [
                float(np.nansum(share * power) / power.sum()) if power.any() else None
                for share in (found.feedforward, found.feedback)
            ]
            told = [outcome.rms, found.largest.max(), found.settling,
                    float(np.sqrt(power.mean())), found.torque_largest.max(), *shares,
                    found.limited]  # fmt: skip
        values = (plan.scene.name, outcome.error, outcome.mode, outcome.bandwidth,
                  plan.damping_ratio, plan.period_ns / 1e9, plan.seed, *told,
                  outcome.failure)  # fmt: skip
        yield dict(zip(COLUMNS, values, strict=True))


def as_csv(study: Study) -> str:
    """Write the loops as CSV."""
    out = io.StringIO()
    writer = csv.DictWriter(out, COLUMNS, lineterminator="\n")
    writer.writeheader()
    writer.writerows(records(study))
    return out.getvalue()


def as_json(study: Study) -> str:
    """Write everything as JSON."""
    whole = {
        "scene": study.plan.scene.name,
        "motion_s": study.seconds,
        "left_out": list(study.left_out),
        "loops": list(records(study)),
        "holds": [
            {"at": at, "order": order(of_instant(study, at)), "order_of_theory": ORDERS[at],
             "errors": [asdict(hold) for hold in of_instant(study, at)]}
            for at in INSTANTS
        ],
        "exact_holds": asdict(study.exact),
        "limits": [{"ideal": asdict(a), "as_it_is": asdict(b)} for a, b in study.limits],
        "report": made_on(),
    }  # fmt: skip
    return json.dumps(whole, indent=2, allow_nan=False) + "\n"
