# SPDX-License-Identifier: Apache-2.0
"""The ends of what a scene allows, each as a distance that must not become negative."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

from sst_ros.errors import RunStopped, SingularityReached, StrokeExceeded, WorkspaceLeft
from sst_ros.mechanism.geometry import Geometry
from sst_ros.scene.scene import Scene

SINGULAR_MU = 1e-6
"""Distance of mu_k from 0 and pi [rad] within which gamma_k has lost its meaning."""


class Limit(NamedTuple):
    """One end: sign * (angle of a joint - end) >= 0.

    Attributes:
        reason: text of the error when the run stops here.
        error: what is raised then; None for a contact event.
        joint: number of the joint in (gamma_1..3, mu_1..3, beta_1..3), from 0.
        sign: +1 for a lower end, -1 for an upper one.
        end: angle [rad].

    """

    reason: str
    error: type[RunStopped] | None
    joint: int
    sign: float
    end: Any

    @property
    def leg(self) -> int:
        """Leg of the joint, 0 to 2."""
        return self.joint % 3

    def distance(self, joints: Sequence[float]) -> float:
        """Distance to the end [rad], negative beyond it; nine angles, then nine rates."""
        distance: float = self.sign * (joints[self.joint] - self.end)
        return distance

    def slope(self, joints: Sequence[float]) -> float:
        """Rate of the distance [rad/s]."""
        return self.sign * joints[self.joint + 9]


def ranges_of(limits: Sequence[Limit]) -> list[tuple[int, float, float]]:
    """Joint, lower and upper end of what the limits allow; infinite where there is none."""
    found: dict[int, tuple[float, float]] = {}
    for limit in limits:
        low, high = found.get(limit.joint, (-math.inf, math.inf))
        found[limit.joint] = (limit.end, high) if limit.sign > 0.0 else (low, limit.end)
    return [(joint, low, high) for joint, (low, high) in found.items()]


def limits_of(scene: Scene, geometry: Geometry) -> Iterator[Limit]:
    """Yield serial singularities, and the ends at which the scene stops.

    Of many geometries the ends are columns, which no text names.
    """
    for k in range(3):
        name = f"serial singularity, mu_{k + 1}"
        yield Limit(f"{name} = 0", SingularityReached, k + 3, 1.0, SINGULAR_MU)
        yield Limit(f"{name} = pi", SingularityReached, k + 3, -1.0, math.pi - SINGULAR_MU)
        if scene.stroke.at_end == "stop":
            arc, name = geometry.of_leg("arc", k), f"gamma_{k + 1}"
            yield Limit(f"{name} < 0", StrokeExceeded, k, 1.0, 0.0)
            yield Limit(_above(name, arc), StrokeExceeded, k, -1.0, arc)
        if scene.workspace.at_edge == "stop":
            most, name = geometry.beta_max, f"beta_{k + 1}"
            yield Limit(f"{name} < 0", WorkspaceLeft, k + 6, 1.0, 0.0)
            yield Limit(_above(name, most), WorkspaceLeft, k + 6, -1.0, most)


def _above(name: str, end: Any) -> str:
    return f"{name} > {end:.6f} rad" if isinstance(end, float) else f"{name} > its end"
