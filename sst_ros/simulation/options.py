# SPDX-License-Identifier: Apache-2.0
"""Options of a simulation, arguments of a step: what is allowed, and budgets by default."""

from __future__ import annotations

import operator
from typing import Any

from sst_ros.dynamics.traced_dynamics import Dynamics, ode_with_work
from sst_ros.errors import InputError, Problem
from sst_ros.integration.methods import METHODS, Rosenbrock
from sst_ros.scene.scene import SineTorque
from sst_ros.state import finite_vector

AUTO = "auto"
INTEGRATORS = (AUTO, *METHODS)

EQUATIONS = ("quaternion", "virtual_work")
"""Equations of motion: in the quaternion and the body rate, or the paper's Eqs. 1 to 92."""

WHOLE_MOTION_BUDGET = 10_000_000
"""`step_budget` where a step may be a whole motion, offline: minutes in plain Python."""

_PLAIN_BUDGET = 3_000_000
"""Operations a step in plain Python may take: 0.12 s at 37 ns each, on a 3 GHz core."""
_STAGE_OPERATIONS = 100
"""Operations of a stage beside the scene's equations, which have 140 to 450."""
_COMPILED_BUDGET = 120_000
"""Evaluations a compiled step may take: 0.12 s, for an accepted step of 36 takes 36 us in all."""
_VIRTUAL_WORK_BUDGET = 1000
"""Evaluations of the paper's equations that a step may take: 0.3 s, at 0.3 ms each."""


def default_budget(dynamics: Dynamics, equations: str, *, compiled: bool) -> int:
    """Return evaluations that keep a step below about 0.2 s: 5,000 to 12,000 in plain Python."""
    if equations == "virtual_work":
        return _VIRTUAL_WORK_BUDGET
    if compiled:
        return _COMPILED_BUDGET
    return _PLAIN_BUDGET // (len(ode_with_work(dynamics).program.steps) + _STAGE_OPERATIONS)


def refuse_bad_options(
    integrator: str, tolerance: float, equations: str, step_budget: int | None, *, compiled: bool
) -> None:
    """Raise InputError for the first option of a `Simulation` that is not allowed."""
    explicit = not (compiled or isinstance(METHODS.get(integrator), Rosenbrock))
    for name, value, good, allowed in (
        ("integrator", integrator, integrator in INTEGRATORS, _one_of(INTEGRATORS)),
        ("tolerance", tolerance, tolerance > 0.0, "must be > 0"),
        ("step_budget", step_budget, step_budget is None or step_budget > 0, "must be > 0"),
        ("equations", equations, equations in EQUATIONS, _one_of(EQUATIONS)),
        ("equations", equations, explicit or equations != "virtual_work",
         "needs an explicit integrator and compiled = False"),
    ):  # fmt: skip
        if not good:
            raise InputError("simulation", [Problem(name, value, allowed)])


def refuse_bad_step(torque: Any, dt_ns: Any, count: Any, moment: Any) -> tuple[int, int]:
    """Return the length [ns] and the number of steps, or name each argument that is not allowed.

    Raises:
        InputError: one is not allowed.

    """
    length, number = _whole(dt_ns), _whole(count)
    if length > 0 and number > 0 and finite_vector(torque) and finite_vector(moment):
        return length, number
    problems = []
    if not (callable(torque) or isinstance(torque, SineTorque)) and finite_vector(torque) is None:
        allowed = "must be three finite numbers [N m], a SineTorque or a function of t [s]"
        problems.append(Problem("torque", torque, allowed))
    if finite_vector(moment) is None:
        problems.append(Problem("moment", moment, "must be three finite numbers [N m]"))
    if length <= 0:
        problems.append(Problem("dt_ns", dt_ns, "must be > 0, in whole nanoseconds"))
    if number <= 0:
        problems.append(Problem("count", count, "must be > 0, a whole number"))
    if problems:
        raise InputError("step", problems)
    return length, number


def _whole(value: Any) -> int:
    """Return a whole number of any type as int, 0 for anything else."""
    if type(value) is int:
        return value
    try:
        return 0 if isinstance(value, bool) else operator.index(value)
    except TypeError:
        return 0


def _one_of(names: tuple[str, ...]) -> str:
    return "must be one of " + ", ".join(names)
