# SPDX-License-Identifier: Apache-2.0
"""Random manipulators and states.

All assemblies as the eight complex zeros of three quadrics.
"""

from itertools import combinations, combinations_with_replacement

import numpy as np
from lagrange import exact, solve
from models import Sample, assembly_of, rigid_body, scene_of
from mpmath import mp
from scipy.spatial.transform import Rotation

from sst_ros.mechanism import kinematics
from sst_ros.mechanism.geometry import Geometry

ISOTROPIC = Geometry.build(np.eye(3), np.radians([120.0, 120.0, 120.0]))
FOLDING = Geometry.build(np.eye(3), np.radians([210.0, 75.0, 75.0]))
SIZES = (0.3, *(0.1,) * 3, *(0.05,) * 3)
"""Of the inertias of star, actuated and intermediate links."""


def random_geometry(rng, roughness=1.0):
    """A general manipulator: a right-handed base triangle of some size, arcs of >= 20
    deg.
    """
    while True:
        v = np.eye(3) + roughness * rng.uniform(-0.6, 0.6, (3, 3))
        v /= np.linalg.norm(v, axis=1)[:, None]
        if np.linalg.det(v) > 0.15:
            break
    alpha = np.radians(20.0 + 300.0 * rng.dirichlet([2.0, 2.0, 2.0]))
    return Geometry.build(v, alpha)


def random_sample(rng, geometry=None) -> Sample:
    """Full tensors for all seven links, in motion anywhere off the singularities."""
    geometry = random_geometry(rng) if geometry is None else geometry
    tensors = [rigid_body(rng.uniform(-1.0, 1.0, 6), size) for size in SIZES]
    scene = scene_of(
        geometry.v, np.degrees(geometry.alpha), tensors[0], tensors[1:4], tensors[4:]
    )
    gamma, rotation = random_pose(rng, geometry)
    rate, torque, moment = rng.normal(size=(3, 3)) * [[2.0], [1.0], [1.0]]
    return Sample(scene, Geometry.of(scene), rotation, gamma, rate, torque, moment)


def random_rotation(rng):
    return rotation_of(rng.normal(size=4))


def random_pose(rng, geometry, least=0.2):
    """gamma and R well away from both kinds of singularity."""
    while True:
        rotation = random_rotation(rng)
        gamma, mu, _ = kinematics.inverse(geometry, rotation)
        det_j2 = assembly_of(geometry, gamma, rotation).det_j2
        if min(np.sin(mu).min(), abs(det_j2)) >= least:
            return gamma, rotation


def rotation_of(q):
    """R of quaternions (w, x, y, z), shape (4,) or (n, 4)."""
    if not np.size(q):  # SciPy before 1.16 makes no rotations of none
        return np.zeros((0, 3, 3))
    return Rotation.from_quat(np.roll(q, -1, axis=-1)).as_matrix()


# All assemblies: r_k . R(q) e_k = 0 are three quadrics in the homogeneous quaternion q.
# By Bezout they have eight zeros; eight distinct ones that are found are all there are.

_FOURTH = list(combinations_with_replacement(range(4), 4))
_THIRD = list(combinations_with_replacement(range(4), 3))
_SECOND = list(combinations_with_replacement(range(4), 2))
_ROW = {monomial: row for row, monomial in enumerate(_FOURTH)}


def _patterns():
    """Symmetric P_ij with R_ij(q) = q .

    P_ij q for quaternions (w, x, y, z), (3, 3, 4, 4).
    """

    def form(q):
        return (q @ q) * rotation_of(q)

    units = np.eye(4)
    twice = [[form(a + b) - form(a) - form(b) for b in units] for a in units]
    return np.round(np.moveaxis(twice, (0, 1), (2, 3)) / 2.0)  # all are 0, 1 or -1


def quadrics(r, e):
    """Symmetric Q_k with q . Q_k q = r_k . R(q) e_k.

    r and e (..., 3, 3) -> (..., 3, 4, 4).
    """
    return np.tensordot(r[..., :, None] * np.asarray(e)[..., None, :], _patterns(), 2)


def complex_zeros(forms, seed=7):
    """The eight complex zeros, shape (n, 8, 4), unit largest entry, and how well, (n,).

    Null space of the degree-4 Macaulay matrix, then the pencil of two linear forms on
    it, then Newton's method in complex numbers. The second result is the distance of
    the nearest two zeros, or 0 where some zero did not settle.
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
    first, second = (
        sum(form[i] * null[:, times[i]] for i in range(4)) for form in linear
    )
    thirds = first @ np.linalg.eig(np.linalg.pinv(first) @ second)[1]
    cubes = [_THIRD.index((i, i, i)) for i in range(4)]
    largest = np.argmax(np.abs(thirds[:, cubes]), axis=1)
    q = np.empty((n, 8, 4), dtype=complex)
    for i in range(4):
        rows = np.array(
            [_THIRD.index(tuple(sorted((big, big, i)))) for big in range(4)]
        )[largest]
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


def exact_rotations(r, e, q, digits=50):
    """Refine eight zeros (8, 4) to `digits`, tell the real ones apart there, and give
    them.

    r and e are what the doubles say exactly. Returns (m, 3, 3) doubles; asserts that
    the eight stay distinct, which proves that none is missing.
    """
    with mp.workdps(digits):
        forms = quadrics(exact(r), exact(e))
        zeros = [_refine(forms, zero) for zero in q]
        for first, second in combinations(zeros, 2):
            # both scaled to 1 there, if they can be
            at = np.argmax(np.abs(first.astype(complex)))
            other = (
                second / second[at] if abs(second[at]) >= mp.mpf(10) ** -10 else second
            )
            assert np.abs(first / first[at] - other).max() > mp.mpf(10) ** -20
        small = mp.mpf(10) ** -25
        real = [zero for zero in zeros if max(abs(z.imag) for z in zero) < small]
        return rotation_of(
            np.reshape([[float(z.real) for z in zero] for zero in real], (-1, 4))
        )


def _refine(forms, zero):
    """Newton's method with the largest entry held."""
    q = np.frompyfunc(lambda z: mp.mpc(complex(z)), 1, 1)(zero)
    fixed = int(np.argmax(np.abs(zero)))
    q = q / q[fixed]
    free = [i for i in range(4) if i != fixed]
    for _ in range(60):
        half = forms @ q
        step = solve(2 * half[:, free], -(half @ q))
        q[free] += step
        if np.abs(step).max() < mp.mpf(10) ** (5 - mp.dps):
            return q
    raise AssertionError("a zero does not settle")


def same_rotations(found, expected, tolerance):
    """Missing and spurious: how many of one set have no partner in the other."""
    if not len(found) or not len(expected):
        return len(expected), len(found)
    apart = np.abs(found[:, None] - expected[None]).max(axis=(2, 3))
    return int(np.sum(apart.min(axis=0) > tolerance)), int(
        np.sum(apart.min(axis=1) > tolerance)
    )


def census(solve, geometries, gammas, hardest):
    """Compare `solve(geometry, gammas)` -> (owner, rotations, admissible) with the
    zeros.

    Configurations whose zeros are nearest to each other, or not real by least, are
    decided in 50 digits: at least `hardest` of them, and all with a gap below 1e-5.
    Returns how many configurations there were, assemblies that were missing and
    spurious, and the least gap.
    """
    pairs = list(zip(geometries, gammas, strict=True))
    r = np.concatenate([kinematics.carriage_directions(*pair) for pair in pairs])
    e = np.concatenate([np.tile(g.e, (len(x), 1, 1)) for g, x in pairs])
    zeros, gap = complex_zeros(quadrics(r, e))
    imaginary = np.abs(zeros.imag).max(axis=2)
    doubtful = np.where(imaginary > 1e-10, imaginary, np.inf).min(axis=1)
    order = np.argsort(np.minimum(gap, doubtful))
    exact_rows = set(order[:hardest]) | set(
        np.nonzero(np.minimum(gap, doubtful) < 1e-5)[0]
    )
    missing = spurious = index = 0
    for geometry, gamma in pairs:
        owner, rotations, valid = solve(geometry, gamma)
        for row in range(len(gamma)):
            mine = owner == row
            if index in exact_rows:
                expected = exact_rotations(r[index], e[index], zeros[index])
            else:
                expected = rotation_of(zeros[index].real[imaginary[index] < 1e-9])
            lost, extra = same_rotations(rotations[mine], expected, 1e-9)
            expected_valid = sum(
                _admissible(geometry, r[index], one) for one in expected
            )
            assert expected_valid == int(np.sum(valid[mine])), (geometry, gamma[row])
            missing, spurious, index = missing + lost, spurious + extra, index + 1
    return index, missing, spurious, float(gap.min())


def _admissible(geometry, r, rotation):
    """Eq. 4 and 0 < beta_k <= beta_max, with beta_k as the angle from s to r_k against
    t_k.
    """
    s, t = rotation[:, 2], geometry.e @ rotation.T
    beta = np.arctan2(np.sum(r * np.cross(t, s), axis=1), r @ s)
    return bool(
        np.all(geometry.w @ s > 0) and np.all((beta > 0) & (beta <= geometry.beta_max))
    )
