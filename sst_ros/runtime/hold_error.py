# SPDX-License-Identifier: Apache-2.0
"""Error of the orientation that comes from holding torques, estimated from how they change.

A torque tau(t_k) held over a period T acts, on average, T / 2 late: the angular acceleration lacks
A tau' T / 2, where A turns torques into body accelerations (`sampled_data` derives it). Integrated
twice with the present A, the orientation is off by A (T / 2) times the integral of tau - tau(0).
Of the torque of the middle of the hold the second order is left: the rate lacks T^2 tau'' / 24 a
period, and the orientation moves T^3 tau' / 12 too little in each of 1 / T periods, together
A (T^2 / 24) (tau - tau(0) + t tau'(0)). Both leave out that A changes and that the motion responds
to its own error: they are estimates of the size.
"""

from __future__ import annotations

import math

from sst_ros.scene.loads import SineTorque
from sst_ros.simulation.simulation import Simulation, Triple


class HeldTorques:
    """Sums over the torques of a run that its hold error is estimated from."""

    def __init__(self) -> None:
        self.clear()

    def clear(self) -> None:
        """Forget the torques."""
        self._first: Triple | None = None
        self._second: Triple | None = None
        self._last: Triple | None = None
        self._impulse = [0.0, 0.0, 0.0]
        self._seconds = self._held = 0.0
        self._changes = 0

    def add(self, torque: Triple | SineTorque, seconds: float) -> None:
        """Add torques [N m] that were held for some time [s]; a sine is not held."""
        if torque is not self._last and torque != self._last:
            if isinstance(torque, SineTorque):
                return
            self._sum()
            self._changes += 1
            self._last = torque
            if self._first is None:
                self._first = torque
            elif self._second is None:
                self._second = torque
        self._held += seconds

    def _sum(self) -> None:
        """Add what the last torque has done."""
        if self._last is not None:
            self._seconds += self._held
            self._impulse = [
                p + torque * self._held for p, torque in zip(self._impulse, self._last, strict=True)
            ]
            self._held = 0.0

    def errors(self, simulation: Simulation) -> tuple[float, float] | None:
        """Estimated errors of the orientation [rad]: torques of the start, and of the middle.

        None where fewer than two torques were held, or where the torques of the actuators lag.
        """
        self._sum()
        first, second, last = self._first, self._second, self._last
        lags = len(simulation.dynamics.state) > 7
        if first is None or second is None or last is None or lags:
            return None
        period = self._seconds / self._changes
        count = self._seconds / period
        late = [p - a * self._seconds for p, a in zip(self._impulse, first, strict=True)]
        lost = [c - a + count * (b - a) for a, b, c in zip(first, second, last, strict=True)]
        return (
            0.5 * period * _acceleration(simulation, late),
            period**2 / 24.0 * _acceleration(simulation, lost),
        )


def _acceleration(simulation: Simulation, torque: list[float]) -> float:
    """Norm of the change of the body acceleration by a change of the torques."""
    state, dynamics = simulation.state, simulation.dynamics
    y, rest = (*state.quaternion, *state.body_rate), (0.0,) * (len(dynamics.drive) - 3)
    with_torque = dynamics.derivative(*y, *torque, *rest)[4:7]
    without = dynamics.derivative(*y, 0.0, 0.0, 0.0, *rest)[4:7]
    return math.dist(with_torque, without)
