# SPDX-License-Identifier: Apache-2.0
"""States at t = 0 of many scenarios; one that cannot start does not stop the others."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sst_ros.dynamics.initial_state import SINGULAR
from sst_ros.host.output import slices
from sst_ros.mechanism import kinematics
from sst_ros.mechanism.frames import quaternion_of
from sst_ros.mechanism.geometry import Array, Geometry

NO_ASSEMBLY, NO_RATE, OUTSIDE = -1, -2, -3
REASONS = {
    NO_ASSEMBLY: "no unique admissible assembly",
    NO_RATE: "gamma_dot does not determine the body rate: singular start",
    OUTSIDE: "initial gamma outside the stroke",
}
"""Why a scenario does not start, by its code."""


def initial_states(
    geometries: Geometry,
    which: NDArray[np.intp],
    gamma: Array,
    gamma_dot: Array,
    *,
    stroke: bool,
    label: str,
    progress: bool,
) -> tuple[Array, Array, NDArray[np.int64]]:
    """Quaternions (N, 4), body rates (N, 3) [rad/s] and codes (N,), 0 for those that start.

    Args:
        geometries: the distinct geometries, or one for all scenarios.
        which: number of the geometry of each scenario, shape (N,).
        gamma: actuator angles [rad], shape (N, 3).
        gamma_dot: their rates [rad/s], shape (N, 3).
        stroke: whether gamma must lie in the stroke.
        label: what a bar is called.
        progress: draw a bar on a terminal.

    """
    count = len(gamma)
    quaternion, rate = np.tile([0.0, 0.0, 0.0, 1.0], (count, 1)), np.zeros((count, 3))
    code = np.full(count, NO_ASSEMBLY, dtype=np.int64)
    for part in slices(count, _BLOCK, label, progress):
        different, same = _distinct(np.column_stack([which[part], gamma[part]]))
        own = geometries.of_rows(different[:, 0].astype(np.intp))
        found = kinematics.direct_many(own, different[:, 1:])
        valid = np.flatnonzero(found.admissible)
        owner = found.configuration[valid]
        counts = np.bincount(owner, minlength=len(different))
        one = np.zeros(len(different), dtype=np.intp)
        one[owner] = valid
        starting = counts[same] == 1
        here, chosen = np.flatnonzero(starting) + part.start, one[same[starting]]
        moving = _any(gamma_dot[here] != 0.0)
        singular = moving & (np.abs(found.det_j2[chosen]) < SINGULAR)
        code[here] = np.where(singular, NO_RATE, 0)
        if len(here):
            quaternion[here] = quaternion_of(found.rotation[one])[same[starting]]
        moves = moving & ~singular
        if moves.any():
            rows = here[moves]
            geometry = geometries.of_rows(which[rows])
            rate[rows] = _body_rates(geometry, found.rotation[chosen[moves]], gamma_dot[rows])
        if stroke:
            arc = geometries.of_rows(which[part]).arc
            code[part][_any((gamma[part] < 0.0) | (gamma[part] > arc))] = OUTSIDE
    return quaternion, rate, code


_BLOCK = 2000
"""Rows solved at once: their arrays fit the cache."""


def _any(mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """`mask.any(axis=1)` of (N, 3), ten times as fast."""
    return np.asarray(mask[:, 0] | mask[:, 1] | mask[:, 2])


def _distinct(rows: Array) -> tuple[Array, NDArray[np.intp]]:
    """Distinct rows, and for each row the index of its own."""
    if (rows == rows[:1]).all():
        return rows[:1], np.zeros(len(rows), dtype=np.intp)
    different, same = np.unique(rows, axis=0, return_inverse=True)
    return different, same.ravel()


def _body_rates(geometry: Geometry, rotation: Array, gamma_dot: Array) -> Array:
    """Body rates W in {E} of gamma_dot_k = g_k.W, g_k = (w_k - a t_k)/(1 - a^2), a = t_k.w_k."""
    w = geometry.w @ rotation
    a = np.sum(geometry.e * w, axis=-1, keepdims=True)
    g = (w - a * geometry.e) / (1.0 - a * a)
    return np.asarray(np.linalg.solve(g, gamma_dot[..., None])[..., 0])
