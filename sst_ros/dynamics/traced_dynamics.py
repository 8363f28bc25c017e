# SPDX-License-Identifier: Apache-2.0
"""Functions of scenes, traced: those that a run calls, the ODE that is integrated, many scenarios.

The programs of many scenarios have the numbers that differ as inputs. What is the same
in all of them stays a constant that `trace` folds, so a batch computes only what
varies. A term whose coefficients are zero in some scenarios changes no bit there.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cached_property, lru_cache, partial
from itertools import chain
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sst_ros.dynamics import kernel
from sst_ros.dynamics.model import Limit, limits_of
from sst_ros.errors import refuse_unless
from sst_ros.mechanism.generic_math import Scalar, positive, sin
from sst_ros.mechanism.geometry import Array, Geometry
from sst_ros.programs.compiled import compile_functions, compile_rows
from sst_ros.programs.expression import (
    Expression,
    Program,
    compile_for_arrays,
    compile_program,
    mark_present,
    number_constants,
    trace,
)
from sst_ros.scene.scene import Scenarios, Scene
from sst_ros.scene.schema import Place, leaves, rebuild
from sst_ros.scene.torque_profile import SineTorque
from sst_ros.state import Joints

Function = Callable[..., Sequence[float]]

QUATERNION = ("x", "y", "z", "w")
RATE = ("wx", "wy", "wz")
MOTION = (*QUATERNION, *RATE)
LAG = ("l1", "l2", "l3")
TORQUE = ("t1", "t2", "t3")
MOMENT = ("n1", "n2", "n3")
BODY_ACCELERATION = ("ax", "ay", "az")

OUTPUTS = (*Joints._fields, "energy")
"""Quantities of a state that depend on the numbers of its scenario."""


class Dynamics:
    """Programs of a manipulator with the constants `model`, numbers or not.

    `state` has the names of the state's numbers: quaternion, body rate, lagged torques
    if any; `drive` of what acts from outside: torques, and a moment if it comes from a
    topic.
    """

    def __init__(self, model: kernel.Model, *, has_moment_topic: bool = False) -> None:
        self.model, self.has_moment_topic = model, has_moment_topic
        self.state = (*MOTION, *(LAG if model.time_constant is not None else ()))
        self.drive = (*TORQUE, *(MOMENT if has_moment_topic else ()))

    @staticmethod
    def of(scene: Scene) -> Dynamics:
        """Give those of a scene: traced once for all scenes that have the same constants."""
        has_moment_topic = scene.moment is not None and scene.moment.topic
        return recent(kernel.model_of(scene), has_moment_topic=has_moment_topic)

    @cached_property
    def derivative(self) -> Function:
        """Derivative of the state by time, of state and drive."""
        return partial(compile_program(ODE(self).program), 0.0)

    @cached_property
    def joints(self) -> Function:
        """Angles gamma, mu, beta and rates in the same order, 18 numbers of the first seven.

        They are nan where an angle has no value.
        """
        return compile_functions({"joints": self.joints_program}, ("joints",))["joints"]

    @cached_property
    def joints_of_rows(self) -> Callable[[Array], Array]:
        """The same of rows of seven numbers each, shape (n, 7) -> (n, 18)."""
        return compile_rows({"joints": self.joints_program}, "joints")

    @cached_property
    def joints_program(self) -> Program:
        """The program of `joints`."""
        return trace(
            lambda *state: [*chain(*kernel.joints(self.numbers, state))], MOTION
        )

    @cached_property
    def inverse(self) -> Function:
        """Torques that give a W_dot, det g and sin^2(mu_k), 7 numbers: `kernel.actuator_torque`.

        Of the first seven numbers of the state, W_dot, and a moment if it comes from a
        topic.
        """

        def torques(*inputs: Any) -> tuple[Any, ...]:
            q, rate, acceleration, moment = (
                inputs[:4],
                inputs[4:7],
                inputs[7:10],
                inputs[10:],
            )
            found = kernel.actuator_torque(
                self.model, q, rate, acceleration, moment or None
            )
            return (
                *found[0],
                found[1],
                *(at.u for at in kernel.leg_motions(self.model, inputs)),
            )

        more = MOMENT if self.has_moment_topic else ()
        return compile_program(trace(torques, (*MOTION, *BODY_ACCELERATION, *more)))

    @cached_property
    def actuator_motion(self) -> Function:
        """Coordinates x and x_dot of state and drive.

        Both by each number of the state, and torque.

        They are x = (gamma, gamma_dot, lagged torques if any).
        """
        size = len(self.state)

        def motion(*inputs: Any) -> tuple[Any, ...]:
            state, torque, moment = (
                inputs[:size],
                inputs[size : size + 3],
                inputs[size + 3 :],
            )
            slope = kernel.derivative(self.model, state, torque, moment or None)
            gamma_ddot = kernel.actuator_acceleration(self.model, state, slope[4:7])
            joints = kernel.joints(self.model, state)
            x = (*joints.gamma, *joints.gamma_dot, *state[7:])
            return (*x, *joints.gamma_dot, *gamma_ddot, *slope[7:])

        inputs = (*self.state, *self.drive)
        return compile_program(trace(motion, inputs, (*self.state, *TORQUE)))

    @cached_property
    def energies(self) -> Function:
        """Kinetic and potential energy [J] of the state."""

        def energies(*state: Any) -> tuple[Any, ...]:
            kinetic = kernel.kinetic_energy(self.model, state)
            return kinetic, kernel.potential_energy(self.model, state)

        return compile_program(trace(energies, self.state))

    def total_energy(self, state: Sequence[float]) -> float:
        """Kinetic and potential energy [J] of a state, whose further numbers are not looked at."""
        return sum(self.energies(*state[: len(self.state)]))

    @cached_property
    def numbers(self) -> kernel.Model:
        """The model, in which what is not 0 or 1 may have another value in another scene."""
        model: kernel.Model = number_constants(self.model, ("model",))
        return model


recent = lru_cache(maxsize=32)(Dynamics)


class ODE:
    """Derivative of a scene's state, as programs with the inputs t, `state` and `drive`.

    These are those of `dynamics`, but for: `torque` over time, clamped to `limit` [N
    m], replaces the torques of the drive; with `phases` the drive keeps three numbers
    for them, the phases [rad]. `work` appends to the state the work [J] that actuators
    and moments have put in, less what friction has taken out.
    """

    def __init__(
        self,
        dynamics: Dynamics,
        torque: SineTorque | None = None,
        *,
        limit: float | None = None,
        work: bool = False,
        phases: bool = False,
    ) -> None:
        self.dynamics, self._torque, self._limit = dynamics, torque, limit
        self._work, self._phases = work, phases
        self.state = (*dynamics.state, *(("work",) if work else ()))
        self.drive = dynamics.drive if torque is None or phases else dynamics.drive[3:]
        self._inputs = ("t", *self.state, *self.drive)
        self._of_numbers = partial(self.derivative, numbered=True)

    @cached_property
    def program(self) -> Program:
        """The derivative."""
        return trace(self._of_numbers, self._inputs)

    @cached_property
    def jacobian(self) -> Program:
        """The derivative, and its derivatives by t and by each number of the state."""
        return trace(self._of_numbers, self._inputs, ("t", *self.state))

    @cached_property
    def directional(self) -> Program:
        """The derivative, and its own along the direction d_x, .. of further inputs.

        They are of the state but the work, and of the time under a torque.
        """
        state = self.state[:-1] if self._work else self.state
        along = state if self._torque is None else (*state, "t")
        return trace(self._of_numbers, self._inputs, (), along)

    def eigenvalues(self, t: float, y: Sequence[float], d: Sequence[float]) -> Array:
        """Eigenvalues of the exact Jacobian at time [s], state and drive [1/s], shape (size,).

        Raises ArithmeticError where the Jacobian is not finite.
        """
        return np.asarray(np.linalg.eigvals(self.matrix(t, y, d)))

    def matrix(self, t: float, y: Sequence[float], d: Sequence[float]) -> Array:
        """Return the exact Jacobian at time [s], state and drive, shape (size, size).

        Raises ArithmeticError where it is not finite.
        """
        size = len(self.state)
        flat = np.array(self.linearised(t, *y, *d)[2 * size :])
        if not np.isfinite(flat).all():
            raise ArithmeticError("the Jacobian is not finite")
        columns: Array = flat.reshape(size, size)
        return np.asarray(columns.T)

    @cached_property
    def slope(self) -> Function:
        """The program as a function of floats; nan where it has no value."""
        return compile_functions({"slope": self.program}, ("slope",))["slope"]

    @cached_property
    def linearised(self) -> Function:
        """The program of `jacobian` as a function; nan where it has no value."""
        return compile_functions({"jacobian": self.jacobian}, ("jacobian",))["jacobian"]

    @cached_property
    def linearised_by_torque(self) -> Function:
        """The derivative, and its derivatives by t, the state and the torques of the drive."""
        program = trace(self._of_numbers, self._inputs, ("t", *self.state, *TORQUE))
        return compile_functions({"linearised": program}, ("linearised",))["linearised"]

    def derivative(
        self, time: Any, *inputs: Any, numbered: bool = False
    ) -> tuple[Any, ...]:
        """Return the derivative at the time, the state and the drive given, of any kind.

        If `numbered` it is that of constants that may be others in another scene.
        """
        model, sine, limit = self.dynamics.model, self._torque, self._limit
        if numbered:
            model, sine = self.dynamics.numbers, number_constants(sine, ("torque",))
            limit = number_constants(limit, ("limit",))
        state, drive = inputs[: len(self.dynamics.state)], inputs[len(self.state) :]
        torque, moment = drive[:3], drive[3:]
        if sine is not None:
            phase = torque if self._phases else sine.phase
            moment = moment if self._phases else drive
            rows = zip(sine.amplitude, sine.frequency, phase, strict=True)
            torque = tuple(a * sin(f * time + p) for a, f, p in rows)
            if limit is not None:  # clamps to -limit and limit, numbers of any kind
                most = 2.0 * limit
                torque = tuple(
                    limit - positive(most - positive(tau + limit)) for tau in torque
                )
        slope = kernel.derivative(model, state, torque, moment or None)
        work = (
            (kernel.power(model, state, torque, moment or None),) if self._work else ()
        )
        return (*slope, *work)


recent_ode = lru_cache(maxsize=64)(ODE)  # traced once for all runs of the same dynamics


def limit_distances(
    limits: Sequence[Limit],
    ends: Sequence[Any],
    model: kernel.Model,
    state: Sequence[Any],
) -> tuple[Scalar, ...]:
    """Return a number for each limit, positive inside, then the rate of each.

    They hold for angles less than pi away from the limit. `ends` has cosine and sine of
    the end of each limit; the state is quaternion and body rate.
    """
    legs = list(kernel.leg_motions(model, state))
    distances, rates = [], []
    for limit, (cosine, sine) in zip(limits, ends, strict=True):
        kind, at = limit.joint // 3, legs[limit.joint % 3]
        if kind == 1:  # sin(mu)^2 - sin(end)^2
            distance, rate = at.u - sine * sine, -2.0 * at.a * at.a_dot
        else:  # sqrt(u) sin(sign * (angle - end))
            across, along = kernel.direction_of(at, kind)
            distance = limit.sign * (across * cosine - along * sine)
            rate = (
                limit.sign
                * (along * cosine + across * sine)
                * kernel.joint_rate(at, kind)
            )
            rate = rate - distance * at.a * at.a_dot / at.u
        distances.append(distance)
        rates.append(rate)
    return (*distances, *rates)


class Constants(NamedTuple):
    """All numbers that the traced programs of a scene are made of: a tree of numbers or columns."""

    model: kernel.Model
    # cosine and sine of the end of each of `limits_of`
    ends: tuple[tuple[float, float], ...]
    torque: SineTorque | None  # the scene's own over time; None where it does not act


class ParameterColumns(NamedTuple):
    """Numbers of the scenarios of a batch."""

    inputs: Array  # the program's varied numbers, shape (numbers, N)
    geometries: Geometry  # the distinct ones, or one for all rows
    geometry: NDArray[np.intp]  # index of the geometry of each row, shape (N,)
    # largest torque of an actuator [N m], infinite without one, shape (N,)
    torque_limit: Array


class ParametricModel:
    """The programs of a scene, with the numbers that differ between scenarios, `names`, as inputs.

    With `profile` the scene's own torques act. `ode` has the names of the state and the
    drive.
    """

    def __init__(self, scenarios: Scenarios, *, profile: bool) -> None:
        self.scene, self.profile, self._scenarios = (
            scenarios.document,
            profile,
            scenarios,
        )
        self._tree = self._constants_of(scenarios)[0]
        numbers = leaves(self._tree)
        self._varied = [place for place, x in numbers.items() if np.max(x) != np.min(x)]
        self.names = tuple(f"p{i}" for i in range(len(self._varied)))
        rest = (place for place in numbers if place not in self._varied)
        self._fixed = {place: float(np.ravel(numbers[place])[0]) for place in rest}
        self.ode = ODE(Dynamics.of(self.scene), self.scene.torque if profile else None)

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle the scenarios: programs are traced again."""
        return _make_model, (self._scenarios, self.profile)

    def columns(self, scenarios: Scenarios) -> ParameterColumns:
        """Return the numbers of scenarios, of which none may differ that is fixed in this model.

        Refused are actuators that cannot give the torques of the profile, too.
        """
        tree, geometries, which = self._constants_of(scenarios)
        numbers = leaves(tree)
        inputs = np.empty((len(self._varied), len(which)))
        for row, place in zip(inputs, self._varied, strict=True):
            row[:] = numbers[place]
            if place[-1] == "static":
                # static = 0 is no breakaway torque, which is as if it were the Coulomb
                # torque.
                level: Place = (*place[:-1], "coulomb")
                row[:] = np.where(row == 0.0, numbers[level], row)
            elif place[-1] == "rest":
                # of a spring without stiffness any will do
                np.nan_to_num(row, copy=False)
        given = getattr(scenarios.columns().actuators, "torque_limit", None)
        limit = np.full(len(which), np.inf if given is None else given)
        limit[limit == 0.0] = np.inf  # of actuators that are left out
        lagging, lags = (
            tree.model.time_constant,
            "must be > 0 [s] in every scenario, or in none",
        )
        checks = [("actuators.time_constant", 0.0, not np.any(lagging == 0.0), lags)]
        for place, x in self._fixed.items():
            allowed = f"must be {x} in all scenarios of this model"
            checks.append(
                (str(place), numbers[place], bool(np.all(numbers[place] == x)), allowed)
            )
        # a fixed step does not resolve the kinks of a clamped torque
        if tree.torque is not None:
            amplitudes = np.array(
                np.broadcast_arrays(*tree.torque.amplitude, limit)[:3]
            )
            largest = np.abs(amplitudes).max(axis=0)
            n = int(np.argmax(largest > limit))
            key = f"scenario {n}: " * bool(scenarios.count) + "actuators.torque_limit"
            allowed = f"must not be less than the amplitude {largest[n]} of the profile"
            checks.append((key, float(limit[n]), bool(largest[n] <= limit[n]), allowed))
        refuse_unless(self.scene.name, *checks)
        return ParameterColumns(inputs, geometries, which, limit)

    @cached_property
    def program(self) -> Program:
        """Derivative of the state; inputs t, state, drive, and the varied numbers."""
        return trace(
            self.derivative, ("t", *self.ode.state, *self.ode.drive, *self.names)
        )

    def derivative(self, *inputs: Any) -> tuple[Any, ...]:
        """Return the derivative at the inputs of `program`, of any kind."""
        known = 1 + len(self.ode.state) + len(self.ode.drive)
        at = self.constants(inputs[known:])
        topic = self.ode.dynamics.has_moment_topic
        ode = ODE(Dynamics(at.model, has_moment_topic=topic), at.torque)
        return ode.derivative(*inputs[:known])

    @cached_property
    def limit_distances(self) -> Program:
        """Distances to the limits, and their rates.

        inputs: state (7) and the varied numbers.
        """
        return trace(self.distances, (*MOTION, *self.names))

    def distances(self, *inputs: Any) -> tuple[Scalar, ...]:
        """Return the results of `limit_distances` at its inputs, of any kind."""
        limits = tuple(limits_of(self.scene, Geometry.of(self.scene)))
        at = self.constants(inputs[7:])
        return limit_distances(limits, at.ends, at.model, inputs[:7])

    def joints(self, *inputs: Any) -> Joints:
        """Return angles and rates of the joints at the inputs of `limit_distances`."""
        return kernel.joints(self.constants(inputs[7:]).model, inputs[:7])

    @cached_property
    def outputs(self) -> dict[str, Callable[..., tuple[Any, ...]]]:
        """Functions of arrays for quantities of OUTPUTS by name.

        Inputs as `limit_distances`.

        Three angles [rad] or rates [rad/s] each, or the energy [J].
        """

        def values(*inputs: Expression) -> tuple[Any, ...]:
            model, state = self.constants(inputs[7:]).model, inputs[:7]
            joints = (number for kind in self.joints(*inputs) for number in kind)
            kinetic = kernel.kinetic_energy(model, state)
            return (*joints, kinetic + kernel.potential_energy(model, state))

        whole = trace(values, (*MOTION, *self.names))
        parts = (whole.prune(whole.outputs[i : i + 3]) for i in range(0, 19, 3))
        return dict(zip(OUTPUTS, map(compile_for_arrays, parts), strict=True))

    def constants(self, inputs: Sequence[Any]) -> Constants:
        """Return the constants, with expressions or columns where they differ."""
        given = dict(zip(self._varied, map(mark_present, inputs), strict=True))
        tree: Constants = rebuild(self._tree, self._fixed | given)
        return tree

    def _constants_of(
        self, scenarios: Scenarios
    ) -> tuple[Constants, Geometry, NDArray[np.intp]]:
        """Return the constants of scenarios, as columns.

        Their geometries, and that of each row.
        """
        geometries, which = Geometry.of_scenarios(scenarios)
        columns, geometry = scenarios.columns(), geometries.of_rows(which)
        limits = limits_of(self.scene, geometry)
        ends = tuple((np.cos(limit.end), np.sin(limit.end)) for limit in limits)
        # 0/0 is the rest of springs without stiffness
        with np.errstate(invalid="ignore"):
            model = kernel.model_of(columns, geometry)
        torque = columns.torque if self.profile else None
        return Constants(model, ends, torque), geometries, which


def _make_model(scenarios: Scenarios, profile: bool) -> ParametricModel:
    return ParametricModel(scenarios, profile=profile)
