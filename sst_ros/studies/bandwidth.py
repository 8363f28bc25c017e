# SPDX-License-Identifier: Apache-2.0
"""The largest stable bandwidth of computed torque: simulated, beside what the theory says."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np

from sst_ros.control.reference import Reference, ReferenceMotion
from sst_ros.scene.scene import Scene
from sst_ros.simulation import NANOSECONDS
from sst_ros.studies.control_loop import Loop, follow
from sst_ros.studies.sampled_data import first_lost, largest

OFFSET = 1e-8
"""Error at the start [rad]: so small that the plant is linear around it."""

_TICKS, _TICKS_OF_DELAY = 600, 200
_FIRST, _FACTOR, _ACCURACY = 0.5, 1.15, 2e-3
_GONE, _LOST = 1e-3, 1e2 * OFFSET


@dataclass(frozen=True)
class Limit:
    """Bandwidths below which computed torque with an exact model is stable [rad/s].

    Attributes:
        delay: samples by which commands are late.
        theory: of the sampled double integrator, `sampled.largest`.
        simulated: of the simulation, the pose at the start of the motion held at rest.

    """

    delay: int
    theory: float
    simulated: float


class Rest(ReferenceMotion):
    """A motion that stays where another one begins."""

    def __init__(self, motion: ReferenceMotion, duration: float) -> None:
        super().__init__(duration, (0.0, duration))
        start, zero = motion.at(0.0), (0.0, 0.0, 0.0)
        self._pose = Reference(start.quaternion, zero, zero, start.gamma, zero, zero)

    def _inside(self, time: float) -> Reference:
        return self._pose


def ideal(scene: Scene) -> Scene:
    """Return the plant of the theory: no friction, which acts between samples too, and no lag."""
    actuators = scene.actuators
    if actuators is not None:
        # A limit that is never met: actuators that change nothing are refused.
        actuators = dataclasses.replace(actuators, torque_limit=1e6, time_constant=None)
    return dataclasses.replace(scene, friction=None, actuators=actuators)


def limit(loop: Loop) -> Limit:
    """Find the limit of a loop in mode computed_torque by bisection on its bandwidth."""
    delay, period = loop.channel.delay, loop.period_ns / NANOSECONDS
    theory = largest(loop.settings.damping_ratio, delay) / period
    found = first_lost(
        lambda bandwidth: stable(loop, bandwidth), _FIRST * theory, _FACTOR, _ACCURACY
    )
    return Limit(delay, theory, found)


def stable(loop: Loop, bandwidth: float) -> bool:
    """Whether a small error fades: it is less in the last quarter of a run than in the second."""
    ticks = _TICKS + _TICKS_OF_DELAY * loop.channel.delay
    rest = Rest(loop.motion, ticks * loop.period_ns / NANOSECONDS)
    settings = dataclasses.replace(loop.settings, mode="computed_torque", bandwidth=bandwidth)
    held = dataclasses.replace(loop, motion=rest, settings=settings, offset=OFFSET, lost=_LOST)
    track, _, failure = follow(held)
    if failure:
        return False
    second, last = (
        float(np.sqrt(np.mean(track.error[part] ** 2)))
        for part in (slice(ticks // 4, ticks // 2), slice(3 * ticks // 4, None))
    )
    return last < max(second, _GONE * OFFSET)
