# SPDX-License-Identifier: Apache-2.0
"""The singular pose that is nearest to a pose: by the least turn of the star.

A turn of the star has the Rodrigues vector v = tan(angle / 2) axis in {E}. It takes
the base axes w_k, in {E}, to W_k / (1 + v.v) with

    W_k(v) = (1 - v.v) w_k - 2 v x w_k + 2 (v.w_k) v,

and det J2 is that of the rows u_k = e_k x (e_k x W_k), up to a positive factor that
vanishes in serial singularities alone. So along a ray v = tau axis it has the sign of a
polynomial in tau of degree six, and its derivatives by v are closed.

1. The nearest serial singularity is closed: the turn of t_k to the line of w_k.
2. Rays in even directions, up to that distance, find where det J2 changes sign.
3. From the nearest of these the least v with det J2 = 0 is sought by Newton's method on
   v + lambda grad = 0 (sequential quadratic programming; Nocedal and Wright, Numerical
   Optimization, 2nd edition, chapter 18).

Many poses are computed at once, each with the numbers that it has alone.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, overload

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sst_ros.errors import check_kinds, read_numbers, refuse_unless
from sst_ros.mechanism import kinematics
from sst_ros.mechanism.geometry import (
    CYCLIC,
    Array,
    Geometry,
    cross,
    dot,
    frozen,
    norm,
    rotation_matrix,
    vectors,
)
from sst_ros.scene.scene import SceneInput, scene_of
from sst_ros.state import Explained

RAYS = 400  # from a pose, along which det J2 is evaluated
RAY_POINTS = 64  # of a ray: two changes of sign between two of them are overlooked
REFINED = 6  # nearest changes of sign that are refined
SINGULAR_SHARE = 1e-9  # abs(det J2) over that of the pose at a parallel singularity
POSES_AT_ONCE = 100  # some 100 MB of polynomials along rays
NEWTON_STEPS = 60  # most of them; a start beside a solution takes five
LONGEST_STEP = 0.2  # of v: a longer one may lead to another solution
LAST_STEP = 1e-9  # of v: after it rounding is reached, for convergence is quadratic
FLAT = 1e-200  # squared gradient below which there is no direction to a solution
DETERMINANT_DEGREE = 6  # of det J2 along a ray as a polynomial in tau
SHORT_OF_SERIAL = 1.0 - 1e-9  # share of a ray; at its end det J2 is zero in any case


@dataclass(frozen=True, repr=False)
class NearestSingularity(Explained):
    """The singular pose that the least turn of the star reaches; read-only arrays."""

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


@dataclass(frozen=True, repr=False)
class NearestSingularities(Explained):
    """The nearest singular pose of each of n poses, in read-only arrays.

    An index gives a `NearestSingularity`.
    """

    leg: NDArray[np.intp]  #: index k of the singular leg; -1 of a parallel one, (n,)
    distance: Array  #: angle of the turn [rad], shape (n,)
    axis: Array  #: of the turn, in {E}, shape (n, 3)
    rotation: Array  #: R of the singular pose, shape (n, 3, 3)

    @property
    def kind(self) -> NDArray[np.str_]:
        """Kind of the singularity, "parallel" or "serial", shape (n,)."""
        return np.where(self.leg < 0, "parallel", "serial")

    def __len__(self) -> int:
        """Return the number of poses."""
        return len(self.leg)

    def __getitem__(self, pose: int) -> NearestSingularity:
        """Return that of one pose."""
        return NearestSingularity(
            kind=str(self.kind[pose]),
            leg=int(self.leg[pose]),
            distance=float(self.distance[pose]),
            axis=self.axis[pose],
            rotation=self.rotation[pose],
        )

    def __iter__(self) -> Iterator[NearestSingularity]:
        """Yield those of all poses."""
        return (self[pose] for pose in range(len(self)))

    def _facts(self) -> dict[str, object]:
        least = float(np.min(self.distance, initial=np.inf))
        largest = float(np.max(self.distance, initial=0.0))
        return {
            "poses": len(self),
            "nearest one is parallel": int(np.count_nonzero(self.leg < 0)),
            "least turn of the star to one [rad]": least,
            "largest turn of the star to one [rad]": largest,
        }


@overload
def distance_to_singularity(
    where: SceneInput | Geometry, gamma: Sequence[float]
) -> NearestSingularity: ...


@overload
def distance_to_singularity(
    where: SceneInput | Geometry, gamma: Array | Sequence[Sequence[float]]
) -> Any: ...


@check_kinds
def distance_to_singularity(
    where: SceneInput | Geometry, gamma: ArrayLike
) -> NearestSingularity | NearestSingularities:
    """Find the singular pose that is nearest to a pose: by the least turn of the star.

    Limits of strokes and arcs are not looked at. To a serial one the distance is
    closed: that of t_k from the line of w_k. Nearer than it det J2 is smooth: rays in
    even directions find where it changes sign, and from the nearest of these the least
    turn is sought. A parallel singularity is overlooked only where it comes nearer than
    that between all rays.

    Args:
        where: a scene, as `simulate` takes it, or its geometry.
        gamma: angles of the actuators in the one admissible assembly [rad], shape (3,);
            of n poses, computed at once, shape (n, 3).

    Returns:
        A `NearestSingularity`; of n poses `NearestSingularities`, whose numbers are
        those of each pose alone.

    Raises:
        InputError: gamma has another shape.
        AssemblyError: there is no unique admissible assembly.

    """
    geometry = where if isinstance(where, Geometry) else Geometry.of(scene_of(where))
    angles = read_numbers("distance_to_singularity", "gamma", gamma)
    fits = angles.shape == (3,) or (angles.ndim == 2 and angles.shape[1] == 3)
    requirement = "must be three angles [rad], or rows of them"
    refuse_unless("distance_to_singularity", ("gamma", gamma, fits, requirement))
    if angles.ndim == 1:
        rotation = kinematics.admissible(geometry, angles).rotation
        return _find_nearest(geometry, rotation[None])[0]
    rotations = kinematics.admissible_rotations(geometry, angles)
    return _find_nearest(geometry, rotations)


def _find_nearest(geometry: Geometry, rotations: Array) -> NearestSingularities:
    """Find the nearest singular poses of R, shape (n, 3, 3)."""
    # rows of the base axes in {E}, by leg
    axes = geometry.w @ rotations
    leg, v = _turns_to_serial(geometry, axes)
    owners = [np.empty(0, dtype=np.intp)]
    starts = [np.empty((0, 3))]
    for first in range(0, len(v), POSES_AT_ONCE):
        block = slice(first, first + POSES_AT_ONCE)
        changes = _first_changes(geometry, axes[block], v[block])
        owners.append(first + changes.pose)
        starts.append(changes.v)
    owner = np.concatenate(owners)
    parallel, is_singular = _least_turns(
        geometry.e, axes[owner], np.concatenate(starts)
    )
    for pose, turn in zip(owner[is_singular], parallel[is_singular], strict=True):
        if turn @ turn < v[pose] @ v[pose]:
            leg[pose] = -1
            v[pose] = turn
    length = norm(v)
    is_turned = (length > 0.0)[:, None]
    axis = np.where(is_turned, v, (0.0, 0.0, 1.0))
    axis = axis / np.where(is_turned, length[:, None], 1.0)
    quaternions = np.hstack([v, np.ones((len(v), 1))])
    singular_poses = rotations @ rotation_matrix(quaternions)
    distance = 2.0 * np.arctan(length)
    frozen(leg, distance, axis, singular_poses)
    return NearestSingularities(leg, distance, axis, singular_poses)


def _turns_to_serial(geometry: Geometry, axes: Array) -> tuple[NDArray[np.intp], Array]:
    """Return the leg, and v of the least turn, that bring t_k onto +-w_k."""
    normals = cross(geometry.e, axes)
    cosines = dot(geometry.e, axes)
    sines = norm(normals)
    angles = np.arctan2(sines, np.abs(cosines))
    leg = angles.argmin(axis=1)
    pose = np.arange(len(axes))
    sign = np.copysign(1.0, cosines[pose, leg])  # the nearer end of the line of w_k
    normal = sign[:, None] * normals[pose, leg]
    sine = sines[pose, leg][:, None]
    direction = normal / np.where(sine > 0.0, sine, 1.0)
    return leg, np.tan(0.5 * angles[pose, leg])[:, None] * direction


class _Changes(NamedTuple):
    """Turns at which det J2 has changed its sign along a ray."""

    pose: NDArray[np.intp]  # of each, shape (m,)
    v: Array  # shape (m, 3)


def _first_changes(geometry: Geometry, axes: Array, nearest: Array) -> _Changes:
    """Return the nearest changes of sign along rays that end at the turns `nearest`."""
    rays = _even_directions(RAYS)
    angles = 2.0 * np.arctan(norm(nearest))
    shares = np.linspace(0.0, SHORT_OF_SERIAL, RAY_POINTS)
    tau = np.tan(0.5 * angles[:, None] * shares)
    powers = tau[:, None, :] ** np.arange(DETERMINANT_DEGREE + 1)[:, None]
    polynomials = _det_along(geometry.e, axes, rays)
    values = polynomials @ powers
    is_beyond = values * polynomials[:, :1, :1] <= 0.0
    changes = is_beyond.any(axis=2)
    first = np.where(changes, is_beyond.argmax(axis=2), RAY_POINTS)
    nearest_rays = np.argsort(first, axis=1, kind="stable")[:, :REFINED]
    pose, place = np.nonzero(
        np.take_along_axis(first, nearest_rays, axis=1) < RAY_POINTS
    )
    ray = nearest_rays[pose, place]
    v = tau[pose, first[pose, ray]][:, None] * rays[ray]
    return _Changes(pose, v)


def _det_along(e: Array, axes: Array, rays: Array) -> Array:
    """Return polynomials in tau that have the sign of det J2 along rays.

    Args:
        e: axes of the star's arcs, shape (3, 3), rows by leg.
        axes: base axes in {E}, shape (n, 3, 3), rows by leg.
        rays: unit vectors in {E}, shape (m, 3).

    Returns:
        Coefficients of tau^0 to tau^6, shape (n, m, 7).

    """
    w = axes[:, None]  # (n, 1, leg, 3)
    ray = rays[:, None]  # (m, 1, 3)
    constant = np.broadcast_to(w, (len(axes), len(rays), 3, 3))
    linear = -2.0 * cross(ray, w)
    quadratic = 2.0 * dot(ray, w)[..., None] * ray - w
    rows = [_across(e, coefficient) for coefficient in (constant, linear, quadratic)]
    count = len(axes), len(rays)
    # cross products of the second and the third leg's rows, by degree from 0 to 4
    normals = np.zeros((5, *count, 3))
    for i, second in enumerate(rows):
        for j, third in enumerate(rows):
            normals[i + j] += cross(second[:, :, 1], third[:, :, 2])
    polynomials = np.zeros((*count, DETERMINANT_DEGREE + 1))
    for i, first in enumerate(rows):
        for degree, normal in enumerate(normals):
            polynomials[:, :, i + degree] += dot(first[:, :, 0], normal)
    return polynomials


def _across(e: Array, vectors: Array) -> Array:
    """Return e_k x (e_k x vector) by leg, shape (..., 3, 3)."""
    return e * dot(e, vectors)[..., None] - vectors


class _Determinant(NamedTuple):
    """A factor of det J2 at turns v, and its derivatives by v."""

    value: Array  # shape (m,)
    gradient: Array  # shape (m, 3)
    hessian: Array  # shape (m, 3, 3)


def _determinant(e: Array, axes: Array, v: Array) -> _Determinant:
    """Differentiate the determinant of the rows u_k twice; axes are (m, 3, 3)."""
    count = len(v)
    turn = v[:, None]
    unit = np.eye(3)
    square = dot(v, v)
    along = dot(turn, axes)
    turned = (1.0 - square)[:, None, None] * axes - 2.0 * cross(turn, axes)
    rows = _across(e, turned + 2.0 * along[..., None] * turn)
    slopes = []
    for i in range(3):
        component = axes[:, :, i, None]
        by_turn = component * turn + along[..., None] * unit[i]
        change = by_turn - cross(unit[i], axes) - v[:, i, None, None] * axes
        slopes.append(_across(e, 2.0 * change))
    normals = np.empty(axes.shape)
    gradient = np.zeros((count, 3))
    hessian = np.zeros((count, 3, 3))
    for k, following, last in CYCLIC:
        normals[:, k] = cross(rows[:, following], rows[:, last])
        for i, j in np.ndindex(3, 3):
            first, second = slopes[i][:, following], slopes[j][:, last]
            mixed = dot(rows[:, k], cross(first, second))
            hessian[:, i, j] += mixed
            hessian[:, j, i] += mixed
    for i, slope in enumerate(slopes):
        gradient[:, i] = dot(slope, normals).sum(axis=1)
        for j in range(3):
            symmetric = axes[:, :, i, None] * unit[j] + axes[:, :, j, None] * unit[i]
            curvature = _across(e, 2.0 * (symmetric - float(i == j) * axes))
            hessian[:, i, j] += dot(curvature, normals).sum(axis=1)
    return _Determinant(dot(rows[:, 0], normals[:, 0]), gradient, hessian)


def _least_turns(
    e: Array, axes: Array, starts: Array
) -> tuple[Array, NDArray[np.bool_]]:
    """Find the least v with det J2 = 0 near each start, and say where it is zero."""
    v = starts.copy()
    is_singular = np.zeros(len(v), dtype=bool)
    at_pose = _determinant(e, axes, np.zeros(v.shape)).value
    sizes = np.where(at_pose == 0.0, 1.0, np.abs(at_pose))
    active = np.arange(len(v))
    for _ in range(NEWTON_STEPS):
        if not len(active):
            break
        turn = v[active]
        scale = 1.0 / sizes[active]
        determinant = _determinant(e, axes[active], turn)
        gradient = scale[:, None] * determinant.gradient
        square = dot(gradient, gradient)
        is_slope = square > FLAT
        multiplier = -dot(gradient, turn) / np.where(is_slope, square, 1.0)
        curvature = (multiplier * scale)[:, None, None] * determinant.hessian
        value = scale * determinant.value
        step = _constrained_step(curvature, gradient, turn, value, is_slope)
        length = norm(step)
        share = np.minimum(1.0, LONGEST_STEP / np.maximum(length, FLAT))
        v[active] += step * share[:, None]
        is_last = (length <= LAST_STEP) | ~is_slope
        is_singular[active[is_last & is_slope]] = True
        active = active[~is_last]
    determinant = _determinant(e, axes, v)
    is_singular &= np.abs(determinant.value) < SINGULAR_SHARE * sizes
    return v, is_singular


def _constrained_step(
    curvature: Array,
    gradient: Array,
    v: Array,
    value: Array,
    is_slope: NDArray[np.bool_],
) -> Array:
    """Return the step to the least v with a linear constraint, shape (m, 3).

    The curvature of the constraint is left out where the step would lead to a largest
    v.
    """
    square = np.where(is_slope, dot(gradient, gradient), 1.0)[:, None, None]
    normal = gradient[:, :, None] * gradient[:, None, :] / square
    tangent = np.eye(3) - normal
    inside = tangent @ (np.eye(3) + curvature) @ tangent + normal
    is_least = np.linalg.eigvalsh(inside).min(axis=1) > 0.0
    # Unknown are the three components of the step, then the multiplier.
    step = slice(0, 3)
    multiplier = -1
    matrix = np.zeros((len(v), 4, 4))
    matrix[:, step, step] = np.eye(3)
    matrix[:, step, step] += np.where(is_least[:, None, None], curvature, 0.0)
    matrix[:, multiplier, step] = gradient
    matrix[:, step, multiplier] = gradient
    matrix[~is_slope, multiplier, multiplier] = 1.0
    right = np.concatenate([-v, -value[:, None]], axis=1)
    unknowns = np.linalg.solve(matrix, right[:, :, None])[..., 0]
    return np.asarray(unknowns[:, step])


def _even_directions(count: int) -> Array:
    """Return unit vectors of a Fibonacci lattice on the sphere, shape (count, 3)."""
    number = np.arange(count)
    z = 1.0 - (2.0 * number + 1.0) / count
    angle = np.pi * (3.0 - np.sqrt(5.0)) * number
    radius = np.sqrt(1.0 - z * z)
    return vectors(radius * np.cos(angle), radius * np.sin(angle), z)
