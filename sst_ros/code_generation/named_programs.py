# SPDX-License-Identifier: Apache-2.0
"""The equations of a scene as programs with named arguments, for other languages.

Each is a straight-line program of the state, of what acts, and of the numbers of the
scene that are left open, its parameters. Without parameters they are the programs that
the package itself runs, operation by operation.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
from itertools import chain
from typing import Any, NamedTuple

import numpy as np

from sst_ros.dynamics import kernel
from sst_ros.dynamics.initial_state import start_of
from sst_ros.dynamics.traced_dynamics import ODE, Dynamics, parameter_symbols
from sst_ros.dynamics.variational import REBOUND, list_numbers, refuse_other_numbers
from sst_ros.errors import refusal, suggestion
from sst_ros.mechanism.geometry import Geometry
from sst_ros.programs.expression import Program, mark_present, trace
from sst_ros.scene.loads import JOINTS
from sst_ros.scene.scene import Scene
from sst_ros.scene.schema import build_unchecked
from sst_ros.scene.yaml_document import (
    dump,
    find_fields,
    find_number,
    plain,
    replace_values,
)
from sst_ros.state import MOMENT, TORQUES, cached_property
from sst_ros.version import VERSION

INFIX = {"add": "+", "sub": "-", "mul": "*", "div": "/"}
"""Operators of C and of Python between two operands."""

CALLER = "equations"  # heads the messages of what is refused

# names of the arguments of the equations
STATE_ARGUMENT = "state"
TORQUE_ARGUMENT = "torque"
MOMENT_ARGUMENT = "moment"
PARAMETERS = "parameters"

STATE_QUANTITIES = (
    "quaternion x of {E} in {B} [1]",
    "quaternion y [1]",
    "quaternion z [1]",
    "quaternion w [1]",
    "body rate W_x of the star in {E} [rad/s]",
    "body rate W_y [rad/s]",
    "body rate W_z [rad/s]",
    "torque that actuator 1 gives [N m]",
    "torque that actuator 2 gives [N m]",
    "torque that actuator 3 gives [N m]",
)
"""The numbers of a state, of which the last three are there where the actuators lag."""


class Argument(NamedTuple):
    """A vector that equations take."""

    name: str
    symbols: tuple[str, ...]  # of its numbers, in the programs
    quantities: tuple[str, ...]  # what they are, with units

    @property
    def size(self) -> int:
        """Count the numbers."""
        return len(self.symbols)


class NamedProgram(NamedTuple):
    """One of the equations: a function of vectors that returns a vector or a matrix.

    It calls no routine.
    """

    name: str
    description: str  # the units of what it returns included
    arguments: tuple[Argument, ...]
    shape: tuple[int, ...]
    program: Program  # its inputs are the symbols of the arguments, in order


class SceneEquations:
    """The equations of a scene, with `parameters` open.

    Args:
        scene: what is described.
        parameters: keys of numbers of the scene, which become arguments. A vector means
            each of its components, a list each of its entries.
        outputs: names of PROGRAM_OUTPUTS; None for all that there are.

    Raises:
        InputError: a parameter is no number of the equations of motion, or there is no
            such output.

    """

    def __init__(
        self, scene: Scene, parameters: Sequence[str], outputs: Sequence[str] | None
    ) -> None:
        self.scene = scene
        self.parameters = _list_parameters(scene, parameters)
        self.values = tuple(_value_of(scene, key) for key in self.parameters)
        self.dynamics = Dynamics.of(scene)
        outputs_known = [
            name for name in PROGRAM_OUTPUTS if self.parameters or name != BY_PARAMETERS
        ]
        self.outputs = tuple(outputs_known if outputs is None else outputs)
        for name in self.outputs:
            if name not in outputs_known:
                requirement = f"must be one of {', '.join(outputs_known)}"
                requirement += suggestion(name, outputs_known)
                raise refusal(CALLER, "outputs", name, requirement)

    @cached_property
    def programs(self) -> tuple[NamedProgram, ...]:
        """The equations, in the order of `outputs`."""
        return tuple(self.named(name) for name in self.outputs)

    def named(self, name: str) -> NamedProgram:
        """Trace one of PROGRAM_OUTPUTS."""
        return PROGRAM_OUTPUTS[name](self)

    @property
    def initial(self) -> tuple[float, ...]:
        """The state at t = 0.

        AssemblyError or SingularConfiguration is raised where there is none.
        """
        start = start_of(self.scene)
        lagged = len(self.dynamics.state) - len(start)
        return (*start, *[0.0] * lagged)

    @property
    def scene_hash(self) -> str:
        """SHA-256 of the scene as YAML, as `scene.yaml_document.dump` writes it."""
        return hashlib.sha256(dump(self.scene).encode()).hexdigest()

    @property
    def state(self) -> Argument:
        """The state, 7 numbers, or 10 where the actuators lag."""
        symbols = self.dynamics.state
        return Argument(STATE_ARGUMENT, symbols, STATE_QUANTITIES[: len(symbols)])

    @property
    def acting(self) -> tuple[Argument, ...]:
        """What acts from outside: torques, and a moment if it comes from a topic."""
        legs = (1, 2, 3)
        meaning = "command to" if self.scene.lags else "torque of"
        torques = tuple(f"{meaning} actuator {leg} [N m]" for leg in legs)
        symbols = self.dynamics.drive
        torque = Argument(TORQUE_ARGUMENT, symbols[TORQUES], torques)
        if not self.dynamics.has_moment_topic:
            return (torque,)
        moments = tuple(f"moment on the star, {axis} in {{B}} [N m]" for axis in "xyz")
        return torque, Argument(MOMENT_ARGUMENT, symbols[MOMENT], moments)

    @property
    def open(self) -> tuple[Argument, ...]:
        """The parameters as an argument; no argument where there are none."""
        if not self.parameters:
            return ()
        symbols = parameter_symbols(len(self.parameters))
        quantities = []
        for key, value in zip(self.parameters, self.values, strict=True):
            unit = _unit_of(self.scene, key)
            quantities.append(f"{key} [{unit}], in the scene {value!r}")
        return (Argument(PARAMETERS, symbols, tuple(quantities)),)

    @property
    def header(self) -> list[str]:
        """Lines that say what the equations are, for the head of each file."""
        lines = [
            (
                f"Equations of motion of the scene {self.scene.name}, by sst_ros"
                f" {VERSION}."
            ),
            f"SHA-256 of the scene: {self.scene_hash}",
            "",
            (
                "They are those of the mechanism with its loads. Torques are not"
                " clamped to"
            ),
            "the limit of the actuators, and nothing stops at a limit: results are not",
            "finite where mu_k is 0 or pi, and the caller has to check that they are.",
        ]
        for argument in (self.state, *self.acting, *self.open):
            lines += ["", f"{argument.name}:"]
            for i, quantity in enumerate(argument.quantities):
                lines.append(f"    [{i}] {quantity}")
        return lines

    def model(self, parameters: Sequence[Any]) -> kernel.Model:
        """Return the constants of the dynamics for values of the parameters."""
        if not self.parameters:
            return self.dynamics.numbers
        marked = map(mark_present, parameters)
        symbols = dict(zip(self.parameters, marked, strict=True))
        opened = build_unchecked(Scene, replace_values(plain(self.scene), symbols))
        return kernel.model_of(opened, Geometry.of(self.scene))

    def derivative(self, *inputs: Any) -> tuple[Any, ...]:
        """Return the derivative of the state, of all arguments in order."""
        size = len(self.dynamics.state) + len(self.dynamics.drive)
        dynamics = self.dynamics
        if not self.parameters:
            return ODE(dynamics).derivative(0.0, *inputs, numbered=True)
        model = self.model(inputs[size:])
        opened = Dynamics(model, has_moment_topic=dynamics.has_moment_topic)
        return ODE(opened).derivative(0.0, *inputs[:size])


def _derivative(equations: SceneEquations) -> NamedProgram:
    arguments = (equations.state, *equations.acting, *equations.open)
    program = trace(equations.derivative, _symbols(arguments))
    description = "derivative of the state by time [unit of the state/s]"
    size = equations.state.size
    return NamedProgram("derivative", description, arguments, (size,), program)


def _joints(equations: SceneEquations) -> NamedProgram:
    arguments = (equations.state, *equations.open)
    size = equations.state.size

    def joints(*inputs: Any) -> list[Any]:
        model = equations.model(inputs[size:])
        return [*chain(*kernel.joints(model, inputs[:size]))]

    program = trace(joints, _symbols(arguments))
    angles = ", ".join(JOINTS)
    description = f"angles {angles} [rad], then their rates [rad/s]"
    angles_and_rates = 2 * len(JOINTS)
    return NamedProgram("joints", description, arguments, (angles_and_rates,), program)


def _energies(equations: SceneEquations) -> NamedProgram:
    arguments = (equations.state, *equations.open)
    size = equations.state.size

    def energies(*inputs: Any) -> tuple[Any, ...]:
        model = equations.model(inputs[size:])
        state = inputs[:size]
        kinetic = kernel.kinetic_energy(model, state)
        return kinetic, kernel.potential_energy(model, state)

    program = trace(energies, _symbols(arguments))
    description = "kinetic and potential energy [J]"
    return NamedProgram("energies", description, arguments, (2,), program)


def _jacobian(equations: SceneEquations, by: Argument) -> NamedProgram:
    """Trace the Jacobian of the derivative by an argument.

    It has a row for each number of the state.
    """
    arguments = (equations.state, *equations.acting, *equations.open)
    derivative = trace(equations.derivative, _symbols(arguments), by.symbols)
    rows = equations.state.size
    # Behind the derivative itself, its slopes by one number of the argument after the
    # other.
    columns = np.arange(rows, len(derivative.outputs)).reshape(by.size, rows)
    entries = [derivative.outputs[i] for i in columns.T.ravel()]
    program = derivative.prune(entries)
    name = f"derivative_by_{by.name}"
    description = (
        f"Jacobian of the derivative by {by.name}: a row a number of the state"
    )
    return NamedProgram(name, description, arguments, (rows, by.size), program)


BY_PARAMETERS = "derivative_by_parameters"
PROGRAM_OUTPUTS: dict[str, Callable[[SceneEquations], NamedProgram]] = {
    "derivative": _derivative,
    "joints": _joints,
    "energies": _energies,
    "derivative_by_state": lambda equations: _jacobian(equations, equations.state),
    "derivative_by_torque": lambda equations: _jacobian(equations, equations.acting[0]),
    BY_PARAMETERS: lambda equations: _jacobian(equations, equations.open[0]),
}
"""What traces each of the equations."""


def write_steps(
    program: Program, write_operation: Callable[[str, list[str]], str]
) -> list[str]:
    """Return a line v0 = .., v1 = .. for each step of a program without routines.

    `write_operation` writes an operation on operands in the language of the lines.
    """
    write = program.operand_writer()
    lines = []
    for i, (operation, operands) in enumerate(program.steps):
        assert isinstance(operation, str)
        lines.append(f"v{i} = {write_operation(operation, [*map(write, operands)])}")
    return lines


def _symbols(arguments: Sequence[Argument]) -> list[str]:
    return [symbol for argument in arguments for symbol in argument.symbols]


def _list_parameters(scene: Scene, parameters: Sequence[str]) -> tuple[str, ...]:
    """Return the key of each number that is to be open."""
    keys = [key for name in parameters for key in list_numbers(scene, name)]
    refuse_other_numbers(scene, keys, CALLER)
    for key in keys:
        if key.startswith("initial"):
            requirement = "is a number of the initial state, not of the equations"
            raise refusal(CALLER, PARAMETERS, key, requirement)
        if key in REBOUND:
            requirement = "acts through the damping of the stops: give the scene"
            requirement += " stroke.damping in its place, and name that"
            raise refusal(CALLER, PARAMETERS, key, requirement)
        if keys.count(key) > 1:
            raise refusal(CALLER, PARAMETERS, key, "must be named once")
    return tuple(keys)


def _value_of(scene: Scene, key: str) -> float:
    value = find_number(scene, key)
    assert value is not None  # refused before
    return value


def _unit_of(scene: Scene, key: str) -> str:
    _, _, spec = next(find_fields(scene, key, components=True))
    return spec.unit or "1"
