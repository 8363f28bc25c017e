# SPDX-License-Identifier: Apache-2.0
"""Quintic polynomials through points in time; what is not given is chosen for minimum jerk.

Position, velocity and acceleration at both ends make one quintic. Where a velocity or an
acceleration is left open, all open ones together minimise the integral of the jerk squared: with
positions alone that is the quintic spline with four continuous derivatives.
"""

from __future__ import annotations

from bisect import bisect_right

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import solveh_banded

from sst_ros.mechanism.geometry import Array

# Power coefficients c_0 ... c_5 on [0, 1] of (p0, v0, a0, p1, v1, a1), derivatives by that time.
_POWERS = np.array(
    [
        [1.0, 0.0, 0.0, 0.0, 0.0, 0.0],
        [0.0, 1.0, 0.0, 0.0, 0.0, 0.0],
        [0.0, 0.0, 0.5, 0.0, 0.0, 0.0],
        [-10.0, -6.0, -1.5, 10.0, -4.0, 0.5],
        [15.0, 8.0, 1.5, -15.0, 7.0, -1.0],
        [-6.0, -3.0, -0.5, 6.0, -3.0, 0.5],
    ]
)


def minimum_jerk(u: float) -> tuple[float, float, float]:
    """s(u) from 0 to 1 for u in [0, 1], at rest at both ends, with its two derivatives by u."""
    rest = 1.0 - u
    square = u * u
    return (
        square * u * (10.0 + u * (6.0 * u - 15.0)),
        30.0 * square * rest * rest,
        60.0 * u * rest * (rest - u),
    )


def timed(time: float, duration: float) -> tuple[float, float, float]:
    """Minimum jerk from 0 to 1 over a duration, with derivatives by time."""
    s, rate, acceleration = minimum_jerk(time / duration)
    return s, rate / duration, acceleration / (duration * duration)


class Quintic:
    """A path of one or more numbers, quintic between points.

    Args:
        times: of the points, rising [s], shape (n,), n >= 2.
        positions: shape (n, m).
        velocities, accelerations: shape (n, m); NaN where they are left open.

    """

    def __init__(
        self,
        times: ArrayLike,
        positions: ArrayLike,
        velocities: ArrayLike,
        accelerations: ArrayLike,
    ) -> None:
        at = np.asarray(times, dtype=float)
        nodes = np.stack(
            [np.array(x, dtype=float) for x in (positions, velocities, accelerations)], axis=1
        )
        self.times: list[float] = at.tolist()
        lengths = np.diff(at)
        _complete(nodes, lengths)
        scale = np.stack([np.ones_like(lengths), lengths, lengths * lengths], axis=1)
        local = np.concatenate(
            [nodes[:-1] * scale[..., None], nodes[1:] * scale[..., None]], axis=1
        )
        # By segment and number: coefficients in the time of the segment, from 0 to 1.
        self._segments = np.einsum("ij,njm->nmi", _POWERS, local).tolist()
        self._lengths: list[float] = lengths.tolist()

    def at(self, time: float) -> tuple[tuple[float, ...], tuple[float, ...], tuple[float, ...]]:
        """Position, velocity and acceleration at a time between the first point and the last."""
        index = min(max(bisect_right(self.times, time) - 1, 0), len(self._lengths) - 1)
        h = self._lengths[index]
        u = (time - self.times[index]) / h
        p, v, a = [], [], []
        for c0, c1, c2, c3, c4, c5 in self._segments[index]:
            p.append(c0 + u * (c1 + u * (c2 + u * (c3 + u * (c4 + u * c5)))))
            v.append((c1 + u * (2.0 * c2 + u * (3.0 * c3 + u * (4.0 * c4 + u * 5.0 * c5)))) / h)
            a.append((2.0 * c2 + u * (6.0 * c3 + u * (12.0 * c4 + u * 20.0 * c5))) / (h * h))
        return tuple(p), tuple(v), tuple(a)


def _complete(nodes: Array, lengths: Array) -> None:
    """Fill in what is open in nodes, shape (n, 3, m), in place."""
    usual = float(np.median(lengths))
    # A velocity times the usual length has the size of a position: the system stays well scaled.
    scale = np.array([1.0, usual, usual * usual])
    hessians = np.stack([_jerk(h) for h in (lengths / usual).tolist()])
    for column in range(nodes.shape[2]):
        if np.isnan(nodes[:, :, column]).any():
            nodes[:, :, column] = _least_jerk(nodes[:, :, column], hessians, scale)


def _least_jerk(nodes: Array, hessians: Array, scale: Array) -> Array:
    """Return nodes, shape (n, 3), completed; hessians, shape (n - 1, 6, 6), are the segments'."""
    missing = np.isnan(nodes).ravel()
    x = np.where(missing, 0.0, (nodes * scale).ravel())
    size, last = len(x), len(x) - 5
    ends = x.reshape(-1, 3)
    slope = np.einsum("nij,nj->ni", hessians, np.concatenate([ends[:-1], ends[1:]], axis=1))
    right = np.zeros(size)
    band = np.zeros((6, size))  # as solveh_banded takes it: band[5 + i - j, j] is entry (i, j)
    for j in range(6):
        right[j : last + j : 3] -= slope[:, j]
        for i in range(j + 1):
            band[5 + i - j, j : last + j : 3] += hessians[:, i, j]
    # A given number keeps its value: its row and column become those of the unit matrix.
    right[~missing] = 0.0
    for above in range(1, 6):
        band[5 - above, above:][~(missing[above:] & missing[:-above])] = 0.0
    band[5][~missing] = 1.0
    root = 1.0 / np.sqrt(band[5])
    for above in range(6):
        band[5 - above, above:] *= root[above:] * root[: size - above]
    found = (root * solveh_banded(band, root * right)).reshape(nodes.shape) / scale
    return np.where(np.isnan(nodes), found, nodes)


def _jerk(h: float) -> Array:
    """Return the form of the integral of the jerk squared in the numbers at the ends."""
    powers = _POWERS * np.array([1.0, h, h * h, 1.0, h, h * h])
    # jerk = 6 c_3 + 24 c_4 u + 60 c_5 u^2, over h^3; du = dt / h.
    jerk = powers[3:] * np.array([[6.0], [24.0], [60.0]])
    hilbert = np.array([[1.0, 1 / 2, 1 / 3], [1 / 2, 1 / 3, 1 / 4], [1 / 3, 1 / 4, 1 / 5]])
    return np.asarray(jerk.T @ hilbert @ jerk / h**5)
