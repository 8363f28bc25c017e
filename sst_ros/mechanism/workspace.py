# SPDX-License-Identifier: Apache-2.0
"""Where the star can go, how far every limit is, how well the actuators hold it, what is singular.

A pose is admissible when E lies on the base triangle (Eq. 4), 0 < beta_k <= beta_max,
and gamma_k lies in its stroke. The map is over orientations (direction of s, turn psi
about it), where the inverse kinematics has one answer.

Singular poses are of two kinds. Serial (det J1 = 0): c_k = sin(mu_k) = 0 means t_k =
+-w_k, so w_k.s = 0: E lies on the base arc P_k P_k+1. By Eq. 4 such poses are only ever
at the edge of what is admissible, never inside. Parallel (det J2 = 0): may lie inside
when some alpha_k > 180 deg; none for all alpha_k < 180 deg and beta_k < 90 deg.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sst_ros.errors import check_kinds, refuse_unless
from sst_ros.mechanism import kinematics
from sst_ros.mechanism.geometry import Array, Geometry, columns, cross, frozen
from sst_ros.progress import slices
from sst_ros.scene.scene import SceneInput, scene_of
from sst_ros.state import Explained

_BLOCK, _BISECTIONS = 20_000, 55
_RAYS, _RAY, _REFINED = 400, 64, 6
"""Rays from a pose, points of each, and the nearest changes of sign that are refined."""

_MOST = 20_000_000  # poses of a map: 4 GB


@dataclass(frozen=True, repr=False)
class Measures(Explained):
    """What a designer asks of poses; arrays share the shape (...) of the poses.

    Read-only.
    """

    gamma: Array  #: joint angles [rad], shape (..., 3)
    mu: Array
    beta: Array
    admissible: NDArray[np.bool_]  #: the manipulator can be there
    #: distance of the nearest gamma_k to an end of its stroke [rad], negative beyond
    stroke: Array
    #: smallest beta_k [rad]: distance to the edge of the workspace, negative beyond
    edge: Array
    reach: Array  #: smallest beta_max - beta_k [rad]
    det_j1: Array  #: 0 at a serial singularity
    det_j2: Array  #: 0 at a parallel singularity
    cond_j: Array  #: condition number of J = -J2^-1 J1, infinite at both

    def _facts(self) -> dict[str, object]:
        finite = self.cond_j[np.isfinite(self.cond_j)]
        smallest = {
            "least way to an end of the stroke [rad]": self.stroke,
            "least beta, way to the edge [rad]": self.edge,
            "least way to the largest beta [rad]": self.reach,
            "least |det J1|, 0 is serially singular": np.abs(self.det_j1),
            "least |det J2|, 0 is parallelly singular": np.abs(self.det_j2),
        }
        facts: dict[str, object] = {"poses": self.cond_j.size}
        facts["admissible"] = int(np.count_nonzero(self.admissible))
        for name, values in smallest.items():
            facts[name] = float(np.min(values, initial=np.inf))
        facts["largest finite cond J"] = float(np.max(finite, initial=1.0))
        return facts

    @property
    def margin(self) -> Array:
        """Distance to the nearest of all limits [rad], negative beyond one."""
        return np.minimum(np.minimum(self.stroke, self.edge), self.reach)


@dataclass(frozen=True)
class OrientationMap:
    """Measures over m directions of s and n turns psi. Arrays are read-only."""

    geometry: Geometry  #: what was mapped
    s: Array  #: directions in {B}, shape (m, 3)
    psi: Array  #: third ZYZ angle [rad], evenly over a full turn, shape (n,)
    measures: Measures  #: shape (m, n)

    @property
    def turn(self) -> Array:
        """Width of the admissible psi at each direction [rad], shape (m,).

        The ends between two samples are interpolated by the margin.
        """
        here, margin = self.measures.admissible, self.measures.margin
        after, beyond = np.roll(here, -1, axis=1), np.roll(margin, -1, axis=1)
        inner, outer = np.where(here, margin, beyond), np.where(here, beyond, margin)
        with np.errstate(divide="ignore", invalid="ignore"):
            part = np.where(outer < 0.0, inner / (inner - outer), 0.5)
        share = np.where(here & after, 1.0, np.where(here | after, part, 0.0))
        return np.asarray(share.sum(axis=1) * (2.0 * np.pi / len(self.psi)))

    @property
    def best_cond_j(self) -> Array:
        """Least cond J over the admissible psi, shape (m,); NaN where there is none."""
        values = np.where(self.measures.admissible, self.measures.cond_j, np.nan)
        return np.asarray(np.fmin.reduce(values, axis=1))

    @property
    def best_margin(self) -> Array:
        """Largest distance to all limits over psi [rad], shape (m,).

        NaN where there is none.
        """
        values = np.where(self.measures.admissible, self.measures.margin, np.nan)
        return np.asarray(np.fmax.reduce(values, axis=1))


def measures(geometry: Geometry, gamma: ArrayLike, rotation: ArrayLike) -> Measures:
    """Measure assemblies: gamma [rad], shape (..., 3), with R, shape (..., 3, 3)."""
    angles, matrices = np.array(gamma, dtype=float), np.asarray(rotation, dtype=float)
    r = kinematics.carriage_directions(geometry, angles)
    mu, beta, det_j2, admissible = kinematics.describe_assemblies(geometry, r, matrices)
    t = geometry.e @ np.swapaxes(matrices, -1, -2)
    n = cross(r, t)
    c = np.sum(n * geometry.w, axis=-1)
    stroke = np.minimum(angles, geometry.arc - angles).min(axis=-1)
    # J is det J2 times this up to its sign: the condition number needs no division.
    rows = [
        cross(n[..., i, :], n[..., i - 2, :]) * c[..., i - 1, None] for i in range(3)
    ]
    singular = np.linalg.svd(np.nan_to_num(np.stack(rows, axis=-2)), compute_uv=False)
    with np.errstate(divide="ignore", invalid="ignore"):
        cond_j = np.where(
            singular[..., 2] > 0.0, singular[..., 0] / singular[..., 2], np.inf
        )
    edge, reach = beta.min(axis=-1), geometry.beta_max - beta.max(axis=-1)
    limits = (admissible & (stroke >= 0.0), stroke, edge, reach)
    return Measures(
        *frozen(angles, mu, beta, *limits, np.prod(c, axis=-1), det_j2, cond_j)
    )


@check_kinds
def workspace(
    geometry: Geometry, divisions: int = 40, turns: int = 180, progress: bool = False
) -> OrientationMap:
    """Map the workspace: every direction of E on the base triangle, every turn about it.

    The geometry is `Geometry.of(scene)` or `Geometry.build(v, alpha)`. An edge of the
    triangle has `divisions`; `turns` are values of the third ZYZ angle psi, evenly over
    a full turn. InputError refuses less than 1 of them. With `progress` a bar is drawn
    on a terminal.
    """
    counts, poses = (
        {"divisions": divisions, "turns": turns},
        int(divisions) ** 2 * int(turns) // 2,
    )
    allowed = f"must be at least 1, and make no more than {_MOST:g} poses"
    checks = (
        (name, n, n >= 1 and poses <= _MOST, allowed) for name, n in counts.items()
    )
    refuse_unless("workspace", *checks)
    return over_orientations(
        geometry, triangle_directions(geometry, divisions)[0], turns, progress
    )


def over_orientations(
    geometry: Geometry, s: ArrayLike, turns: int = 180, progress: bool = False
) -> OrientationMap:
    """Map directions s, shape (m, 3), with `turns` values of psi each.

    With `progress` a bar on stderr shows how far it is, if stderr is a terminal.
    """
    directions = np.array(s, dtype=float)
    directions /= np.linalg.norm(directions, axis=1)[:, None]
    psi = np.asarray(
        (np.arange(turns) + 0.5) * (2.0 * np.pi / turns) - np.pi, dtype=float
    )
    parts = []
    for block in slices(
        len(directions), max(1, _BLOCK // turns), "orientations", progress
    ):
        rotation = orientations(directions[block][:, None], psi)
        gamma, _, _ = kinematics.inverse(geometry, rotation)
        parts.append(measures(geometry, gamma, rotation))
    frozen(directions, psi)
    columns_of_parts = zip(*(vars(part).values() for part in parts), strict=True)
    joined = Measures(*frozen(*map(np.concatenate, columns_of_parts)))
    return OrientationMap(geometry, directions, psi, joined)


def orientations(s: Array, psi: ArrayLike) -> Array:
    """R of directions s (..., 3) and third ZYZ angles psi (...) [rad], shape (..., 3, 3).

    theta and phi are those of s; where s = +-z, theta is 0.
    """
    sine = np.hypot(s[..., 0], s[..., 1])
    pole = sine == 0.0
    safe = np.where(pole, 1.0, sine)
    ct, st = (
        np.where(pole, 1.0, s[..., 0] / safe),
        np.where(pole, 0.0, s[..., 1] / safe),
    )
    along = np.stack([ct * s[..., 2], st * s[..., 2], -sine], axis=-1)
    across = np.stack([-st, ct, np.zeros_like(st)], axis=-1)
    angle = np.asarray(psi, dtype=float)[..., None]
    x = np.cos(angle) * along + np.sin(angle) * across
    return columns(
        x, np.cos(angle) * across - np.sin(angle) * along, np.broadcast_to(s, x.shape)
    )


def triangle_directions(
    geometry: Geometry, divisions: int = 40
) -> tuple[Array, NDArray[np.intp]]:
    """Directions inside the base triangle, shape (m, 3), and their triangles, shape (n, 3)."""
    i, j = np.nonzero(
        np.add.outer(range(divisions + 1), range(divisions + 1)) <= divisions
    )
    number = np.full((divisions + 2, divisions + 2), -1)
    number[i, j] = np.arange(len(i))
    upward = number[i, j], number[i + 1, j], number[i, j + 1]
    downward = number[i, j], np.where(j > 0, number[i + 1, j - 1], -1), number[i + 1, j]
    faces = np.stack([upward, downward], axis=-1).reshape(3, -1).T
    s = np.column_stack([i, j, divisions - i - j]) + 0.1
    s = s @ geometry.v
    inside = np.asarray(faces[faces.min(axis=1) >= 0], dtype=np.intp)
    return s / np.linalg.norm(s, axis=1)[:, None], inside


@dataclass(frozen=True)
class SingularPoses:
    """Poses of one kind. Arrays are read-only."""

    kind: str  #: "parallel" or "serial"
    rotation: Array  #: R, shape (m, 3, 3)
    #: joint angles [rad], shape (m, 3); NaN of the singular leg at a serial one
    gamma: Array
    beta: Array
    #: index k of the singular leg, shape (m,); -1 for parallel ones, which involve all
    leg: Array
    determinant: Array  #: det J2 or c_k that was found, shape (m,): 0 up to rounding

    def __len__(self) -> int:
        return len(self.rotation)


def parallel_singularities(chart: OrientationMap) -> SingularPoses:
    """Admissible poses with det J2 = 0, one for each change of sign along psi in the map.

    The poses fill a surface in (s, psi); the resolution of the map sets how many points
    of it are found. Each is exact to rounding.
    """
    measured, geometry = chart.measures, chart.geometry
    after = np.roll(np.arange(len(chart.psi)), -1)
    change = np.sign(measured.det_j2) * np.sign(measured.det_j2[:, after]) < 0
    # gamma jumps by pi where the pose passes t_k = +-w_k, and det J2 with it: these are
    # serial.
    smooth = np.abs(measured.gamma[:, after] - measured.gamma).max(axis=2) < 1.0
    rows, starts = np.nonzero(
        change & smooth & measured.admissible & measured.admissible[:, after]
    )
    s = chart.s[rows]
    low = chart.psi[starts].copy()
    high = low + (chart.psi[1] - chart.psi[0])
    sign = np.sign(measured.det_j2[rows, starts])

    def at(psi: Array) -> tuple[Array, ...]:
        rotation = orientations(s, psi)
        gamma, _, beta = kinematics.inverse(geometry, rotation)
        return rotation, gamma, beta, measures(geometry, gamma, rotation).det_j2

    for _ in range(_BISECTIONS):
        middle = 0.5 * (low + high)
        same = np.sign(at(middle)[-1]) == sign
        low, high = np.where(same, middle, low), np.where(same, high, middle)
    *found, determinant = at(low)
    return SingularPoses(
        "parallel", *frozen(*found, np.full(len(rows), -1), determinant)
    )


def serial_singularities(geometry: Geometry, points: int = 90) -> SingularPoses:
    """Poses with c_k = 0 at the edge of what is admissible: all other conditions hold there."""
    found = []
    for k, sign in product(range(3), (1.0, -1.0)):
        angles = np.linspace(0.0, geometry.arc[k], points)
        s = np.cos(angles)[:, None] * geometry.v[k]
        s = s + np.sin(angles)[:, None] * cross(geometry.w[k], geometry.v[k])
        t = np.broadcast_to(sign * geometry.w[k], s.shape)
        # R maps e_k to t_k and z to s; in {E} the triad is (e_k x z, e_k, z).
        e, z = geometry.e[k], np.array([0.0, 0.0, 1.0])
        rotation = columns(cross(t, s), t, s) @ np.stack([np.cross(e, z), e, z])
        gamma, _, beta = kinematics.inverse(geometry, rotation)
        valid = (s @ geometry.w.T > 0.0) & (beta > 0.0) & (beta <= geometry.beta_max)
        valid &= (gamma >= 0.0) & (gamma <= geometry.arc)
        valid[:, k] = True
        gamma[:, k] = beta[:, k] = np.nan
        c = np.linalg.norm(cross(t, np.broadcast_to(geometry.w[k], t.shape)), axis=1)
        inside = valid.all(axis=1)
        found.append(
            [part[inside] for part in (rotation, gamma, beta, np.full(points, k), c)]
        )
    arrays = (np.concatenate(parts) for parts in zip(*found, strict=True))
    return SingularPoses("serial", *frozen(*arrays))


@dataclass(frozen=True, repr=False)
class NearestSingularity(Explained):
    """The singular pose that the least turn of the star reaches.

    Arrays are read-only.
    """

    kind: str  #: "parallel" or "serial"
    leg: int  #: index k of the singular leg; -1 of a parallel one, which involves all
    distance: float  #: angle of the turn [rad]
    axis: Array  #: of the turn, in {E}, shape (3,)
    rotation: Array  #: R of the singular pose, shape (3, 3)

    def _facts(self) -> dict[str, object]:
        return {
            "kind": self.kind,
            "leg": "all" if self.leg < 0 else self.leg + 1,
            "turn of the star to it [rad]": self.distance,
            "axis of the turn, in {E}": self.axis.tolist(),
        }


@check_kinds
def distance_to_singularity(
    where: SceneInput | Geometry, gamma: ArrayLike
) -> NearestSingularity:
    """Find the singular pose that is nearest to a pose: by the least turn of the star.

    Limits of strokes and arcs are not looked at. To a serial one the distance is
    closed: that of t_k from the line of w_k. Nearer than it det J2 is smooth: rays in
    even directions find where it changes sign, and from the nearest of these the least
    turn is sought. A parallel singularity is overlooked only where it comes nearer than
    that between all rays.

    Args:
        where: a scene, as `simulate` takes it, or its geometry.
        gamma: angles of the actuators in the one admissible assembly [rad], shape (3,).

    Raises:
        AssemblyError: there is no unique admissible assembly.

    """
    from scipy.optimize import minimize
    from scipy.spatial.transform import Rotation

    geometry = where if isinstance(where, Geometry) else Geometry.of(scene_of(where))
    start = kinematics.admissible(geometry, gamma).rotation
    t = start.T @ geometry.w.T  # columns: w_k in {E}
    cosines = np.sum(geometry.e.T * t, axis=0)
    angles = np.arctan2(
        np.linalg.norm(np.cross(geometry.e, t.T), axis=1), np.abs(cosines)
    )
    leg = int(angles.argmin())
    kind, turn = (
        "serial",
        np.cross(geometry.e[leg], np.copysign(1.0, cosines[leg]) * t[:, leg]),
    )
    turn = angles[leg] * turn / np.linalg.norm(turn)

    def det_j2(turns: Array) -> Array:
        # A list of vectors: SciPy before 1.16 takes no arrays of more dimensions.
        matrices = Rotation.from_rotvec(turns.reshape(-1, 3)).as_matrix()
        rotation = start @ matrices.reshape(*turns.shape[:-1], 3, 3)
        found, _, _ = kinematics.inverse(geometry, rotation)
        return measures(geometry, found, rotation).det_j2

    lengths = np.linspace(0.0, 1.0 - 1e-9, _RAY) * angles[leg]
    # Even directions: points of a Fibonacci lattice on the sphere.
    z = 1.0 - (2.0 * np.arange(_RAYS) + 1.0) / _RAYS
    phi, rim = np.pi * (3.0 - np.sqrt(5.0)) * np.arange(_RAYS), np.sqrt(1.0 - z * z)
    rays = np.column_stack([rim * np.cos(phi), rim * np.sin(phi), z])
    at_pose = det_j2(np.zeros(3))
    values = det_j2(rays[:, None] * lengths[:, None]) / at_pose
    first = np.where(values.min(axis=1) <= 0.0, (values <= 0.0).argmax(axis=1), _RAY)
    equal: Any = {"type": "eq", "fun": lambda turn: det_j2(turn) / at_pose}
    for row in np.argsort(first, kind="stable")[:_REFINED]:
        if first[row] < _RAY:
            begin, most = (
                rays[row] * lengths[first[row]],
                {"ftol": 1e-12, "maxiter": 60},
            )
            found = minimize(lambda x: x @ x, begin, constraints=equal, options=most).x
            if abs(equal["fun"](found)) < 1e-9 and np.linalg.norm(
                found
            ) < np.linalg.norm(turn):
                kind, leg, turn = "parallel", -1, found
    distance = float(np.linalg.norm(turn))
    rotation = start @ Rotation.from_rotvec(turn).as_matrix()
    return NearestSingularity(kind, leg, distance, *frozen(turn / distance, rotation))


def report_singularities(geometry: Geometry, chart: OrientationMap) -> str:
    """Summarise the singular poses in a few lines."""
    lines, found = [], (parallel_singularities(chart), serial_singularities(geometry))
    for poses, where in zip(found, ("inside", "at the edge"), strict=True):
        said, row = f"none {where}", len(poses) // 2
        if len(poses):
            gamma = ", ".join(f"{x:.4f}" for x in np.degrees(poses.gamma[row]))
            s = ", ".join(f"{x:.4f}" for x in poses.rotation[row, :, 2])
            said = f"{len(poses)} found; for example s = ({s}), gamma = ({gamma}) deg"
            said += f", leg {poses.leg[row] + 1}" if poses.kind == "serial" else ""
        lines.append(f"{poses.kind}: {said}")
    return "\n".join(lines)
