# SPDX-License-Identifier: Apache-2.0
"""The tick loop of the node without ROS.

A control loop in it, its errors, and how fast it may be.

A controller has a model of the plant, which may be wrong, and a channel to it, with
encoders, noise and a delay of commands. The largest stable bandwidth of computed torque
is found by bisection, beside the theory of `sampled_data`.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from types import SimpleNamespace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sst_ros.control.actuator_space import Reference, ReferenceMotion
from sst_ros.control.controller import (
    ChannelState,
    Controller,
    ControlStopped,
    Track,
    track_of,
)
from sst_ros.errors import RunStopped
from sst_ros.mechanism.generic_math import axpy
from sst_ros.runtime.tick_loop import Pacer, RunParts, SteadyTime, TickLoop
from sst_ros.runtime.torque_input import RunSettings
from sst_ros.scene.loads import Initial
from sst_ros.scene.scene import Scene
from sst_ros.scene.schema import build
from sst_ros.scene.yaml_document import plain
from sst_ros.simulation.simulation import Simulation
from sst_ros.state import NANOSECONDS, ZERO, State, Vector3
from sst_ros.sweeps.sweep_study import SampledControl
from studies.sampled_data import largest_stable, stability_limit

OFFSET = 1e-8
"""Start error [rad] of a search for a limit, so small that the plant is linear."""

SHARE = 0.2
"""Part by which the model's bodies are too heavy or too light."""

_GONE, _LOST = 1e-3, 1e2 * OFFSET


@dataclass(frozen=True)
class ModelError:
    """Error of a controller: in its model of the plant's scene, or in the channel."""

    name: str
    change: Callable[[Scene], Scene] | None = None
    # fields of a `ControlChannel`
    channel: Mapping[str, Any] = field(default_factory=dict)

    def model(self, plant: Scene) -> Scene:
        """Return the controller's model of a plant."""
        return plant if self.change is None else self.change(plant)

    def changes(self, plant: Scene) -> bool:
        """Whether this plant can have it: absent friction cannot be unknown."""
        return bool(self.channel) or self.model(plant) != plant


BODIES = ("star", "actuated_links", "intermediate_links", "payload", "actuators")


def make_heavier(scene: Scene, factor: float, kinds: Sequence[str] = BODIES) -> Scene:
    """Return a scene whose bodies have `factor` times the mass and inertia.

    Places stay the same. With all kinds of bodies every torque of inertia and of weight
    is `factor` times as large.
    """
    document = plain(scene)
    for found in filter(None, map(document.get, kinds)):
        for body in found if isinstance(found, list) else [found]:
            for name in {"mass", "rotor_inertia"} & body.keys():
                body[name] *= factor
            for part in body.get("inertia", ()):
                body["inertia"][part] *= factor
    return build(Scene, document, scene.name)


def model_errors() -> Iterator[ModelError]:
    """Yield every error that is studied, none first."""
    yield ModelError("nominal")
    yield ModelError(f"inertia +{SHARE:.0%}", partial(make_heavier, factor=1.0 + SHARE))
    yield ModelError(f"inertia -{SHARE:.0%}", partial(make_heavier, factor=1.0 - SHARE))
    yield ModelError("friction unknown", partial(replace, friction=None))
    yield ModelError("gravity missing", partial(replace, gravity=None))
    for delay in range(1, 6):
        yield ModelError(f"delay {delay}", channel={"delay": delay})
    for counts in (65536, 16384):
        yield ModelError(f"encoder {counts}", channel={"counts": counts})
    yield ModelError("noise", channel={"angle_noise": 1e-4, "rate_noise": 1e-2})


TorqueOf = Callable[[Simulation], Any]
"""Torques of the tick that begins now [N m], constant or a `SineTorque`."""


def run_in_loop(
    simulation: Simulation,
    torque: TorqueOf,
    period_ns: int,
    ticks: int,
    *,
    warm: bool = False,
) -> tuple[list[State], list[float]]:
    """Run a simulation from its start for some ticks, with a sample at each.

    With `warm` the code of all methods is loaded before, so that all ticks take equally
    long.

    Returns:
        The states of all samples, and the processor time of the thread at each [s].

    Raises:
        RunStopped: it ended before.

    """
    states: list[State] = []
    times: list[float] = []

    def sample(simulation: Simulation, _: int) -> None:
        states.append(simulation.state)
        times.append(time.thread_time())

    def nothing(*_: Any, **__: Any) -> None: ...

    # Input and output of a run without messages: no torque gets old, and nobody
    # listens.
    ends: Any = SimpleNamespace(
        torque=lambda simulation, _: simulation.acting(torque(simulation)),
        constant=lambda _: False,
        now_ns=lambda: NANOSECONDS,
        sample=sample,
        **dict.fromkeys(("refresh", "ticks", "idle", "accept_idle"), nothing),
        moment=ZERO,
        unread=False,
    )
    settings, pacer = (
        RunSettings(period_ns, last_tick=ticks),
        Pacer(period_ns, 0.0, SteadyTime()),
    )
    loop = TickLoop(simulation, RunParts(settings, ends, pacer, ends))
    if warm:
        loop.warm_up()
    loop.begin()
    loop.resume()
    while not loop.complete:
        loop.to_next_sample(paced=True)
    return states, times


@dataclass(frozen=True)
class ControlLoop:
    """A controller and a plant."""

    model: Scene  # the controller's, of the plant
    motion: ReferenceMotion
    settings: SampledControl
    plant: Scene  # what moves
    seed: int = 0  # of the noise
    rest_s: float = 0.0  # time for which the loop goes on after the motion
    offset: float = 0.0  # of the plant's gamma at the start [rad]
    lost: float = math.inf  # error of gamma beyond which the run is aborted [rad]

    @property
    def period_ns(self) -> int:
        """Time between samples, over which a torque is held [ns]."""
        return round(self.settings.period * NANOSECONDS)


def run_loop(loop: ControlLoop) -> tuple[Track, NDArray[np.bool_], str]:
    """Run a loop to its end.

    Returns:
        The track, with the errors of the true state, not of the measured one; by
        sample, whether the controller limited a torque; why the loop ended early, empty
        where it did not.

    """
    period = loop.period_ns / NANOSECONDS
    plant = at_start(loop.plant, loop.motion, loop.offset)
    simulation = Simulation(plant)
    controller = Controller(loop.model, loop.motion, loop.settings, period)
    channel = ChannelState(loop.settings, loop.seed)
    rows, limited, failure = [], [], ""

    def torque(simulation: Simulation) -> Vector3:
        joints, now = simulation.state.joints, simulation.time_ns / NANOSECONDS
        command = controller.command(
            now, channel.measure(joints.gamma, joints.gamma_dot)
        )
        acting, desired = channel.transmit(command.torque), command.desired
        error = axpy(1.0, desired.gamma, -1.0, joints.gamma)
        torques = *command.feedforward, *command.feedback, *acting
        rows.append((now, *desired.gamma, *desired.gamma_dot, *error, *torques))
        limited.append(command.saturated)
        if math.dist(desired.gamma, joints.gamma) > loop.lost:
            raise ControlStopped(f"off by more than {loop.lost:g} rad", now)
        return acting

    try:
        ticks = round((loop.motion.duration + loop.rest_s) / period)
        run_in_loop(simulation, torque, loop.period_ns, ticks)
        torque(simulation)  # of the end, which is a sample, too
    except (RunStopped, ControlStopped) as error:
        failure = str(error)
    return track_of(rows), np.array(limited, dtype=bool), failure


def at_start(plant: Scene, motion: ReferenceMotion, offset: float = 0.0) -> Scene:
    """Return the plant at the start of a motion, its gamma off by `offset` [rad]."""
    start = motion.at(0.0)
    a, b, c = (angle + offset for angle in start.gamma)
    initial = Initial(
        gamma=(a, b, c), gamma_dot=start.gamma_dot, orientation=start.quaternion
    )
    return replace(plant, initial=initial)


def ideal_plant(scene: Scene) -> Scene:
    """Return the plant of the theory: without friction and lag.

    Friction acts between samples, too.
    """
    actuators = scene.actuators
    if actuators is not None:
        # A limit that is never met: actuators that change nothing are refused.
        actuators = replace(actuators, torque_limit=1e6, time_constant=None)
    return replace(scene, friction=None, actuators=actuators)


def bandwidth_in_theory(loop: ControlLoop) -> float:
    """Return the limit of the sampled double integrator, `stability_limit` [rad/s]."""
    limit = stability_limit(loop.settings.damping_ratio, loop.settings.delay)
    return limit * NANOSECONDS / loop.period_ns


def bandwidth_limit(loop: ControlLoop) -> float:
    """Find the largest bandwidth [rad/s] that holds the start of the motion.

    The mode is computed torque.
    """
    first = 0.5 * bandwidth_in_theory(loop)
    return largest_stable(
        lambda bandwidth: is_stable(loop, bandwidth), first, 1.15, 2e-3
    )


def is_stable(loop: ControlLoop, bandwidth: float) -> bool:
    """Return whether a small error is less in a run's last quarter than its second."""
    ticks = 600 + 200 * loop.settings.delay
    start, seconds = loop.motion.at(0.0), ticks * loop.period_ns / NANOSECONDS
    pose = Reference(start.quaternion, ZERO, ZERO, start.gamma, ZERO, ZERO)
    rest = ReferenceMotion(lambda _: pose, (0.0, seconds))
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
