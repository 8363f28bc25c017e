# SPDX-License-Identifier: Apache-2.0
"""Functions of scenes, traced: what a run calls, the ODE, and many scenarios at once.

The programs of many scenarios have the numbers that differ as inputs. What is the same
in all of them stays a constant that `trace` folds, so a batch computes only what
varies. A term whose coefficients are zero in some scenarios changes no bit there.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import lru_cache, partial
from itertools import chain
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sst_ros.dynamics import kernel
from sst_ros.dynamics.model import AT_MU, Limit, limits_of
from sst_ros.dynamics.model import LEGS as LEGS
from sst_ros.errors import Check, refuse_unless
from sst_ros.mechanism.generic_math import Scalar, positive, sin, symmetric_rows, triple
from sst_ros.mechanism.geometry import Array, Geometry
from sst_ros.programs.compiled import (
    RowsFunction,
    compile_functions,
    compile_rows,
)
from sst_ros.programs.expression import (
    Expression,
    Program,
    compile_for_arrays,
    compile_program,
    mark_present,
    number_constants,
    trace,
    trace_along,
)
from sst_ros.scene.scene import Scenarios, Scene
from sst_ros.scene.schema import Place, leaves, rebuild
from sst_ros.scene.torque_profile import SineTorque
from sst_ros.state import MOMENT, STAR_RATE, TORQUES, ZERO, Joints, cached_property

Function = Callable[..., Sequence[float]]

QUATERNION_SYMBOLS = ("x", "y", "z", "w")
RATE_SYMBOLS = ("wx", "wy", "wz")
MOTION = (*QUATERNION_SYMBOLS, *RATE_SYMBOLS)
LAG = ("l1", "l2", "l3")
TORQUE_SYMBOLS = ("t1", "t2", "t3")
MOMENT_SYMBOLS = ("n1", "n2", "n3")
BODY_ACCELERATION = ("ax", "ay", "az")

STATE_SIZE = len(MOTION)  # of a state without lagged torques


def parameter_symbols(count: int) -> tuple[str, ...]:
    """Return symbols of numbers that are inputs of a program."""
    return tuple(f"p{i}" for i in range(count))


DYNAMICS_OUTPUTS = (*Joints._fields, "energy")
"""Quantities of a state that depend on the numbers of its scenario."""


class Dynamics:
    """Programs of a manipulator with the constants `model`, numbers or not.

    `state` has the names of the state's numbers: quaternion, body rate, lagged torques
    if any; `drive` of what acts from outside: torques, and a moment if it comes from a
    topic.
    """

    def __init__(self, model: kernel.Model, *, has_moment_topic: bool = False) -> None:
        self.model = model
        self.has_moment_topic = has_moment_topic
        self.state: tuple[str, ...] = MOTION
        if model.time_constant is not None:
            self.state = (*MOTION, *LAG)
        self.drive: tuple[str, ...] = TORQUE_SYMBOLS
        if has_moment_topic:
            self.drive = (*TORQUE_SYMBOLS, *MOMENT_SYMBOLS)

    @staticmethod
    def of(scene: Scene) -> Dynamics:
        """Return those of a scene; scenes of the same constants share them."""
        has_moment_topic = scene.moment is not None and scene.moment.topic
        return recent(kernel.model_of(scene), has_moment_topic=has_moment_topic)

    @cached_property
    def derivative(self) -> Function:
        """Derivative of the state by time, of state and drive."""
        return partial(compile_program(ODE(self).program), 0.0)

    @cached_property
    def joints(self) -> Function:
        """Angles gamma, mu and beta, and rates in the same order, 18 numbers.

        They depend on quaternion and body rate; an angle without a value is nan.
        """
        return compile_functions({"joints": self.joints_program}, ("joints",))["joints"]

    @cached_property
    def joints_of_rows(self) -> RowsFunction:
        """The same of rows of seven numbers each, shape (n, 7) -> (n, 18)."""
        return compile_rows({"joints": self.joints_program}, "joints")

    @cached_property
    def joints_program(self) -> Program:
        """The program of `joints`."""

        def angles_and_rates(*state: Any) -> list[Any]:
            return [*chain(*kernel.joints(self.numbers, state))]

        return trace(angles_and_rates, MOTION)

    @cached_property
    def inverse(self) -> Function:
        """Torques that give a W_dot, det g and sin^2(mu_k), seven numbers.

        See `kernel.actuator_torque`. The inputs are the first seven numbers of the
        state, W_dot, and a moment if it comes from a topic.
        """
        return compile_program(self._inverse_program)

    @cached_property
    def inverse_of_rows(self) -> RowsFunction:
        """The same of rows of inputs, shape (n, inputs) -> (n, 7)."""
        return compile_rows({"inverse": self._inverse_program}, "inverse")

    @cached_property
    def _inverse_program(self) -> Program:
        def torques(*inputs: Any) -> tuple[Any, ...]:
            x, y, z, w, wx, wy, wz, ax, ay, az, *moment = inputs
            torque, determinant = kernel.actuator_torque(
                self.model,
                (x, y, z, w),
                (wx, wy, wz),
                (ax, ay, az),
                triple(moment) if moment else None,
            )
            squares = [leg.u for leg in kernel.leg_motions(self.model, inputs)]
            return (*torque, determinant, *squares)

        names: tuple[str, ...] = (*MOTION, *BODY_ACCELERATION)
        if self.has_moment_topic:
            names = (*names, *MOMENT_SYMBOLS)
        return trace(torques, names)

    @cached_property
    def reduced_inertia(self) -> Function:
        """Inertia reduced to the star in {E}, then the rows g_k, nine numbers each.

        See `kernel.balance`. The input is a quaternion.
        """
        return compile_program(self._reduced_inertia_program)

    @cached_property
    def reduced_inertia_of_rows(self) -> RowsFunction:
        """The same of rows of quaternions, shape (n, 4) -> (n, 18)."""
        return compile_rows({"inertia": self._reduced_inertia_program}, "inertia")

    @cached_property
    def _reduced_inertia_program(self) -> Program:
        def inertia_and_rows(x: Any, y: Any, z: Any, w: Any) -> list[Any]:
            inertia, _, reach = kernel.balance(self.model, (x, y, z, w), ZERO, ZERO)
            return [*chain(*symmetric_rows(inertia)), *chain(*reach)]

        return trace(inertia_and_rows, QUATERNION_SYMBOLS)

    @cached_property
    def actuator_motion(self) -> Function:
        """Coordinates x and their rates, then both by each number of state and torque.

        x has gamma, gamma_dot, and the lagged torques if any. The inputs are the state
        and the drive.
        """
        return compile_program(self._actuator_motion_program)

    @cached_property
    def coordinates_by_state(self) -> Function:
        """Derivatives of the coordinates x by each number of the state.

        The inputs are those of `actuator_motion`, of whose results they are a part.
        """
        program = self._actuator_motion_program
        size = len(self.state)
        coordinates = size - 1  # x: a quaternion is three coordinates
        row_size = 2 * coordinates  # of x and its rates
        slopes: list[float | int] = []
        for number in range(1, size + 1):  # the values themselves come before the rows
            begin = number * row_size
            slopes += program.outputs[begin : begin + coordinates]
        return compile_program(program.prune(slopes))

    @cached_property
    def _actuator_motion_program(self) -> Program:
        size = len(self.state)

        def motion(*inputs: Any) -> tuple[Any, ...]:
            state, drive = inputs[:size], inputs[size:]
            torque, moment = triple(drive[:LEGS]), drive[LEGS:]
            slope = kernel.derivative(
                self.model, state, torque, triple(moment) if moment else None
            )
            body_acceleration = triple(slope[STAR_RATE])
            gamma_ddot = kernel.actuator_acceleration(
                self.model, state, body_acceleration
            )
            joints = kernel.joints(self.model, state)
            x = (*joints.gamma, *joints.gamma_dot, *state[STATE_SIZE:])
            return (*x, *joints.gamma_dot, *gamma_ddot, *slope[STATE_SIZE:])

        inputs = (*self.state, *self.drive)
        return trace(motion, inputs, (*self.state, *TORQUE_SYMBOLS))

    @cached_property
    def energies(self) -> Function:
        """Kinetic and potential energy [J] of the state."""

        def energies(*state: Any) -> tuple[Any, ...]:
            kinetic = kernel.kinetic_energy(self.model, state)
            return kinetic, kernel.potential_energy(self.model, state)

        return compile_program(trace(energies, self.state))

    def total_energy(self, state: Sequence[float]) -> float:
        """Return the kinetic plus potential energy of a state [J].

        The state may have further numbers.
        """
        return sum(self.energies(*state[: len(self.state)]))

    @cached_property
    def numbers(self) -> kernel.Model:
        """The model, whose numbers but 0 and 1 may differ in another scene."""
        model: kernel.Model = number_constants(self.model, ("model",))
        return model


recent = lru_cache(maxsize=32)(Dynamics)


class ODE:
    """Derivative of a scene's state, as programs with inputs t, `state`, `drive`.

    State and drive are those of `dynamics`, with these differences: `torque` over time,
    clamped to `limit` [N m], replaces the torques of the drive; with `phases` the drive
    has the three phases [rad] in their place. `work` appends to the state the work [J]
    that actuators and moments have put in, less what friction has taken out.
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
        self.dynamics = dynamics
        self._torque = torque
        self._limit = limit
        self._work = work
        self._phases = phases
        self.state = (*dynamics.state, "work") if work else dynamics.state
        self.drive = dynamics.drive
        if torque is not None and not phases:
            self.drive = dynamics.drive[MOMENT]
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

    def eigenvalues(self, t: float, y: Sequence[float], d: Sequence[float]) -> Array:
        """Return the eigenvalues of `matrix` [1/s], shape (size,)."""
        return np.asarray(np.linalg.eigvals(self.matrix(t, y, d)))

    def matrix(self, t: float, y: Sequence[float], d: Sequence[float]) -> Array:
        """Return the exact Jacobian at time [s], state and drive, shape (size, size).

        Raises ArithmeticError where it is not finite.
        """
        size = len(self.state)
        first = 2 * size  # of the slopes by state, behind the derivative and that by t
        slopes = np.array(self.linearised(t, *y, *d)[first:])
        if not np.isfinite(slopes).all():
            raise ArithmeticError("the Jacobian is not finite")
        return np.asarray(slopes.reshape(size, size).T, dtype=float)

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
        """The derivative, and its derivatives by t, state and the drive's torques."""
        program = trace(
            self._of_numbers, self._inputs, ("t", *self.state, *TORQUE_SYMBOLS)
        )
        return compile_functions({"linearised": program}, ("linearised",))["linearised"]

    @cached_property
    def tangent(self) -> Program:
        """The derivative, and how it changes where state and torques change.

        After the inputs of `program` come the rates of change of the state and of the
        drive's torques.
        """
        return trace_along(
            self._of_numbers, self._inputs, (*self.state, *TORQUE_SYMBOLS)
        )

    def derivative(
        self, time: Any, *inputs: Any, numbered: bool = False
    ) -> tuple[Any, ...]:
        """Return the derivative at a time, a state and a drive of any kind.

        With `numbered` its constants are each a `Number`, which another scene may have
        another value of.
        """
        model = self.dynamics.model
        sine = self._torque
        limit = self._limit
        if numbered:
            model = self.dynamics.numbers
            sine = number_constants(sine, ("torque",))
            limit = number_constants(limit, ("limit",))
        state = inputs[: len(self.dynamics.state)]
        drive = inputs[len(self.state) :]
        torque, moment = drive[TORQUES], drive[MOMENT]
        if sine is not None:
            phase = torque
            if not self._phases:
                phase = sine.phase
                moment = drive
            rows = zip(sine.amplitude, sine.frequency, phase, strict=True)
            torque = tuple(a * sin(f * time + p) for a, f, p in rows)
            if limit is not None:
                torque = tuple(_clamp(tau, limit) for tau in torque)
        external = triple(moment) if moment else None
        slope = kernel.derivative(model, state, triple(torque), external)
        if not self._work:
            return slope
        return (*slope, kernel.power(model, state, triple(torque), external))


def _clamp(torque: Any, limit: Any) -> Any:
    """Clamp a torque to -limit and limit, numbers of any kind."""
    return limit - positive(2.0 * limit - positive(torque + limit))


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
    distances = []
    rates = []
    for limit, (cosine, sine) in zip(limits, ends, strict=True):
        joint, number = divmod(limit.joint, LEGS)
        leg = legs[number]
        if joint == AT_MU:  # sin(mu)^2 - sin(end)^2
            distance = leg.u - sine * sine
            rate = -2.0 * leg.a * leg.a_dot
        else:  # sqrt(u) sin(sign * (angle - end))
            across, along = kernel.direction_of(leg, joint)
            distance = limit.sign * (across * cosine - along * sine)
            turned = along * cosine + across * sine
            rate = limit.sign * turned * kernel.joint_rate(leg, joint)
            rate = rate - distance * leg.a * leg.a_dot / leg.u
        distances.append(distance)
        rates.append(rate)
    return (*distances, *rates)


class Constants(NamedTuple):
    """All numbers of the traced programs of a scene: a tree of numbers or columns."""

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
    """The programs of a scene whose inputs are the numbers that differ, `names`.

    `ode` has the names of the state and the drive. Models that are equal have the same
    programs.

    Args:
        scene: what is simulated.
        profile: whether the scene's own torques act.
        constants: of the programs; of those that differ any numbers.
        varied: places of the constants that differ.

    """

    def __init__(
        self,
        scene: Scene,
        profile: bool,
        constants: Constants,
        varied: tuple[Place, ...],
    ) -> None:
        self.scene = scene
        self.profile = profile
        self._constants = constants
        self._varied = varied
        self._fixed: dict[Place, float] = leaves(constants)
        for place in varied:
            del self._fixed[place]
        self.names = parameter_symbols(len(varied))
        self.ode = ODE(Dynamics.of(scene), scene.torque if profile else None)

    @classmethod
    def of(cls, scenarios: Scenarios, *, profile: bool) -> ParametricModel:
        """Make the model of scenarios: what differs between them are its inputs."""
        scene = scenarios.document
        columns, _, _ = _constants_of(scene, scenarios, profile=profile)
        numbers: dict[Place, float] = {}
        varied = []
        for place, column in leaves(columns).items():
            if np.max(column) != np.min(column):
                varied.append(place)
                numbers[place] = 0.0
            else:
                numbers[place] = float(np.ravel(column)[0])
        return cls(scene, profile, rebuild(columns, numbers), tuple(varied))

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle what was given: programs are traced again."""
        return ParametricModel, self._arguments

    def __eq__(self, other: object) -> bool:
        return isinstance(other, ParametricModel) and (
            self._arguments == other._arguments
        )

    def __hash__(self) -> int:
        return hash(self._arguments)

    @property
    def _arguments(self) -> tuple[Any, ...]:
        return self.scene, self.profile, self._constants, self._varied

    def columns(self, scenarios: Scenarios) -> ParameterColumns:
        """Return the numbers of scenarios.

        Refused are numbers that differ and are fixed in this model, and actuators that
        cannot give the torques of the profile.
        """
        tree, geometries, geometry_index = _constants_of(
            self.scene, scenarios, profile=self.profile
        )
        numbers = leaves(tree)
        inputs = np.empty((len(self._varied), len(geometry_index)))
        for row, place in zip(inputs, self._varied, strict=True):
            row[:] = numbers[place]
            *section, name = place
            if name == "static":
                # static = 0 is no breakaway torque, which is as if it were the Coulomb
                # torque.
                level: Place = (*section, "coulomb")
                row[:] = np.where(row == 0.0, numbers[level], row)
            elif name == "rest":
                # A spring without stiffness has none, and any number will do.
                np.nan_to_num(row, copy=False)
        torque_limit = getattr(scenarios.columns().actuators, "torque_limit", None)
        if torque_limit is None:
            torque_limit = np.inf
        limit = np.full(len(geometry_index), torque_limit)
        limit[limit == 0.0] = np.inf  # zero: the scenario has no limit
        all_lag = not np.any(tree.model.time_constant == 0.0)
        requirement = "must be > 0 [s] in every scenario, or in none"
        checks: list[Check] = [("actuators.time_constant", 0.0, all_lag, requirement)]
        for place, fixed in self._fixed.items():
            is_fixed = bool(np.all(numbers[place] == fixed))
            requirement = f"must be {fixed} in all scenarios of this model"
            checks.append((str(place), numbers[place], is_fixed, requirement))
        if tree.torque is not None:
            checks.append(_check_limit(scenarios, tree.torque, limit))
        refuse_unless(self.scene.name, *checks)
        return ParameterColumns(inputs, geometries, geometry_index, limit)

    @cached_property
    def program(self) -> Program:
        """Derivative of the state; inputs t, state, drive, and the varied numbers."""
        return trace(
            self.derivative, ("t", *self.ode.state, *self.ode.drive, *self.names)
        )

    def derivative(self, *inputs: Any) -> tuple[Any, ...]:
        """Return the derivative at the inputs of `program`, of any kind."""
        count = 1 + len(self.ode.state) + len(self.ode.drive)
        constants = self.constants(inputs[count:])
        topic = self.ode.dynamics.has_moment_topic
        dynamics = Dynamics(constants.model, has_moment_topic=topic)
        return ODE(dynamics, constants.torque).derivative(*inputs[:count])

    @cached_property
    def limit_distances(self) -> Program:
        """Distances to the limits and their rates; inputs MOTION and varied numbers."""
        return trace(self.distances, (*MOTION, *self.names))

    def distances(self, *inputs: Any) -> tuple[Scalar, ...]:
        """Return the results of `limit_distances` at its inputs, of any kind."""
        limits = tuple(limits_of(self.scene, Geometry.of(self.scene)))
        state, numbers = inputs[:STATE_SIZE], inputs[STATE_SIZE:]
        constants = self.constants(numbers)
        return limit_distances(limits, constants.ends, constants.model, state)

    def joints(self, *inputs: Any) -> Joints:
        """Return angles and rates of the joints at the inputs of `limit_distances`."""
        state, numbers = inputs[:STATE_SIZE], inputs[STATE_SIZE:]
        return kernel.joints(self.constants(numbers).model, state)

    @cached_property
    def outputs(self) -> dict[str, Callable[..., tuple[Any, ...]]]:
        """Functions of arrays for quantities of DYNAMICS_OUTPUTS by name.

        They have the inputs of `limit_distances`, and give three angles [rad] or rates
        [rad/s] each, or the energy [J].
        """

        def values(*inputs: Expression) -> tuple[Any, ...]:
            state, numbers = inputs[:STATE_SIZE], inputs[STATE_SIZE:]
            model = self.constants(numbers).model
            kinetic = kernel.kinetic_energy(model, state)
            energy = kinetic + kernel.potential_energy(model, state)
            return (*chain(*self.joints(*inputs)), energy)

        program = trace(values, (*MOTION, *self.names))
        functions = {}
        for number, name in enumerate(DYNAMICS_OUTPUTS):
            first = LEGS * number
            own = program.prune(program.outputs[first : first + LEGS])
            functions[name] = compile_for_arrays(own)
        return functions

    def constants(self, inputs: Sequence[Any]) -> Constants:
        """Return the constants, with expressions or columns where they differ."""
        varied = dict(zip(self._varied, map(mark_present, inputs), strict=True))
        tree: Constants = rebuild(self._constants, self._fixed | varied)
        return tree


def _constants_of(
    scene: Scene, scenarios: Scenarios, *, profile: bool
) -> tuple[Constants, Geometry, NDArray[np.intp]]:
    """Return constants of scenarios, as columns, and their distinct geometries.

    The last of the three results is the index of each row's geometry.
    """
    geometries, geometry_index = Geometry.of_scenarios(scenarios)
    geometry = geometries.of_rows(geometry_index)
    columns = scenarios.columns()
    limits = limits_of(scene, geometry)
    ends = tuple((np.cos(limit.end), np.sin(limit.end)) for limit in limits)
    # The rest of springs without stiffness is 0/0.
    with np.errstate(invalid="ignore"):
        model = kernel.model_of(columns, geometry)
    torque = columns.torque if profile else None
    return Constants(model, ends, torque), geometries, geometry_index


def _check_limit(scenarios: Scenarios, torque: SineTorque, limit: Array) -> Check:
    """Return the check that actuators can give a profile in all scenarios.

    A fixed step does not resolve the kinks of a clamped torque.
    """
    *amplitudes, limits = np.broadcast_arrays(*torque.amplitude, limit)
    largest = np.abs(amplitudes).max(axis=0)
    row = int(np.argmax(largest > limits))
    key = "actuators.torque_limit"
    if scenarios.count:
        key = f"scenario {row}: {key}"
    requirement = f"must not be less than the amplitude {largest[row]} of the profile"
    return key, float(limits[row]), bool(largest[row] <= limits[row]), requirement
