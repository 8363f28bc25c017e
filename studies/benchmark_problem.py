# SPDX-License-Identifier: Apache-2.0
"""The manipulator as a benchmark problem of multibody dynamics.

The page has its statement, its reference and solutions. Two methods that share no
equation of motion find the reference: the body rates of the star in extended precision
by fixed steps, and the paper's virtual work in the actuator angles, with the assembly
solved at each evaluation, by SciPy with an error control of its own.
"""

from __future__ import annotations

import argparse
import time
from functools import partial
from statistics import median
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from scipy.integrate import solve_ivp

from benchmark.measure import time_in_turn
from sst_ros.errors import InputError, Problem
from sst_ros.mechanism import kinematics, virtual_work
from sst_ros.mechanism.geometry import Array, Geometry, angle_between, quaternion_of
from sst_ros.report.reference_solution import (
    InitialValueProblem,
    ReferenceSolution,
    solve_reference,
)
from sst_ros.report.results import data_frame, publish, records, render
from sst_ros.scene import scene as scenes
from sst_ros.scene.scene import Scene
from sst_ros.simulation.simulate import simulate
from studies import DOCS, PAGES, run

if TYPE_CHECKING:
    from collections.abc import Callable

    from pandas import DataFrame

NAME = "example2_heavy"
INTERVAL_NS = 10_000_000
"""Between the rows of the data file."""

DIGITS = 13
"""Decimals of the data file; the two methods agree in all of them."""

COLUMNS = (
    "t [s]", "gamma_1 [rad]", "gamma_2 [rad]", "gamma_3 [rad]",
    "q_x", "q_y", "q_z", "q_w", "omega_x [rad/s]", "omega_y [rad/s]", "omega_z [rad/s]",
)  # fmt: skip
SETTINGS = (
    ("auto", 1e-6),
    ("auto", 1e-9),
    ("dop853", 1e-12),
    ("dopri5", 1e-6),
    ("rk4", 1e-6),
)
"""Method and tolerance [rad] of each solution by this package."""

ROUNDS = 9


class Agreement(NamedTuple):
    """Largest differences of the two methods.

    They are those of the orientation [rad], gamma [rad] and gamma_dot [rad/s].
    """

    orientation: float
    gamma: float
    gamma_dot: float


def solve_apart(
    scene: Scene, times: Array, tolerance: float = 1e-13
) -> tuple[Array, Array]:
    """Solve the paper's equations by SciPy.

    Return (gamma, gamma_dot) (m, 6) and quaternions (m, 4).
    """
    if scene.torque is None:
        raise InputError(scene.name, [Problem("torque", None, "must be given")])
    mechanism, geometry = virtual_work.Mechanism.of(scene), Geometry.of(scene)
    torque = scene.torque.at

    def slope(t: float, x: Array) -> Array:
        at = virtual_work.posture(geometry, x[:3])
        return np.concatenate(
            [
                x[3:],
                virtual_work.direct_dynamics(mechanism, at, x[3:], np.array(torque(t))),
            ]
        )

    start = np.array([*scene.initial.gamma, 0.0, 0.0, 0.0])
    given: dict[str, Any] = {"rtol": tolerance, "atol": tolerance, "max_step": 2e-3}
    # Samples end steps: a step's polynomial has less accuracy than the step.
    rows = [start]
    for begin, end in zip(times[:-1].tolist(), times[1:].tolist(), strict=True):
        rows.append(
            solve_ivp(slope, (begin, end), rows[-1], "DOP853", **given).y[:, -1]
        )
    turned = [kinematics.admissible(geometry, row[:3]).rotation for row in rows]
    return np.array(rows), np.array([quaternion_of(one) for one in turned])


def compare(problem: InitialValueProblem, reference: ReferenceSolution) -> Agreement:
    """Solve by the second method and compare at all rows of the data file."""
    rows, quaternions = solve_apart(problem.scene, problem.times)
    states = reference.states.astype(float)
    angles, rates = problem.joints(reference.states).astype(float)
    return Agreement(
        float(angle_between(quaternions, states[:, :4]).max()),
        float(np.abs(rows[:, :3] - angles.T).max()),
        float(np.abs(rows[:, 3:] - rates.T).max()),
    )


def data_file(problem: InitialValueProblem, reference: ReferenceSolution) -> str:
    """Write the data file: a head, and a row for each instant with DIGITS decimals."""
    angles = problem.joints(reference.states)[0].T
    columns = problem.times[:, None], angles, reference.states[:, :7]
    rows = np.hstack([np.asarray(one, dtype=float) for one in columns])
    # q and -q are one orientation
    rows[:, 4:8] *= np.where(rows[:, 7:8] < 0.0, -1.0, 1.0)
    lines = [
        ",".join([f"{row[0]:.2f}", *(f"{x:.{DIGITS}f}" for x in row[1:])])
        for row in rows
    ]
    return "\n".join([",".join(COLUMNS), *lines, ""]).replace(
        f"-{0:.{DIGITS}f}", f"{0:.{DIGITS}f}"
    )


def solve_by_package(problem: InitialValueProblem, truth: Array) -> DataFrame:
    """Solutions of this package: error as the problem defines it, processor time."""
    calls: dict[tuple[str, float], Callable[[], Any]] = {
        (method, tolerance): partial(
            simulate,
            problem.scene,
            method=method,
            tolerance=tolerance,
            t_eval=problem.times,
        )
        for method, tolerance in SETTINGS
    }
    solutions = {setting: call() for setting, call in calls.items()}
    times = time_in_turn(calls, ROUNDS, shortest=0.02, clock=time.process_time)
    return data_frame(
        {
            "method": method,
            "tolerance [rad]": f"{tolerance:.0e}",
            "error [rad]": f"{angle_between(solution.quaternion, truth).max():.1e}",
            "evaluations": solution.evaluations,
            "processor time [ms]": f"{1e3 * median(times[method, tolerance]):.3g}",
        }
        for (method, tolerance), solution in solutions.items()
    )


def report(options: argparse.Namespace) -> bool:
    """Write the page, its data file and the solutions.

    True where both methods agree.
    """
    problem = InitialValueProblem(scenes.load(NAME), INTERVAL_NS)
    reference = solve_reference(problem)
    agreement = compare(problem, reference)
    truth = reference.states[:, :4].astype(float)
    solutions = solve_by_package(problem, truth)
    text = page(problem.scene, reference, agreement, solutions)
    document = {"agreement": agreement._asdict(), "solutions": records(solutions)}
    files = {".csv": data_file(problem, reference), ".json": document, ".md": text}
    publish(options.out, "benchmark_problem", files)
    print(text)
    return max(agreement) < 0.5 * 10.0**-DIGITS


def page(
    scene: Scene,
    reference: ReferenceSolution | None = None,
    agreement: Agreement | None = None,
    solutions: DataFrame | None = None,
) -> str:
    """Write the problem as a Markdown page; without results the statement alone."""
    given = {
        "scene": scene,
        "reference": reference,
        "agreement": agreement,
        "columns": COLUMNS,
    }
    return render(
        PAGES / "benchmark_problem.md", solutions=solutions, digits=DIGITS, **given
    )


if __name__ == "__main__":
    raise SystemExit(run(report, "benchmark_problem", DOCS, None))
