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

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

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

POINTS_A_PERIOD = (
    12  # samples, and points of the scene, in a period of the highest harmonic
)
# of each range that the motion may use: the manipulator is not quite its model
RANGE_SHARE = 0.9
LEAST_SINE = 0.15  # of mu_k, and det J2: torques and rates grow with their inverse
_FIRST_AMPLITUDE = 0.05  # amplitude of the first guess [rad]
_PENALTY = 100.0
_POINT = ("time", "gamma", "gamma_dot", "gamma_ddot")  # of a quintic between waypoints
_HOMOTOPY = 8  # steps from the centre to all samples


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
    free = np.random.default_rng(seed).normal(size=trial.size)
    free *= _FIRST_AMPLITUDE / np.abs(trial.series(free)[0] - trial.centre).max()
    found = minimize(
        trial.cost, free, method="L-BFGS-B", options={"maxiter": iterations}
    ).x
    origin = "designed to identify parameters: Fourier series"
    changes = {"initial.gamma_dot": 0.0, "torque": None, "provenance.motion": origin}
    for _ in range(40):
        rows = zip(trial.times, *trial.series(found), strict=True)
        points = [dict(zip(_POINT, row, strict=True)) for row in rows]
        points[-1] |= dict.fromkeys(_POINT[2:], (0.0, 0.0, 0.0))
        motion = {"motion": {"waypoints": points}, "duration": trial.times[-1]}
        designed = scene.with_values(changes | motion)
        plan = examine_motion(reference_motion(designed), designed)
        columns, excess = trial.evaluate(found)
        if not plan.problems and excess.max() <= 0.0:
            # Of 1000 samples a second.
            information = columns.T @ columns * (1000.0 * duration / len(trial.times))
            deviation = np.sqrt(np.diag(np.linalg.inv(information)))
            return ExcitingMotion(designed, trial.base, _condition(columns), deviation)
        found = 0.95 * found
    room = Problem(
        "initial.gamma", scene.initial.gamma, "leaves no room for a motion about it"
    )
    raise MotionRefused("identify design", plan.problems or [room])


class _Trial:
    """Fourier series of free numbers, and how far they determine `base`.

    The series are about `centre`, at `times`. `base` are the parameters that some
    motion of the scene determines; samples are POINTS_A_PERIOD in a period of the
    highest harmonic, n of them.
    """

    def __init__(
        self, scene: Scene, names: Sequence[str], duration: float, harmonics: int
    ) -> None:
        self._regressor = Regressor(scene, names)
        self.base = find_base_parameters(self._regressor)
        requirement = "must determine something: no torque depends on these parameters"
        found = "parameters", list(names), bool(self.base.chosen), requirement
        refuse_unless("identify design", found)
        self._scene, self._values = scene, parameters.values(scene, names)
        self._space = ActuatorSpaceMap(Geometry.of(scene))
        self._start = np.array(initial_state(scene, self._space.geometry)[:4])
        self.centre = np.array(scene.initial.gamma)
        self.times = (
            np.arange(1, POINTS_A_PERIOD * harmonics + 1)
            * duration
            / (POINTS_A_PERIOD * harmonics)
        )
        n = np.arange(1, harmonics + 1)
        # gamma, gamma_dot, gamma_ddot at the beginning
        at_rest = np.zeros((3, 2 * harmonics))
        at_rest[0, harmonics:], at_rest[1, :harmonics], at_rest[2, harmonics:] = (
            1.0,
            n,
            n * n,
        )
        basis, w = null_space(at_rest), 2.0 * np.pi * n / duration
        self.size = 3 * basis.shape[1]
        s, c = (f(np.outer(self.times, w)) for f in (np.sin, np.cos))
        derivatives = ([s, c], [c * w, -s * w], [-s * w * w, -c * w * w])
        self._maps = [np.hstack(harmonics_of) @ basis for harmonics_of in derivatives]

    def series(self, free: Array) -> tuple[Array, Array, Array]:
        """Angles [rad] and two derivatives at the samples, each shape (n, 3)."""
        gamma, rate, acceleration = (part @ free.reshape(-1, 3) for part in self._maps)
        return self.centre + gamma, rate, acceleration

    def cost(self, free: Array) -> float:
        """Return what the optimisation minimises."""
        columns, excess = self.evaluate(free)
        information = np.linalg.svd(columns, compute_uv=False) ** 2
        log_deviation = -0.5 * float(np.mean(np.log(np.maximum(information, 1e-300))))
        penalty = _PENALTY * float(np.sum(excess**2))
        return float(np.log(_condition(columns))) + log_deviation + penalty

    def evaluate(self, free: Array) -> tuple[Array, Array]:
        """Return the regressor of the base parameters, and excesses over limits.

        The regressor of b base parameters has the shape (3 n, b).
        """
        gamma, rate, acceleration = self.series(free)
        space, chosen = self._space, self.base.chosen
        with np.errstate(all="ignore"):
            # From the centre along straight lines, all samples at once.
            quaternion = np.tile(self._start, (len(gamma), 1))
            for part in np.linspace(0.0, 1.0, _HOMOTOPY + 1)[1:]:
                here = self.centre + part * (gamma - self.centre)
                quaternion = space.orientations(
                    quaternion, here, 5 if part == 1.0 else 2
                )
            moving = *quaternion.T, *rate.T, *acceleration.T
            star = np.stack(space.star_accelerations(*moving), axis=1)
            known, columns = self._regressor(quaternion, star[:, :3], star[:, 3:])
            torque = known + columns @ self._values
            posture = np.stack(space.postures(*quaternion.T), axis=1)
        sines, beta, det_j2 = posture[:, :3], posture[:, 3:6], posture[:, 6:]
        # How far numbers lie beyond RANGE_SHARE of their range, over the range.
        ranges = (gamma, space.geometry.arc), (beta, space.geometry.beta_max)
        excess = [
            np.abs(values / high - 0.5) - 0.5 * RANGE_SHARE for values, high in ranges
        ]
        excess.append(LEAST_SINE - np.hstack([sines, np.abs(det_j2)]))
        reached = {"torque": torque, "velocity": rate, "acceleration": acceleration}
        for name, values in reached.items():
            for limit in values_at(self._scene, f"actuators.{name}_limit"):
                excess.append(np.abs(values) / limit - RANGE_SHARE)
        beyond = np.hstack(excess)
        columns = columns[..., chosen].reshape(-1, len(chosen))
        if not (np.all(np.isfinite(columns)) and np.all(np.isfinite(beyond))):
            return np.ones_like(columns), np.array([1e3])
        return columns, np.maximum(beyond, 0.0)


def _condition(columns: Array) -> float:
    """Condition number with columns of length one, 1e15 at most."""
    lengths = np.linalg.norm(columns, axis=0)
    return min(float(np.linalg.cond(columns / np.maximum(lengths, 1e-300))), 1e15)
