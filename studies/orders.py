# SPDX-License-Identifier: Apache-2.0
"""Orders of the methods, and errors of samples, events and energy.

Each error is drawn over what controls it. `python -m studies.orders` writes the page.
Every truth is a run by DOP853 at the tightest tolerance that is sensible; the distance
from one by Dormand-Prince 5 says how far it is known.
"""

from __future__ import annotations

import argparse
import re
from collections.abc import Callable, Sequence
from functools import cache
from itertools import product
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from matplotlib.figure import Figure

from sst_ros import Simulation, SineTorque, Trajectory, simulate
from sst_ros.figures import GREY, INK, MARKERS, styled
from sst_ros.integration.methods import METHODS
from sst_ros.integration.stepper import WHOLE_MOTION_BUDGET
from sst_ros.mechanism.geometry import Array, angle_between
from sst_ros.report.results import data_frame, publish, render
from sst_ros.state import State
from studies import DOCS, PAGES, run, run_jobs
from studies.extreme_scenes import FREE, Changes, bouncing, changed
from studies.sampled_data import slope

if TYPE_CHECKING:
    from pandas import DataFrame

ALL = tuple(METHODS)
ORDER = {name: method.order for name, method in METHODS.items()}
SINE = SineTorque(
    amplitude=(2.0, 1.5, 1.0), frequency=(5.0, 7.0, 9.0), phase=(0.0, 1.0, 2.0)
)
LIMIT = 1.0
"""Limit of the actuators in the scene with a clamp [N m]."""


def clipped(t: float) -> list[float]:
    """Return SINE within LIMIT, as a function of the time."""
    return [max(-LIMIT, min(LIMIT, torque)) for torque in SINE.at(t)]


def clipped_by_state(t: float, state: State) -> list[float]:
    """Return the same, as a function that may depend on the state."""
    return clipped(t)


class Row(NamedTuple):
    """One error, with what controls it: step, tolerance, or time for the energy."""

    of: str  # kind of error, a key of LABELS
    scene: str
    method: str
    x: float
    error: float
    known: float  # how far the truth is known


class Motion(NamedTuple):
    """A motion of example2_heavy with other values by key."""

    title: str
    changes: Changes
    torque: Any = SINE
    duration: float = 0.4  # [s]
    truth: str = ""  # another motion that is the same; empty for its own
    shortest: float = 0.0  # steps that are measured are longer [s]

    def run(self, method: str, tolerance: float, **given: Any) -> Trajectory:
        """Simulate; by default the end is the only sample."""
        times = given.pop("t_eval", [self.duration])
        return simulate(
            changed(self.changes), self.torque, self.duration,
            method=method, tolerance=tolerance, t_eval=times, **given,
        )  # fmt: skip


FRICTION = {"gamma": {"coulomb": 0.3, "smoothing": 0.02}}
MOTIONS = {
    "smooth": Motion("smooth", FREE, duration=2.0),
    "friction": Motion("friction, sharp to 0.02 rad/s", {**FREE, "friction": FRICTION}),
    "lag": Motion("lag of 10 ms", {**FREE, "actuators.time_constant": 1e-2}),
    "short lag": Motion("lag of 1 µs, stiff", {**FREE, "actuators.time_constant": 1e-6},
                        duration=0.02),
    "clamp": Motion("sine cut by the torque limit: kinks are found",
                    {**FREE, "actuators.torque_limit": LIMIT}),
    "function": Motion("as a function of the time: kinks are located", FREE, clipped,
                       truth="clamp", shortest=1e-3),
    "feedback": Motion("as a function of the state: kinks are unknown", FREE,
                       clipped_by_state, truth="clamp"),
    "stop": Motion("end of the stroke", {"friction": FRICTION}, (0.9, 0.8, 0.7), 2.0),
    "contact": Motion("contact with an elastic stop", bouncing(1e4), (0.0, 0.0, 0.0),
                      0.3),
}  # fmt: skip
TITLES = {"swing": "swing"} | {name: motion.title for name, motion in MOTIONS.items()}
LABELS = {
    "step": "error at the end [rad]", "t_eval": "error of samples at t_eval [rad]",
    "at": "error of Trajectory.at [rad]", "stop": "error of the time of the stop [s]",
    "contact": "error at the end [rad]", "energy": "|energy residual| [J]",
}  # fmt: skip
Guide = tuple[str, Callable[[Array], Array]]
TOLERANCE: Guide = ("error = tolerance", lambda x: x)
ROUNDING: Guide = ("1e-15 J sqrt(t / 1 s)", lambda t: 1e-15 * np.sqrt(t))
SHOWN = ("smooth", "friction", "lag", "short lag", "clamp", "function", "feedback")
TIGHTEST = 1e-13
STEPS = tuple(dict.fromkeys(round(2 ** (k / 2)) for k in range(21)))
"""Numbers of steps of a whole motion."""
TOLERANCES = tuple(10.0**-k for k in range(3, 12))
# of the energy's run [ns]; step of error constants [s]
PERIOD_NS, UNIT = 5_000_000, 0.1


@cache
def truth(name: str, instants: int = 0) -> tuple[Trajectory, float]:
    """Return a motion at its end or random instants, and how far it is known [rad]."""
    motion = MOTIONS[MOTIONS[name].truth or name]
    times = np.array([motion.duration])
    if instants:  # whole nanoseconds
        drawn = np.random.default_rng(32).integers(
            1, round(1e9 * motion.duration), instants
        )
        times = np.unique(drawn) / 1e9
    one, other = (motion.run(m, TIGHTEST, t_eval=times) for m in ("dop853", "dopri5"))
    return one, max(_largest(one, other), 1e-15)


def measure_steps(job: tuple[str, str]) -> list[Row]:
    """Run a motion by a method with fixed steps: errors at its end."""
    name, method = job
    motion, (exact, known) = MOTIONS[name], truth(name)
    rows = []
    for count in STEPS:
        h = motion.duration / count
        if h <= motion.shortest:
            continue
        # A loose tolerance leaves the steps alone.
        solution = motion.run(method, 1e3, max_step=h)
        if solution.status == 0:
            end = solution.quaternion[-1]
            error = float(angle_between(end, exact.quaternion[-1]))
            rows.append(Row("step", name, method, h, error, known))
    return rows


def measure_tolerance(job: tuple[str, str, float]) -> list[Row]:
    """Run a motion by a method and tolerance: errors of samples or of its stop time."""
    name, method, tolerance = job
    motion, found = MOTIONS[name], {}
    if name == "stop":
        exact, other = map(_stop_time, ("dop853", "dopri5"), (TIGHTEST, TIGHTEST))
        found["stop"] = abs(_stop_time(method, tolerance) - exact)
        known = max(abs(exact - other), 1e-12)  # digits of the message
    elif name == "contact":
        end, known = truth(name)
        found["contact"] = _largest(motion.run(method, tolerance), end)
    else:
        samples, known = truth(name, 300)
        sampled = motion.run(method, tolerance, t_eval=samples.t)
        between = motion.run(method, tolerance, t_eval=None).at(samples.t)
        found |= {
            "t_eval": _largest(sampled, samples),
            "at": _largest(between, samples),
        }
    return [
        Row(of, name, method, tolerance, error, known) for of, error in found.items()
    ]


@cache
def _stop_time(method: str, tolerance: float) -> float:
    """Return when a limit ends the motion "stop" [s], from the message."""
    message = MOTIONS["stop"].run(method, tolerance).message
    return float(re.findall(r"stopped at t = (\S+) s", message)[0])


def _largest(found: Trajectory, exact: Trajectory) -> float:
    return float(angle_between(found.quaternion, exact.quaternion).max())


def measure_energy(job: tuple[str, float]) -> list[Row]:
    """Run `swing` without friction for some seconds: a method's energy residual [J]."""
    method, seconds = job
    simulation = Simulation("swing", method, step_budget=WHOLE_MOTION_BUDGET)
    rows, done = [], 0
    for count in np.unique(
        np.geomspace(10, 1e9 * seconds / PERIOD_NS, 90).astype(int)
    ).tolist():
        simulation.steps((0.0, 0.0, 0.0), PERIOD_NS, count - done)
        done, residual = count, abs(simulation.energy_residual)
        rows.append(
            Row("energy", "swing", method, 1e-9 * count * PERIOD_NS, residual, 1e-16)
        )
    return rows


def order_table(rows: DataFrame) -> DataFrame:
    """Return the orders over the shortest steps and over all, and error constants."""
    found = []
    for (name, method), each in rows[rows.of == "step"].groupby(
        ["scene", "method"], sort=False
    ):
        resolved = each[
            (each.error > 30.0 * each.known) & (each.error < 1e-3)
        ].sort_values("x")
        # steps longer than a piece are the piece
        resolved = resolved.drop_duplicates("error")
        if len(resolved) < 3:
            continue
        short = resolved[:7]
        order = slope(short.x, short.error)
        constant = np.exp(np.mean(np.log(short.error) - order * np.log(short.x / UNIT)))
        found.append(
            {
                "motion": TITLES[name],
                "method": method,
                "order in theory": ORDER[method],
                "order, shortest steps": f"{order:.2f}",
                "order, all steps": f"{slope(resolved.x, resolved.error):.2f}",
                "steps [ms]": f"{1e3 * resolved.x.min():.2g}"
                f" to {1e3 * resolved.x.max():.2g}",
                "error constant [rad]": f"{constant:.1e}",
            }
        )
    return data_frame(found)


def ratio_table(rows: DataFrame) -> DataFrame:
    """Return the largest error over the tolerance, of resolved errors, by method."""
    chosen = rows[~rows.of.isin(["step", "energy"]) & (rows.error > 10.0 * rows.known)]
    ratios = (
        (chosen.error / chosen.x)
        .groupby([chosen.of, chosen.scene, chosen.method])
        .max()
    )
    table = (
        ratios.unstack()
        .reindex(columns=list(ALL))
        .map("{:.2g}".format)
        .replace("nan", "-")
    )
    return (
        table.rename(LABELS, level=0)
        .rename(TITLES, level=1)
        .reset_index(names=["error", "motion"])
    )


@styled
def draw(
    rows: DataFrame,
    panels: Sequence[tuple[str, str]],
    xlabel: str,
    guide: Guide | None = None,
) -> Figure:
    """Draw panels of (kind of error, scene), a line a method.

    A dotted line shows how far the truth is known.
    """
    down, across = -(-len(panels) // 2), min(len(panels), 2)
    figure = Figure(figsize=(9.0, 0.8 + 3.0 * down + (1.0 if across == 1 else 0.0)))
    grid = figure.subplots(down, across, squeeze=False)
    for axes in grid.flat[len(panels) :]:
        axes.set_axis_off()
    for axes, (of, name) in zip(grid.flat[: len(panels)], panels, strict=True):
        chosen = rows[(rows.of == of) & (rows.scene == name) & (rows.error < 0.05)]
        known, ends = chosen.known.max(), np.array([chosen.x.min(), chosen.x.max()])
        for method in ALL:
            mine, look = (
                chosen[chosen.method == method].sort_values("x"),
                MARKERS[method],
            )
            if len(mine):
                axes.plot(
                    mine.x,
                    np.maximum(mine.error, known),
                    color=look[0],
                    marker=look[1],
                    label=method,
                    markersize=4,
                    linewidth=1.2,
                )
        axes.axhline(known, color=GREY, linestyle=":", label="truth known to")
        if guide:
            axes.plot(
                ends, guide[1](ends), "--", color=INK, linewidth=0.9, label=guide[0]
            )
        axes.set(
            xscale="log",
            yscale="log",
            xlabel=xlabel,
            ylabel=LABELS[of],
            title=TITLES[name],
        )
    figure.legend(
        *grid[0, 0].get_legend_handles_labels(),
        loc="outside lower center",
        ncols=7,
        fontsize=9,
        frameon=False,
    )
    return figure


def report(options: argparse.Namespace) -> bool:
    """Measure all; write orders.csv, .json, .md and the pictures."""
    steps = list(product(SHOWN, ALL))
    toleranced = list(
        product(("smooth", "friction", "stop", "contact"), ALL, TOLERANCES)
    )
    energies = [(method, options.seconds) for method in list(METHODS)[::-1]]
    parts = [
        *run_jobs(measure_energy, energies, "energy          "),
        *run_jobs(measure_steps, steps, "orders          "),
        *run_jobs(measure_tolerance, toleranced, "tolerances      "),
    ]
    rows = data_frame(row._asdict() for part in parts for row in part)
    samples = [(of, name) for name in ("smooth", "friction") for of in ("t_eval", "at")]
    swing = Simulation("swing")
    given = {
        "energy": swing.dynamics.total_energy(swing.sample[0]),
        "seconds": options.seconds,
    }
    page = render(
        PAGES / "orders.md", orders=order_table(rows), ratios=ratio_table(rows), **given
    )
    figures = {
        ".png": draw(rows, [("step", name) for name in SHOWN], "step [s]"),
        "orders_samples.png": draw(rows, samples, "tolerance [rad]", TOLERANCE),
        "orders_events.png": draw(
            rows,
            [("stop", "stop"), ("contact", "contact")],
            "tolerance [rad]",
            TOLERANCE,
        ),
        "orders_energy.png": draw(rows, [("energy", "swing")], "time [s]", ROUNDING),
    }
    publish(options.out, "orders", {".csv": rows, ".json": {}, ".md": page, **figures})
    return True


def main(words: Sequence[str] | None = None) -> int:
    """Measure from the command line."""
    seconds = {"type": float, "default": 1e5, "help": "of the run for the energy"}
    return run(report, "orders", DOCS, words, seconds=seconds)


if __name__ == "__main__":
    raise SystemExit(main())
