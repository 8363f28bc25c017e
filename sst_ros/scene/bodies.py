# SPDX-License-Identifier: Apache-2.0
"""The mechanism of a scene: base triangle, star, links, payload, and its range.

The range is the one that they move in. Bodies rotate about the fixed centre O, so every
inertia here is about O but the payload's; one that a document gives about the centre of
mass is shifted when it is read (parallel axes). Letters and frames are the paper's:
base directions v_k, angles alpha_k between the arcs of the moving spherical star (MSS),
{E} fixed in the star, {1k} in actuated link k, {2k} in intermediate link k.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from sst_ros.errors import Problem, check_kinds, refuse_unless
from sst_ros.scene.schema import Rules, Section, amount, choice, coefficient, entry
from sst_ros.state import ZERO, Array, Vector3

RELATIVE_ROUNDING = 1e-9
"""Share by which numbers of a document may miss a bound that they are on."""

SHIFT_ROUNDING = 1e-6
"""Share of the largest moment by which moments about a centre of mass may miss a bound.

They are small differences of large numbers, which the document has rounded.
"""

SMALLEST_SIDE = 4e-5
"""Side [rad] of an equilateral base whose volume is lost in RELATIVE_ROUNDING."""

SHORTEST_DIRECTION = 1e-6
"""Length of a direction `v` below which it counts as zero."""

ABOUT_O = "O"
ABOUT_CENTRE = "centre_of_mass"

SMALLEST_MOMENT = 1e-18
"""Moment of inertia [kg m^2] of a microgram at a millimetre.

Its inverse must not overflow.
"""


class Inertia(Section):
    """A symmetric inertia tensor, about O for all but the payload.

    Off-diagonal entries are those of the tensor: xy = -sum(m x y), the negative product
    of inertia.
    """

    xx: float = entry("inertia tensor, xx", "kg m^2")
    yy: float = entry("inertia tensor, yy", "kg m^2")
    zz: float = entry("inertia tensor, zz", "kg m^2")
    xy: float = entry("inertia tensor, xy", "kg m^2", default=0.0)
    xz: float = entry("inertia tensor, xz", "kg m^2", default=0.0)
    yz: float = entry("inertia tensor, yz", "kg m^2", default=0.0)

    @property
    def matrix(self) -> Array:
        """The tensor, shape (3, 3) [kg m^2]."""
        return _matrix_of(entries_of(self))

    def rules(self) -> Rules:
        """Refuse what no rigid body has."""
        tensor = entries_of(self)
        xx, yy, zz, *_ = tensor
        trace = xx + yy + zz
        # A moment that equals the sum of the other two is half the trace.
        largest = (1.0 + RELATIVE_ROUNDING) / (2.0 + RELATIVE_ROUNDING) * trace
        definite = _is_positive(tensor, -SMALLEST_MOMENT * (1.0 - RELATIVE_ROUNDING))
        fits = _is_positive([-entry for entry in tensor], largest)
        least = f"> 0 (positive definite), at least {SMALLEST_MOMENT:g} kg m^2"
        yield ~definite, "", tensor, f"principal moments of inertia must be {least}"
        requirement = "no principal moment may exceed the sum of the other two"
        yield definite & ~fits, "", tensor, requirement


class Base(Section):
    """The fixed spherical triangle P1 P2 P3 in {B}, by directions v or by its arcs.

    The arcs 1-2, 2-3, 3-1 do not place the triangle in {B}: P1 is then put on the x
    axis of {B}, P2 in its xy plane with y > 0, and P3 above that plane: v1 = (1, 0, 0),
    v2 = (cos a12, sin a12, 0), v3 = (cos a31, y, z > 0) with v2 . v3 = cos a23. A scene
    that is read has these v.
    """

    ONE_OF = "v", "arcs_deg"
    CONVERTED = ("v",)

    v: tuple[Vector3, Vector3, Vector3] = entry(
        "directions of P1, P2, P3 seen from O, right-handed, of any length",
        "1",
        default=None,
    )
    arcs_deg: Vector3 | None = entry(
        "lengths of the arcs 1-2, 2-3, 3-1, in place of v", "deg", least=1e-6
    )
    radius: float = amount("radius of the base sphere", "m")

    def settle(self) -> Iterator[Problem]:
        """Replace arcs by directions; refuse those that close no triangle."""
        arcs = self.arcs_deg
        if arcs is None or self.v is not None:
            return
        if 2.0 * max(arcs) < sum(arcs) < 360.0:
            v = _directions_of(*np.radians(arcs).tolist())
            vars(self).update(v=v, arcs_deg=None)
            return
        requirement = (
            "must close: each less than the sum of the others, their sum less than"
            " 360 deg"
        )
        yield Problem("arcs_deg", arcs, requirement)

    def rules(self) -> Rules:
        """Refuse triangles without area and left-handed ones."""
        if self.v is None:
            return
        # Columns of many scenes have the row last: it comes first here.
        v = np.moveaxis(np.asarray(self.v), (0, 1), (-2, -1))
        lengths = np.linalg.norm(v, axis=-1)
        volume = np.linalg.det(v / lengths[..., None])
        without_direction = lengths.min(axis=-1) < SHORTEST_DIRECTION
        flat = without_direction | ~(abs(volume) >= RELATIVE_ROUNDING)
        apart = (
            f"P1, P2, P3 must lie {SMALLEST_SIDE:g} rad apart or more, and not on one"
            " great circle; no direction may be zero (degenerate)"
        )
        yield flat, "v", self.v, apart
        handed = "must be right-handed, v1 . (v2 x v3) > 0: exchange two of the points"
        yield ~flat & (volume < 0.0), "v", self.v, handed


def _directions_of(
    a12: float, a23: float, a31: float
) -> tuple[Vector3, Vector3, Vector3]:
    """Return the directions of the corners of a spherical triangle.

    It has these arcs [rad], as in `Base`.
    """
    # v1 . (v2 x v3) = 2 sqrt(product) = z sin a12, where z is the last entry of v3.
    half = 0.5 * (a12 + a23 + a31)
    product = (
        math.sin(half)
        * math.sin(half - a12)
        * math.sin(half - a23)
        * math.sin(half - a31)
    )
    # Cosines by sines, which keep short arcs.
    c12 = math.sin(0.5 * math.pi - a12)
    c23 = math.sin(0.5 * math.pi - a23)
    c31 = math.sin(0.5 * math.pi - a31)
    s12 = math.sin(a12)
    v1 = (1.0, 0.0, 0.0)
    v2 = (c12, s12, 0.0)
    v3 = (c31, (c23 - c31 * c12) / s12, 2.0 * math.sqrt(max(product, 0.0)) / s12)
    return v1, v2, v3


class Link(Section):
    """One rigid link of a leg.

    Without `inertia` it has none, without `mass` no weight.
    """

    CONVERTED = "inertia", "mass", "centre"

    inertia: Inertia | None = entry("inertia of the link in its own frame")
    mass: float = coefficient("mass, for gravity", "kg")
    centre: Vector3 = entry(
        "centre of mass in the frame of the inertia",
        "m",
        default=ZERO,
        acts_on=("mass",),
    )
    inertia_about: str = choice(
        "point of the inertia; once read it is O", (ABOUT_O, ABOUT_CENTRE)
    )

    @property
    def tensor(self) -> Array:
        """The inertia, shape (3, 3) [kg m^2], zero without one."""
        return _matrix_of(entries_of(self.inertia))

    def settle(self) -> Iterator[Problem]:
        """Replace an inertia about the centre of mass by that about O."""
        if self.inertia_about != ABOUT_CENTRE:
            return
        if self.mass == 0.0 or self.inertia is None:
            requirement = "needs an inertia and mass > 0 [kg]"
            yield Problem("inertia_about", ABOUT_CENTRE, requirement)
            return
        shifted = _inertia_of(shift_inertia(self.inertia, self.mass, self.centre))
        vars(self).update(inertia=shifted, inertia_about=ABOUT_O)

    def rules(self) -> Rules:
        """Refuse centres and inertias that contradict the mass."""
        x, y, z = self.centre
        scale = self.mass * (x * x + y * y + z * z)
        for moment in entries_of(self.inertia):
            scale = np.maximum(scale, abs(moment))
        # Moments about the centre of mass: none exceeds half their sum, but for
        # rounding.
        about_centre = shift_inertia(self.inertia, -self.mass, self.centre)
        xx, yy, zz, *_ = about_centre
        largest = 0.5 * (xx + yy + zz) + 0.5 * (SHIFT_ROUNDING * scale)
        fits = _is_positive([-moment for moment in about_centre], largest)
        has_mass = np.greater(self.mass, 0.0) & np.greater(scale, 0.0)
        requirement = (
            "must fit the inertia about O, which leaves moments about this centre that"
            f" no body has (inertia_about: {ABOUT_CENTRE} takes one about the centre of"
            " mass)"
        )
        yield has_mass & ~fits, "centre", self.centre, requirement


class Star(Link):
    """The moving spherical star."""

    inertia: Inertia = entry("inertia of the star in {E}")
    alpha_deg: Vector3 = amount(
        "angles between the planes of arcs 1-2, 2-3, 3-1", "deg"
    )
    radius: float = amount("radius of the star's sphere, distance O E", "m")

    def rules(self) -> Rules:
        """Refuse open arcs, and a mass that contradicts the inertia.

        Arcs are open where they do not close around E.
        """
        total = sum(self.alpha_deg)
        open_ = np.greater(abs(total - 360.0), 360.0 * RELATIVE_ROUNDING)
        requirement = f"must sum to 360 deg; the sum is {total}"
        yield open_, "alpha_deg", self.alpha_deg, requirement
        yield from super().rules()


class Payload(Section):
    """A body carried by the star; its inertia is about its own centre of mass."""

    EFFECTS = "mass", "inertia"

    mass: float = amount("mass", "kg")
    centre: Vector3 = entry("centre of mass in {E}", "m")
    inertia: Inertia | None = entry(
        "inertia about the payload's centre of mass, axes of {E}; none for a point"
    )

    @property
    def entries(self) -> list[Any]:
        """Inertia about O in {E}: xx, yy, zz, xy, xz, yz [kg m^2]."""
        return shift_inertia(self.inertia, self.mass, self.centre)

    @property
    def about_o(self) -> Array:
        """Inertia about O in {E}, shape (3, 3) [kg m^2]."""
        return _matrix_of(self.entries)


class Stroke(Section):
    """The range of the actuators, 0 < gamma_k < arc P_k P_k+1.

    Elastic stops give the torque stiffness depth (1 + damping rate inwards), never a
    pull. Their damping is given as such, or by the restitution at one impact rate.
    """

    at_end: str = choice("what happens at its ends", ("stop", "ignore", "elastic"))
    stiffness: float | None = amount("stiffness of elastic stops", "N m/rad")
    damping: float = coefficient(
        "damping: torque = stiffness depth (1 + damping rate inwards)", "s/rad"
    )
    restitution: float | None = entry(
        "rate after an impact / rate before, in place of damping",
        "1",
        least=0.01,
        most=1.0,
    )
    impact_rate: float | None = amount(
        "rate of the impacts that have this restitution", "rad/s"
    )

    def rules(self) -> Rules:
        """Refuse coefficients of another kind of end, and two dampings.

        A kind without its own coefficients is refused, too.
        """
        elastic = self.at_end == "elastic"
        damped = np.not_equal(self.damping, 0.0)
        bounces = self.restitution is not None
        only = "is given with at_end: elastic, and only there"
        yield (self.stiffness is not None) != elastic, "stiffness", self.stiffness, only
        yield bounces and not elastic, "restitution", self.restitution, only
        alone = bounces != (self.impact_rate is not None)
        paired = "is given with restitution, both or none"
        yield alone, "impact_rate", self.impact_rate, paired
        yield damped & (not elastic), "damping", self.damping, only
        either = "give either damping or restitution"
        yield damped & bounces, "damping", self.damping, either


class Workspace(Section):
    """Where E may be: on the base triangle, 0 < beta_k <= beta_max."""

    beta_max_deg: float = amount(
        "largest angle between E and the intermediate link",
        "deg",
        default=90.0,
        most=180.0,
    )
    at_edge: str = choice(
        "what happens at the edge of the workspace", ("stop", "ignore")
    )


PLACES = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))
"""Rows and columns of the six numbers of an inertia (xx, yy, zz, xy, xz, yz)."""


def entries_of(inertia: Inertia | None) -> list[Any]:
    """Return xx, yy, zz, xy, xz and yz, zero without inertia.

    They may be columns or symbols.
    """
    if inertia is None:
        return [0.0] * len(PLACES)
    return [*vars(inertia).values()]


def shift_inertia(inertia: Inertia | None, mass: Any, centre: Any) -> list[Any]:
    """Return six numbers about O of an inertia about the centre of mass.

    They are shifted by parallel axes. They may be columns.
    """
    x, y, z = centre
    square = x * x + y * y + z * z
    shifted = []
    for moment, (i, j) in zip(entries_of(inertia), PLACES, strict=True):
        point_mass = mass * (square * float(i == j) - centre[i] * centre[j])
        shifted.append(moment + point_mass)
    return shifted


def _matrix_of(entries: Iterable[Any]) -> Array:
    xx, yy, zz, xy, xz, yz = entries
    return np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])


def _inertia_of(entries: Iterable[float]) -> Inertia:
    return Inertia(**dict(zip(Inertia.SPECS, entries, strict=True)))


def _is_positive(entries: Sequence[Any], shift: Any) -> Any:
    """Return whether a symmetric matrix + shift 1 is positive definite.

    The pivots of its L D L^T are positive then.
    """
    xx, yy, zz, xy, xz, yz = map(np.asarray, entries)
    first = xx + shift
    second = yy + shift - xy * xy / (xx + shift)
    off = yz - xy * xz / first
    third = zz + shift - xz * xz / first - off * off / second
    return np.asarray((first > 0.0) & (second > 0.0) & (third > 0.0))


@check_kinds
def arc_inertia(
    mass: float, radius: float, begin: ArrayLike, end: ArrayLike
) -> Inertia:
    """Return the inertia about O of a thin, uniform arc of a great circle.

    Inertias of several arcs add up.

    Mass [kg] and radius [m] are those of the arc; `begin` and `end` are directions from
    O, shape (3,), of any length and less than pi apart. Raises InputError where mass or
    radius is not positive, or the directions span no arc.
    """
    first = np.asarray(begin, dtype=float)
    last = np.asarray(end, dtype=float)
    normal = math.nan
    if first.shape == last.shape == (3,):
        normal = float(np.linalg.norm(np.cross(first, last)))
    spans = normal > 1e-9 * float(np.linalg.norm(first) * np.linalg.norm(last))
    directions = "must be two directions, shape (3,), neither parallel nor opposite"
    refuse_unless(
        "arc_inertia",
        ("mass", mass, 0.0 < mass < math.inf, "must be > 0 and finite [kg]"),
        ("radius", radius, 0.0 < radius < math.inf, "must be > 0 and finite [m]"),
        ("begin, end", (begin, end), spans, directions),
    )
    u = first / np.linalg.norm(first)
    v = last / np.linalg.norm(last)
    half = 0.5 * math.atan2(normal, float(first @ last))
    # Mean of r r^T over the arc: angles from -half to half about its middle.
    ratio = math.sin(2.0 * half) / (2.0 * half)
    spread = np.zeros((3, 3))
    for along, share in ((u + v, 1.0 + ratio), (v - u, 1.0 - ratio)):
        spread += 0.5 * share * np.outer(along, along) / (along @ along)
    tensor = mass * radius**2 * (np.eye(3) - spread)
    return _inertia_of(tensor[place] for place in PLACES)
