# SPDX-License-Identifier: Apache-2.0
"""A run of one scene: the state, a step under given torques, and the end of what is valid."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple, TypeAlias

import numpy as np
from scipy.optimize import brentq

from sst_ros.errors import Diverged, InputError, Problem, RunStopped, StrokeExceeded, WorkspaceLeft
from sst_ros.integration.explicit import ExplicitMethod
from sst_ros.integration.tableaux import DORMAND_PRINCE, Tableau
from sst_ros.mechanism import kernel, kinematics, virtual_work
from sst_ros.mechanism.frames import quaternion_of
from sst_ros.mechanism.geometry import Geometry
from sst_ros.scene import Scene

NANOSECONDS = 1_000_000_000
Triple = tuple[float, float, float]
Torque: TypeAlias = Triple | Callable[[float], Triple]


@dataclass(frozen=True)
class State:
    """The manipulator at one instant.

    Attributes:
        time_ns: simulated time since the start [ns].
        quaternion: orientation of {E} in {B}, (x, y, z, w).
        body_rate: angular velocity of the star in {E} [rad/s].
        joints: angles and rates of all nine joints.
        torque: actuator torques at this instant [N m]; before the first step zero.

    """

    time_ns: int
    quaternion: tuple[float, float, float, float]
    body_rate: Triple
    joints: kernel.Joints
    torque: Triple


class Limit(NamedTuple):
    """An end of what is valid: sign * (joint angle of leg - end) must not be negative."""

    reason: str
    error: type[RunStopped]
    joint: str
    leg: int
    sign: float
    end: float

    def margin(self, joints: kernel.Joints) -> float:
        """Distance to the end [rad], negative beyond it."""
        angle: float = getattr(joints, self.joint)[self.leg]
        return self.sign * (angle - self.end)


class Simulation:
    """Direct dynamics of a scene from its initial state.

    Raises:
        AssemblyError: the initial gamma has no unique admissible assembly.
        InputError: the initial gamma lies outside the stroke.

    """

    def __init__(self, scene: Scene, tableau: Tableau = DORMAND_PRINCE) -> None:
        self.scene = scene
        self.geometry = Geometry.of(scene)
        self.model = kernel.model_of(scene)
        self._method = ExplicitMethod(tableau)
        self.method = tableau.name
        self._limits = tuple(_limits_of(scene, self.geometry))
        self._state = self._initial()
        self.error_estimate = 0.0

    @property
    def state(self) -> State:
        """The last valid state."""
        return self._state

    def step(self, torque: Torque, dt_ns: int) -> State:
        """Advance by dt_ns [ns] under torques [N m], held constant or as a function of t [s].

        Local error estimates add up in `error_estimate`, in units of (q, W).

        Raises:
            StrokeExceeded, WorkspaceLeft: the motion ends inside this step; when, the error says.
            Diverged: the result is not finite. In all three cases the state stays as it was.

        """
        start, before = self._state.time_ns / NANOSECONDS, self._state
        y: tuple[float, ...] = (*before.quaternion, *before.body_rate)
        force = torque if callable(torque) else None
        constant = (0.0, 0.0, 0.0) if callable(torque) else torque

        def rates(t: float, y: tuple[float, ...]) -> Sequence[float]:
            return kernel.derivative(self.model, y, force(t) if force else constant)

        def after(h: float) -> tuple[State, float]:
            moved, error = self._method.step(rates, start, y, h)
            end = start + h
            time_ns = before.time_ns + round(h * NANOSECONDS)
            return self._state_at(time_ns, moved, force(end) if force else constant), error

        h = dt_ns / NANOSECONDS
        try:
            state, error = after(h)
        except (ArithmeticError, ValueError):
            raise Diverged("the step is not finite", start, before) from None
        passed = [limit for limit in self._limits if limit.margin(state.joints) < 0.0]
        if passed:

            def crossing(limit: Limit) -> float:
                return _root(lambda x: limit.margin(after(x)[0].joints), h)

            time, limit = min(((crossing(limit), limit) for limit in passed), key=lambda at: at[0])
            raise limit.error(limit.reason, start + time, before)
        self._state = state
        self.error_estimate += error
        return state

    def _state_at(self, time_ns: int, y: Sequence[float], torque: Triple) -> State:
        length = math.hypot(*y[:4])
        if not all(map(math.isfinite, y)) or length == 0.0:
            raise ArithmeticError
        qx, qy, qz, qw = (part / length for part in y[:4])
        wx, wy, wz = y[4:]
        joints = kernel.joints(self.model, (qx, qy, qz, qw, wx, wy, wz))
        return State(time_ns, (qx, qy, qz, qw), (wx, wy, wz), joints, torque)

    def _initial(self) -> State:
        initial = self.scene.initial
        gamma = np.array(initial.gamma)
        if self.scene.stroke.at_end == "stop" and np.any((gamma < 0) | (gamma > self.geometry.arc)):
            ends = ", ".join(f"{arc:.6f}" for arc in self.geometry.arc)
            allowed = f"must lie in the stroke, 0 to ({ends}) rad"
            raise InputError(self.scene.name, [Problem("initial.gamma", initial.gamma, allowed)])
        assembly = kinematics.admissible(self.geometry, gamma)
        posture = virtual_work.posture(self.geometry, gamma, assembly.rotation)
        body_rate = assembly.rotation.T @ posture.j @ np.array(initial.gamma_dot)
        y = [*quaternion_of(assembly.rotation).tolist(), *body_rate.tolist()]
        return self._state_at(0, y, (0.0, 0.0, 0.0))


def _limits_of(scene: Scene, geometry: Geometry) -> Iterator[Limit]:
    """Yield the ends that the scene does not ignore."""
    for k in range(3):
        if scene.stroke.at_end == "stop":
            arc, name = float(geometry.arc[k]), f"gamma_{k + 1}"
            yield Limit(f"{name} < 0", StrokeExceeded, "gamma", k, 1.0, 0.0)
            yield Limit(f"{name} > {arc:.6f} rad", StrokeExceeded, "gamma", k, -1.0, arc)
        if scene.workspace.at_edge == "stop":
            most, name = geometry.beta_max, f"beta_{k + 1}"
            yield Limit(f"{name} < 0", WorkspaceLeft, "beta", k, 1.0, 0.0)
            yield Limit(f"{name} > {most:.6f} rad", WorkspaceLeft, "beta", k, -1.0, most)


def _root(margin: Callable[[float], float], h: float) -> float:
    """Time in [0, h] at which a margin that ends negative goes through zero [s]."""
    if margin(0.0) <= 0.0:
        return 0.0
    return float(brentq(margin, 0.0, h, xtol=1e-15))
