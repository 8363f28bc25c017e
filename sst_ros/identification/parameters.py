# SPDX-License-Identifier: Apache-2.0
"""Unknown constants of a scene by name, and the scene with other values for them.

The names are the keys of a scene, and for a body "star.moment.x": mass times centre [kg m], in
which torques are linear. "actuated_links.mass" means all three alike, "actuated_links[0].mass" one.
"offset[0]" is a constant torque at an actuator, as of a sensor without zero balance [N m].
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import fields
from types import SimpleNamespace
from typing import Any

import numpy as np

from sst_ros.errors import InputError, Problem, suggestion
from sst_ros.mechanism.geometry import Array
from sst_ros.scene.bodies import Inertia, Link, Star
from sst_ros.scene.loads import Actuators, Friction
from sst_ros.scene.scene import Scene
from sst_ros.scene.schema import Section
from sst_ros.scene.yaml_document import from_values, replace_values, values_of

JOINT_KINDS = ("gamma", "mu", "beta")

INERTIA = ("xx", "yy", "zz", "xy", "xz", "yz")
STANDARD = ("mass", *(f"moment.{axis}" for axis in "xyz"), *(f"inertia.{part}" for part in INERTIA))
"""The ten inertial parameters of a body about O, in the order of a body's columns."""

LINKS = ("actuated_links", "intermediate_links")
NEGLIGIBLE = 1e-12
"""Friction coefficient [N m, N m s/rad] below which a scene has no such friction."""


def select_names(scene: Scene, requested: Iterable[str] | None) -> tuple[str, ...]:
    """Names of parameters: all that the scene has, or those that begin as one of `requested`.

    Args:
        scene: the manipulator.
        requested: names, or the beginnings of names, as in ("star", "friction.gamma", "offset").

    Raises:
        InputError: no parameter begins like that.

    """
    if requested is None:
        return tuple(_own(scene))
    names: dict[str, None] = {}
    problems = []
    known = _all(scene)
    for begin in [requested] if isinstance(requested, str) else requested:
        found = [name for name in known if re.match(re.escape(str(begin)) + r"($|\.|\[)", name)]
        if str(begin) in LINKS:  # the three alike
            found = [name for name in found if "[" not in name]
        if not found:
            allowed = "begins no parameter of the scene" + suggestion(str(begin), known)
            problems.append(Problem("parameters", begin, allowed))
        names |= dict.fromkeys(found)
    for kind in LINKS:
        both = {name.removeprefix(kind)[:1] for name in names if name.startswith(kind)}
        if len(both) > 1:
            allowed = f"name {kind} alike, or {kind}[0] to {kind}[2], not both"
            problems.append(Problem("parameters", kind, allowed))
    if problems:
        raise InputError("identify", problems)
    return tuple(names)


def bodies_of(names: Sequence[str]) -> Iterator[str]:
    """Yield the bodies, as "star" or "actuated_links[0]", whose whole inertia is in `names`."""
    for body in dict.fromkeys(re.split(r"\.", name)[0] for name in names):
        if f"{body}.inertia.xx" in names and all(
            f"{body}.{part}" in names for part in STANDARD[4:]
        ):
            yield body


def values(scene: Scene, names: Sequence[str]) -> Array:
    """Values of parameters in a scene, zero for what it does not have, shape (len(names),)."""
    return np.array([_value(scene, name) for name in names])


def with_symbols(scene: Scene, symbols: Mapping[str, Any], *, moments: bool = False) -> Any:
    """Return an object like the scene with other values, of any kind, which are not checked.

    Args:
        scene: the manipulator.
        symbols: values by name; a list without index means all of its entries.
        moments: bodies have mass 1, so that "centre" is mass times centre.

    """
    result = open_section(scene)
    if moments:
        for body in (result.star, *result.actuated_links, *result.intermediate_links):
            body.centre = [body.mass * part for part in body.centre]
            body.mass = 1.0
    for name, symbol in symbols.items():
        if moments and name.endswith(".mass"):
            continue  # torques depend on mass times centre alone
        name = re.sub(r"moment\.([xyz])$", lambda m: f"centre[{'xyz'.index(m[1])}]", name)
        set_number(result, re.findall(r"\w+", name), symbol)
    return result


def with_parameters(scene: Scene, names: Sequence[str], numbers: Array, note: str) -> Scene:
    """Return the scene with identified values; `note` is their provenance.

    Raises:
        InputError: the values make no scene.

    """
    found = dict(zip(names, (float(number) for number in numbers), strict=True))
    changed: dict[str, Any] = {}
    for name, number in found.items():
        body, _, part = name.partition(".")
        if part.startswith("moment."):
            mass = found.get(f"{body}.mass", _value(scene, f"{body}.mass"))
            centre = [found.get(f"{body}.moment.{axis}", 0.0) for axis in "xyz"]
            changed[f"{body}.centre"] = [h / mass for h in centre] if mass else [0.0] * 3
        elif not name.startswith("offset"):
            changed[name] = number
    document = replace_values(values_of(scene), changed)
    _drop_friction(document)
    notes = document.setdefault("provenance", {})
    known = {re.sub(r"\[\d\]", "", name).split(".")[0] for name in found}
    notes |= dict.fromkeys(sorted(known & document.keys()), note)
    return from_values(Scene, document, scene.name)


def _drop_friction(document: dict[str, Any]) -> None:
    """Take away friction without a coefficient, and smoothing that acts on nothing."""
    friction = document.get("friction", {})
    for kind in list(friction):
        terms = friction[kind]
        for key in ("viscous", "coulomb", "static"):
            if terms.get(key, 0.0) < NEGLIGIBLE:
                terms.pop(key, None)
        if not (terms.get("coulomb") or terms.get("static")):
            terms.pop("smoothing", None)
        if not terms.get("static"):
            terms.pop("stribeck", None)
        if not terms:
            del friction[kind]
    if not friction:
        document.pop("friction", None)


def _own(scene: Scene) -> Iterator[str]:
    """Names of what the scene has; links that are equal are taken as alike."""
    yield from _body("star", scene.star, scene)
    for kind in LINKS:
        links = getattr(scene, kind)
        if links[0] == links[1] == links[2]:
            yield from _body(kind, links[0], scene)
        else:
            for k in range(3):
                yield from _body(f"{kind}[{k}]", links[k], scene)
    for kind in JOINT_KINDS:
        terms = getattr(scene.friction, kind, None)
        present = (part for part in ("viscous", "coulomb", "static") if getattr(terms, part, 0.0))
        yield from (f"friction.{kind}.{part}" for part in present)
    yield from (f"springs[{i}].stiffness" for i in range(len(scene.springs)))
    if scene.actuators is not None and scene.actuators.rotor_inertia:
        yield "actuators.rotor_inertia"


def _all(scene: Scene) -> list[str]:
    """Names that may be asked for: also separate links, friction not yet known, offsets."""
    names = list(_own(scene))
    for kind in LINKS:
        links = getattr(scene, kind)
        for k in range(3):
            names += _body(f"{kind}[{k}]", links[k], scene)
        names += _body(kind, links[0], scene)
    for kind in JOINT_KINDS:
        names += (f"friction.{kind}.{part}" for part in ("viscous", "coulomb"))
    names += ("actuators.rotor_inertia", *(f"offset[{k}]" for k in range(3)))
    return list(dict.fromkeys(names))


def _body(name: str, body: Star | Link, scene: Scene) -> Iterator[str]:
    if body.inertia is not None:
        weighty = scene.gravity is not None
        yield from (f"{name}.{part}" for part in (STANDARD if weighty else STANDARD[4:]))


def _value(scene: Scene, name: str) -> float:
    words = re.findall(r"\w+", name)
    if words[0] == "offset":
        return 0.0
    if words[-2:-1] == ["moment"] and words[0] != "moment":
        value = at(scene, words[:-2])
        return float(value.mass * value.centre["xyz".index(words[-1])])
    value = at(scene, words)
    return 0.0 if value is None else float(value)


def value_of(scene: Scene, name: str) -> float | None:
    """Return a number of a scene by its key, the first of a list; None where there is none."""
    try:
        value = at(scene, re.findall(r"\w+", name))
    except (AttributeError, IndexError, TypeError):
        return None
    return float(value) if isinstance(value, (int, float)) else None


def at(value: Any, words: Sequence[str]) -> Any:
    """Return what a key, split in words, names; of a list without index the first entry."""
    for word in words:
        if value is None:
            return None
        if isinstance(value, (tuple, list)):
            if not word.isdigit():
                value = getattr(value[0], word)
                continue
            value = value[int(word)]
        else:
            value = getattr(value, word)
    return value[0] if isinstance(value, (tuple, list)) else value


def open_section(value: Any) -> Any:
    """Return a section as an object whose fields may be set to anything, tuples as lists."""
    if isinstance(value, Section):
        return SimpleNamespace(
            **{f.name: open_section(getattr(value, f.name)) for f in fields(value)}
        )
    return [open_section(entry) for entry in value] if isinstance(value, tuple) else value


def set_number(value: Any, words: Sequence[str], symbol: Any) -> None:
    """Set a number of an `open_section`; a list without an index means all of its entries."""
    first, *rest = words
    if isinstance(value, list):
        if not first.isdigit():
            for entry in value:
                set_number(entry, words, symbol)
        elif rest:
            set_number(value[int(first)], rest, symbol)
        else:
            value[int(first)] = symbol
        return
    known = vars(value)
    if rest:
        if known.get(first) is None:
            known[first] = _make_absent(first)
        set_number(known[first], rest, symbol)
    else:
        entries = known.get(first)
        known[first] = [symbol] * len(entries) if isinstance(entries, list) else symbol


def _make_absent(name: str) -> SimpleNamespace:
    """Return an empty section for a term that the scene does not have."""
    if name == "friction":
        return SimpleNamespace(gamma=None, mu=None, beta=None)
    if name == "inertia":
        return SimpleNamespace(**dict.fromkeys((f.name for f in fields(Inertia)), 0.0))
    section: type[Section] = Actuators if name == "actuators" else Friction
    return SimpleNamespace(**{f.name: f.default for f in fields(section)})
