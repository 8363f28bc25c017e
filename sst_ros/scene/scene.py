# SPDX-License-Identifier: Apache-2.0
"""What is simulated, as one document: bodies, terms, the start, and where each value is from."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sst_ros.errors import InputError, Problem, suggestion
from sst_ros.scene.bodies import Base, Link, Payload, Star
from sst_ros.scene.loads import (
    Actuators,
    DesiredMotion,
    Gravity,
    Initial,
    JointFriction,
    Moment,
    SineTorque,
    Spring,
    Stroke,
    Workspace,
)
from sst_ros.scene.schema import (
    Rules,
    Section,
    has_key,
    notes,
    number,
    numbers_of,
    section,
    sections,
    text,
)
from sst_ros.scene.yaml_document import build, plain, read, replace_values, values_of

Matrix = NDArray[np.float64]

LARGEST, SMALLEST = 1e9, 1e-12
"""No number of a scene is larger, none that must be positive smaller: it is a slip of units, and
its powers leave the range of double precision."""

_BODIES = (
    ("star", None),
    *((name, k) for name in ("actuated_links", "intermediate_links") for k in range(3)),
)


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
            changed = replace_values(values_of(self), plain(values))
        except KeyError as error:
            key = error.args[0]
            problem = Problem(str(key), values[key], "names nothing in this scene")
            raise InputError(self.name, [problem]) from None
        return build(Scene, changed, self.name)

    @property
    def torque_limit(self) -> float | None:
        """Largest torque of an actuator [N m]; None without one."""
        return None if self.actuators is None else self.actuators.torque_limit

    @property
    def lags(self) -> bool:
        """Whether the torques of the actuators lag behind what is commanded."""
        return self.actuators is not None and self.actuators.time_constant is not None

    @property
    def star_inertia(self) -> Matrix:
        """Inertia of the star and its payload about O in {E}, shape (3, 3) [kg m^2]."""
        own = self.star.inertia.matrix
        return own if self.payload is None else own + self.payload.about_o

    @property
    def actuated_inertias(self) -> Matrix:
        """Inertias of actuated links and rotors in {1k}, shape (3, 3, 3) [kg m^2]."""
        inertias = np.stack([link.tensor for link in self.actuated_links])
        if self.actuators is not None:
            inertias[:, 2, 2] += self.actuators.gear_ratio**2 * self.actuators.rotor_inertia
        return inertias

    @property
    def intermediate_inertias(self) -> Matrix:
        """Inertias of the intermediate links in {2k}, shape (3, 3, 3) [kg m^2]."""
        return np.stack([link.tensor for link in self.intermediate_links])

    def check(self) -> Iterator[Problem]:
        """Refuse what contradicts itself across sections, and numbers of another unit."""
        for key, value, spec in numbers_of(self):
            if abs(value) > LARGEST:
                allowed = f"must not exceed {LARGEST:g} in size: use m, kg, s, rad, N"
                yield Problem(key, value, allowed)
            elif spec.above == 0.0 and value < SMALLEST:
                allowed = f"must be at least {SMALLEST:g}: use m, kg, s, rad, N"
                yield Problem(key, value, allowed)
        yield from super().check()
        for key, note in self.provenance:
            if not has_key(type(self), key):
                yield Problem(f"provenance.{key}", note, "is about a key that no scene has")

    def rules(self) -> Rules:
        """Refuse a centre of mass far from the bodies, and gravity without a mass."""
        reach = np.maximum(self.base.radius, self.star.radius)
        mass: Any = 0.0 if self.payload is None else self.payload.mass
        for name, k in _BODIES:
            body: Link = self.star if k is None else getattr(self, name)[k]
            mass = mass + body.mass
            x, y, z = body.centre
            key = f"{name}.centre" if k is None else f"{name}[{k}].centre"
            yield np.sqrt(x * x + y * y + z * z) > reach, partial(_far, key, body.centre, reach)
        if self.gravity is not None:
            allowed = "acts on nothing: no body has a mass"
            yield (
                np.equal(mass, 0.0),
                partial(Problem, "gravity", self.gravity.acceleration, allowed),
            )


def _far(key: str, centre: object, reach: float) -> Problem:
    return Problem(key, centre, f"must lie within {reach:g} m of O")


def scene_of(scene: Scene | Mapping[str, Any] | str | Path) -> Scene:
    """Return a scene as it is, by its name or path, or built from its document as a dict.

    Raises:
        InputError: there is no such scene, or its document is refused.

    """
    if isinstance(scene, Scene):
        return scene
    if isinstance(scene, Mapping):
        return build(Scene, scene, "scene")
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
    if not isinstance(initial, Mapping):
        try:
            gamma, gamma_dot = initial
        except (TypeError, ValueError):
            allowed = "must be (gamma, gamma_dot), a mapping or Initial"
            raise InputError("initial", [Problem("initial", initial, allowed)]) from None
        initial = {"gamma": gamma, "gamma_dot": gamma_dot}
    elif "gamma" not in initial or initial.keys() - {"gamma", "gamma_dot", "orientation"}:
        allowed = "must have the key gamma, and may have gamma_dot and orientation"
        raise InputError("initial", [Problem("initial", list(initial), allowed)])
    return replace(scene, initial=Initial(**{name: plain(x) for name, x in initial.items()}))


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
