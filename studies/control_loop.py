# SPDX-License-Identifier: Apache-2.0
"""A control loop in lockstep, what may be wrong with it, and how fast it may be.

A controller has a model of the plant, which may be wrong, and a channel to it, with encoders, noise
and a delay of commands. The largest stable bandwidth of computed torque is found by bisection,
beside the theory of `sampled_data`.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from sst_ros.control.controller import Controller, ControllerSettings, ControlStopped, Measurement
from sst_ros.control.reference import Reference, ReferenceMotion
from sst_ros.control.tracking import TrackingRecord
from sst_ros.errors import RunStopped
from sst_ros.integration.codegen import numba_version
from sst_ros.scene.scene import Initial, Scene
from sst_ros.scene.yaml_document import build, values_of
from sst_ros.simulation.simulation import NANOSECONDS, Simulation
from sst_ros.state import Vector3
from studies.sampled_data import largest_stable, stability_limit

OFFSET = 1e-8
"""Error at the start [rad] of a search for a limit: so small that the plant is linear around it."""

SHARE = 0.2
"""Part by which the model's bodies are too heavy or too light."""

_GONE, _LOST = 1e-3, 1e2 * OFFSET


@dataclass(frozen=True)
class Channel:
    """What a channel changes; all zeros change nothing.

    Attributes:
        delay: of commands in samples. Until the first one arrives, it acts already.
        counts: steps of the encoders per turn; 0 for exact angles. An encoder measures no rate:
            that is the difference of the last two angles over the period.
        noise: standard deviations on gamma [rad] and gamma_dot [rad/s], new at every sample.

    """

    delay: int = 0
    counts: int = 0
    noise: tuple[float, float] = (0.0, 0.0)


class ChannelState:
    """The memory of a channel during a run with `period_s` between samples [s]."""

    def __init__(self, channel: Channel, period_s: float, seed: int) -> None:
        self._channel, self._period = channel, period_s
        self._random = np.random.default_rng(seed)
        self._before: Vector3 | None = None
        self._queue: deque[Vector3] = deque()

    def measure(self, gamma: Vector3, gamma_dot: Vector3) -> tuple[Vector3, Vector3]:
        """Return what the controller receives of gamma [rad] and gamma_dot [rad/s] at a sample."""
        if self._channel.counts:
            step = 2.0 * math.pi / self._channel.counts
            if self._before is None:
                earlier = np.subtract(gamma, np.multiply(self._period, gamma_dot)).tolist()
                self._before = _count(earlier, step)
            before, gamma = self._before, _count(gamma, step)
            self._before = gamma
            a, b, c = ((x - y) / self._period for x, y in zip(gamma, before, strict=True))
            gamma_dot = (a, b, c)
        if any(self._channel.noise):
            gamma = self._noisy(gamma, self._channel.noise[0])
            gamma_dot = self._noisy(gamma_dot, self._channel.noise[1])
        return gamma, gamma_dot

    def delayed(self, command: Vector3) -> Vector3:
        """Return the torques [N m] that act when this command has been sent."""
        if not self._queue:
            self._queue.extend([command] * self._channel.delay)
        self._queue.append(command)
        return self._queue.popleft()

    def _noisy(self, values: Vector3, deviation: float) -> Vector3:
        a, b, c = (self._random.standard_normal(3) * deviation).tolist()
        return (values[0] + a, values[1] + b, values[2] + c)


def _count(angles: Sequence[float], step: float) -> Vector3:
    a, b, c = (step * round(angle / step) for angle in angles)
    return (a, b, c)


@dataclass(frozen=True)
class ModelError:
    """One error of a controller: its model of the plant's scene, and what stands between them."""

    name: str
    model: Callable[[Scene], Scene] = lambda scene: scene
    channel: Channel = field(default_factory=Channel)

    def changes(self, plant: Scene) -> bool:
        """Whether this plant can have it: friction that is not there cannot be unknown."""
        return self.channel != Channel() or self.model(plant) != plant


def make_heavier(scene: Scene, factor: float) -> Scene:
    """Return a scene whose bodies have `factor` times the mass and inertia, in the same places.

    Then every torque of inertia and of weight is `factor` times as large.
    """
    document = values_of(scene)
    bodies = [document["star"], *document["actuated_links"], *document["intermediate_links"]]
    for body in [*bodies, *filter(None, [document.get("payload")])]:
        body["mass"] *= factor
        for part in body.get("inertia", ()):
            body["inertia"][part] *= factor
    if "actuators" in document:
        document["actuators"]["rotor_inertia"] *= factor
    return build(Scene, document, scene.name)


def model_errors() -> Iterator[ModelError]:
    """Yield every error that is studied, none first."""
    yield ModelError("nominal")
    yield ModelError(f"inertia +{SHARE:.0%}", partial(make_heavier, factor=1.0 + SHARE))
    yield ModelError(f"inertia -{SHARE:.0%}", partial(make_heavier, factor=1.0 - SHARE))
    yield ModelError("friction unknown", partial(replace, friction=None))
    yield ModelError("gravity missing", partial(replace, gravity=None))
    for delay in range(1, 6):
        yield ModelError(f"delay {delay}", channel=Channel(delay=delay))
    for counts in (65536, 16384):
        yield ModelError(f"encoder {counts}", channel=Channel(counts=counts))
    yield ModelError("noise", channel=Channel(noise=(1e-4, 1e-2)))


@dataclass(frozen=True)
class ControlLoop:
    """A controller and a plant."""

    plant: Scene  # what moves
    model: Scene  # the controller's model of it
    motion: ReferenceMotion
    settings: ControllerSettings
    period_ns: int  # between samples, over which a torque is held
    channel: Channel = field(default_factory=Channel)  # between plant and controller
    seed: int = 0  # of the noise
    rest_s: float = 0.0  # time for which the loop goes on after the motion
    offset: float = 0.0  # of the plant's gamma at the start [rad]
    lost: float = math.inf  # error of gamma beyond which the run is aborted [rad]


def run_loop(loop: ControlLoop) -> tuple[TrackingRecord, NDArray[np.bool_], str]:
    """Run a loop to its end.

    Returns:
        The track, with the errors of the true state, not of the measured one; by sample, whether
        the controller limited a torque; why the loop ended early, empty where it did not.

    """
    period = loop.period_ns / NANOSECONDS
    plant = at_start(loop.plant, loop.motion, loop.offset)
    simulation = Simulation(plant, compiled=numba_version() is not None)
    controller = Controller(loop.model, loop.motion, loop.settings, period)
    channel = ChannelState(loop.channel, period, loop.seed)
    rows, limited, failure = [], [], ""
    torque = (0.0, 0.0, 0.0)
    for k in range(round((loop.motion.duration + loop.rest_s) / period) + 1):
        time = k * loop.period_ns / NANOSECONDS
        try:
            if k > 0:
                simulation.step(torque, loop.period_ns)
            joints = simulation.state.joints
            measured = Measurement(*channel.measure(joints.gamma, joints.gamma_dot))
            command = controller.command(time, measured)
            torque = channel.delayed(command.torque)
            desired = command.desired
            rows.append(
                ((time,) * 3, desired.gamma, desired.gamma_dot, joints.gamma, joints.gamma_dot,
                 command.feedforward, command.feedback, torque)
            )  # fmt: skip
            limited.append(command.saturated)
            if math.dist(desired.gamma, joints.gamma) > loop.lost:
                raise ControlStopped(f"off by more than {loop.lost:g} rad", time)
        except (RunStopped, ControlStopped) as error:
            failure = str(error)
            break
    table = np.array(rows).reshape(len(rows), 8, 3)
    time_s, gamma, gamma_dot, at, rate, feedforward, feedback, torques = table.swapaxes(0, 1)
    track = TrackingRecord(
        time_s[:, 0], gamma, gamma_dot, gamma - at, gamma_dot - rate, feedforward, feedback, torques
    )
    return track, np.array(limited, dtype=bool), failure


def at_start(plant: Scene, motion: ReferenceMotion, offset: float = 0.0) -> Scene:
    """Return the plant at the start of a motion, its gamma off by `offset` [rad]."""
    start = motion.at(0.0)
    a, b, c = (angle + offset for angle in start.gamma)
    initial = Initial(gamma=(a, b, c), gamma_dot=start.gamma_dot, orientation=start.quaternion)
    return replace(plant, initial=initial)


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
        actuators = replace(actuators, torque_limit=1e6, time_constant=None)
    return replace(scene, friction=None, actuators=actuators)


def bandwidth_in_theory(loop: ControlLoop) -> float:
    """Return the limit of the sampled double integrator, `stability_limit` [rad/s]."""
    limit = stability_limit(loop.settings.damping_ratio, loop.channel.delay)
    return limit * NANOSECONDS / loop.period_ns


def bandwidth_limit(loop: ControlLoop) -> float:
    """Find the largest bandwidth [rad/s] at which computed torque holds the start of the motion."""
    first = 0.5 * bandwidth_in_theory(loop)
    return largest_stable(lambda bandwidth: is_stable(loop, bandwidth), first, 1.15, 2e-3)


def is_stable(loop: ControlLoop, bandwidth: float) -> bool:
    """Return whether a small error is less in the last quarter of a run than in the second."""
    ticks = 600 + 200 * loop.channel.delay
    rest = RestMotion(loop.motion, ticks * loop.period_ns / NANOSECONDS)
    settings = replace(loop.settings, mode="computed_torque", bandwidth=bandwidth)
    held = replace(loop, motion=rest, settings=settings, offset=OFFSET, lost=_LOST)
    track, _, failure = run_loop(held)
    if failure:
        return False
    second, last = (
        float(np.sqrt(np.mean(track.error[part] ** 2)))
        for part in (slice(ticks // 4, ticks // 2), slice(3 * ticks // 4, None))
    )
    return last < max(second, _GONE * OFFSET)
