# SPDX-License-Identifier: Apache-2.0
"""certify_zone(): a part of the workspace proven regular and inside all limits.

With t_k = R e_k, s = R z and v_4 = v_1, a pose R is inside all limits exactly where
for k = 1, 2, 3

    -v_k . t_k > 0,  v_k+1 . t_k > 0    0 < gamma_k < arc_k,
    w_k . s > 0                         0 < beta_k, and so sin(mu_k) > 0,
    w_k . R g_k > 0                     beta_k < beta_max,

with g_k = sin(beta_max) z x e_k - cos(beta_max) z: by r_k = t_k x w_k / sin(mu_k) these
numbers are sin(mu_k) times the sine of gamma_k, arc_k - gamma_k, beta_k and beta_max -
beta_k. Each is the product of two unit vectors, and a turn by an angle moves a unit
vector by no more than that angle. So the sine of an angle, compared with the product at
one pose, decides for all poses within the angle, and for all geometries whose vectors
lie within a tolerance. With N_k = w_k - (w_k . t_k) t_k,

    det J2 = -D / (sin mu_1 sin mu_2 sin mu_3),    D = N_1 . (N_2 x N_3),

where abs(N_k) <= 1; along a turn at unit rate the first derivative of N_k is at most 1
and the second at most 2, so that the second of D is at most 12. Cells of poses are
halved until they are decided, or the budget is used up.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sst_ros.errors import (
    Check,
    SingularConfiguration,
    check_kinds,
    read_numbers,
    refuse_errors,
    refuse_unless,
    require,
)
from sst_ros.mechanism import kinematics
from sst_ros.mechanism.generic_math import cos, cross3, rows_of, sin
from sst_ros.mechanism.geometry import (
    Array,
    Geometry,
    cross,
    dot,
    rotation_matrix,
    zyz_angles,
)
from sst_ros.mechanism.workspace import measures, orientations
from sst_ros.progress import Bar
from sst_ros.proof.balls import (
    arb,
    degrees_up,
    middles,
    percent_down,
    percent_up,
    precision,
    upper,
    write_down,
)
from sst_ros.proof.scene_balls import Parts, SceneBalls, WrittenDocument, range_balls
from sst_ros.scene.scene import Scene, scene_of
from sst_ros.scene.schema import Place, key_of
from sst_ros.state import Explained

PROVEN, OPEN, REFUTED = 1, 0, -1
# Limits of a leg, in the order of its products.
_LEG_LIMITS = (
    ("gamma", "< 0"),
    ("gamma", "> arc"),
    ("beta", "< 0"),
    ("beta", "> beta_max"),
)
LIMITS_OF_LEG = len(_LEG_LIMITS)
_OF_GAMMA = slice(0, 2)  # of them, those of the stroke
ZONE_LIMITS = (
    *(f"{joint}_{leg} {end}" for leg in (1, 2, 3) for joint, end in _LEG_LIMITS),
    "parallel singularity",
)
ZONE_ROUNDING = 1e-13
"""Bound of the rounding in a product or a determinant: each comes of less than 400
operations on numbers up to 2, a unit in the last place of which is 4.4e-16."""

CURVATURE = 6.0  # half of what bounds the second derivative of D
WIDEST_ZONE = 0.3  # tolerance of a vector [rad] that is still of use
ARC_OF_CHORD = 1.01  # most ratio of an arc to its chord, up to WIDEST_ZONE
ZONE_BLOCK = 20_000  # cells that are examined at a time
MOST_BOXES = 20_000_000  # 2 GB
GEOMETRY_KEYS: tuple[Place, ...] = (
    ("base", "v"),
    ("base", "arcs_deg"),
    ("star", "alpha_deg"),
    ("workspace", "beta_max_deg"),
)
"""Numbers of a document that a geometry is made of."""

LEAST_ZONE_SIGMA = 0.01  # least singular value of J2 at which an assembly is followed
ZONE_NEWTON_STEPS = 4  # from an assembly to one that is nearer than SAFE_SHARE allows
SAFE_SHARE = 0.12  # step in gamma [rad] over the square of the least singular value
LEAST_DET_J2 = 1e-9  # abs(det J2) of a reference pose whose sign is beyond doubt
MOST_TILT = 3.0  # [rad]: near pi the azimuth moves E the less, and rounding the more
MOST_ZONE_STEPS = 200  # from one cell to the next
_PRINTED_LIMITS = 3  # those that refute the largest shares


class UnitVectors(NamedTuple):
    """The vectors of a geometry, or how far each may be from its place.

    Vectors are rows by leg, shape (3, 3), distances have the shape (3,).
    """

    v: Array
    w: Array
    e: Array
    g: Array


class TolerantGeometry(NamedTuple):
    """All geometries of the ranges: vectors and by how much they may be off [rad]."""

    vectors: UnitVectors
    tolerance: UnitVectors
    rounding: UnitVectors  # tolerance of the geometry in the middle of the ranges


class PoseBalls(NamedTuple):
    """Balls of poses: all that a turn by the radius, or less, leads to."""

    rotation: Array  # R in the middle, shape (n, 3, 3)
    radius: Array  # angle [rad], shape (n,)
    # What is known without looking at the poses, shape (n,): REFUTED by a limit, OPEN
    # where the ball may not hold all poses, else PROVEN.
    status: NDArray[np.int8]
    limit: NDArray[np.int8]  # index in ZONE_LIMITS, -1 for none
    in_stroke: NDArray[np.bool_]  # whether all gamma_k are known to be, shape (n,)


class Verdicts(NamedTuple):
    """What is proven of cells, shape (n,)."""

    status: NDArray[np.int8]  # PROVEN, OPEN or REFUTED
    limit: NDArray[np.int8]  # index in ZONE_LIMITS of what refutes it, -1 for none
    det_j2: Array  # not above the least abs(det J2) in the cell
    sine_mu: Array  # not above the least sin(mu_k) in the cell


def enclose_geometry(scene: Scene, ranges: Mapping[Place, Any]) -> TolerantGeometry:
    """Enclose the vectors of all geometries of the ranges.

    Raises InputError where the ranges are so wide that nothing would be proven.
    """

    def components(traced_scene: Parts) -> list[Any]:
        axes = traced_scene.axes
        sine, cosine = sin(axes.beta_max), cos(axes.beta_max)
        g = []
        for e in axes.e:
            x, y, _ = cross3((0.0, 0.0, 1.0), e)
            g.append((sine * x, sine * y, -cosine))
        vectors = (*axes.v, *axes.w, *axes.e, *g)
        return [component for vector in vectors for component in vector]

    vector_count = len(UnitVectors._fields) * 3
    requirement = f"must move no axis by more than {WIDEST_ZONE} rad"
    named = [key_of(place) for place in ranges]
    with refuse_errors("certify_zone", "ranges", named, requirement, ArithmeticError):
        balls = SceneBalls(scene, None, ranges)
        run = balls.compile(components, (), balls.inputs)
        varied = balls.varied_balls
        # The components of all vectors, then their slopes by each input.
        numbers_in_middle = list(map(arb, run(*middles(varied))))
        middle_vectors = rows_of(numbers_in_middle, 3)[:vector_count]
        _, *slopes_by_input = rows_of(run(*varied), 3 * vector_count)
    slopes = [rows_of(numbers, 3) for numbers in slopes_by_input]  # by input and vector
    nominal = []
    tolerance = []
    rounding = []
    for number, middle in enumerate(middle_vectors):
        vector = [float(x) for x in middle]
        nominal.append(vector)
        error = _length([x - y for x, y in zip(middle, vector, strict=True)])
        moved = arb(0)
        for slopes_of_vectors, ball in zip(slopes, varied, strict=True):
            moved += _length(slopes_of_vectors[number]) * ball.rad()
        rounding.append(ARC_OF_CHORD * upper(error) + ZONE_ROUNDING)
        tolerance.append(ARC_OF_CHORD * upper(error + moved) + ZONE_ROUNDING)
    widest = max(tolerance)
    fits = math.isfinite(widest) and widest <= WIDEST_ZONE
    refuse_unless("certify_zone", ("ranges", named, fits, requirement))
    return TolerantGeometry(
        UnitVectors(*np.array(nominal).reshape(4, 3, 3)),
        UnitVectors(*np.array(tolerance).reshape(4, 3)),
        UnitVectors(*np.array(rounding).reshape(4, 3)),
    )


def _length(vector: Sequence[Any]) -> Any:
    """Return an upper bound of the length of a vector of balls, as an exact number."""
    total = arb(0)
    for x in vector:
        total += arb(x).abs_upper() ** 2
    return total.sqrt().upper()


def decide(geometry: TolerantGeometry, poses: PoseBalls, side: float) -> Verdicts:
    """Decide for each ball of poses whether it is inside all limits, or beyond one.

    `side` is the sign that D must have.
    """
    products = limit_products(geometry.vectors, poses.rotation)
    angle = poses.radius[:, None, None]
    inside = products > _sine(angle + _spread(geometry.tolerance)) + ZONE_ROUNDING
    inside[..., _OF_GAMMA] |= poses.in_stroke[:, None, None]
    beyond = products < -_sine(angle + _spread(geometry.rounding)) - ZONE_ROUNDING

    determinant, slope = determinant_and_slope(geometry.vectors, poses.rotation)
    change = slope * poses.radius + CURVATURE * poses.radius**2 + ZONE_ROUNDING
    least = side * determinant - change - _sum_of_axes(geometry.tolerance)
    singular = side * determinant + change + _sum_of_axes(geometry.rounding) < 0.0

    is_known = poses.status == PROVEN
    proven = inside.all(axis=(1, 2)) & (least > 0.0) & is_known
    of_limits = np.column_stack([beyond.reshape(len(singular), -1), singular])
    refuted = of_limits.any(axis=1) & is_known
    limit = np.where(refuted, of_limits.argmax(axis=1), poses.limit)
    refuted |= poses.status == REFUTED
    status = np.where(refuted, REFUTED, np.where(proven, PROVEN, OPEN))
    low, high = bound_sines(geometry, poses)
    det_j2 = least / (high.prod(axis=1) + ZONE_ROUNDING)
    sine_mu = low.min(axis=1)
    return Verdicts(status.astype(np.int8), limit.astype(np.int8), det_j2, sine_mu)


def limit_products(vectors: UnitVectors, rotation: Array) -> Array:
    """Products of unit vectors that are positive inside the limits, (n, leg, limit)."""
    v, w, e, g = vectors
    transposed = np.swapaxes(rotation, -1, -2)
    t = e @ transposed
    turned_g = g @ transposed
    _x, _y, z = np.moveaxis(rotation, -1, 0)
    s = z[:, None]
    next_v = np.roll(v, -1, axis=0)
    return np.stack([-dot(v, t), dot(next_v, t), dot(w, s), dot(w, turned_g)], axis=-1)


def determinant_and_slope(vectors: UnitVectors, rotation: Array) -> tuple[Array, Array]:
    """D of rotations (n, 3, 3), and the length of its gradient by a turn, (n,) each."""
    t = vectors.e @ np.swapaxes(rotation, -1, -2)
    w = np.broadcast_to(vectors.w, t.shape)
    along = dot(t, w)
    normal = w - along[..., None] * t
    first, second, third = np.moveaxis(normal, 1, 0)
    cofactors = np.stack(
        [cross(second, third), cross(third, first), cross(first, second)], axis=1
    )
    # dN = -((d x t) . w) t - (t . w) d x t for a small turn d.
    gradients = dot(cofactors, t)[..., None] * cross(t, w)
    gradients = gradients + along[..., None] * cross(t, cofactors)
    slope = np.linalg.norm(gradients.sum(axis=1), axis=-1)
    return dot(first, cofactors[:, 0]), np.asarray(slope, dtype=float)


def bound_sines(geometry: TolerantGeometry, poses: PoseBalls) -> tuple[Array, Array]:
    """Bound sin(mu_k) in balls of poses from below and from above.

    Each bound has the shape (n, 3).
    """
    _, w, e, _ = geometry.vectors
    _, of_w, of_e, _ = geometry.tolerance
    t = e @ np.swapaxes(poses.rotation, -1, -2)
    sine = np.linalg.norm(cross(t, np.broadcast_to(w, t.shape)), axis=-1)
    moved = poses.radius[:, None] + of_w + of_e + ZONE_ROUNDING
    return sine - moved, np.minimum(sine + moved, 1.0)


def _sum_of_axes(tolerance: UnitVectors) -> float:
    """Bound how far D moves with the axes w_k and e_k."""
    return float(tolerance.w.sum() + tolerance.e.sum())


def _spread(tolerance: UnitVectors) -> Array:
    """Return how far the two vectors of each product may be off in sum.

    The axes are (leg, limit).
    """
    v, w, e, g = tolerance
    return np.stack([v + e, np.roll(v, -1) + e, w, w + g], axis=-1)


def _sine(angle: Array) -> Array:
    """Return the sine of an angle up to a right one, and 2 beyond.

    No product is larger than 2.
    """
    return np.where(angle < 0.5 * np.pi, np.sin(angle), 2.0)


class Cells(NamedTuple):
    """Boxes in three coordinates from 0 to 1, by lower corners and sizes, shape (n, 3).

    Each has a pose near it that is known, with the coordinates where that is.
    """

    low: Array
    size: Array
    known_at: Array  # shape (n, 3)
    known_rotation: Array  # R, shape (n, 3, 3)

    @property
    def middle(self) -> Array:
        """Coordinates of the middles, shape (n, 3)."""
        return self.low + 0.5 * self.size

    def rows(self, rows: Any) -> Cells:
        """Return some of the cells."""
        return Cells(*(array[rows] for array in self))

    def halve(self, axis: NDArray[np.intp]) -> Cells:
        """Halve each cell along an axis, shape (n,).

        All first halves come first, then the second ones.
        """
        row = np.arange(len(self.low))
        size = self.size.copy()
        size[row, axis] *= 0.5
        second = self.low.copy()
        second[row, axis] += size[row, axis]
        first_half = Cells(self.low, size, self.known_at, self.known_rotation)
        return join_cells([first_half, first_half._replace(low=second)])


def join_cells(cell_groups: Sequence[Cells]) -> Cells:
    """Return all cells of some parts."""
    return Cells(*(np.concatenate(arrays) for arrays in zip(*cell_groups, strict=True)))


class OrientationCap:
    """Orientations by azimuth and tilt of E and torsion about it.

    They count from a reference pose:
    R = R_0 Rz(azimuth) Ry(tilt) Rz(torsion - azimuth). The tilt moves E, the torsion
    turns the star about it (Bonev, Zlatanov & Gosselin, Parallel Kinematic Machines,
    2002). Equal volumes of the coordinates are equal shares of all orientations.
    """

    NAMES = "azimuth", "tilt", "torsion"

    def __init__(self, reference: Array, tilt: float, torsion: float) -> None:
        self.reference = reference
        self.tilt = tilt
        self.torsion = torsion
        self._most = math.sin(0.5 * tilt)

    def coordinates(self, rotation: ArrayLike) -> Array:
        """Coordinates of rotations (..., 3, 3), shape (..., 3).

        In the cap they are from 0 to 1.
        """
        relative = self.reference.T @ np.asarray(rotation, dtype=float)
        azimuth, tilt, psi = np.moveaxis(zyz_angles(relative), -1, 0)
        torsion = np.remainder(psi + azimuth + np.pi, 2.0 * np.pi) - np.pi
        azimuth_share = azimuth / (2.0 * np.pi) + 0.5
        tilt_share = (np.sin(0.5 * tilt) / self._most) ** 2
        torsion_share = torsion / (2.0 * self.torsion) + 0.5
        return np.stack([azimuth_share, tilt_share, torsion_share], axis=-1)

    def angles(self, coordinates: Array) -> Array:
        """Azimuth, tilt and torsion [rad] of coordinates, both of shape (n, 3)."""
        azimuth_share, tilt_share, torsion_share = coordinates.T
        azimuth = 2.0 * np.pi * (azimuth_share - 0.5)
        tilt = 2.0 * np.arcsin(np.sqrt(tilt_share) * self._most)
        return np.stack(
            [azimuth, tilt, self.torsion * (2.0 * torsion_share - 1.0)], axis=1
        )

    def first_cell(self) -> Cells:
        """Return all orientations as one cell."""
        return _undivided_cell(np.array([0.5, 0.0, 0.5]), self.reference)

    def poses(self, cells: Cells) -> PoseBalls:
        """Return balls that hold all poses of cells.

        Along a straight line in the angles the star turns about three axes: at the rate
        of the tilt, about an axis across the others; at that of the torsion, about E;
        and at 2 sin(tilt / 2) times that of the azimuth, about an axis at (pi + tilt) /
        2 to E.
        """
        low, high = self._tilts(cells)
        azimuth, _, torsion = self.angles(cells.middle).T
        tilt = 0.5 * (low + high)
        reach = self._reach(cells)
        around, _, about = reach.T
        square = dot(reach, reach) + 2.0 * np.sin(0.5 * high) * around * about
        radius = np.sqrt(square) + ZONE_ROUNDING
        rotation = self.reference @ tilted(azimuth, tilt, torsion)
        count = len(tilt)
        return PoseBalls(
            rotation=rotation,
            radius=radius,
            status=np.full(count, PROVEN, dtype=np.int8),
            limit=np.full(count, -1, dtype=np.int8),
            in_stroke=np.zeros(count, dtype=bool),
        )

    def longest(self, cells: Cells) -> NDArray[np.intp]:
        """Return the coordinate in which each cell reaches farthest, shape (n,)."""
        return np.asarray(self._reach(cells).argmax(axis=1))

    def _tilts(self, cells: Cells) -> tuple[Array, Array]:
        """Least and largest tilt [rad] of cells, shape (n,) each."""
        low = self.angles(cells.low)[:, 1]
        high = self.angles(np.minimum(cells.low + cells.size, 1.0))[:, 1]
        return low, high

    def _reach(self, cells: Cells) -> Array:
        """Return how far cells turn the star in each coordinate [rad], shape (n, 3)."""
        low, high = self._tilts(cells)
        azimuth_size, _, torsion_size = cells.size.T
        around = 2.0 * np.sin(0.5 * high) * np.pi * azimuth_size
        about = self.torsion * torsion_size
        return np.stack([around, 0.5 * (high - low), about], axis=1)


def _undivided_cell(known_at: Array, known_rotation: Array) -> Cells:
    """Return the cell of all coordinates, in which one pose is known."""
    return Cells(
        np.zeros((1, 3)), np.ones((1, 3)), known_at[None], known_rotation[None]
    )


def tilted(azimuth: Array, tilt: Array, torsion: Array) -> Array:
    """Return Rz(azimuth) Ry(tilt) Rz(torsion - azimuth), shape (n, 3, 3).

    The angles [rad] have the shape (n,).
    """
    psi = torsion - azimuth
    ca, sa = np.cos(azimuth), np.sin(azimuth)
    ct, st = np.cos(tilt), np.sin(tilt)
    cp, sp = np.cos(psi), np.sin(psi)
    rows = (
        (ca * ct * cp - sa * sp, -ca * ct * sp - sa * cp, ca * st),
        (sa * ct * cp + ca * sp, -sa * ct * sp + ca * cp, sa * st),
        (-st * cp, st * sp, ct),
    )
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


class GammaBox:
    """Actuator angles in a box, in the assembly that is followed from its middle.

    Let d_k bound how far r_k and t_k move from the middle of a cell, where sigma is the
    least singular value of J2. If

        abs(d) <= rho (sigma - abs(d) - sqrt(3) rho),

    the assembly goes on to exist in the whole cell, within the angle rho of that in the
    middle, and is the only one there: J2 is off by abs(d) + sqrt(3) rho at most, so the
    star turns by no more than abs(d) / (sigma - abs(d) - sqrt(3) rho) meanwhile, and
    between two assemblies r_k . t_k would have to change.
    """

    NAMES = "gamma_1", "gamma_2", "gamma_3"

    def __init__(self, tolerant: TolerantGeometry, box: Array, start: Array) -> None:
        self._tolerant = tolerant
        self._start = start
        self.low, self.high = box.T
        v, w, e, _ = tolerant.tolerance
        # r_k = cos(gamma_k) v_k + sin(gamma_k) w_k x v_k
        self._moved = math.sqrt(2.0) * v + w + e
        self._arc = _arcs(tolerant.vectors.v)
        # Least arc of all geometries, and largest arc of that in the middle.
        rounding = tolerant.rounding.v
        self._shortest = self._arc - v - np.roll(v, -1) - ZONE_ROUNDING
        self._longest = self._arc + rounding + np.roll(rounding, -1) + ZONE_ROUNDING

    def coordinates(self, gamma: ArrayLike) -> Array:
        """Coordinates of actuator angles [rad], both of shape (..., 3)."""
        angles = np.asarray(gamma, dtype=float)
        return np.asarray((angles - self.low) / (self.high - self.low))

    def angles(self, coordinates: Array) -> Array:
        """Actuator angles [rad] of coordinates, both of shape (n, 3)."""
        return np.asarray(self.low + coordinates * (self.high - self.low))

    def first_cell(self) -> Cells:
        """Return the whole box as one cell."""
        return _undivided_cell(np.full(3, 0.5), self._start)

    def longest(self, cells: Cells) -> NDArray[np.intp]:
        """Return the coordinate in which each cell is longest, shape (n,)."""
        return np.asarray((cells.size * (self.high - self.low)).argmax(axis=1))

    def poses(self, cells: Cells) -> PoseBalls:
        """Return balls that hold the assembly for all angles of cells.

        Where the assembly is not followed the status is OPEN.
        """
        rotation, followed = self._follow(cells)
        half = 0.5 * cells.size * (self.high - self.low)
        gamma = self.angles(cells.middle)
        sigma = _least_singular(self._j2(gamma, rotation))
        radius = _reach_of_assembly(half + self._moved + ZONE_ROUNDING, sigma)
        followed &= np.isfinite(radius)
        below = gamma + half < -ZONE_ROUNDING
        above = gamma - half > self._longest
        beyond = np.stack([below, above], axis=-1)  # (n, leg, end)
        in_stroke = (gamma - half > ZONE_ROUNDING) & (gamma + half < self._shortest)
        outside = beyond.any(axis=(1, 2))
        leg, end = np.divmod(beyond.reshape(-1, 6).argmax(axis=1), 2)
        status = np.where(outside, REFUTED, np.where(followed, PROVEN, OPEN))
        limit = np.where(outside, LIMITS_OF_LEG * leg + end, -1)
        return PoseBalls(
            rotation=rotation,
            radius=np.where(followed, radius, np.pi),
            status=status.astype(np.int8),
            limit=limit.astype(np.int8),
            in_stroke=in_stroke.all(axis=1),
        )

    def _follow(self, cells: Cells) -> tuple[Array, NDArray[np.bool_]]:
        """Follow the known assemblies straight to the middles of cells.

        Return the rotations there, and which of them were reached.
        """
        begin = self.angles(cells.known_at)
        segment = self.angles(cells.middle) - begin
        length = np.linalg.norm(segment, axis=1)
        rotation = cells.known_rotation.copy()
        followed_share = np.zeros(len(segment))
        active = np.flatnonzero(length > 0.0)
        for _ in range(MOST_ZONE_STEPS):
            if not len(active):
                break
            gamma = begin[active] + followed_share[active, None] * segment[active]
            sigma = _least_singular(self._j2(gamma, rotation[active]))
            regular = sigma > LEAST_ZONE_SIGMA
            active = active[regular]
            sigma = sigma[regular]
            step = SAFE_SHARE * sigma**2
            share = np.minimum(followed_share[active] + step / length[active], 1.0)
            target = begin[active] + share[:, None] * segment[active]
            moved, closes = self._newton(target, rotation[active])
            share_change = np.abs(share - followed_share[active])
            change = share_change[:, None] * np.abs(segment[active])
            reach = _reach_of_assembly(change + ZONE_ROUNDING, sigma)
            safe = closes & (_angle(rotation[active], moved) < reach)
            active = active[safe]
            rotation[active] = moved[safe]
            followed_share[active] = share[safe]
            active = active[share[safe] < 1.0]
        return rotation, (length == 0.0) | (followed_share == 1.0)

    def _rows(self, gamma: Array, rotation: Array) -> tuple[Array, Array]:
        """Directions r_k and t_k, shape (n, 3, 3) each."""
        v, w, e, _ = self._tolerant.vectors
        cosine, sine = np.cos(gamma)[..., None], np.sin(gamma)[..., None]
        return cosine * v + sine * cross(w, v), e @ np.swapaxes(rotation, -1, -2)

    def _j2(self, gamma: Array, rotation: Array) -> Array:
        r, t = self._rows(gamma, rotation)
        return cross(t, r)

    def _newton(self, gamma: Array, rotation: Array) -> tuple[Array, NDArray[np.bool_]]:
        """Return assemblies near rotations, and whether each closes the loops."""
        for _ in range(ZONE_NEWTON_STEPS):
            r, t = self._rows(gamma, rotation)
            step = np.linalg.solve(cross(t, r), -dot(r, t)[..., None])[..., 0]
            rotation = kinematics.rotate(rotation, np.asarray(step, dtype=float))
        r, t = self._rows(gamma, rotation)
        return rotation, np.abs(dot(r, t)).max(axis=1) < 0.01 * ZONE_ROUNDING


def _arcs(v: Array) -> Array:
    """Angles between unit vectors v_k and v_k+1 [rad], shape (3,)."""
    next_v = np.roll(v, -1, axis=0)
    sine = np.linalg.norm(cross(v, next_v), axis=1)
    return np.asarray(np.arctan2(sine, dot(v, next_v)), dtype=float)


def _least_singular(matrices: Array) -> Array:
    """Bound the least singular values of matrices (n, 3, 3) from below, shape (n,)."""
    sigma = np.asarray(np.linalg.svd(matrices, compute_uv=False), dtype=float)
    return np.asarray(sigma[:, -1] - ZONE_ROUNDING, dtype=float)


def _reach_of_assembly(moved: Array, sigma: Array) -> Array:
    """Return the least rho of `GammaBox` [rad], shape (n,); inf where there is none."""
    d = np.linalg.norm(moved, axis=1)
    slack = sigma - d
    square = slack**2 - 4.0 * math.sqrt(3.0) * d
    exists = (slack > 0.0) & (square > 0.0)
    root = np.sqrt(np.where(exists, square, 1.0))
    reach = 2.0 * d / (slack + root) * (1.0 + ZONE_ROUNDING)
    return np.asarray(np.where(exists, reach, np.inf), dtype=float)


def _angle(first: Array, second: Array) -> Array:
    """Return the angles between rotations, bounded from above [rad], shape (n,)."""
    chord = np.linalg.norm(first - second, axis=(1, 2)) / math.sqrt(2.0)
    half = np.arcsin(np.minimum(0.5 * chord + ZONE_ROUNDING, 1.0))
    return np.asarray(2.0 * half, dtype=float)


class Subdivision(NamedTuple):
    """Cells that cover a zone, and what is proven of each."""

    cells: Cells
    verdicts: Verdicts
    examined: int  # number of cells that were looked at


def subdivide(
    zone: OrientationCap | GammaBox,
    geometry: TolerantGeometry,
    side: float,
    max_boxes: int,
    bar: Bar,
) -> Subdivision:
    """Halve the cells of a zone until they are decided, or `max_boxes` are examined."""
    leaves: list[Cells] = []
    decided: list[Verdicts] = []
    examined = 0
    cells = zone.first_cell()
    while len(cells.low) and examined < max_boxes:
        block = cells.rows(slice(0, min(ZONE_BLOCK, max_boxes - examined)))
        later_cells = cells.rows(slice(len(block.low), None))
        poses = zone.poses(block)
        verdicts = decide(geometry, poses, side)
        examined += len(block.low)
        followed = poses.status == PROVEN
        block = block._replace(
            known_at=np.where(followed[:, None], block.middle, block.known_at),
            known_rotation=np.where(
                followed[:, None, None], poses.rotation, block.known_rotation
            ),
        )
        is_open = verdicts.status == OPEN
        leaves.append(block.rows(~is_open))
        decided.append(Verdicts(*(array[~is_open] for array in verdicts)))
        undecided_cells = block.rows(is_open)
        halves = undecided_cells.halve(zone.longest(undecided_cells))
        cells = join_cells([later_cells, halves])
        bar.draw(examined / max_boxes)
    bar.draw(1.0)
    # What is left when the budget is used up.
    leaves.append(cells)
    count = len(cells.low)
    left_open = np.full(count, OPEN, dtype=np.int8)
    no_limit = np.full(count, -1, dtype=np.int8)
    decided.append(Verdicts(left_open, no_limit, np.zeros(count), np.zeros(count)))
    verdicts = Verdicts(*(np.concatenate(rows) for rows in zip(*decided, strict=True)))
    return Subdivision(join_cells(leaves), verdicts, examined)


class NearestLimit(NamedTuple):
    """A pose of the zone that is beyond a limit, the nearest one that was found."""

    rotation: Array  # R, shape (3, 3)
    distance: float  # angle from the reference pose [rad]
    limit: str  # which one, of ZONE_LIMITS


class ProvenZone(Explained):
    """What is proven of a zone of the workspace, for all geometries of the ranges.

    Attributes:
        scene: whose workspace it is.
        reference: R of the pose that the zone is about, shape (3, 3).
        names: names of the three coordinates: azimuth, tilt and torsion, or gamma_1 to
            gamma_3.
        columns: by name, shape (n,): the boxes that cover the zone, from NAME_low to
            NAME_high [rad] in each coordinate; status, 1 where a box is proven, -1
            where it is refuted, 0 where it is open; limit, the index in `limits` of
            what refutes it, or -1; share of the zone.
        proven: share of the zone that is proven, not rounded up.
        refuted: share of it that is beyond a limit at the geometry in the middle of the
            ranges, not rounded up.
        open: share that is neither.
        refuted_by: share that each limit refutes; the first one, where several do.
        least_det_j2: abs(det J2) is larger in all that is proven; nan where nothing is.
        least_sine_mu: so is sin(mu_k), of which det J1 is the product up to its sign.
        nearest: a pose that is refuted, of those found the nearest to the reference;
            None where there is none.
        examined: number of boxes that were looked at.

    """

    limits = ZONE_LIMITS

    def __init__(
        self,
        scene: Scene,
        zone: OrientationCap | GammaBox,
        reference: Array,
        parts: Subdivision,
    ) -> None:
        self.scene = scene
        self.reference = reference
        self.examined = parts.examined
        self.names = zone.NAMES
        self._zone = zone
        cells = parts.cells
        self._cells = cells
        verdicts = parts.verdicts
        low, high = zone.angles(cells.low), zone.angles(cells.low + cells.size)
        self.columns: dict[str, NDArray[Any]] = {}
        for i, name in enumerate(self.names):
            self.columns[f"{name}_low"] = low[:, i]
            self.columns[f"{name}_high"] = high[:, i]
        share = cells.size.prod(axis=1)
        self.columns |= {
            "status": verdicts.status,
            "limit": verdicts.limit,
            "share": share,
        }
        for numbers in self.columns.values():
            numbers.flags.writeable = False
        # Sums of halves of halves are exact.
        is_proven = verdicts.status == PROVEN
        is_refuted = verdicts.status == REFUTED
        self.proven = float(share[is_proven].sum())
        self.refuted = float(share[is_refuted].sum())
        self.open = 1.0 - self.proven - self.refuted
        self.refuted_by: dict[str, float] = {}
        for index, name in enumerate(ZONE_LIMITS):
            self.refuted_by[name] = float(share[verdicts.limit == index].sum())
        self.least_det_j2 = float(np.min(verdicts.det_j2[is_proven], initial=np.inf))
        self.least_sine_mu = float(np.min(verdicts.sine_mu[is_proven], initial=np.inf))
        if not self.proven:
            self.least_det_j2 = math.nan
            self.least_sine_mu = math.nan
        self.nearest = self._find_nearest(
            cells.rows(is_refuted), verdicts.limit[is_refuted]
        )

    def _find_nearest(
        self, cells: Cells, limits: NDArray[np.int8]
    ) -> NearestLimit | None:
        """Find the middle of a cell that is nearest to the reference pose."""
        if not len(cells.low):
            return None
        poses = self._zone.poses(cells)
        distance = _angle(
            poses.rotation, np.broadcast_to(self.reference, poses.rotation.shape)
        )
        row = int(distance.argmin())
        return NearestLimit(
            poses.rotation[row], float(distance[row]), ZONE_LIMITS[limits[row]]
        )

    def __len__(self) -> int:
        """Return the number of boxes."""
        return len(self.columns["status"])

    @property
    def success(self) -> bool:
        """Whether the whole zone is proven."""
        return self.proven == 1.0

    @property
    def shares(self) -> str:
        """The shares in words, rounded outward."""
        phrases = [f"{percent_down(self.proven, 6)} proven"]
        if self.refuted:
            phrases.append(f"{percent_down(self.refuted, 6)} refuted")
        if self.open:
            phrases.append(f"{percent_up(self.open, 6)} open")
        return ", ".join(phrases)

    def status_of(self, poses: ArrayLike) -> NDArray[np.int8]:
        """Return the status of poses, shape (m,).

        It is 1 for proven, -1 for refuted, 0 for anything else. Poses are rotations R,
        shape (m, 3, 3); of a box of actuator angles these, (m, 3).
        """
        low, high = self._cells.low, self._cells.low + self._cells.size
        status = np.zeros(len(np.asarray(poses)), dtype=np.int8)
        for row, place in enumerate(self._zone.coordinates(poses)):
            inside = np.all((low <= place) & (place <= high), axis=1)
            if inside.any():
                status[row] = self.columns["status"][inside].min()
        return status

    def turns_at(self, directions: ArrayLike) -> Array:
        """Torsion [rad] that is refuted, open and proven at directions of E in {B}.

        Both have the shape (m, 3); the torsions are zero outside of the cap. Raises
        InputError for a box of actuator angles, which has no torsion.
        """
        zone = self._zone
        is_cap = isinstance(zone, OrientationCap)
        refuse_unless("turns_at", ("zone", self.names, is_cap, "must be a cap"))
        assert isinstance(zone, OrientationCap)
        places = zone.coordinates(orientations(np.asarray(directions), 0.0))
        low = self._cells.low
        high = low + self._cells.size
        _, _, torsion_size = self._cells.size.T
        widths = 2.0 * zone.torsion * torsion_size
        of_direction = slice(0, 2)  # azimuth and tilt
        turns = np.zeros((len(places), 3))
        for row, place in enumerate(places):
            above = low[:, of_direction] <= place[of_direction]
            below = place[of_direction] < high[:, of_direction]
            inside = np.all(above & below, axis=1)
            column = self.columns["status"][inside] - REFUTED  # from 0 on
            turns[row] = np.bincount(column, widths[inside], minlength=3)
        return turns

    def middles(self) -> Array:
        """R in the middle of each box, shape (n, 3, 3); nan where none is known."""
        poses = self._zone.poses(self._cells)
        is_known = poses.status != OPEN
        return np.asarray(np.where(is_known[:, None, None], poses.rotation, np.nan))

    def to_pandas(self) -> Any:
        """Table of `columns`."""
        return require("pandas").DataFrame(self.columns)

    def _facts(self) -> dict[str, object]:
        low, high = self._zone.angles(np.array([[0.0] * 3, [1.0] * 3])).tolist()
        extent = zip(self.names, low, high, strict=True)
        facts: dict[str, object] = {
            "scene": self.scene.name,
            "zone": ", ".join(
                f"{name} {least!r} to {most!r} rad" for name, least, most in extent
            ),
            "shares": self.shares,
        }
        shares = {name: share for name, share in self.refuted_by.items() if share}
        if shares:
            largest = sorted(shares, key=shares.__getitem__, reverse=True)
            limit_shares = [
                f"{percent_down(shares[name], 3)} {name}"
                for name in largest[:_PRINTED_LIMITS]
            ]
            facts["refuted by"] = ", ".join(limit_shares)
        if self.proven:
            facts["abs(det J2)"] = f"above {write_down(self.least_det_j2, 3)}"
            facts["sin(mu)"] = f"above {write_down(self.least_sine_mu, 3)}"
        if self.nearest:
            away = degrees_up(self.nearest.distance, 4)
            facts["beyond"] = f"{self.nearest.limit}, {away} from the reference pose"
        return facts | {"boxes": self.examined}


@check_kinds
def certify_zone(
    scene: Scene | Mapping[str, Any] | str | Path,
    gamma_box: ArrayLike | None = None,
    *,
    tilt: float | None = None,
    torsion: float = math.pi,
    orientation: ArrayLike | None = None,
    ranges: Mapping[str, Any] | None = None,
    max_boxes: int = 200_000,
    progress: bool = False,
) -> ProvenZone:
    """Prove where the manipulator is regular and inside all limits.

    The proof is for given tolerances. A pose is inside where 0 < gamma_k < arc P_k
    P_k+1, E lies on the base triangle and 0 < beta_k < beta_max; it is regular where
    neither det J1 nor det J2 is zero. What is proven is so for every geometry of the
    ranges, with one sign of det J2: that of the reference pose. Rounding is outward.
    What the scene does at an end or an edge (`at_end`, `at_edge`) has no part in it.

    Without `gamma_box` the zone is all orientations whose E is within the angle `tilt`
    of that of the reference pose, and which are turned about E by no more than
    `torsion` (tilt and torsion angles); shares are those of all orientations of the
    zone. With it, the zone is all actuator angles of a box, in the assembly that is
    followed from its middle without meeting a singularity; shares are those of its
    volume.

    Args:
        scene: as `simulate` takes it.
        gamma_box: least and largest angle of each actuator [rad], shape (3, 2).
        tilt: half of the opening of the cap [rad], at most 3; by default as far as the
            farthest corner of the base triangle.
        torsion: largest turn about E [rad], at most pi.
        orientation: quaternion (x, y, z, w) of the reference pose; by default that at
            the start of the scene. With a box it selects the assembly in the middle,
            within 0.1 rad, where several are admissible.
        ranges: tolerances of the geometry, as `certify` takes them: of base.v or
            base.arcs_deg, star.alpha_deg and workspace.beta_max_deg.
        max_boxes: number of boxes after which the rest is left open, some 5 us each.
        progress: draw a bar on a terminal.

    Raises:
        InputError: an argument is not allowed; names it and the allowed values.
        AssemblyError: the scene does not start, or the middle of the box is, in a
            unique admissible assembly.
        SingularConfiguration: the reference pose is singular.
        MissingDependency: python-flint is not installed.

    """
    checked_scene = scene_of(scene)
    _check_arguments(gamma_box, tilt, torsion, orientation, max_boxes)
    geometry = Geometry.of(checked_scene)
    box = None if gamma_box is None else np.array(gamma_box, dtype=float)
    reference, det_j2 = _reference_pose(checked_scene, box, orientation)
    if abs(det_j2) < LEAST_DET_J2:
        raise SingularConfiguration("parallel singularity, det J2 = 0", det_j2)
    with precision():
        balls = range_balls(
            WrittenDocument.of(checked_scene),
            ranges or {},
            own_torque=True,
            origin="certify_zone",
        )
        _refuse_other_ranges(balls)
        tolerant = enclose_geometry(checked_scene, balls)
    zone: OrientationCap | GammaBox
    if box is not None:
        zone = GammaBox(tolerant, box, reference)
    else:
        corners = np.arccos(np.clip(geometry.v @ reference[:, 2], -1.0, 1.0))
        widest = float(corners.max()) if tilt is None else float(tilt)
        zone = OrientationCap(reference, min(widest, MOST_TILT), float(torsion))
    side = -math.copysign(1.0, det_j2)
    bar = Bar("certify_zone", progress)
    subdivision = subdivide(zone, tolerant, side, max_boxes, bar)
    return ProvenZone(checked_scene, zone, reference, subdivision)


def _reference_pose(
    scene: Scene, box: Array | None, orientation: ArrayLike | None
) -> tuple[Array, float]:
    """Return R of the reference pose, shape (3, 3), and its det J2."""
    geometry = Geometry.of(scene)
    selected = scene.initial.orientation if orientation is None else orientation
    selected_rotation = None if selected is None else rotation_matrix(selected)
    if orientation is not None and box is None:
        assert selected_rotation is not None
        gamma, _, _ = kinematics.inverse(geometry, selected_rotation)
        measured = measures(geometry, gamma, selected_rotation)
        requirement = "must be inside all limits of the scene"
        is_inside = bool(measured.admissible)
        refuse_unless(
            "certify_zone", ("orientation", orientation, is_inside, requirement)
        )
        return selected_rotation, float(measured.det_j2)
    angles = scene.initial.gamma if box is None else box.mean(axis=1)
    start = kinematics.admissible(geometry, angles, selected_rotation)
    return np.array(start.rotation), start.det_j2


def _check_arguments(
    gamma_box: ArrayLike | None,
    tilt: float | None,
    torsion: float,
    orientation: ArrayLike | None,
    max_boxes: int,
) -> None:
    """Refuse what is no zone."""
    checks: list[Check] = []
    if gamma_box is not None:
        box = read_numbers("certify_zone", "gamma_box", gamma_box)
        is_box = box.shape == (3, 2) and bool(np.all(np.isfinite(box)))
        is_box = is_box and bool(np.all(box[:, 0] < box[:, 1]))
        requirement = "must be the least and the largest angle of three actuators [rad]"
        checks.append(("gamma_box", gamma_box, is_box, requirement))
        alone = tilt is None and torsion == math.pi
        requirement = "are those of a cap: leave them out with gamma_box"
        checks.append(("tilt, torsion", (tilt, torsion), alone, requirement))
    if orientation is not None:
        q = read_numbers("certify_zone", "orientation", orientation)
        is_quaternion = q.shape == (4,) and bool(np.all(np.isfinite(q)) and np.any(q))
        requirement = "must be a quaternion (x, y, z, w), not zero"
        checks.append(("orientation", orientation, is_quaternion, requirement))
    is_tilt = tilt is None or 0.0 < tilt <= MOST_TILT
    checks.append(("tilt", tilt, is_tilt, f"must be > 0 and at most {MOST_TILT:g} rad"))
    is_torsion = 0.0 < torsion <= math.pi
    checks.append(("torsion", torsion, is_torsion, "must be > 0 and at most pi [rad]"))
    requirement = f"must be from 1 to {MOST_BOXES}"
    checks.append(("max_boxes", max_boxes, 1 <= max_boxes <= MOST_BOXES, requirement))
    refuse_unless("certify_zone", *checks)


def _refuse_other_ranges(balls: Mapping[Place, Any]) -> None:
    """Refuse ranges of numbers that the geometry does not depend on."""
    geometry = ", ".join(map(key_of, GEOMETRY_KEYS))
    requirement = f"is no part of the geometry, which is {geometry}"
    for place in balls:
        is_geometry = any(place[: len(key)] == key for key in GEOMETRY_KEYS)
        refuse_unless(
            "certify_zone", ("ranges", key_of(place), is_geometry, requirement)
        )
