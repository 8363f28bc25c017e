# SPDX-License-Identifier: Apache-2.0
"""Unknown constants of a scene by name, and the scene with other values for them.

The names are the keys of a scene, and for a body "star.moment.x": mass times centre [kg m], in
which torques are linear. "actuated_links.mass" means all three alike, "actuated_links[0].mass" one.
"offset[0]" is a constant torque at an actuator, as of a sensor without zero balance [N m].
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from sst_ros.errors import InputError, Problem, suggestion
from sst_ros.mechanism.geometry import Array
from sst_ros.scene.bodies import Link, Star
from sst_ros.scene.loads import Friction
from sst_ros.scene.scene import Scene
from sst_ros.scene.yaml_document import (
    build,
    build_unchecked,
    find_fields,
    replace_values,
    values_of,
)

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
    problems, known = [], _all(scene)
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
    for body in dict.fromkeys(name.partition(".")[0] for name in names):
        if all(f"{body}.{part}" in names for part in STANDARD[4:]):
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
    values = values_of(scene)
    if moments:
        for body in (values["star"], *values["actuated_links"], *values["intermediate_links"]):
            body["centre"] = [body["mass"] * part for part in body["centre"]]
            body["mass"] = 1.0
    # Torques depend on mass times centre alone.
    used = {
        _of_centre(name): symbol
        for name, symbol in symbols.items()
        if not (moments and name.endswith(".mass"))
    }
    return build_unchecked(Scene, replace_values(values, used))


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
    for terms in document.get("friction", {}).values():
        for key in Friction.EFFECTS:
            if terms.get(key, 0.0) < NEGLIGIBLE:
                terms[key] = 0.0
    notes = document.setdefault("provenance", {})
    known = {re.sub(r"\[\d\]", "", name).split(".")[0] for name in found}
    notes |= dict.fromkeys(sorted(known & document.keys()), note)
    return build(Scene, document, scene.name, of_row=True)


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
        first, second, third = getattr(scene, kind)
        bodies = {f"{kind}[0]": first, f"{kind}[1]": second, f"{kind}[2]": third, kind: first}
        for name, body in bodies.items():
            names += _body(name, body, scene)
    for kind in JOINT_KINDS:
        names += (f"friction.{kind}.{part}" for part in ("viscous", "coulomb"))
    names += ("actuators.rotor_inertia", *(f"offset[{k}]" for k in range(3)))
    return list(dict.fromkeys(names))


def _body(name: str, body: Star | Link, scene: Scene) -> Iterator[str]:
    if body.inertia is not None:
        weighty = scene.gravity is not None
        yield from (f"{name}.{part}" for part in (STANDARD if weighty else STANDARD[4:]))


def _value(scene: Scene, name: str) -> float:
    body, _, axis = name.partition(".moment.")
    if axis:
        mass, centre = value_of(scene, f"{body}.mass"), value_of(scene, _of_centre(name))
        return (mass or 0.0) * (centre or 0.0)
    return value_of(scene, name) or 0.0


def _of_centre(name: str) -> str:
    """Return the key of the component of a centre that a moment has."""
    return re.sub(r"moment\.([xyz])$", lambda m: f"centre[{'xyz'.index(m[1])}]", name)


def value_of(scene: Scene, name: str) -> float | None:
    """Return a number of a scene by its key, the first of a list; None where there is none."""
    try:
        _, value, spec = next(find_fields(scene, name, components=True))
    except ValueError:
        return None
    if spec.kind != "number" or value is None:
        return None
    return float(np.ravel(value)[0])
