# SPDX-License-Identifier: Apache-2.0
"""Direct dynamics of one scene, step by step, up to the end of what is valid."""

from __future__ import annotations

import operator
import sys
import threading
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from sst_ros.dynamics.initial_state import derive_by_paper, start_of
from sst_ros.dynamics.traced_dynamics import Dynamics, recent_ode
from sst_ros.errors import (
    Diverged,
    SstError,
    StepBudgetExceeded,
    check_kinds,
    refusal,
    refuse_unless,
)
from sst_ros.integration.methods import AUTO, METHODS, RK4, Rosenbrock
from sst_ros.integration.point import MethodChange, Period, Point
from sst_ros.integration.stepper import (
    BudgetSpent,
    CannotStep,
    EvaluationBudget,
    LimitReached,
    Stepper,
)
from sst_ros.mechanism import kinematics
from sst_ros.mechanism.generic_math import triple
from sst_ros.mechanism.geometry import Geometry, rotation_matrix
from sst_ros.programs.llvm import llvmlite_version
from sst_ros.scene.scene import SceneInput, scene_of
from sst_ros.scene.torque_profile import (
    Torque,
    TorqueFunction,
    TorqueProfile,
    count_arguments,
    profile_of,
)
from sst_ros.state import (
    NANOSECONDS,
    STAR_RATE,
    ZERO,
    Explained,
    State,
    Vector3,
    finite_vector,
)

INTEGRATORS = (AUTO, *METHODS)

EQUATIONS = ("quaternion", "virtual_work")
"""Equations of motion: in quaternion and body rate, or the paper's Eqs. 1 to 92."""

_MOST_CALL_STEPS = 10**9
"""Most steps of one call."""

_COUNT_REQUIREMENT = f"must be > 0 and <= {_MOST_CALL_STEPS:g}, a whole number"
_MOMENT_REQUIREMENT = "must be three finite numbers [N m]"
_TORQUE_REQUIREMENT = f"{_MOMENT_REQUIREMENT}, a SineTorque or a function of t [s]"

_PLAIN_BUDGET = 3_000_000
"""Operations a step in plain Python may take: 0.12 s at 37 ns each, on a 3 GHz core."""
_STAGE_OPERATIONS = 100
"""Operations of a stage beside the scene's equations, which have 140 to 450."""
_COMPILED_BUDGET = 120_000
"""Evaluations a step in machine code may take.

They take 0.12 s, at most 1 us each with the loop.
"""
_VIRTUAL_WORK_BUDGET = 1000
"""Evaluations of the paper's equations that a step may take: 0.3 s, at 0.3 ms each."""


def default_budget(dynamics: Dynamics, equations: str) -> int:
    """Return the evaluations that keep a step below about 0.2 s.

    In plain Python they are 5,000 to 12,000, by the terms of the scene.
    """
    if equations == "virtual_work":
        return _VIRTUAL_WORK_BUDGET
    if llvmlite_version() is not None:
        return _COMPILED_BUDGET
    operations = len(recent_ode(dynamics, work=True).program.steps)
    return _PLAIN_BUDGET // (operations + _STAGE_OPERATIONS)


def _read_whole(value: Any) -> int:
    """Return a whole number below 2^63 of any type as int, 0 for anything else."""
    if isinstance(value, (bool, np.timedelta64)):  # they convert, but are no number
        return 0
    try:
        number = operator.index(value)
    except TypeError:
        return 0
    return number if number < 2**63 else 0


def _require_one_of(names: tuple[str, ...]) -> str:
    return "must be one of " + ", ".join(names)


class _Instant(NamedTuple):
    """What a state is made of, when it is asked for."""

    time_ns: int
    point: Point
    torque: Torque = (0.0, 0.0, 0.0)  # that acted until then
    moment: tuple[float, ...] = ()  # alike
    period_ns: int = 0  # length of the steps that led to it


class Simulation(Explained):
    """Direct dynamics of a scene from its initial state.

    A copy, also one of pickle, goes on from where the simulation is, to the bit. Only
    one thread at a time may advance a simulation: another one is refused, for it would
    lose steps.

    Args:
        scene: a Scene, the name of a scene that is shipped, the path of a file, or a
            mapping with the keys of a scene.
        integrator: auto, or a method of `integration.methods.METHODS`.
        tolerance: largest local error of a step: of the quaternion, and of the rate
            relative to its length. RK4 has no error estimate; it takes one step a call.
        equations: "quaternion", the equations of motion in the quaternion and the body
            rate, or "virtual_work", the paper's Eqs. 1 to 92: the same motion, a
            thousand times slower, by explicit methods in plain Python, without the
            terms that the paper does not have.
        step_budget: evaluations of the right-hand side that one `step` may take. The
            default keeps a step below about 0.2 s, see `default_budget`. Long steps of
            a stiff or fast motion may need more. A Jacobian counts as 30 evaluations.

    Attributes:
        geometry: constant vectors of the scene.
        dynamics: traced functions of the scene.
        step_budget: evaluations that one step may take.

    Raises:
        AssemblyError: the initial gamma has no unique admissible assembly.
        SingularConfiguration: it moves from a parallel singularity.
        InputError: the initial gamma lies outside the stroke, an argument is not
            allowed, or the scene has a term that the equations do not have.

    """

    @check_kinds
    def __init__(
        self,
        scene: SceneInput,
        integrator: str = AUTO,
        *,
        tolerance: float = 1e-10,
        equations: str = "quaternion",
        step_budget: int | None = None,
    ) -> None:
        is_integrator = integrator in INTEGRATORS
        is_budget = step_budget is None or step_budget > 0
        are_equations = equations in EQUATIONS
        is_explicit = not isinstance(METHODS.get(integrator), Rosenbrock)
        fits = is_explicit or equations != "virtual_work"
        refuse_unless(
            "simulation",
            ("integrator", integrator, is_integrator, _require_one_of(INTEGRATORS)),
            ("tolerance", tolerance, tolerance > 0.0, "must be > 0"),
            ("step_budget", step_budget, is_budget, "must be > 0"),
            ("equations", equations, are_equations, _require_one_of(EQUATIONS)),
            ("equations", equations, fits, "needs an explicit integrator"),
        )
        scene = scene_of(scene)
        self.scene = scene
        # a copy is made with them
        self._settings = integrator, tolerance, equations
        self._running = threading.Lock()
        self._thread = 0  # that advances the simulation
        derivative = derive_by_paper(scene) if equations == "virtual_work" else None
        self.geometry = Geometry.of(scene)
        self.dynamics = Dynamics.of(scene)
        self.step_budget = step_budget or default_budget(self.dynamics, equations)
        self._stepper = Stepper(
            scene,
            integrator,
            # A call of RK4 is one step, whatever its error.
            sys.float_info.max if integrator == RK4.name else tolerance,
            budget=EvaluationBudget(self.step_budget),
            derivative=derivative,
        )
        self._lags = scene.lags
        self._start = self._stepper.begin(list(start_of(scene)))
        self._current = self._before = _Instant(0, self._start)
        self.reset()

    def step(
        self,
        torque: Torque | TorqueFunction,
        dt_ns: int,
        moment: Vector3 = (0.0, 0.0, 0.0),
    ) -> State:
        """Advance by dt_ns [ns] in as many steps as the tolerance asks for.

        Args:
            torque: commanded torques [N m], held constant; a `SineTorque`; or a
                function of t [s].
            dt_ns: length [ns], > 0.
            moment: external moment on the star in {B} [N m], used where the scene takes
                it from a topic.

        Raises:
            InputError: an argument is not finite, or dt_ns not positive.
            StrokeExceeded, WorkspaceLeft, SingularityReached: the motion ends inside
                the step, at the `time` of the error.
            StepBudgetExceeded: the step takes more than `step_budget` evaluations.
            Diverged: no step resolves the motion. In all cases the state stays as it
                was.

        """
        acting, length, _ = self._read_steps(torque, dt_ns, 1, moment)
        self.advance(acting, length, 1, moment)
        return self.state

    def steps(
        self,
        torque: Torque | TorqueFunction,
        dt_ns: int,
        count: int,
        moment: Vector3 = (0.0, 0.0, 0.0),
    ) -> None:
        """Advance by `count` times dt_ns, bit for bit as by `count` calls of `step`.

        Errors are those of `step`: the state is then that after the last step before,
        at `time_ns`.
        """
        acting, length, number = self._read_steps(torque, dt_ns, count, moment)
        self.advance(acting, length, number, moment)

    def _read_steps(
        self,
        torque: Torque | TorqueFunction,
        dt_ns: int,
        count: int,
        moment: Vector3,
    ) -> tuple[Torque, int, int]:
        """Return what acts, the length of a step [ns] and the number of steps."""
        length = _read_whole(dt_ns)
        number = _read_whole(count)
        constant_torque = finite_vector(torque)
        are_counted = length > 0 and 0 < number <= _MOST_CALL_STEPS
        if constant_torque is None or finite_vector(moment) is None or not are_counted:
            # Some argument is not plain: look at each, to name one that is refused.
            is_function = callable(torque) or isinstance(torque, TorqueProfile)
            is_torque = constant_torque is not None or is_function
            is_moment = finite_vector(moment) is not None
            refuse_unless(
                "step",
                ("torque", torque, is_torque, _TORQUE_REQUIREMENT),
                ("moment", moment, is_moment, _MOMENT_REQUIREMENT),
                ("dt_ns", dt_ns, length > 0, "must be > 0, in whole nanoseconds"),
                ("count", count, 0 < number <= _MOST_CALL_STEPS, _COUNT_REQUIREMENT),
            )
        if constant_torque is None:
            return self.acting(torque), length, number
        return self._stepper.torque.acting(constant_torque), length, number

    def __reduce__(self) -> tuple[Any, ...]:
        """Copy the arguments, and where the run is."""
        arguments = self.scene, *self._settings, self.step_budget
        spent = self._stepper.budget.spent
        return _continue_simulation, (arguments, (self._before, self._current), spent)

    def _claim(self) -> None:
        """Begin to advance; refuse another thread until `_running` is released."""
        if not self._running.acquire(blocking=False):
            thread_names = {
                thread.ident: thread.name for thread in threading.enumerate()
            }
            thread_name = threading.current_thread().name
            running_name = thread_names.get(self._thread, "another thread")
            requirement = f"must wait: {running_name} advances the simulation"
            raise refusal("step", "thread", thread_name, requirement)
        self._thread = threading.get_ident()

    def acting(self, torque: Torque | TorqueFunction) -> Torque:
        """Return what acts: finite torques [N m] within the limit of the actuators."""
        constant_torque = finite_vector(torque)
        if constant_torque is not None:
            return self._stepper.torque.acting(constant_torque)
        if not isinstance(torque, TorqueProfile):
            is_function = callable(torque) and count_arguments(torque) == 1
            refuse_unless("step", ("torque", torque, is_function, _TORQUE_REQUIREMENT))
        return self._stepper.torque.acting(profile_of(torque))

    def advance(self, torque: Torque, dt_ns: int, count: int, moment: Vector3) -> None:
        """Do what `steps` does, without checks: `torque` is what `acting` returns."""
        h = dt_ns / NANOSECONDS
        acting_moment: tuple[float, ...] = ()
        if self.dynamics.has_moment_topic:
            acting_moment = tuple(map(float, moment))
        # One thread at a time: what follows reads where the run is, and changes it.
        self._claim()
        began = self._current
        try:
            left = count
            while left:
                instant = self._current
                start = instant.time_ns / NANOSECONDS
                period = Period(start, h, torque, acting_moment)
                # Take several plain periods at once, or steps to the end of the next.
                point, done = self._stepper.advance_evenly(instant.point, period, left)
                if not done:
                    try:
                        point = self._stepper.advance(instant.point, period)
                    except (LimitReached, CannotStep) as stop:
                        raise self._explain(stop, start) from None
                    done = 1
                # What it reached is the state now; until here nothing has changed.
                self._before = began
                self._current = _Instant(
                    instant.time_ns + done * dt_ns, point, torque, acting_moment, dt_ns
                )
                left -= done
        finally:
            self._running.release()

    def _explain(self, stop: LimitReached | CannotStep, start: float) -> SstError:
        """Return the error by which a step that began at a time [s] ends."""
        if isinstance(stop, LimitReached):
            assert stop.limit.error is not None
            return stop.limit.error(stop.limit.reason, stop.time, self.state)
        conditioning_text = describe_conditioning(self.geometry, self.state)
        error_class = StepBudgetExceeded if isinstance(stop, BudgetSpent) else Diverged
        return error_class(f"{stop} ({conditioning_text})", start, self.state)

    @check_kinds
    def within(self, time_ns: int) -> State:
        """Return the state at a time inside the last step, as accurate as the run.

        It is that of a step from the beginning of the last one, under the same torques;
        after a call of `steps`, that of its steps up to there.

        Raises:
            InputError: the time is not inside the last step.
            StrokeExceeded, WorkspaceLeft, SingularityReached, StepBudgetExceeded,
                Diverged: a shorter step meets what the last one passed.

        """
        began, end = self._before.time_ns, self._current.time_ns
        requirement = f"must lie in the last step, {began} to {end} ns"
        refuse_unless(
            "within", ("time_ns", time_ns, began <= time_ns <= end, requirement)
        )
        if time_ns == began:
            return self._as_state(self._before)
        _, _, torque, moment, period_ns = self._current
        point = self._before.point
        for start_ns in range(began, time_ns, period_ns):
            start = start_ns / NANOSECONDS
            h = min(period_ns, time_ns - start_ns) / NANOSECONDS
            try:
                point = self._stepper.advance(point, Period(start, h, torque, moment))
            except (LimitReached, CannotStep) as stop:
                raise self._explain(stop, start) from None
        return self._as_state(_Instant(time_ns, point, torque, moment))

    def reset(self) -> State:
        """Go back to the initial state at time zero."""
        self._claim()
        try:
            self._current = self._before = _Instant(0, self._start)
            # One assignment of both: other threads may read the state meanwhile.
            self._shown_state = self._current, self._as_state(self._current)
            self._energy = self.dynamics.total_energy(self._start.y)
        finally:
            self._running.release()
        return self.state

    def load_code(self) -> None:
        """Compile the code of all methods that steps under constant torques may use.

        Otherwise the first step, and one that changes the method, compiles it, which
        takes tenths of a second. The state does not change.
        """
        self._stepper.load()

    @property
    def state(self) -> State:
        """The last valid state."""
        instant = self._current
        shown_instant, state = self._shown_state
        if shown_instant is not instant:
            state = self._as_state(instant)
            self._shown_state = instant, state
        return state

    @property
    def sample(self) -> tuple[Sequence[float], Sequence[float], Vector3]:
        """The numbers of `state`.

        They are those that are integrated, quaternion and body rate first; nine angles
        and nine rates of the joints; and the torques.
        """
        instant = self._current
        return instant.point.y, instant.point.joints, self._torque(instant)

    @property
    def body_acceleration(self) -> Vector3:
        """Angular acceleration of the star in {E} [rad/s^2].

        It is that under the torques and the moment of the last step; the next step may
        have others.
        """
        instant = self._current
        moment: tuple[float, ...] = ()
        if self.dynamics.has_moment_topic:
            moment = instant.moment or ZERO  # before the first step it has none
        state = instant.point.y[: len(self.dynamics.state)]
        slope = self.dynamics.derivative(*state, *self._torque(instant), *moment)
        return triple(slope[STAR_RATE])

    @property
    def time_ns(self) -> int:
        """Time of the last valid state [ns]."""
        return self._current.time_ns

    @property
    def method(self) -> str:
        """Name of the method in use."""
        return self._current.point.method.name

    @property
    def changes(self) -> list[MethodChange]:
        """Changes of method that auto has made."""
        return list(self._current.point.changes)

    @property
    def accepted_steps(self) -> int:
        """Number of accepted steps of the integrator since the start."""
        return self._current.point.steps

    @property
    def evaluations(self) -> int:
        """Evaluations of the derivative, those of rejected steps too.

        A Jacobian counts as 30.
        """
        return self._stepper.budget.spent

    @property
    def error_estimate(self) -> float:
        """Estimated global error of the orientation [rad].

        It is twice the distance of a second solution, whose steps have half the length,
        so it holds where the error only halves with the steps, too. It is not less than
        rounding.
        """
        return self._current.point.error

    @property
    def rate_error_estimate(self) -> float:
        """Estimated global error of the body rate [rad/s]."""
        return self._current.point.rate_error

    @property
    def energy_residual(self) -> float:
        """Energy now, less that at the start, less work done on the manipulator [J]."""
        y = self._current.point.y
        work = y[-1]
        return self.dynamics.total_energy(y) - self._energy - work

    @property
    def closure_residual(self) -> float:
        """Largest abs(r_k . t_k), 0 where the loops are exactly closed."""
        rotation = rotation_matrix(self.state.quaternion)
        closure = kinematics.closure(self.geometry, self.state.joints.gamma, rotation)
        return float(np.abs(closure).max())

    @property
    def conditioning(self) -> dict[str, float]:
        """The least sin(mu_k) and det J2, see the function `conditioning`."""
        return conditioning(self.geometry, self.state)

    def _facts(self) -> dict[str, object]:
        return {
            "scene": self.scene.name,
            "time [s]": self.time_ns / NANOSECONDS,
            "method": self.method,
            "accepted steps": self.accepted_steps,
            "error estimate [rad]": self.error_estimate,
            "gamma [rad]": self.state.joints.gamma,
            "gamma_dot [rad/s]": self.state.joints.gamma_dot,
            "conditioning": describe_conditioning(self.geometry, self.state),
        }

    def _as_state(self, instant: _Instant) -> State:
        point = instant.point
        return State.of(instant.time_ns, point.y, point.joints, self._torque(instant))

    def _torque(self, instant: _Instant) -> Vector3:
        """Return the torques that the actuators give at an instant [N m]."""
        # As held torques act at once without lag, nothing is to be evaluated.
        if type(instant.torque) is tuple and not self._lags:
            return instant.torque
        return self._stepper.acting(
            instant.torque, instant.time_ns / NANOSECONDS, instant.point
        )


def _continue_simulation(
    arguments: tuple[Any, ...], instants: tuple[_Instant, _Instant], spent: int
) -> Simulation:
    """Make a copy of a simulation, for pickle."""
    scene, integrator, tolerance, equations, budget = arguments
    copied = Simulation(
        scene, integrator, tolerance=tolerance, equations=equations, step_budget=budget
    )
    copied._before, copied._current = instants
    copied._stepper.budget.spent = spent
    return copied


def conditioning(geometry: Geometry, state: State) -> dict[str, float]:
    """Return the least sin(mu_k), which is zero at a serial singularity, and det J2.

    The latter is zero at a parallel singularity.
    """
    r = kinematics.carriage_directions(geometry, state.joints.gamma)
    rotation = rotation_matrix(state.quaternion)
    _, _, determinant, _ = kinematics.describe_assemblies(geometry, r, rotation)
    return {
        "sin_mu": float(np.sin(state.joints.mu).min()),
        "det_j2": float(determinant),
    }


def describe_conditioning(geometry: Geometry, state: State) -> str:
    """Say how near a state is to a singularity."""
    values = conditioning(geometry, state)
    return ", ".join(f"{name} = {value:.3g}" for name, value in values.items())
