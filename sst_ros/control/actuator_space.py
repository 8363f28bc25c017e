# SPDX-License-Identifier: Apache-2.0
"""Desired motions, and the map between the star and the actuators, to rounding.

One equation serves both directions: gamma_dot_k = g_k.W and its derivative gamma_ddot_k
= g_k.W_dot + (acceleration at W_dot = 0), which is Eq. 40 solved for gamma_ddot. The
orientation at given actuator angles comes from Newton's method, started so close that
it stays in the assembly mode; `ActuatorSpaceMap.follow` sees to that from one set of
angles to the next, however far apart.
"""

from __future__ import annotations

import contextlib
import math
import operator
from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from functools import lru_cache, partial
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from sst_ros.dynamics import kernel
from sst_ros.errors import (
    SingularConfiguration,
    check_kinds,
    check_kinds_late,
    refuse_unless,
)
from sst_ros.mechanism import continuation
from sst_ros.mechanism import generic_math as gm
from sst_ros.mechanism.generic_math import axpy, cross3, dot3, multiply
from sst_ros.mechanism.geometry import Array, Geometry, quaternion_of, rotation_matrix
from sst_ros.programs.expression import compile_program, trace
from sst_ros.state import ZERO, Explained, Quaternion, Vector3, find_lost_meaning

# residual abs(r_k . t_k) at which Newton's method ends: rounding
ANGLE_ROUNDING = 4e-16
# largest loop-closure residual abs(r_k . t_k) of an orientation that is returned
CLOSED = 1e-14
_INVERSION_STEPS = 20
_STAR_MOTION = (*"xyzw", "wx", "wy", "wz", "ax", "ay", "az")
_MOVING = (*_STAR_MOTION[:4], "d1", "d2", "d3", "dd1", "dd2", "dd3")
_POSE_NUMBERS = (
    *_STAR_MOTION[:4],
    *(f"r{k}{axis}" for k in range(3) for axis in "xyz"),
)


@dataclass(frozen=True)
class Reference:
    """Desired state and acceleration at one instant.

    All parts describe the same motion.
    """

    quaternion: Quaternion  # of {E} in {B}, (x, y, z, w), of length 1 up to rounding
    body_rate: Vector3  # W in {E} [rad/s]
    body_acceleration: Vector3  # W_dot in {E} [rad/s^2]
    gamma: Vector3  # of the actuators [rad]
    gamma_dot: Vector3  # [rad/s]
    gamma_ddot: Vector3  # [rad/s^2]


REFERENCE_SIZES = {
    quantity.name: 4 if quantity.name == "quaternion" else 3
    for quantity in fields(Reference)
}
"""Numbers of each part of a `Reference`, as inputs of a traced control law."""


class ReferenceMotion(Explained):
    """A desired motion; it rests before time 0 and after `duration` [s].

    It is made of a function that gives the reference at a time from 0 to `duration`, in
    which an ArithmeticError is a serial singularity, and of `pieces`, rising times from
    0 to `duration`: from one to the next the motion is so smooth that some ten samples
    resolve it. An `effort` is a function that gives torques at such a time, which a
    controller adds to its own [N m].
    """

    @check_kinds
    def __init__(
        self,
        inside: Callable[[float], Reference],
        pieces: tuple[float, ...],
        effort: Callable[[float], Vector3] | None = None,
    ) -> None:
        some = isinstance(pieces, tuple) and len(pieces) > 0
        refuse_unless(
            "motion", ("pieces", pieces, some, "must be rising times [s], a tuple")
        )
        self._inside = inside
        self.pieces = pieces
        self.duration = pieces[-1]
        self.effort = effort

    @check_kinds_late
    def at(self, time: float) -> Reference:
        """Return the reference at a time [s].

        Raises SingularConfiguration in a singularity.
        """
        lost = "" if type(time) is float else find_lost_meaning(time)
        if lost or math.isnan(time):
            refuse_unless("motion", ("time", time, False, "must be a number [s]"))
        inside = min(max(time, 0.0), self.duration)
        try:
            reference = self._inside(inside)
        except ArithmeticError:
            cause = f"serial singularity at t = {inside:.9g} s, sin(mu)"
            raise SingularConfiguration(cause, 0.0) from None
        if time == inside:
            return reference
        return Reference(reference.quaternion, ZERO, ZERO, reference.gamma, ZERO, ZERO)

    def effort_at(self, time: float) -> Vector3 | None:
        """Return the torques [N m] to add at a time [s].

        Beyond the ends of the motion they are those of the ends.
        """
        if self.effort is None:
            return None
        return self.effort(min(max(time, 0.0), self.duration))

    def _facts(self) -> dict[str, object]:
        piece_count = len(self.pieces) - 1
        facts: dict[str, object] = {
            "duration [s]": self.duration,
            "smooth pieces": piece_count,
        }
        with contextlib.suppress(Exception):  # a representation raises nothing
            facts["begins at gamma [rad]"] = self.at(0.0).gamma
            facts["ends at gamma [rad]"] = self.at(self.duration).gamma
        return facts


def equal_pieces(duration: float, count: int) -> tuple[float, ...]:
    """Return the ends of `count` equal parts of a duration."""
    return tuple((duration * (np.arange(count + 1) / count)).tolist())


def slow_down(
    motion: ReferenceMotion, begin: float, duration: float
) -> ReferenceMotion:
    """Return a motion slowed down to rest from its time `begin` [s] on.

    The duration of the slowdown is > 0 [s]. Its time s has ds/dt = 1 - 3 u^2 + 2 u^3
    with u = t / duration: 1 at first and 0 at the end, with d^2s/dt^2 = 0 at both. It
    stays on the path of the given motion, which is inside all limits of position, for
    half of `duration` more at most.
    """
    inside = partial(_slowed_down, motion, begin, duration)
    effort = None
    if motion.effort is not None:
        effort = partial(_slowed_effort, motion, begin, duration)
    return ReferenceMotion(inside, equal_pieces(duration, 4), effort)


def _slowed_effort(
    motion: ReferenceMotion, begin: float, duration: float, time: float
) -> Vector3:
    """Return the effort of `slow_down` at a time [s]: that of the place on the path."""
    effort = motion.effort_at(_slowed_time(begin, duration, time))
    assert effort is not None
    return effort


def _slowed_time(begin: float, duration: float, time: float) -> float:
    u = time / duration
    return begin + duration * u * (1.0 - u * u * (1.0 - 0.5 * u))


def _slowed_down(
    motion: ReferenceMotion, begin: float, duration: float, time: float
) -> Reference:
    """Return the reference of `slow_down` at a time [s].

    A function that pickle takes.
    """
    u = time / duration
    reference = motion.at(_slowed_time(begin, duration, time))
    speed = 1.0 - u * u * (3.0 - 2.0 * u)
    change = -6.0 * u * (1.0 - u) / duration
    return replace(
        reference,
        body_rate=multiply(speed, reference.body_rate),
        body_acceleration=axpy(
            speed * speed, reference.body_acceleration, change, reference.body_rate
        ),
        gamma_dot=multiply(speed, reference.gamma_dot),
        gamma_ddot=axpy(
            speed * speed, reference.gamma_ddot, change, reference.gamma_dot
        ),
    )


class ActuatorSpaceMap:
    """Map between star and actuators: traced kinematics of one geometry.

    Functions of numbers raise an ArithmeticError in a singularity: of_star and posture
    in a serial one (sin(mu_k) = 0), newton_step in a parallel one (det J2 = 0), the
    others in both. Of arrays they give numbers that are not finite there, and a warning
    of NumPy.
    """

    def __init__(self, geometry: Geometry) -> None:
        self.geometry = geometry
        rows = zip(
            geometry.w.tolist(), geometry.v.tolist(), geometry.e.tolist(), strict=True
        )
        legs = (
            kernel.Leg(tuple(w), tuple(v), cross3(w, v), e[0], e[1]) for w, v, e in rows
        )
        self._legs = tuple(legs)
        # star_motion: W and W_dot in {E}, six numbers, of a quaternion, gamma_dot and
        # gamma_ddot. posture: sin(mu) and beta [rad] of the legs, six numbers, and det
        # J2, of a quaternion.
        self._actuators, self.star_motion, self.posture, self._newton = _compile(self)

    def __eq__(self, other: object) -> bool:
        """Compare legs, from which all programs follow."""
        return isinstance(other, ActuatorSpaceMap) and self._legs == other._legs

    def __hash__(self) -> int:
        """Agree with equality."""
        return hash(self._legs)

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle the geometry alone."""
        return ActuatorSpaceMap, (self.geometry,)

    def of_star(self, q: Quaternion, rate: Vector3, acceleration: Vector3) -> Reference:
        """Return the reference of a state of the star; gamma is in (-pi, pi] [rad]."""
        g1, g2, g3, d1, d2, d3, dd1, dd2, dd3 = self._actuators(
            *q, *rate, *acceleration
        )
        return Reference(
            q, rate, acceleration, (g1, g2, g3), (d1, d2, d3), (dd1, dd2, dd3)
        )

    def follow(
        self,
        start_quaternion: Quaternion,
        start_gamma: Vector3,
        gamma: Vector3,
        sigma: float | None = None,
    ) -> Quaternion:
        """Find the quaternion at gamma of the assembly mode known at other angles.

        The other angles may be far from gamma. The quaternion is found in the steps
        that `continuation` proves to stay in the mode. The proof needs sigma, the least
        singular value of J2. The rows of J2 are unit vectors, so its squared singular
        values sum to 3, the product of the larger two is at most 3/2, and sigma >= 2/3
        abs(det J2): enough for most steps, and cheap. Raises BranchEnds where a
        parallel singularity lies between, or no assembly has these angles.
        """
        step = math.dist(gamma, start_gamma)
        with contextlib.suppress(ArithmeticError):
            if sigma is None:
                sigma = 2.0 / 3.0 * abs(self.posture(*start_quaternion)[-1])
            if step <= continuation.SAFE_STEP * sigma * sigma:
                quaternion = self._find_orientation(start_quaternion, gamma)
                # The theorem holds in a ball about R, see `continuation.advance`. A
                # chord is 2 sqrt(2) sin(angle / 2), the radius sqrt(2) (sigma - step)
                # / 2.
                cosine = sum(map(float.__mul__, quaternion, start_quaternion))
                sine = math.sqrt(max(0.0, 1.0 - cosine**2))  # of half the angle
                if sine <= 0.25 * (sigma - step):
                    return quaternion
        return follow_assembly(self.geometry, start_quaternion, start_gamma, gamma)

    def _find_orientation(self, guess: Quaternion, gamma: Vector3) -> Quaternion:
        """Return the unit quaternion of the assembly at gamma closest to `guess`."""
        carriages = self.carriages(gamma)
        best = guess
        q = guess
        least = math.inf
        for _ in range(_INVERSION_STEPS):
            x, y, z, w, *residuals = self._newton(*q, *carriages)
            largest = max(map(abs, residuals))
            if largest < least:
                best = q
                least = largest
            if not largest > ANGLE_ROUNDING:
                break
            q = (x, y, z, w)
        if least > CLOSED:
            raise ArithmeticError("the loops do not close")
        return best

    def carriages(self, gamma: Any) -> list[Any]:
        """Return the unit vectors r_k of the carriages, nine numbers.

        The angles may be numbers of any kind.
        """
        components: list[Any] = []
        for angle, leg in zip(gamma, self._legs, strict=True):
            c, s = gm.cos(angle), gm.sin(angle)
            components += [
                c * x + s * y for x, y in zip(leg.v, leg.across, strict=True)
            ]
        return components

    def orientations(
        self, guesses: Array, gamma: Array, steps: int = _INVERSION_STEPS
    ) -> Array:
        """Find quaternions (n, 4) at gamma (n, 3) by steps of Newton's method.

        The steps begin at `guesses`, shape (n, 4).
        """
        carriages = self.carriages(gamma.T)
        q = list(guesses.T)
        for _ in range(steps):
            *q, first, second, third = self.newton_step(*q, *carriages)
            if np.abs((first, second, third)).max(initial=0.0) < 1e-9:
                break  # quadratic: the next step would be rounding
        return np.stack(q, axis=1)

    def _of_star(self, *inputs: Any) -> tuple[Any, ...]:
        rows = gm.rotation_rows(inputs[:4])
        rate = inputs[4:7]
        acceleration = inputs[7:10]
        legs = [kernel.leg_motion(leg, rows, rate) for leg in self._legs]
        return (
            *(kernel.joint_angle(moving_leg, 0) for moving_leg in legs),
            *(moving_leg.gamma_dot for moving_leg in legs),
            *(
                dot3(moving_leg.g, acceleration)
                + kernel.rest_accelerations(moving_leg, rate)[1]
                for moving_leg in legs
            ),
        )

    def postures(self, *q: Any) -> tuple[Any, ...]:
        """See `posture`; of a quaternion of numbers of any kind."""
        rows = gm.rotation_rows((q[0], q[1], q[2], q[3]))
        legs = [kernel.leg_motion(leg, rows, ZERO) for leg in self._legs]
        sines = [gm.sqrt(posed_leg.u) for posed_leg in legs]
        # Rows t_k x r_k of J2; p = r sin(mu).
        j2 = [
            multiply(1.0 / s, cross3(posed_leg.along, posed_leg.p))
            for s, posed_leg in zip(sines, legs, strict=True)
        ]
        beta = (kernel.joint_angle(posed_leg, 2) for posed_leg in legs)
        return (*sines, *beta, dot3(j2[0], cross3(j2[1], j2[2])))

    def star_accelerations(self, *inputs: Any) -> tuple[Any, ...]:
        """W [rad/s] and W_dot of quaternion, gamma_dot and gamma_ddot.

        Numbers of any kind.
        """
        rows = gm.rotation_rows(inputs[:4])
        gamma_dot = inputs[4:7]
        gamma_ddot = inputs[7:10]
        reach = [kernel.leg_motion(leg, rows, ZERO).g for leg in self._legs]
        rate = _solve(reach, gamma_dot)
        moving = [kernel.leg_motion(leg, rows, rate) for leg in self._legs]
        rest_accelerations = [
            kernel.rest_accelerations(moving_leg, rate)[1] for moving_leg in moving
        ]
        missing = [
            total - rest_acceleration
            for total, rest_acceleration in zip(
                gamma_ddot, rest_accelerations, strict=True
            )
        ]
        return (*rate, *_solve(reach, missing))

    def newton_step(self, *inputs: Any) -> tuple[Any, ...]:
        """Take a step of Newton's method for r_k . R e_k = 0.

        Return the quaternion after it, and the three residuals before it.
        """
        rows = gm.rotation_rows(inputs[:4])
        arcs = [(leg.e0, leg.e1, 0.0) for leg in self._legs]
        local = [gm.rotate_back(rows, inputs[4 + 3 * k : 7 + 3 * k]) for k in range(3)]
        residual = [dot3(r, e) for r, e in zip(local, arcs, strict=True)]
        # R exp(turn): the residual changes by turn . (e x r).
        slope = [cross3(e, r) for r, e in zip(local, arcs, strict=True)]
        turn = multiply(-0.5, _solve(slope, residual))
        moved = gm.quaternion_product(inputs[:4], (*turn, 1.0))
        length = gm.sqrt(sum(component * component for component in moved))
        return (*(component / length for component in moved), *residual)


@lru_cache(maxsize=16)
def _compile(space: ActuatorSpaceMap) -> tuple[Callable[..., Any], ...]:
    """Compile the programs of a map once for all that are equal: that takes 20 ms."""
    return (
        compile_program(trace(space._of_star, _STAR_MOTION)),
        compile_program(trace(space.star_accelerations, _MOVING)),
        compile_program(trace(space.postures, _STAR_MOTION[:4])),
        compile_program(trace(space.newton_step, _POSE_NUMBERS)),
    )


def _solve(rows: list[Any], right: Any) -> Any:
    """Solve rows . x = right by Cramer's rule."""
    normals = (
        cross3(rows[1], rows[2]),
        cross3(rows[2], rows[0]),
        cross3(rows[0], rows[1]),
    )
    determinant = dot3(rows[0], normals[0])
    numerators = [
        sum(map(operator.mul, right, components))
        for components in zip(*normals, strict=True)
    ]
    return tuple(numerator / determinant for numerator in numerators)


def follow_assembly(
    geometry: Geometry, start: Quaternion, start_gamma: ArrayLike, end_gamma: ArrayLike
) -> Quaternion:
    """Follow the assembly from one gamma straight to another.

    Raises as `continuation.advance`.
    """
    rotation = continuation.advance(
        geometry, rotation_matrix(start), start_gamma, end_gamma
    )
    quaternion = quaternion_of(rotation)
    # the sign of the start
    x, y, z, w = (quaternion if quaternion @ start >= 0.0 else -quaternion).tolist()
    return (x, y, z, w)
