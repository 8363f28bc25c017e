# SPDX-License-Identifier: Apache-2.0
"""The sheet of a scene: what it is made of, what each term costs, what to run it with."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from sst_ros.bodies import Link
from sst_ros.errors import InputError
from sst_ros.integration.advice import advise
from sst_ros.limits import limits_of
from sst_ros.mechanism.compiled import Dynamics
from sst_ros.mechanism.geometry import Geometry
from sst_ros.scene import Scene
from sst_ros.terms import Stroke, Workspace


@dataclass(frozen=True)
class Term:
    """Something that a scene may have.

    Attributes:
        name: what it is called in the sheet.
        value: what the scene has of it, falsy for nothing.
        without: the scene without it.

    """

    name: str
    value: Callable[[Scene], Any]
    without: Callable[[Scene], Scene]


def _drop(key: str, part: str = "") -> Callable[[Scene], Scene]:
    """Leave out a section, or one field of it."""

    def without(scene: Scene) -> Scene:
        held: Any = getattr(scene, key)
        change: Any = () if isinstance(held, tuple) else None
        if part:
            blank = {field.name: field.default for field in dataclasses.fields(held)}
            if any(getattr(held, name) != blank[name] for name in blank if name != part):
                change = dataclasses.replace(held, **{part: blank[part]})
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
        _drop("actuators", "rotor_inertia"),
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
    return sum(Dynamics(scene).program.operations.values())


def costs(scene: Scene) -> list[tuple[str, bool, int]]:
    """For every term: its name, whether the scene has it, and the operations that it adds."""
    total = operations(scene)
    return [
        (term.name, True, total - operations(term.without(scene)))
        if term.value(scene)
        else (term.name, False, 0)
        for term in TERMS
    ]


def sheet(scene: Scene) -> str:
    """Write the sheet of a scene as text."""
    return "\n".join(_lines(scene)) + "\n"


def _lines(scene: Scene) -> Iterator[str]:
    geometry, dynamics = Geometry.of(scene), Dynamics(scene)
    yield f"{scene.name}: {scene.description}"
    yield ""
    yield "geometry"
    with np.printoptions(precision=6, suppress=True):
        for k in range(3):
            arc = np.degrees(geometry.arc[k])
            yield f"  P{k + 1} {geometry.v[k]}  stroke 0 to {arc:.4f} deg"
        alpha, beta_max = np.degrees(geometry.alpha), scene.workspace.beta_max_deg
        yield f"  alpha {alpha} deg, beta_max {beta_max:g} deg"
    yield ""
    yield f"right-hand side: {len(dynamics.state)} states, {operations(scene)} operations"
    for op, count in sorted(dynamics.program.operations.items()):
        yield f"  {op:<9}{count:>5}"
    yield ""
    yield "term                           in the scene   operations it adds"
    for name, present, count in costs(scene):
        yield f"  {name:<29}{'yes' if present else 'no':<15}{count:>6}"
    ends = len(list(limits_of(scene, geometry)))
    yield f"  ends watched between steps   {ends}: {_ends(scene.stroke, scene.workspace)}"
    yield ""
    yield "topics of the simulator"
    for line in _topics(dynamics):
        yield f"  {line}"
    yield ""
    yield f"suggestion: {advise(scene)}"
    yield ""
    yield "where the numbers come from"
    for key, said in scene.provenance:
        yield f"  {key}: {said}"


def _ends(stroke: Stroke, workspace: Workspace) -> str:
    return f"stroke {stroke.at_end}, workspace {workspace.at_edge}"


def _topics(dynamics: Dynamics) -> Iterator[str]:
    yield "in:  ~/commands" + (", ~/external_moment" if dynamics.moved else "")
    yield "out: joint_states, ~/orientation, ~/euler_zyz, ~/applied_torques, ~/scene, /diagnostics"
