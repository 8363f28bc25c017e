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
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import lru_cache, partial
from typing import Any, NamedTuple

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
from sst_ros.mechanism.generic_math import (
    Triple,
    axpy,
    cross3,
    dot3,
    multiply,
    triple,
)
from sst_ros.mechanism.geometry import Array, Geometry, quaternion_of, rotation_matrix
from sst_ros.programs.expression import compile_program, divide, trace
from sst_ros.state import ZERO, Explained, Quaternion, Vector3, find_lost_meaning

# residual abs(r_k . t_k) at which Newton's method ends: rounding
ANGLE_ROUNDING = 4e-16
# largest loop-closure residual abs(r_k . t_k) of an orientation that is returned
CLOSED = 1e-14
# most steps of Newton's method to an orientation: from close by four or five do
_INVERSION_STEPS = 20
# residual in rad at which the orientations of arrays are done: Newton's method is
# quadratic, and the next step would be rounding
_ARRAY_RESIDUAL = 1e-9

# Inputs of the traced functions.
_STAR_SIZES = {"quaternion": 4, "rate": 3, "acceleration": 3}
_ACTUATOR_SIZES = {"quaternion": 4, "gamma_dot": 3, "gamma_ddot": 3}
_POSE_SIZES = {"quaternion": 4, "carriages": 9}
_CARRIAGE_SIZES = {"r_1": 3, "r_2": 3, "r_3": 3}


def name_parts(sizes: Mapping[str, int]) -> list[str]:
    """Return names of the numbers of some parts, as inputs of a traced function."""
    return [f"{name}_{k}" for name, size in sizes.items() for k in range(size)]


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
        is_tuple = isinstance(pieces, tuple) and len(pieces) > 0
        requirement = "must be rising times [s], a tuple"
        refuse_unless("motion", ("pieces", pieces, is_tuple, requirement))
        self._inside = inside
        self.pieces = pieces
        self.duration = pieces[-1]
        self.effort = effort

    @check_kinds_late
    def at(self, time: float) -> Reference:
        """Return the reference at a time [s].

        Raises SingularConfiguration in a singularity.
        """
        lost = ""
        if type(time) is not float:
            lost = find_lost_meaning(time)
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
    speed = 1.0 - u * u * (3.0 - 2.0 * u)  # ds/dt
    change = -6.0 * u * (1.0 - u) / duration  # d^2s/dt^2

    def accelerate(acceleration: Vector3, rate: Vector3) -> Vector3:
        return axpy(speed * speed, acceleration, change, rate)

    return replace(
        reference,
        body_rate=multiply(speed, reference.body_rate),
        body_acceleration=accelerate(reference.body_acceleration, reference.body_rate),
        gamma_dot=multiply(speed, reference.gamma_dot),
        gamma_ddot=accelerate(reference.gamma_ddot, reference.gamma_dot),
    )


class ActuatorSpaceMap:
    """Map between star and actuators: traced kinematics of one geometry.

    Functions of numbers raise an ArithmeticError in a singularity: of_star and posture
    in a serial one (sin(mu_k) = 0), newton_step in a parallel one (det J2 = 0), the
    others in both. Of arrays they give numbers that are not finite there, and a warning
    of NumPy.

    Attributes:
        geometry: that of the mechanism.
        star_motion: `star_accelerations`, compiled for numbers.
        posture: `postures`, compiled for numbers.

    """

    def __init__(self, geometry: Geometry) -> None:
        self.geometry = geometry
        legs = []
        for k in range(3):
            w = triple(geometry.w[k].tolist())
            v = triple(geometry.v[k].tolist())
            e0, e1, _ = geometry.e[k].tolist()
            legs.append(kernel.Leg(w, v, cross3(w, v), e0, e1))
        self._legs = tuple(legs)
        compiled = _compile(self)
        self.star_motion = compiled.star_motion
        self.posture = compiled.posture
        self._actuator_motion = compiled.actuator_motion
        self._newton = compiled.newton_step

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
        numbers = self._actuator_motion(*q, *rate, *acceleration)
        g1, g2, g3, d1, d2, d3, dd1, dd2, dd3 = numbers
        return Reference(
            quaternion=q,
            body_rate=rate,
            body_acceleration=acceleration,
            gamma=(g1, g2, g3),
            gamma_dot=(d1, d2, d3),
            gamma_ddot=(dd1, dd2, dd3),
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
        that `continuation` proves to stay in the mode. Raises BranchEnds where a
        parallel singularity lies between, or no assembly has these angles.

        The proof needs `sigma`, a bound below the least singular value of J2. The rows
        of J2 are unit vectors, so its squared singular values sum to 3, the product of
        the larger two is at most 3/2, and sigma >= 2/3 abs(det J2): enough for most
        steps, and cheap.
        """
        step = math.dist(gamma, start_gamma)
        with contextlib.suppress(ArithmeticError):
            if sigma is None:
                *_, det_j2 = self.posture(*start_quaternion)
                sigma = 2.0 / 3.0 * abs(det_j2)
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
            cosine, sine = gm.cos(angle), gm.sin(angle)
            for x, y in zip(leg.v, leg.across, strict=True):
                components.append(cosine * x + sine * y)
        return components

    def orientations(
        self, guesses: Array, gamma: Array, steps: int = _INVERSION_STEPS
    ) -> Array:
        """Find quaternions (n, 4) at gamma (n, 3) by steps of Newton's method.

        The steps begin at `guesses`, shape (n, 4). Nothing says whether they arrive.
        """
        carriages = self.carriages(gamma.T)
        q = list(guesses.T)
        for _ in range(steps):
            x, y, z, w, *residuals = self.newton_step(*q, *carriages)
            q = [x, y, z, w]
            if np.abs(residuals).max(initial=0.0) < _ARRAY_RESIDUAL:
                break
        return np.stack(q, axis=1)

    def _accelerate_actuators(self, *inputs: Any) -> tuple[Any, ...]:
        """Return gamma, gamma_dot and gamma_ddot of quaternion, W and W_dot."""
        of = divide(_STAR_SIZES, inputs)
        rows = gm.rotation_rows(of["quaternion"])
        legs = [kernel.leg_motion(leg, rows, of["rate"]) for leg in self._legs]
        gamma = [kernel.joint_angle(leg, 0) for leg in legs]
        gamma_dot = [leg.gamma_dot for leg in legs]
        gamma_ddot = []
        for leg in legs:
            _, at_rest = kernel.rest_accelerations(leg, of["rate"])
            gamma_ddot.append(dot3(leg.g, of["acceleration"]) + at_rest)
        return (*gamma, *gamma_dot, *gamma_ddot)

    def postures(self, x: Any, y: Any, z: Any, w: Any) -> tuple[Any, ...]:
        """Return sin(mu) and beta [rad] of the legs, and det J2, seven numbers.

        They are those of a quaternion, of numbers of any kind.
        """
        rows = gm.rotation_rows((x, y, z, w))
        legs = [kernel.leg_motion(leg, rows, ZERO) for leg in self._legs]
        sines = []
        j2 = []
        for leg in legs:
            sine = gm.sqrt(leg.u)
            sines.append(sine)
            # Rows t_k x r_k of J2; p = r sin(mu).
            j2.append(multiply(1.0 / sine, cross3(leg.along, leg.p)))
        beta = [kernel.joint_angle(leg, 2) for leg in legs]
        first, second, third = j2
        return (*sines, *beta, dot3(first, cross3(second, third)))

    def star_accelerations(self, *inputs: Any) -> tuple[Any, ...]:
        """Return W [rad/s] and W_dot [rad/s^2] in {E}, six numbers.

        They are those of a quaternion, gamma_dot and gamma_ddot, of numbers of any
        kind.
        """
        of = divide(_ACTUATOR_SIZES, inputs)
        rows = gm.rotation_rows(of["quaternion"])
        g = [kernel.leg_motion(leg, rows, ZERO).g for leg in self._legs]
        rate = _solve(g, of["gamma_dot"])
        legs = [kernel.leg_motion(leg, rows, rate) for leg in self._legs]
        missing = []  # what W_dot adds to gamma_ddot
        for leg, gamma_ddot in zip(legs, of["gamma_ddot"], strict=True):
            _, at_rest = kernel.rest_accelerations(leg, rate)
            missing.append(gamma_ddot - at_rest)
        return (*rate, *_solve(g, missing))

    def newton_step(self, *inputs: Any) -> tuple[Any, ...]:
        """Take a step of Newton's method for r_k . R e_k = 0.

        Of a quaternion and `carriages`, return the quaternion after it, and the three
        residuals before it.
        """
        of = divide(_POSE_SIZES, inputs)
        rows = gm.rotation_rows(of["quaternion"])
        residuals = []
        slopes = []
        carriages = divide(_CARRIAGE_SIZES, of["carriages"]).values()
        for leg, carriage in zip(self._legs, carriages, strict=True):
            e = (leg.e0, leg.e1, 0.0)
            r = gm.rotate_back(rows, carriage)
            residuals.append(dot3(r, e))
            # R exp(turn): the residual changes by turn . (e x r).
            slopes.append(cross3(e, r))
        turn = multiply(-0.5, _solve(slopes, residuals))
        moved = gm.quaternion_product(of["quaternion"], (*turn, 1.0))
        length = gm.sqrt(sum(component * component for component in moved))
        return (*(component / length for component in moved), *residuals)


class _Compiled(NamedTuple):
    """Functions of a map, compiled for numbers."""

    actuator_motion: Callable[..., Any]
    star_motion: Callable[..., Any]
    posture: Callable[..., Any]
    newton_step: Callable[..., Any]


@lru_cache(maxsize=16)
def _compile(space: ActuatorSpaceMap) -> _Compiled:
    """Compile the functions of a map once for all that are equal: that takes 20 ms."""

    def compile_function(
        function: Callable[..., Any], sizes: Mapping[str, int]
    ) -> Callable[..., Any]:
        return compile_program(trace(function, name_parts(sizes)))

    return _Compiled(
        compile_function(space._accelerate_actuators, _STAR_SIZES),
        compile_function(space.star_accelerations, _ACTUATOR_SIZES),
        compile_function(space.postures, {"quaternion": 4}),
        compile_function(space.newton_step, _POSE_SIZES),
    )


def _solve(rows: Sequence[Any], right: Sequence[Any]) -> Triple:
    """Solve rows . x = right by Cramer's rule."""
    first, second, third = rows
    normals = (cross3(second, third), cross3(third, first), cross3(first, second))
    determinant = dot3(first, normals[0])
    numerators = []
    for components in zip(*normals, strict=True):
        numerators.append(sum(map(operator.mul, right, components)))
    return triple(numerator / determinant for numerator in numerators)


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
    if quaternion @ start < 0.0:  # of the two signs, that of the start
        quaternion = -quaternion
    x, y, z, w = quaternion.tolist()
    return (x, y, z, w)
