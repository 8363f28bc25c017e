# SPDX-License-Identifier: Apache-2.0
"""Work-precision study: error and computing time of methods on a scene.

Every method and setting is studied. Each method has settings from coarse to fine. Fixed
steps use no error estimate. Tolerances go to `Simulation`, whose estimate of the global
error is counted and timed with it. The report shows the studies on the terminal, in
files, and as one page.
"""

from __future__ import annotations

import math
import timeit
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullFormatter
from pandas import DataFrame, Series

from sst_ros.errors import SstError
from sst_ros.figures import INK, MARKERS, Looks, note, styled
from sst_ros.integration.many_runs import run_many
from sst_ros.integration.method_steps import steps_of
from sst_ros.integration.methods import METHODS, RK4, Method
from sst_ros.integration.point import Drive
from sst_ros.report.reference_solution import (
    InitialValueProblem,
    ReferenceSolution,
    SolverRun,
    solve_reference,
)
from sst_ros.report.results import data_frame, provenance, publish, records, render
from sst_ros.report.scene_summary import StepAdvice, step_advice
from sst_ros.scene import scene as scenes
from sst_ros.scene.scene import Scene
from sst_ros.simulation.simulate import simulate
from sst_ros.state import STAR, cached_property

FIXED = "fixed steps"
TOLERANCE_KIND = "tolerance"
_STEPS_PER_INTERVAL = (1, 2, 5, 10, 20, 50, 100, 200, 500, 1000, 2000)
_TOLERANCES = tuple(10.0**-n for n in range(4, 14))
# orientation errors for which the fastest setting is named [rad]
ERROR_TARGETS = (1e-3, 1e-6, 1e-9, 1e-12)
TARGET = 1e-9  # the one in titles

# errors are reported if they are so many times the reference's own
ABOVE_REFERENCE = 100.0
USELESS = 0.1  # an orientation error above this [rad] is a failure
REFERENCE_ROUNDING = 2e-14  # finer steps are not expected to give less than this [rad]
# no finer settings are tried after a run that took longer than this [s]
LONGEST_RUN_S = 0.4
# are tried even where they take longer: a busy machine must not empty the grid
LEAST_SETTINGS = 3
# A run is timed again for so long [s], from twice to this number of times: the shortest
# time is that of a core that is free.
TIMING_S = 0.15
MOST_TIMINGS = 14
_SHOWN_REASON = 40  # characters of a failure on the terminal

ERROR_COLUMN = "largest_orientation_rad"
ERROR_COLUMNS = [
    f"{when}_{quantity}"
    for when in ("final", "largest")
    for quantity in ("orientation_rad", "gamma_rad", "gamma_dot_rad_per_s")
]
STUDY_COLUMNS = (
    "scene",
    "method",
    "kind",
    "setting",
    "evaluations",
    "wall_min_s",
    *ERROR_COLUMNS,
    "failure",
)
"""Columns of the solver grid. `setting` is the length of the steps [s] or the
tolerance; `evaluations` has rejected steps in it, and is empty where they are not
counted; errors are empty for a failure, and `failure` for a success.
"""


@dataclass(frozen=True)
class WorkPrecision:
    """Result of a work-precision study of a scene."""

    scene: str
    seconds: float  # time span [s]
    ends: str  # why it ends before the scene's duration; empty where it does not
    reference: ReferenceSolution
    # the solver grid, columns as in STUDY_COLUMNS; settings from coarse to fine
    rows: DataFrame
    advice: StepAdvice  # as `scene show` prints it
    measured: float | None
    """Error of `simulate` with that advice [rad]; None where a limit stops it."""
    proven: str = "-"  # what that error is proven to be below, or why it is not

    @property
    def floor(self) -> float:
        """Smallest orientation error that is reported [rad]."""
        return ABOVE_REFERENCE * self.reference.own.orientation

    @property
    def rests(self) -> bool:
        """Whether nothing moves, so that every setting is right to rounding.

        So it is with scenes that a controller drives along a reference motion.
        """
        states = self.reference.states[:, STAR]
        return bool(np.abs(states - states[0]).max() < REFERENCE_ROUNDING)

    def best(self, target: float) -> Series[Any] | None:
        """Return the fastest setting with an error of at most `target` [rad].

        The error is that of the orientation. A setting counts only if at least one
        finer setting of its method was tried and every one of them is as good: a coarse
        setting whose errors happen to cancel is no recommendation.
        """
        if self.rests:
            return None
        good: list[Any] = []
        for _, group in self.rows.groupby(["method", "kind"], sort=False):
            errors = group[ERROR_COLUMN].astype(float).to_numpy()
            bad = np.flatnonzero(~(errors <= target))  # failures have no error
            first_good = int(bad[-1]) + 1 if len(bad) else 0
            good += group.index[first_good:-1].tolist()
        if not good:
            return None
        return self.rows.loc[good].sort_values("wall_min_s", kind="stable").iloc[0]

    @cached_property
    def fastest(self) -> dict[float, Series[Any]]:
        """The fastest setting for each of ERROR_TARGETS that has one.

        Targets below the floor are left out.
        """
        fastest = {}
        for target in ERROR_TARGETS:
            row = self.best(target) if target >= self.floor else None
            if row is not None:
                fastest[target] = row
        return fastest


def study_scene(scene: Scene, *, visible: bool = False) -> WorkPrecision:
    """Solve a scene with every method and setting and compare with the reference.

    Progress is `visible` on the terminal. Raises what the problem and its reference do.
    """
    problem = InitialValueProblem(scene)
    grid = list(list_settings(problem))
    truth = solve_reference(problem)
    refine = partial(_refine, problem=problem, truth=truth)
    # One after another: computing times are those of a core that is free.
    label = f"{scene.name:<16}" if visible else ""
    rows = []
    for _, refined in run_many(refine, grid, label=label):
        rows += refined
    motion = simulate(scene, duration=problem.seconds, t_eval=problem.times)
    measured = None
    if len(motion) > problem.count:  # else a limit stops it before
        states = np.hstack([motion.quaternion, motion.body_rate])
        _, largest = problem.errors(states, truth.states)
        measured = largest.orientation
    return WorkPrecision(
        scene=scene.name,
        seconds=problem.seconds,
        ends=problem.ends,
        reference=truth,
        rows=data_frame(({"scene": scene.name, **row} for row in rows), STUDY_COLUMNS),
        advice=step_advice(scene),
        measured=measured,
        proven=proven_error(scene, duration=problem.seconds, t_eval=problem.times),
    )


def proven_error(*arguments: Any, **options: Any) -> str:
    """Return the proven bound of the error of `simulate` as a cell of a table.

    It takes what `certify` takes. Where the proof ends early the time is named, where
    nothing is proven there is a dash, and both have a reason.
    """
    try:
        # They need python-flint, which others do not.
        from sst_ros.proof.balls import write_down, write_up
        from sst_ros.proof.certify import certify

        proven = certify(*arguments, **options)
    except SstError as refused:
        return f"-: {str(refused).splitlines()[0]}"
    if math.isinf(proven.error):
        return f"-: {proven.reason}"
    bound = f"{write_up(proven.error)} rad"
    if not proven.reason:
        return bound
    return f"{bound} to {write_down(proven.until, 4)} s: {proven.reason}"


class SolverSetting(NamedTuple):
    """One point of the grid."""

    method: str
    kind: str  # FIXED or TOLERANCE_KIND
    setting: float  # step [s] or tolerance
    solve: Callable[[], SolverRun]  # raises SstError, ArithmeticError or ValueError
    timed: Callable[[], object]  # does the same work with the least overhead


def list_settings(problem: InitialValueProblem) -> Iterator[Iterator[SolverSetting]]:
    """Yield the settings by method and kind, each from coarse to fine."""
    for method in METHODS.values():
        if not problem.clamped:  # fixed steps know no limit of torque
            yield _list_steps(problem, method)
        if method is not RK4:  # its steps in a run are fixed
            yield _list_tolerances(problem, method.name)


def _list_steps(
    problem: InitialValueProblem, method: Method
) -> Iterator[SolverSetting]:
    machine = steps_of(problem.system, method)
    drive = Drive(tuple(problem.drive))
    for steps in _STEPS_PER_INTERVAL:
        h = problem.interval / steps
        start = list(problem.start)
        timed = partial(machine.fixed, 0.0, h, steps * problem.count, start, drive)
        solve = partial(problem.run_steps, machine, steps)
        yield SolverSetting(method.name, FIXED, h, solve, timed)


def _list_tolerances(
    problem: InitialValueProblem, method: str
) -> Iterator[SolverSetting]:
    for tolerance in _TOLERANCES:
        run = partial(problem.run_simulation, problem.simulation(method, tolerance))
        yield SolverSetting(method, TOLERANCE_KIND, tolerance, run, run)


def _refine(
    settings: Iterator[SolverSetting],
    problem: InitialValueProblem,
    truth: ReferenceSolution,
) -> list[dict[str, Any]]:
    """Go from coarse to fine until a run takes long, or two errors reach the floor."""
    rows: list[dict[str, Any]] = []
    below = 0
    floor = max(ABOVE_REFERENCE * truth.own.orientation, REFERENCE_ROUNDING)
    for setting in settings:
        row = _measure(setting, problem, truth)
        rows.append(row)
        below += row.get(ERROR_COLUMN, math.inf) < floor
        takes_long = row["wall_min_s"] > LONGEST_RUN_S and len(rows) >= LEAST_SETTINGS
        if takes_long or below > 1:
            break
    return rows


def _measure(
    setting: SolverSetting, problem: InitialValueProblem, truth: ReferenceSolution
) -> dict[str, Any]:
    """Run one setting, and return its row of the grid."""
    row: dict[str, Any] = {
        "method": setting.method,
        "kind": setting.kind,
        "setting": setting.setting,
        "evaluations": None,
        "wall_min_s": 0.0,
        "failure": "",
    }
    with np.errstate(all="ignore"):
        try:
            run = setting.solve()
            row["evaluations"] = run.evaluations
            wall = timeit.timeit(setting.timed, number=1)
            if wall < LONGEST_RUN_S:
                turns = min(MOST_TIMINGS, max(2, int(TIMING_S / wall)))
                wall = min(wall, *timeit.repeat(setting.timed, number=1, repeat=turns))
            row["wall_min_s"] = wall
            if not np.isfinite(run.states[:, STAR]).all():
                raise ArithmeticError("not finite")
            final, largest = problem.errors(run.states, truth.states)
            useful = largest.orientation <= USELESS and math.isfinite(largest.gamma_dot)
            if not useful:
                raise ArithmeticError(f"off by {largest.orientation:.1g} rad")
            row |= dict(zip(ERROR_COLUMNS, (*final, *largest), strict=True))
        except (SstError, ArithmeticError, ValueError) as error:
            row["failure"] = str(error).splitlines()[0] if str(error) else "not finite"
    return row


def write_accuracy_report(names: Sequence[str], folder: Path) -> list[WorkPrecision]:
    """Study scenes one after another, print each, and write what is finished.

    Files in `folder`: accuracy.csv, .json, .md, and accuracy_SCENE.png. Raises SstError
    where a scene is refused or cannot start, or `folder` cannot be written.
    """
    studies: list[WorkPrecision] = []
    for each in [scenes.load(name) for name in names]:
        study = study_scene(each, visible=True)
        studies.append(study)
        print(accuracy_text(study), flush=True)
        rows = [row for result in studies for row in records(result.rows)]
        files: dict[str, Any] = {
            ".csv": data_frame(rows),
            ".json": {"rows": rows},
            ".md": accuracy_page(studies),
        }
        if not study.rests:
            files[f"accuracy_{each.name}.png"] = draw_accuracy(study)
        publish(folder, "accuracy", files)
    return studies


def name_fastest(study: WorkPrecision) -> str:
    """Return the fastest setting for TARGET as a sentence."""
    best = study.best(TARGET)
    if study.rests:
        return (
            "It rests: it has no torques of its own, a controller drives it along its"
            " motion."
        )
    if best is not None:
        return f"{TARGET:.0e} rad over {study.seconds:g} s: {_setting(best)}."
    least = study.rows[ERROR_COLUMN].astype(float).min()
    reached = "every one failed"
    if math.isfinite(least):
        reached = f"the least error is {least:.0e} rad"
    return (
        f"No setting that was tried reaches {TARGET:.0e} rad with every finer one;"
        f" {reached}."
    )


def _setting(row: Series[Any]) -> str:
    """Name a setting, with its computing time."""
    setting = f"{1e3 * row.setting:.4g} ms steps"
    if row.kind == TOLERANCE_KIND:
        setting = f"tolerance {row.setting:.0e}"
    wall_ms = 1e3 * row.wall_min_s
    digits = ".2g" if wall_ms < 99.5 else ".0f"  # two, or all before the point
    return f"{row.method}, {setting}, {wall_ms:{digits}} ms"


def accuracy_text(study: WorkPrecision) -> str:
    """Format a study for the terminal: its part of the page, and the grid."""
    columns = study.rows.drop(
        columns=["scene", "final_gamma_rad", "final_gamma_dot_rad_per_s"]
    )
    columns["failure"] = [
        f"FAILED: {reason[:_SHOWN_REASON]}" if reason else ""
        for reason in study.rows.failure
    ]
    grid = columns.to_string(index=False, na_rep="-", float_format=lambda x: f"{x:.1e}")
    return accuracy_page([study], full=False) + f"\n{grid}\n"


def accuracy_page(studies: Sequence[WorkPrecision], *, full: bool = True) -> str:
    """Write studies as one Markdown page, or without its introduction and summary."""
    values = {"targets": ERROR_TARGETS, "fastest": name_fastest, "setting": _setting}
    return render("accuracy.md", whole=full, studies=studies, **values)


@styled
def draw_accuracy(study: WorkPrecision) -> Figure:
    """Draw the largest error of the orientation over wall time.

    The fastest setting for each of ERROR_TARGETS is marked.
    """
    rows = study.rows
    floor = study.floor
    figure = Figure(figsize=(10.5, 6.2))
    axes = figure.subplots()
    axes.set(
        xscale="log", yscale="log", ylabel="largest error of the orientation [rad]"
    )
    axes.set_xlabel(f"wall time for {study.seconds:g} s of motion [ms]")
    drawn = rows[(rows[ERROR_COLUMN] >= floor) & (rows[ERROR_COLUMN] > 0.0)]
    for (name, kind), group in drawn.groupby(["method", "kind"], sort=False):
        colour, marker = MARKERS[name]
        looks: Looks = {"color": colour, "marker": marker, "markersize": 6.5}
        if kind == TOLERANCE_KIND:
            looks |= {"markerfacecolor": "white", "linestyle": "--"}
        axes.plot(
            1e3 * group.wall_min_s,
            group[ERROR_COLUMN],
            label=f"{name}, {kind}",
            **looks,
        )
    errors = np.array([1e-3, 1.0])  # of an empty picture
    if len(drawn):
        errors = drawn[ERROR_COLUMN].astype(float).to_numpy()
    low = 10.0 ** math.floor(math.log10(errors.min()) - 0.7)
    axes.set_ylim(low, 10.0 ** math.ceil(math.log10(errors.max()) + 0.01))
    if floor > low:
        text = "100 × the reference's own error: none plotted"
        axes.axhspan(low, floor, color="#999999", alpha=0.25, linewidth=0, label=text)
    ring: Looks = {"markersize": 14, "markerfacecolor": "none", "markeredgewidth": 1.4}
    for target, row in study.fastest.items():
        axes.axhline(target, color=INK, linewidth=0.9, linestyle=":")
        place = 1e3 * row.wall_min_s, max(row[ERROR_COLUMN], floor)
        label = "fastest for a dotted line" if target == min(study.fastest) else None
        axes.plot(*place, "o", color=INK, zorder=5, label=label, **ring)
    axes.yaxis.set_major_locator(LogLocator(numticks=12))
    axes.yaxis.set_minor_formatter(NullFormatter())
    if axes.get_legend_handles_labels()[0]:  # none where every setting failed
        figure.legend(fontsize=8, frameon=False, loc="outside right center")
    figure.suptitle(
        f"{study.scene}: error against wall time\n{name_fastest(study)}", fontsize=12
    )
    note(figure, f"Reference: {study.reference.how}. {provenance()}", 145)
    return figure
