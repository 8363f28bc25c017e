# SPDX-License-Identifier: Apache-2.0
"""A run of one scene: the state, a step under given torques, and the end of what is valid."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple, TypeAlias

import numpy as np

from sst_ros.errors import Diverged, ImpactsAccumulate, InputError, Problem, RunStopped
from sst_ros.integration.events import first_crossing
from sst_ros.integration.explicit import ExplicitMethod
from sst_ros.integration.tableaux import DORMAND_PRINCE, Tableau
from sst_ros.limits import Limit, limits_of
from sst_ros.mechanism import kinematics, virtual_work
from sst_ros.mechanism.compiled import Dynamics
from sst_ros.mechanism.contacts import RigidEnds
from sst_ros.mechanism.frames import quaternion_of
from sst_ros.mechanism.geometry import Geometry
from sst_ros.mechanism.kernel import Joints
from sst_ros.scene import Scene

NANOSECONDS = 1_000_000_000
Triple = tuple[float, float, float]
Vector = tuple[float, ...]
Torque: TypeAlias = Triple | Callable[[float], Triple]

_IMPACTS_PER_STEP = 1000
_RESTING_RATE = 1e-9


@dataclass(frozen=True)
class State:
    """The manipulator at one instant.

    Attributes:
        time_ns: simulated time since the start [ns].
        quaternion: orientation of {E} in {B}, (x, y, z, w).
        body_rate: angular velocity of the star in {E} [rad/s].
        joints: angles and rates of all nine joints.
        torque: torques that the actuators give at this instant [N m]; zero before the first step.

    """

    time_ns: int
    quaternion: tuple[float, float, float, float]
    body_rate: Triple
    joints: Joints
    torque: Triple


class _Point(NamedTuple):
    """A point inside a step: time since it began, state, joints (angles, rates), local error."""

    x: float
    y: Vector
    joints: Vector
    error: float


class Simulation:
    """Direct dynamics of a scene from its initial state.

    Attributes:
        scene: what is simulated.
        geometry: its constant vectors.
        dynamics: its traced functions.
        method: name of the integrator.
        error_estimate: sum of the local error estimates so far, in units of (q, W).

    Raises:
        AssemblyError: the initial gamma has no unique admissible assembly.
        InputError: the initial gamma lies outside the stroke.

    """

    def __init__(self, scene: Scene, tableau: Tableau = DORMAND_PRINCE) -> None:
        self.scene = scene
        self.geometry = Geometry.of(scene)
        self.dynamics = Dynamics(scene)
        self.method = tableau.name
        self.error_estimate = 0.0
        self._method = ExplicitMethod(tableau)
        self._limits = tuple(limits_of(scene, self.geometry))
        self._ends = RigidEnds(self.dynamics)
        self._resting: tuple[Limit, ...] = ()
        self._y, self._state = self._initial()

    @property
    def state(self) -> State:
        """The last valid state."""
        return self._state

    def step(self, torque: Torque, dt_ns: int, moment: Triple = (0.0, 0.0, 0.0)) -> State:
        """Advance by dt_ns [ns].

        Args:
            torque: commanded torques [N m], held constant or as a function of t [s].
            dt_ns: length of the step [ns].
            moment: external moment on the star in {B} [N m], used where the scene takes it from
                a topic.

        Raises:
            StrokeExceeded, WorkspaceLeft: the motion ends inside this step; when, the error says.
            ImpactsAccumulate: impacts follow each other without end.
            Diverged: the result is not finite. In all cases the state stays as it was.

        """
        start, h = self._state.time_ns / NANOSECONDS, dt_ns / NANOSECONDS
        drive = self._drive(torque, moment)
        resting = self._resting
        try:
            with np.errstate(all="ignore"):
                at = self._through_impacts(h, start, drive)
        except (ArithmeticError, ValueError):
            self._resting = resting
            raise Diverged("the step is not finite", start, self._state) from None
        except RunStopped:
            self._resting = resting
            raise
        self._y = at.y
        self._state = self._as_state(self._state.time_ns + dt_ns, at, drive(start + h))
        self.error_estimate += at.error
        return self._state

    def _through_impacts(self, h: float, start: float, drive: Callable[[float], Vector]) -> _Point:
        """Go on to h; impacts on the way are part of it, the other limits are its end."""
        at = self._point(0.0, self._y, 0.0)
        reason = ""
        for _ in range(_IMPACTS_PER_STEP):
            at, hit = self._advance(at, h, start, drive)
            if hit is None:
                return at
            if hit.error is not None:
                raise hit.error(hit.reason, start + at.x, self._state)
            at, reason = self._strike(at, hit), hit.reason
        raise ImpactsAccumulate(reason, start + at.x, self._state)

    def _advance(
        self, at: _Point, h: float, start: float, drive: Callable[[float], Vector]
    ) -> tuple[_Point, Limit | None]:
        """Go on to h, or to the first limit that is met before."""

        def rates(t: float, y: Vector) -> Sequence[float]:
            slope = self.dynamics.derivative(*y, *drive(t))
            legs = [limit.leg for limit in self._resting]
            return self._ends.held(y, slope, legs)[0] if legs else slope

        def after(x: float) -> _Point:
            y, error = self._method.step(rates, start + at.x, at.y, x)
            return self._point(at.x + x, y, at.error + error)

        left = h - at.x
        end = after(left)
        first: tuple[float, Limit] | None = None
        for limit in self._limits:
            if not limit.may_be_crossed(at.joints, end.joints) or limit in self._resting:
                continue
            x = first_crossing(
                lambda x: limit.margin(after(x).joints),  # noqa: B023
                lambda x: limit.slope(after(x).joints),  # noqa: B023
                left,
            )
            if x is not None and (first is None or x < first[0]):
                first = (x, limit)
        if first is not None:
            return after(first[0]), first[1]
        self._release(end, drive(start + h))
        return end, None

    def _strike(self, at: _Point, limit: Limit) -> _Point:
        """Bounce off a limit, or come to rest where the bounce is not worth the name."""
        restitution = self.scene.stroke.restitution or 0.0
        if abs(limit.slope(at.joints)) * restitution < _RESTING_RATE:
            restitution = 0.0
            self._resting = (*self._resting, limit)
        y = self._ends.after_impact(at.y, limit.leg, restitution)
        return self._point(at.x, y, at.error)

    def _release(self, at: _Point, drive: Vector) -> None:
        """Let go of ends that would have to pull."""
        if self._resting:
            legs = [limit.leg for limit in self._resting]
            slope = self.dynamics.derivative(*at.y, *drive)
            torques = self._ends.held(at.y, slope, legs)[1]
            pushing = zip(self._resting, torques, strict=True)
            self._resting = tuple(limit for limit, torque in pushing if limit.sign * torque > 0.0)

    def _drive(self, torque: Torque, moment: Triple) -> Callable[[float], Vector]:
        """Give what acts from outside as a function of time; torques within their limit."""
        limit = self.scene.actuators.torque_limit if self.scene.actuators else None
        more = moment if self.dynamics.moved else ()

        def limited(torques: Triple) -> Vector:
            if limit is None:
                return (*torques, *more)
            clamped = [min(max(tau, -limit), limit) for tau in torques]
            return (*clamped, *more)

        if callable(torque):
            return lambda t: limited(torque(t))
        constant = limited(torque)
        return lambda t: constant

    def _point(self, x: float, y: Vector, error: float) -> _Point:
        length = math.hypot(*y[:4])
        if not all(map(math.isfinite, y)) or length == 0.0:
            raise ArithmeticError
        unit = (*(part / length for part in y[:4]), *y[4:])
        return _Point(x, unit, self.dynamics.joints(*unit[:7]), error)

    def _as_state(self, time_ns: int, at: _Point, drive: Vector) -> State:
        qx, qy, qz, qw, wx, wy, wz, *lagged = at.y
        t1, t2, t3 = lagged or drive[:3]
        joints = Joints(*zip(at.joints[::3], at.joints[1::3], at.joints[2::3], strict=True))
        return State(time_ns, (qx, qy, qz, qw), (wx, wy, wz), joints, (t1, t2, t3))

    def _initial(self) -> tuple[Vector, State]:
        initial = self.scene.initial
        gamma = np.array(initial.gamma)
        outside = np.any((gamma < 0) | (gamma > self.geometry.arc))
        if self.scene.stroke.at_end in ("stop", "impact") and outside:
            ends = ", ".join(f"{arc:.6f}" for arc in self.geometry.arc)
            allowed = f"must lie in the stroke, 0 to ({ends}) rad"
            raise InputError(self.scene.name, [Problem("initial.gamma", initial.gamma, allowed)])
        assembly = kinematics.admissible(self.geometry, gamma)
        posture = virtual_work.posture(self.geometry, gamma, assembly.rotation)
        rate = assembly.rotation.T @ posture.j @ np.array(initial.gamma_dot)
        lagged = [0.0] * (len(self.dynamics.state) - 7)
        y = (*quaternion_of(assembly.rotation).tolist(), *rate.tolist(), *lagged)
        at = self._point(0.0, y, 0.0)
        return at.y, self._as_state(0, at, (0.0, 0.0, 0.0))
