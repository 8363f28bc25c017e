# SPDX-License-Identifier: Apache-2.0
"""The mechanism once more, written without sst_ros: what the tests of this folder compare with.

Random manipulators and states; all assemblies as the eight complex zeros of three quadrics.
"""

from dataclasses import dataclass
from itertools import combinations_with_replacement

import mpmath as mp
import numpy as np

from sst_ros.mechanism.geometry import Geometry
from sst_ros.mechanism.virtual_work import Mechanism

ISOTROPIC = Geometry.build(np.eye(3), np.radians([120.0, 120.0, 120.0]))
FOLDING = Geometry.build(np.eye(3), np.radians([210.0, 75.0, 75.0]))


def random_geometry(rng, roughness=1.0):
    """A general manipulator: a right-handed base triangle of some size, arcs of >= 20 deg."""
    while True:
        v = np.eye(3) + roughness * rng.uniform(-0.6, 0.6, (3, 3))
        v /= np.linalg.norm(v, axis=1)[:, None]
        if np.linalg.det(v) > 0.15:
            break
    alpha = np.radians(20.0 + 300.0 * rng.dirichlet([2.0, 2.0, 2.0]))
    return Geometry.build(v, alpha)


def random_tensor(rng, scale=1.0):
    """An inertia tensor that some rigid body has: positive definite, triangle inequality."""
    points = rng.normal(size=(6, 3))
    second = scale * points.T @ points / 6
    return np.trace(second) * np.eye(3) - second


def random_mechanism(rng, geometry):
    """Full tensors for all seven links."""
    actuated = np.stack([random_tensor(rng, 0.1) for _ in range(3)])
    intermediate = np.stack([random_tensor(rng, 0.05) for _ in range(3)])
    return Mechanism(geometry, random_tensor(rng, 0.3), actuated, intermediate)


def random_rotation(rng):
    q = rng.normal(size=4)
    return rotation_of(q / np.linalg.norm(q))


def random_pose(rng, geometry, least=0.2):
    """gamma and R well away from both kinds of singularity."""
    while True:
        rotation = random_rotation(rng)
        t = geometry.e @ rotation.T
        p = np.cross(t, geometry.w)
        sine = np.linalg.norm(p, axis=1)
        if sine.min() < least:
            continue
        r = p / sine[:, None]
        if abs(np.linalg.det(np.cross(r, t))) < least:
            continue
        across = np.cross(geometry.w, geometry.v)
        gamma = np.arctan2(np.sum(r * across, axis=1), np.sum(r * geometry.v, axis=1))
        return gamma, rotation


def rotation_of(q):
    """R of unit quaternions (w, x, y, z), any leading shape."""
    w, x, y, z = np.moveaxis(np.asarray(q), -1, 0)
    rows = [
        [w * w + x * x - y * y - z * z, 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), w * w - x * x + y * y - z * z, 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), w * w - x * x - y * y + z * z],
    ]
    return np.moveaxis(np.array(rows), (0, 1), (-2, -1))


# All assemblies: r_k . R(q) e_k = 0 are three quadrics in the homogeneous quaternion q. By Bezout
# they have eight zeros; eight distinct ones that are found are all there are.

_FOURTH = list(combinations_with_replacement(range(4), 4))
_THIRD = list(combinations_with_replacement(range(4), 3))
_SECOND = list(combinations_with_replacement(range(4), 2))
_ROW = {monomial: row for row, monomial in enumerate(_FOURTH)}


def _left(u):
    """Matrix of q -> u q for pure quaternions u, shape (..., 3) -> (..., 4, 4)."""
    x, y, z = np.moveaxis(u, -1, 0)
    o = np.zeros_like(x)
    return np.moveaxis(
        np.array([[o, -x, -y, -z], [x, o, -z, y], [y, z, o, -x], [z, -y, x, o]]), (0, 1), (-2, -1)
    )


def _right(u):
    """Matrix of q -> q u."""
    x, y, z = np.moveaxis(u, -1, 0)
    o = np.zeros_like(x)
    return np.moveaxis(
        np.array([[o, -x, -y, -z], [x, o, z, -y], [y, -z, o, x], [z, y, -x, o]]), (0, 1), (-2, -1)
    )


def quadrics(r, e):
    """Symmetric Q_k with q . Q_k q = r_k . R(q) e_k; r and e (..., 3, 3) -> (..., 3, 4, 4)."""
    product = np.swapaxes(_left(r), -1, -2) @ _right(np.broadcast_to(e, r.shape))
    return 0.5 * (product + np.swapaxes(product, -1, -2))


def complex_zeros(forms, seed=7):
    """The eight complex zeros, shape (n, 8, 4), unit largest entry, and how well, (n,).

    Null space of the degree-4 Macaulay matrix, then the pencil of two linear forms on it, then
    Newton's method in complex numbers. The second result is the distance of the nearest two
    zeros, or 0 where some zero did not settle.
    """
    n = len(forms)
    macaulay = np.zeros((n, 30, 35))
    for k in range(3):
        for row, factor in enumerate(_SECOND):
            for i in range(4):
                for j in range(4):
                    column = _ROW[tuple(sorted((*factor, i, j)))]
                    macaulay[:, 10 * k + row, column] += forms[:, k, i, j]
    null = np.linalg.svd(macaulay)[2][:, -8:].transpose(0, 2, 1)
    linear = np.random.default_rng(seed).normal(size=(2, 4))
    times = [[_ROW[tuple(sorted((*third, i)))] for third in _THIRD] for i in range(4)]
    first, second = (sum(form[i] * null[:, times[i]] for i in range(4)) for form in linear)
    values, vectors = np.linalg.eig(np.linalg.pinv(first) @ second)
    del values
    thirds = first @ vectors
    cubes = [_THIRD.index((i, i, i)) for i in range(4)]
    largest = np.argmax(np.abs(thirds[:, cubes]), axis=1)
    q = np.empty((n, 8, 4), dtype=complex)
    for i in range(4):
        rows = np.array([_THIRD.index(tuple(sorted((big, big, i)))) for big in range(4)])[largest]
        q[:, :, i] = np.take_along_axis(thirds, rows[:, None, :], axis=1)[:, 0]
    scale = np.take_along_axis(q, np.argmax(np.abs(q), axis=2)[:, :, None], axis=2)
    q /= scale
    fixed = np.argmax(np.abs(q), axis=2)
    with np.errstate(all="ignore"):
        for _ in range(6):
            half = np.einsum("nkij,nmj->nmki", forms, q)
            slope = np.zeros((n, 8, 4, 4), dtype=complex)
            slope[:, :, :3] = 2.0 * half
            np.put_along_axis(slope[:, :, 3], fixed[:, :, None], 1.0, axis=2)
            value = np.zeros((n, 8, 4), dtype=complex)
            value[:, :, :3] = np.einsum("nmki,nmi->nmk", half, q)
            slope += 1e-300 * np.eye(4)
            q = q - np.linalg.solve(slope, value[..., None])[..., 0]
        half = np.einsum("nkij,nmj->nmki", forms, q)
        wrong = np.abs(np.einsum("nmki,nmi->nmk", half, q)).max(axis=(1, 2)) > 1e-12
    unit = q / np.linalg.norm(q, axis=2, keepdims=True)
    overlap = np.abs(np.einsum("nai,nbi->nab", unit, unit.conj())) - 2.0 * np.eye(8)
    gap = np.sqrt(np.maximum(1.0 - overlap.max(axis=(1, 2)) ** 2, 0.0))
    gap[wrong | ~np.isfinite(gap)] = 0.0
    return q, gap


def real_rotations(q, near=1e-9):
    """Rotations (m, 3, 3) of those of the zeros (8, 4) that are real to `near`."""
    real = np.abs(q.imag).max(axis=1) < near
    unit = q.real[real]
    return rotation_of(unit / np.linalg.norm(unit, axis=1)[:, None])


def exact_rotations(r, e, q, digits=50):
    """Refine eight zeros (8, 4) to `digits`, tell the real ones apart there, and give them.

    r and e are what the doubles say exactly. Returns (m, 3, 3) doubles; asserts that the eight
    stay distinct, which proves that none is missing.
    """
    with mp.workdps(digits):
        forms = [_exact_quadric(r[k], e[k]) for k in range(3)]
        zeros = [_refined(forms, zero) for zero in q]
        for i in range(8):
            for j in range(i):
                assert max(abs(a - b) for a, b in zip(*_aligned(zeros[i], zeros[j]), strict=True)) \
                    > mp.mpf(10) ** -20  # fmt: skip
        small = mp.mpf(10) ** -25
        real = [[z.real for z in zero] for zero in zeros if max(abs(z.imag) for z in zero) < small]
        found = []
        for zero in real:
            length = mp.sqrt(sum(z * z for z in zero))
            found.append(rotation_of([float(z / length) for z in zero]))
    return np.array(found).reshape(-1, 3, 3)


def _exact_quadric(r, e):
    """Q_k in exact numbers: integer matrices times the doubles r_i e_j."""
    entries = {}
    for i in range(3):
        for j in range(3):
            pattern = quadrics(np.eye(3)[[i]][None], np.eye(3)[[j]][None])[0, 0]
            for a in range(4):
                for b in range(4):
                    if pattern[a, b]:
                        term = (
                            mp.mpf(float(pattern[a, b])) * mp.mpf(float(r[i])) * mp.mpf(float(e[j]))
                        )
                        entries[a, b] = entries.get((a, b), mp.mpf(0)) + term
    return entries


def _refined(forms, zero):
    q = [mp.mpc(complex(z)) for z in zero]
    fixed = int(np.argmax(np.abs(zero)))
    q = [z / q[fixed] for z in q]
    free = [i for i in range(4) if i != fixed]
    for _ in range(60):
        slope, value = mp.zeros(3, 3), mp.zeros(3, 1)
        for k, form in enumerate(forms):
            half = [sum(v * q[b] for (row, b), v in form.items() if row == a) for a in range(4)]
            value[k] = sum(half[a] * q[a] for a in range(4))
            for column, a in enumerate(free):
                slope[k, column] = 2 * half[a]
        step = mp.lu_solve(slope, -value)
        for column, a in enumerate(free):
            q[a] += step[column]
        if max(abs(x) for x in step) < mp.mpf(10) ** (5 - mp.mp.dps):
            return q
    raise AssertionError("a zero does not settle")


def _aligned(a, b):
    """Both scaled to 1 where a is largest."""
    at = max(range(4), key=lambda i: abs(a[i]))
    if abs(b[at]) < mp.mpf(10) ** -10:
        return a, b
    return [x / a[at] for x in a], [x / b[at] for x in b]


def same_rotations(found, expected, tolerance):
    """Missing and spurious: how many of one set have no partner in the other."""
    if not len(found) or not len(expected):
        return len(expected), len(found)
    apart = np.abs(found[:, None] - expected[None]).max(axis=(2, 3))
    return int(np.sum(apart.min(axis=0) > tolerance)), int(np.sum(apart.min(axis=1) > tolerance))


@dataclass(frozen=True)
class Census:
    """Figures of a comparison over many configurations."""

    configurations: int
    roots: int
    admissible: int
    missing: int
    spurious: int
    in_exact_numbers: int
    nearest: float


def census(solve, geometries, gammas, hardest):
    """Compare `solve(geometry, gammas)` -> (owner, rotations, admissible) with the zeros.

    Configurations whose zeros are nearest to each other, or not real by least, are decided in 50
    digits: at least `hardest` of them, and all with a gap below 1e-5.
    """
    r = np.concatenate([_carriages(g, x) for g, x in zip(geometries, gammas, strict=True)])
    e = np.concatenate(
        [np.tile(g.e, (len(x), 1, 1)) for g, x in zip(geometries, gammas, strict=True)]
    )
    zeros, gap = complex_zeros(quadrics(r, e))
    imaginary = np.abs(zeros.imag).max(axis=2)
    doubtful = np.where(imaginary > 1e-10, imaginary, np.inf).min(axis=1)
    order = np.argsort(np.minimum(gap, doubtful))
    exact = set(order[:hardest]) | set(np.nonzero(np.minimum(gap, doubtful) < 1e-5)[0])
    roots = admissible = missing = spurious = index = 0
    for geometry, gamma in zip(geometries, gammas, strict=True):
        owner, rotations, valid = solve(geometry, gamma)
        for row in range(len(gamma)):
            mine = owner == row
            if index in exact:
                expected = exact_rotations(r[index], e[index], zeros[index])
            else:
                expected = real_rotations(zeros[index])
            lost, extra = same_rotations(rotations[mine], expected, 1e-9)
            expected_valid = sum(_admissible(geometry, r[index], one) for one in expected)
            assert expected_valid == int(np.sum(valid[mine])), (geometry, gamma[row])
            roots, admissible = roots + len(expected), admissible + expected_valid
            missing, spurious, index = missing + lost, spurious + extra, index + 1
    return Census(index, roots, admissible, missing, spurious, len(exact), float(gap.min()))


def _carriages(geometry, gamma):
    across = np.cross(geometry.w, geometry.v)
    return np.cos(gamma)[..., None] * geometry.v + np.sin(gamma)[..., None] * across


def _admissible(geometry, r, rotation):
    """Eq. 4 and 0 < beta_k <= beta_max, with beta_k as the angle from s to r_k against t_k."""
    s, t = rotation[:, 2], geometry.e @ rotation.T
    beta = np.arctan2(np.sum(r * np.cross(t, s), axis=1), r @ s)
    return bool(np.all(geometry.w @ s > 0) and np.all((beta > 0) & (beta <= geometry.beta_max)))
