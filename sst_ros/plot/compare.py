# SPDX-License-Identifier: Apache-2.0
"""Several runs in one picture, and the differences between them.

Runs are laid on each other by the time since the start of each, in whole nanoseconds;
only samples that both have are compared, nothing is interpolated.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, TypeAlias

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from sst_ros.errors import refuse_unless
from sst_ros.figures import (
    DEGREES,
    LINES,
    SMALLEST_SHOWN,
    break_lines,
    hide_zeros,
    legend,
    styled,
)
from sst_ros.mechanism.geometry import Array, angle_between
from sst_ros.plot import pictures, workspace
from sst_ros.plot.pictures import (
    ERROR_KEY,
    JOINT_LETTERS,
    JOINT_STATES_KEY,
    ORIENTATION,
    SCENE_KEY,
    TICKS,
    LegCurves,
    Picture,
    draw_legs,
    tick_torques,
)
from sst_ros.recording.recording import Signals

if TYPE_CHECKING:
    from pandas import DataFrame


class DrawnRun(NamedTuple):
    """A run, its name in the legend, and the style of its curves."""

    run: Signals
    name: str
    look: dict[str, Any]


Drawn: TypeAlias = Sequence[DrawnRun]


def _overlay(
    quantity: str, label: str, scale: float = 1.0
) -> Callable[[Drawn], Figure]:
    """Return what draws a quantity of the legs of all runs.

    Below it draws how far the runs are apart.
    """

    def draw(runs: Drawn) -> Figure:
        legs = [
            LegCurves.of(name, run, scale * run.legs(quantity), look)
            for run, name, look in runs
        ]
        _, _, unit = label.partition(" ")
        below = f"largest difference\nfrom the first {unit}"
        figure = draw_legs(label, legs, below)
        axes = figure.axes[-1]
        axes.set_yticks([])  # none until a run differs
        first = runs[0].run
        for run, name, look in runs[1:]:
            rows_of_first, rows = _common(first, run)
            distance = scale * np.abs(
                run.legs(quantity)[rows] - first.legs(quantity)[rows_of_first]
            )
            largest = hide_zeros(distance.max(axis=1, initial=0.0))
            remark = ""
            if np.isfinite(largest).any():
                axes.set_yscale("log")
            elif len(rows) and (distance <= SMALLEST_SHOWN).all():
                remark = ": no difference"
            else:
                remark = ": no samples in common"
            times = run.seconds()[rows]
            times, largest = break_lines(times, largest, run.gaps())
            axes.plot(times, largest, label=name + remark, **look)
        legend(axes)
        return figure

    return draw


def _torques(runs: Drawn) -> Figure:
    """Draw the torques of the ticks of all runs."""
    curves = [LegCurves(name, *tick_torques(run), look) for run, name, look in runs]
    return draw_legs("τ [N m]", curves)


def _sphere(runs: Drawn) -> Figure:
    """Draw the paths of E of all runs in the workspace of the first one's scene."""
    scene = runs[0].run.scene
    assert scene is not None
    paths = [(name, pictures.directions(run), look) for run, name, look in runs]
    return workspace.draw_paths(scene, paths)


COMPARISON_PICTURES = {
    "gamma": Picture(
        "Actuator angles", (JOINT_STATES_KEY,), _overlay("gamma", "γ [deg]", DEGREES)
    ),
    "gamma_dot": Picture(
        "Actuator rates", (JOINT_STATES_KEY,), _overlay("gamma_dot", "γ̇ [rad/s]")
    ),
    "tracking_error": Picture(
        "Desired less measured angles",
        (ERROR_KEY,),
        _overlay("gamma_error", "Δγ [rad]"),
    ),
    "torques": Picture("Applied torques", (TICKS,), _torques),
    "sphere": Picture("Path of E in the workspace", (ORIENTATION, SCENE_KEY), _sphere),
}


@styled
def draw_comparison(
    runs: Sequence[Signals], folder: Path, only: Sequence[str] = ()
) -> tuple[list[Path], dict[str, str]]:
    """Write pictures of several runs into `folder`, as `pictures.draw_run` does of one.

    Raises InputError where there are too many runs, too.
    """
    requirement = f"must be 2 to {len(LINES)} bags, which can be distinguished"
    refuse_unless(
        "compare", ("bags", len(runs), 2 <= len(runs) <= len(LINES), requirement)
    )
    all_runs = [
        DrawnRun(run, name, look)
        for run, name, look in zip(runs, labels(runs), LINES, strict=False)
    ]
    paths: list[Path] = []
    missing: dict[str, str] = {}
    for name in pictures.chosen_names(only, COMPARISON_PICTURES):
        title, needs, make = COMPARISON_PICTURES[name]
        drawn: list[DrawnRun] = []
        incomplete: list[str] = []  # names of runs that lack something
        for candidate in all_runs:
            if set(needs) & set(candidate.run.missing):
                incomplete.append(candidate.name)
            else:
                drawn.append(candidate)
        if incomplete:
            names = ", ".join(incomplete)
            missing[name] = f"without {names}: no {' or '.join(needs)} there"
        if len(drawn) > 1 and drawn[0].run is runs[0]:
            paths += pictures.save(make(drawn), title, folder, f"compare_{name}")
        else:
            missing[name] = f"not drawn: {missing[name]}"
    return paths, missing


def differences(runs: Sequence[Signals]) -> DataFrame:
    """Compare each run with the first one, at the stamps that both have.

    A row of the table is a joint of a run, by its label, or the star, whose difference
    is the angle between the orientations: largest difference of the angle and root of
    its mean square [rad], and the same of the rate [rad/s]; samples in common, of how
    many. What cannot be compared is nan.
    """
    from pandas import concat

    tables = {}
    for run, label in zip(runs[1:], labels(runs)[1:], strict=True):
        tables[label] = _difference_table(runs[0], run)
    return concat(tables, names=["run", "joint"])


def _difference_table(first: Signals, run: Signals) -> DataFrame:
    """Compare one run with the first, a row a joint; see `differences`."""
    from pandas import DataFrame, Series, concat

    names = [f"{angle}_{leg}" for angle in JOINT_LETTERS for leg in (1, 2, 3)]
    rate_names = [f"{angle}_dot_{leg}" for angle in JOINT_LETTERS for leg in (1, 2, 3)]
    rows_of_first, rows = _common(first, run)
    absent = {*first.missing, *run.missing}

    def difference(columns: Sequence[str]) -> Array:
        return run.take(*columns)[rows] - first.take(*columns)[rows_of_first]

    angles = DataFrame(columns=names, dtype=float)
    rates = DataFrame(columns=names, dtype=float)
    if JOINT_STATES_KEY not in absent:
        angles = DataFrame(difference(names), columns=names)
        rates = DataFrame(difference(rate_names), columns=names)
    turn = Series(dtype=float)
    if ORIENTATION not in absent:
        of_first = first.take(*pictures.QUATERNION_COLUMNS)[rows_of_first]
        of_run = run.take(*pictures.QUATERNION_COLUMNS)[rows]
        turn = Series(angle_between(of_first, of_run))
    angles = concat([angles, turn.rename("star")], axis=1)
    table = DataFrame(index=angles.columns)
    table["max_rad"] = angles.abs().max()
    table["rms_rad"] = (angles**2).mean() ** 0.5
    table["rate_max_rad_per_s"] = rates.abs().max()
    table["rate_rms_rad_per_s"] = (rates**2).mean() ** 0.5
    count = len(run.tables["samples"]) if "samples" in run.tables else 0
    return table.assign(samples=len(rows), of=count)


def _common(first: Signals, run: Signals) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Places of the samples that two runs have at the same time since their starts."""
    if "samples" not in first.tables or "samples" not in run.tables:
        return np.empty(0, dtype=np.intp), np.empty(0, dtype=np.intp)
    _, rows_of_first, rows = np.intersect1d(
        first.time_ns("samples"),
        run.time_ns("samples"),
        assume_unique=True,
        return_indices=True,
    )
    return rows_of_first, rows


def labels(runs: Sequence[Signals]) -> list[str]:
    """Name each run by its folder, or by number and path where folders share a name.

    Runs of one bag have the names of their namespaces.
    """
    if len({run.bag.path.resolve() for run in runs}) == 1:
        names = [run.namespace for run in runs]
    else:
        names = [run.bag.path.resolve().name for run in runs]
    if len(set(names)) == len(names):
        return names
    return [f"{index}: {run.bag.path}" for index, run in enumerate(runs, 1)]


def difference_text(runs: Sequence[Signals]) -> str:
    """Write the differences as text, a table for each run."""
    paragraphs = [
        f"Differences from {labels(runs)[0]}, at samples that both have at the same"
        " time since the start of each run\n(whole nanoseconds, nothing interpolated)"
    ]
    for label, table in differences(runs).groupby(level="run", sort=False):
        samples = table.pop("samples").iloc[0]
        of = table.pop("of").iloc[0]
        rows = table.droplevel("run").rename_axis(None)
        text = rows.to_string(na_rep="-", float_format="{:.3e}".format)
        paragraphs.append(f"{label}: {samples} of {of} samples\n{text}")
    return "\n\n".join(paragraphs) + "\n"
