# SPDX-License-Identifier: Apache-2.0
"""Exciting motions: Fourier series of the actuators that make parameters well determined.

The motion is a Fourier series that begins and ends at rest,

    gamma_k(t) = c_k + sum over n of a_nk sin(n w t) + b_nk cos(n w t), w = 2 pi / duration

(Swevers, Ganseman, Tukel, De Schutter and Van Brussel, IEEE Trans. Robotics Autom. 13 (1997)
730-740). The coefficients are taken from the subspace in which gamma = c and gamma_dot =
gamma_ddot = 0 at both ends. They minimise

    log condition number + mean log standard deviation

of the base parameters at equal noise, with quadratic penalties beyond a share of the limits:
stroke, workspace, singularities, torque, rate and acceleration of the actuators.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from scipy.linalg import null_space
from scipy.optimize import minimize

from sst_ros.control.actuator_space import ActuatorSpaceMap
from sst_ros.control.plan import examine_motion
from sst_ros.control.reference_motions import reference_motion
from sst_ros.dynamics.initial_state import initial_state
from sst_ros.errors import InputError, MotionRefused, Problem
from sst_ros.identification import parameters
from sst_ros.identification.regressor import BaseParameters, Regressor, find_base_parameters
from sst_ros.mechanism import kinematics
from sst_ros.mechanism.frames import cross, quaternion_of, rotation_matrix
from sst_ros.mechanism.geometry import Array, Geometry
from sst_ros.mechanism.kinematics import rotate
from sst_ros.scene.scene import Scene

POINTS = 12
"""Samples, and points of the scene, in a period of the highest harmonic."""

SHARE = 0.9
"""Share of each range that the motion may use: the manipulator is not quite its model."""

LEAST_SINE = 0.15
"""Least sin(mu_k) and det J2 of a motion: torques and rates grow with their inverse."""

_FIRST = 0.05
"""Amplitude of the first guess [rad]."""
_PENALTY = 100.0
_HOMOTOPY = 8


@dataclass(frozen=True)
class ExcitingMotion:
    """A designed motion.

    Attributes:
        scene: the scene with the motion.
        base: the parameters that it determines.
        condition: of the regressor with columns of length one.
        deviation: standard deviations of the base parameters for 1 N m of noise in each of 1000
            samples a second, shape (b,).

    """

    scene: Scene
    base: BaseParameters
    condition: float
    deviation: Array

    def table(self) -> str:
        """Return the base parameters with their standard deviations, as text."""
        lines = [f"condition number {self.condition:.3g} (columns of length one)"]
        lines += ["", f"{'std. dev. at 1 N m':>19}  base parameter"]
        rows = zip(self.deviation, self.base.labels, strict=True)
        lines += [f"{deviation:19.3g}  {label}" for deviation, label in rows]
        return "\n".join(lines) + "\n"


def design(
    scene: Scene,
    requested: Iterable[str] | None = None,
    *,
    duration: float = 6.0,
    harmonics: int = 5,
    iterations: int = 60,
    seed: int = 0,
) -> ExcitingMotion:
    """Design a motion about the initial pose of a scene that determines parameters well.

    Args:
        scene: the manipulator, with values as good as they are known.
        requested: the parameters, see `identify`.
        duration: of the motion [s].
        harmonics: of the series, 3 or more.
        iterations: of the optimisation.
        seed: of the first guess.

    Raises:
        InputError: an argument is not allowed.
        MotionRefused: no motion about the initial pose keeps within the limits.

    """
    problems = []
    if not (np.isfinite(duration) and duration >= 0.1):
        problems.append(Problem("duration", duration, "must be a number >= 0.1 [s]"))
    if not 3 <= harmonics <= 30:
        problems.append(Problem("harmonics", harmonics, "must be from 3 to 30"))
    if problems:
        raise InputError("identify design", problems)
    series = FourierSeries(duration, harmonics, np.array(scene.initial.gamma))
    cost = _Cost(scene, parameters.select_names(scene, requested), series)
    free = np.random.default_rng(seed).normal(size=series.size)
    free *= _FIRST / np.abs(series.at(free, series.times)[0] - series.centre).max()
    found = minimize(cost, free, method="L-BFGS-B", options={"maxiter": iterations}).x
    for _ in range(40):
        designed = _write_scene(scene, series, found)
        plan = examine_motion(reference_motion(designed), designed)
        if not plan.problems and cost.violation(found) <= 0.0:
            return cost.result(designed, found)
        found = 0.95 * found
    room = Problem("initial.gamma", scene.initial.gamma, "leaves no room for a motion about it")
    raise MotionRefused("identify design", plan.problems or [room])


class FourierSeries:
    """Angles of three actuators as functions of free numbers.

    Args:
        duration: of the motion [s].
        harmonics: of the series.
        centre: angles at both ends [rad], shape (3,).

    Attributes:
        size: number of the free numbers.
        times: samples [s], POINTS in a period of the highest harmonic, shape (n,).

    """

    def __init__(self, duration: float, harmonics: int, centre: Array) -> None:
        self.duration, self.centre = duration, centre
        n = np.arange(1, harmonics + 1)
        self._frequency = 2.0 * np.pi * n / duration
        rest = np.zeros((3, 2 * harmonics))  # gamma, gamma_dot, gamma_ddot at the beginning
        rest[0, harmonics:], rest[1, :harmonics], rest[2, harmonics:] = 1.0, n, n * n
        self._basis = null_space(rest)
        self.size = 3 * self._basis.shape[1]
        count = POINTS * harmonics
        self.times = np.arange(1, count + 1) * duration / count

    def at(self, free: Array, t: Array) -> tuple[Array, Array, Array]:
        """Angles [rad] and two derivatives at the times t [s], each shape (len(t), 3)."""
        sine, cosine = np.split(self._basis @ free.reshape(-1, 3), 2)
        w = self._frequency
        s, c = np.sin(np.outer(t, w)), np.cos(np.outer(t, w))
        return (
            self.centre + s @ sine + c @ cosine,
            (c * w) @ sine - (s * w) @ cosine,
            -(s * w * w) @ sine - (c * w * w) @ cosine,
        )


class _Cost:
    """What the optimisation minimises."""

    def __init__(self, scene: Scene, names: tuple[str, ...], series: FourierSeries) -> None:
        self._scene, self._series = scene, series
        self._regressor = Regressor(scene, names)
        self._base = find_base_parameters(self._regressor)
        self._values = parameters.values(scene, names)
        self._geometry = Geometry.of(scene)
        self._rates = ActuatorSpaceMap(self._geometry).star_rates
        x, y, z, w = initial_state(scene, self._geometry)[:4]
        self._start = rotation_matrix((x, y, z, w))
        if not self._base.chosen:
            allowed = "must determine something: no torque depends on these parameters"
            raise InputError("identify design", [Problem("parameters", list(names), allowed)])

    def __call__(self, free: Array) -> float:
        """Cost of free numbers of the series."""
        columns, excess = self._states(free)
        values = self._spread(columns)
        log_deviation = -0.5 * float(np.mean(np.log(np.maximum(values[1], 1e-300))))
        return float(np.log(values[0])) + log_deviation + _PENALTY * float(np.sum(excess**2))

    def violation(self, free: Array) -> float:
        """Return the largest excess over a limit, as a share of its range."""
        return float(self._states(free)[1].max())

    def result(self, designed: Scene, free: Array) -> ExcitingMotion:
        """Return the design with its condition and standard deviations."""
        columns, _ = self._states(free)
        matrix = columns.reshape(-1, columns.shape[-1])
        samples = 1000.0 * self._series.duration / len(columns)
        covariance = np.linalg.inv(matrix.T @ matrix * samples)
        condition = self._spread(columns)[0]
        return ExcitingMotion(designed, self._base, condition, np.sqrt(np.diag(covariance)))

    def _spread(self, columns: Array) -> tuple[float, Array]:
        """Condition with columns of length one, and the eigenvalues of the information."""
        matrix = columns.reshape(-1, columns.shape[-1])
        lengths = np.linalg.norm(matrix, axis=0)
        condition = min(float(np.linalg.cond(matrix / np.maximum(lengths, 1e-300))), 1e15)
        return condition, np.asarray(np.linalg.svd(matrix, compute_uv=False) ** 2)

    def _states(self, free: Array) -> tuple[Array, Array]:
        """Regressor of the base parameters, and excesses over the limits where positive."""
        gamma, rate, acceleration = self._series.at(free, self._series.times)
        rotation = self._rotations(gamma)
        quaternion = np.asarray(quaternion_of(rotation))
        with np.errstate(all="ignore"):
            star = np.stack(self._rates(*quaternion.T, *rate.T, *acceleration.T), axis=1)
            known, columns = self._regressor(quaternion, star[:, :3], star[:, 3:])
        torque = known + columns @ self._values
        excess = np.concatenate(list(self._excesses(gamma, rate, acceleration, rotation, torque)))
        if not (np.all(np.isfinite(columns)) and np.all(np.isfinite(excess))):
            return np.ones_like(self._base.of_columns(columns)), np.array([1e3])
        return self._base.of_columns(columns), np.maximum(excess, 0.0)

    def _excesses(
        self, gamma: Array, rate: Array, acceleration: Array, rotation: Array, torque: Array
    ) -> Iterable[Array]:
        """Yield how far numbers lie beyond SHARE of their range, over the range."""
        geometry, actuators = self._geometry, self._scene.actuators
        r = kinematics.carriage_directions(geometry, gamma)
        mu, beta, det_j2, _ = kinematics.describe_assemblies(geometry, r, rotation)
        for values, high in ((gamma, geometry.arc), (beta, np.full(3, geometry.beta_max))):
            yield (np.abs(values / high - 0.5) - 0.5 * SHARE).ravel()
        yield (LEAST_SINE - np.sin(mu)).ravel()
        yield LEAST_SINE - np.abs(det_j2)
        if actuators is not None:
            for values, limit in (
                (torque, actuators.torque_limit),
                (rate, actuators.velocity_limit),
                (acceleration, actuators.acceleration_limit),
            ):
                if limit is not None:
                    yield (np.abs(values) / limit - SHARE).ravel()

    def _rotations(self, gamma: Array) -> Array:
        """R at each sample, followed from the centre along straight lines, all at once."""
        rotation = np.broadcast_to(self._start, (len(gamma), 3, 3))
        for part in np.linspace(0.0, 1.0, _HOMOTOPY + 1)[1:]:
            here = self._series.centre + part * (gamma - self._series.centre)
            r = kinematics.carriage_directions(self._geometry, here)
            for _ in range(5 if part == 1.0 else 2):
                t = self._geometry.e @ np.swapaxes(rotation, -1, -2)
                slope = cross(t, r) + 1e-12 * np.eye(3)  # no exception at a singularity
                step = np.linalg.solve(slope, -np.sum(r * t, axis=-1)[..., None])[..., 0]
                rotation = rotate(rotation, np.clip(step, -0.5, 0.5))
        return np.asarray(rotation)


def _write_scene(scene: Scene, series: FourierSeries, free: Array) -> Scene:
    """Return the scene with the motion as waypoints, quintic between them."""
    names = ("gamma", "gamma_dot", "gamma_ddot")
    points = [
        {"time": time, **dict(zip(names, row, strict=True))}
        for time, *row in zip(series.times, *series.at(free, series.times), strict=True)
    ]
    points[-1] |= dict.fromkeys(names[1:], (0.0, 0.0, 0.0))
    return scene.with_values(
        {
            "initial.gamma_dot": 0.0,
            "torque": None,
            "motion": {"waypoints": points},
            "duration": series.duration,
            "provenance.motion": "designed to identify parameters: Fourier series",
        }
    )
