# SPDX-License-Identifier: Apache-2.0
"""Where the star can go, how far its limits are, how well it is held, what is singular.

A pose is admissible when E lies on the base triangle (Eq. 4), 0 < beta_k <= beta_max,
and gamma_k lies in its stroke. The map is over orientations (direction of s, turn psi
about it), where the inverse kinematics has one answer.

Singular poses are of two kinds. Serial (det J1 = 0): c_k = sin(mu_k) = 0 means t_k =
+-w_k, so w_k.s = 0: E lies on the base arc P_k P_k+1. By Eq. 4 such poses are only ever
at the edge of what is admissible, never inside. Parallel (det J2 = 0): may lie inside
when some alpha_k > 180 deg; none for all alpha_k < 180 deg and beta_k < 90 deg.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from itertools import product

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sst_ros.errors import check_kinds, refuse_unless
from sst_ros.mechanism import kinematics
from sst_ros.mechanism.geometry import Array, Geometry, columns, cross, frozen, vectors
from sst_ros.progress import slices
from sst_ros.state import Explained

MEASURED_AT_ONCE = 20_000  # poses that are measured at a time
BISECTIONS = 55  # of psi between two samples: to rounding
MOST_MAP_POSES = 20_000_000  # of a map: 4 GB
SMOOTH = 1.0  # change of gamma [rad] between two samples that is no jump by pi


@dataclass(frozen=True, repr=False)
class Measures(Explained):
    """What a designer asks of poses, in read-only arrays of the poses' shape."""

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
            "least distance to an end of the stroke [rad]": self.stroke,
            "least beta, distance to the edge [rad]": self.edge,
            "least distance to the largest beta [rad]": self.reach,
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
        first = self.measures.admissible
        second = np.roll(first, -1, axis=1)
        first_margin = self.measures.margin
        second_margin = np.roll(first_margin, -1, axis=1)
        inner = np.where(first, first_margin, second_margin)
        outer = np.where(first, second_margin, first_margin)
        with np.errstate(divide="ignore", invalid="ignore"):
            crossing = np.where(outer < 0.0, inner / (inner - outer), 0.5)
        share = np.where(first | second, crossing, 0.0)
        share = np.where(first & second, 1.0, share)
        step = 2.0 * np.pi / len(self.psi)
        return np.asarray(share.sum(axis=1) * step)

    @property
    def best_cond_j(self) -> Array:
        """Least cond J over the admissible psi, shape (m,); NaN where there is none."""
        values = np.where(self.measures.admissible, self.measures.cond_j, np.nan)
        return np.asarray(np.fmin.reduce(values, axis=1))

    @property
    def best_margin(self) -> Array:
        """Largest distance to all limits over psi [rad], shape (m,).

        NaN without any.
        """
        values = np.where(self.measures.admissible, self.measures.margin, np.nan)
        return np.asarray(np.fmax.reduce(values, axis=1))


def measures(geometry: Geometry, gamma: ArrayLike, rotation: ArrayLike) -> Measures:
    """Measure assemblies: gamma [rad], shape (..., 3), with R, shape (..., 3, 3)."""
    angles = np.array(gamma, dtype=float)
    matrices = np.asarray(rotation, dtype=float)
    r = kinematics.carriage_directions(geometry, angles)
    mu, beta, det_j2, admissible = kinematics.describe_assemblies(geometry, r, matrices)
    normal = cross(r, kinematics.star_axes(geometry, matrices))
    c = np.sum(normal * geometry.w, axis=-1)
    stroke = np.minimum(angles, geometry.arc - angles).min(axis=-1)
    result = Measures(
        gamma=angles,
        mu=mu,
        beta=beta,
        admissible=admissible & (stroke >= 0.0),
        stroke=stroke,
        edge=beta.min(axis=-1),
        reach=geometry.beta_max - beta.max(axis=-1),
        det_j1=np.prod(c, axis=-1),
        det_j2=det_j2,
        cond_j=_condition(normal, c),
    )
    frozen(*vars(result).values())
    return result


def _condition(normal: Array, c: Array) -> Array:
    """Condition number of J, shape (...), from N_k = r_k x t_k and c_k, rows by leg.

    J is det J2 times a matrix of their products, up to its sign, so that no division is
    needed.
    """
    first, second, third = np.moveaxis(normal, -2, 0)
    c_1, c_2, c_3 = np.moveaxis(c[..., None], -2, 0)
    rows = [
        cross(first, second) * c_3,
        cross(second, third) * c_1,
        cross(third, first) * c_2,
    ]
    matrix = np.nan_to_num(np.stack(rows, axis=-2))
    singular = np.linalg.svd(matrix, compute_uv=False)
    largest = singular[..., 0]
    smallest = singular[..., -1]
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(np.where(smallest > 0.0, largest / smallest, np.inf))


@check_kinds
def workspace(
    geometry: Geometry, divisions: int = 40, turns: int = 180, progress: bool = False
) -> OrientationMap:
    """Map the workspace: all directions of E on the base triangle, all turns about it.

    The geometry is `Geometry.of(scene)` or `Geometry.build(v, alpha)`. An edge of the
    triangle has `divisions`; `turns` are values of the third ZYZ angle psi, evenly over
    a full turn. InputError refuses less than 1 of them. With `progress` a bar is drawn
    on a terminal.
    """
    is_small = int(divisions) ** 2 * int(turns) // 2 <= MOST_MAP_POSES
    requirement = f"must be at least 1, and make no more than {MOST_MAP_POSES:g} poses"
    refuse_unless(
        "workspace",
        ("divisions", divisions, divisions >= 1 and is_small, requirement),
        ("turns", turns, turns >= 1 and is_small, requirement),
    )
    s, _ = triangle_directions(geometry, divisions)
    return over_orientations(geometry, s, turns, progress)


def over_orientations(
    geometry: Geometry, s: ArrayLike, turns: int = 180, progress: bool = False
) -> OrientationMap:
    """Map directions s, shape (m, 3), with `turns` values of psi each.

    With `progress` a bar on stderr shows how far it is, if stderr is a terminal.
    """
    directions = np.array(s, dtype=float)
    directions /= np.linalg.norm(directions, axis=1)[:, None]
    step = 2.0 * np.pi / turns
    psi = np.asarray((np.arange(turns) + 0.5) * step - np.pi, dtype=float)
    measured = []
    size = max(1, MEASURED_AT_ONCE // turns)
    for block in slices(len(directions), size, "orientations", progress):
        rotation = orientations(directions[block][:, None], psi)
        gamma, _, _ = kinematics.inverse(geometry, rotation)
        measured.append(measures(geometry, gamma, rotation))
    arrays = {}
    for field in fields(Measures):
        blocks = [getattr(block_measures, field.name) for block_measures in measured]
        arrays[field.name] = np.concatenate(blocks)
    joined = Measures(**arrays)
    frozen(directions, psi, *vars(joined).values())
    return OrientationMap(geometry, directions, psi, joined)


def orientations(s: Array, psi: ArrayLike) -> Array:
    """R of directions s, shape (..., 3), and third ZYZ angles psi [rad], shape (...).

    theta and phi are those of s; where s = +-z, theta is 0. R has the shape (..., 3,
    3).
    """
    s_x, s_y, s_z = np.moveaxis(s, -1, 0)
    sine_phi = np.hypot(s_x, s_y)
    at_pole = sine_phi == 0.0
    divisor = np.where(at_pole, 1.0, sine_phi)
    cosine = np.where(at_pole, 1.0, s_x / divisor)  # of theta
    sine = np.where(at_pole, 0.0, s_y / divisor)
    along = vectors(cosine * s_z, sine * s_z, -sine_phi)
    across = vectors(-sine, cosine, np.zeros_like(sine))
    angle = np.asarray(psi, dtype=float)[..., None]
    x = np.cos(angle) * along + np.sin(angle) * across
    y = np.cos(angle) * across - np.sin(angle) * along
    return columns(x, y, np.broadcast_to(s, x.shape))


def triangle_directions(
    geometry: Geometry, divisions: int = 40
) -> tuple[Array, NDArray[np.intp]]:
    """Return directions inside the base triangle, (m, 3), and their triangles, (n, 3).

    The directions are the nodes (i, j) of a triangular grid, i steps from one corner
    and j from another; each triangle has the numbers of its three nodes.
    """
    steps = range(divisions + 1)
    i, j = np.nonzero(np.add.outer(steps, steps) <= divisions)
    no_node = -1
    number = np.full((divisions + 2, divisions + 2), no_node)
    number[i, j] = np.arange(len(i))
    corner = number[i, j]
    right = number[i + 1, j]
    above = number[i, j + 1]
    below = np.where(j > 0, number[i + 1, j - 1], no_node)
    upward = (corner, right, above)
    downward = (corner, below, right)
    faces = np.stack([upward, downward], axis=-1).reshape(3, -1).T
    # 0.1 of a step more for each corner keeps all directions off the edges.
    weights = np.column_stack([i, j, divisions - i - j]) + 0.1
    s = weights @ geometry.v
    inside = np.asarray(faces[faces.min(axis=1) > no_node], dtype=np.intp)
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
    determinant: Array  #: det J2 or c_k there, shape (m,): 0 up to rounding

    def __len__(self) -> int:
        return len(self.rotation)


def parallel_singularities(chart: OrientationMap) -> SingularPoses:
    """Admissible poses with det J2 = 0, one for each change of sign along psi.

    The poses fill a surface in (s, psi); the resolution of the map sets how many points
    of it are found. Each is exact to rounding.
    """
    geometry = chart.geometry
    measured = chart.measures
    following = np.roll(np.arange(len(chart.psi)), -1)
    signs = np.sign(measured.det_j2)
    changes = signs * signs[:, following] < 0
    # gamma jumps by pi where the pose passes t_k = +-w_k, and det J2 with it: these are
    # serial.
    jump = np.abs(measured.gamma[:, following] - measured.gamma).max(axis=2)
    inside = measured.admissible & measured.admissible[:, following]
    rows, starts = np.nonzero(changes & (jump < SMOOTH) & inside)
    s = chart.s[rows]
    sign = signs[rows, starts]
    low = chart.psi[starts].copy()
    high = low + (chart.psi[1] - chart.psi[0])

    def det_j2(psi: Array) -> Array:
        rotation = orientations(s, psi)
        gamma, _, _ = kinematics.inverse(geometry, rotation)
        return measures(geometry, gamma, rotation).det_j2

    for _ in range(BISECTIONS):
        middle = 0.5 * (low + high)
        is_below = np.sign(det_j2(middle)) == sign
        low = np.where(is_below, middle, low)
        high = np.where(is_below, high, middle)
    rotation = orientations(s, low)
    gamma, _, beta = kinematics.inverse(geometry, rotation)
    no_leg = np.full(len(rows), -1)
    determinant = det_j2(low)
    frozen(rotation, gamma, beta, no_leg, determinant)
    return SingularPoses("parallel", rotation, gamma, beta, no_leg, determinant)


def serial_singularities(geometry: Geometry, points: int = 90) -> SingularPoses:
    """Return poses with c_k = 0 at the edge of the admissible, all else inside."""
    rows = []
    z = np.array([0.0, 0.0, 1.0])
    for k, sign in product(range(3), (1.0, -1.0)):
        v = geometry.v[k]
        w = geometry.w[k]
        e = geometry.e[k]
        angles = np.linspace(0.0, geometry.arc[k], points)
        s = np.cos(angles)[:, None] * v
        s = s + np.sin(angles)[:, None] * cross(w, v)
        t = np.broadcast_to(sign * w, s.shape)
        # R maps e_k to t_k and z to s; in {E} the triad is (e_k x z, e_k, z).
        triad = np.stack([np.cross(e, z), e, z])
        rotation = columns(cross(t, s), t, s) @ triad
        gamma, _, beta = kinematics.inverse(geometry, rotation)
        on_triangle = s @ geometry.w.T > 0.0
        in_reach = (beta > 0.0) & (beta <= geometry.beta_max)
        in_stroke = (gamma >= 0.0) & (gamma <= geometry.arc)
        is_inside = on_triangle & in_reach & in_stroke
        is_inside[:, k] = True  # of the singular leg nothing is asked
        gamma[:, k] = np.nan
        beta[:, k] = np.nan
        c = np.linalg.norm(cross(t, np.broadcast_to(w, t.shape)), axis=1)
        leg = np.full(points, k)
        is_kept = is_inside.all(axis=1)
        rows.append([array[is_kept] for array in (rotation, gamma, beta, leg, c)])
    arrays = [np.concatenate(blocks) for blocks in zip(*rows, strict=True)]
    return SingularPoses("serial", *frozen(*arrays))


def report_singularities(geometry: Geometry, chart: OrientationMap) -> str:
    """Summarise the singular poses in a few lines."""
    parallel = _report_poses(parallel_singularities(chart), "inside")
    serial = _report_poses(serial_singularities(geometry), "at the edge")
    return f"{parallel}\n{serial}"


def _report_poses(poses: SingularPoses, place: str) -> str:
    """Say how many poses of a kind there are, and give one."""
    if not len(poses):
        return f"{poses.kind}: none {place}"
    row = len(poses) // 2
    gamma = ", ".join(f"{x:.4f}" for x in np.degrees(poses.gamma[row]))
    _, _, s_axis = poses.rotation[row].T
    s = ", ".join(f"{x:.4f}" for x in s_axis)
    text = f"{len(poses)} found; for example s = ({s}), gamma = ({gamma}) deg"
    if poses.kind == "serial":
        text += f", leg {poses.leg[row] + 1}"
    return f"{poses.kind}: {text}"
