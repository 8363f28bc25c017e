# SPDX-License-Identifier: Apache-2.0
"""Where elastic ends begin and cease to push: steps end there, for the force has a kink."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from sst_ros.dynamics.limits import Limit
from sst_ros.integration.events import GRAZING
from sst_ros.mechanism.geometry import Geometry
from sst_ros.scene.scene import Scene

BESIDE = 1e-9
"""Farther beyond than this [rad], an actuator has not just come to the kink."""


def touches_of(scene: Scene, geometry: Geometry) -> Iterator[Limit]:
    """Yield the kinks of elastic ends, once for each way through."""
    if scene.stroke.at_end == "elastic":
        for k in range(3):
            for end in (0.0, float(geometry.arc[k])):
                for sign in (1.0, -1.0):
                    yield Limit(f"gamma_{k + 1} = {end:.6f} rad", None, k, sign, end)


def may_touch(kink: Limit, begin: Sequence[float], end: Sequence[float]) -> bool:
    """Cheap test before a search: it goes through, or in and back, and does not start there."""
    if kink.margin(begin) <= GRAZING and not (
        kink.margin(begin) > -BESIDE and kink.slope(begin) > 0.0
    ):
        return False
    return kink.margin(end) < 0.0 or kink.slope(begin) < 0.0 < kink.slope(end)


def just_beyond(kink: Limit, x: float, joints: Sequence[float], h: float) -> float:
    """Time at which the kink is surely behind, for the Jacobian there must be that of its side."""
    return min(x + min(1e-14 / max(abs(kink.slope(joints)), 1e-200), 1e-3 * h), h)


def clear_of(kinks: Sequence[Limit]) -> list[Limit]:
    """Return limits before which elastic ends are surely not touched."""
    inner = [kink for kink in kinks if (kink.end == 0.0) == (kink.sign > 0.0)]
    return [kink._replace(end=kink.end + 4.0 * BESIDE * kink.sign) for kink in inner]
