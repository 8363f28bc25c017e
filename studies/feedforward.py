# SPDX-License-Identifier: Apache-2.0
"""How good feedforward is: every control mode with every model error, as a grid.

**Theory.** With an exact model the error of feedforward alone is that of the hold, and
falls with the period as `sampled_data` derives. With equal gains, the error of gamma
obeys one linear equation as long as it is small, driven by the torque that the
feedforward lacks: all of it for pd, the share s of a model whose bodies weigh 1 +- s
times too much for feedforward_pd. So

    RMS(pd) / RMS(feedforward_pd) -> 1 / s = 5 for s = 20 %,

and, as the hold adds the error of an exact model, it is by the triangle inequality no
less than 1 / (s + RMS(feedforward_pd, exact model) / RMS(pd)). Friction, which the
model has right, and the curvature of the mechanism change it by some per cent. Computed
torque is stable up to the bandwidth of `sampled_data.stability_limit`.
"""

from __future__ import annotations

import argparse
import itertools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from sst_ros.control.controller import InverseDynamics, TrackingMetrics
from sst_ros.control.law import HELD_INSTANTS, MODES
from sst_ros.control.reference_motions import reference_motion
from sst_ros.figures import BLUE, GREEN, GREY, INK, ORANGE, VERMILION, styled
from sst_ros.report.results import data_frame, publish, records, render
from sst_ros.scene.scene import Scene, load
from sst_ros.simulation.simulate import simulate
from sst_ros.state import NANOSECONDS, Vector3
from sst_ros.sweeps.sweep_study import SampledControl
from studies import DOCS, PAGES, run, run_jobs
from studies import control_loop as loops
from studies.control_loop import SHARE, ControlLoop, ModelError, model_errors, run_loop
from studies.sampled_data import ORDERS, slope

if TYPE_CHECKING:
    from pandas import DataFrame

REST_S = 0.3
"""Time for which a loop goes on after the motion, to see whether it settles [s]."""

OPEN_LOOP = "feedforward"  # the mode that has no bandwidth

COLUMNS = (
    "scene", "error", "mode", "bandwidth_rad_per_s", "damping_ratio", "period_s",
    "seed", "rms_rad", "largest_rad", "settling_s", "torque_rms_Nm",
    "torque_largest_Nm", "feedforward_share", "feedback_share", "samples_limited",
    "failure",
)  # fmt: skip
"""Columns of the table of loops; those from rms_rad on are empty for a failure."""

_motion = lru_cache(maxsize=4)(reference_motion)

RESTLESS = "does not come to rest"
"""A failure: the loop is unstable, or its measurements are too coarse for its gains."""


@dataclass(frozen=True)
class FeedforwardPlan:
    """The grid of a study."""

    scene: Scene  # the plant, with its reference motion
    period_ns: int = 1_000_000  # control period
    bandwidths: tuple[float, ...] = (20.0, 60.0, 180.0)  # of the feedback [rad/s]
    seed: int = 8  # of all noise; every loop draws the same numbers
    errors: tuple[ModelError, ...] = tuple(model_errors())
    multiples: tuple[int, ...] = (1, 2, 4, 8)  # periods for the order of the hold
    # samples, for the limits of the bandwidth
    delays: tuple[int, ...] = (0, 1, 2, 3, 4, 5)


@dataclass(frozen=True)
class FeedforwardStudy:
    """Result of a study.

    Attributes:
        plan, seconds: its grid, and the length of the motion [s].
        loops: a row for each error, mode and bandwidth, columns as in COLUMNS.
        holds: feedforward alone, exact model: instant `at` of the torque that is held,
            period_s, largest error of gamma [rad].
        unheld: the same with torques as a function of time: error, and its estimate
            [rad].
        limits: largest stable bandwidths of computed torque [rad/s] by delay in
            samples: theory, ideal (the plant of the theory), real (the plant as it is).

    """

    plan: FeedforwardPlan
    seconds: float
    loops: DataFrame
    holds: DataFrame
    unheld: tuple[float, float]
    limits: DataFrame

    def rms(self, error: str, mode: str, bandwidth: float) -> float:
        """Root of the mean square error of all gamma [rad].

        Nan where the loop failed.
        """
        rows = self.loops[(self.loops.error == error) & (self.loops["mode"] == mode)]
        if mode != OPEN_LOOP:
            rows = rows[rows.bandwidth_rad_per_s == bandwidth]
        return float(rows.rms_rad.iloc[0]) if len(rows) else math.nan

    def benefit(self, error: str, bandwidth: float) -> float:
        """RMS(pd) / RMS(feedforward_pd) at equal gains.

        Nan where one of them failed.
        """
        return self.rms(error, "pd", bandwidth) / self.rms(
            error, "feedforward_pd", bandwidth
        )

    def least_benefit(self, error: str, bandwidth: float) -> float:
        """Return the bound of the benefit by linear theory.

        Bodies of the model weigh SHARE too much.
        """
        exact = self.rms("nominal", "feedforward_pd", bandwidth)
        return 1.0 / (SHARE + exact / self.rms(error, "pd", bandwidth))

    @property
    def failed(self) -> DataFrame:
        """The loops that failed, in the order of their footnotes."""
        return self.loops[self.loops.failure != ""]

    def orders(self) -> dict[str, float]:
        """Power of the period with which the error of a hold falls, by instant."""
        groups = self.holds.groupby("at", sort=False)
        return {str(at): slope(group.period_s, group.error) for at, group in groups}


def feedforward_study(
    plan: FeedforwardPlan, *, workers: int = 0, shown: bool = False
) -> FeedforwardStudy:
    """Run the grid on all cores; the same bits for any number of workers.

    Errors that the plant cannot have, as unknown friction where there is none, are left
    out.

    Raises:
        InputError: the scene has no reference motion, or one that cannot be made.
        SingularConfiguration: a singularity lies on the path.

    """
    scene, motion = plan.scene, _motion(plan.scene)
    errors = [
        error
        for error in plan.errors
        if error.name == "nominal" or error.changes(scene)
    ]
    basic = SampledControl(period=plan.period_ns / NANOSECONDS)
    shown_as = f"{scene.name:<16}" if shown else ""
    limits = [replace(basic, delay=delay) for delay in plan.delays]
    schemes = [
        replace(basic, mode=mode, bandwidth=bandwidth)
        for mode in MODES
        for bandwidth in ((basic.bandwidth,) if mode == OPEN_LOOP else plan.bandwidths)
    ]
    holds = [
        replace(
            basic,
            mode=OPEN_LOOP,
            feedforward_at=at,
            period=plan.period_ns * n / NANOSECONDS,
        )
        for at in HELD_INSTANTS
        for n in plan.multiples
    ]
    tracked = list(itertools.product(errors, schemes))
    return FeedforwardStudy(
        plan,
        motion.duration,
        data_frame(
            run_jobs(partial(_track, plan), tracked, shown_as, workers), COLUMNS
        ),
        data_frame(run_jobs(partial(_held, scene), holds, shown_as, workers)),
        _unheld(scene),
        data_frame(
            run_jobs(partial(_limit, scene), limits, shown_as, workers),
            ("delay", "theory", "ideal", "real"),
        ),
    )


def _track(
    plan: FeedforwardPlan, job: tuple[ModelError, SampledControl]
) -> dict[str, Any]:
    """Run a loop with a model error: its row of the table."""
    error, settings = job
    motion, open_loop = _motion(plan.scene), settings.mode == OPEN_LOOP
    named = {
        "scene": plan.scene.name,
        "error": error.name,
        "mode": settings.mode,
        "bandwidth_rad_per_s": None if open_loop else settings.bandwidth,
        "damping_ratio": settings.damping_ratio,
        "period_s": settings.period,
        "seed": plan.seed,
    }
    model, settings = error.model(plan.scene), replace(settings, **error.channel)
    loop = ControlLoop(model, motion, settings, plan.scene, plan.seed, REST_S)
    track, limited, failure = run_loop(loop)
    if failure:
        return named | {"failure": failure}
    found = TrackingMetrics(track, int(limited.sum()))
    late = track.time >= motion.duration + 0.5 * REST_S
    swing, saturated = (
        float(np.ptp(track.error[late], axis=0).max()),
        limited[late].any(),
    )
    if not open_loop and (saturated or not swing <= found.band):
        cause = ", torques at their limit" if saturated else ""
        return named | {"failure": f"{RESTLESS}: swings by {swing:.1g} rad{cause}"}
    power = found.torque_rms**2
    shares = [
        float(np.nansum(share * power) / power.sum()) if power.any() else None
        for share in found.shares
    ]
    numbers = (
        float(np.sqrt(np.mean(found.rms**2))),
        float(found.largest.max()),
        found.settling,
        float(np.sqrt(power.mean())),
        float(found.torque_largest.max()),
        *shares,
        found.limited,
        "",
    )
    return named | dict(zip(COLUMNS[len(named) :], numbers, strict=True))


def _limit(plant: Scene, settings: SampledControl) -> dict[str, Any]:
    ideal, real = (
        ControlLoop(each, _motion(each), settings, each)
        for each in (loops.ideal_plant(plant), plant)
    )
    return {
        "delay": settings.delay,
        "theory": loops.bandwidth_in_theory(real),
        "ideal": loops.bandwidth_limit(ideal),
        "real": loops.bandwidth_limit(real),
    }


def _held(plant: Scene, settings: SampledControl) -> dict[str, Any]:
    """Find the largest error of gamma under feedforward alone.

    Nan where the loop fails.
    """
    track, _, failure = run_loop(ControlLoop(plant, _motion(plant), settings, plant))
    error = math.nan if failure else float(np.abs(track.error).max())
    return {"at": settings.feedforward_at, "period_s": settings.period, "error": error}


def _unheld(plant: Scene) -> tuple[float, float]:
    """Hold nothing: return the largest error of gamma [rad].

    Also return the error estimate at the end [rad].
    """
    inverse, motion = InverseDynamics(plant), _motion(plant)

    def torque(time: float) -> Vector3:
        return inverse.reference_torque(motion.at(time))

    found = simulate(
        loops.at_start(plant, motion),
        torque,
        motion.duration,
        method="dop853",
        tolerance=1e-12,
        t_eval=np.linspace(0.0, motion.duration, 21),
    )
    desired = [motion.at(t).gamma for t in found.t.tolist()]
    return float(np.abs(desired - found.gamma).max()), found.error_estimate


def report(options: argparse.Namespace) -> bool:
    """Run a study; print it, and write feedforward.csv, .json, .md and .png."""
    study = feedforward_study(FeedforwardPlan(load(options.scene)), shown=True)
    print(page(study), flush=True)
    drawn = draw_study(study, title(study))
    files = {
        ".csv": study.loops,
        ".json": document(study),
        ".md": page(study),
        ".png": drawn,
    }
    publish(options.out, "feedforward", files)
    return True


def rms_table(study: FeedforwardStudy) -> DataFrame:
    """Return RMS errors as texts, and pd / feedforward_pd.

    Errors are by model error, bandwidth and mode.
    """
    failed = (
        study.failed[["error", "mode", "bandwidth_rad_per_s"]]
        .fillna(0.0)
        .to_numpy()
        .tolist()
    )
    footnotes = {
        tuple(key): f"[{number}]" for number, key in enumerate(failed, start=1)
    }
    rows = []
    for error, bandwidth in itertools.product(
        study.loops.error.unique(), study.plan.bandwidths
    ):
        row = {"error": error, "rad/s": f"{bandwidth:g}"}
        for mode in MODES:
            key = error, mode, 0.0 if mode == OPEN_LOOP else bandwidth
            row[mode] = footnotes.get(key, f"{study.rms(error, mode, bandwidth):.1e}")
        if bandwidth != study.plan.bandwidths[0]:
            row[OPEN_LOOP] = ""
        benefit = study.benefit(error, bandwidth)
        row["pd / feedforward_pd"] = "-" if math.isnan(benefit) else f"{benefit:.3g}"
        rows.append(row)
    return data_frame(rows)


def title(study: FeedforwardStudy) -> str:
    """Return scene and settings in one line."""
    plan, period = study.plan, f"control period {study.plan.period_ns / 1e6:g} ms"
    text = f"Feedforward on {plan.scene.name}: {study.seconds:g} s of motion, {period}"
    return f"{text}, damping ratio {study.loops.damping_ratio[0]:g}, seed {plan.seed}"


def findings(study: FeedforwardStudy) -> Iterator[str]:
    """Yield predictions of the theory beside what was found, line by line."""
    for at, order in study.orders().items():
        cells = ", ".join(
            f"{hold.error:.2e} rad at {1e3 * hold.period_s:g} ms"
            for hold in study.holds.itertuples()
            if hold.at == at
        )
        yield (
            f"Exact model, feedforward alone, torque at the {at} of the hold: {cells};"
            f" order {order:.3f}, theory {ORDERS[at]}"
        )
    yield (
        f"Torque as a function of time, nothing held: {study.unheld[0]:.1e} rad; error"
        f" estimate of the integrator {study.unheld[1]:.1e} rad"
    )
    for sign in "+-":
        error = f"inertia {sign}{SHARE:.0%}"
        for bandwidth in study.plan.bandwidths:
            benefit, bound = (
                study.benefit(error, bandwidth),
                study.least_benefit(error, bandwidth),
            )
            if not math.isnan(benefit + bound):
                yield (
                    f"{error}, {bandwidth:g} rad/s: the error of feedforward_pd is"
                    f" {benefit:.2f} times smaller than that of pd with equal gains;"
                    f" theory: at least {bound:.2f}"
                )
    yield (
        "Largest stable bandwidth of computed_torque [rad/s]: theory; without friction;"
        " as it is"
    )
    for row in study.limits.itertuples():
        yield (
            f"  delay {row.delay}: {row.theory:8.1f} {row.ideal:9.1f} "
            f"({row.ideal / row.theory - 1.0:+.2%}) {row.real:9.1f}"
        )


def page(study: FeedforwardStudy) -> str:
    """Write a study as one Markdown page."""
    failures = []
    for number, row in enumerate(study.failed.itertuples(), start=1):
        at = "" if row.mode == OPEN_LOOP else f" at {row.bandwidth_rad_per_s:g} rad/s"
        failures.append(f"[{number}] {row.error}, {row.mode}{at}: {row.failure}")
    given = {
        "about": title(study),
        "findings": findings(study),
        "table": rms_table(study),
    }
    return render(PAGES / "feedforward.md", failures=failures, **given)


_LOOKS = ((GREY, "D"), (BLUE, "o"), (GREEN, "^"), (VERMILION, "s"), (ORANGE, "v"))
MARKERS = dict(zip(MODES, _LOOKS, strict=True))
"""Colour and marker of each mode."""

_FAILED, _SPREAD = 12.0, 0.13


@styled
def draw_study(study: FeedforwardStudy, title: str) -> Figure:
    """Draw a study: a panel of errors a bandwidth, orders of the hold, and limits."""
    figure = Figure(figsize=(12.5, 10.6))
    figure.suptitle(title, fontsize=12)
    halves: Any = figure.subfigures(2, 1, height_ratios=(1.6, 1.0))
    upper, lower = halves
    bandwidths = study.plan.bandwidths
    panels = upper.subplots(
        1, len(bandwidths), sharex=True, sharey=True, squeeze=False
    )[0]
    for axes, bandwidth in zip(panels, bandwidths, strict=True):
        _errors(axes, study.loops, bandwidth)
    holds, limits = lower.subplots(1, 2)
    _holds(holds, study)
    _limits(limits, study.limits)
    marks = [*((mode, *look) for mode, look in MARKERS.items()), ("failed", INK, "x")]
    handles = [
        Line2D([], [], color=colour, marker=marker, linestyle="", label=name)
        for name, colour, marker in marks
    ]
    upper.legend(
        handles=handles, loc="outside upper center", ncols=7, fontsize=9, frameon=False
    )
    return figure


def _errors(axes: Axes, loops: DataFrame, bandwidth: float) -> None:
    names = list(loops.error.unique())
    low, high = 0.5 * loops.rms_rad.min(), 2.0 * loops.rms_rad.max()
    axes.set_xscale("log")
    own = loops.bandwidth_rad_per_s
    for loop in loops[(own == bandwidth) | own.isna()].itertuples():
        colour, marker = MARKERS[loop.mode]
        place = MODES.index(loop.mode)
        y = names.index(loop.error) + (place - 2) * _SPREAD
        if loop.failure:
            x = high * _FAILED ** ((place + 0.5) / len(MODES))
            axes.plot(
                x,
                y,
                marker,
                color=colour,
                markerfacecolor="white",
                markersize=5.5,
                zorder=3,
            )
            axes.plot(x, y, "x", color=INK, markersize=4, zorder=4)
        else:
            axes.plot(loop.rms_rad, y, marker, color=colour, markersize=5.5, zorder=3)
    for row in range(len(names)):
        axes.axhline(row + 0.5, color="#cccccc", linewidth=0.6)
    axes.axvspan(high, high * _FAILED, color="#f4e3d7", linewidth=0)
    axes.set(xlim=(low, high * _FAILED), ylim=(len(names) - 0.5, -0.5))
    axes.set_yticks(range(len(names)), names)
    axes.tick_params(axis="y", length=0)
    axes.grid(axis="y", visible=False)
    axes.set(title=f"feedback at {bandwidth:g} rad/s", xlabel="RMS error of γ [rad]")


def _holds(axes: Axes, study: FeedforwardStudy) -> None:
    """Error over period, each with its theory's line through the shortest period."""
    holds, unheld, orders = study.holds, study.unheld[0], study.orders()
    for (at, group), colour, marker in zip(
        holds.groupby("at", sort=False), (BLUE, VERMILION), ("o", "s"), strict=False
    ):
        x, y = 1e3 * group.period_s.to_numpy(), group.error.to_numpy()
        order, theory = orders[at], ORDERS[at]
        axes.plot(x, y[0] * (x / x[0]) ** theory, color=colour, linewidth=1.0)
        axes.plot(x, y, marker, color=colour, markersize=7,
                  label=f"torque at the {at} of the hold: order {order:.3f} "
                        f"(line: {theory})")  # fmt: skip
    axes.axhline(
        unheld, color=GREEN, linewidth=2.0, label=f"nothing held: {unheld:.0e} rad"
    )
    periods = 1e3 * np.unique(holds.period_s.to_numpy())
    axes.set_xscale("log", base=2)
    axes.set(yscale="log", ylim=(0.2 * unheld, 10.0 * holds.error.max()))
    axes.set_xticks(periods, [f"{period:g}" for period in periods])
    axes.set(xlabel="control period [ms]", ylabel="largest error of γ [rad]")
    axes.set_title("Exact model, feedforward alone")
    axes.legend(loc="center left", bbox_to_anchor=(0.0, 0.33), fontsize=8.5)


def _limits(axes: Axes, limits: DataFrame) -> None:
    """Largest stable bandwidth over delay: theory as a line, simulations as markers."""
    axes.set_title("computed_torque, exact model: stable below")
    axes.set(
        xlabel="delay of the command [samples]",
        ylabel="largest stable bandwidth [rad/s]",
    )
    if limits.empty:
        return
    axes.fill_between(
        limits.delay, 1.0, limits.theory, color=GREEN, alpha=0.12, linewidth=0.0
    )
    axes.plot(limits.delay, limits.theory, color=GREEN,
              label="poles of the sampled double integrator")  # fmt: skip
    axes.plot(limits.delay, limits.ideal, "^", color=GREEN, markersize=8,
              label="simulated, without friction and lag")  # fmt: skip
    axes.plot(
        limits.delay,
        limits.real,
        "o",
        color=BLUE,
        markersize=8,
        markerfacecolor="none",
        label="simulated, the plant as it is",
    )
    axes.set(yscale="log", ylim=(0.5 * limits.theory.min(), 2.0 * limits.theory.max()))
    axes.set_xticks(limits.delay)
    axes.legend(loc="upper right", fontsize=8.5)


def document(study: FeedforwardStudy) -> dict[str, Any]:
    """Return everything as JSON has it."""
    return {
        "scene": study.plan.scene.name,
        "motion_s": study.seconds,
        "loops": records(study.loops),
        "holds": records(study.holds),
        "exact_holds": dict(zip(("error", "estimate"), study.unheld, strict=True)),
        "limits": records(study.limits),
    }


def main(words: Sequence[str] | None = None) -> int:
    """Run the study of the page from the command line."""
    scene = {"default": "reach", "help": "with a motion: name, or path of a .yaml file"}
    return run(report, "feedforward", DOCS, words, scene=scene)


if __name__ == "__main__":
    raise SystemExit(main())
