# SPDX-License-Identifier: Apache-2.0
"""Inertia of bodies made of thin circular arcs around O, as the star and the actuated links are."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike

from sst_ros.errors import InputError, Problem
from sst_ros.scene.bodies import Inertia


def arc_inertia(mass: float, radius: float, begin: ArrayLike, end: ArrayLike) -> Inertia:
    """Inertia about O of a thin, uniform arc of a great circle. Inertias of several arcs add up.

    Args:
        mass: of the arc [kg].
        radius: of its circle [m].
        begin: direction of its beginning seen from O, of any length, shape (3,).
        end: direction of its end, less than pi from `begin`, shape (3,).

    Raises:
        InputError: mass or radius is not positive, or the directions span no arc.

    """
    problems = [
        Problem(name, value, f"must be > 0 and finite [{unit}]")
        for name, value, unit in (("mass", mass, "kg"), ("radius", radius, "m"))
        if not (value > 0.0 and math.isfinite(value))
    ]
    first, last = np.asarray(begin, dtype=float), np.asarray(end, dtype=float)
    fits = first.shape == last.shape == (3,) and np.all(np.isfinite([first, last]))
    normal = np.linalg.norm(np.cross(first, last)) if fits else 0.0
    lengths = np.linalg.norm(first) * np.linalg.norm(last) if fits else 0.0
    if not normal > 1e-9 * lengths:
        allowed = "must be two directions, shape (3,), neither parallel nor opposite"
        problems.append(Problem("begin, end", (begin, end), allowed))
    if problems:
        raise InputError("arc_inertia", problems)
    u = first / np.linalg.norm(first)
    half = 0.5 * math.atan2(normal, float(first @ last))
    middle = u * math.cos(half) + _towards(u, last) * math.sin(half)
    across = _towards(middle, last)
    # Mean of r r^T over the arc: angles from -half to half about its middle.
    ratio = math.sin(2.0 * half) / (2.0 * half)
    spread = 0.5 * (1.0 + ratio) * np.outer(middle, middle)
    spread += 0.5 * (1.0 - ratio) * np.outer(across, across)
    tensor = mass * radius**2 * (np.eye(3) - spread)
    xx, yy, zz = (float(tensor[i, i]) for i in range(3))
    return Inertia(
        xx=xx, yy=yy, zz=zz, xy=float(tensor[0, 1]), xz=float(tensor[0, 2]), yz=float(tensor[1, 2])
    )


def _towards(axis: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Return the unit vector across `axis` in the plane of both, on the side of `other`."""
    across = other - axis * float(axis @ other)
    return np.asarray(across / np.linalg.norm(across))
