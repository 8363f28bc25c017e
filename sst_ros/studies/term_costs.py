# SPDX-License-Identifier: Apache-2.0
"""What each term of a scene costs: operations of the right-hand side with it and without it."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from sst_ros.dynamics.traced_dynamics import Dynamics
from sst_ros.errors import InputError
from sst_ros.scene.bodies import Link
from sst_ros.scene.loads import Stroke
from sst_ros.scene.scene import Scene


@dataclass(frozen=True)
class Term:
    """Something that a scene may have.

    Attributes:
        name: its name in the summary.
        value: what the scene has of it, falsy for nothing.
        without: the scene without it.

    """

    name: str
    value: Callable[[Scene], Any]
    without: Callable[[Scene], Scene]


def _drop(key: str, *parts: str) -> Callable[[Scene], Scene]:
    """Leave out a section, or some fields of it."""

    def without(scene: Scene) -> Scene:
        held: Any = getattr(scene, key)
        change: Any = () if isinstance(held, tuple) else None
        if parts:
            blank = {field.name: field.default for field in dataclasses.fields(held)}
            if any(getattr(held, name) != blank[name] for name in blank if name not in parts):
                change = dataclasses.replace(held, **{part: blank[part] for part in parts})
        changes: dict[str, Any] = {key: change}
        return dataclasses.replace(scene, **changes)

    return without


def _without_links(key: str) -> Callable[[Scene], Scene]:
    """Leave out links, and gravity if nothing is left for it to act on."""

    def without(scene: Scene) -> Scene:
        changes: dict[str, Any] = {key: (Link(),) * 3}
        try:
            return dataclasses.replace(scene, **changes)
        except InputError:
            return dataclasses.replace(scene, **changes, gravity=None)

    return without


def _part(key: str, part: str) -> Callable[[Scene], Any]:
    return lambda scene: getattr(scene, key) and getattr(getattr(scene, key), part)


TERMS = (
    Term(
        "actuated links",
        lambda scene: any(link.inertia for link in scene.actuated_links),
        _without_links("actuated_links"),
    ),
    Term(
        "intermediate links",
        lambda scene: any(link.inertia for link in scene.intermediate_links),
        _without_links("intermediate_links"),
    ),
    Term("payload", lambda scene: scene.payload, _drop("payload")),
    Term("gravity", lambda scene: scene.gravity, _drop("gravity")),
    Term("external moment", lambda scene: scene.moment, _drop("moment")),
    Term("friction in gamma", _part("friction", "gamma"), _drop("friction", "gamma")),
    Term("friction in mu", _part("friction", "mu"), _drop("friction", "mu")),
    Term("friction in beta", _part("friction", "beta"), _drop("friction", "beta")),
    Term("springs", lambda scene: scene.springs, _drop("springs")),
    Term(
        "rotors",
        _part("actuators", "rotor_inertia"),
        _drop("actuators", "rotor_inertia", "gear_ratio"),
    ),
    Term("torque limit", _part("actuators", "torque_limit"), _drop("actuators", "torque_limit")),
    Term("actuator lag", _part("actuators", "time_constant"), _drop("actuators", "time_constant")),
    Term(
        "elastic ends",
        lambda scene: scene.stroke.stiffness,
        lambda scene: dataclasses.replace(scene, stroke=Stroke(at_end="ignore")),
    ),
)


def operations(scene: Scene) -> int:
    """Operations in one evaluation of the right-hand side."""
    return sum(Dynamics.of(scene).program.operations.values())


@dataclass(frozen=True)
class Cost:
    """What a term costs.

    Attributes:
        name: of the term.
        present: whether the scene has it.
        without: operations of the right-hand side without it.
        adds: operations that it adds.

    """

    name: str
    present: bool
    without: int
    adds: int


def costs(scene: Scene) -> list[Cost]:
    """Count for every term what it costs in a scene; one that it has not costs nothing."""
    total, found = operations(scene), []
    for term in TERMS:
        present = bool(term.value(scene))
        without = operations(term.without(scene)) if present else total
        found.append(Cost(term.name, present, without, total - without))
    return found
