# SPDX-License-Identifier: Apache-2.0
"""Weighted linear least squares, and the nearest parameters of bodies that can exist.

The variance of the noise differs between actuators; it is estimated from the residuals
of an unweighted fit, over the equations of the actuator less the unknowns that they
determine (their leverage), and the equations are then divided by it (Gautier 1997;
Swevers, Verdonck and De Schutter, IEEE Control Systems 27 (2007) no. 5, 58-71). Where
equations are components of a frequency, noise of the angles makes it grow with the
frequency: weights by it would gain 2 % of the deviations and lose more by their own
uncertainty, but the covariance of the estimates has it (`estimate_variances`).

A body has mass m, first moment h and inertia I about O if and only if its
pseudo-inertia

    J = [[S, h], [h^T, m]],  S = tr(I) / 2 - I,

is positive semidefinite: mass >= 0, I positive definite, and the triangle inequality of
its principal moments (Wensing, Kim and Slotine, IEEE Robot. Autom. Lett. 3 (2018)
60-67). Its centre lies within a distance r of O if [[m r 1, h], [h^T, m r]] is.
Friction, stiffness and rotors must be >= 0. All this is linear in the parameters, and
to minimise

    chi^2 of the base parameters + squared distance from the values given, in sizes of
    the bodies

under it is a semidefinite programme (Sousa and Cortesao, Int. J. Robotics Research 33
(2014) 931-944), solved by the logarithmic barrier. The distance decides what torques
leave open, and nothing that torques determine. Newton's step of each barrier problem is
itself a linear least-squares problem, so that data without noise are fitted to
rounding.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from scipy.linalg import solve_triangular

from sst_ros.identification.parameters import (
    FIRST_MOMENTS,
    INERTIA_ENTRIES,
    STANDARD,
)
from sst_ros.mechanism.geometry import Array

# noise over RMS terms that is assumed at least: simulations have no other
LEAST_NOISE = 1e-12
VARIANCE_STEPS = 2  # fits by which the noise is estimated: unweighted, and weighted
# Growths of the variance from rest to the highest frequency that are tried: none, and
# from what is too small to see to noise of angles alone.
GROWTHS = np.append(0.0, np.geomspace(0.05, 500.0, 41))
SMALLEST_VARIANCE = 1e-300  # of residuals that are zero
INTERIOR = 1e-3  # share of its size by which a parameter is lifted at the start
# Factors of the barrier, each a tenth of the one before; by the last chi^2 is off by
# 1e-10 at each boundary.
BARRIERS = tuple(10.0**-k for k in range(0, 11))
# squared decrement over the barrier below which Newton converges quadratically
CENTRED = 1e-2
_BARRIER_NEWTON_STEPS = 100  # at most, with each barrier
SMALLEST_STEP = 1e-12  # share of a step below which it is rounding
LARGEST_DOUBLE = float(np.finfo(float).max)
_BOUNDARY_SHARE = 0.95  # of the distance to the boundary that a step may cover


def _unit_pseudo_inertias() -> dict[str, Array]:
    """Return J of each of the parameters of STANDARD alone, shape (4, 4)."""
    units = {name: np.zeros((4, 4)) for name in STANDARD}
    units["mass"][-1, -1] = 1.0
    for axis, name in enumerate(FIRST_MOMENTS):
        units[name][axis, -1] = 1.0
        units[name][-1, axis] = 1.0
    for name in INERTIA_ENTRIES:
        row, column = map("xyz".index, name.removeprefix("inertia."))
        units[name][row, column] = -1.0
        units[name][column, row] = -1.0
        if row == column:
            units[name][:-1, :-1] += 0.5 * np.eye(3)  # of tr(I) / 2
    return units


_UNIT_PSEUDO_INERTIAS = _unit_pseudo_inertias()


class LinearFit(NamedTuple):
    """A weighted fit of b unknowns: R^T R, of its root R, is their covariance^-1."""

    estimate: Array  # shape (b,)
    root: Array  # shape (b, b), upper triangular
    noise: Array  # standard deviations of the torques [N m], shape (3,)


def fit_weighted(
    columns: Array,
    torque: Array,
    noise: Sequence[float] | None = None,
    *,
    terms: float = 0.0,
    frequencies: Array | None = None,
) -> LinearFit:
    """Fit torque = columns estimate, with b independent columns, shape (m, 3, b).

    Torques are measured less known ones [N m], shape (m, 3), and the noise their
    standard deviations, three, by default estimated: at least LEAST_NOISE of the
    torques, and of the RMS of the `terms` that sum up to them [N m], which cancel in a
    free motion. Equations may be components of given frequencies, over the highest,
    shape (m,): then the noise is the RMS over the components, and the covariance is
    that of a noise which grows with the frequency, see `estimate_variances`.
    """
    floor = LEAST_NOISE * max(float(np.sqrt(np.mean(torque**2))), terms) + 1e-300
    deviations = np.ones(3)
    for _ in range(VARIANCE_STEPS):
        solution = _solve(columns, torque, deviations)
        residuals = torque - columns @ solution.estimate
        variances = estimate_variances(residuals, solution.leverage, frequencies)
        mean_variance = np.maximum(variances.mean(axis=0), SMALLEST_VARIANCE)
        deviations = np.maximum(np.sqrt(mean_variance), floor)
    if noise is not None:
        deviations = np.array(noise)
    solution = _solve(columns, torque, deviations)
    root = solution.root
    if frequencies is not None:
        root = _spread_root(solution, variances / mean_variance)
    return LinearFit(solution.estimate, root, deviations)


def estimate_variances(
    residuals: Array, leverage: Array, frequencies: Array | None
) -> Array:
    """Estimate the variance of the noise of each equation [(N m)^2], shape (m, 3).

    Residuals [N m] and leverages have the shape (m, 3). Without frequencies the noise
    of an actuator is white. With them, shape (m,), its variance is s^2 (1 + g f^4):
    noise of the torques, and noise of the angles in the accelerations. The growth g
    minimises the pseudo-likelihood

        sum over i of (1 - h_i) ln v_i + r_i^2 / v_i

    of variances v, residuals r and leverages h (Davidian and Carroll, J. American
    Statistical Association 82 (1987) 1079-1091).

    Of n degrees of freedom, the sum of 1 - h_i, the level is divided by n - 2 and not
    by n, and by n - 3 where g is estimated too: an estimate over its true deviation is
    normally distributed, but over an estimated one by Student's distribution, whose
    variance is n / (n - 2).
    """
    free = 1.0 - leverage
    freedom = np.maximum(free.sum(axis=0), 1.0)
    if frequencies is None:
        level = np.sum(residuals**2, axis=0) / np.maximum(freedom - 2.0, 1.0)
        return np.broadcast_to(level, residuals.shape)
    growths = 1.0 + np.outer(GROWTHS, frequencies**4)
    variances = np.empty_like(residuals)
    for k in range(3):
        sums = (residuals[:, k] ** 2 / growths).sum(axis=1)
        levels = np.maximum(sums / freedom[k], SMALLEST_VARIANCE)
        costs = freedom[k] * np.log(levels) + np.log(growths) @ free[:, k]
        best = int(np.argmin(costs))
        variances[:, k] = sums[best] / max(freedom[k] - 3.0, 1.0) * growths[best]
    return variances


class _Solution(NamedTuple):
    """A fit with given weights: W X = Q R of the weighted regressor."""

    estimate: Array  # shape (b,)
    orthogonal: Array  # Q, shape (3 m, b)
    root: Array  # R, shape (b, b)

    @property
    def leverage(self) -> Array:
        """Leverage of each equation, shape (m, 3).

        Those of an actuator sum up to how many unknowns it determines.
        """
        return np.asarray(np.sum(self.orthogonal**2, axis=1).reshape(-1, 3))


def _solve(columns: Array, torque: Array, noise: Array) -> _Solution:
    """Solve the weighted least-squares problem with the noise [N m], shape (3,)."""
    matrix = (columns / noise[:, None]).reshape(-1, columns.shape[-1])
    right = (torque / noise).ravel()
    lengths = np.linalg.norm(matrix, axis=0)
    q, r = np.linalg.qr(matrix / lengths)
    estimate = solve_triangular(r, q.T @ right)
    # One step of refinement: noise-free data are fitted to rounding.
    estimate = estimate + solve_triangular(
        r, q.T @ (right - matrix / lengths @ estimate)
    )
    return _Solution(estimate / lengths, q, r * lengths)


def _spread_root(solution: _Solution, growth: Array) -> Array:
    """Return the root of the inverse covariance where variances are not alike.

    They are `growth` times those of the weights, shape (m, 3). The covariance of the
    estimate is R^-1 Q^T V Q R^-T then, the sandwich (White, Econometrica 48 (1980)
    817-838), with the V of the model of the noise. V^1/2 Q = P T makes the root T^-T R,
    which is turned into a triangle.
    """
    scaled = np.sqrt(growth).reshape(-1, 1) * solution.orthogonal
    triangle: Any = np.linalg.qr(scaled, mode="r")
    root: Any = np.linalg.qr(
        solve_triangular(triangle, solution.root, trans="T"), mode="r"
    )
    return np.asarray(root)


def find_consistent_values(
    names: Sequence[str],
    start: Array,
    transform: Array,
    estimate: Array,
    root: Array,
    reach: float,
) -> tuple[Array, float]:
    """Find values of all parameters that fit the base parameters.

    The values are those of bodies that can exist. Of p parameters with values given in
    the scene, b combinations (transform, shape (b, p)) were estimated, with the
    covariance (R^T R)^-1 of the root R. Centres of mass lie within the reach of O [m].
    Returns the values, shape (p,), and chi^2 of the base parameters there: how much
    worse the torques are fitted than without the constraints.
    """
    sizes = scales(names, start)
    constant, basis = make_cones(names, reach)
    problem = _BarrierProblem(
        rows=np.vstack([root @ transform, np.diag(1.0 / sizes)]),
        right=np.concatenate([root @ estimate, start / sizes]),
        constant=constant,
        basis=basis,
    )
    # Into the interior: flat bodies and what is zero lie on the boundary.
    is_lifted = [
        ".moment." not in name and not name.endswith(("xy", "xz", "yz"))
        for name in names
    ]
    values = start + INTERIOR * sizes * is_lifted
    for barrier in BARRIERS:
        values = problem.minimize(values, barrier)
    off = root @ (transform @ values - estimate)
    return values, float(off @ off)


class _BarrierProblem(NamedTuple):
    """|rows values - right|^2 / 2 under constraints, by a logarithmic barrier.

    The constraints: matrices that are linear in the values are positive definite.
    """

    rows: Array  # shape (m, p)
    right: Array  # shape (m,)
    constant: Array  # of k matrices, shape (k, 4, 4)
    basis: Array  # what a unit of each value adds to them, shape (p, k, 4, 4)

    def minimize(self, values: Array, barrier: float) -> Array:
        """Take Newton's steps from values inside the constraints to the minimum.

        Where the decrement says that Newton converges quadratically, one more step is
        taken, whatever the cost is to rounding.
        """
        for _ in range(_BARRIER_NEWTON_STEPS):
            newton = self._newton_step(values, barrier)
            centred = newton.decrement < CENTRED * barrier
            most = LARGEST_DOUBLE if centred else self._cost(values, barrier)
            share = self._shorten(values, newton, barrier, most)
            values = values + share * newton.step
            if centred or share == 0.0:
                break
        return values

    def _matrices(self, values: Array) -> Array:
        """Return the matrices that must be positive definite, shape (k, 4, 4)."""
        return np.asarray(self.constant + np.tensordot(values, self.basis, 1))

    def _cost(self, values: Array, barrier: float) -> float:
        """Return |rows values - right|^2 / 2 - barrier sum log det.

        It is infinite where a matrix is not positive definite.
        """
        try:
            factors = np.linalg.cholesky(self._matrices(values))
        except np.linalg.LinAlgError:
            return np.inf
        off = self.rows @ values - self.right
        logs = np.log(np.diagonal(factors, axis1=1, axis2=2))
        return float(0.5 * off @ off - 2.0 * barrier * logs.sum())

    def _newton_step(self, values: Array, barrier: float) -> _NewtonStep:
        """Return Newton's step, which solves a linear least-squares problem."""
        factors = np.linalg.cholesky(self._matrices(values))
        inverse = np.linalg.inv(factors)
        # Of the matrices by the values, in units of the matrices themselves.
        slopes = inverse @ self.basis @ inverse.transpose(0, 2, 1)
        barrier_rows = np.sqrt(barrier) * slopes.reshape(len(values), -1).T
        identity = np.tile(np.eye(4), (len(self.constant), 1, 1)).ravel()
        matrix = np.vstack([self.rows, barrier_rows])
        target = np.concatenate(
            [self.right - self.rows @ values, np.sqrt(barrier) * identity]
        )
        lengths = np.linalg.norm(matrix, axis=0)
        q, r = np.linalg.qr(matrix / lengths)
        rotated = q.T @ target
        step = solve_triangular(r, rotated) / lengths
        changes = np.linalg.eigvalsh(np.tensordot(step, slopes, 1))
        least = float(changes.min(initial=0.0))  # -1 at the boundary
        largest = 1.0 if least > -_BOUNDARY_SHARE else -_BOUNDARY_SHARE / least
        return _NewtonStep(step, float(rotated @ rotated), largest)

    def _shorten(
        self, values: Array, newton: _NewtonStep, barrier: float, most: float
    ) -> float:
        """Halve a step until the cost is no more than `most`; 0 where it stays more."""
        share = newton.largest
        while share > SMALLEST_STEP:
            if self._cost(values + share * newton.step, barrier) <= most:
                return share
            share *= 0.5
        return 0.0


class _NewtonStep(NamedTuple):
    step: Array  # shape (p,)
    decrement: float  # squared
    largest: float  # share of the step that stays inside the constraints, 1 at most


def make_cones(names: Sequence[str], reach: float) -> tuple[Array, Array]:
    """Return k matrices that must be positive semidefinite, linear in p parameters.

    That is their constant part, shape (k, 4, 4), which fills the diagonal of smaller
    ones, and what each parameter adds for a unit, shape (p, k, 4, 4).
    """
    cones: list[dict[str, Array]] = []
    for body in dict.fromkeys(name.partition(".")[0] for name in names):
        units = {
            f"{body}.{entry}": unit for entry, unit in _UNIT_PSEUDO_INERTIAS.items()
        }
        inertia = {f"{body}.{entry}" for entry in INERTIA_ENTRIES}
        if units.keys() <= set(names):
            cones.append(units)
            # [[m r 1, h], [h^T, m r]] of m and h.
            moments = {f"{body}.{entry}" for entry in FIRST_MOMENTS}
            centre = {name: units[name] for name in moments}
            cones.append({f"{body}.mass": reach * np.eye(4), **centre})
        elif inertia <= set(names):
            cones.append({name: units[name] for name in inertia})
    for name in names:
        if name.startswith(("friction", "springs", "actuators")):
            cones.append({name: np.diag([1.0, 0.0, 0.0, 0.0])})
    basis = np.zeros((len(names), len(cones), 4, 4))
    for k, cone in enumerate(cones):
        for name, matrix in cone.items():
            basis[names.index(name), k] = matrix
    empty = np.asarray(~basis.any(axis=(0, 3)))
    return empty[:, :, None] * np.eye(4), basis


def scales(names: Sequence[str], start: Array) -> Array:
    """Return the sizes that parameters may have, shape (p,).

    Those of bodies are by their mass and inertia.
    """
    values = dict(zip(names, start.tolist(), strict=True))
    sizes = []
    for name in names:
        body, _, entry = name.partition(".")
        diagonal = (f"{body}.inertia.{axes}" for axes in ("xx", "yy", "zz"))
        trace = sum(abs(values.get(key, 0.0)) for key in diagonal)
        mass = abs(values.get(f"{body}.mass", 0.0)) or 1.0
        of_body = {"mass": mass, "moment": np.sqrt(mass * trace), "inertia": trace}
        quantity = entry.partition(".")[0]
        sizes.append(of_body.get(quantity, abs(values[name])) or 1.0)
    return np.array(sizes, dtype=float)
