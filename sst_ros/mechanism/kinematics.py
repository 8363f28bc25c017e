# SPDX-License-Identifier: Apache-2.0
"""Positions: orientation -> joint angles, and actuator angles -> every orientation.

A leg holds t_k at a right angle to r_k; that is all there is to the position problem:
r_k(gamma_k) . R e_k = 0 for k = 1, 2, 3. Its roots R are those of one quartic, for many
r at once:

t_1 = cos(x) n + sin(x) m spans the plane across r_1, and s = cos(y) r_1 + sin(y) t_1 x
r_1. Legs 2 and 3 then read a cos(y) + b sin(y) + c = 0, so (cos y, sin y, 1) is the
cross product of the two rows (a, b, c), and cos^2 + sin^2 = 1 is a form of degree four
in (cos x, sin x). Its roots come from a companion matrix; each is polished on the
rotation itself. t_1 and -t_1 give two assemblies, R and R Rot(z, pi), that share s: up
to eight.

Resolution: two roots are distinguished when the residual r_k . t_k midway between them
is more than rounding, so that they are some 1e-6 rad apart or gamma is some 1e-12 rad
off the fold where they meet. Closer ones, real or a complex pair, are a double root in
this arithmetic, for r_k and e_k are rounded too: they come out as one, with det J2
near 0.
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
    norm,
    quaternion_of,
)
from sst_ros.state import Assembly

Index = NDArray[np.intp]
Mask = NDArray[np.bool_]
NEAR = 0.1  # how near an assembly must be to the rotation that names it [rad]
CLOSURE_ROUNDING = 1e-15  # largest abs(r_k . t_k) that is rounding and not a residual
NOT_ISOLATED = 1e-13  # quartic forms with smaller coefficients vanish identically
# The next three choose what is polished and compared: larger ones cost time only,
# smaller ones may lose a root.
NEAR_REAL = 1e-3  # imaginary part, over 1 + abs(z)^2, of a root that may be real
SAME_ROOT = 1e-3  # entries of two rotations that may be one root differ by less
MISFIT = 1e-2  # residual of leg 2 or 3 at an angle y that is worth polishing
POSE_NEWTON_STEPS = 40  # at most: each halves the distance to a double root
LONGEST_TURN = 0.3  # of a Newton step [rad]: a longer one may leave the root's vicinity
LAST_STEP = 1e-9  # a Newton step [rad] after which rounding is reached
REGULAR = 1e-5  # abs(det J2) above which a Newton step is solved by the adjugate
SMALLEST = 1e-300  # divisor in place of zero
SORTED_DIGITS = 6  # decimals by which assemblies are sorted: rounding decides nothing
HALF_TURN = np.array([-1.0, -1.0, 1.0])  # R Rot(z, pi) is R times it


@dataclass(frozen=True)
class Assemblies:
    """The assemblies of many gamma at once; m of them for n configurations.

    Read-only arrays.
    """

    #: row of gamma that each assembly belongs to, ascending, shape (m,)
    configuration: Index
    rotation: Array  #: this and what follows as in `Assembly`, with m first
    mu: Array
    beta: Array
    det_j2: Array
    admissible: Mask
    #: shape (n,); False where gamma has a continuum of assemblies: none is listed
    isolated: Mask


def carriage_directions(geometry: Geometry, gamma: ArrayLike) -> Array:
    """Directions r_k of the intermediate joints in {B}, Eq. 1.

    Shape (..., 3, 3), rows by leg.
    """
    angles = np.asarray(gamma, dtype=float)[..., None]
    across = cross(geometry.w, geometry.v)
    return np.asarray(np.cos(angles) * geometry.v + np.sin(angles) * across)


def star_axes(geometry: Geometry, rotation: Array) -> Array:
    """Axes t_k = R e_k of the star's arcs in {B}, shape (..., 3, 3), rows by leg."""
    return np.asarray(geometry.e @ np.swapaxes(rotation, -1, -2))


def closure(geometry: Geometry, gamma: ArrayLike, rotation: ArrayLike) -> Array:
    """Residuals r_k . R e_k of the loops, zero where they are closed, shape (..., 3).

    They are those of gamma [rad], shape (..., 3), and R, shape (..., 3, 3).
    """
    t = star_axes(geometry, np.asarray(rotation, dtype=float))
    return dot(carriage_directions(geometry, gamma), t)


@check_kinds
def inverse(
    geometry: Geometry, rotation: ArrayLike, signs: ArrayLike = (1, 1, 1)
) -> tuple[Array, Array, Array]:
    """Joint angles (gamma, mu, beta) of orientations R, shape (..., 3, 3).

    Each of the three is in radians and has the shape (..., 3).

    The planes across w_k and t_k meet in one line, so every leg has two solutions, r_k
    and -r_k, and an orientation has eight:

    - sign +1, r_k = t_k x w_k / sin(mu_k): mu_k in (0, pi). All admissible assemblies
      have it, and on it beta_k changes sign smoothly at the edge of the workspace.
    - sign -1, -r_k: gamma_k + pi, -mu_k and beta_k + pi, wrapped to (-pi, pi].

    Where t_k = +-w_k (serial singularity) every gamma_k fits and it comes out as 0.
    InputError refuses other shapes.
    """
    matrices = np.asarray(rotation, dtype=float)
    shape = matrices.shape
    refuse_unless(
        "inverse",
        ("rotation", shape, shape[-2:] == (3, 3), "must be (..., 3, 3)"),
        ("signs", signs, np.shape(signs) == (3,), "must be three of 1 and -1"),
    )
    t = star_axes(geometry, matrices)
    s = matrices[..., None, :, 2]
    p = cross(t, geometry.w)
    sine = norm(p)
    sign = np.asarray(signs, dtype=float)
    p = sign[:, None] * p
    across = cross(geometry.w, geometry.v)
    gamma = np.arctan2(dot(p, across), dot(p, geometry.v))
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
    assemblies = direct_many(geometry, angles[None])
    if not assemblies.isolated[0]:
        raise AssemblyError("the assemblies are not isolated", angles)
    return [
        Assembly(
            rotation=assemblies.rotation[row],
            mu=assemblies.mu[row],
            beta=assemblies.beta[row],
            det_j2=float(assemblies.det_j2[row]),
            admissible=bool(assemblies.admissible[row]),
        )
        for row in range(len(assemblies.rotation))
    ]


def direct_many(geometry: Geometry, gamma: ArrayLike) -> Assemblies:
    """All real assemblies of many gamma [rad], shape (n, 3), in the order of `direct`.

    The geometry may be one for each. AssemblyError refuses what is not (n, 3) finite
    numbers.
    """
    angles = np.asarray(gamma, dtype=float)
    is_table = angles.ndim == 2 and angles.shape[1] == 3
    if not is_table or not np.all(np.isfinite(angles)):
        raise AssemblyError(
            "gamma must be three finite numbers, or rows of them", angles
        )
    r = carriage_directions(geometry, angles)
    e = np.broadcast_to(geometry.e, r.shape)
    configuration, rotation, isolated = _solve_closure(r, e)
    mu, beta, det_j2, admissible = describe_assemblies(
        geometry.of_rows(configuration), r[configuration], rotation
    )
    return Assemblies(
        *frozen(configuration, rotation, mu, beta, det_j2, admissible, isolated)
    )


def admissible(
    geometry: Geometry, gamma: ArrayLike, near: ArrayLike | None = None
) -> Assembly:
    """Return the one assembly in which the manipulator can be built, section 4.1.

    The actuator angles gamma [rad] have the shape (3,). Where several are admissible,
    the rotation `near` selects the only one within NEAR of it.

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
        rotations = np.stack([candidate.rotation for candidate in candidates])
        orientations = quaternion_of(rotations)
        if near is not None:
            apart = angle_between(orientations, quaternion_of(near))
            selected = np.flatnonzero(apart < NEAR)
            if len(selected) == 1:
                return candidates[int(selected[0])]
        raise AmbiguousAssembly(angles, candidates, orientations)
    return candidates[0]


def admissible_rotations(geometry: Geometry, gamma: ArrayLike) -> Array:
    """Return the rotations of the admissible assemblies at many gamma.

    Args:
        geometry: of the manipulator.
        gamma: actuator angles [rad], shape (n, 3).

    Returns:
        Rotations R, shape (n, 3, 3).

    Raises:
        AssemblyError: as `admissible` of the first gamma that has no unique admissible
            assembly.

    """
    angles = np.asarray(gamma, dtype=float)
    for row in np.flatnonzero(~np.isfinite(angles).all(axis=1)):
        admissible(geometry, angles[row])  # raises the error
    assemblies = direct_many(geometry, angles)
    owners = assemblies.configuration[assemblies.admissible]
    counts = np.bincount(owners, minlength=len(angles))
    for row in np.flatnonzero((counts != 1) | ~assemblies.isolated):
        admissible(geometry, angles[row])  # raises the error
    return assemblies.rotation[assemblies.admissible]


def describe_assemblies(
    geometry: Geometry, r: Array, rotation: Array
) -> tuple[Array, Array, Array, Mask]:
    """Passive angles mu and beta [rad], det J2 and admissibility of closed assemblies.

    The carriage directions r, in rows, and R have the shape (..., 3, 3); mu and beta
    then have (..., 3), the others (...).
    """
    t = star_axes(geometry, rotation)
    s = rotation[..., None, :, 2]
    mu = np.arctan2(dot(cross(t, geometry.w), r), dot(geometry.w, t))
    beta = np.arctan2(dot(r, cross(t, s)), dot(r, s))
    first, second, third = np.moveaxis(cross(r, t), -2, 0)
    # J2 has the rows t_k x r_k = -(r_k x t_k).
    det_j2 = -dot(first, cross(second, third))
    is_on_triangle = dot(np.broadcast_to(s, t.shape), geometry.w) > 0.0
    beta_max = np.asarray(geometry.beta_max)[..., None]
    in_reach = (beta > 0.0) & (beta <= beta_max)
    return mu, beta, det_j2, np.all(is_on_triangle & in_reach, axis=-1)


def _solve_closure(r: Array, e: Array) -> tuple[Index, Array, Mask]:
    """Solve r_k . R e_k = 0 for many configurations at once.

    The letters are those of this module's docstring. r and e have the configuration
    first, then rows of unit vectors by leg; e_1 = (0, 1, 0). Returns the configuration
    of each root, ascending; the rotations, in the order of `direct`; and whether the
    roots of each configuration are isolated: where they are not, none is given.
    """
    r_1 = r[:, 0]
    directions = r[:, 1:]  # r_2 and r_3
    least_axis = np.eye(3)[np.argmin(np.abs(r_1), axis=1)]  # far from r_1
    n = cross(r_1, least_axis)
    n /= np.linalg.norm(n, axis=1)[:, None]
    m = cross(r_1, n)
    along_n = (directions @ n[:, :, None])[..., 0]
    along_m = (directions @ m[:, :, None])[..., 0]
    along_r = (directions @ r_1[:, :, None])[..., 0]
    e_x = e[..., 1:, 0]
    e_y = e[..., 1:, 1]
    # For each configuration and legs 2 and 3: two coefficients, of cos x and sin x, in
    # a and c; one number in b.
    a = e_x[..., None] * np.stack([-along_m, along_n], axis=-1)
    b = -e_x * along_r
    c = e_y[..., None] * np.stack([along_n, along_m], axis=-1)
    form = _quartic(a, b, c)
    isolated = np.abs(form).max(axis=1) > NOT_ISOLATED
    x, may_be_real = _roots(form, isolated)
    y, fits = _second_angles(x, a, b, c)
    owner, root, branch = np.nonzero(may_be_real[:, :, None] & fits)
    x = x[owner, root][:, None]
    y = y[owner, root, branch][:, None]
    t_1 = np.cos(x) * n[owner] + np.sin(x) * m[owner]
    s = np.cos(y) * r_1[owner] + np.sin(y) * cross(t_1, r_1[owner])
    start = columns(cross(t_1, s), t_1, s)
    rotation, residual = _polish(r[owner], e[owner], start)
    closed = residual <= CLOSURE_ROUNDING
    owner, rotation = _distinct(r, e, owner[closed], rotation[closed])
    owner, rotation = _arrange(owner, rotation)
    return owner, rotation, isolated


def _largest(rows: Array) -> Array:
    """Largest size of an entry in rows of three, shape (n, 3) -> (n,)."""
    first, second, third = np.abs(rows).T
    return np.asarray(np.maximum(np.maximum(first, second), third))


# where the coefficients of a quadratic form are in one of degree four
TIMES_COSINE_SQUARED = slice(0, 3)
TIMES_SINE_SQUARED = slice(2, 5)


def _quartic(a: Array, b: Array, c: Array) -> Array:
    """Coefficients of cos^4 x, cos^3 x sin x, ..., sin^4 x, shape (n, 5).

    The form is that of cos(y)^2 + sin(y)^2 - 1, where (cos y, sin y, 1) is the cross
    product of the rows (a, b, c) of legs 2 and 3.
    """
    a_2, a_3 = a.swapaxes(0, 1)
    b_2, b_3 = b.T[:, :, None]
    c_2, c_3 = c.swapaxes(0, 1)
    cosine = b_2 * c_3 - b_3 * c_2
    scale = a_2 * b_3 - a_3 * b_2
    sine = _product(c_2, a_3) - _product(a_2, c_3)
    form = _product(sine, sine)
    quadratic = _product(cosine, cosine) - _product(scale, scale)
    # The quadratic form becomes one of degree four by the factor cos^2 x + sin^2 x = 1.
    form[:, TIMES_COSINE_SQUARED] += quadratic
    form[:, TIMES_SINE_SQUARED] += quadratic
    return form


def _product(a: Array, b: Array) -> Array:
    """Products of forms, coefficients along the last axis."""
    size = b.shape[1]
    result = np.zeros((len(a), a.shape[1] + size - 1))
    for power, coefficient in enumerate(a.T):
        result[:, power : power + size] += coefficient[:, None] * b
    return result


def _turn_forms(count: int) -> tuple[Array, Array]:
    """Angles x_0, and matrices that turn coefficients of a quartic form to x - x_0."""
    angles = np.arange(count) * np.pi / count
    matrices = np.zeros((count, 5, 5))
    for turn, angle in enumerate(angles):
        cosine = np.cos(angle)
        sine = np.sin(angle)
        for power in range(5):
            # cos^(4 - power) x sin^power x, each factor by cosine and sine of x - x_0
            term = np.ones(1)
            for _ in range(4 - power):
                term = np.convolve(term, [cosine, -sine])
            for _ in range(power):
                term = np.convolve(term, [sine, cosine])
            matrices[turn, :, power] = term
    return angles, matrices


TURN_ANGLES, TURN_MATRICES = _turn_forms(5)


def _roots(form: Array, isolated: Mask) -> tuple[Array, Mask]:
    """Angles x of the roots, shape (n, 4), modulo pi, and which of them may be real."""
    # Count x from where the form is largest: then its leading coefficient is no small
    # number.
    leading = form @ TURN_MATRICES[:, 0].T
    best = np.argmax(np.abs(leading), axis=1)
    turned = (TURN_MATRICES[best] @ form[:, :, None])[..., 0]
    divisor = np.where(isolated, turned[:, 0], 1.0)
    companion = np.zeros((len(form), 4, 4))
    companion[:, 0] = -turned[:, 1:] / divisor[:, None]
    column = np.arange(3)
    companion[:, column + 1, column] = 1.0
    z = np.linalg.eigvals(companion)
    square = z.real**2 + z.imag**2
    # z = cot(x - x_0)
    from_best = 0.5 * np.arctan2(2.0 * z.real, square - 1.0)
    x = TURN_ANGLES[best][:, None] + from_best
    is_near_real = np.abs(z.imag) < NEAR_REAL * (1.0 + square)
    return x, isolated[:, None] & is_near_real


def _second_angles(x: Array, a: Array, b: Array, c: Array) -> tuple[Array, Mask]:
    """Angles y at x, shape (n, 4, 2), and which fit both legs: two where they agree.

    They are those of the leg that depends more on y.
    """
    direction = np.stack([np.cos(x), np.sin(x)], axis=1)
    a = a @ direction  # (n, leg, root)
    c = c @ direction
    b = np.broadcast_to(b[:, :, None], a.shape)
    reach = np.hypot(a, b)
    by_third = reach[:, 1] > reach[:, 0]

    def select(of_legs: Array) -> Array:
        return np.where(by_third, of_legs[:, 1], of_legs[:, 0])

    radius = select(reach)
    with np.errstate(divide="ignore", invalid="ignore"):
        cosine = np.clip(-select(c) / radius, -1.0, 1.0)
    swing = np.arccos(np.where(radius > 0.0, cosine, 0.0))
    middle = np.arctan2(select(b), select(a))
    y = np.stack([middle + swing, middle - swing], axis=-1)
    of_cosine = a[..., None] * np.cos(y)[:, None]
    of_sine = b[..., None] * np.sin(y)[:, None]
    misfit = of_cosine + of_sine + c[..., None]
    return y, np.abs(misfit).max(axis=1) < MISFIT


def _polish(r: Array, e: Array, rotation: Array) -> tuple[Array, Array]:
    """Newton's method on SO(3); the best iterate of each start and its residual."""
    best = rotation.copy()
    least = np.full(len(rotation), np.inf)  # residual of `best`
    active = np.arange(len(rotation))  # which start each row of `rotation` is of
    length = np.full(len(rotation), np.inf)  # of the last step
    for _ in range(POSE_NEWTON_STEPS):
        t = e @ rotation.transpose(0, 2, 1)
        residual = dot(r, t)
        largest = _largest(residual)
        better = largest < least[active]
        least[active[better]] = largest[better]
        best[active[better]] = rotation[better]
        moves = length > LAST_STEP
        if not moves.any():
            break
        if not moves.all():
            active = active[moves]
            rotation = rotation[moves]
            r = r[moves]
            e = e[moves]
            t = t[moves]
            residual = residual[moves]
        step = _newton_step(cross(t, r), residual)
        length = norm(step)
        if length.max() > LONGEST_TURN:
            share = LONGEST_TURN / np.maximum(length, SMALLEST)
            step = step * np.minimum(1.0, share)[:, None]
        rotation = rotate(rotation, step)
    return best, least


def _newton_step(slope: Array, residual: Array) -> Array:
    """Solve slope step = -residual, by the shortest step where nearly singular."""
    first, second, third = slope.swapaxes(0, 1)
    # A^-1 is the adjugate over the determinant; its columns are these vector products.
    adjugate = columns(cross(second, third), cross(third, first), cross(first, second))
    determinant = dot(first, adjugate[:, :, 0])
    regular = np.abs(determinant) > REGULAR
    scale = -1.0 / np.where(regular, determinant, 1.0)
    step = (adjugate @ residual[:, :, None])[..., 0] * scale[:, None]
    if not regular.all():
        singular = ~regular
        pseudo_inverse = np.linalg.pinv(slope[singular], rcond=1e-9)
        step[singular] = -(pseudo_inverse @ residual[singular][:, :, None])[..., 0]
    return np.asarray(step)


def rotate(rotation: Array, step: Array) -> Array:
    """Turn R, shape (..., 3, 3), by small rotation vectors in {B}; keep it orthonormal.

    The turn is exact to second order, which is all that Newton's method asks for.
    """
    t = _turn_vector(rotation[..., 1], step)
    s = _turn_vector(rotation[..., 2], step)
    s = s / norm(s)[..., None]
    t = t - s * dot(s, t)[..., None]
    t = t / norm(t)[..., None]
    return columns(cross(t, s), t, s)


def _turn_vector(vector: Array, step: Array) -> Array:
    moved = cross(step, vector)
    return vector + moved + 0.5 * cross(step, moved)


def _distinct(r: Array, e: Array, owner: Index, rotation: Array) -> tuple[Index, Array]:
    """Keep one solution of each root; those of t_1 and -t_1 count as one here."""
    if not len(owner):
        return owner, rotation
    fresh = np.ones(len(owner), dtype=bool)
    # A configuration has at most eight starts: four angles x with two angles y each.
    for back in range(1, 8):
        later = np.arange(back, len(owner))
        later = later[(owner[later] == owner[later - back]) & fresh[later]]
        if not len(later):
            continue
        new = rotation[later]
        old = rotation[later - back]
        along = dot(new[:, :, 1], old[:, :, 1])  # of the vectors t_1
        sign = np.where(along < 0.0, -1.0, 1.0)
        partner = np.stack([sign, sign, np.ones_like(sign)], axis=1)
        old = old * partner[:, None, :]
        close = np.abs(new - old).max(axis=(1, 2)) < SAME_ROOT
        if close.any():
            rows = later[close]
            mean = 0.5 * (new[close] + old[close])
            middle = rotate(mean, np.zeros((len(rows), 3)))
            t = e[owner[rows]] @ middle.transpose(0, 2, 1)
            fresh[rows] = _largest(dot(r[owner[rows]], t)) > CLOSURE_ROUNDING
    return owner[fresh], rotation[fresh]


def _arrange(owner: Index, rotation: Array) -> tuple[Index, Array]:
    """Sort the roots, and insert the partner R Rot(z, pi) beside each."""
    s_x, s_y, s_z = np.round(rotation[:, :, 2], SORTED_DIGITS).T
    order = np.lexsort((s_x, s_y, s_z, owner))
    owner = owner[order]
    rotation = rotation[order]
    partner = rotation * HALF_TURN
    # t_1 first, then -t_1: first the one further along the first base vector where they
    # differ.
    t_1 = np.round(rotation[:, :, 1], SORTED_DIGITS)
    component = np.argmax(t_1 != 0.0, axis=1)
    first_entry = t_1[np.arange(len(t_1)), component]
    is_behind = (first_entry < 0.0)[:, None, None]
    leading = np.where(is_behind, partner, rotation)
    pairs = np.stack([leading, leading * HALF_TURN], axis=1)
    return np.repeat(owner, 2), pairs.reshape(-1, 3, 3)
