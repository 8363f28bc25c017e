# SPDX-License-Identifier: Apache-2.0
"""Positions: orientation -> joint angles, and actuator angles -> every orientation.

A leg holds t_k at a right angle to r_k; that is all there is to the position problem:
r_k(gamma_k) . R e_k = 0 for k = 1, 2, 3. Its roots R are those of one quartic, for many
r at once:

t_1 = cos(x) n + sin(x) m spans the plane across r_1 and s = cos(y) r_1 + sin(y) t_1 x
r_1. Legs 2 and 3 then read a cos(y) + b sin(y) + c = 0, so (cos y, sin y, 1) is the
cross product of the two rows (a, b, c), and cos^2 + sin^2 = 1 is a form of degree four
in (cos x, sin x). Its roots come from a companion matrix; each is polished on the
rotation itself. t_1 and -t_1 give two assemblies, R and R Rot(z, pi), that share s: up
to eight.

Resolution: two roots are distinguished when the residual r_k . t_k midway between them
is more than rounding, so that they are some 1e-6 rad apart or gamma is some 1e-12 rad
off the fold where they meet. Closer ones, real or a complex pair, are a double root in
this arithmetic, for r_k and e_k
are rounded too: they come out as one, with det J2 near 0.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sst_ros.errors import (
    AmbiguousAssembly,
    AssemblyError,
    NoAdmissibleAssembly,
    check_kinds,
    refuse_unless,
)
from sst_ros.mechanism.geometry import (
    Array,
    Geometry,
    angle_between,
    columns,
    cross,
    dot,
    frozen,
    quaternion_of,
)
from sst_ros.state import Assembly

Index = NDArray[np.intp]
Mask = NDArray[np.bool_]
NEAR = 0.1  # how near an assembly must be to the rotation that names it [rad]
ROUNDING = 1e-15  # largest abs(r_k . t_k) that is rounding and not a residual
_NOT_ISOLATED, _NEAR_REAL, _SAME, _MISFIT = 1e-13, 1e-3, 1e-3, 1e-2
_STEPS, _LONGEST_TURN, _LAST_STEP, _REGULAR = 40, 0.3, 1e-9, 1e-5


@dataclass(frozen=True)
class Assemblies:
    """The assemblies of many gamma at once; m of them for n configurations.

    Read-only arrays.
    """

    # : row of gamma that each assembly belongs to, ascending, shape (m,)
    configuration: Index
    rotation: Array  #: this and what follows as in `Assembly`, with m first
    mu: Array
    beta: Array
    det_j2: Array
    admissible: Mask
    # : shape (n,); False where gamma has a continuum of assemblies, of which none is
    # listed
    isolated: Mask


def carriage_directions(geometry: Geometry, gamma: ArrayLike) -> Array:
    """Directions r_k of the intermediate joints in {B}, Eq. 1, shape (..., 3, 3), rows by leg."""
    angles = np.asarray(gamma, dtype=float)[..., None]
    across = cross(geometry.w, geometry.v)
    return np.asarray(np.cos(angles) * geometry.v + np.sin(angles) * across)


def closure(geometry: Geometry, gamma: ArrayLike, rotation: ArrayLike) -> Array:
    """Products r_k .

    R e_k of gamma (..., 3) [rad] and R (..., 3, 3), zero in closed loops.
    """
    t = geometry.e @ np.swapaxes(np.asarray(rotation, dtype=float), -1, -2)
    return dot(carriage_directions(geometry, gamma), t)


@check_kinds
def inverse(
    geometry: Geometry, rotation: ArrayLike, signs: ArrayLike = (1, 1, 1)
) -> tuple[Array, Array, Array]:
    """Joint angles (gamma, mu, beta) [rad], each shape (..., 3), of orientations R (..., 3, 3).

    The planes across w_k and t_k meet in one line, so every leg has two solutions, r_k
    and -r_k, and an orientation has eight:

    - sign +1, r_k = t_k x w_k / sin(mu_k): mu_k in (0, pi). All admissible assemblies
      have it, and on it beta_k changes sign smoothly at the edge of the workspace.
    - sign -1, -r_k: gamma_k + pi, -mu_k and beta_k + pi, wrapped to (-pi, pi].

    Where t_k = +-w_k (serial singularity) every gamma_k fits and it comes out as 0.
    InputError refuses other shapes.
    """
    matrices = np.asarray(rotation, dtype=float)
    refuse_unless(
        "inverse",
        (
            "rotation",
            matrices.shape,
            matrices.shape[-2:] == (3, 3),
            "must be (..., 3, 3)",
        ),
        ("signs", signs, np.shape(signs) == (3,), "must be three of 1 and -1"),
    )
    t, s = geometry.e @ np.swapaxes(matrices, -1, -2), matrices[..., None, :, 2]
    p = cross(t, geometry.w)
    sine = np.sqrt(dot(p, p))
    sign = np.asarray(signs, dtype=float)
    p = sign[:, None] * p
    gamma = np.arctan2(dot(p, cross(geometry.w, geometry.v)), dot(p, geometry.v))
    mu = np.arctan2(sign * sine, dot(t, geometry.w))
    beta = np.arctan2(dot(p, cross(t, s)), dot(p, s))
    return gamma, mu, beta


@check_kinds
def direct(geometry: Geometry, gamma: ArrayLike) -> list[Assembly]:
    """All real assemblies at actuator angles gamma [rad], shape (3,); up to eight.

    They come in pairs R, R Rot(z, pi), in the order of (s_z, s_y, s_x) of their shared
    s. A double root comes out as one, with det J2 near 0. Where gamma is not finite, or
    the assemblies are not isolated, AssemblyError is raised.
    """
    angles = np.array(gamma, dtype=float)
    found = direct_many(geometry, angles[None])
    if not found.isolated[0]:
        raise AssemblyError("the assemblies are not isolated", angles)
    rows = zip(
        found.rotation,
        found.mu,
        found.beta,
        found.det_j2,
        found.admissible,
        strict=True,
    )
    return [Assembly(*row[:3], float(row[3]), bool(row[4])) for row in rows]


def direct_many(geometry: Geometry, gamma: ArrayLike) -> Assemblies:
    """All real assemblies of many gamma [rad], shape (n, 3), at once.

    The order is `direct`'s.

    The geometry may be one for each. AssemblyError refuses what is not (n, 3) finite
    numbers.
    """
    angles = np.asarray(gamma, dtype=float)
    if angles.ndim != 2 or angles.shape[1] != 3 or not np.all(np.isfinite(angles)):
        raise AssemblyError(
            "gamma must be three finite numbers, or rows of them", angles
        )
    r = carriage_directions(geometry, angles)
    configuration, rotation, isolated = _solve_closure(
        r, np.broadcast_to(geometry.e, r.shape)
    )
    mu, beta, det_j2, admissible = describe_assemblies(
        geometry.of_rows(configuration), r[configuration], rotation
    )
    return Assemblies(
        *frozen(configuration, rotation, mu, beta, det_j2, admissible, isolated)
    )


def admissible(
    geometry: Geometry, gamma: ArrayLike, near: ArrayLike | None = None
) -> Assembly:
    """Return the one assembly in which the manipulator can be built at gamma [rad], section 4.1.

    Where several are admissible, the rotation `near` selects the only one within NEAR
    of it.

    Raises:
        NoAdmissibleAssembly: no assembly has E on the base triangle and 0 < beta_k <=
            beta_max.
        AmbiguousAssembly: more than one has, and `near` names none; the error carries
            them.
        AssemblyError: gamma is not finite, or the assemblies are not isolated.

    """
    candidates = [
        assembly for assembly in direct(geometry, gamma) if assembly.admissible
    ]
    angles = np.asarray(gamma, dtype=float)
    if not candidates:
        raise NoAdmissibleAssembly("no admissible assembly", angles)
    if len(candidates) > 1:
        orientations = quaternion_of(np.stack([one.rotation for one in candidates]))
        if near is not None:
            (meant,) = np.nonzero(
                angle_between(orientations, quaternion_of(near)) < NEAR
            )
            if len(meant) == 1:
                return candidates[int(meant[0])]
        raise AmbiguousAssembly(angles, candidates, orientations)
    return candidates[0]


def describe_assemblies(
    geometry: Geometry, r: Array, rotation: Array
) -> tuple[Array, Array, Array, Mask]:
    """Passive angles mu, beta (..., 3) [rad], det J2 and admissibility (...) of assemblies.

    They have the carriage directions r in rows and R, (..., 3, 3) each, with r_k . R
    e_k = 0.
    """
    t, s = geometry.e @ np.swapaxes(rotation, -1, -2), rotation[..., None, :, 2]
    mu = np.arctan2(dot(cross(t, geometry.w), r), dot(geometry.w, t))
    beta = np.arctan2(dot(r, cross(t, s)), dot(r, s))
    normal = cross(r, t)
    volume = dot(normal[..., 0, :], cross(normal[..., 1, :], normal[..., 2, :]))
    edge = dot(np.broadcast_to(s, t.shape), geometry.w) > 0.0
    most = np.asarray(geometry.beta_max)[..., None]
    valid = np.all(edge & (beta > 0.0) & (beta <= most), axis=-1)
    return mu, beta, -volume, valid


def _solve_closure(r: Array, e: Array) -> tuple[Index, Array, Mask]:
    """Solve r_k . R e_k = 0 for n configurations with r and e, (n, 3, 3) each.

    Rows are unit vectors, e_1 = (0, 1, 0). Returns the configuration of each root,
    ascending, (m,); the rotations, (m, 3, 3), in the order of `direct`; and whether the
    roots of a configuration are isolated, (n,): where they are not, none is given.
    """
    r0, rest = r[:, 0], r[:, 1:]
    n = cross(r0, np.eye(3)[np.argmin(np.abs(r0), axis=1)])
    n /= np.linalg.norm(n, axis=1)[:, None]
    m = cross(r0, n)
    rn, rm = (rest @ n[:, :, None])[..., 0], (rest @ m[:, :, None])[..., 0]
    ex, ey = e[..., 1:, 0], e[..., 1:, 1]
    # Coefficients of (cos x, sin x) in a and c, and the number b; shapes (n, 2, 2) and
    # (n, 2).
    a = ex[..., None] * np.stack([-rm, rn], axis=-1)
    b = -ex * (rest @ r0[:, :, None])[..., 0]
    c = ey[..., None] * np.stack([rn, rm], axis=-1)
    form = _quartic(a, b, c)
    isolated = np.abs(form).max(axis=1) > _NOT_ISOLATED
    x, keep = _roots(form, isolated)
    y, fits = _second_angles(x, a, b, c)
    owner, root, which = np.nonzero(keep[:, :, None] & fits)
    x, y = x[owner, root][:, None], y[owner, root, which][:, None]
    t1 = np.cos(x) * n[owner] + np.sin(x) * m[owner]
    s = np.cos(y) * r0[owner] + np.sin(y) * cross(t1, r0[owner])
    rotation, residual = _polish(r[owner], e[owner], columns(cross(t1, s), t1, s))
    good = residual <= ROUNDING
    owner, rotation = _distinct(r, e, owner[good], rotation[good])
    return (*_arrange(owner, rotation), isolated)


def _largest(rows: Array) -> Array:
    """Largest size of an entry in rows of three."""
    size = np.abs(rows)
    return np.maximum(np.maximum(size[:, 0], size[:, 1]), size[:, 2])


def _quartic(a: Array, b: Array, c: Array) -> Array:
    """Coefficients of cos^4, cos^3 sin, ..., sin^4 in cos(y)^2 + sin(y)^2 - 1, shape (n, 5)."""
    cosine = b[:, :1] * c[:, 1] - b[:, 1:] * c[:, 0]
    one = a[:, 0] * b[:, 1:] - a[:, 1] * b[:, :1]
    sine = _product(c[:, 0], a[:, 1]) - _product(a[:, 0], c[:, 1])
    form = _product(sine, sine)
    bare = _product(cosine, cosine) - _product(one, one)
    form[:, :3] += bare
    form[:, 2:] += bare
    return form


def _product(a: Array, b: Array) -> Array:
    """Products of forms, coefficients along the last axis."""
    result = np.zeros((len(a), a.shape[1] + b.shape[1] - 1))
    for power in range(a.shape[1]):
        result[:, power : power + b.shape[1]] += a[:, power, None] * b
    return result


def _turn_forms(count: int) -> tuple[Array, Array]:
    """Angles x0 and matrices that turn a quartic form's coefficients from x to x - x0."""
    angles = np.arange(count) * np.pi / count
    matrices = np.zeros((count, 5, 5))
    for turn, (cosine, sine) in enumerate(
        zip(np.cos(angles), np.sin(angles), strict=True)
    ):
        for power in range(5):
            term = np.ones(1)
            for factor in [[cosine, -sine]] * (4 - power) + [[sine, cosine]] * power:
                term = np.convolve(term, factor)
            matrices[turn, :, power] = term
    return angles, matrices


_TURN, _TURNED = _turn_forms(5)


def _roots(form: Array, isolated: Mask) -> tuple[Array, Mask]:
    """Angles x of the roots, shape (n, 4), modulo pi, and which of them may be real."""
    # Count x from where the form is largest: then its leading coefficient is no small
    # number.
    best = np.argmax(np.abs(form @ _TURNED[:, 0].T), axis=1)
    turned = (_TURNED[best] @ form[:, :, None])[..., 0]
    lead = np.where(isolated, turned[:, 0], 1.0)
    companion = np.zeros((len(form), 4, 4))
    companion[:, 0] = -turned[:, 1:] / lead[:, None]
    companion[:, [1, 2, 3], [0, 1, 2]] = 1.0
    z = np.linalg.eigvals(companion)
    size = z.real**2 + z.imag**2
    x = _TURN[best][:, None] + 0.5 * np.arctan2(2.0 * z.real, size - 1.0)
    return x, isolated[:, None] & (np.abs(z.imag) < _NEAR_REAL * (1.0 + size))


def _second_angles(x: Array, a: Array, b: Array, c: Array) -> tuple[Array, Mask]:
    """Angles y at x, shape (n, 4, 2), and which fit both legs: two where the legs agree."""
    direction = np.stack([np.cos(x), np.sin(x)], axis=1)
    a, c = a @ direction, c @ direction
    b = np.broadcast_to(b[:, :, None], a.shape)
    reach = np.hypot(a, b)
    steep = reach[:, 1] > reach[:, 0]
    chosen = np.where(steep, reach[:, 1], reach[:, 0])
    with np.errstate(divide="ignore", invalid="ignore"):
        cosine = np.clip(-np.where(steep, c[:, 1], c[:, 0]) / chosen, -1.0, 1.0)
    swing = np.arccos(np.where(chosen > 0.0, cosine, 0.0))
    middle = np.arctan2(
        np.where(steep, b[:, 1], b[:, 0]), np.where(steep, a[:, 1], a[:, 0])
    )
    y = np.stack([middle + swing, middle - swing], axis=-1)
    misfit = (
        a[..., None] * np.cos(y)[:, None]
        + b[..., None] * np.sin(y)[:, None]
        + c[..., None]
    )
    return y, np.abs(misfit).max(axis=1) < _MISFIT


def _polish(r: Array, e: Array, rotation: Array) -> tuple[Array, Array]:
    """Newton's method on SO(3); the best iterate of each start and its residual."""
    best, least = rotation.copy(), np.full(len(rotation), np.inf)
    active, last = np.arange(len(rotation)), np.full(len(rotation), np.inf)
    for _ in range(_STEPS):
        t = e @ rotation.transpose(0, 2, 1)
        residual = dot(r, t)
        largest = _largest(residual)
        better = largest < least[active]
        least[active[better]], best[active[better]] = largest[better], rotation[better]
        open_ = last > _LAST_STEP
        if not open_.any():
            break
        if not open_.all():
            active, r, t, rotation = active[open_], r[open_], t[open_], rotation[open_]
            residual, e = residual[open_], e[open_]
        step = _newton_step(cross(t, r), residual)
        last = np.sqrt(dot(step, step))
        if last.max() > _LONGEST_TURN:
            step = (
                step
                * np.minimum(1.0, _LONGEST_TURN / np.maximum(last, 1e-300))[:, None]
            )
        rotation = rotate(rotation, step)
    return best, least


def _newton_step(slope: Array, residual: Array) -> Array:
    """Solve slope step = -residual.

    The shortest such step where slope is nearly singular.
    """
    first, second, third = slope[:, 0], slope[:, 1], slope[:, 2]
    # A^-1 is the adjugate over the determinant; its columns are these vector products.
    adjugate = columns(cross(second, third), cross(third, first), cross(first, second))
    determinant = dot(first, adjugate[:, :, 0])
    regular = np.abs(determinant) > _REGULAR
    scale = -1.0 / np.where(regular, determinant, 1.0)
    step = (adjugate @ residual[:, :, None])[..., 0] * scale[:, None]
    if not regular.all():
        odd = ~regular
        inverse = np.linalg.pinv(slope[odd], rcond=1e-9)
        step[odd] = -(inverse @ residual[odd][:, :, None])[..., 0]
    return np.asarray(step)


def rotate(rotation: Array, step: Array) -> Array:
    """Turn R, shape (..., 3, 3), by small rotation vectors `step` in {B} and keep it orthonormal.

    The turn is exact to second order, which is all that Newton's method asks for.
    """
    t, s = rotation[..., 1], rotation[..., 2]
    ts, ss = cross(step, t), cross(step, s)
    t, s = t + ts + 0.5 * cross(step, ts), s + ss + 0.5 * cross(step, ss)
    s = s / np.sqrt(dot(s, s))[..., None]
    t = t - s * dot(s, t)[..., None]
    t = t / np.sqrt(dot(t, t))[..., None]
    return columns(cross(t, s), t, s)


def _distinct(r: Array, e: Array, owner: Index, rotation: Array) -> tuple[Index, Array]:
    """Keep one of each root; t_1 and -t_1 count as the same here."""
    if not len(owner):
        return owner, rotation
    fresh = np.ones(len(owner), dtype=bool)
    for back in range(1, 8):
        later = np.arange(back, len(owner))
        later = later[(owner[later] == owner[later - back]) & fresh[later]]
        if not len(later):
            continue
        new, old = rotation[later], rotation[later - back]
        sign = np.where(dot(new[:, :, 1], old[:, :, 1]) < 0.0, -1.0, 1.0)
        old = old * np.stack([sign, sign, np.ones_like(sign)], axis=1)[:, None, :]
        close = np.abs(new - old).max(axis=(1, 2)) < _SAME
        if close.any():
            at = later[close]
            middle = rotate(0.5 * (new[close] + old[close]), np.zeros((len(at), 3)))
            t = e[owner[at]] @ middle.transpose(0, 2, 1)
            fresh[at] = _largest(dot(r[owner[at]], t)) > ROUNDING
    return owner[fresh], rotation[fresh]


def _arrange(owner: Index, rotation: Array) -> tuple[Index, Array]:
    """Sort, and set the partner R Rot(z, pi) beside each root."""
    s = np.round(rotation[:, :, 2], 6)
    order = np.lexsort((s[:, 0], s[:, 1], s[:, 2], owner))
    owner, rotation = owner[order], rotation[order]
    # t_1 first, then -t_1: first the one further along the first base vector where they
    # differ.
    t = np.round(rotation[:, :, 1], 6)
    lead = t[np.arange(len(t)), np.argmax(t != 0.0, axis=1)] < 0.0
    rotation = np.where(lead[:, None, None], rotation * [-1.0, -1.0, 1.0], rotation)
    both = np.stack([rotation, rotation * [-1.0, -1.0, 1.0]], axis=1)
    return np.repeat(owner, 2), both.reshape(-1, 3, 3)
