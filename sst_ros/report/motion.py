# SPDX-License-Identifier: Apache-2.0
"""The equations of motion of a scene, integrated with fixed steps: the reference's own way."""

from __future__ import annotations

import math
from collections.abc import Sequence

from sst_ros.control.torque import Profile
from sst_ros.integration.explicit import ExplicitMethod
from sst_ros.integration.tableaux import DOP853
from sst_ros.limits import limits_of
from sst_ros.mechanism import kernel
from sst_ros.mechanism.geometry import Geometry
from sst_ros.report import states
from sst_ros.report.rows import NANOSECONDS
from sst_ros.report.states import Vector
from sst_ros.scene import Scene

METHOD = ExplicitMethod(DOP853)

TOUCHING = 1e-12
"""An actuator that is farther beyond its end than this [rad] has hit it."""


class Motion:
    """Motion of a scene up to its next impact.

    Attributes:
        model: constants of the dynamics.
        size: number of numbers in a state.
        impacts: how often `advance` met one.

    """

    def __init__(self, scene: Scene) -> None:
        self.model = kernel.model_of(scene)
        self.size = 10 if states.lags(scene) else 7
        self.impacts = 0
        limit = scene.actuators.torque_limit if scene.actuators else None
        self._limit = math.inf if limit is None else limit
        every = limits_of(scene, Geometry.of(scene))
        self._rigid = [end for end in every if end.error is None]

    def advance(
        self,
        torque: Profile,
        moment: Sequence[float] | None,
        start_ns: int,
        end_ns: int,
        y: Vector,
        steps: int,
    ) -> Vector | None:
        """Integrate from start to end; None where there is an impact or no finite continuation."""
        external = None if moment is None else (moment[0], moment[1], moment[2])

        def rates(t: float, y: Vector) -> kernel.State:
            first, second, third = (min(max(tau, -self._limit), self._limit) for tau in torque(t))
            return kernel.derivative(self.model, y, (first, second, third), external)

        start, h = start_ns / NANOSECONDS, (end_ns - start_ns) / NANOSECONDS / steps
        try:
            for step in range(steps):
                y = METHOD.step(rates, start + step * h, y, h).y
                if self._rigid and self._hits(y):
                    self.impacts += 1
                    return None
        except (ArithmeticError, ValueError):
            return None
        return y if all(map(math.isfinite, y)) else None

    def _hits(self, y: Vector) -> bool:
        joints = kernel.joints(self.model, y)
        angles = (*joints.gamma, *joints.mu, *joints.beta)
        return any(end.margin(angles) < -TOUCHING for end in self._rigid)
