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
    ZERO,
    Array,
    Explained,
    ReadOnly,
    State,
    Vector3,
    finite_vector,
)

COORDINATES = {
    "gamma": [f"{name}_{k}" for name in ("gamma", "gamma_dot") for k in (1, 2, 3)],
    "star": [f"{name}_{axis}" for name in ("rotation", "body_rate") for axis in "xyz"],
}
_MOST_PERIOD_EVALUATIONS, _CHECKS = 20_000, 8
"""Evaluations for a period: without end in a singularity.

Parts after which limits are checked.
"""


_REST = 1e-9
"""A state this near to one of rest [rad], by the largest entry of A, counts as one."""


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
        commands = [f"command_{k}" for k in (1, 2, 3)]
        system = self.A, self.B, np.eye(len(x)), np.zeros_like(self.B), self.dt or 0
        return require("control").StateSpace(
            *system, states=x, outputs=x, inputs=commands
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
    torque = InverseDynamics(scene_at_rest).gravity_torque(y[:4])
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
    acting = finite_vector(torque)
    limit = scene.torque_limit
    largest = max(map(abs, acting or ZERO))
    beyond = (
        f"must be at most {limit} N m, the torque limit: beyond it torques have no"
        " effect"
    )
    positive = isinstance(dt, (int, float)) and dt is not True and 0.0 < dt < math.inf
    is_defined = isinstance(coordinates, str) and coordinates in COORDINATES
    refuse_unless(
        "linearize",
        ("torque", torque, acting is not None, "must be three finite torques [N m]"),
        ("torque", torque, limit is None or largest <= limit, beyond),
        ("dt", dt, dt is None or positive, "must be a number > 0 [s]"),
        ("coordinates", coordinates, is_defined, "must be gamma or star"),
    )
    assert acting is not None
    if isinstance(state, State):
        quaternion = state.quaternion
        rate = state.body_rate
        lagged = state.torque
    else:
        x, y, z, w, *body_rate = start_of(with_initial(scene, state))
        quaternion = (x, y, z, w)
        rate = triple(body_rate)
        lagged = acting
    by_gamma = coordinates == "gamma"
    if by_gamma:
        InverseDynamics(scene).torque(quaternion, rate, ZERO)  # refuses singularities
    dynamics = Dynamics.of(scene)
    by_star = None if by_gamma else trace_derivatives(scene, (), by_torque=True)
    start_state = np.array((*quaternion, *rate, *(lagged if scene.lags else ())))
    try:
        begin = _differentiate(dynamics, by_star, start_state, acting)
    except (ArithmeticError, ValueError):
        raise SingularConfiguration("serial singularity, sin(mu)", 0.0) from None
    a, b = begin.A, begin.B
    at_equilibrium = np.abs(begin.slope).max() <= _REST * np.abs(a).max()
    if dt is not None:
        dt = float(dt)
        with np.errstate(all="ignore"):  # of steps that are too long
            flow = follow_held_torque(
                recent_ode(dynamics),
                start_state.tolist(),
                acting,
                dt,
                _MOST_PERIOD_EVALUATIONS,
                elastic=scene.stroke.at_end == "elastic",
            )
        lasts = (
            "must be a period for which the motion lasts: it meets a singularity or is"
            " too long"
        )
        if flow is not None:
            lasts = _find_limit(scene, dynamics, flow, acting, dt)
        refuse_unless("linearize", ("dt", dt, not lasts, lasts))
        assert flow is not None
        to_x = _coordinates_by_state(dynamics, flow.states[-1], acting, by_gamma)
        a = to_x @ flow.by_start @ begin.y_by_x
        b = to_x @ flow.by_torque
    lag = [f"torque_{k}" for k in (1, 2, 3)] if scene.lags else []
    states = (*COORDINATES[coordinates], *lag)
    return LinearModel(a, b, states, dt, bool(at_equilibrium))


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
    angles = np.array([dynamics.joints(*y[:7].tolist()) for y in states])
    limits = list(limits_of(scene, Geometry.of(scene)))
    ends = np.array([limit.end for limit in limits])
    signs = np.array([limit.sign for limit in limits])
    distances = signs * (angles[:, [limit.joint for limit in limits]] - ends)
    passed = (distances[0] >= -GRAZING) & (distances.min(axis=0) < -GRAZING)
    if not passed.any():
        return ""
    return f"must end before a limit: {limits[int(passed.argmax())].reason}"


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
    if by_star is None:
        table = np.array(
            dynamics.actuator_motion(*y.tolist(), *_drive(dynamics, torque))
        )
        values_and_slopes = table.reshape(size + 4, -1)
        x, x_dot = np.split(values_and_slopes[1:].T, 2)
        slope = np.split(values_and_slopes[0], 2)[1]
        from_gamma = from_star @ np.linalg.inv(x[:, :size] @ from_star)
        a = x_dot[:, :size] @ from_gamma
        return _Derivatives(x[:, :size], from_gamma, a, x_dot[:, size:], slope)
    rows = np.array(by_star(*y.tolist(), *torque)).reshape(size + 4, size)
    if not np.isfinite(rows).all():
        raise ArithmeticError("the derivatives are not finite")
    slopes = to_star @ rows[1:].T
    a = slopes[:, :size] @ from_star
    a[:3, :3] = np.cross(y[4:7], np.eye(3))  # in the turning frame d' = dW - W x d
    return _Derivatives(to_star, from_star, a, slopes[:, size:], rows[0])


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
    """Return derivatives of a state by deviations of the star, and those of the latter.

    Shapes (n + 1, n) and (n, n + 1).
    """
    size = len(y)
    q = y[:4]
    by_axis = [quaternion_rate(tuple(q), tuple(axis)) for axis in np.eye(3)]
    turn = np.array(by_axis).T
    from_star, to_star = np.eye(size, size - 1, -1), np.eye(size - 1, size, 1)
    from_star[:4, :3], to_star[:3, :4] = turn, 4.0 * turn.T / (q @ q)
    return from_star, to_star
