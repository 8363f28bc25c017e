# SPDX-License-Identifier: Apache-2.0
"""Settings of a control loop in a study: controller, sampling period, delay, encoders, noise."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from sst_ros.control.controller import ControllerSettings
from sst_ros.control.reference import ReferenceMotion
from sst_ros.control.reference_motions import reference_motion
from sst_ros.errors import InputError, Problem
from sst_ros.scene.scene import Scene
from sst_ros.scene.schema import Section, integer, number, specs
from sst_ros.sweeps.variations import Target


@dataclass(frozen=True)
class ControlChannel(Section):
    """What lies between plant and controller; zeros change nothing."""

    period: float = number("control period", "s", default=1e-3, least=1e-6, most=1.0)
    delay: int = integer("delay of commands", "periods", default=0, least=0, most=100)
    counts: int = integer(
        "encoder steps per turn; 0 for exact angles and rates", "1", default=0, least=0, most=2**31
    )
    angle_noise: float = number(
        "standard deviation of noise on gamma", "rad", default=0.0, least=0.0, most=1.0
    )
    rate_noise: float = number(
        "standard deviation of noise on gamma_dot", "rad/s", default=0.0, least=0.0, most=1e3
    )


@dataclass(frozen=True)
class ControlledRun:
    """A control loop.

    Attributes:
        model: the controller's model of the plant, which does not vary.
        motion: reference motion, that of the scene.
        settings: scheme and gains.
        channel: period, delay, encoders, noise.

    """

    model: Scene
    motion: ReferenceMotion
    settings: ControllerSettings
    channel: ControlChannel

    def targets(self, key: str) -> list[Target]:
        """Return what a key control.* names."""
        name = key.removeprefix("control.")
        for given in (self.settings, self.channel):
            spec = specs(type(given)).get(name)
            if spec is not None and spec.kind == "number" and name != "period":
                return [Target(key, np.array(getattr(given, name), dtype=float), spec)]
        known = [*_numbers(ControllerSettings), *_numbers(ControlChannel)]
        raise ValueError(f"must be one of {', '.join(f'control.{name}' for name in known)}")


def control_of(scene: Scene, given: Mapping[str, Any]) -> ControlledRun:
    """Read the settings of a control loop: those of a controller and of its channel.

    Raises:
        InputError: a key is unknown or its value not allowed, or the scene has no motion.

    """
    controller, channel = specs(ControllerSettings), specs(ControlChannel)
    known = (*controller, *channel)
    unknown = [Problem(f"control.{key}", given[key], f"unknown key; allowed are {', '.join(known)}")
               for key in given if key not in known]  # fmt: skip
    if unknown:
        raise InputError("sweep", unknown)
    motion = reference_motion(scene)
    return ControlledRun(
        scene,
        motion,
        ControllerSettings(**{key: value for key, value in given.items() if key in controller}),
        ControlChannel(**{key: value for key, value in given.items() if key in channel}),
    )


def _numbers(cls: type[Section]) -> list[str]:
    return [name for name, spec in specs(cls).items() if spec.kind == "number" and name != "period"]
