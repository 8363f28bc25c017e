# SPDX-License-Identifier: Apache-2.0
"""Direct dynamics of one scene, step by step, up to the end of what is valid."""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from sst_ros.dynamics.initial_state import initial_state
from sst_ros.dynamics.traced_dynamics import Dynamics
from sst_ros.dynamics.virtual_work_derivative import VirtualWorkDerivative
from sst_ros.errors import Diverged, InputError, Problem, StepBudgetExceeded
from sst_ros.integration.adaptive_stepper import (
    BudgetSpent,
    CannotStep,
    EvaluationBudget,
    MethodChange,
)
from sst_ros.integration.applied_torque import Torque
from sst_ros.integration.codegen import numba_version
from sst_ros.integration.methods import METHODS, Rosenbrock
from sst_ros.integration.ode import ode_with_work
from sst_ros.integration.propagator import Point, Propagator
from sst_ros.mechanism.geometry import Geometry
from sst_ros.mechanism.vec3 import axpy, cross, dot, rotation_rows, turned_back
from sst_ros.scene.given import scene_of
from sst_ros.scene.scene import Scene, SineTorque
from sst_ros.state import NANOSECONDS, Joints, State, Vector3

__all__ = [
    "EQUATIONS",
    "INTEGRATORS",
    "NANOSECONDS",
    "WHOLE_MOTION_BUDGET",
    "Simulation",
    "State",
    "Torque",
    "Triple",
]

AUTO = "auto"
INTEGRATORS = (AUTO, *METHODS)

PLAIN_BUDGET = 3_000_000
"""Operations a step in plain Python may take: 0.12 s at 37 ns each, on a 3 GHz core."""
STAGE_OPERATIONS = 100
"""Operations of a stage beside the scene's equations, which have 140 to 450."""
COMPILED_BUDGET = 120_000
"""Evaluations a compiled step may take: 0.12 s, for an accepted step of 36 takes 36 us in all."""

VIRTUAL_WORK_BUDGET = 1000
"""Evaluations of the paper's equations that a step may take: 0.3 s, at 0.3 ms each."""

EQUATIONS = ("quaternion", "virtual_work")
"""Equations of motion: in the quaternion and the body rate, or the paper's Eqs. 1 to 92."""

WHOLE_MOTION_BUDGET = 10_000_000
"""`step_budget` where a step may be a whole motion, offline: minutes in plain Python."""

Triple = Vector3


class _Instant(NamedTuple):
    """What a state is made of, when it is asked for."""

    time_ns: int
    point: Point
    torque: Torque


class Simulation:
    """Direct dynamics of a scene from its initial state.

    Args:
        scene: a Scene, the name of a scene that is shipped, the path of a file, or a mapping with
            the keys of a scene.
        integrator: auto, or a method of `integration.methods.METHODS`.
        tolerance: largest local error of a step: of the quaternion, and of the rate relative to
            its length. RK4 has no error estimate; it takes one pair of steps a call.
        compiled: run under numba; the digits are the same, the first step of a new scene takes
            seconds. Without numba a RuntimeWarning is raised and plain Python runs. Torque
            functions, and sines that the actuators clamp, run in plain Python, with one
            RuntimeWarning.
        equations: "quaternion", the equations of motion in the quaternion and the body rate, or
            "virtual_work", the paper's Eqs. 1 to 92: the same motion, about 20 times slower, by
            explicit methods in plain Python, without the terms that the paper does not have.
        step_budget: evaluations of the right-hand side that one `step` may take. The default keeps
            a step below about 0.2 s: `PLAIN_BUDGET` operations in plain Python (5,000 to 12,000
            evaluations), `COMPILED_BUDGET` evaluations under numba. Long steps of a stiff or fast
            motion may need more. A Jacobian counts as 30 evaluations.

    Attributes:
        geometry: constant vectors of the scene.
        dynamics: traced functions of the scene.
        compiled: whether numba is used.
        step_budget: evaluations that one step may take.

    Raises:
        AssemblyError: the initial gamma has no unique admissible assembly.
        SingularConfiguration: it moves from a parallel singularity.
        InputError: the initial gamma lies outside the stroke, an argument is not allowed, or the
            scene has a term that the equations do not have.

    """

    def __init__(
        self,
        scene: Scene | str | Path | dict[str, Any],
        integrator: str = AUTO,
        *,
        tolerance: float = 1e-10,
        compiled: bool = False,
        equations: str = "quaternion",
        step_budget: int | None = None,
    ) -> None:
        if integrator not in INTEGRATORS:
            allowed = "must be one of " + ", ".join(INTEGRATORS)
            raise InputError("simulation", [Problem("integrator", integrator, allowed)])
        if not tolerance > 0.0:
            raise InputError("simulation", [Problem("tolerance", tolerance, "must be > 0")])
        if step_budget is not None and not step_budget > 0:
            raise InputError("simulation", [Problem("step_budget", step_budget, "must be > 0")])
        if equations not in EQUATIONS:
            allowed = "must be one of " + ", ".join(EQUATIONS)
            raise InputError("simulation", [Problem("equations", equations, allowed)])
        self.scene = scene = scene_of(scene)
        derivative = None
        if equations == "virtual_work":
            if compiled or isinstance(METHODS.get(integrator), Rosenbrock):
                allowed = "needs an explicit integrator and compiled = False"
                raise InputError("simulation", [Problem("equations", equations, allowed)])
            derivative = VirtualWorkDerivative(scene)
            step_budget = step_budget or VIRTUAL_WORK_BUDGET
        self.geometry = Geometry.of(scene)
        self.dynamics = Dynamics.of(scene)
        self.compiled = compiled and numba_version() is not None
        if compiled and not self.compiled:
            text = "no numba (or SST_ROS_NUMBA=0): running plain Python, slower, the same digits"
            warnings.warn(text, RuntimeWarning, stacklevel=2)
        if step_budget is None:
            operations = len(ode_with_work(self.dynamics).program.steps)
            step_budget = (
                COMPILED_BUDGET
                if self.compiled
                else PLAIN_BUDGET // (operations + STAGE_OPERATIONS)
            )
        self.step_budget = step_budget
        self._propagator = Propagator(
            scene,
            self.geometry,
            self.dynamics,
            integrator,
            tolerance,
            compiled=self.compiled,
            budget=EvaluationBudget(step_budget),
            derivative=derivative,
        )
        self._warned = not self.compiled
        self._start = self._initial()
        self._given: tuple[Torque, tuple[float, ...]] = ((0.0, 0.0, 0.0), ())
        self.reset()

    def reset(self) -> State:
        """Go back to the initial state at time zero."""
        self._propagator.reset()
        self._now = self._before = _Instant(0, self._start, (0.0, 0.0, 0.0))
        self._shown = self._now, self._as_state(self._now)
        self._energy = self._stored()
        return self.state

    @property
    def state(self) -> State:
        """The last valid state."""
        now = self._now
        if self._shown[0] is not now:
            self._shown = now, self._as_state(now)
        return self._shown[1]

    @property
    def time_ns(self) -> int:
        """Time of the last valid state [ns]."""
        return self._now.time_ns

    @property
    def method(self) -> str:
        """Name of the method in use."""
        return self._propagator.method

    @property
    def changes(self) -> list[MethodChange]:
        """Changes of method that auto has made: time [s], method, reason."""
        return list(self._propagator.changes)

    @property
    def accepted_steps(self) -> int:
        """Number of accepted steps of the integrator since the start."""
        return self._propagator.accepted_steps

    @property
    def evaluations(self) -> int:
        """Evaluations of the derivative, those of rejected steps too; a Jacobian counts as 30."""
        return self._propagator.evaluations

    @property
    def error_estimate(self) -> float:
        """Estimated global error of the orientation [rad].

        A coarse solution takes steps of twice the length; its distance, over 2^order - 1, is the
        error of the run, rounding included where the distance consists of it.
        """
        return self._propagator.errors(self._now.point)[0]

    @property
    def rate_error_estimate(self) -> float:
        """Estimated global error of the body rate [rad/s]."""
        return self._propagator.errors(self._now.point)[1]

    @property
    def energy_residual(self) -> float:
        """Energy now, less energy at the start, less the work done on the manipulator [J]."""
        return self._stored() - self._energy - self._now.point.y[-1]

    @property
    def closure_residual(self) -> float:
        """Largest abs(r_k . t_k): how far the loops are from closed."""
        return float(max(abs(dot(t, r)) for t, r in self._directions()))

    @property
    def conditioning(self) -> dict[str, float]:
        """The least sin(mu_k), zero at a serial singularity, and det J2, zero at a parallel one."""
        first, second, third = (cross(t, r) for t, r in self._directions())
        determinant = dot(first, cross(second, third))
        return {"sin_mu": min(map(math.sin, self.state.joints.mu)), "det_j2": determinant}

    def step(self, torque: Torque, dt_ns: int, moment: Triple = (0.0, 0.0, 0.0)) -> State:
        """Advance by dt_ns [ns] in as many steps as the tolerance asks for.

        Args:
            torque: commanded torques [N m], held constant; a `SineTorque`; or a function of
                t [s], for which explicit methods in plain Python are used.
            dt_ns: length [ns], > 0.
            moment: external moment on the star in {B} [N m], used where the scene takes it from
                a topic.

        Raises:
            InputError: an argument is not finite, or dt_ns not positive.
            StrokeExceeded, WorkspaceLeft, SingularityReached: the motion ends inside the step, at
                the `time` of the error.
            StepBudgetExceeded: the step takes more than `step_budget` evaluations.
            Diverged: no step resolves the motion. In all cases the state stays as it was.

        """
        self.steps(torque, dt_ns, 1, moment)
        return self.state

    def steps(
        self, torque: Torque, dt_ns: int, count: int, moment: Triple = (0.0, 0.0, 0.0)
    ) -> None:
        """Advance by `count` times dt_ns: the bits are those of `count` calls of `step`.

        Where nothing happens but steps, all of them are one call of compiled code.

        Raises:
            as `step`: the state is then that after the last step before, at `time_ns`.

        """
        _refuse_bad_input(torque, dt_ns, moment)
        torque = self._propagator.traced(torque)
        if callable(torque) and not self._warned:
            self._warned = True
            text = "a torque function runs in plain Python, slower than compiled=True; same digits"
            warnings.warn(text, RuntimeWarning, stacklevel=3)
        drive = (*moment,) if self.dynamics.moved else ()
        h = dt_ns / NANOSECONDS
        while count > 0:
            point, done = self._propagator.step_many(self._now.point, h, count, torque, drive)
            if done == 0:
                point, done = self._advanced(h, torque, drive), 1
            time_ns = self._now.time_ns + done * dt_ns
            self._given = torque, drive
            self._before, self._now = self._now, _Instant(time_ns, point, torque)
            count -= done

    def load_code(self, dt_ns: int) -> None:
        """Have the code of all methods loaded that steps of dt_ns may turn to.

        Otherwise the step that changes the method loads it, which takes tenths of a second, or
        compiles it, which takes up to half a minute. The state does not change.
        """
        drive = (0.0, 0.0, 0.0) if self.dynamics.moved else ()
        self._propagator.load(self._now.point, dt_ns / NANOSECONDS, drive)

    def _advanced(self, h: float, torque: Torque, drive: tuple[float, ...]) -> Point:
        start = self._now.time_ns / NANOSECONDS
        try:
            with np.errstate(all="ignore"):
                return self._propagator.advance(
                    self._now.point, start, h, torque, drive, self.state
                )
        except (CannotStep, ArithmeticError, ValueError) as error:
            numbers = ", ".join(f"{name} = {x:.3g}" for name, x in self.conditioning.items())
            kind = StepBudgetExceeded if isinstance(error, BudgetSpent) else Diverged
            raise kind(f"{error or 'not finite'} ({numbers})", start, self.state) from None

    def within(self, time_ns: int) -> State:
        """State at a time inside the last step, to the full accuracy of the run.

        It is stepped to from the beginning of that step, under the torques that were given.

        Raises:
            InputError: the time is not inside the last step.

        """
        began, end = self._before.time_ns, self._now.time_ns
        if not began <= time_ns <= end:
            allowed = f"must lie in the last step, {began} to {end} ns"
            raise InputError("within", [Problem("time_ns", time_ns, allowed)])
        before = self._as_state(self._before)
        if time_ns == began:
            return before
        torque, more = self._given
        h = (time_ns - began) / NANOSECONDS
        start = began / NANOSECONDS
        point = self._propagator.repeat_part(self._before.point, start, h, torque, more, before)
        return self._as_state(_Instant(time_ns, point, torque))

    def _stored(self) -> float:
        size = len(self.dynamics.state)
        kinetic, potential, _ = self.dynamics.energies(
            *self._now.point.y[:size], *(0.0,) * len(self.dynamics.drive)
        )
        return kinetic + potential

    def _as_state(self, at: _Instant) -> State:
        (y, _, j, _), asked = at.point, at.torque
        if len(self.dynamics.state) > 7:
            torque = (y[7], y[8], y[9])
        else:
            torque = self._propagator.torque_at(asked, at.time_ns / NANOSECONDS, y)
        joints = Joints(j[0:3], j[3:6], j[6:9], j[9:12], j[12:15], j[15:18])  # type: ignore[arg-type]
        return State(at.time_ns, (y[0], y[1], y[2], y[3]), (y[4], y[5], y[6]), joints, torque)

    def _initial(self) -> Point:
        initial = self.scene.initial
        gamma = np.array(initial.gamma)
        outside = np.any((gamma < 0) | (gamma > self.geometry.arc))
        if self.scene.stroke.at_end == "stop" and outside:
            ends = ", ".join(f"{arc:.6f}" for arc in self.geometry.arc)
            allowed = f"must lie in the stroke, 0 to ({ends}) rad"
            raise InputError(self.scene.name, [Problem("initial.gamma", initial.gamma, allowed)])
        return self._propagator.begin(list(initial_state(self.scene, self.geometry)))

    def _directions(self) -> Iterator[tuple[Triple, Triple]]:
        """Directions t_k and r_k in {E}, r_k from gamma_k alone."""
        rows = rotation_rows(self.state.quaternion)
        for gamma, leg in zip(self.state.joints.gamma, self.dynamics.model.legs, strict=True):
            r = axpy(math.cos(gamma), leg.v, math.sin(gamma), leg.across)
            yield (leg.e0, leg.e1, 0.0), turned_back(rows, r)


def _refuse_bad_input(torque: Torque, dt_ns: int, moment: Sequence[float]) -> None:
    problems = []
    if not (callable(torque) or isinstance(torque, SineTorque) or _is_vector3(torque)):
        allowed = "must be three finite numbers [N m], a SineTorque or a function of t [s]"
        problems.append(Problem("torque", torque, allowed))
    if not _is_vector3(moment):
        problems.append(Problem("moment", moment, "must be three finite numbers [N m]"))
    if dt_ns <= 0:
        problems.append(Problem("dt_ns", dt_ns, "must be > 0 [ns]"))
    if problems:
        raise InputError("step", problems)


def _is_vector3(value: Any) -> bool:
    try:
        return len(value) == 3 and all(map(math.isfinite, value))
    except TypeError:
        return False
