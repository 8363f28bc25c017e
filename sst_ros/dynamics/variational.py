# SPDX-License-Identifier: Apache-2.0
"""Variational equations: integrate a motion with its derivatives by parameters.

The sensitivities S = dy/dp of the motion y' = f(y, t, p) obey

    S' = (df/dy) S + df/dp,  S(0) = dy(0)/dp

(Hairer, Norsett and Wanner, Solving Ordinary Differential Equations I, section I.14).
Both derivatives are those of the traced equation of motion, exact to rounding, and one
error control holds for S and the motion.

Where f jumps across a surface that the motion meets, S jumps by the saltation matrix,
which is one where f is continuous (Leine and Nijmeijer, Dynamics and Bifurcations of
Non-Smooth Mechanical Systems, Springer 2004, 7.2): so it is where an elastic stop is
met or left. Torques that jump do so at times that no parameter moves.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from functools import lru_cache
from itertools import chain
from typing import Any, NamedTuple

import numpy as np

from sst_ros.dynamics import kernel
from sst_ros.dynamics.initial_state import initial_state
from sst_ros.dynamics.model import damping_of
from sst_ros.dynamics.traced_dynamics import (
    LEGS,
    MOTION,
    STATE_SIZE,
    TORQUE_SYMBOLS,
    Dynamics,
    parameter_symbols,
)
from sst_ros.errors import SingularConfiguration, refusal
from sst_ros.mechanism.generic_math import (
    Triple,
    atan2,
    cos,
    cross3,
    dot3,
    quaternion_rate,
    sin,
    sqrt,
    triple,
)
from sst_ros.mechanism.geometry import Geometry
from sst_ros.programs.compiled import compile_functions
from sst_ros.programs.expression import (
    compile_for_arrays,
    divide,
    mark_present,
    trace,
)
from sst_ros.scene.loads import NANOSECOND
from sst_ros.scene.scene import Scene
from sst_ros.scene.schema import Section, build_unchecked, key_of, leaves
from sst_ros.scene.torque_profile import (
    FunctionTorque,
    LostTorque,
    PolynomialTorque,
    SineTorque,
    TorqueProfile,
    TorqueTable,
)
from sst_ros.scene.yaml_document import find_fields, find_number, plain, replace_values
from sst_ros.state import QUATERNION, STAR, STAR_RATE, Array, clamp, freeze

SENSITIVITY_TOLERANCE = 1e-12
"""Error of a step, relative and absolute; the latter over the size of a parameter."""

AT_STOPS = 0.1
"""Share of SENSITIVITY_TOLERANCE that is allowed where stops are elastic.

A step across a jump of derivatives loses order.
"""

MOST_MOTION_EVALUATIONS = 4_000_000
"""Evaluations of a motion: minutes, where a stiff one needs hours by explicit steps."""

GEOMETRY = ("base.v", "star.alpha_deg")
"""Keys of the geometry in the equations of motion; the third alpha is what is left."""

ACTUATOR_PARAMETERS = (
    "actuators.torque_limit",
    "actuators.idle_damping",
    "actuators.velocity_limit",
    "actuators.acceleration_limit",
)
OUTSIDE_PARAMETERS = (
    "torque", "motion", "duration", "initial.orientation", "base.radius", "star.radius",
    "workspace", "stroke.at_end", *ACTUATOR_PARAMETERS,
)  # fmt: skip
# known to the equations as one damping
REBOUND = ("stroke.restitution", "stroke.impact_rate")
FIRST_TIME = np.zeros(1)
OWN_TORQUE = "torque"
"""Parameter that means all numbers of the torques."""


class VariationalEquations:
    """Motions of a scene under torques over time, and their derivatives by parameters.

    Those are numbers of the scene by key, as "friction.gamma.smoothing",
    "initial.gamma_dot[0]" or "actuators.time_constant"; a list without index means all
    its entries. Of the geometry they are "base.v[0][1]" and "star.alpha_deg[0]", for
    `simulate` alone: `run` takes it as it is. With `by_torque` the numbers of the
    torques follow. InputError names what is no such key.
    """

    def __init__(
        self,
        scene: Scene,
        names: Sequence[str],
        torque: TorqueProfile,
        *,
        by_torque: bool = False,
        caller: str = "simulate",
    ) -> None:
        self.scene = scene
        self.names = tuple(names)
        self._torque = torque
        self._geometry = Geometry.of(scene)
        self._caller = caller
        self._by_torque = by_torque
        refuse_other_numbers(scene, self.names, caller)

    def run(self, values: Array, t: Array) -> tuple[Array, Array]:
        """Integrate motion and sensitivities with values of the parameters, shape (p,).

        Returns states (q, W and lagged torques) at times t [s], shape (n,), ascending
        from 0 on, of shape (n, m), and their derivatives, (n, m, p), with those by the
        numbers of the torques last; raises InputError where there is no motion.
        """
        # Only start and stroke are checked as a scene's: inertias between iterations of
        # a fit need not be those of bodies that can exist.
        checked_values = {}
        for name, value in zip(self.names, values.tolist(), strict=True):
            if name.startswith(("initial", "stroke")):
                checked_values[name] = value
        scene = self.scene.with_values(checked_values)
        state, slopes = self._start(scene)
        solution = self.integrate(state, slopes, t, values, scene=scene)
        if solution is None:
            requirement = "leave no motion to the last time"
            raise refusal(
                self._caller, _argument(self._caller), values.tolist(), requirement
            )
        return solution

    def integrate(
        self,
        state: Array,
        slopes: Array,
        t: Array,
        values: Array | None = None,
        *,
        scene: Scene | None = None,
    ) -> tuple[Array, Array] | None:
        """Integrate from a state, (m,), and its derivatives, (m, k), to times t [s].

        The last of the k numbers are the parameters, with these values, and those of
        the torques; the numbers before them change the motion by its initial state
        alone. Returns what `run` does, or None where there is no motion, or where it
        needs more evaluations than MOST_MOTION_EVALUATIONS.
        """
        from scipy.integrate import solve_ivp  # takes 0.3 s, which few runs need

        if scene is None:
            scene = self.scene
        if values is None:
            values = np.empty(0)
        numbers = np.append(values, _numbers(self._torque) if self._by_torque else [])
        size = len(state)
        first = slopes.shape[1] - len(numbers)  # column of the first parameter
        rates = self._rates(scene, size, first, values)
        tolerance = SENSITIVITY_TOLERANCE
        if scene.stroke.at_end == "elastic":
            tolerance = SENSITIVITY_TOLERANCE * AT_STOPS
        parameter_sizes = np.append(np.ones(first), np.abs(numbers))
        parameter_sizes = parameter_sizes + (parameter_sizes == 0.0)
        absolute = np.append(np.ones(size), np.tile(1.0 / parameter_sizes, size))
        limit = scene.torque_limit
        end = max(float(t[-1]), NANOSECOND)  # SciPy needs an interval
        breaks = self._torque.kinks(limit, end)
        inside = breaks[(breaks > 0.0) & (breaks < end)]
        y = np.concatenate([state, slopes.ravel()])
        rows = np.empty((len(t), len(y)))
        rows[t <= 0.0] = y
        begin = 0.0
        for stop in np.append(np.unique(inside), end).tolist():
            reached = (t > begin) & (t <= stop)
            piece = self._torque.piece(begin, stop)
            forcing = self._forcing(begin, stop, limit)
            try:
                run = solve_ivp(
                    rates, (begin, stop), y, "DOP853", np.union1d(t[reached], stop),
                    rtol=tolerance, atol=tolerance * absolute, args=(piece, forcing),
                )  # fmt: skip
            except (ArithmeticError, ValueError):
                return None
            if run.status != 0:
                return None
            rows[reached] = run.y.T[: int(reached.sum())]
            y = run.y[:, -1]
            begin = stop
        return rows[:, :size], rows[:, size:].reshape(len(t), size, -1)

    def _rates(
        self, scene: Scene, size: int, first: int, values: Array
    ) -> Callable[[float, Array, TorqueProfile, Callable[[float], Array]], Array]:
        """Return the variational equations as a function for `solve_ivp`.

        It takes the time [s]; a state of `size` numbers, then its derivatives, of which
        those by the parameters with these values begin in the column `first`; the
        torques, and their derivatives by their numbers, both over time. It raises
        ArithmeticError after MOST_MOTION_EVALUATIONS calls.
        """
        parameters, factor = self._parameters(scene, values)
        limit = scene.torque_limit
        evaluations = iter(range(MOST_MOTION_EVALUATIONS))
        derivatives = trace_derivatives(self.scene, self.names, self._by_torque)
        # rows of y', by the state, by the torques and by the parameters
        blocks = np.cumsum([1, size, LEGS * self._by_torque])

        def rates(
            time: float,
            y: Array,
            acting: TorqueProfile,
            forcing: Callable[[float], Array],
        ) -> Array:
            if next(evaluations, None) is None:
                raise ArithmeticError
            torque = clamp(acting.at(time), limit)
            flat = derivatives(*y[:size].tolist(), *torque, *parameters)
            rows = np.array(flat).reshape(-1, size)
            rate, by_state, by_torque, by_parameter = np.split(rows, blocks)
            flow = by_state.T @ y[size:].reshape(size, -1)
            own = [by_parameter.T * factor, by_torque.T @ forcing(time)]
            flow[:, first:] += np.hstack(own)
            return np.concatenate([rate[0], flow.ravel()])

        return rates

    def _parameters(self, scene: Scene, values: Array) -> tuple[list[float], Array]:
        """Return the parameters as the equations take them, and factors of derivatives.

        Restitution and impact rate act as one damping: the first of them has it.
        """
        parameters = values.tolist()
        factor = np.ones(len(values))
        rebound = [i for i, name in enumerate(self.names) if name in REBOUND]
        if not rebound:
            return parameters, factor
        slopes = dict(zip(REBOUND, differentiate_damping(scene), strict=True))
        for i in rebound:
            factor[i] = slopes[self.names[i]]
            parameters[i] = 0.0
        parameters[rebound[0]] = damping_of(scene.stroke)
        return parameters, factor

    def differentiate_joints(self, motion: Array) -> Array:
        """Differentiate gamma and gamma_dot by quaternion and W, shape (7, 6, n).

        `motion` has the shape (7, n).
        """
        return self._joint_slopes(motion, ())

    def differentiate_joints_by_geometry(self, motion: Array) -> Array:
        """Differentiate gamma and gamma_dot at a fixed state by the parameters.

        The state has the shape (7, n), the derivatives (p, 6, n). Those by numbers that
        are not of the geometry are zero.
        """
        names = tuple(name for name in self.names if name.startswith(GEOMETRY))
        slopes = np.zeros((len(self.names), 6, motion.shape[1]))
        chosen = [self.names.index(name) for name in names]
        slopes[chosen] = self._joint_slopes(motion, names)[STATE_SIZE:]
        return slopes

    def _joint_slopes(self, motion: Array, names: tuple[str, ...]) -> Array:
        """Differentiate gamma and gamma_dot by quaternion, W and geometry numbers.

        `motion` has the shape (7, n), the derivatives (7 + names, 6, n).
        """
        count = motion.shape[1]
        numbers = [find_number(self.scene, name) for name in names]
        columns = _trace_joints(self.scene, names)(*motion, *numbers)
        rows = np.stack([np.broadcast_to(row, count) for row in columns])
        _values, *slopes = rows.reshape(-1, 2 * LEGS, count)
        return np.array(slopes)

    def _start(self, scene: Scene) -> tuple[Array, Array]:
        """Return the initial state, and derivatives by parameters and torques."""
        torque_count = len(_numbers(self._torque)) if self._by_torque else 0
        state = np.zeros(len(Dynamics.of(scene).state))
        state[STAR] = initial_state(scene, self._geometry)
        slopes = np.zeros((len(state), len(self.names) + torque_count))
        own = [i for i, name in enumerate(self.names) if name.startswith("initial")]
        shaped = [i for i, name in enumerate(self.names) if name.startswith(GEOMETRY)]
        if not own and not shaped:
            return state, slopes
        by_joints = self._start_by_joints(state[STAR])
        if shaped:  # the star moves so that gamma and gamma_dot stay
            start = state[STAR, None]
            by_geometry = self.differentiate_joints_by_geometry(start)[shaped, :, 0]
            slopes[STAR, shaped] = -by_joints @ by_geometry.T
        for i in own:
            name = self.names[i]
            first = LEGS if name.startswith("initial.gamma_dot") else 0
            legs = list(range(LEGS))
            if name.endswith("]"):
                legs = [int(name[-2])]  # a single digit stands before the bracket
            columns = [first + leg for leg in legs]
            slopes[STAR, i] = by_joints[:, columns].sum(axis=1)
        return state, slopes

    def _start_by_joints(self, start: Array) -> Array:
        """Differentiate quaternion and W, (7,), by gamma and gamma_dot, (7, 6).

        It is the inverse of how gamma and gamma_dot change by a rotation vector and W,
        both in {E}. SingularConfiguration is raised where there is none.
        """
        tangent = np.zeros((STATE_SIZE, 6))
        tangent[STAR_RATE, LEGS:] = np.eye(3)
        for i, axis in enumerate(np.eye(3)):
            tangent[QUATERNION, i] = quaternion_rate(
                tuple(start[QUATERNION]), tuple(axis)
            )
        forward = self.differentiate_joints(start[:, None])[..., 0].T @ tangent
        try:
            return np.asarray(tangent @ np.linalg.inv(forward))
        except np.linalg.LinAlgError:
            message = (
                "no derivative by initial angles or rates: parallel singularity, det"
            )
            raise SingularConfiguration(message, 0.0) from None

    def _forcing(
        self, begin: float, end: float, limit: float | None
    ) -> Callable[[float], Array]:
        """Return the torques' derivatives by their numbers over time.

        The function is for times between two kinks, at which torques beyond the limit
        do not change.
        """
        if not self._by_torque:
            return lambda time: np.empty((0, 0))
        slopes = _differentiate_torque(self._torque, begin, end)
        middle = 0.5 * (begin + end)
        acting = np.abs(self._torque.piece(begin, end).at(middle))
        largest = np.inf if limit is None else limit
        is_free = (acting <= largest)[:, None]
        return lambda time: slopes(time) * is_free


def refuse_other_numbers(scene: Scene, names: Sequence[str], caller: str) -> None:
    """Raise InputError of a caller for a name of no number of the equations of motion.

    Only `simulate` differentiates by the geometry.
    """
    for name in names:
        requirement = ""
        if name.startswith(GEOMETRY) and caller != "simulate":
            requirement = "is geometry, which is taken as known"
        elif name.startswith(OUTSIDE_PARAMETERS):
            requirement = "is no number of the equations of motion"
        elif find_number(scene, name) is None:
            requirement = "must be the key of a number that the scene has"
        if requirement:
            raise refusal(caller, _argument(caller), name, requirement)


def _argument(caller: str) -> str:
    """Return the name of the argument by which a caller was given names of numbers."""
    return "sensitivities" if caller == "simulate" else "parameters"


class _TracedAxes(NamedTuple):
    """The arrays of a `Geometry` that the dynamics take, as symbols."""

    v: Sequence[Any]
    w: Sequence[Any]
    e: Sequence[Any]
    arc: Sequence[Any]

    @classmethod
    def of(cls, scene: Any) -> _TracedAxes:
        """Derive them as `Geometry.build` does, of base and star with symbols."""
        v_1, v_2, v_3 = (_unit(triple(row)) for row in scene.base.v)
        w = []
        arcs = []
        for begin, end in ((v_1, v_2), (v_2, v_3), (v_3, v_1)):
            normal = cross3(begin, end)
            sine = sqrt(dot3(normal, normal))
            w.append(triple(x / sine for x in normal))
            arcs.append(atan2(sine, dot3(begin, end)))
        degree = float(np.radians(1.0))
        alpha_12, alpha_23, _ = (degree * angle for angle in scene.star.alpha_deg)
        turns = (0.0, alpha_12, alpha_12 + alpha_23)
        e = [(-sin(turn), cos(turn), 0.0) for turn in turns]
        return cls([v_1, v_2, v_3], w, e, arcs)

    def of_leg(self, name: str, k: int) -> Any:
        """Return what an array has for leg k."""
        return getattr(self, name)[k]


def _unit(vector: Triple) -> Triple:
    length = sqrt(dot3(vector, vector))
    return triple(component / length for component in vector)


def _open_model(scene: Scene, symbols: dict[str, Any]) -> Any:
    """Return the model of a scene with symbols for some of its numbers."""
    opened = build_unchecked(Scene, replace_values(plain(scene), symbols))
    geometry: Any = Geometry.of(scene)
    if any(name.startswith(GEOMETRY) for name in symbols):
        geometry = _TracedAxes.of(opened)
    return kernel.model_of(opened, geometry)


@lru_cache(maxsize=32)
def trace_derivatives(
    scene: Scene, names: tuple[str, ...], by_torque: bool
) -> Callable[..., list[float]]:
    """Return y', then its derivatives by y, by torques if needed, and by parameters."""
    state = Dynamics.of(scene).state
    varied = parameter_symbols(len(names))
    sizes = {"state": len(state), "torque": LEGS, "parameters": len(names)}

    def derivative(*inputs: Any) -> tuple[Any, ...]:
        of = divide(sizes, inputs)
        symbols = dict(zip(names, map(mark_present, of["parameters"]), strict=True))
        rebound = [symbols.pop(name) for name in names if name in REBOUND]
        if rebound:  # their numbers add up to the damping
            damping = mark_present(sum(rebound[1:], rebound[0]))
            symbols |= {"stroke.damping": damping, **dict.fromkeys(REBOUND)}
        model = _open_model(scene, symbols)
        return kernel.derivative(model, of["state"], of["torque"])

    by = (*state, *(TORQUE_SYMBOLS if by_torque else ()), *varied)
    program = trace(derivative, (*state, *TORQUE_SYMBOLS, *varied), by)
    return compile_functions({"derivatives": program}, ("derivatives",))["derivatives"]


@lru_cache(maxsize=32)
def _trace_joints(
    scene: Scene, names: tuple[str, ...]
) -> Callable[..., tuple[Any, ...]]:
    """Return gamma, gamma_dot and derivatives by quaternion, W and named numbers."""
    inputs = (*MOTION, *parameter_symbols(len(names)))

    def angles_and_rates(*values: Any) -> tuple[Any, ...]:
        motion, numbers = values[:STATE_SIZE], values[STATE_SIZE:]
        symbols = dict(zip(names, map(mark_present, numbers), strict=True))
        model = _open_model(scene, symbols) if names else Dynamics.of(scene).model
        joints = kernel.joints(model, motion)
        return (*joints.gamma, *joints.gamma_dot)

    return compile_for_arrays(trace(angles_and_rates, inputs, inputs))


def _numbers(torque: TorqueProfile) -> Array:
    """Return a profile's numbers that torques are differentiated by, shape (q,)."""
    if isinstance(torque, SineTorque):
        return np.array([*torque.amplitude, *torque.frequency, *torque.phase])
    if isinstance(torque, PolynomialTorque):
        return torque.c.ravel()
    if isinstance(torque, TorqueTable):
        return np.ravel(torque.torques)
    return np.ravel(torque.values(FIRST_TIME))


def _differentiate_torque(
    torque: TorqueProfile, begin: float, end: float
) -> Callable[[float], Array]:
    """Return derivatives of torques by `_numbers`, (3, q), between kinks [s]."""
    unit = np.eye(3)
    if isinstance(torque, SineTorque):
        amplitude = np.array(torque.amplitude)
        frequency = np.array(torque.frequency)
        phase = np.array(torque.phase)

        def sine(time: float) -> Array:
            angle = frequency * time + phase
            by_phase = unit * amplitude * np.cos(angle)
            return np.hstack([unit * np.sin(angle), by_phase * time, by_phase])

        return sine
    if isinstance(torque, TorqueTable):
        middle = 0.5 * (begin + end)
        row = np.searchsorted(torque.times, middle) - 1  # of the table, held until end
        selection = np.zeros((3, len(torque.times), 3))
        selection[:, row] = unit * (middle > torque.times[0])
        return lambda time: selection.reshape(3, -1)
    if isinstance(torque, PolynomialTorque):
        piece_index = int(np.searchsorted(torque.x, 0.5 * (begin + end))) - 1
        acting = np.multiply.outer(unit, np.arange(torque.c.shape[1]) == piece_index)

        def polynomial(time: float) -> Array:
            powers = (time - torque.x[piece_index]) ** np.arange(len(torque.c))[::-1]
            # By torque; power, piece and component of a coefficient.
            return np.asarray(np.einsum("p,tci->tpic", powers, acting)).reshape(3, -1)

        return polynomial
    return lambda time: unit


def differentiate_damping(scene: Scene) -> tuple[float, float]:
    """Differentiate the damping by restitution [s/rad] and impact rate [s^2/rad^2].

    The damping is d / v, and s = d (1 + e) = ln((1 + d) / (1 - d e)), see `damping_of`.
    So ds/de = d / (1 - e - e d), which is -3 where e = 1.
    """
    e, v = scene.stroke.restitution, scene.stroke.impact_rate
    assert e is not None and v is not None
    d = float(damping_of(scene.stroke) * v)
    change = d / (1.0 - e - e * d) if d else -3.0
    return (change - d) / ((1.0 + e) * v), -d / v**2


class Sensitivity(NamedTuple):
    """Derivatives of a motion at n instants by the k numbers of a parameter.

    Their units are those below over the unit of the parameter. Samples stay at their
    times, also where a limit ends the motion.

    Attributes:
        gamma: of the angles of the actuators [rad], shape (n, 3, k).
        gamma_dot: of their rates [rad/s], shape (n, 3, k).
        rotation: of the orientation, as rotation vectors in {E} [rad], shape (n, 3, k).
        body_rate: of the angular velocity of the star in {E} [rad/s], shape (n, 3, k).

    """

    gamma: Array
    gamma_dot: Array
    rotation: Array
    body_rate: Array


class Sensitivities:
    """Derivatives of a motion by parameters, each of which may be several numbers.

    A vector means each of its components, a list each of its entries, in their order,
    and "torque" the numbers of the profile: the three torques, `torques` of a
    `TorqueTable`, coefficients of a `PolynomialTorque`, or amplitudes, frequencies and
    phases of a `SineTorque`. InputError is raised where one is no such number, or the
    torques are a function of the state.
    """

    def __init__(
        self, scene: Scene, names: Iterable[str], torque: TorqueProfile
    ) -> None:
        keys: dict[str, list[str]] = {}
        for name in names:
            keys[name] = [] if name == OWN_TORQUE else list_numbers(scene, name)
        flat = list(dict.fromkeys(chain(*keys.values())))
        self._columns: dict[str, Any] = {}
        for name, own in keys.items():
            self._columns[name] = [flat.index(key) for key in own]
        by_torque = OWN_TORQUE in keys
        if by_torque:  # behind all numbers of the scene
            self._columns[OWN_TORQUE] = slice(len(flat), None)
        requirement = ""
        if torque.feedback or isinstance(torque, LostTorque):
            requirement = (
                "need torques that are known over time, not a function of the state"
            )
        elif by_torque and isinstance(torque, FunctionTorque):
            requirement = "torque needs three numbers or a profile, not a function"
        if requirement:
            raise refusal("simulate", "sensitivities", list(keys), requirement)
        self._equations = VariationalEquations(scene, flat, torque, by_torque=by_torque)
        self._values = np.array(
            [find_number(scene, name) for name in flat], dtype=float
        )

    def at(self, t: Array) -> dict[str, Sensitivity]:
        """Return sensitivities by parameter name at ascending times [s] >= 0, (n,)."""
        states, state_slopes = self._equations.run(self._values, t)
        motion = states[:, STAR].T
        slopes = state_slopes[:, STAR]
        q = tuple(motion[QUATERNION])
        turn = np.array([quaternion_rate(q, tuple(axis)) for axis in np.eye(3)])
        rates = np.einsum(
            "qcn,nqp->ncp", self._equations.differentiate_joints(motion), slopes
        )
        by_geometry = self._equations.differentiate_joints_by_geometry(motion)
        rates[..., : len(by_geometry)] += np.moveaxis(by_geometry, (0, 2), (2, 0))
        # quaternion_rate(q, .) has orthogonal columns of length abs(q) / 2.
        by_quaternion = slopes[:, QUATERNION]
        rotation = 4.0 * np.einsum("cqn,nqp->ncp", turn, by_quaternion)
        by_all_numbers = Sensitivity(
            gamma=rates[:, :LEGS],
            gamma_dot=rates[:, LEGS:],
            rotation=rotation,
            body_rate=slopes[:, STAR_RATE],
        )
        sensitivities = {}
        for name, columns in self._columns.items():
            arrays = [freeze(array[..., columns]) for array in by_all_numbers]
            sensitivities[name] = Sensitivity(*arrays)
        return sensitivities


def list_numbers(scene: Scene, name: str) -> list[str]:
    """Return the key of each number that a key names, or the key where it names none.

    A section means all of its numbers, as "star.inertia" its six.
    """
    try:
        fields = list(find_fields(scene, name, components=True))
    except ValueError:
        return [name]
    keys = []
    for place, value, _ in fields:
        if isinstance(value, Section):
            inner_places = list(leaves(value))
        else:
            inner_places = list(np.ndindex(np.shape(value)))
        keys += [key_of((*place, *inner_place)) for inner_place in inner_places]
    return keys
