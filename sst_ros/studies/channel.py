# SPDX-License-Identifier: Apache-2.0
"""The channel between plant and controller: encoders, noise, delay of commands."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass

import numpy as np

Triple = tuple[float, float, float]


@dataclass(frozen=True)
class Channel:
    """What a channel changes; all zeros change nothing.

    Attributes:
        delay: delay of commands in samples. Until the first one arrives, it acts already, as
            if the controller had been there before.
        counts: steps of the encoders per turn; 0 for exact angles. An encoder measures no rate:
            that is the difference of the last two angles over the period.
        noise: standard deviations of normal noise on gamma [rad] and gamma_dot [rad/s], new at
            every sample.

    """

    delay: int = 0
    counts: int = 0
    noise: tuple[float, float] = (0.0, 0.0)


class ChannelState:
    """The memory of a channel during a run.

    Args:
        channel: its properties.
        period_s: time between samples [s].
        seed: of the noise.

    """

    def __init__(self, channel: Channel, period_s: float, seed: int) -> None:
        self._channel, self._period = channel, period_s
        self._random = np.random.default_rng(seed)
        self._before: Triple | None = None
        self._queue: deque[Triple] = deque()

    def measure(self, gamma: Triple, gamma_dot: Triple) -> tuple[Triple, Triple]:
        """Return what the controller receives of gamma [rad] and gamma_dot [rad/s] at a sample."""
        if self._channel.counts:
            step = 2.0 * math.pi / self._channel.counts
            if self._before is None:
                a, b, c = (
                    _counted(angle - self._period * rate, step)
                    for angle, rate in zip(gamma, gamma_dot, strict=True)
                )
                self._before = (a, b, c)
            a, b, c = (_counted(angle, step) for angle in gamma)
            gamma, before = (a, b, c), self._before
            self._before = gamma
            a, b, c = ((x - y) / self._period for x, y in zip(gamma, before, strict=True))
            gamma_dot = (a, b, c)
        if any(self._channel.noise):
            gamma = self._noisy(gamma, self._channel.noise[0])
            gamma_dot = self._noisy(gamma_dot, self._channel.noise[1])
        return gamma, gamma_dot

    def delayed(self, command: Triple) -> Triple:
        """Return the torques [N m] that act when this command has been sent."""
        if not self._queue:
            self._queue.extend([command] * self._channel.delay)
        self._queue.append(command)
        return self._queue.popleft()

    def _noisy(self, values: Triple, deviation: float) -> Triple:
        a, b, c = (self._random.standard_normal(3) * deviation).tolist()
        return (values[0] + a, values[1] + b, values[2] + c)


def _counted(angle: float, step: float) -> float:
    return step * round(angle / step)
