# SPDX-License-Identifier: Apache-2.0
"""States of a trajectory between its samples: integrated from the sample before."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from sst_ros.dynamics.traced_dynamics import Dynamics
from sst_ros.integration.applied_torque import StateFeedback
from sst_ros.scene.scene import Scene
from sst_ros.simulation.sampled_motion import Array, SampledMotion
from sst_ros.simulation.torque import ConstantTorque, FeedbackFunction, TorqueProfile

_ACCURACY = 1e-13
"""Error of a step; gaps between samples are short, so that steps do not add up."""


def integrated(trajectory: SampledMotion, times: Array) -> Array:
    """States (quaternion, body rate, acting torque) at times [s] inside, shape (m, 10)."""
    if trajectory.dense is not None:
        states = trajectory.dense(times)
        if states.shape[1] > 7 or not isinstance(trajectory.law, TorqueProfile):
            return states
        limit = _torque_limit(trajectory.scene)
        return np.hstack([states, np.clip(trajectory.law.values(times), -limit, limit)])
    samples = np.hstack([trajectory.quaternion, trajectory.body_rate, trajectory.torque])
    before = np.searchsorted(trajectory.t, times, side="right") - 1
    found = samples[before]
    gap = _Gap(trajectory)
    for k in np.unique(before[times > trajectory.t[before]]):
        rows = np.flatnonzero((before == k) & (times > trajectory.t[k]))
        order = rows[np.argsort(times[rows], kind="stable")]
        found[order] = gap.states(int(k), samples[k], times[order])
    return found


def _torque_limit(scene: Scene) -> float:
    limit = scene.actuators.torque_limit if scene.actuators else None
    return np.inf if limit is None else limit


class _Gap:
    """Integrates from a sample towards the next one."""

    def __init__(self, trajectory: SampledMotion) -> None:
        scene = trajectory.scene
        self._dynamics = Dynamics.of(scene)
        self._t, self._torque, self._law = trajectory.t, trajectory.torque, trajectory.law
        self._limit = _torque_limit(scene)
        self._more = (0.0,) * (len(self._dynamics.drive) - 3)

    def states(self, k: int, sample: Array, times: Array) -> Array:
        """States at ascending times between sample k and the next, shape (m, 10)."""
        from scipy.integrate import solve_ivp

        size = len(self._dynamics.state)
        t, y, found = float(self._t[k]), sample[:size], []
        for end, torque in self._pieces(k, t, float(times[-1])):
            here = times[(times > t) & (times <= end)]
            slope = self._slope(torque)
            solved = solve_ivp(
                slope, (t, end), y, "DOP853", rtol=_ACCURACY, atol=_ACCURACY,
                t_eval=np.unique([*here, end]), first_step=min(end - t, 1e-2),
            )  # fmt: skip
            states = solved.y.T
            states[:, :4] /= np.linalg.norm(states[:, :4], axis=1)[:, None]
            acting = states[:, 7:10]
            if size == 7:
                acting = np.array([torque(s, x) for s, x in zip(solved.t, states, strict=True)])
            rows = np.searchsorted(solved.t, here)
            found.append(np.hstack([states[:, :7], acting])[rows])
            t, y = end, solved.y[:, -1]
        return np.vstack(found)

    def _pieces(
        self, k: int, begin: float, end: float
    ) -> list[tuple[float, Callable[[float, Array], Array]]]:
        """List the ends of the pieces with a smooth torque, and the clamped torque there."""
        law = self._law
        if law is None:
            held = self._torque[k + 1]
            return [(end, lambda t, y: held)]
        if not isinstance(law, TorqueProfile):
            return [(end, self._feedback(law))]
        breaks = law.breaks()
        ends = [*breaks[(breaks > begin) & (breaks < end)].tolist(), end]
        return [
            (stop, self._limited(law.between(start, stop)))
            for start, stop in zip([begin, *ends], ends, strict=False)
        ]

    def _limited(self, torque: Callable[[float], Sequence[float]]) -> Callable[..., Array]:
        if isinstance(torque, ConstantTorque):
            constant = np.clip(torque.torque, -self._limit, self._limit)
            return lambda t, y: constant
        return lambda t, y: np.clip(torque(t), -self._limit, self._limit)

    def _feedback(self, function: FeedbackFunction) -> Callable[[float, Array], Array]:
        torque = StateFeedback(function, self._dynamics)
        return lambda t, y: np.clip(torque(t, y.tolist()), -self._limit, self._limit)

    def _slope(self, torque: Callable[[float, Array], Array]) -> Callable[[float, Array], Array]:
        def slope(t: float, y: Array) -> Array:
            return np.array(self._dynamics.derivative(*y.tolist(), *torque(t, y), *self._more))

        return slope
