# SPDX-License-Identifier: Apache-2.0
"""What is simulated: the geometry, the inertias, the start and the torques, as one document.

Bodies rotate about the fixed centre O, so every inertia here is about O. Letters and frames are
the paper's: base directions v_k, angles alpha_k between the arcs of the moving spherical star
(MSS), {E} fixed in the star, {1k} in actuated link k, {2k} in intermediate link k.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sst_ros.errors import InputError, Problem
from sst_ros.schema import Section, choice, notes, number, read, section, sections, specs, text

Vector = tuple[float, float, float]

RELATIVE_ROUNDING = 1e-9


@dataclass(frozen=True)
class Inertia(Section):
    """A symmetric inertia tensor about O; off-diagonal entries are those of the tensor."""

    xx: float = number("inertia tensor, xx", "kg m^2")
    yy: float = number("inertia tensor, yy", "kg m^2")
    zz: float = number("inertia tensor, zz", "kg m^2")
    xy: float = number("inertia tensor, xy", "kg m^2", default=0.0)
    xz: float = number("inertia tensor, xz", "kg m^2", default=0.0)
    yz: float = number("inertia tensor, yz", "kg m^2", default=0.0)

    @property
    def matrix(self) -> NDArray[np.float64]:
        """The tensor, shape (3, 3) [kg m^2]."""
        rows = [
            [self.xx, self.xy, self.xz],
            [self.xy, self.yy, self.yz],
            [self.xz, self.yz, self.zz],
        ]
        return np.array(rows)

    def check(self) -> Iterator[Problem]:
        """Refuse what no rigid body has."""
        moments = [float(moment) for moment in np.linalg.eigvalsh(self.matrix)]
        if moments[0] <= 0.0:
            allowed = "principal moments of inertia must be > 0 (positive definite)"
            yield Problem("", moments, allowed)
        elif moments[2] > (moments[0] + moments[1]) * (1.0 + RELATIVE_ROUNDING):
            allowed = "no principal moment may exceed the sum of the other two"
            yield Problem("", moments, allowed)


@dataclass(frozen=True)
class Base(Section):
    """The fixed spherical triangle P1 P2 P3 in {B}."""

    v: tuple[Vector, Vector, Vector] = number(
        "directions of P1, P2, P3 seen from O, any length, right-handed", "1", shape=(3, 3)
    )
    radius: float = number("radius of the base sphere", "m", above=0.0)

    def check(self) -> Iterator[Problem]:
        """Refuse triangles without area and left-handed ones."""
        v = np.array(self.v)
        lengths = np.linalg.norm(v, axis=1)
        if np.any(lengths == 0.0):
            yield Problem("v", self.v, "no direction may be zero")
            return
        volume = float(np.linalg.det(v / lengths[:, None]))
        if abs(volume) < RELATIVE_ROUNDING:
            yield Problem("v", self.v, "P1, P2, P3 must not lie on one great circle (degenerate)")
        elif volume < 0.0:
            allowed = "must be right-handed, v1 . (v2 x v3) > 0: exchange two of the points"
            yield Problem("v", self.v, allowed)


@dataclass(frozen=True)
class Star(Section):
    """The moving spherical star."""

    alpha_deg: Vector = number(
        "angles between the planes of arcs 1-2, 2-3, 3-1", "deg", shape=(3,), above=0.0
    )
    radius: float = number("radius of the star's sphere, distance O E", "m", above=0.0)
    inertia: Inertia = section("inertia of the star in {E}", Inertia)

    def check(self) -> Iterator[Problem]:
        """Refuse arcs that do not close around E."""
        total = sum(self.alpha_deg)
        if abs(total - 360.0) > 360.0 * RELATIVE_ROUNDING:
            yield Problem("alpha_deg", self.alpha_deg, f"must sum to 360 deg; the sum is {total:g}")


@dataclass(frozen=True)
class Link(Section):
    """One rigid link of a leg."""

    inertia: Inertia = section("inertia of the link in its own frame", Inertia)


@dataclass(frozen=True)
class Stroke(Section):
    """The range of the actuators, 0 < gamma_k < arc P_k P_k+1."""

    at_end: str = choice("what happens at an end of the stroke", ("stop", "ignore"), default="stop")


@dataclass(frozen=True)
class Workspace(Section):
    """Where E may be: on the base triangle, 0 < beta_k <= beta_max."""

    beta_max_deg: float = number(
        "largest angle between E and the intermediate link",
        "deg",
        default=90.0,
        above=0.0,
        most=180.0,
    )
    at_edge: str = choice(
        "what happens at the edge of the workspace", ("stop", "ignore"), default="stop"
    )


@dataclass(frozen=True)
class Initial(Section):
    """The state at t = 0."""

    gamma: Vector = number("actuator angles at t = 0", "rad", shape=(3,))
    gamma_dot: Vector = number(
        "actuator rates at t = 0", "rad/s", shape=(3,), default=(0.0, 0.0, 0.0)
    )


@dataclass(frozen=True)
class SineTorque(Section):
    """Torques tau_k(t) = amplitude_k sin(frequency_k t + phase_k)."""

    amplitude: Vector = number("amplitudes", "N m", shape=(3,))
    frequency: Vector = number("angular frequencies", "rad/s", shape=(3,), least=0.0)
    phase: Vector = number("phases", "rad", shape=(3,), default=(0.0, 0.0, 0.0))


@dataclass(frozen=True)
class Scene(Section):
    """All that is simulated."""

    name: str = text("short name")
    description: str = text("what the scene shows")
    base: Base = section("the fixed spherical triangle", Base)
    star: Star = section("the moving spherical star", Star)
    actuated_links: tuple[Link, Link, Link] = sections(
        "actuated links in {1k}; one entry stands for all three", Link, (1, 3)
    )
    intermediate_links: tuple[Link, Link, Link] = sections(
        "intermediate links in {2k}; one entry stands for all three", Link, (1, 3)
    )
    stroke: Stroke = section("range of the actuators", Stroke, default=Stroke())
    workspace: Workspace = section("where E may be", Workspace, default=Workspace())
    initial: Initial = section("state at t = 0", Initial)
    torque: SineTorque | None = section(
        "torques that torque_player plays", SineTorque, default=None
    )
    duration: float | None = number("length of a run", "s", default=None, above=0.0)
    provenance: tuple[tuple[str, str], ...] = notes("where the values come from, by key")

    def check(self) -> Iterator[Problem]:
        """Refuse provenance of keys that the scene does not have."""
        for key, said in self.provenance:
            if not _has(type(self), key.split(".")):
                yield Problem(f"provenance.{key}", said, "is about a key that no scene has")


def load(name_or_path: str | Path) -> Scene:
    """Read a scene by its path (ends in .yaml) or by the name of one that comes with sst_ros.

    Raises:
        InputError: there is no such scene, or its document is refused.

    """
    path = Path(name_or_path)
    if path.suffix not in (".yaml", ".yml"):
        path = share_directory() / "config" / "scenes" / f"{name_or_path}.yaml"
    try:
        source = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError, ValueError) as error:
        allowed = f"must be a readable .yaml file or one of {', '.join(names())} ({error})"
        raise InputError("scene", [Problem("scene", str(name_or_path), allowed)]) from None
    return read(Scene, source, str(path))


def names() -> list[str]:
    """Names of the scenes that come with sst_ros."""
    return sorted(path.stem for path in (share_directory() / "config" / "scenes").glob("*.yaml"))


def share_directory() -> Path:
    """Folder that holds config/ and launch/: the source tree, or share/sst_ros of a prefix.

    Raises:
        InputError: sst_ros was installed without its data files.

    """
    for parent in Path(__file__).resolve().parents:
        for candidate in (parent, parent / "share" / "sst_ros"):
            if (candidate / "config" / "scenes").is_dir():
                return candidate
    raise InputError("installation", [Problem("config/scenes", __file__, "was not installed")])


def _has(cls: type[Section], path: list[str]) -> bool:
    spec = specs(cls).get(path[0])
    if spec is None or len(path) == 1:
        return spec is not None
    return spec.section is not None and _has(spec.section, path[1:])
