# SPDX-License-Identifier: Apache-2.0
"""Desired motions of a scene as data; `control.reference_motions` makes them reference motions.

Every motion begins at rest and ends at rest, except a recorded one, which begins and ends as the
recording does. A motion that names no start begins in the initial pose of the scene.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from itertools import pairwise

import numpy as np

from sst_ros.errors import Problem
from sst_ros.scene.schema import Rules, Section, number, section, sections, specs, text
from sst_ros.state import Vector3

NANOSECOND = 1e-9
"""Resolution of time [s]."""


@dataclass(frozen=True)
class ToAngles(Section):
    """The actuators go straight from their initial angles to others, with minimum jerk."""

    gamma: Vector3 = number("actuator angles at the end", "rad", shape=(3,))
    duration: float = number("time that it takes", "s", least=NANOSECOND)


@dataclass(frozen=True)
class ToOrientation(Section):
    """The star turns about one axis from its initial orientation to another, with minimum jerk."""

    orientation: tuple[float, float, float, float] = number(
        "quaternion (x, y, z, w) of {E} in {B} at the end, of any length", "1", shape=(4,)
    )
    duration: float = number("time that it takes", "s", least=NANOSECOND)

    def rules(self) -> Rules:
        """Refuse a quaternion without direction."""
        square = sum(part * part for part in self.orientation)
        yield (
            np.equal(square, 0.0),
            partial(Problem, "orientation", self.orientation, "must not be zero"),
        )


@dataclass(frozen=True)
class Sweep(Section):
    """Sines of the actuators, gamma_k = centre_k + fading amplitude_k sin(angle_k).

    The angle grows with the frequency, which goes evenly from its first to its last value (a linear
    chirp). The fading grows from 0 to 1 over `fade` at the beginning, with minimum jerk, and back
    at the end.
    """

    amplitude: Vector3 = number("amplitudes", "rad", shape=(3,))
    frequency: Vector3 = number("angular frequencies at the beginning", "rad/s", shape=(3,))
    last_frequency: Vector3 | None = number(
        "angular frequencies at the end; by default those at the beginning",
        "rad/s",
        shape=(3,),
        default=None,
    )
    centre: Vector3 | None = number(
        "centres; by default the initial angles", "rad", shape=(3,), default=None
    )
    fade: float = number("time to grow and to fade", "s", least=NANOSECOND)
    duration: float = number("time that it takes", "s", least=NANOSECOND)

    def rules(self) -> Rules:
        """Refuse to fade for longer than there is time."""
        most = 0.5 * self.duration
        yield (
            np.greater(self.fade, most),
            lambda: Problem("fade", self.fade, f"must not exceed half the duration, {most:g} s"),
        )


@dataclass(frozen=True)
class Spiral(Section):
    """E winds outwards from where it is: tilt phi, its direction theta, and psi about E.

    R = R(0) Rz(theta) Ry(phi) Rz(psi - theta). All three grow from zero by one minimum jerk.
    """

    phi: float = number("tilt at the end", "rad", least=0.0, most=3.141592653589793)
    theta: float = number("how far the direction of the tilt turns", "rad")
    psi: float = number("turn about E at the end", "rad", default=0.0)
    duration: float = number("time that it takes", "s", least=NANOSECOND)


@dataclass(frozen=True)
class Waypoint(Section):
    """Where the actuators are at a time. What is not given is chosen for minimum jerk."""

    time: float = number("time since the beginning", "s", least=0.0)
    gamma: Vector3 = number("actuator angles", "rad", shape=(3,))
    gamma_dot: Vector3 | None = number("actuator rates", "rad/s", shape=(3,), default=None)
    gamma_ddot: Vector3 | None = number(
        "actuator accelerations", "rad/s^2", shape=(3,), default=None
    )


@dataclass(frozen=True)
class Recorded(Section):
    """What the actuators did in a recorded run."""

    bag: str = text("folder of the bag, as seen from where the program runs")


@dataclass(frozen=True)
class DesiredMotion(Section):
    """What the manipulator is to do, for a controller and for `plan`; give one kind."""

    to_angles: ToAngles | None = section("actuators from point to point", ToAngles, default=None)
    to_orientation: ToOrientation | None = section(
        "star from point to point", ToOrientation, default=None
    )
    sweep: Sweep | None = section("sines of the actuators", Sweep, default=None)
    spiral: Spiral | None = section("spiral of E", Spiral, default=None)
    waypoints: tuple[Waypoint, ...] = sections(
        "points of the actuators in time, quintic between them", Waypoint, (), default=()
    )
    recorded: Recorded | None = section("motion of a recorded run", Recorded, default=None)

    @property
    def kind(self) -> str:
        """Name of the kind that is given."""
        return next(name for name in specs(DesiredMotion) if getattr(self, name))

    def rules(self) -> Rules:
        """Refuse none and several, and points whose times do not rise."""
        given = [name for name in specs(DesiredMotion) if getattr(self, name)]
        allowed = "give one of " + ", ".join(specs(DesiredMotion))
        yield len(given) != 1, partial(Problem, "", given or None, allowed)
        for index, (before, here) in enumerate(pairwise(self.waypoints), start=1):
            early = np.less(here.time, before.time + NANOSECOND)
            yield early, partial(_too_early, f"waypoints[{index}].time", here.time, before.time)


def _too_early(key: str, time: float, before: float) -> Problem:
    return Problem(key, time, f"must be > {before:g} s, that of the point before, by 1e-9 s")
