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
from sst_ros.identification.parameters import BaseParameters, Regressor, find_base_parameters
from sst_ros.mechanism.geometry import Array, Geometry
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
    series = _Series(duration, harmonics, np.array(scene.initial.gamma))
    cost = _Cost(scene, parameters.select_names(scene, requested), series)
    free = np.random.default_rng(seed).normal(size=series.size)
    free *= _FIRST / np.abs(series.at(free)[0] - series.centre).max()
    found = minimize(cost, free, method="L-BFGS-B", options={"maxiter": iterations}).x
    for _ in range(40):
        designed = _write_scene(scene, series, found)
        plan = examine_motion(reference_motion(designed), designed)
        columns, excess = cost.evaluate(found)
        if not plan.problems and excess.max() <= 0.0:
            # Of 1000 samples a second.
            information = columns.T @ columns * (1000.0 * duration / len(series.times))
            deviation = np.sqrt(np.diag(np.linalg.inv(information)))
            return ExcitingMotion(designed, cost.base, _condition(columns), deviation)
        found = 0.95 * found
    room = Problem("initial.gamma", scene.initial.gamma, "leaves no room for a motion about it")
    raise MotionRefused("identify design", plan.problems or [room])


class _Series:
    """Angles of three actuators as a Fourier series of free numbers.

    Attributes:
        centre: angles at both ends [rad], shape (3,).
        size: number of the free numbers.
        times: samples [s], POINTS in a period of the highest harmonic, shape (n,).

    """

    def __init__(self, duration: float, harmonics: int, centre: Array) -> None:
        self.centre = centre
        n = np.arange(1, harmonics + 1)
        rest = np.zeros((3, 2 * harmonics))  # gamma, gamma_dot, gamma_ddot at the beginning
        rest[0, harmonics:], rest[1, :harmonics], rest[2, harmonics:] = 1.0, n, n * n
        self._basis = null_space(rest)
        self.size = 3 * self._basis.shape[1]
        count = POINTS * harmonics
        self.times = np.arange(1, count + 1) * duration / count
        self._w = 2.0 * np.pi * n / duration
        self._s, self._c = (f(np.outer(self.times, self._w)) for f in (np.sin, np.cos))

    def at(self, free: Array) -> tuple[Array, Array, Array]:
        """Angles [rad] and two derivatives at the samples, each shape (n, 3)."""
        sine, cosine = np.split(self._basis @ free.reshape(-1, 3), 2)
        s, c, w = self._s, self._c, self._w
        return (
            self.centre + s @ sine + c @ cosine,
            (c * w) @ sine - (s * w) @ cosine,
            -(s * w * w) @ sine - (c * w * w) @ cosine,
        )


def _condition(columns: Array) -> float:
    """Condition number with columns of length one, 1e15 at most."""
    lengths = np.linalg.norm(columns, axis=0)
    return min(float(np.linalg.cond(columns / np.maximum(lengths, 1e-300))), 1e15)


class _Cost:
    """What the optimisation minimises, of the free numbers of a series."""

    def __init__(self, scene: Scene, names: tuple[str, ...], series: _Series) -> None:
        self._scene, self._series = scene, series
        self._regressor = Regressor(scene, names)
        self.base = find_base_parameters(self._regressor)
        self._values = parameters.values(scene, names)
        self._geometry = Geometry.of(scene)
        self._coordinates = ActuatorSpaceMap(self._geometry)
        self._start = np.array(initial_state(scene, self._geometry)[:4])
        if not self.base.chosen:
            allowed = "must determine something: no torque depends on these parameters"
            raise InputError("identify design", [Problem("parameters", list(names), allowed)])

    def __call__(self, free: Array) -> float:
        columns, excess = self.evaluate(free)
        information = np.linalg.svd(columns, compute_uv=False) ** 2
        log_deviation = -0.5 * float(np.mean(np.log(np.maximum(information, 1e-300))))
        penalty = _PENALTY * float(np.sum(excess**2))
        return float(np.log(_condition(columns))) + log_deviation + penalty

    def evaluate(self, free: Array) -> tuple[Array, Array]:
        """Return the regressor of b base parameters, shape (3 n, b), and excesses over limits."""
        gamma, rate, acceleration = self._series.at(free)
        with np.errstate(all="ignore"):
            quaternion = self._orientations(gamma)
            star = self._coordinates.star_rates(*quaternion.T, *rate.T, *acceleration.T)
            body = np.stack(star, axis=1)
            known, columns = self._regressor(quaternion, body[:, :3], body[:, 3:])
            torque = known + columns @ self._values
            posture = np.stack(self._coordinates.postures(*quaternion.T), axis=1)
        excess = np.concatenate(list(self._excesses(gamma, rate, acceleration, torque, posture)))
        columns = columns[..., self.base.chosen].reshape(-1, len(self.base.chosen))
        if not (np.all(np.isfinite(columns)) and np.all(np.isfinite(excess))):
            return np.ones_like(columns), np.array([1e3])
        return columns, np.maximum(excess, 0.0)

    def _excesses(
        self, gamma: Array, rate: Array, acceleration: Array, torque: Array, posture: Array
    ) -> Iterable[Array]:
        """Yield how far numbers lie beyond SHARE of their range, over the range."""
        geometry, actuators = self._geometry, self._scene.actuators
        sines, beta, det_j2 = posture[:, :3], posture[:, 3:6], posture[:, 6:]
        for values, high in ((gamma, geometry.arc), (beta, geometry.beta_max)):
            yield (np.abs(values / high - 0.5) - 0.5 * SHARE).ravel()
        yield LEAST_SINE - np.hstack([sines, np.abs(det_j2)]).ravel()
        for values, name in (
            (torque, "torque"),
            (rate, "velocity"),
            (acceleration, "acceleration"),
        ):
            if (limit := getattr(actuators, f"{name}_limit", None)) is not None:
                yield (np.abs(values) / limit - SHARE).ravel()

    def _orientations(self, gamma: Array) -> Array:
        """Quaternion at each sample, followed from the centre along straight lines, all at once."""
        found, centre = np.tile(self._start, (len(gamma), 1)), self._series.centre
        for part in np.linspace(0.0, 1.0, _HOMOTOPY + 1)[1:]:
            here = centre + part * (gamma - centre)
            found = self._coordinates.orientations(found, here, 5 if part == 1.0 else 2)
        return found


def _write_scene(scene: Scene, series: _Series, free: Array) -> Scene:
    """Return the scene with the motion as waypoints, quintic between them."""
    names = ("time", "gamma", "gamma_dot", "gamma_ddot")
    rows = zip(series.times, *series.at(free), strict=True)
    points = [dict(zip(names, row, strict=True)) for row in rows]
    points[-1] |= dict.fromkeys(names[2:], (0.0, 0.0, 0.0))
    return scene.with_values(
        {
            "initial.gamma_dot": 0.0,
            "torque": None,
            "motion": {"waypoints": points},
            "duration": series.times[-1],
            "provenance.motion": "designed to identify parameters: Fourier series",
        }
    )
