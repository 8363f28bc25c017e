# SPDX-License-Identifier: Apache-2.0
"""Error of the run loop against its processor time.

Varied are the control rate, the method, and how torques are held. Each point is a run
of the tick loop of the simulator node, compared with the reference of the continuous
motion; `sampled_data` derives the orders of the hold.
"""

from __future__ import annotations

import argparse
import itertools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from numpy.typing import NDArray

from sst_ros.errors import InputError, Problem
from sst_ros.figures import BLUE, GREEN, INK, MARKERS, VERMILION, styled
from sst_ros.integration.many_runs import run_many
from sst_ros.integration.methods import METHODS
from sst_ros.mechanism.geometry import Array
from sst_ros.report.reference_solution import (
    InitialValueProblem,
    ReferenceSolution,
    solve_reference,
)
from sst_ros.report.results import data_frame, publish, records, render
from sst_ros.scene import scene as scenes
from sst_ros.scene.scene import Scene
from sst_ros.simulation.simulation import Simulation
from sst_ros.state import NANOSECONDS
from studies import DOCS, PAGES, run
from studies.control_loop import run_in_loop
from studies.sampled_data import ORDERS, slope

if TYPE_CHECKING:
    from pandas import DataFrame

RATES = (100, 200, 500, 1000, 2000, 5000, 10_000)
"""Control rates [Hz]."""

START, MIDDLE, EXACT = "start", "middle", "exact"
HOLDS = (START, MIDDLE, EXACT)
"""What acts over a period: the torque at its start, at its middle, or the profile."""

TOLERANCE = 1e-10
"""Local tolerance of a step, the default of the node."""

OWN_ERROR = 0.1
"""A method's own error below this part of the hold's error leaves that as it is."""

SAME_ERROR = 1.05
"""Methods whose errors differ by less than this ratio have the same error."""

COLUMNS = ("scene", "rate_Hz", "method", "hold", "final_rad", "largest_rad",
           "estimate_rad", "tick_us", "core_share")  # fmt: skip


Run = tuple[NDArray[np.int64], Array, float, float]
"""Times of the samples (n,) [ns], quaternions and body rates (n, 7), error estimate at
the end [rad], median processor time of a tick [s].
"""


def run_controlled(
    scene: Scene, seconds: float, rate: int, method: str, hold: str
) -> Run:
    """Run a scene with torques at a control rate [Hz], with a sample a tick.

    The rate is a divisor of 1e9.

    Raises:
        RunStopped: the run stopped early.

    """
    assert scene.torque is not None
    profile, period_ns = scene.torque, NANOSECONDS // rate
    shift_ns = period_ns // 2 if hold == MIDDLE else 0

    def torque(simulation: Simulation) -> Any:
        if hold == EXACT:
            return profile
        return profile.at((simulation.time_ns + shift_ns) / NANOSECONDS)

    simulation = Simulation(scene, method, tolerance=TOLERANCE)
    ticks = math.floor(seconds * rate + 1e-6)
    states, times = run_in_loop(simulation, torque, period_ns, ticks, warm=True)
    times_ns = np.array([state.time_ns for state in states])
    rows = np.array([(*state.quaternion, *state.body_rate) for state in states])
    return times_ns, rows, simulation.error_estimate, float(np.median(np.diff(times)))


@dataclass(frozen=True)
class ControlStudy:
    """Result of a study: the grid as a table of COLUMNS, and its reference."""

    scene: str
    seconds: float
    reference: ReferenceSolution
    rows: DataFrame

    @cached_property
    def least_rates(self) -> dict[str, float]:
        """Least rate [Hz] from which on the error is that of the hold, by method.

        Or infinite.

        From there on the method's own error, that with the exact profile, is below a
        part OWN_ERROR of that with held torques. Below, errors of either sign may
        cancel.
        """
        found = {}
        for method, runs in self.rows.groupby("method", sort=False):
            errors = runs.pivot(
                index="rate_Hz", columns="hold", values="largest_rad"
            ).sort_index()
            resolved = errors[EXACT] <= OWN_ERROR * errors.drop(columns=EXACT).min(
                axis=1
            )
            from_here_on = resolved[::-1].cummin()
            found[str(method)] = float(
                min(errors.index[from_here_on[::-1]], default=math.inf)
            )
        return found

    def resolved(self, hold: str) -> DataFrame:
        """Rows of the run loop whose error is that of the hold."""
        rows = self.rows[self.rows.hold == hold]
        return rows[rows.rate_Hz >= rows.method.map(self.least_rates)]

    def order(self, hold: str) -> float:
        """Power of the period with which the largest error of the hold falls."""
        rows = self.resolved(hold)
        return slope((1.0 / rows.rate_Hz).tolist(), rows.largest_rad.tolist())

    def spread(self, hold: str) -> float:
        """Largest ratio of `resolved` errors of two methods at the same rate."""
        errors = self.resolved(hold).groupby("rate_Hz").largest_rad
        return float((errors.max() / errors.min()).max())


def control_study(
    scene: Scene,
    *,
    rates: Sequence[int] = RATES,
    methods: Sequence[str] = tuple(METHODS),
    shown: bool = False,
) -> ControlStudy:
    """Run the grid, one point after another.

    Processor times are those of a core that is free. Errors are taken at every tick, so
    that the rates [Hz], divisors of 1e9, have a common tick.

    Raises:
        InputError: the scene has no torques of its own, or cannot start.
        RunStopped: a run stopped early.

    """
    if scene.torque is None:
        raise InputError(scene.name, [Problem("torque", None, "must be given")])
    tick_ns = math.gcd(*(NANOSECONDS // rate for rate in rates))
    problem = InitialValueProblem(scene, tick_ns)
    reference = solve_reference(problem)

    points, rows = list(itertools.product(rates, methods, HOLDS)), []

    def run_one(point: tuple[int, str, str]) -> Run:
        return run_controlled(scene, problem.seconds, *point)

    for number, found in run_many(run_one, points, label=f"{scene.name:<16}" * shown):
        rate, method, hold = points[number]
        times_ns, states, estimate, tick = found
        final, largest = problem.errors(states, reference.states[times_ns // tick_ns])
        errors = final.orientation, largest.orientation
        rows.append(
            (scene.name, rate, method, hold, *errors, estimate, 1e6 * tick, tick * rate)
        )
    return ControlStudy(
        scene.name,
        problem.seconds,
        reference,
        data_frame(dict(zip(COLUMNS, row, strict=True)) for row in rows),
    )


def advice(study: ControlStudy) -> str:
    """Return what to change for a smaller error, from the grid."""
    rates, spread = study.least_rates, max(map(study.spread, (START, MIDDLE)))
    if math.isinf(min(rates.values())) or spread > SAME_ERROR:
        differ = f"the methods differ by up to {spread:.2g} times at the same rate"
        return f"{differ}: choose a finer method or tolerance first"
    held = [study.resolved(hold) for hold in (START, MIDDLE)]
    least = held[0].rate_Hz.min()
    start, middle = (rows[rows.rate_Hz == least].largest_rad.max() for rows in held)
    late = "; ".join(
        f"{name}, below {rate:g} Hz," for name, rate in rates.items() if rate > RATES[0]
    )
    other, own_errors = (
        ("other ", f"; {late} has errors of its own") if late else ("", "")
    )
    return (
        "raise the rate or command the torque of the middle of the hold; do not change"
        f" the method: at the same rate all {other}methods have the same error, to"
        f" {100 * (spread - 1):.1g} %, and at {least:g} Hz the middle gives"
        f" {start / middle:.0f} times less than the start{own_errors}"
    )


WRONG_ORDER = 0.2
"""Difference from the order of theory that is reported as a fault."""

SCENES = ("example2", "friction")
"""Scenes of the page."""


def report(options: argparse.Namespace) -> bool:
    """Study scenes.

    Print the page, and write control_rate.csv, .json, .md and figures.
    """
    studies: list[ControlStudy] = []
    for name in options.scene:
        studies.append(control_study(scenes.load(name), shown=True))
    rows = data_frame(row for study in studies for row in records(study.rows))
    print(page(studies))
    document = {"rows": records(rows), "advice": {s.scene: advice(s) for s in studies}}
    figures = {f"control_rate_{s.scene}.png": figure(s) for s in studies}
    files = {".csv": rows, ".json": document, ".md": page(studies), **figures}
    publish(options.out, "control_rate", files)
    return True


def grid(study: ControlStudy) -> DataFrame:
    """Return errors and times as texts by rate and hold."""
    rows = []
    for (rate, hold), group in study.rows.groupby(["rate_Hz", "hold"], sort=False):
        low, high = group.largest_rad.min(), group.largest_rad.max()
        error = f"{high:.3e}" if high < 1.001 * low else f"{low:.0e} to {high:.0e}"
        fast, slow = group.tick_us.min(), group.tick_us.max()
        rows.append(
            {
                "rate [Hz]": f"{rate:g}",
                "torque": hold,
                "largest error [rad]": error,
                "at the end [rad]": f"{group.final_rad.max():.1e}",
                "per tick [us]": (
                    f"{fast:.0f} to {slow:.0f}" if slow > 1.1 * fast else f"{slow:.0f}"
                ),
                "share of a core [%]": "{:.2g} to {:.2g}".format(
                    *(100 * group.core_share.agg(["min", "max"]))
                ),
            }
        )
    return data_frame(rows)


def findings(study: ControlStudy) -> Iterator[str]:
    """Yield orders and advice, a sentence each."""
    for hold, power in ORDERS.items():
        found = study.order(hold)
        doubt = (
            "" if abs(found - power) < WRONG_ORDER else "WARNING, not as in theory: "
        )
        yield (
            f"{doubt}torque at the {hold} of the hold: order {found:.3f}, theory"
            f" {power}."
        )
    yield f"Advice: {advice(study)}."
    own = study.reference.own.orientation
    yield f"Reference: {study.reference.how}; its own error: {own:.0e} rad."


HOLD_NAMES = {
    START: (VERMILION, "torque at the start of the hold"),
    MIDDLE: (BLUE, "torque at the middle of the hold"),
    EXACT: (GREEN, "exact profile, nothing held"),
}


@styled
def figure(study: ControlStudy) -> Figure:
    """Draw the largest error over the control period and over the share of a core."""
    figure = Figure(figsize=(12.0, 6.6))
    left, right = figure.subplots(1, 2, sharey=True)
    loop = study.rows
    for (hold, method), group in loop.groupby(["hold", "method"], sort=False):
        group = group.sort_values("rate_Hz")
        error = np.maximum(group.largest_rad.to_numpy(), 1e-17)
        look: Any = {"color": HOLD_NAMES[hold][0], "marker": MARKERS[method][1],
                     "markerfacecolor": "none"}  # fmt: skip
        left.plot(
            1e3 / group.rate_Hz,
            error,
            markersize=5 + 2.5 * list(MARKERS).index(method),
            linewidth=float(hold == EXACT),
            **look,
        )
        right.plot(100.0 * group.core_share, error, markersize=7, linewidth=1.0, **look)
    for hold, power in ORDERS.items():
        colour, group = HOLD_NAMES[hold][0], study.resolved(hold).sort_values("rate_Hz")
        period = 1e3 / group.rate_Hz.to_numpy()
        line = group.largest_rad.to_numpy()[0] * (period / period[0]) ** power
        left.plot(period, line, color=colour, linewidth=1.6, zorder=1)
        k = len(period) // 2
        found = f"slope {power} (found {study.order(hold):.3f})"
        left.annotate(found, (period[k], line[k]), (8, -14), textcoords="offset points",
                      color=colour, fontsize=9)  # fmt: skip
    log = {"xscale": "log", "yscale": "log"}
    left.set(
        xlabel="control period [ms]",
        ylabel="largest error of the orientation [rad]",
        **log,
    )
    right.set(xlabel="processor time of the run loop, share of a core [%]", **log)
    handles = [
        Line2D([], [], color=colour, label=name) for colour, name in HOLD_NAMES.values()
    ]
    handles += [
        Line2D([], [], color=INK, marker=MARKERS[method][1], linestyle="", label=method,
               markerfacecolor="none") for method in loop.method.unique()
    ]  # fmt: skip
    figure.legend(
        handles=handles, loc="outside lower center", ncols=4, fontsize=9, frameon=False
    )
    found = advice(study).partition(": ")[0]  # the page gives the reasons
    figure.suptitle(f"{study.scene} over {study.seconds:g} s: {found}", fontsize=12)
    return figure


def page(studies: Sequence[ControlStudy]) -> str:
    """Write studies as one Markdown page."""
    given = {"findings": findings, "grid": grid}
    return render(PAGES / "control_rate.md", studies=studies, **given)


def main(words: Sequence[str] | None = None) -> int:
    """Study scenes from the command line."""
    return run(
        report,
        "control_rate",
        DOCS,
        words,
        scene={
            "nargs": "+",
            "default": SCENES,
            "help": "with torques: names, or .yaml files",
        },
    )


if __name__ == "__main__":
    raise SystemExit(main())
