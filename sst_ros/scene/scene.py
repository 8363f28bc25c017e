# SPDX-License-Identifier: Apache-2.0
"""What is simulated, as one document: bodies, terms, the start, and where each value is from."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sst_ros.errors import InputError, Problem, suggestion
from sst_ros.scene.bodies import Base, Inertia, Link, Payload, Star
from sst_ros.scene.loads import (
    Actuators,
    Friction,
    Gravity,
    Initial,
    JointFriction,
    Moment,
    SineTorque,
    Spring,
    Stroke,
    Workspace,
)
from sst_ros.scene.motions import DesiredMotion
from sst_ros.scene.schema import Section, Spec, notes, number, section, sections, specs, text
from sst_ros.scene.yaml_document import from_values, plain, read, replace_values, values_of

Matrix = NDArray[np.float64]

LARGEST, SMALLEST = 1e9, 1e-12
"""No number of a scene is larger, none that must be positive smaller: it is a slip of units, and
its powers leave the range of double precision."""

__all__ = [
    "Actuators",
    "Base",
    "DesiredMotion",
    "Friction",
    "Gravity",
    "Inertia",
    "Initial",
    "JointFriction",
    "Link",
    "Moment",
    "Payload",
    "Scene",
    "SineTorque",
    "Spring",
    "Star",
    "Stroke",
    "Workspace",
    "load",
    "names",
    "share_directory",
    "text_of",
]


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
    payload: Payload | None = section("body carried by the star", Payload, default=None)
    gravity: Gravity | None = section("gravity", Gravity, default=None)
    moment: Moment | None = section("external moment on the star", Moment, default=None)
    friction: JointFriction | None = section("friction in the joints", JointFriction, default=None)
    springs: tuple[Spring, ...] = sections("springs at joints", Spring, (), default=())
    actuators: Actuators | None = section("the actuators", Actuators, default=None)
    stroke: Stroke = section("range of the actuators", Stroke, default=Stroke())
    workspace: Workspace = section("where E may be", Workspace, default=Workspace())
    initial: Initial = section("state at t = 0", Initial)
    torque: SineTorque | None = section(
        "torques that torque_player plays", SineTorque, default=None
    )
    motion: DesiredMotion | None = section("desired motion", DesiredMotion, default=None)
    duration: float | None = number("length of a run", "s", default=None, above=0.0)
    provenance: tuple[tuple[str, str], ...] = notes("where the values come from, by key")

    def with_values(self, values: Mapping[str, Any]) -> Scene:
        """Return the scene with other values by key, as in {"star.inertia.zz": 0.3}.

        A list without an index means all of its entries: "actuated_links.inertia.xx",
        "springs[0].rest". A section that the scene does not have is made from the values given;
        None takes one away.

        Raises:
            InputError: a key names nothing that a scene has, or the result is refused.

        """
        try:
            changed = replace_values(values_of(self), values)
        except KeyError as error:
            key = error.args[0]
            problem = Problem(str(key), values[key], "names nothing in this scene")
            raise InputError(self.name, [problem]) from None
        return from_values(Scene, changed, self.name)

    @property
    def star_inertia(self) -> Matrix:
        """Inertia of the star and its payload about O in {E}, shape (3, 3) [kg m^2]."""
        own = self.star.inertia.matrix
        return own if self.payload is None else own + self.payload.about_o

    @property
    def actuated_inertias(self) -> Matrix:
        """Inertias of actuated links and rotors in {1k}, shape (3, 3, 3) [kg m^2]."""
        inertias = np.stack([_matrix(link) for link in self.actuated_links])
        if self.actuators is not None:
            inertias[:, 2, 2] += self.actuators.gear_ratio**2 * self.actuators.rotor_inertia
        return inertias

    @property
    def intermediate_inertias(self) -> Matrix:
        """Inertias of the intermediate links in {2k}, shape (3, 3, 3) [kg m^2]."""
        return np.stack([_matrix(link) for link in self.intermediate_links])

    def check(self) -> Iterator[Problem]:
        """Refuse what contradicts itself across sections, and numbers of another unit."""
        for key, value, spec in _numbers(self, ""):
            if abs(value) > LARGEST:
                allowed = f"must not exceed {LARGEST:g} in size: use m, kg, s, rad, N"
                yield Problem(key, value, allowed)
            elif spec.above == 0.0 and value < SMALLEST:
                allowed = f"must be at least {SMALLEST:g}: use m, kg, s, rad, N"
                yield Problem(key, value, allowed)
        reach = max(self.base.radius, self.star.radius)
        for key, body in self._bodies():
            if np.linalg.norm(body.centre) > reach:
                yield Problem(f"{key}.centre", body.centre, f"must lie within {reach:g} m of O")
        heavy = self.payload or any(body.mass for _, body in self._bodies())
        if self.gravity and not heavy:
            allowed = "acts on nothing: no body has a mass"
            yield Problem("gravity", self.gravity.acceleration, allowed)
        for key, note in self.provenance:
            if not _has(type(self), key.split(".")):
                yield Problem(f"provenance.{key}", note, "is about a key that no scene has")

    def _bodies(self) -> Iterator[tuple[str, Link]]:
        yield "star", self.star
        for key in ("actuated_links", "intermediate_links"):
            for k, link in enumerate(getattr(self, key)):
                yield f"{key}[{k}]", link


def scene_of(scene: Scene | Mapping[str, Any] | str | Path) -> Scene:
    """Return a scene as it is, by its name or path, or built from its document as a dict.

    Raises:
        InputError: there is no such scene, or its document is refused.

    """
    if isinstance(scene, Scene):
        return scene
    if isinstance(scene, Mapping):
        return from_values(Scene, scene, "scene")
    if isinstance(scene, (str, Path)):
        return load(scene)
    allowed = "must be a Scene, the name or path of one, or its document as a dict"
    raise InputError("scene", [Problem("scene", scene, allowed)])


def with_initial(scene: Scene, initial: Any) -> Scene:
    """Return the scene with another initial state: (gamma, gamma_dot), a mapping or `Initial`.

    Raises:
        InputError: it is none of these, or its numbers are refused.

    """
    if initial is None:
        return scene
    if isinstance(initial, Initial):
        return replace(scene, initial=initial)
    names = ("gamma", "gamma_dot", "orientation")
    if isinstance(initial, Mapping):
        unknown = [name for name in initial if name not in names]
        if unknown or "gamma" not in initial:
            allowed = "must have the key gamma, and may have gamma_dot and orientation"
            raise InputError("initial", [Problem("initial", list(initial), allowed)])
        given = dict(initial)
    else:
        try:
            gamma, gamma_dot = initial
        except (TypeError, ValueError):
            allowed = "must be (gamma, gamma_dot), a mapping or Initial"
            raise InputError("initial", [Problem("initial", initial, allowed)]) from None
        given = {"gamma": gamma, "gamma_dot": gamma_dot}
    return replace(scene, initial=Initial(**{name: plain(given[name]) for name in given}))


def load(name_or_path: str | Path) -> Scene:
    """Read a scene by its path (ends in .yaml) or by the name of one that comes with sst_ros.

    Raises:
        InputError: there is no such scene, or its document is refused.

    """
    source, origin = text_of(name_or_path)
    return read(Scene, source, origin)


def text_of(name_or_path: str | Path) -> tuple[str, str]:
    """Return the YAML text of a scene, found as by `load`, and the path that it is from.

    Raises:
        InputError: there is no such file, or it is no text.

    """
    path = Path(name_or_path)
    if path.suffix not in (".yaml", ".yml"):
        path = share_directory() / "config" / "scenes" / f"{name_or_path}.yaml"
    try:
        return path.read_text(encoding="utf-8"), str(path)
    except (OSError, UnicodeDecodeError, ValueError) as error:
        allowed = f"must be a readable .yaml file or one of {', '.join(names())} ({error})"
        allowed += suggestion(str(name_or_path), names())
        raise InputError("scene", [Problem("scene", str(name_or_path), allowed)]) from None


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


def _matrix(link: Link) -> Matrix:
    return np.zeros((3, 3)) if link.inertia is None else link.inertia.matrix


def _numbers(
    value: object, key: str, spec: Spec | None = None
) -> Iterator[tuple[str, float, Spec]]:
    """Yield every number of a section with its key and its specification."""
    if isinstance(value, Section):
        for name, inner in specs(type(value)).items():
            yield from _numbers(getattr(value, name), f"{key}.{name}" if key else name, inner)
    elif isinstance(value, tuple):
        for index, entry in enumerate(value):
            where = f"{key}[{index}]" if isinstance(entry, Section) else key
            yield from _numbers(entry, where, spec)
    elif isinstance(value, float) and spec is not None:
        yield key, value, spec


def _has(cls: type[Section], path: list[str]) -> bool:
    spec = specs(cls).get(path[0])
    if spec is None or len(path) == 1:
        return spec is not None
    return spec.section is not None and _has(spec.section, path[1:])
