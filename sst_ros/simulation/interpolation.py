# SPDX-License-Identifier: Apache-2.0
"""States of a trajectory between its samples: propagated from the sample before."""

from __future__ import annotations

import numpy as np

from sst_ros.integration.adaptive_stepper import EvaluationBudget
from sst_ros.integration.applied_torque import StateFeedback, Torque
from sst_ros.integration.methods import DOP853
from sst_ros.integration.propagator import Propagator
from sst_ros.simulation.sampled_motion import Array, SampledMotion
from sst_ros.simulation.torque_profile import ConstantTorque, TorqueProfile

_ACCURACY = 1e-13
"""Error of a step; gaps between samples are short, so that steps do not add up."""


def integrated(trajectory: SampledMotion, times: Array) -> Array:
    """States (quaternion, body rate, acting torque) at times [s] inside, shape (m, 10)."""
    if trajectory.dense is not None:
        states = trajectory.dense(times)
        if states.shape[1] > 7 or not isinstance(trajectory.law, TorqueProfile):
            return states
        actuators = trajectory.scene.actuators
        limit = (actuators.torque_limit if actuators else None) or np.inf
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


class _Gap:
    """Propagates from a sample towards the next one."""

    def __init__(self, trajectory: SampledMotion) -> None:
        self._propagator = Propagator(
            trajectory.scene, DOP853.name, _ACCURACY,
            compiled=False, budget=EvaluationBudget(), limits=False,
        )  # fmt: skip
        self._t, self._torque, self._law = trajectory.t, trajectory.torque, trajectory.law

    def states(self, k: int, sample: Array, times: Array) -> Array:
        """States at ascending times between sample k and the next, shape (m, 10)."""
        propagator, dynamics = self._propagator, self._propagator.dynamics
        moment = (0.0,) * (len(dynamics.drive) - 3)
        at, t = propagator.begin(sample[: len(dynamics.state)].tolist()), float(self._t[k])
        found = []
        for end, asked in self._pieces(k, t, float(times[-1])):
            torque = propagator.torque.acting(asked)
            for time in (*times[(times > t) & (times < end)].tolist(), end):
                if time > t:
                    at, _ = propagator.advance(at, t, time - t, 1, torque, moment)
                    t = time
                    lagged = at.y[7:10] if len(dynamics.state) > 7 else None
                    acting = lagged or propagator.torque.at(torque, t, at.y)
                    found.append((t, *at.y[:7], *acting))
        states = np.array(found)
        return np.asarray(states[np.searchsorted(states[:, 0], times), 1:])

    def _pieces(self, k: int, begin: float, end: float) -> list[tuple[float, Torque]]:
        """List the ends of the pieces with a smooth torque, and the torque there."""
        law = self._law
        if law is None:
            first, second, third = self._torque[k + 1].tolist()
            return [(end, (first, second, third))]
        if not isinstance(law, TorqueProfile):
            return [(end, StateFeedback(law, self._propagator.dynamics))]
        breaks = law.breaks()
        ends = [*breaks[(breaks > begin) & (breaks < end)].tolist(), end]
        pieces = (law.between(*span) for span in zip([begin, *ends], ends, strict=False))
        return [
            (stop, piece.torque if isinstance(piece, ConstantTorque) else piece)
            for stop, piece in zip(ends, pieces, strict=True)
        ]
