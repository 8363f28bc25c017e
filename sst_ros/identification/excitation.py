# SPDX-License-Identifier: Apache-2.0
"""Exciting motions of the actuators, which make parameters well determined.

The motion is a Fourier series that begins and ends at rest,

    gamma_k(t) = c_k + sum over n of a_nk sin(n w t) + b_nk cos(n w t), w = 2 pi /
    duration

(Swevers, Ganseman, Tukel, De Schutter and Van Brussel, IEEE Trans. Robotics Autom. 13
(1997) 730-740). The coefficients are taken from the subspace in which gamma = c and
gamma_dot = gamma_ddot = 0 at both ends. They minimise

    log condition number + mean log standard deviation

of the base parameters at equal noise, with quadratic penalties beyond a share of the
limits: stroke, workspace, singularities, torque, rate and acceleration of the
actuators.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.linalg import null_space
from scipy.optimize import minimize

from sst_ros.control.actuator_space import ActuatorSpaceMap
from sst_ros.control.plan import examine_motion
from sst_ros.control.reference_motions import reference_motion
from sst_ros.dynamics.initial_state import initial_state
from sst_ros.errors import MotionRefused, Problem, refuse_unless
from sst_ros.identification import parameters
from sst_ros.identification.parameters import (
    BaseParameters,
    Regressor,
    find_base_parameters,
)
from sst_ros.mechanism.geometry import Array, Geometry
from sst_ros.scene.scene import Scene
from sst_ros.scene.yaml_document import values_at
from sst_ros.state import QUATERNION, ZERO

# samples, and points of the scene, in a period of the highest harmonic
POINTS_A_PERIOD = 12
# of each range that the motion may use: the manipulator is not quite its model
RANGE_SHARE = 0.9
LEAST_SINE = 0.15  # of mu_k, and det J2: torques and rates grow with their inverse
_FIRST_AMPLITUDE = 0.05  # amplitude of the first guess [rad]
_PENALTY = 100.0  # weight of squared excesses over limits against the logarithms
_SMALLER = 0.95  # factor by which a motion beyond a limit is made smaller
_MOST_REDUCTIONS = 40  # then the motion has an eighth of its size
_SAMPLE_RATE = 1000.0  # [1/s], to which standard deviations refer
_HOMOTOPY = 8  # steps from the centre to all samples
_HOMOTOPY_NEWTON_STEPS = 2  # after each of them, which the next one corrects
_LAST_NEWTON_STEPS = 5  # after the last: to rounding
_LARGEST_CONDITION = 1e15  # beyond which a condition number is rounding
_EXCESS_WITHOUT_ASSEMBLY = 1e3  # excess of a motion that no assembly has


@dataclass(frozen=True)
class ExcitingMotion:
    """A designed motion.

    Attributes:
        scene: the scene with the motion.
        base: the parameters that it determines.
        condition: of the regressor with columns of length one.
        deviation: standard deviations of the base parameters for 1 N m of noise in each
            of 1000 samples a second, shape (b,).

    """

    scene: Scene
    base: BaseParameters
    condition: float
    deviation: Array

    def table(self) -> str:
        """Return the base parameters with their standard deviations, as text."""
        condition = f"condition number {self.condition:.3g} (columns of length one)"
        rows = zip(self.deviation, self.base.labels, strict=True)
        lines = [f"{deviation:19.3g}  {label}" for deviation, label in rows]
        return "\n".join(
            [condition, "", f"{'std. dev. at 1 N m':>19}  base parameter", *lines, ""]
        )


def design(
    scene: Scene,
    requested: Iterable[str] | None = None,
    *,
    duration: float = 6.0,
    harmonics: int = 5,
    iterations: int = 60,
    seed: int = 0,
) -> ExcitingMotion:
    """Design a motion that determines the parameters of a scene well.

    The motion is about the initial pose of the scene.

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
    refuse_unless(
        "identify design",
        ("duration", duration, 0.1 <= duration < np.inf, "must be a number >= 0.1 [s]"),
        ("harmonics", harmonics, 3 <= harmonics <= 30, "must be from 3 to 30"),
    )
    names = parameters.select_names(scene, requested)
    trial = _Trial(scene, names, duration, harmonics)
    first = np.random.default_rng(seed).normal(size=trial.size)
    first_gamma, _, _ = trial.series(first)
    first *= _FIRST_AMPLITUDE / np.abs(first_gamma - trial.centre).max()
    coefficients = minimize(
        trial.cost, first, method="L-BFGS-B", options={"maxiter": iterations}
    ).x
    for _ in range(_MOST_REDUCTIONS):
        designed = trial.scene_of(coefficients)
        plan = examine_motion(reference_motion(designed), designed)
        columns, excess = trial.evaluate(coefficients)
        if not plan.problems and excess.max() <= 0.0:
            samples = _SAMPLE_RATE * duration / len(trial.times)  # for each of these
            information = columns.T @ columns * samples
            deviation = np.sqrt(np.diag(np.linalg.inv(information)))
            return ExcitingMotion(designed, trial.base, _condition(columns), deviation)
        coefficients = _SMALLER * coefficients
    room = Problem(
        "initial.gamma", scene.initial.gamma, "leaves no room for a motion about it"
    )
    raise MotionRefused("identify design", plan.problems or [room])


class _Trial:
    """Fourier series of free coefficients, and how far they determine `base`.

    The series are about `centre`, at `times`. `base` are the parameters that some
    motion of the scene determines; samples are POINTS_A_PERIOD in a period of the
    highest harmonic, n of them. There are `size` coefficients.
    """

    def __init__(
        self, scene: Scene, names: Sequence[str], duration: float, harmonics: int
    ) -> None:
        self._regressor = Regressor(scene, names)
        self.base = find_base_parameters(self._regressor)
        requirement = "must determine something: no torque depends on these parameters"
        determined = "parameters", list(names), bool(self.base.chosen), requirement
        refuse_unless("identify design", determined)
        self._scene = scene
        self._values = parameters.values(scene, names)
        self._space = ActuatorSpaceMap(Geometry.of(scene))
        start = initial_state(scene, self._space.geometry)
        self._start = np.array(start[QUATERNION])
        self.centre = np.array(scene.initial.gamma)
        samples = POINTS_A_PERIOD * harmonics
        self.times = np.arange(1, samples + 1) * duration / samples
        orders: Array = np.arange(1.0, harmonics + 1.0)
        frequencies = 2.0 * np.pi * orders / duration  # [rad/s]
        basis = _rest_basis(orders)
        self.size = 3 * basis.shape[1]
        phases = np.outer(self.times, frequencies)
        sine = np.sin(phases)
        cosine = np.cos(phases)
        derivatives = (
            [sine, cosine],
            [cosine * frequencies, -sine * frequencies],
            [-sine * frequencies * frequencies, -cosine * frequencies * frequencies],
        )
        self._maps = [np.hstack(terms) @ basis for terms in derivatives]

    def series(self, coefficients: Array) -> tuple[Array, Array, Array]:
        """Angles [rad] and two derivatives at the samples, each shape (n, 3)."""
        of_legs = coefficients.reshape(-1, 3)
        gamma, rate, acceleration = (linear_map @ of_legs for linear_map in self._maps)
        return self.centre + gamma, rate, acceleration

    def scene_of(self, coefficients: Array) -> Scene:
        """Return the scene with the motion as waypoints; it ends at rest."""
        points: list[dict[str, Any]] = []
        series = self.series(coefficients)
        for time, gamma, rate, acceleration in zip(self.times, *series, strict=True):
            point = {
                "time": time,
                "gamma": gamma,
                "gamma_dot": rate,
                "gamma_ddot": acceleration,
            }
            points.append(point)
        points[-1] |= {"gamma_dot": ZERO, "gamma_ddot": ZERO}
        return self._scene.with_values(
            {
                "initial.gamma_dot": 0.0,
                "torque": None,
                "provenance.motion": "designed to identify parameters: Fourier series",
                "motion": {"waypoints": points},
                "duration": self.times[-1],
            }
        )

    def cost(self, coefficients: Array) -> float:
        """Return what the optimisation minimises."""
        columns, excess = self.evaluate(coefficients)
        information = np.linalg.svd(columns, compute_uv=False) ** 2
        log_deviation = -0.5 * float(np.mean(np.log(np.maximum(information, 1e-300))))
        penalty = _PENALTY * float(np.sum(excess**2))
        return float(np.log(_condition(columns))) + log_deviation + penalty

    def evaluate(self, coefficients: Array) -> tuple[Array, Array]:
        """Return the regressor of the base parameters, and excesses over limits.

        The regressor of b base parameters has the shape (3 n, b).
        """
        gamma, rate, acceleration = self.series(coefficients)
        with np.errstate(all="ignore"):
            quaternion = self._orientations(gamma)
            motion = *quaternion.T, *rate.T, *acceleration.T
            star = np.stack(self._space.star_accelerations(*motion), axis=1)
            body_rate, body_acceleration = np.split(star, 2, axis=1)
            known, columns = self._regressor(quaternion, body_rate, body_acceleration)
            torque = known + columns @ self._values
            reached = {"torque": torque, "velocity": rate, "acceleration": acceleration}
            excess = self._find_excess(gamma, quaternion, reached)
        columns = columns[..., self.base.chosen].reshape(-1, len(self.base.chosen))
        if not (np.all(np.isfinite(columns)) and np.all(np.isfinite(excess))):
            return np.ones_like(columns), np.array([_EXCESS_WITHOUT_ASSEMBLY])
        return columns, np.maximum(excess, 0.0)

    def _orientations(self, gamma: Array) -> Array:
        """Return quaternions (n, 4) at gamma (n, 3).

        All samples go from the centre along straight lines at once.
        """
        quaternion = np.tile(self._start, (len(gamma), 1))
        for share in np.linspace(0.0, 1.0, _HOMOTOPY + 1)[1:]:
            angles = self.centre + share * (gamma - self.centre)
            steps = _LAST_NEWTON_STEPS if share == 1.0 else _HOMOTOPY_NEWTON_STEPS
            quaternion = self._space.orientations(quaternion, angles, steps)
        return quaternion

    def _find_excess(
        self, gamma: Array, quaternion: Array, reached: Mapping[str, Array]
    ) -> Array:
        """Return how far numbers lie beyond RANGE_SHARE of their range, over the range.

        `reached` has the quantities that actuators limit, shape (n, 3), by name.
        """
        posture = np.stack(self._space.postures(*quaternion.T), axis=1)
        sines, beta, det_j2 = np.split(posture, (3, 6), axis=1)  # of three legs each
        geometry = self._space.geometry
        excess = []
        for values, high in ((gamma, geometry.arc), (beta, geometry.beta_max)):
            excess.append(np.abs(values / high - 0.5) - 0.5 * RANGE_SHARE)
        excess.append(LEAST_SINE - np.hstack([sines, np.abs(det_j2)]))
        for name, values in reached.items():
            for limit in values_at(self._scene, f"actuators.{name}_limit"):
                excess.append(np.abs(values) / limit - RANGE_SHARE)
        return np.hstack(excess)


def _rest_basis(orders: Array) -> Array:
    """Return the coefficients of series that begin and end at rest in the centre.

    Their columns span all of them: coefficients of the sines, then of the cosines, for
    which gamma, gamma_dot and gamma_ddot are zero at time 0.
    """
    harmonics = len(orders)
    at_start = np.zeros((3, 2 * harmonics))
    gamma, gamma_dot, gamma_ddot = at_start  # in units of a base frequency of 1
    gamma[harmonics:] = 1.0
    gamma_dot[:harmonics] = orders
    gamma_ddot[harmonics:] = orders * orders
    return np.asarray(null_space(at_start))


def _condition(columns: Array) -> float:
    """Condition number with columns of length one, _LARGEST_CONDITION at most."""
    lengths = np.linalg.norm(columns, axis=0)
    scaled = columns / np.maximum(lengths, 1e-300)
    return min(float(np.linalg.cond(scaled)), _LARGEST_CONDITION)
