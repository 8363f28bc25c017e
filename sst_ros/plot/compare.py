# SPDX-License-Identifier: Apache-2.0
"""Several runs in one picture, and the differences between them.

Runs are laid on each other by the time since the start of each, in whole nanoseconds; only samples
that both have are compared, nothing is interpolated.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from sst_ros.errors import InputError, Problem
from sst_ros.mechanism.geometry import angle_between
from sst_ros.plot import pictures, workspace
from sst_ros.plot.pictures import DEGREES, Picture, draw_legs, tick_torques
from sst_ros.plot.style import LINES, hide_zeros, legend, stack, styled
from sst_ros.recording.recording import Signals
from sst_ros.recording.topic_tables import SCENE

if TYPE_CHECKING:
    from pandas import DataFrame

Drawn: TypeAlias = "Sequence[tuple[Signals, str, dict[str, Any]]]"
"""Runs with their names and styles."""


def _overlay(quantity: str, label: str, scale: float = 1.0) -> Callable[[Drawn], Figure]:
    """Return what draws a quantity of the legs of all runs."""
    return lambda runs: draw_legs(
        label, [(name, run.seconds(), scale * run.legs(quantity), look) for run, name, look in runs]
    )


def _torques(runs: Drawn) -> Figure:
    return draw_legs("τ [N m]", [(name, *tick_torques(run), look) for run, name, look in runs])


def _difference(runs: Drawn) -> Figure:
    figure, panels = stack(["largest |Δγₖ| [rad]", "largest |Δγ̇ₖ| [rad/s]"], 2.6)
    first = runs[0][0]
    for axes, name in zip(panels, ("gamma", "gamma_dot"), strict=True):
        for run, label, style in runs[1:]:
            here, there = _common(first, run)
            apart = np.abs(run.legs(name)[there] - first.legs(name)[here])
            largest = apart.max(axis=1, initial=0.0)
            axes.plot(run.seconds()[there], hide_zeros(largest), label=label, **style)
        axes.set_yscale("log")
    legend(panels[0])
    return figure


def _sphere(runs: Drawn) -> Figure:
    scene = runs[0][0].scene
    assert scene is not None
    paths = [(label, pictures.directions(run), look) for run, label, look in runs]
    return workspace.draw_paths(scene, paths)


JOINTS, ERROR, TICKS, TURN = "joint_states", "tracking_error", "applied_torques", "orientation"
PICTURES = {
    "gamma": Picture("Actuator angles", (JOINTS,), _overlay("gamma", "γ [deg]", DEGREES)),
    "gamma_dot": Picture("Actuator rates", (JOINTS,), _overlay("gamma_dot", "γ̇ [rad/s]")),
    "tracking_error": Picture(
        "Desired less measured angles", (ERROR,), _overlay("gamma_error", "Δγ [rad]")
    ),
    "torques": Picture("Applied torques", (TICKS,), _torques),
    "difference": Picture("Differences from the first run", (JOINTS,), _difference),
    "sphere": Picture("Path of E in the workspace", (TURN, SCENE.key), _sphere),
}


@styled
def draw_comparison(
    runs: Sequence[Signals], out: Path, only: Sequence[str] = ()
) -> tuple[list[Path], dict[str, str]]:
    """Write the pictures of several runs into `out`, as `pictures.draw_run` does of one.

    Raises:
        InputError: there are too many runs, a name is unknown, or `out` cannot be written.

    """
    if not 2 <= len(runs) <= len(LINES):
        allowed = f"must be 2 to {len(LINES)} bags, which can be distinguished"
        raise InputError("plot", [Problem("compare", len(runs), allowed)])
    paths: list[Path] = []
    missing: dict[str, str] = {}
    for name in pictures.known(only, PICTURES):
        title, needs, make = PICTURES[name]
        all_runs = list(zip(runs, labels(runs), LINES, strict=False))
        drawn = [each for each in all_runs if not set(needs) & set(each[0].missing)]
        if left := [label for run, label, _ in all_runs if set(needs) & set(run.missing)]:
            missing[name] = f"without {', '.join(left)}: no {' or '.join(needs)} there"
        if len(drawn) > 1 and drawn[0][0] is runs[0]:
            paths += pictures.save(make(drawn), title, out, f"compare_{name}")
        else:
            missing[name] = f"not drawn: {missing[name]}"
    return paths, missing


def differences(runs: Sequence[Signals]) -> DataFrame:
    """Compare each run with the first one, at the stamps that both have.

    A row of the table is a run, by its label: samples in common, of how many; largest difference of
    an angle gamma_k, and root of the mean square over samples and legs [rad]; the same of the rates
    [rad/s]; largest angle between the orientations of the star [rad]; nan for what cannot be
    compared.
    """
    from pandas import DataFrame, Series

    first = runs[0]
    rows: list[dict[str, float]] = []
    for run in runs[1:]:
        (here, there), absent = _common(first, run), {*first.missing, *run.missing}
        of = len(run.tables["samples"]) if "samples" in run.tables else 0
        row: dict[str, float] = {"samples": len(here), "of": of}
        for quantity, name, unit in (("gamma", "γ", "rad"), ("gamma_dot", "rate", "rad/s")):
            apart = Series(dtype=float)
            if JOINTS not in absent:
                apart = Series(np.ravel(run.legs(quantity)[there] - first.legs(quantity)[here]))
            row[f"{name} max [{unit}]"] = apart.abs().max()
            row[f"{name} rms [{unit}]"] = (apart**2).mean() ** 0.5
        turn = Series(dtype=float)
        if TURN not in absent:
            one, other = (each.take(*pictures.QUATERNION) for each in (first, run))
            turn = Series(angle_between(one[here], other[there]))
        rows.append(row | {"turn max [rad]": turn.max()})
    return DataFrame(rows, index=labels(runs)[1:])


def _common(first: Signals, run: Signals) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Places of the samples that two runs have at the same time since their starts."""
    if "samples" not in first.tables or "samples" not in run.tables:
        return np.empty(0, dtype=np.intp), np.empty(0, dtype=np.intp)
    both = np.intersect1d(first.time_ns("samples"), run.time_ns("samples"), True, True)
    return both[1], both[2]


def labels(runs: Sequence[Signals]) -> list[str]:
    """Name each run by its folder, or by number and path where two folders have one name."""
    names = [run.bag.path.resolve().name for run in runs]
    if len(set(names)) == len(names):
        return names
    return [f"{index}: {run.bag.path}" for index, run in enumerate(runs, 1)]


def difference_text(runs: Sequence[Signals]) -> str:
    """Write the differences as text."""
    shown = differences(runs)
    counts = shown.pop("samples").astype(str) + " of " + shown.pop("of").astype(str)
    shown.insert(0, "samples", counts)
    return (
        f"Differences from {labels(runs)[0]}, at samples that both have at the same time since "
        "the start of each run\n(whole nanoseconds, nothing interpolated):\n\n"
        f"{shown.to_string(na_rep='-', float_format=lambda x: f'{x:.3e}')}\n"
    )
