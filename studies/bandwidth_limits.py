# SPDX-License-Identifier: Apache-2.0
"""The largest stable bandwidth of computed torque: simulated, beside sampled-data theory."""

from __future__ import annotations

import dataclasses

import numpy as np

from sst_ros.control.reference import Reference, ReferenceMotion
from sst_ros.scene.scene import Scene
from sst_ros.simulation.simulation import NANOSECONDS
from studies.control_loop import ControlLoop, run_loop
from studies.sampled_data import largest_stable, stability_limit

OFFSET = 1e-8
"""Error at the start [rad]: so small that the plant is linear around it."""

_TICKS, _TICKS_OF_DELAY = 600, 200
_FIRST, _FACTOR, _ACCURACY = 0.5, 1.15, 2e-3
_GONE, _LOST = 1e-3, 1e2 * OFFSET


class RestMotion(ReferenceMotion):
    """A motion that stays where another one begins."""

    def __init__(self, motion: ReferenceMotion, duration: float) -> None:
        super().__init__(duration, (0.0, duration))
        start, zero = motion.at(0.0), (0.0, 0.0, 0.0)
        self._pose = Reference(start.quaternion, zero, zero, start.gamma, zero, zero)

    def _inside(self, time: float) -> Reference:
        return self._pose


def ideal_plant(scene: Scene) -> Scene:
    """Return the plant of the theory: no friction, which acts between samples too, and no lag."""
    actuators = scene.actuators
    if actuators is not None:
        # A limit that is never met: actuators that change nothing are refused.
        actuators = dataclasses.replace(actuators, torque_limit=1e6, time_constant=None)
    return dataclasses.replace(scene, friction=None, actuators=actuators)


def bandwidth_in_theory(loop: ControlLoop) -> float:
    """Return the limit of the sampled double integrator, `stability_limit` [rad/s]."""
    limit = stability_limit(loop.settings.damping_ratio, loop.channel.delay)
    return limit * NANOSECONDS / loop.period_ns


def bandwidth_limit(loop: ControlLoop) -> float:
    """Find the largest stable bandwidth [rad/s] in mode computed_torque by bisection.

    The pose at the start of the motion is held at rest; the model is exact.
    """
    first = _FIRST * bandwidth_in_theory(loop)
    return largest_stable(lambda bandwidth: stable(loop, bandwidth), first, _FACTOR, _ACCURACY)


def stable(loop: ControlLoop, bandwidth: float) -> bool:
    """Return whether a small error is less in the last quarter of a run than in the second."""
    ticks = _TICKS + _TICKS_OF_DELAY * loop.channel.delay
    rest = RestMotion(loop.motion, ticks * loop.period_ns / NANOSECONDS)
    settings = dataclasses.replace(loop.settings, mode="computed_torque", bandwidth=bandwidth)
    held = dataclasses.replace(loop, motion=rest, settings=settings, offset=OFFSET, lost=_LOST)
    track, _, failure = run_loop(held)
    if failure:
        return False
    second, last = (
        float(np.sqrt(np.mean(track.error[part] ** 2)))
        for part in (slice(ticks // 4, ticks // 2), slice(3 * ticks // 4, None))
    )
    return last < max(second, _GONE * OFFSET)
