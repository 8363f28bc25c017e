# SPDX-License-Identifier: Apache-2.0
"""What is simulated, as one document: bodies, terms, start, and provenance.

Provenance is where each value is from. `Scenarios` are many of it, whose numbers
differ: a row of each array makes a scene, which meets all requirements of a document.
What has no effect in a row is left out of it, as documents demand: a friction whose
coefficients are zero there, the gear of a rotor without inertia.
"""

from __future__ import annotations

import pickle
from collections.abc import Mapping
from dataclasses import replace
from functools import cache, lru_cache
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sst_ros.errors import InputError, Problem, check_kinds, refusal, suggestion
from sst_ros.scene import loads, schema, yaml_document
from sst_ros.scene.bodies import Base, Link, Payload, Star, Stroke, Workspace
from sst_ros.scene.own_loads import FormulaLoad
from sst_ros.scene.schema import Place, Section, Spec, amount, entry, key_of
from sst_ros.scene.torque_profile import SineTorque
from sst_ros.scene.yaml_document import (
    find_fields,
    plain,
    read,
    replace_values,
    values_at,
)
from sst_ros.state import Array, Explained, LostMeaning, freeze, real_numbers

LARGEST_NUMBER = 1e9
"""No number of a scene is larger.

A larger one is a slip of units, and its powers leave double precision.
"""


MOST_FAULTS = 10
"""Problems of scenarios in one message, and rows that are examined for it."""

LINKS = ("actuated_links", "intermediate_links")


class Scene(Explained, Section):
    """All that is simulated."""

    name: str = entry("short name")
    description: str = entry("what the scene shows")
    base: Base = entry("the fixed spherical triangle")
    star: Star = entry("the moving spherical star")
    actuated_links: tuple[Link, Link, Link] = entry(
        "actuated links in {1k}; one entry stands for all three"
    )
    intermediate_links: tuple[Link, Link, Link] = entry(
        "intermediate links in {2k}; one entry stands for all three"
    )
    payload: Payload | None = entry("body carried by the star")
    gravity: loads.Gravity | None = entry("gravity")
    moment: loads.Moment | None = entry("external moment on the star")
    friction: loads.JointFriction | None = entry("friction in the joints")
    springs: tuple[loads.Spring, ...] = entry("springs at joints", default=())
    own_loads: tuple[FormulaLoad, ...] = entry(
        "loads of your own, by formulas", default=()
    )
    actuators: loads.Actuators | None = entry("the actuators")
    stroke: Stroke = entry("range of the actuators", default=Stroke())
    workspace: Workspace = entry("where E may be", default=Workspace())
    initial: loads.Initial = entry("state at t = 0")
    torque: SineTorque | None = entry("torques that torque_player plays")
    motion: loads.DesiredMotion | None = entry("desired motion")
    duration: float | None = amount("length of a run", "s")
    provenance: tuple[tuple[str, str], ...] = entry(
        "where the values come from, by key", default=()
    )

    @check_kinds
    def with_values(self, values: Mapping[str, Any]) -> Scene:
        """Return the scene with other values by key, as in {"star.inertia.zz": 0.3}.

        A list without an index means all of its entries: "actuated_links.inertia.xx",
        "springs[0].rest". A section that the scene does not have is made from the
        values given; None takes one away. InputError is raised where a key names
        nothing that a scene has, or the result is refused.
        """
        problems = []
        for key, value in values.items():
            try:
                plain(value)
            except LostMeaning as error:
                problems.append(Problem(key, value, str(error)))
            except RecursionError:
                problems.append(Problem(key, value, "must not hold itself"))
        if problems:
            raise InputError(self.name, problems)
        try:
            changed = replace_values(self, plain(values))
        except RecursionError:
            raise InputError(
                self.name, [Problem("", values, "must not hold itself")]
            ) from None
        except KeyError as error:
            key = error.args[0]
            requirement = "names nothing in this scene"
            raise refusal(self.name, str(key), values[key], requirement) from None
        scene = schema.build(Scene, changed, self.name)
        schema.keep_texts(self, scene)
        return scene

    @property
    def torque_limit(self) -> float | None:
        """Largest torque of an actuator [N m]; None without one."""
        return None if self.actuators is None else self.actuators.torque_limit

    @property
    def lags(self) -> bool:
        """Whether the torques of the actuators lag behind what is commanded."""
        return self.actuators is not None and self.actuators.time_constant is not None

    def _facts(self) -> dict[str, object]:
        present = terms(self)
        absent = [term for term in SCENE_TERMS if term not in present]
        return {
            "name": self.name,
            "description": self.description,
            "has": present or "nothing but the star",
            "has not": absent or "all terms are there",
            "gamma(0) [rad]": self.initial.gamma,
            "gamma_dot(0) [rad/s]": self.initial.gamma_dot,
            "torque": "sines" if self.torque else "none of its own",
            "motion": self.motion.kind if self.motion else "none of its own",
            "duration [s]": self.duration or "open",
        }

    def rules(self) -> schema.Rules:
        """Refuse slips of units, and values that do not fit the bodies.

        Refused are centres of mass far from the bodies, gravity without a mass, and
        provenance of what no scene has.
        """
        most = f"must not exceed {LARGEST_NUMBER:g} in size: use m, kg, s, rad, N"
        for place, value in schema.leaves(self).items():
            yield abs(value) > LARGEST_NUMBER, key_of(place), value, most
        bodies = {"star": self.star}
        for name in LINKS:
            for k, link in enumerate(getattr(self, name)):
                bodies[f"{name}[{k}]"] = link
        reach = np.maximum(self.base.radius, self.star.radius)
        mass: Any = 0.0 if self.payload is None else self.payload.mass
        for name, body in bodies.items():
            mass = mass + body.mass
            x, y, z = body.centre
            far = np.sqrt(x * x + y * y + z * z) > reach
            yield far, f"{name}.centre", body.centre, f"must lie within {reach} m of O"
        if self.gravity is not None:
            idle = "acts on nothing: no body has a mass"
            yield np.equal(mass, 0.0), "gravity", self.gravity.acceleration, idle
        for key, note in self.provenance:
            strange = not _has_key(Scene, key)
            yield strange, f"provenance.{key}", note, "is about a key that no scene has"


SCENE_TERMS = {
    "actuated links": f"{LINKS[0]}.inertia",
    "intermediate links": f"{LINKS[1]}.inertia",
    "payload": "payload",
    "gravity": "gravity",
    "external moment": "moment",
    "friction in gamma": "friction.gamma",
    "friction in mu": "friction.mu",
    "friction in beta": "friction.beta",
    "springs": "springs",
    "own loads": "own_loads",
    "rotors": "actuators.rotor_inertia",
    "torque limit": "actuators.torque_limit",
    "actuator lag": "actuators.time_constant",
    "elastic stops": "stroke.stiffness",
}
"""Key of each term in a scene."""


def terms(scene: Scene) -> list[str]:
    """Return those of SCENE_TERMS that a scene has."""
    present = []
    for term, key in SCENE_TERMS.items():
        if schema.has_effect(values_at(scene, key)):
            present.append(term)
    return present


def _has_key(cls: type[Section], key: str) -> bool:
    """Return whether documents of a class may have a key without indices."""
    name, _, inner_key = key.partition(".")
    spec = cls.SPECS.get(name)
    if spec is None:
        return False
    if not inner_key:
        return True
    return spec.section is not None and _has_key(spec.section, inner_key)


SceneInput: TypeAlias = Scene | Mapping[str, Any] | str | Path
"""What `scene_of` takes wherever a scene is asked for."""


def scene_of(scene: SceneInput) -> Scene:
    """Return a scene by its path or by its name.

    A path ends in .yaml; a name is of a scene that comes with sst_ros. It may also be
    its document as a dict, or a `Scene`, which is returned as it is. InputError is
    raised where there is no such scene, or its document is refused.
    """
    if isinstance(scene, Scene):
        return scene
    if isinstance(scene, Mapping):
        return schema.build(Scene, scene, "scene")
    if isinstance(scene, (str, Path)):
        return load(scene)
    requirement = "must be a Scene, the name or path of one, or its document as a dict"
    raise refusal("scene", "scene", scene, requirement)


def with_initial(scene: Scene, initial: Any) -> Scene:
    """Return the scene with another initial state.

    It is (gamma, gamma_dot), a mapping or `Initial`. Raises InputError where it is none
    of these, or its numbers are refused.
    """
    if initial is None:
        return scene
    if isinstance(initial, Mapping):
        # None stands for a key that is left out, as in `Initial`.
        initial = {key: value for key, value in initial.items() if value is not None}
    elif not isinstance(initial, loads.Initial):
        try:
            gamma, gamma_dot = initial
        except (TypeError, ValueError):
            requirement = "must be (gamma, gamma_dot), a mapping or Initial"
            raise refusal("initial", "initial", initial, requirement) from None
        initial = {"gamma": gamma, "gamma_dot": gamma_dot}
    return replace(scene, initial=initial)


def load(name_or_path: str | Path) -> Scene:
    """Read a scene by its path or name; see `scene_of`.

    The file is read in each call. A text that was read before is not parsed again.
    """
    scene: Scene = pickle.loads(_parse(*text_of(name_or_path)))
    return scene


@lru_cache(maxsize=64)
def _parse(text: str, origin: str) -> bytes:
    """Return the scene of a text, pickled.

    So each call of `load` has one of its own.
    """
    return pickle.dumps(read(Scene, text, origin), pickle.HIGHEST_PROTOCOL)


def text_of(name_or_path: str | Path) -> tuple[str, str]:
    """Return the YAML text of a scene, and the path that it is from.

    The scene is found as by `load`.
    """
    path = Path(name_or_path)
    is_name = path.suffix not in (".yaml", ".yml")
    if is_name:
        path = share_directory() / "config" / "scenes" / f"{name_or_path}.yaml"
    try:
        return yaml_document.read_file(path), str(path)
    except (OSError, UnicodeDecodeError, ValueError) as error:
        requirement = f"must be a readable .yaml file or one of {', '.join(names())}"
        if is_name:
            requirement += suggestion(str(name_or_path), names())
        else:
            # `strerror` is the reason without the path, which the message has already.
            requirement += f" ({getattr(error, 'strerror', None) or error})"
        raise refusal("scene", "scene", str(name_or_path), requirement) from None


def names() -> list[str]:
    """Names of the scenes that come with sst_ros."""
    return sorted(
        path.stem for path in (share_directory() / "config" / "scenes").glob("*.yaml")
    )


@cache  # each scene by name asks, and the installation stays where it is
def share_directory() -> Path:
    """Return the folder that holds config/ and launch/.

    It is the source tree, or share/sst_ros of a prefix.
    """
    for parent in Path(__file__).resolve().parents:
        for candidate in (parent, parent / "share" / "sst_ros"):
            if (candidate / "config" / "scenes").is_dir():
                return candidate
    raise refusal("installation", "config/scenes", __file__, "was not installed")


class Scenarios:
    """Scenarios of a scene by row.

    `parameters` are arrays by keys of numbers in the document, as in "star.mass",
    "springs[0].rest" or "gravity.acceleration": first the row, then what one scene has,
    so shape (N,), (N, 3) or (N, 3, 3). A list without an index means all of its
    entries. `rows` has these arrays; the `count` N is None where nothing varies.
    InputError is raised where a key names no number of the scene, or an array has
    another shape.
    """

    def __init__(self, scene: Scene, parameters: Mapping[str, ArrayLike]) -> None:
        self.document = scene
        self.count: int | None = None
        self.rows: dict[str, Array] = {}
        self._specs: dict[str, Spec] = {}
        self._places: dict[Place, str] = {}
        problems = []
        for key, value in parameters.items():
            try:
                for place, _, spec in find_fields(scene, key):
                    if spec.kind != "number":
                        raise ValueError(yaml_document.NO_NUMBER)
                    if place in self._places:
                        raise ValueError("is given twice")
                    self._places[place] = key
                    self._specs[key] = spec
                self.rows[key] = self._rows_of(value, spec.shape)
                self.count = len(self.rows[key])
            except (TypeError, ValueError, OverflowError, MemoryError) as error:
                problems.append(Problem(key, value, str(error)))
        if problems:
            raise InputError(scene.name, problems)

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle what was given."""
        return Scenarios, (self.document, self.rows)

    def _rows_of(self, value: ArrayLike, shape: tuple[int, ...]) -> Array:
        """Return the values of one key, a row a scenario, each of a shape."""
        rows = freeze(real_numbers(value))
        count = self.count or max(1, len(np.atleast_1d(rows)))
        if rows.shape == (count, *shape):
            return rows
        sizes = ", ".join(map(str, (self.count or "N", *shape)))
        if not shape:
            sizes += ","
        requirement = f"must have the shape ({sizes}), a row a scenario"
        raise ValueError(f"{requirement}; it has {rows.shape}")

    def scene(self, row: int) -> Scene:
        """Build the scene of a row; InputError names the numbers that make none."""
        numbers = {key: rows[row].tolist() for key, rows in self.rows.items()}
        problems = []
        for key, spec in self._specs.items():
            in_bounds = np.all(spec.allows(self.rows[key][row]))
            if schema.has_effect(numbers[key]) and not in_bounds:
                problems.append(Problem(key, numbers[key], spec.refuse()))
        try:
            if problems:  # though the section that they are in may be left out
                raise InputError("", problems)
            values = {place: numbers[key] for place, key in self._places.items()}
            document = plain(schema.rebuild(self.document, values))
            return schema.build(Scene, schema.drop_idle(Scene, document))
        except InputError as error:
            problems = [
                replace(problem, key=f"scenario {row}: {problem.key}")
                for problem in error.problems
            ]
            raise InputError(self.document.name, problems) from None

    def columns(self) -> Any:
        """Return the scene, unchecked; numbers that vary are columns, shape (N,)."""
        columns = {
            place: _columns(self.rows[key]) for place, key in self._places.items()
        }
        return schema.rebuild(self.document, columns)

    def faults(self, most: int = MOST_FAULTS) -> dict[int, InputError]:
        """Return the rows that make no scene, `most` at most, and why each does not."""
        faults: dict[int, InputError] = {}
        for row in np.flatnonzero(self._doubtful()).tolist():
            try:
                self.scene(row)
            except InputError as error:
                faults[row] = error
            if len(faults) == most:
                break
        return faults

    def _doubtful(self) -> NDArray[np.bool_]:
        """Return the rows whose scene may be refused.

        A zero may refuse a number, or leave its section out.
        """
        doubtful: Any = np.zeros(self.count or 0, dtype=bool)
        for key, spec in self._specs.items():
            in_bounds = spec.allows(self.rows[key])
            doubtful = doubtful | ~in_bounds.reshape(len(in_bounds), -1).all(axis=1)
        with np.errstate(all="ignore"):
            for _, section in schema.walk(self.columns()):
                if not isinstance(section, Section):
                    continue
                for broken, *_ in section.rules():
                    doubtful = doubtful | broken
        return np.asarray(doubtful)

    def check(self) -> None:
        """Raise InputError with the first problems if rows make no scene."""
        problems: list[Problem] = []
        for error in self.faults().values():
            problems += error.problems
        if problems:
            raise InputError(self.document.name, problems[:MOST_FAULTS])


def _columns(values: Array) -> Any:
    """Return contiguous columns (N,) of an array (N, ...).

    They are nested tuples where the array has more dimensions.
    """
    if values.ndim == 1:
        return np.ascontiguousarray(values)
    return tuple(map(_columns, np.moveaxis(values, 1, 0)))
