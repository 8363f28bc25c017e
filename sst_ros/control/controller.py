# SPDX-License-Identifier: Apache-2.0
"""Inverse dynamics, controllers that track a reference motion, and how well they do.

The controllers use the inverse dynamics. The control laws are in `law`: by the model,
by feedback, or by both.
"""

from __future__ import annotations

import contextlib
import dataclasses
import math
from collections.abc import Callable, Sequence
from typing import Any, TypeAlias, overload

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sst_ros.control import law
from sst_ros.control.actuator_space import ActuatorSpaceMap, Reference, ReferenceMotion
from sst_ros.control.law import (
    Command,
    ControlChannel,
    ControllerSettings,
    Measurement,
)
from sst_ros.dynamics import kernel
from sst_ros.dynamics.traced_dynamics import Dynamics
from sst_ros.errors import (
    SingularConfiguration,
    SstError,
    check_kinds,
    check_kinds_late,
    read_numbers,
    refuse_unless,
)
from sst_ros.mechanism import kinematics, virtual_work
from sst_ros.mechanism.generic_math import axpy, triple
from sst_ros.mechanism.geometry import Array, Geometry, quaternion_of, rotation_matrix
from sst_ros.scene.scene import Scene, SceneInput, scene_of, terms
from sst_ros.state import (
    ZERO,
    Explained,
    Quaternion,
    State,
    Vector3,
    find_lost_meaning,
    finite_vector,
)

# sin(mu_k) and det J2 below which rounding leaves a torque less than six digits
SINGULAR_MASS = 1e-10
_SHORTEST_QUATERNION = 1e-100  # its square is far from the smallest double

Pose: TypeAlias = "State | Sequence[float]"
"""A state, or angles gamma [rad], or a quaternion of {E} in {B}."""

Poses: TypeAlias = "Array | Sequence[Sequence[float]]"
"""Rows of angles or quaternions."""


class InverseDynamics(Explained):
    """Torques at the joints of a scene, all its terms included.

    It is the model that the simulation integrates, solved for the torques: tau = M
    gamma_ddot + h (the paper's Eq. 90 with every term of the scene). What lies between
    a command and a torque (limit, lag) is no part of it.
    """

    @check_kinds
    def __init__(self, scene: SceneInput) -> None:
        self.scene = scene_of(scene)
        self._dynamics = Dynamics.of(self.scene)
        self._has_moment_topic = self._dynamics.has_moment_topic
        self._program = self._dynamics.inverse

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle the scene."""
        return InverseDynamics, (self.scene,)

    def torque(
        self,
        quaternion: Quaternion,
        body_rate: Vector3,
        body_acceleration: Vector3,
        moment: Vector3 = ZERO,
    ) -> Vector3:
        """Torques [N m] that give W_dot in {E} [rad/s^2] in a state.

        The quaternion (x, y, z, w) of {E} in {B} has any length > 0, the body rate is W
        in {E} [rad/s]; the moment on the star in {B} [N m] is used where a topic gives
        it. Raises SingularConfiguration, serial (sin(mu_k) = 0) or parallel (det J2 =
        0), where no torques control the star; InputError for numbers that are no state.
        """
        moment_numbers = moment if self._has_moment_topic else ()
        # What is refused where they cannot be unpacked.
        numbers: Any = (quaternion, body_rate, body_acceleration, moment_numbers)
        with contextlib.suppress(ArithmeticError, TypeError, ValueError, MemoryError):
            numbers = *quaternion, *body_rate, *body_acceleration, *moment_numbers
            first, second, third, determinant, *squares = self._program(*numbers)
            total = first + second + third + determinant
            if isinstance(total, float):  # it is none of masked or complex numbers
                det_j2 = abs(determinant) * math.sqrt(
                    squares[0] * squares[1] * squares[2]
                )
                # Comparisons with NaN are false: what is not finite is refused, too.
                is_sound = math.isfinite(first + second + third)
                is_sound = is_sound and det_j2 > SINGULAR_MASS
                if is_sound and min(squares) > SINGULAR_MASS * SINGULAR_MASS:
                    return first, second, third
        raise self._refusal(quaternion, numbers)

    @check_kinds_late
    def reference_torque(self, reference: Reference) -> Vector3:
        """Torques [N m] of a reference: the feedforward; raises as `torque`."""
        return self.torque(
            reference.quaternion, reference.body_rate, reference.body_acceleration
        )

    @overload
    def gravity_torque(self, at: State | Sequence[float]) -> Vector3: ...

    @overload
    def gravity_torque(self, at: Array | Sequence[Sequence[float]]) -> Any: ...

    def gravity_torque(self, at: Pose | Poses) -> Vector3 | Array:
        """Return the torques [N m] that hold the manipulator at rest.

        They hold it against gravity, springs and the like.

        Args:
            at: a state of a simulation; or gamma [rad], shape (3,), for the admissible
                assembly there; or the quaternion (x, y, z, w) of {E} in {B}, shape
                (4,). Rows of angles or quaternions, shape (n, 3) or (n, 4), are n
                poses, computed at once.

        Returns:
            Three torques; of rows an array, shape (n, 3), with the bits of pose by
            pose.

        Raises:
            AssemblyError: a gamma has no unique admissible assembly.
            SingularConfiguration: as in `torque`, of the first pose that is singular.
            InputError: `at` is no pose.

        """
        quaternions = self._orientations(at)
        if quaternions is None:
            return self.torque(self._orientation(at), ZERO, ZERO)
        return self._torques_at_rest(quaternions)

    def mass_matrix(self, at: Pose | Poses) -> Array:
        """M of tau = M gamma_ddot + h [kg m^2], rotors included; symmetric.

        Its shape is (3, 3); of n poses (n, 3, 3), with the bits of pose by pose. `at`
        and what is raised are as in `gravity_torque`.
        """
        quaternions = self._orientations(at)
        if quaternions is None:
            inertia, reach = self._reduce(self._orientation(at))
        else:
            self._torques_at_rest(quaternions)  # refuses singularities
            # Pose by pose in memory, as one pose is: NumPy 1.26 multiplies matrices of
            # another layout without BLAS, which rounds otherwise.
            numbers = np.ascontiguousarray(
                self._dynamics.reduced_inertia_of_rows(quaternions)
            )
            inertia, reach = np.split(numbers.reshape(-1, 6, 3), 2, axis=1)
        back = np.linalg.inv(reach)
        mass = np.swapaxes(back, -1, -2) @ inertia @ back
        return np.asarray(0.5 * (mass + np.swapaxes(mass, -1, -2)))

    @check_kinds
    def bias(self, state: State, moment: Vector3 = ZERO) -> Vector3:
        """Return the torques h of tau = M gamma_ddot + h [N m] in a state.

        They keep gamma_dot as it is. The moment and what is raised are as in `torque`.
        """
        _check_moment(moment)
        q = state.quaternion
        rate = state.body_rate
        _, reach = self._reduce(q)
        rest_acceleration = kernel.actuator_acceleration(
            self._dynamics.model, (*q, *rate), ZERO
        )
        acceleration = np.linalg.solve(reach, np.negative(rest_acceleration))
        return self.torque(q, rate, triple(acceleration.tolist()), moment)

    @check_kinds
    def torque_of_moment(
        self, at: State | Sequence[float], moment: ArrayLike
    ) -> Vector3:
        """Return torques [N m] at the actuators that do the work of a moment.

        The moment acts on the star, in {B} [N m]. `at` and what is raised are as in
        `gravity_torque`. In a function for `simulate` such torques stand for loads that
        the scene does not have.
        """
        _check_moment(moment)
        q = self._orientation(at)
        _, reach = self._reduce(q)
        acting = rotation_matrix(q).T @ np.asarray(moment, dtype=float)
        return triple(np.linalg.solve(reach.T, acting).tolist())

    def _orientation(self, pose: Pose | Poses) -> Quaternion:
        """Quaternion of {E} in {B} of a state, of angles gamma or of itself."""
        numbers: Any = pose.quaternion if isinstance(pose, State) else pose
        requirement = (
            "must be a State, three angles gamma or a quaternion, or rows of either"
        )
        numbers = read_numbers("inverse dynamics", "at", numbers)
        fits = numbers.shape in ((3,), (4,))
        refuse_unless("inverse dynamics", ("at", pose, fits, requirement))
        if len(numbers) == 3:
            rotation = kinematics.admissible(Geometry.of(self.scene), numbers).rotation
            numbers = quaternion_of(rotation)
        x, y, z, w = numbers.tolist()
        return x, y, z, w

    def _orientations(self, pose: Pose | Poses) -> Array | None:
        """Quaternions of many poses, shape (n, 4); None where `pose` is not rows."""
        if isinstance(pose, State):
            return None
        poses = read_numbers("inverse dynamics", "at", pose)
        if poses.ndim != 2:
            return None
        fits = poses.shape[1] in (3, 4)
        requirement = "must be rows of three angles gamma or of quaternions"
        refuse_unless("inverse dynamics", ("at", pose, fits, requirement))
        if poses.shape[1] == 4:
            return poses
        geometry = Geometry.of(self.scene)
        return quaternion_of(kinematics.admissible_rotations(geometry, poses))

    def _torques_at_rest(self, quaternions: Array) -> Array:
        """Return torques [N m] that hold many poses, shape (n, 4) -> (n, 3).

        Raises as `torque` of the first pose that has none.
        """
        zeros = 6  # W and W_dot
        if self._has_moment_topic:
            zeros = 9
        at_rest = np.zeros((len(quaternions), zeros))
        results = self._dynamics.inverse_of_rows(np.hstack([quaternions, at_rest]))
        torques, determinants, squares = np.split(results, [3, 4], axis=1)
        with np.errstate(all="ignore"):  # what is not finite is refused
            det_j2 = np.abs(determinants[:, 0]) * np.sqrt(squares.prod(axis=1))
            sound = np.isfinite(torques.sum(axis=1)) & (det_j2 > SINGULAR_MASS)
            sound &= squares.min(axis=1) > SINGULAR_MASS * SINGULAR_MASS
        for row in np.flatnonzero(~sound):
            x, y, z, w = quaternions[row].tolist()
            self.torque((x, y, z, w), ZERO, ZERO)
        return np.ascontiguousarray(torques)

    def _reduce(self, q: Quaternion) -> tuple[Array, Array]:
        """Return the inertia reduced to the star [kg m^2] and the rows g_k.

        Raises as `torque`.
        """
        self.torque(q, ZERO, ZERO)  # refuses singularities
        inertia, reach = np.array(self._dynamics.reduced_inertia(*q)).reshape(2, 3, 3)
        return inertia, reach

    def _facts(self) -> dict[str, object]:
        of_actuators = ("torque limit", "actuator lag")
        included = ["star", *terms(self.scene)]
        moment = "none is given"
        if self._has_moment_topic:
            moment = "given with a state"
        return {
            "scene": self.scene.name,
            "torques for": [term for term in included if term not in of_actuators],
            "not for": of_actuators,
            "external moment": moment,
        }

    def _refusal(
        self, quaternion: Quaternion, numbers: Sequence[float]
    ) -> SingularConfiguration:
        """Return why there is no torque; raises InputError where numbers are wrong."""
        lost = find_lost_meaning([*numbers, quaternion])
        finite = False
        refuse_unless("inverse dynamics", ("state", tuple(numbers), not lost, lost))
        with contextlib.suppress(TypeError, ValueError, OverflowError):
            # quaternion, W and W_dot, and a moment if it comes from a topic
            sizes = len(numbers), len(quaternion)
            finite = sizes in ((10, 4), (13, 4)) and all(map(math.isfinite, numbers))
        short = finite and math.hypot(*quaternion) < _SHORTEST_QUATERNION
        refuse_unless(
            "inverse dynamics",
            ("state", tuple(numbers), finite, "must be finite numbers"),
            ("quaternion", quaternion, not short, "must have a length > 0"),
        )
        geometry = Geometry.of(self.scene)
        # t_k x w_k is r_k times sin(mu_k); J2 has the rows t_k x r_k.
        t = geometry.e @ rotation_matrix(quaternion).T
        scaled_r = np.cross(t, geometry.w)
        sines = np.linalg.norm(scaled_r, axis=1)
        least = float(sines.min())
        if least <= SINGULAR_MASS:
            return SingularConfiguration("serial singularity, sin(mu)", least)
        determinant = float(np.linalg.det(np.cross(t, scaled_r / sines[:, None])))
        cause = "no finite torque gives this acceleration:"
        if abs(determinant) <= 2.0 * SINGULAR_MASS:
            cause = "parallel singularity,"
        return SingularConfiguration(f"{cause} det J2", determinant)


def _check_moment(moment: Any) -> None:
    """Refuse a moment that is not three numbers."""
    is_vector = finite_vector(moment) is not None
    refuse_unless(
        "inverse dynamics",
        ("moment", moment, is_vector, "must be three numbers [N m]"),
    )


class ControlStopped(SstError):
    """No torque can be computed at a `time` of the motion [s].

    Every call raises it again until a reset.
    """

    def __init__(self, reason: str, time: float) -> None:
        self.time = time
        super().__init__(f"control stopped at t = {time:.9f} s: {reason}")


class ChannelState:
    """The memory of a channel during a run, with its noise by seed."""

    def __init__(self, channel: ControlChannel, seed: int | Sequence[int]) -> None:
        self._channel = channel
        self._random = np.random.default_rng(seed)
        self._deviations = np.repeat((channel.angle_noise, channel.rate_noise), 3)
        self._before: Any = None  # angles of the last sample, as encoders count them
        self._queue: Any = ZERO * channel.delay  # commands that have not arrived
        self._first = 1.0  # 0 after the first sample

    def measure(self, gamma: Vector3, gamma_dot: Vector3) -> Measurement:
        """Return gamma [rad] and gamma_dot [rad/s] as the controller receives them."""
        channel = self._channel
        noise: list[float] = []
        if channel.counts and self._before is None:
            earlier = axpy(1.0, gamma, -channel.period, gamma_dot)
            self._before = tuple(map(channel.count, earlier))
        if self._deviations.any():
            noise = (self._random.standard_normal(6) * self._deviations).tolist()
        measured, self._before = channel.measure(gamma, gamma_dot, self._before, noise)
        return measured

    def transmit(self, command: Vector3) -> Vector3:
        """Return the torques [N m] that act when a command is sent."""
        torque, self._queue = self._channel.transmit(command, self._queue, self._first)
        self._first = 0.0
        return torque


class Controller:
    """A controller that tracks one reference motion by a scheme of the law.

    The law has five schemes. The controller has a model of the manipulator, which may
    differ from the plant, and holds a command over a control period [s]. Its `inertia`
    is M_kk at the start of the motion [kg m^2], by which gains are made. Raises
    InputError where the integral action would be unstable, SingularConfiguration where
    the motion begins in a singularity.
    """

    @check_kinds
    def __init__(
        self,
        model: SceneInput,
        motion: ReferenceMotion,
        settings: ControllerSettings,
        period_s: float,
    ) -> None:
        model = scene_of(model)
        self._motion = motion
        self._settings = settings
        self._period_s = period_s
        geometry = Geometry.of(model)
        start = motion.at(0.0)
        self._inverse = InverseDynamics(model)
        self._space = ActuatorSpaceMap(geometry)
        self._begin = start.quaternion, start.gamma
        rotation = rotation_matrix(start.quaternion)
        posture = virtual_work.posture(geometry, np.array(start.gamma), rotation)
        mechanism = virtual_work.Mechanism.of(model)
        t1, _ = virtual_work.equation_of_motion(mechanism, posture, (0.0, 0.0, 0.0))
        self.inertia: Vector3 = triple((-np.diag(t1)).tolist())
        limit = float(law.command_limit(settings.torque_limit, model))
        self._limit = limit if math.isfinite(limit) else None
        self._law = self._make_law(settings)
        self.reset()

    @property
    def model(self) -> Scene:
        """The manipulator as the controller knows it."""
        return self._inverse.scene

    @property
    def settings(self) -> ControllerSettings:
        """Mode and gains."""
        return self._settings

    @property
    def space(self) -> ActuatorSpaceMap:
        """The kinematics of the model."""
        return self._space

    def _make_law(self, settings: ControllerSettings) -> law.ControlLaw:
        return self.law_with(
            self._inverse.torque, self._space.star_motion, settings=settings
        )

    def law_with(
        self,
        torque: Callable[..., Any],
        accelerate: Callable[..., Any],
        *,
        settings: ControllerSettings | None = None,
    ) -> law.ControlLaw:
        """Return the law with functions of the model that take numbers of another kind.

        See `law.ControlLaw`. Its settings are by default those of the controller.
        Raises InputError where the integral action would be unstable.
        """
        settings = settings or self._settings
        column = np.array(self.inertia)[:, None]
        rate = settings.integral_rate
        kp_column, kd_column = law.feedback_gains(
            column, lambda name: getattr(settings, name), settings.direct
        )
        kp = triple(kp_column.ravel().tolist())
        kd = triple(kd_column.ravel().tolist())
        # Routh: s^3 + kd s^2 + kp s + kp r is stable for 0 < r < kd.
        requirement = (
            f"must be < {min(kd):g} 1/s, damping over inertia: else the loop is"
            " unstable"
        )
        is_stable = not rate or rate < min(kd)
        refuse_unless("control", ("integral_rate", rate, is_stable, requirement))
        return law.ControlLaw(
            settings=settings,
            torque=torque,
            accelerate=accelerate,
            kp=kp,
            kd=kd,
            inertia=self.inertia,
            integral_rate=rate,
            limit=self._limit,
            period=self._period_s,
        )

    def __getstate__(self) -> dict[str, Any]:
        """Return what a copy or a pickle gets: all but compiled functions."""
        return {name: value for name, value in vars(self).items() if name != "_law"}

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Go on where the controller was when it was copied."""
        vars(self).update(state)
        self._law = self._make_law(self._settings)

    @check_kinds
    def tune(self, settings: ControllerSettings) -> None:
        """Take other gains from the next command on.

        Mode, limit and the sum of errors stay. Raises InputError, and changes nothing,
        where the integral action would be unstable.
        """
        kept = {
            name: getattr(self._settings, name)
            for name in ("mode", "space", "torque_limit", "feedforward_at")
        }
        settings = dataclasses.replace(settings, **kept)
        self._law = self._make_law(settings)
        self._settings = settings

    def reset(self) -> None:
        """Clear the integral, the orientation that was observed last, and a failure."""
        # Orientation and gamma from which the next orientation is found.
        self._last_observed = self._begin
        self._integral = ZERO
        self._failure: ControlStopped | None = None

    @check_kinds
    def follow(self, motion: ReferenceMotion) -> None:
        """Track another motion, from the present reference on.

        Gains and integral stay.
        """
        self._motion = motion

    def desire(self, time: float) -> tuple[Reference, Vector3, Vector3]:
        """Return the reference at a time [s], and its torques [N m].

        The torques are those of this time, then those that are held over the period
        from it on. They are zeros where the mode does not feed them forward.
        """
        desired = self._motion.at(time)
        if not self._settings.feeds:
            return desired, ZERO, ZERO
        present_torque = self._inverse.reference_torque(desired)
        held_torque = present_torque
        if self._settings.feedforward_at == "middle":
            middle = self._motion.at(self._hold_time(time))
            held_torque = self._inverse.reference_torque(middle)
        return desired, present_torque, held_torque

    def _hold_time(self, time: float) -> float:
        """Return the time of the feedforward that is held from a time on [s]."""
        if self._settings.feedforward_at == "middle":
            return time + 0.5 * self._period_s
        return time

    @check_kinds_late
    def command(self, time: float, measured: Measurement) -> Command:
        """Return the command at a time of the motion [s], to be held for a period.

        Raises ControlStopped where the measurement is not finite, the assembly mode
        ends, or the model is singular.
        """
        if self._failure is not None:
            raise self._failure
        if type(time) is not float:
            lost = find_lost_meaning(time)
            refuse_unless("control", ("time", time, not lost, lost))
        requirement = "must be finite numbers"
        observes = self._settings.observes
        try:
            numbers = (*measured.gamma, *measured.gamma_dot)
            refuse_unless(
                "control",
                ("measured", numbers, all(map(math.isfinite, numbers)), requirement),
            )
            desired, *torques = self.desire(time)
            observed: Any = ()
            if observes:
                observed = self._space.follow(*self._last_observed, measured.gamma)
            command = self._law.answer(
                desired,
                torques,
                measured,
                observed,
                self._integral,
                self._motion.effort_at(self._hold_time(time)),
            )
            total = command.total
            refuse_unless(
                "control",
                ("torque", total, all(map(math.isfinite, total)), requirement),
            )
        except (SstError, ArithmeticError, ValueError) as error:
            self._failure = ControlStopped(str(error), time)
            raise self._failure from error
        self._integral = command.integral
        if observes:
            self._last_observed = observed, measured.gamma
        return command

    def __call__(self, time: float, state: State) -> Vector3:
        """Return torques [N m] for the angles and rates of a state.

        This makes the controller a function for `simulate`.
        """
        joints = state.joints
        return self.command(time, Measurement(joints.gamma, joints.gamma_dot)).torque


SETTLING_BAND = 0.02  # settling band: share of the largest range of a joint

_ANSWER_PARTS = ("gamma", "gamma_dot", "error", "feedforward", "feedback", "torque")
TRACK = np.dtype([("time", float), *((name, float, 3) for name in _ANSWER_PARTS)])
"""A sample of a tracking record, 19 numbers: the time since the start of the motion or
of the run [s], gamma and gamma_dot as desired [rad], [rad/s], desired - measured gamma
[rad], the two parts of the controller's command [N m], and the torque that was
commanded or applied [N m].
"""

Track: TypeAlias = "np.recarray[Any, Any]"


def track_of(rows: ArrayLike) -> Track:
    """Return a tracking record, shape (n,) of TRACK, of numbers in its order.

    The numbers have the shape (n, 19), or are flat.
    """
    return np.array(rows, dtype=float).reshape(-1).view(TRACK).view(np.recarray)


class TrackingMetrics:
    """Metrics of a tracking record, which may come part by part.

    Those of joints have shape (3,).

    Attributes:
        samples: number of samples.
        limited: number of samples in which a torque was limited, None where that is not
            known.
        largest: largest error of each joint [rad].
        last: error of each joint at the last sample [rad].
        torque_largest: largest torque of each joint [N m].

    """

    def __init__(self, track: Track | None = None, limited: int | None = None) -> None:
        self.samples = 0
        self.limited = limited
        self.largest = np.zeros(3)
        self.torque_largest = np.zeros(3)
        self.last = np.zeros(3)
        self._error_squares = np.zeros(3)  # sums over the samples
        self._torque_squares = np.zeros(3)
        # Sums of feedforward x torque and of feedback x torque.
        self._part_products = np.zeros((2, 3))
        self._lowest = np.full(3, np.inf)  # desired gamma [rad]
        self._highest = np.full(3, -np.inf)
        self._rested: float | None = None  # when the motion ended [s]
        self._settled: float | None = None  # since when the error is in the band [s]
        if track is not None:
            self.add(track)

    def add(self, track: Track) -> None:
        """Add the next part of the record, of one sample or more."""
        error = np.abs(track.error)
        torque = track.torque
        self._error_squares += np.sum(error**2, axis=0)
        self._torque_squares += np.sum(torque**2, axis=0)
        feedforward_product = np.sum(track.feedforward * torque, axis=0)
        feedback_product = np.sum(track.feedback * torque, axis=0)
        self._part_products += [feedforward_product, feedback_product]
        self.largest = np.maximum(self.largest, error.max(axis=0))
        self.torque_largest = np.maximum(
            self.torque_largest, np.abs(torque).max(axis=0)
        )
        self._lowest = np.minimum(self._lowest, track.gamma.min(axis=0))
        self._highest = np.maximum(self._highest, track.gamma.max(axis=0))
        moving = np.any(track.gamma_dot != 0.0, axis=1)
        self._rested = _since(self._rested, moving, track.time)
        away = moving | (error.max(axis=1) > self.band)
        self._settled = _since(self._settled, away, track.time)
        self.last = error[-1]
        self.samples += len(error)

    @property
    def rms(self) -> Array:
        """Root of the mean square of the error [rad]; 0 without a sample."""
        return np.asarray(np.sqrt(self._error_squares / max(self.samples, 1)))

    @property
    def torque_rms(self) -> Array:
        """Root of the mean square of the torque [N m]; 0 without a sample."""
        return np.asarray(np.sqrt(self._torque_squares / max(self.samples, 1)))

    @property
    def shares(self) -> Array:
        """Shares of feedforward and feedback in the torque, shape (2, 3).

        They are the mean of (part x torque) over the mean of torque^2, nan without a
        torque. What a limit has cut off makes their sum differ from 1.
        """
        with np.errstate(invalid="ignore", divide="ignore"):
            return np.asarray(self._part_products / self._torque_squares)

    @property
    def band(self) -> float:
        """Settling band [rad], SETTLING_BAND times the largest range of a joint."""
        return SETTLING_BAND * float(np.max(self._highest - self._lowest))

    @property
    def settling(self) -> float | None:
        """Time after the end of the motion after which the error stays in the band [s].

        None where it does not settle, or the record ends with the motion.
        """
        if self._rested is None or self._settled is None:
            return None
        return self._settled - self._rested


def _since(since: float | None, wrong: NDArray[np.bool_], time: Array) -> float | None:
    """Return the time since when no sample has been wrong [s]; None if the last is.

    It was `since` before these samples.
    """
    if since is not None and not wrong.any():
        return since
    first_right = int(np.max(np.flatnonzero(wrong), initial=-1)) + 1
    return float(time[first_right]) if first_right < len(time) else None
