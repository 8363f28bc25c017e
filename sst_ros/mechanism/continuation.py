# SPDX-License-Identifier: Apache-2.0
"""Follow one assembly along a motion gamma, proving at every step that it is the same.

Let A have the rows t_k x r_k, so that turning R by a small phi changes r_k . R e_k by A
phi, and let sigma be its least singular value. Along a straight segment of length d in
gamma the residual and the slope change by at most d, and second derivatives by phi are
at most 1 a row. So sqrt(3) bounds how fast the slope changes, 1/(sigma - d) its
inverse, and d/(sigma - d) the first step of Newton's method. By the Newton-Kantorovich
theorem a unique assembly exists near R for every point of the segment, and Newton's
method from R finds it, as long as

    sqrt(3) d / (sigma - d)^2 <= 1/2,   for which   d <= 0.18 sigma^2   is enough.

So no step jumps to another branch, however near it is; steps shrink only toward a
parallel singularity (sigma = 0). Nothing happens here at the edge of the workspace,
beta_k = 0.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from sst_ros.errors import AssemblyError, SingularConfiguration
from sst_ros.mechanism import kinematics
from sst_ros.mechanism.geometry import Array, Geometry, cross, frozen
from sst_ros.mechanism.kinematics import CLOSURE_ROUNDING, rotate

SAFE_STEP = 0.18  # in gamma [rad] over sigma^2; a longer one might leave the branch
LEAST_SIGMA = 1e-5  # at which a branch is followed
ASSEMBLY_RESIDUAL = (
    1e-9  # largest abs(r_k . t_k) of a rotation that is given as an assembly
)
ITERATIONS = 20  # of Newton's method at most: it converges quadratically
MOST_STEPS = 20_000  # between two points
SQRT2 = 2.0**0.5


class BranchEnds(SingularConfiguration):
    """The branch meets a parallel singularity before the motion ends.

    `measure` is sigma, the least singular value of J2, at the last assembly.
    """

    def __init__(
        self, measure: float, row: int, gamma: Array, rotation: Array, j2: Array
    ) -> None:
        self.row = row  #: index of the point of the motion that was not reached
        self.gamma = gamma  #: actuator angles of the last assembly [rad], shape (3,)
        self.rotation = rotation  #: R of the last assembly, shape (3, 3)
        self.det_j2 = float(np.linalg.det(j2))  #: determinant of J2 there
        angles = np.array2string(gamma, precision=9)
        super().__init__(
            f"parallel singularity before point {row}: the branch ends at gamma ="
            f" {angles} rad, det J2 = {self.det_j2:.3e}, least singular value",
            measure,
        )


def follow(
    geometry: Geometry, gamma: ArrayLike, rotation: ArrayLike | None = None
) -> tuple[Array, Array]:
    """Follow a branch along straight segments between points gamma [rad], (n, 3).

    Sample a curved motion finely enough that the chords stand for it. `rotation` is R
    of the assembly at gamma[0], by default of the admissible one. Returns R, shape (n,
    3, 3), and the least singular values of J2, shape (n,), read-only.

    Raises:
        AssemblyError: rotation is None and there is no unique admissible assembly,
            rotation is no assembly at gamma[0], or gamma is not (n, 3) finite numbers.
        BranchEnds: a parallel singularity lies on the path (or the motion runs along
            one so near that no number of steps would do); carries where, and how near.

    """
    points = np.array(gamma, dtype=float)
    is_table = points.ndim == 2 and points.shape[1] == 3
    if not is_table or not np.all(np.isfinite(points)):
        raise AssemblyError("gamma must be rows of three finite numbers", points)
    if rotation is None:
        rotation = kinematics.admissible(geometry, points[0]).rotation
    rotations = np.empty((len(points), 3, 3))
    rotations[0] = rotate(np.array(rotation, dtype=float), np.zeros(3))
    residual = kinematics.closure(geometry, points[0], rotations[0])
    if np.abs(residual).max() > ASSEMBLY_RESIDUAL:
        raise AssemblyError("rotation does not close the loops", points[0])
    rotations[0] = _newton(geometry, points[0], rotations[0])
    for row in range(1, len(points)):
        rotations[row] = advance(
            geometry, rotations[row - 1], points[row - 1], points[row], row
        )
    sigma = _least_singular(_slope(geometry, points, rotations))
    frozen(rotations, sigma)
    return rotations, sigma


def advance(
    geometry: Geometry,
    rotation: ArrayLike,
    start: ArrayLike,
    end: ArrayLike,
    row: int = 1,
) -> Array:
    """Return R, shape (3, 3), at the end of a segment in gamma [rad], from its start.

    The branch is that of the assembly `rotation` at the start. The steps are proved not
    to leave the branch. Where a parallel singularity lies on the path, BranchEnds is
    raised; it says that the end is point `row` of a motion.
    """
    begin = np.array(start, dtype=float)
    goal = np.array(end, dtype=float)
    current = np.array(rotation, dtype=float)
    gamma = begin
    length = float(np.linalg.norm(goal - begin))
    travelled = 0.0
    for _ in range(MOST_STEPS):
        slope = _slope(geometry, gamma, current)
        sigma = float(_least_singular(slope))
        if travelled >= length:
            return current
        if sigma < LEAST_SIGMA:
            break
        step = SAFE_STEP * sigma * sigma
        travelled = min(travelled + step, length)
        following = goal
        if travelled < length:
            following = begin + (travelled / length) * (goal - begin)
        moved = _newton(geometry, following, current)
        # The theorem speaks of a ball about R; a result beyond it would be another
        # assembly.
        if np.linalg.norm(moved - current) > SQRT2 * (sigma - step) / 2.0:
            break
        gamma = following
        current = moved
    raise BranchEnds(sigma, row, gamma, current, slope)


def _least_singular(matrices: Array) -> Array:
    """Return the least singular values of matrices (..., 3, 3)."""
    descending = np.linalg.svd(matrices, compute_uv=False)
    return np.asarray(descending[..., -1], dtype=float)


def _slope(geometry: Geometry, gamma: Array, rotation: Array) -> Array:
    """Matrices A (..., 3, 3), equal to J2: rows t_k x r_k = -(r_k x t_k)."""
    t = kinematics.star_axes(geometry, rotation)
    return cross(t, kinematics.carriage_directions(geometry, gamma))


def _newton(geometry: Geometry, gamma: Array, rotation: Array) -> Array:
    """Return the best iterate R of Newton's method at gamma, shape (3, 3)."""
    r = kinematics.carriage_directions(geometry, gamma)
    best = rotation
    least = np.inf  # residual of `best`
    for _ in range(ITERATIONS):
        t = geometry.e @ rotation.T
        residual = np.sum(r * t, axis=1)
        largest = float(np.abs(residual).max())
        if largest < least:
            best = rotation
            least = largest
        if largest < CLOSURE_ROUNDING:
            break
        rotation = rotate(rotation, np.linalg.solve(cross(t, r), -residual))
    return best
