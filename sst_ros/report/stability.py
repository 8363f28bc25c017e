# SPDX-License-Identifier: Apache-2.0
"""The stability report of one scene: its stable steps, and what it survives.

Stable steps are found along its motion. The eigenvalues of the linearised dynamics
along the motion give the longest step in which each method is stable. Then the scene is
run as it is and with other numbers: ten times the torque, ten times the rates, a
hundred times the stiffness and the friction, from poses at its limits and beside its
nearest singularity. Each run has to end with a value within its error estimate, which a
run for a hundredth of the tolerance checks, or with a limit or an error that names the
reason.
"""

from __future__ import annotations

import itertools
import math
import re
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from matplotlib.figure import Figure
from pandas import DataFrame
from scipy.spatial.transform import Rotation

from sst_ros.dynamics import kernel
from sst_ros.errors import Check, SstError, refuse_unless, suggestion
from sst_ros.figures import BLUE, MARKERS, VERMILION, legend, note, styled
from sst_ros.integration.many_runs import run_many
from sst_ros.integration.methods import METHODS
from sst_ros.mechanism import kinematics, workspace
from sst_ros.mechanism.geometry import (
    Geometry,
    angle_between,
    quaternion_of,
    rotation_matrix,
)
from sst_ros.report import scene_summary as advised
from sst_ros.report.results import (
    WHOLE_RUN_S,
    data_frame,
    provenance,
    publish,
    records,
    render,
)
from sst_ros.scene.scene import Scene, with_initial
from sst_ros.scene.schema import key_of, leaves
from sst_ros.simulation.simulate import simulate
from sst_ros.simulation.trajectory import Trajectory
from sst_ros.state import Array

EIGENVALUE_INSTANTS = 50  # at which the motion is linearised
FINER = 1e-2  # share of the tolerance by which a second run checks the first one
# The estimate of a run holds if the true error is at most so many times as large, or
# rounding [rad].
FACTOR = 10.0
PASSING_ROUNDING = 1e-13
LARGER = 10.0  # factor of torques and rates
STIFFER = 100.0  # of stiffness and friction
# margin of the workspace [rad] below which a limit is passed, and not met to rounding
PASSED_MARGIN = -1e-9
TURN_BISECTIONS = 40  # of the turns between two of TURNS: to rounding
# of the star about each axis, up to pi: limits and singularities lie between them
TURNS = 181
SPIN = 1.0  # angular velocity with which a run goes from a limit into it [rad/s]
BESIDE = 1e-3  # angle between a singular pose and the start beside it [rad]

Change: TypeAlias = "Callable[[Scene, Trajectory], Scene | str]"
"""Makes another scene of one and its motion, or gives the reason why there is none."""


class ChangedRun(NamedTuple):
    """A row of the report."""

    description: str  # what differs from the scene
    change: Change


class StabilityReport(NamedTuple):
    """Steps along the motion, and the runs."""

    scene: str
    steps: DataFrame
    """A row an instant: t_s, decay and oscillation, the largest -Re and abs(Im) of the
    eigenvalues [1/s], and the longest stable step of each method [s], inf for every
    one.
    """
    advice: str
    runs: DataFrame
    """A row each. name, change: of the row, and what is other than in the scene.
    passed: it ended with a value within its estimate, or with a named reason; None
    where the scene has nothing to change. result: in words. method: what `auto` took.
    error, estimate: distance of the orientation at the end from a finer run, and what
    the run estimated [rad], nan if unknown. wall_s: computing time of both runs [s].
    """

    @property
    def passed(self) -> bool:
        """Whether no run failed."""
        return False not in self.runs.passed.tolist()


def write_stability_report(
    scene: Scene, folder: Path, only: Sequence[str] = ()
) -> bool:
    """Examine a scene, print the report and write its files into `folder`.

    The files are stability.csv, .json, .md and .png. `only` names rows of CHANGED_RUNS;
    by default all. Returns whether no run failed. Raises InputError where a name is
    unknown or `folder` cannot be written, SstError where the scene cannot start.
    """
    report = examine_stability(scene, only, visible=True)
    page = stability_page(report)
    print(page)
    document = {
        "scene": report.scene,
        "advice": report.advice,
        "steps": records(report.steps.replace(math.inf, None)),
        "runs": records(report.runs),
    }
    files = {
        ".csv": report.runs,
        ".json": document,
        ".md": page,
        ".png": draw_stability(report),
    }
    publish(folder, "stability", files)
    return report.passed


def examine_stability(
    scene: Scene, only: Sequence[str] = (), *, visible: bool = False
) -> StabilityReport:
    """Find the stable steps along a motion, and run its scene with other numbers."""
    requirement = f"must be one of {', '.join(CHANGED_RUNS)}"
    checks: list[Check] = []
    for name in only:
        hint = suggestion(name, CHANGED_RUNS)
        checks.append(("--only", name, name in CHANGED_RUNS, requirement + hint))
    refuse_unless("report stability", *checks)
    chosen = [name for name in CHANGED_RUNS if name in only or not only]
    seconds = min(scene.duration or WHOLE_RUN_S, advised.LONGEST_S)
    began = time.perf_counter()
    motion = simulate(scene, duration=seconds, tolerance=advised.ADVICE_TOLERANCE)
    if visible:
        about = max(1.0, 2.0 * (time.perf_counter() - began)) * len(chosen)
        print(
            f"{len(chosen)} runs of {seconds:g} s, each at two tolerances: about"
            f" {about:.0f} s"
        )
    steps = _stable_steps(scene, motion)

    def run(name: str) -> dict[str, Any]:
        row = CHANGED_RUNS[name]
        outcome = _run(row.change(scene, motion), seconds)
        return {"name": name, "change": row.description, **outcome}

    # One after another: computing times are those of a core that is free.
    label = f"{scene.name:<16}" if visible else ""
    runs = [row for _, row in run_many(run, chosen, label=label)]
    advice = advised.step_advice(scene).text
    return StabilityReport(scene.name, data_frame(steps), advice, data_frame(runs))


def _stable_steps(scene: Scene, motion: Trajectory) -> list[dict[str, Any]]:
    """Return rates and longest stable steps along a motion, see `StabilityReport`."""
    steps = []
    instants = motion.at(np.linspace(motion.t[0], motion.t[-1], EIGENVALUE_INSTANTS))
    states = np.hstack([instants.quaternion, instants.body_rate])
    if scene.lags:
        states = np.hstack([states, instants.torque])
    for t, state, torque in zip(
        instants.t.tolist(), states.tolist(), instants.torque.tolist(), strict=True
    ):
        values = advised.eigenvalues(scene, state, torque)
        row = {
            "t_s": t,
            "decay": max(0.0, -values.real.min()),
            "oscillation": abs(values.imag).max(),
        }
        for name, method in METHODS.items():
            row[name] = advised.largest_stable_step(method, values)
        steps.append(row)
    return steps


def _run(changed: Scene | str, seconds: float) -> dict[str, Any]:
    """Run a scene at two tolerances: how it ended, as the last columns of a row."""
    row: dict[str, Any] = {
        "passed": None,
        "result": changed,
        "method": "",
        "error": math.nan,
        "estimate": math.nan,
    }
    began = time.perf_counter()
    try:
        if isinstance(changed, Scene):
            row |= _run_twice(changed, seconds)
    except SstError as fault:  # it names the reason
        reason = str(fault).splitlines()[0]
        row |= {"passed": True, "result": f"{type(fault).__name__}: {reason}"}
    return row | {"wall_s": time.perf_counter() - began}


def _run_twice(scene: Scene, seconds: float) -> dict[str, Any]:
    """Compare a run with a finer one."""
    tolerance = advised.ADVICE_TOLERANCE
    with np.errstate(all="ignore"):
        run = simulate(scene, duration=seconds, tolerance=tolerance)
        fine = simulate(scene, duration=seconds, tolerance=FINER * tolerance)
    end = min(float(run.t[-1]), float(fine.t[-1]))
    apart = angle_between(run.at(end).quaternion[0], fine.at(end).quaternion[0])
    error = float(apart)
    # A run that ends where it starts has no estimate.
    allowed_error = np.fmax(FACTOR * run.error_estimate, PASSING_ROUNDING)
    holds = run.status < 0 or bool(error <= allowed_error)
    same_end = run.status == fine.status
    result = run.message
    if not same_end:
        result = f"{run.message}; finer: {fine.message}"
    return {
        "passed": same_end and holds,
        "result": result,
        "method": run.method,
        "error": error,
        "estimate": run.error_estimate,
    }


def _scale(factor: float, keys: str, absent: str) -> Change:
    """Multiply all numbers of a scene whose key is `keys`, a regular expression."""

    def change(scene: Scene, _: Trajectory) -> Scene | str:
        scaled = {}
        for place, value in leaves(scene).items():
            key = key_of(place)
            if re.fullmatch(keys, key):
                scaled[key] = factor * value
        return scene.with_values(scaled) if scaled else f"the scene has no {absent}"

    return change


def _faster(scene: Scene, motion: Trajectory) -> Scene | str:
    """Start with LARGER rates: than those given, or those that it reaches from rest."""
    rates = np.array(scene.initial.gamma_dot)
    if not rates.any():
        rates = np.abs(motion.gamma_dot).max(axis=0)
    if not rates.any():
        return "nothing moves"
    return scene.with_values({"initial.gamma_dot": LARGER * rates})


def _turn_to(*names: str, spin: float = 0.0, before: float = 0.0) -> Change:
    """Start at the nearest pose in which a measure of the workspace is zero.

    Or by an angle `before` it. The star turns on at the rate `spin`.
    """

    def change(scene: Scene, motion: Trajectory) -> Scene | str:
        zeros = [_first_zeros(scene, motion, name, before) for name in names]
        axes, angles, poses = map(np.concatenate, zip(*zeros, strict=True))
        if not len(angles):
            return "no turn of the star meets it"
        # Where a limit is met as well, or before, that one ends the run.
        geometry = Geometry.of(scene)
        beyond = _measure(scene, poses).margin < PASSED_MARGIN
        nearest = int(np.lexsort((angles, beyond))[0])
        rotation = poses[nearest]
        rate = rotation.T @ (spin * axes[nearest])
        quaternion = quaternion_of(rotation)
        state = (*quaternion.tolist(), *rate.tolist())
        rates = np.array(kernel.joints(kernel.model_of(scene), state).gamma_dot)
        gamma = kinematics.inverse(geometry, rotation)[0]
        start = {"gamma": gamma, "gamma_dot": rates, "orientation": quaternion}
        return with_initial(scene, start)

    return change


def _first_zeros(
    scene: Scene, motion: Trajectory, name: str, before: float
) -> tuple[Array, Array, Array]:
    """Turn the star from its start about many axes up to where a measure becomes zero.

    Returns axes (n, 3) and angles (n,) [rad] where it does, and the poses (n, 3, 3)
    there, or by an angle `before` it.
    """
    start = rotation_matrix(motion.quaternion[0])
    # towards the corners, edges and faces of a cube
    corners = itertools.product((-1.0, 0.0, 1.0), repeat=3)
    axes = np.array([axis for axis in corners if any(axis)])
    axes /= np.linalg.norm(axes, axis=1)[:, None]

    def turn(axes: Array, angles: Array) -> Array:
        turns = Rotation.from_rotvec(angles[:, None] * axes)
        return np.asarray(turns.as_matrix() @ start)

    def values(axes: Array, angles: Array) -> Array:
        return np.asarray(getattr(_measure(scene, turn(axes, angles)), name))

    angles = np.linspace(0.0, np.pi, TURNS)
    measures = values(np.repeat(axes, TURNS, axis=0), np.tile(angles, len(axes)))
    sign = np.sign(measures[0])  # at the start
    beyond = sign * measures.reshape(len(axes), TURNS) <= 0.0
    meets = beyond.any(axis=1) & ~beyond[:, 0]
    axes = axes[meets]
    first = beyond.argmax(axis=1)[meets]
    if not len(axes):  # SciPy before 1.16 makes no rotations of none
        return axes, np.zeros(0), np.zeros((0, 3, 3))
    low = angles[first - 1]
    high = angles[first]
    for _ in range(TURN_BISECTIONS):
        middle = 0.5 * (low + high)
        inside = sign * values(axes, middle) > 0.0
        low = np.where(inside, middle, low)
        high = np.where(inside, high, middle)
    return axes, low, turn(axes, np.maximum(low - before, 0.0))


def _measure(scene: Scene, rotation: Array) -> workspace.Measures:
    """Return the measures of the workspace at orientations, shape (n, 3, 3)."""
    geometry = Geometry.of(scene)
    return workspace.measures(
        geometry, kinematics.inverse(geometry, rotation)[0], rotation
    )


CHANGED_RUNS = {
    "as-it-is": ChangedRun("nothing", lambda scene, _: scene),
    "torque": ChangedRun(
        "ten times the torque",
        _scale(LARGER, r"torque\.amplitude.*", "torques of its own"),
    ),
    "rates": ChangedRun("ten times the rates at the start", _faster),
    "stiffness": ChangedRun(
        "a hundred times the stiffness",
        _scale(STIFFER, r".*\.stiffness", "springs and no elastic stops"),
    ),
    "friction": ChangedRun(
        "a hundred times the friction",
        _scale(STIFFER, r"friction\..*\.(viscous|coulomb|static)", "friction"),
    ),
    "stroke": ChangedRun(
        "from an end of the stroke into it", _turn_to("stroke", spin=SPIN)
    ),
    "edge": ChangedRun("from beta = 0 into it", _turn_to("edge", spin=SPIN)),
    "reach": ChangedRun("from the largest beta into it", _turn_to("reach", spin=SPIN)),
    "singularity": ChangedRun(
        f"from {BESIDE:g} rad beside the nearest singularity",
        _turn_to("det_j1", "det_j2", before=BESIDE),
    ),
}
"""Rows by the name that `--only` takes."""


def stability_page(report: StabilityReport) -> str:
    """Write the report as Markdown."""
    values = {
        "factor": FACTOR,
        "rounding": PASSING_ROUNDING,
        "methods": METHODS,
        "inf": math.inf,
    }
    return render("stability.md", found=report, **values)


@styled
def draw_stability(report: StabilityReport) -> Figure:
    """Draw eigenvalues and stable steps along the motion."""
    figure = Figure(figsize=(11.0, 4.6))
    left, right = figure.subplots(1, 2)
    steps = report.steps.set_index("t_s").replace([math.inf, 0.0], math.nan)
    looks = {"logy": True, "linewidth": 1.8, "xlabel": "time t [s]"}
    steps[["decay", "oscillation"]].plot(
        ax=left,
        ylabel="fastest rate of the eigenvalues [1/s]",
        color=[BLUE, VERMILION],
        style=["-", "--"],
        **looks,
    )
    limited = [name for name in METHODS if steps[name].notna().any()]
    colours = [MARKERS[name][0] for name in limited]
    if limited:
        steps[limited].plot(
            ax=right, ylabel="longest stable step [s]", color=colours, **looks
        )
    free = ", ".join(name for name in METHODS if name not in limited)
    right.plot([], [], " ", label=f"{free}: every step")
    legend(left)
    legend(right)
    figure.suptitle(f"Stability of {report.scene}", fontsize=12)
    note(figure, provenance(), 185)
    return figure
