# SPDX-License-Identifier: Apache-2.0
"""Linear models of the manipulator near a state: A and B for the design of controllers.

With the state y of the dynamics, D = dx/dy for the coordinates x, and R for which D R =
1,

    A = (d x_dot / dy) R,    B = d x_dot / d torque,

by derivatives of the traced program, exact to rounding. Under torques that are held for
dt, A is D S(dt) R and B is D S(dt), of the sensitivities S of the motion itself, S' =
(df/dy) S + df/du (Hairer, Norsett and Wanner, Solving Ordinary Differential Equations
I, section I.14).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from sst_ros.control.controller import InverseDynamics
from sst_ros.dynamics.initial_state import start_of
from sst_ros.dynamics.model import GRAZING, limits_of
from sst_ros.dynamics.traced_dynamics import LEGS, Dynamics, recent_ode
from sst_ros.dynamics.variational import trace_derivatives
from sst_ros.errors import SingularConfiguration, check_kinds, refuse_unless, require
from sst_ros.integration.held_flow import HeldFlow, follow_held_torque, states_inside
from sst_ros.mechanism.generic_math import quaternion_rate, triple
from sst_ros.mechanism.geometry import Geometry
from sst_ros.scene.scene import Scene, SceneInput, scene_of, with_initial
from sst_ros.state import (
    QUATERNION,
    STAR,
    STAR_RATE,
    ZERO,
    Array,
    Explained,
    ReadOnly,
    State,
    Vector3,
    finite_vector,
)

COORDINATES = {
    "gamma": [f"{name}_{leg}" for name in ("gamma", "gamma_dot") for leg in (1, 2, 3)],
    "star": [f"{name}_{axis}" for name in ("rotation", "body_rate") for axis in "xyz"],
}
# Evaluations of the dynamics for a period, at most: in a singularity there is no end.
_MOST_PERIOD_EVALUATIONS = 20_000
_CHECKS = 8  # parts of a period, after each of which limits are checked
# A state this near to one of rest [rad], by the largest entry of A, counts as one.
_REST = 1e-9
_ROTATION_VECTOR = slice(0, 3)  # place in the coordinates of the star


@dataclass(frozen=True, repr=False)
class LinearModel(Explained, ReadOnly):
    """Deviations x of a motion by deviations u of its torques: x' = A x + B u.

    With `dt` they are those from one period to the next: x[k + 1] = A x[k] + B u[k].

    Attributes:
        A: shape (n, n), n = 6, or 9 where the actuators lag.
        B: shape (n, 3).
        states: names of the coordinates x, n of them.
        dt: period for which the torques are held [s], or None.
        at_equilibrium: whether the motion is a state of rest under the torques. Only
            there the eigenvalues of A do not depend on the coordinates.

    """

    A: Array
    B: Array
    states: tuple[str, ...]
    dt: float | None
    at_equilibrium: bool = False  # whether the motion is a state of rest

    def __post_init__(self) -> None:
        self._freeze()

    def _facts(self) -> dict[str, object]:
        facts: dict[str, object] = {
            "x": self.states,
            "A": " x ".join(map(str, self.A.shape)),
            "B": " x ".join(map(str, self.B.shape)),
            "dt [s]": self.dt or "none: x' = A x + B u",
        }
        if self.at_equilibrium:  # elsewhere it depends on the coordinates
            largest = np.abs(np.linalg.eigvals(self.A)).max()
            facts["largest abs(eigenvalue of A)"] = float(largest)
        return facts

    def to_control(self) -> Any:
        """Return a `control.StateSpace` with the outputs x.

        Needs the package control.
        """
        x = list(self.states)
        return require("control").StateSpace(
            self.A,
            self.B,
            np.eye(len(x)),
            np.zeros_like(self.B),
            self.dt or 0,
            states=x,
            outputs=x,
            inputs=["command_1", "command_2", "command_3"],
        )


def equilibrium(scene: SceneInput, gamma: Any) -> State:
    """Return the state at rest at gamma [rad].

    Its `torque` holds the manipulator there.

    Raises:
        InputError: gamma is not three angles in the stroke.
        AssemblyError: gamma has no unique admissible assembly.
        SingularConfiguration: no torques control the star there.

    """
    scene_at_rest = with_initial(scene_of(scene), (gamma, ZERO))
    y = start_of(scene_at_rest)
    torque = InverseDynamics(scene_at_rest).gravity_torque(y[QUATERNION])
    return State.of(0, y, Dynamics.of(scene_at_rest).joints(*y), torque)


@check_kinds
def linearize(
    scene: SceneInput,
    state: Any,
    torque: Any,
    *,
    dt: float | None = None,
    coordinates: str = "gamma",
) -> LinearModel:
    """Linearize the dynamics of a scene near a state and its torques.

    All terms of the scene are included.

    Args:
        scene: name or path of a scene, its document as a dict, or a `Scene`.
        state: a `State`, as of `equilibrium` or `Simulation`; or an initial state as
            `simulate` takes it, None for that of the scene. Where the actuators lag, a
            `State` has the torques that they give; otherwise they give those commanded.
        torque: torques that are commanded [N m], shape (3,).
        dt: period for which they are held [s]. By default the model is continuous.
        coordinates: "gamma" for deviations of gamma [rad] and gamma_dot [rad/s]; "star"
            for the rotation vector from the motion's {E} to the deviating one, in {E}
            [rad], and the deviation of the body rate [rad/s], also in a parallel
            singularity. The torques that lagging actuators give [N m] follow.

    Raises:
        InputError: an argument is not allowed, or no motion lasts for `dt`.
        AssemblyError: gamma has no unique admissible assembly.
        SingularConfiguration: a serial singularity; with "gamma" a parallel one, too.

    """
    scene = scene_of(scene)
    acting = _read_arguments(scene, torque, dt, coordinates)
    start = _start_of(scene, state, acting)
    by_gamma = coordinates == "gamma"
    if by_gamma:
        x, y, z, w = start[QUATERNION].tolist()
        body_rate = triple(start[STAR_RATE].tolist())
        # It refuses singularities.
        InverseDynamics(scene).torque((x, y, z, w), body_rate, ZERO)
    dynamics = Dynamics.of(scene)
    by_star = None if by_gamma else trace_derivatives(scene, (), by_torque=True)
    try:
        begin = _differentiate(dynamics, by_star, start, acting)
    except (ArithmeticError, ValueError):
        raise SingularConfiguration("serial singularity, sin(mu)", 0.0) from None
    a = begin.A
    b = begin.B
    at_equilibrium = np.abs(begin.slope).max() <= _REST * np.abs(a).max()
    if dt is not None:
        dt = float(dt)
        flow = _hold(scene, dynamics, start, acting, dt)
        to_x = _coordinates_by_state(dynamics, flow.states[-1], acting, by_gamma)
        a = to_x @ flow.by_start @ begin.y_by_x
        b = to_x @ flow.by_torque
    states = COORDINATES[coordinates].copy()
    if scene.lags:
        states += ["torque_1", "torque_2", "torque_3"]
    return LinearModel(a, b, tuple(states), dt, bool(at_equilibrium))


def _read_arguments(scene: Scene, torque: Any, dt: Any, coordinates: Any) -> Vector3:
    """Return the torques of `linearize`; refuse arguments that are not allowed."""
    acting = finite_vector(torque)
    limit = scene.torque_limit
    largest = max(map(abs, acting or ZERO))
    beyond = (
        f"must be at most {limit} N m, the torque limit: beyond it torques have no"
        " effect"
    )
    is_positive = isinstance(dt, (int, float)) and dt is not True and 0 < dt < math.inf
    is_defined = isinstance(coordinates, str) and coordinates in COORDINATES
    refuse_unless(
        "linearize",
        ("torque", torque, acting is not None, "must be three finite torques [N m]"),
        ("torque", torque, limit is None or largest <= limit, beyond),
        ("dt", dt, dt is None or is_positive, "must be a number > 0 [s]"),
        ("coordinates", coordinates, is_defined, "must be gamma or star"),
    )
    assert acting is not None
    return acting


def _start_of(scene: Scene, state: Any, commanded: Vector3) -> Array:
    """Return the state of the dynamics that `linearize` is given.

    Where the actuators lag, the state has the torques that they give.
    """
    if isinstance(state, State):
        motion = [*state.quaternion, *state.body_rate]
        lagged = state.torque
    else:
        motion = [*start_of(with_initial(scene, state))[STAR]]
        lagged = commanded
    return np.array([*motion, *lagged] if scene.lags else motion)


def _hold(
    scene: Scene, dynamics: Dynamics, start: Array, torque: Vector3, dt: float
) -> HeldFlow:
    """Follow a motion under held torques for dt [s].

    Raises InputError where it does not last, or meets a limit.
    """
    with np.errstate(all="ignore"):  # of steps that are too long
        flow = follow_held_torque(
            recent_ode(dynamics),
            start.tolist(),
            torque,
            dt,
            _MOST_PERIOD_EVALUATIONS,
            elastic=scene.stroke.at_end == "elastic",
        )
    requirement = (
        "must be a period for which the motion lasts: it meets a singularity or is"
        " too long"
    )
    if flow is not None:
        requirement = _find_limit(scene, dynamics, flow, torque, dt)
    refuse_unless("linearize", ("dt", dt, not requirement, requirement))
    assert flow is not None
    return flow


def _find_limit(
    scene: Scene, dynamics: Dynamics, flow: HeldFlow, torque: Vector3, length: float
) -> str:
    """Say which limit a motion passes that it began inside of, "" if none."""
    inside = np.arange(1.0, _CHECKS) * (length / _CHECKS)
    states = [
        flow.states[0],
        *states_inside(recent_ode(dynamics), flow, torque, inside),
        flow.states[-1],
    ]
    joints = [dynamics.joints(*y[STAR].tolist()) for y in states]
    for limit in limits_of(scene, Geometry.of(scene)):
        distances = np.array([limit.distance(numbers) for numbers in joints])
        if distances[0] >= -GRAZING and distances.min() < -GRAZING:
            return f"must end before a limit: {limit.reason}"
    return ""


class _Derivatives(NamedTuple):
    """Derivatives at a state y, of n + 1 numbers, and the continuous model there."""

    x_by_y: Array  # of the coordinates, shape (n, n + 1)
    y_by_x: Array  # of the state's own changes, shape (n + 1, n)
    A: Array  # shape (n, n)
    B: Array  # shape (n, 3)
    slope: Array  # by time, of x, or of y where x are deviations


def _differentiate(
    dynamics: Dynamics,
    by_star: Callable[..., Sequence[float]] | None,
    y: Array,
    torque: Sequence[float],
) -> _Derivatives:
    """Differentiate the dynamics at a state.

    `by_star` gives the slope of y and its derivatives for coordinates of the star; None
    stands for those of gamma.
    """
    size = len(y)
    from_star, to_star = _turns(y)
    # Rows of values, then of their derivatives by each number of y and each torque.
    if by_star is None:
        numbers = dynamics.actuator_motion(*y.tolist(), *_drive(dynamics, torque))
        rows = np.array(numbers).reshape(1 + size + LEGS, -1)
        _, slope = np.split(rows[0], 2)
        x, x_dot = np.split(rows[1:].T, 2)
        x_by_y, _ = np.split(x, [size], axis=1)
        slope_by_y, slope_by_torque = np.split(x_dot, [size], axis=1)
        from_gamma = from_star @ np.linalg.inv(x_by_y @ from_star)
        a = slope_by_y @ from_gamma
        return _Derivatives(x_by_y, from_gamma, a, slope_by_torque, slope)
    rows = np.array(by_star(*y.tolist(), *torque)).reshape(1 + size + LEGS, size)
    if not np.isfinite(rows).all():
        raise ArithmeticError("the derivatives are not finite")
    slopes = to_star @ rows[1:].T
    slope_by_y, slope_by_torque = np.split(slopes, [size], axis=1)
    a = slope_by_y @ from_star
    # In the turning frame d' = dW - W x d.
    a[_ROTATION_VECTOR, _ROTATION_VECTOR] = np.cross(y[STAR_RATE], np.eye(3))
    return _Derivatives(to_star, from_star, a, slope_by_torque, rows[0])


def _coordinates_by_state(
    dynamics: Dynamics, y: Array, torque: Sequence[float], by_gamma: bool
) -> Array:
    """Return the derivatives of the coordinates by a state, shape (n, n + 1)."""
    if not by_gamma:
        return _turns(y)[1]
    columns = dynamics.coordinates_by_state(*y.tolist(), *_drive(dynamics, torque))
    return np.asarray(np.array(columns).reshape(len(y), -1).T)


def _drive(dynamics: Dynamics, torque: Sequence[float]) -> tuple[float, ...]:
    """Return what acts from outside: torques, and no moment from a topic."""
    return (*torque, *(0.0 for _ in dynamics.drive[LEGS:]))


def _turns(y: Array) -> tuple[Array, Array]:
    """Return the derivatives of a state by deviations of the star, and their inverse.

    The first have the shape (n + 1, n), those of the deviations by the state (n, n +
    1).
    """
    size = len(y)
    q = y[QUATERNION]
    by_axis = [quaternion_rate(tuple(q), tuple(axis)) for axis in np.eye(3)]
    turn = np.array(by_axis).T
    # A quaternion has one number more than the rotation; all else is the same.
    from_star = np.eye(size, size - 1, -1)
    from_star[QUATERNION, _ROTATION_VECTOR] = turn
    to_star = np.eye(size - 1, size, 1)
    to_star[_ROTATION_VECTOR, QUATERNION] = 4.0 * turn.T / (q @ q)
    return from_star, to_star
