# SPDX-License-Identifier: Apache-2.0
"""Weighted linear least squares, and the nearest parameters of bodies that can exist.

The variance of the noise differs between actuators; it is estimated from the residuals of an
unweighted fit, over the equations of the actuator less the unknowns that they determine (their
leverage), and the equations are then divided by it (Gautier 1997; Swevers, Verdonck and
De Schutter, IEEE Control Systems 27 (2007) no. 5, 58-71).

A body has mass m, first moment h and inertia I about O if and only if its pseudo-inertia

    J = [[S, h], [h^T, m]],  S = tr(I) / 2 - I,

is positive semidefinite: mass >= 0, I positive definite, and the triangle inequality of its
principal moments (Wensing, Kim and Slotine, IEEE Robot. Autom. Lett. 3 (2018) 60-67). Its centre
lies within a distance r of O if [[m r 1, h], [h^T, m r]] is. Friction, stiffness and rotors must be
>= 0. All this is linear in the parameters, and to minimise

    chi^2 of the base parameters + squared distance from the values given, in sizes of the bodies

under it is a semidefinite programme (Sousa and Cortesao, Int. J. Robotics Research 33 (2014)
931-944), solved by the logarithmic barrier. The distance decides what torques leave open, and
nothing that torques determine. Newton's step of each barrier problem is itself a linear
least-squares problem, so that data without noise are fitted to rounding.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
from scipy.linalg import solve_triangular

from sst_ros.identification.parameters import STANDARD
from sst_ros.mechanism.geometry import Array

EXACT = 1e-12
"""Noise over RMS torque that is assumed at least: data of a simulation have no other."""

INTERIOR = 1e-3
"""Share of its trace that J of a flat body is lifted by at the start, into the interior."""

BARRIERS = tuple(10.0**-k for k in range(0, 11))
"""Weights of the barrier; at the last, chi^2 is off by 1e-10 for each boundary that is active."""

CENTRED = 1e-2
"""Squared decrement, over the barrier, below which Newton's method converges quadratically."""

_PSEUDO = np.zeros((10, 4, 4))
"""J of each of the ten parameters alone."""

_PSEUDO[0, 3, 3] = 1.0
for _i in range(3):
    _PSEUDO[1 + _i, [_i, 3], [3, _i]] = 1.0
for _row, (_i, _j) in enumerate(((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2)), start=4):
    _PSEUDO[_row, [_i, _j], [_j, _i]] = -1.0
    if _i == _j:
        _PSEUDO[_row, :3, :3] += 0.5 * np.eye(3)

_NEWTON_STEPS = 100
_CLOSE = 0.95
"""Share of the distance to the boundary that a step may cover."""


def fit_weighted(
    columns: Array, torque: Array, noise: Array | None = None
) -> tuple[Array, Array, Array]:
    """Fit torque = columns estimate, with b independent columns, shape (m, 3, b).

    Torques are measured less known ones [N m], shape (m, 3), and the noise their standard
    deviations, shape (3,), by default estimated. Returns the estimates, shape (b,), R of the
    weighted regressor, R^T R = covariance^-1, shape (b, b), and the noise.
    """
    floor = EXACT * float(np.sqrt(np.mean(torque**2))) + 1e-300
    if noise is None:
        noise = np.ones(3)
        for _ in range(2):
            estimate, _, leverage = _solve(columns, torque, noise)
            free = np.maximum(len(torque) - leverage, 1.0)
            squares = np.sum((torque - columns @ estimate) ** 2, axis=0)
            noise = np.maximum(np.sqrt(squares / free), floor)
    estimate, root, _ = _solve(columns, torque, noise)
    return estimate, root, noise


def _solve(columns: Array, torque: Array, noise: Array) -> tuple[Array, Array, Array]:
    """Estimate, R of the weighted regressor, and the unknowns that each actuator determines."""
    matrix = (columns / noise[:, None]).reshape(-1, columns.shape[-1])
    right = (torque / noise).ravel()
    lengths = np.linalg.norm(matrix, axis=0)
    q, r = np.linalg.qr(matrix / lengths)
    estimate = solve_triangular(r, q.T @ right)
    # One step of refinement: noise-free data are fitted to rounding.
    estimate = estimate + solve_triangular(r, q.T @ (right - matrix / lengths @ estimate))
    leverage = np.sum((q**2).reshape(-1, 3, len(r)), axis=(0, 2))
    return estimate / lengths, r * lengths, leverage


class Cone(NamedTuple):
    """A matrix that must be positive semidefinite: values at `places` times basis (., n, n)."""

    places: list[int]
    basis: Array

    def matrix(self, values: Array) -> Array:
        """Return the matrix for all parameters."""
        return np.asarray(np.tensordot(values[self.places], self.basis, 1))


def find_consistent_values(
    names: Sequence[str],
    given: Array,
    transform: Array,
    estimate: Array,
    root: Array,
    reach: float,
) -> tuple[Array, float]:
    """Values of all parameters that fit the base parameters, those of bodies that can exist.

    Of p parameters with values given in the scene, b combinations (transform, shape (b, p)) were
    estimated, with the covariance (R^T R)^-1 of the root R. Centres of mass lie within the reach of
    O [m]. Returns the values, shape (p,), and chi^2 of the base parameters there: how much worse
    the torques are fitted than without the constraints.
    """
    cones, sizes = list(cones_of(tuple(names), reach)), scales(names, given)
    rows = np.vstack([root @ transform, np.diag(1.0 / sizes)])
    right = np.concatenate([root @ estimate, given / sizes])
    values = _lift_into_interior(cones, given)
    for barrier in BARRIERS:
        for _ in range(_NEWTON_STEPS):
            step, size, decrement = _newton_step(cones, rows, right, values, barrier)
            if decrement < CENTRED:
                values = values + size * step
                break
            before = _cost(cones, rows, right, values, barrier)
            while _cost(cones, rows, right, values + size * step, barrier) > before:
                size *= 0.5
                if size < 1e-12:  # rounding: the step cannot get better
                    break
            values = values + size * step
    off = root @ (transform @ values - estimate)
    return values, float(off @ off)


def scales(names: Sequence[str], given: Array) -> Array:
    """Size that a parameter may have: of bodies by their mass and inertia, shape (p,)."""
    values = dict(zip(names, given.tolist(), strict=True))
    sizes = []
    for name in names:
        body, _, part = name.partition(".")
        trace = sum(abs(values.get(f"{body}.inertia.{axis}", 0.0)) for axis in ("xx", "yy", "zz"))
        mass = abs(values.get(f"{body}.mass", 0.0)) or 1.0
        of_body = {"mass": mass, "moment": np.sqrt(mass * trace), "inertia": trace}
        sizes.append(of_body.get(part.partition(".")[0], abs(values[name])) or 1.0)
    return np.array(sizes, dtype=float)


def _cost(cones: list[Cone], rows: Array, right: Array, values: Array, barrier: float) -> float:
    """Cost of a barrier problem; infinite outside the cones."""
    try:
        logs = [np.log(np.diag(np.linalg.cholesky(cone.matrix(values)))) for cone in cones]
    except np.linalg.LinAlgError:
        return np.inf
    off = rows @ values - right
    return float(0.5 * off @ off - 2.0 * barrier * sum(float(one.sum()) for one in logs))


def _newton_step(
    cones: list[Cone], rows: Array, right: Array, values: Array, barrier: float
) -> tuple[Array, float, float]:
    """Newton's step for |rows values - right|^2 / 2 - barrier sum log det.

    Returns it, how far to go along it, and its decrement, squared and over the barrier.
    """
    blocks, targets, whitened = [rows], [right - rows @ values], []
    for cone in cones:
        inverse = np.linalg.inv(np.linalg.cholesky(cone.matrix(values)))
        slopes = inverse @ cone.basis @ inverse.T  # of the matrix, in units of itself
        block = np.zeros((slopes[0].size, len(values)))
        block[:, cone.places] = slopes.reshape(len(slopes), -1).T
        blocks.append(np.sqrt(barrier) * block)
        targets.append(np.sqrt(barrier) * np.eye(len(inverse)).ravel())
        whitened.append((cone.places, slopes))
    matrix = np.vstack(blocks)
    lengths = np.linalg.norm(matrix, axis=0)
    q, r = np.linalg.qr(matrix / lengths)
    part = q.T @ np.concatenate(targets)
    step = np.asarray(solve_triangular(r, part) / lengths)
    changes = (np.tensordot(step[places], slopes, 1) for places, slopes in whitened)
    least = min((float(np.linalg.eigvalsh(change)[0]) for change in changes), default=0.0)
    return step, 1.0 if least > -_CLOSE else -_CLOSE / least, float(part @ part) / barrier


def cones_of(names: tuple[str, ...], reach: float) -> Iterator[Cone]:
    """Yield what must be positive semidefinite."""
    index = {name: i for i, name in enumerate(names)}
    # [[m r 1, h], [h^T, m r]] of m and h.
    centre = np.stack([reach * np.eye(4), *_PSEUDO[1:4]])
    for body in dict.fromkeys(name.partition(".")[0] for name in names):
        inertia = [index[key] for part in STANDARD[4:] if (key := f"{body}.{part}") in index]
        if len(inertia) < len(STANDARD[4:]):
            continue
        if f"{body}.mass" in index:
            moment = [index[f"{body}.{part}"] for part in STANDARD[:4]]
            yield Cone(moment + inertia, _PSEUDO)
            yield Cone(moment, centre)
        else:
            yield Cone(inertia, _PSEUDO[4:, :3, :3])
    for name, place in index.items():
        if name.startswith(("friction", "springs", "actuators")):
            yield Cone([place], np.ones((1, 1, 1)))


def _lift_into_interior(cones: list[Cone], given: Array) -> Array:
    """Values near those given at which every matrix is positive definite."""
    values = given.copy()
    for cone in cones:
        n = cone.basis.shape[1]
        if n == 1:
            values[cone.places] = np.maximum(values[cone.places], INTERIOR)
        elif len(cone.places) > n:
            j = cone.matrix(values)
            lifted = j + INTERIOR * (float(np.trace(j[:3, :3])) or 1.0) * np.eye(n)
            back = np.linalg.pinv(cone.basis.reshape(len(cone.places), -1).T)
            values[cone.places] = back @ lifted.ravel()
    return np.asarray(values)
