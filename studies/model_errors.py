# SPDX-License-Identifier: Apache-2.0
"""Model errors of a controller: a wrong model, or a channel that changes its signals."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import partial

from sst_ros.scene.bodies import Inertia, Link
from sst_ros.scene.scene import Scene
from studies.control_loop import Channel

SHARE = 0.2
"""Part by which the model's bodies are too heavy or too light."""

DELAYS = (1, 2, 3, 4, 5)
"""Delays of commands in samples."""

COUNTS = (65536, 16384)
"""Steps of an encoder per turn of the joint."""

NOISE = (1e-4, 1e-2)
"""Standard deviations of measured gamma [rad] and gamma_dot [rad/s]."""


def _same(scene: Scene) -> Scene:
    return scene


@dataclass(frozen=True)
class ModelError:
    """One error of a controller.

    Attributes:
        name: its name in tables.
        model: the controller's model, of the plant's scene.
        channel: what stands between the plant and the controller.

    """

    name: str
    model: Callable[[Scene], Scene] = _same
    channel: Channel = field(default_factory=Channel)

    def changes(self, plant: Scene) -> bool:
        """Whether this plant can have it: friction that is not there cannot be unknown."""
        return self.channel != Channel() or self.model(plant) != plant


def heavier(scene: Scene, factor: float) -> Scene:
    """Return a scene whose bodies weigh `factor` times as much, in the same places.

    Masses and inertias go together: a mass that does not fit its inertia is no rigid body. So
    every torque of inertia and of weight is `factor` times as large.
    """
    actuators, payload = scene.actuators, scene.payload
    if actuators is not None:
        rotor = factor * actuators.rotor_inertia
        actuators = dataclasses.replace(actuators, rotor_inertia=rotor)
    if payload is not None:
        inertia = payload.inertia and scaled(payload.inertia, factor)
        payload = dataclasses.replace(payload, mass=factor * payload.mass, inertia=inertia)
    star = scene.star
    star = dataclasses.replace(star, mass=factor * star.mass, inertia=scaled(star.inertia, factor))
    actuated, intermediate = (
        (_link(first, factor), _link(second, factor), _link(third, factor))
        for first, second, third in (scene.actuated_links, scene.intermediate_links)
    )
    return dataclasses.replace(
        scene, star=star, actuated_links=actuated, intermediate_links=intermediate,
        payload=payload, actuators=actuators,
    )  # fmt: skip


def without_friction(scene: Scene) -> Scene:
    """Return a scene whose joints have none."""
    return dataclasses.replace(scene, friction=None)


def without_gravity(scene: Scene) -> Scene:
    """Return a scene in free fall."""
    return dataclasses.replace(scene, gravity=None)


def model_errors() -> Iterator[ModelError]:
    """Yield every error that is studied, none first."""
    yield ModelError("nominal")
    yield ModelError(f"inertia +{SHARE:.0%}", partial(heavier, factor=1.0 + SHARE))
    yield ModelError(f"inertia -{SHARE:.0%}", partial(heavier, factor=1.0 - SHARE))
    yield ModelError("friction unknown", without_friction)
    yield ModelError("gravity missing", without_gravity)
    for delay in DELAYS:
        yield ModelError(f"delay {delay}", channel=Channel(delay=delay))
    for counts in COUNTS:
        yield ModelError(f"encoder {counts}", channel=Channel(counts=counts))
    yield ModelError("noise", channel=Channel(noise=NOISE))


def _link(link: Link, factor: float) -> Link:
    inertia = link.inertia and scaled(link.inertia, factor)
    return dataclasses.replace(link, mass=factor * link.mass, inertia=inertia)


def scaled(inertia: Inertia, factor: float) -> Inertia:
    """Return `factor` times an inertia."""
    return Inertia(**{key: factor * value for key, value in dataclasses.asdict(inertia).items()})
