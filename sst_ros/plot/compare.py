# SPDX-License-Identifier: Apache-2.0
"""Several runs in one picture, and the differences between them.

Runs are laid on each other by the time since the start of each, in whole nanoseconds;
only samples that both have are compared, nothing is interpolated.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

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
from sst_ros.mechanism.geometry import angle_between
from sst_ros.plot import pictures, workspace
from sst_ros.plot.pictures import (
    JOINT_LETTERS,
    LegCurves,
    Picture,
    draw_legs,
    tick_torques,
)
from sst_ros.recording.recording import Signals
from sst_ros.recording.topic_tables import SCENE_TOPIC

if TYPE_CHECKING:
    from pandas import DataFrame

Drawn: TypeAlias = "Sequence[tuple[Signals, str, dict[str, Any]]]"
"""Runs with their names and styles."""


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
        below = f"largest difference\nfrom the first {label.partition(' ')[2]}"
        figure, first = draw_legs(label, legs, below), runs[0][0]
        axes = figure.axes[-1]
        axes.set_yticks([])  # none until a run differs
        for run, name, look in runs[1:]:
            here, there = _common(first, run)
            apart = scale * np.abs(
                run.legs(quantity)[there] - first.legs(quantity)[here]
            )
            largest = hide_zeros(apart.max(axis=1, initial=0.0))
            if differs := bool(np.isfinite(largest).any()):
                axes.set_yscale("log")
            same = len(there) and bool((apart <= SMALLEST_SHOWN).all())
            result = ""
            if not differs:
                result = ": no difference" if same else ": no samples in common"
            times = run.seconds()[there]
            times, largest = break_lines(times, largest, run.gaps())
            axes.plot(times, largest, label=name + result, **look)
        legend(axes)
        return figure

    return draw


def _torques(runs: Drawn) -> Figure:
    curves = [LegCurves(name, *tick_torques(run), look) for run, name, look in runs]
    return draw_legs("τ [N m]", curves)


def _sphere(runs: Drawn) -> Figure:
    scene = runs[0][0].scene
    assert scene is not None
    paths = [(label, pictures.directions(run), look) for run, label, look in runs]
    return workspace.draw_paths(scene, paths)


JOINT_STATES_KEY, ERROR_KEY, TICKS, TURN_KEY = (
    "joint_states",
    "tracking_error",
    "applied_torques",
    "orientation",
)
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
    "sphere": Picture(
        "Path of E in the workspace", (TURN_KEY, SCENE_TOPIC.key), _sphere
    ),
}


@styled
def draw_comparison(
    runs: Sequence[Signals], out: Path, only: Sequence[str] = ()
) -> tuple[list[Path], dict[str, str]]:
    """Write pictures of several runs into `out`, as `pictures.draw_run` does of one.

    Raises InputError where there are too many runs, too.
    """
    allowed = f"must be 2 to {len(LINES)} bags, which can be distinguished"
    refuse_unless("compare", ("bags", len(runs), 2 <= len(runs) <= len(LINES), allowed))
    paths: list[Path] = []
    missing: dict[str, str] = {}
    for name in pictures.known(only, COMPARISON_PICTURES):
        title, needs, make = COMPARISON_PICTURES[name]
        all_runs = list(zip(runs, labels(runs), LINES, strict=False))
        drawn = [each for each in all_runs if not set(needs) & set(each[0].missing)]
        if left := [
            label for run, label, _ in all_runs if set(needs) & set(run.missing)
        ]:
            missing[name] = f"without {', '.join(left)}: no {' or '.join(needs)} there"
        if len(drawn) > 1 and drawn[0][0] is runs[0]:
            paths += pictures.save(make(drawn), title, out, f"compare_{name}")
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
    from pandas import DataFrame, Series, concat

    first, tables = runs[0], {}
    joints = [f"{kind}_{leg}" for kind in JOINT_LETTERS for leg in (1, 2, 3)]
    rated = [f"{kind}_dot_{leg}" for kind in JOINT_LETTERS for leg in (1, 2, 3)]
    for run, label in zip(runs[1:], labels(runs)[1:], strict=True):
        here, there = _common(first, run)
        absent = {*first.missing, *run.missing}
        angles, rates = (DataFrame(columns=joints, dtype=float) for _ in range(2))
        if JOINT_STATES_KEY not in absent:
            angles, rates = (
                DataFrame(
                    run.take(*names)[there] - first.take(*names)[here], columns=joints
                )
                for names in (joints, rated)
            )
        turn = Series(dtype=float)
        if TURN_KEY not in absent:
            one, other = (
                each.take(*pictures.QUATERNION_COLUMNS) for each in (first, run)
            )
            turn = Series(angle_between(one[here], other[there]))
        angles = concat([angles, turn.rename("star")], axis=1)
        table = DataFrame(index=angles.columns)
        for name, apart in ("max_rad", angles), ("rate_max_rad_per_s", rates):
            table[name] = apart.abs().max()
            table[name.replace("max", "rms")] = (apart**2).mean() ** 0.5
        of = len(run.tables["samples"]) if "samples" in run.tables else 0
        tables[label] = table.assign(samples=len(here), of=of)
    return concat(tables, names=["run", "joint"])


def _common(first: Signals, run: Signals) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Places of the samples that two runs have at the same time since their starts."""
    if "samples" not in first.tables or "samples" not in run.tables:
        return np.empty(0, dtype=np.intp), np.empty(0, dtype=np.intp)
    both = np.intersect1d(first.time_ns("samples"), run.time_ns("samples"), True, True)
    return both[1], both[2]


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
    said = [
        f"Differences from {labels(runs)[0]}, at samples that both have at the same"
        " time since the start of each run\n(whole nanoseconds, nothing interpolated)"
    ]
    for label, table in differences(runs).groupby(level="run", sort=False):
        samples, of = table.pop("samples").iloc[0], table.pop("of").iloc[0]
        shown = table.droplevel("run").rename_axis(None)
        text = shown.to_string(na_rep="-", float_format="{:.3e}".format)
        said.append(f"{label}: {samples} of {of} samples\n{text}")
    return "\n\n".join(said) + "\n"
