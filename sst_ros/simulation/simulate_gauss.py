# SPDX-License-Identifier: Apache-2.0
"""Motions by Gauss collocation: whole and smooth, under a profile that can be traced."""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np

from sst_ros.integration.gauss import NODES
from sst_ros.integration.gauss_motion import GaussMotion, NotSmooth
from sst_ros.scene.loads import SineTorque
from sst_ros.scene.scene import Scene
from sst_ros.simulation.simulation import Simulation
from sst_ros.simulation.torque_profile import ConstantTorque, SineProfile
from sst_ros.simulation.trajectory import Trajectory
from sst_ros.state import NANOSECONDS, clamp

_FINEST_PER_SECOND, _FINEST = 1024, 4096
"""Steps a second beyond which `auto` turns to methods with error control, and the most of all."""


class CollocatedMotion:
    """A motion by collocation, prepared once.

    Args:
        scene: what moves.
        law: torques that act.
        span: length of the motion [ns].
        period: control period [ns]; None where torques are not held.
        tolerance: largest error estimate at the end [rad].
        asked: the caller has chosen this method: compile it, and try hard.

    Raises:
        NotSmooth: the motion is not one for collocation; gives the reason.

    """

    def __init__(
        self, scene: Scene, law: Any, span: int, period: int | None, tolerance: float, asked: bool
    ) -> None:
        torque = _traced(scene, law, period)
        state = Simulation(scene).state
        lag = scene.actuators is not None and scene.actuators.time_constant is not None
        start = [*state.quaternion, *state.body_rate, *((0.0,) * 3 if lag else ())]
        duration = span / NANOSECONDS
        finest = _FINEST if asked else min(_FINEST, round(16 + _FINEST_PER_SECOND * duration))
        self._motion = motion = GaussMotion(
            scene, torque, start, duration, tolerance, compiled=asked or None, finest=finest
        )
        self._scene, self._lag = scene, lag
        self._start = np.array([start])
        self._end, self._ending = duration, motion.ending
        status, message = 0, "reached the end"
        if self._ending is not None:
            self._end = float(motion.grid[self._ending.step]) + self._ending.time
            status = 1
            message = f"stopped at t = {self._end:.12f} s: {self._ending.limit.reason}"
        chosen = "" if asked else " (auto: a smooth motion under a profile)"
        # Read-only, so that all trajectories share them.
        self._times, self._torques = motion.grid.copy(), motion.torque(motion.grid)
        self._times.flags.writeable = self._torques.flags.writeable = False
        self._of_the_run: dict[str, Any] = {
            "status": status,
            "message": message,
            "method": f"gauss, order {2 * NODES}: {motion.count} steps of {motion.h:.3g} s, "
            f"{motion.iterations} iterations{chosen}",
            "error_estimate": motion.error,
            "evaluations": motion.evaluations,
            "step": motion.h,
            "law": law,
            "energy_residual": partial(motion.energy_residual, self._end),
            "dense": motion.at,
        }

    def trajectory(self, times: np.ndarray | None) -> Trajectory:
        """Compute the motion; times [ns] of the samples, None for the ends of the steps."""
        t = self._times if times is None else times / NANOSECONDS
        if times is None and self._ending is None:
            y = np.concatenate([self._start, self._motion.run()])
        else:
            if self._ending is not None:
                t = np.append(t[t < self._end], self._end)
            y = self._motion.at(t)
        torque = y[:, 7:10]
        if not self._lag:
            torque = self._torques if t is self._times else self._motion.torque(t)
        return Trajectory(self._scene, t, y[:, :4], y[:, 4:7], torque, **self._of_the_run)


def _traced(scene: Scene, law: Any, period: int | None) -> SineTorque | tuple[float, float, float]:
    """Return the torque that is traced into the code, or three that are constant.

    Raises:
        NotSmooth: there is none, or the scene has jumps.

    """
    limit = scene.actuators.torque_limit if scene.actuators else None
    if period is not None or not isinstance(law, (SineProfile, ConstantTorque)):
        raise NotSmooth("collocation takes constant torques and sines only")
    if scene.stroke.at_end not in ("stop", "ignore"):
        raise NotSmooth(f"collocation does not take a stroke with at_end: {scene.stroke.at_end}")
    if isinstance(law, ConstantTorque):
        return clamp(law.torque, limit)
    if limit is not None and max(map(abs, law.sine.amplitude)) > limit:
        raise NotSmooth("collocation does not take a sine that the torque limit cuts")
    return law.sine
