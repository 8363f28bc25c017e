# SPDX-License-Identifier: Apache-2.0
"""What the actuators do over time, with two derivatives: from point to point, and sine sweeps."""

from __future__ import annotations

import math

from sst_ros.control.actuator_motions import Path
from sst_ros.control.quintic import minimum_jerk
from sst_ros.control.reference import Triple
from sst_ros.control.rest_to_rest import parts
from sst_ros.control.star_motions import PIECES, timed
from sst_ros.scene.motions import Sweep, ToAngles


def straight_path(start: Triple, goal: ToAngles) -> Path:
    """From one gamma straight to another, with minimum jerk."""
    way = [b - a for a, b in zip(start, goal.gamma, strict=True)]

    def path(time: float) -> tuple[Triple, Triple, Triple]:
        s, rate, acceleration = timed(time, goal.duration)
        (p1, p2, p3), (w1, w2, w3) = start, way
        return (
            (p1 + s * w1, p2 + s * w2, p3 + s * w3),
            (rate * w1, rate * w2, rate * w3),
            (acceleration * w1, acceleration * w2, acceleration * w3),
        )

    return path


def sweep_path(sweep: Sweep, centre: Triple) -> tuple[Path, tuple[float, ...]]:
    """Sines that fade in and out, and pieces of a quarter of a period or less."""
    last = sweep.last_frequency or sweep.frequency
    slopes = [(b - a) / sweep.duration for a, b in zip(sweep.frequency, last, strict=True)]
    rows = list(zip(centre, sweep.amplitude, sweep.frequency, slopes, strict=True))

    def path(time: float) -> tuple[Triple, Triple, Triple]:
        e, e1, e2 = _fading(time, sweep.fade, sweep.duration)
        p, v, a = [], [], []
        for middle, amplitude, first, slope in rows:
            angle, frequency = time * (first + 0.5 * slope * time), first + slope * time
            s, c = math.sin(angle), math.cos(angle)
            # The sine and its derivatives by time, times the fading and its own.
            s1, s2 = frequency * c, slope * c - frequency * frequency * s
            p.append(middle + amplitude * e * s)
            v.append(amplitude * (e1 * s + e * s1))
            a.append(amplitude * (e2 * s + 2.0 * e1 * s1 + e * s2))
        return (p[0], p[1], p[2]), (v[0], v[1], v[2]), (a[0], a[1], a[2])

    fastest = max(map(abs, (*sweep.frequency, *last)))
    quarters = math.ceil(fastest * sweep.duration / (0.5 * math.pi))
    fades = (sweep.fade, sweep.duration - sweep.fade)
    pieces = {*parts(sweep.duration, max(quarters, 2 * PIECES)), *fades}
    return path, tuple(sorted(pieces))


def _fading(time: float, fade: float, duration: float) -> tuple[float, float, float]:
    """Fading in and out, between 0 and 1, with its derivatives by time."""
    if fade <= time <= duration - fade:
        return 1.0, 0.0, 0.0
    e, e1, e2 = minimum_jerk(min(time, duration - time) / fade)
    return e, (e1 if time < fade else -e1) / fade, e2 / (fade * fade)
