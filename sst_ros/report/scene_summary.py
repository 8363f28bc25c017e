# SPDX-License-Identifier: Apache-2.0
"""Summary of a scene: what it consists of, what each term costs, advice for its step."""

from __future__ import annotations

import dataclasses
import math
import textwrap
import time
from collections.abc import Iterable, Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np

from sst_ros.dynamics.initial_state import initial_state
from sst_ros.dynamics.model import damping_of, limits_of
from sst_ros.dynamics.traced_dynamics import ODE, Dynamics
from sst_ros.errors import InputError
from sst_ros.integration.codegen import numba_version
from sst_ros.integration.compiled_method import CompiledMethod
from sst_ros.integration.methods import RK4
from sst_ros.mechanism.geometry import Geometry
from sst_ros.report.step_advice import step_advice
from sst_ros.scene.bodies import Link
from sst_ros.scene.loads import Stroke
from sst_ros.scene.scene import Scene

WIDTH = 100


def summary(scene: Scene) -> str:
    """Write the summary of a scene as text."""
    dynamics = Dynamics.of(scene)
    parts = (
        [f"{scene.name}: {scene.description}"],
        ["geometry", *_columns(_geometry(scene))],
        ["run", *_columns(_run(scene))],
        _right_hand_side(scene, dynamics),
        ["ends", *_columns(_ends(scene))],
        ["topics of the simulator", *_columns(_topics(dynamics))],
        ["advice", *_wrap(step_advice(scene).text, "  ")],
        ["sources of the numbers", *_columns(scene.provenance)],
    )
    return "\n\n".join("\n".join(part) for part in parts) + "\n"


def _geometry(scene: Scene) -> Iterator[tuple[str, str]]:
    geometry = Geometry.of(scene)
    for k in range(3):
        following = (k + 1) % 3 + 1
        arc = np.degrees(geometry.arc[k])
        direction = "(" + ", ".join(f"{x:.6f}" for x in geometry.v[k] + 0.0) + ")"
        yield f"P{k + 1}", f"{direction} in {{B}}; arc P{k + 1} P{following} is {arc:.6g} deg long"
    yield "alpha", _list(scene.star.alpha_deg) + " deg"
    yield "radii", f"base {scene.base.radius:g} m, star {scene.star.radius:g} m"


def _run(scene: Scene) -> Iterator[tuple[str, str]]:
    yield "gamma(0)", _list(scene.initial.gamma) + " rad"
    yield "gamma_dot(0)", _list(scene.initial.gamma_dot) + " rad/s"
    if scene.torque is None:
        yield "torque", "none of its own"
    else:
        tau = scene.torque
        rows = zip(tau.amplitude, tau.frequency, tau.phase, strict=True)
        yield "torque", ", ".join(f"{a:g} sin({f:g} t + {p:.6g})" for a, f, p in rows) + " N m"
    if scene.motion is not None:
        yield (
            "motion",
            f"{scene.motion.kind}; `python -m sst_ros plan check` shows what it requires",
        )
    yield "duration", "open" if scene.duration is None else f"{scene.duration:g} s"


def _right_hand_side(scene: Scene, dynamics: Dynamics) -> list[str]:
    counted = dynamics.program.operations
    by_kind = ", ".join(f"{count} {op}" for op, count in counted.most_common())
    lines = [
        f"right-hand side: {len(dynamics.state)} states, {sum(counted.values())} operations",
        f"  {by_kind}",
        "",
        "terms present           operations it adds   operations without it",
    ]
    for cost in costs(scene):
        lines.append(f"  {cost.name:<21}{cost.adds:>19}{cost.without:>24}")
    absent = [term for term in TERMS if not has(scene, term)]
    return [*lines, "", "terms absent", *_wrap(", ".join(absent) or "none", "  ")]


def _ends(scene: Scene) -> Iterator[tuple[str, str]]:
    stroke, workspace = scene.stroke, scene.workspace
    more = ""
    if stroke.at_end == "elastic":
        more = f", {stroke.stiffness} N m/rad, damping {damping_of(stroke):.3g} s/rad"
    if stroke.restitution is not None:
        more += f" (restitution {stroke.restitution:g} at {stroke.impact_rate:g} rad/s)"
    yield "stroke", f"0 < gamma_k < arc: {stroke.at_end}{more}"
    yield "workspace", f"0 < beta_k <= {workspace.beta_max_deg:g} deg: {workspace.at_edge}"
    yield "limits", f"{len(list(limits_of(scene, Geometry.of(scene))))} monitored between steps"


def _topics(dynamics: Dynamics) -> Iterator[tuple[str, str]]:
    yield "in", "~/commands" + (", ~/external_moment" if dynamics.has_moment_topic else "")
    topics = "joint_states, ~/orientation, ~/euler_zyz, ~/applied_torques, ~/scene, /diagnostics"
    yield "out", topics


def _columns(rows: Iterable[tuple[str, str]]) -> Iterator[str]:
    """Write pairs in two columns, the second one wrapped."""
    pairs = list(rows)
    width = max((len(name) for name, _ in pairs), default=0)
    for name, text in pairs:
        yield from _wrap(text, f"  {name:<{width}}  ")


def _wrap(text: str, first: str) -> list[str]:
    return textwrap.wrap(
        text,
        WIDTH,
        initial_indent=first,
        subsequent_indent=" " * len(first),
        break_on_hyphens=False,
    )


def _list(numbers: Sequence[float]) -> str:
    return "(" + ", ".join(f"{x:.6g}" for x in numbers) + ")"


TIMED_STEPS, ROUNDS = 2000, 200
"""Steps of a measurement of the time of an evaluation, and how many: a scene and what it is without
each term take turns, and each has the time of its fastest turn, which no other process has met."""


TERMS: dict[str, tuple[str, ...]] = {
    "actuated links": ("actuated_links",),
    "intermediate links": ("intermediate_links",),
    "payload": ("payload",),
    "gravity": ("gravity",),
    "external moment": ("moment",),
    "friction in gamma": ("friction", "gamma"),
    "friction in mu": ("friction", "mu"),
    "friction in beta": ("friction", "beta"),
    "springs": ("springs",),
    "rotors": ("actuators", "rotor_inertia", "gear_ratio"),
    "torque limit": ("actuators", "torque_limit"),
    "actuator lag": ("actuators", "time_constant"),
    "elastic stops": ("stroke", "stiffness"),
}
"""Section of a scene that has each term, and the fields of that section where not all are its."""


def has(scene: Scene, term: str) -> bool:
    """Return whether a scene has one of TERMS."""
    section, *fields = TERMS[term]
    value: Any = getattr(scene, section)
    if section in ("actuated_links", "intermediate_links"):
        return any(link.inertia for link in value)
    return bool(value and getattr(value, fields[0]) if fields else value)


def without(scene: Scene, term: str) -> Scene:
    """Return a scene without one of TERMS; gravity goes with the last links that it acts on."""
    section, *fields = TERMS[term]
    value: Any = getattr(scene, section)
    change: Any = () if section == "springs" else None
    if section in ("actuated_links", "intermediate_links"):
        change = (Link(),) * 3
    elif section == "stroke":
        change = Stroke(at_end="ignore") if value.stiffness else value
    elif value is not None and fields:
        blank = {field.name: field.default for field in dataclasses.fields(value)}
        if any(getattr(value, name) != blank[name] for name in blank if name not in fields):
            change = dataclasses.replace(value, **{name: blank[name] for name in fields})
    changes: dict[str, Any] = {section: change}
    try:
        return dataclasses.replace(scene, **changes)
    except InputError:
        return dataclasses.replace(scene, **changes, gravity=None)


def operations(scene: Scene) -> int:
    """Operations in one evaluation of the right-hand side."""
    return Dynamics.of(scene).program.operations.total()


class Cost(NamedTuple):
    """What a term of a scene costs: operations of the scene, less those of the scene without it."""

    name: str
    adds: int
    without: int


def costs(scene: Scene) -> list[Cost]:
    """Count the operations of every term that a scene has: traced with it and without it."""
    total = operations(scene)
    bare = {term: operations(without(scene, term)) for term in TERMS if has(scene, term)}
    return [Cost(term, total - count, count) for term, count in bare.items()]


def cost_table(scene: Scene) -> list[dict[str, Any]]:
    """Return operations and times [ns] of an evaluation: the whole, then each term present."""
    found, runs = costs(scene), []
    for one in (scene, *(without(scene, cost.name) for cost in found)):
        ode, start = ODE(Dynamics.of(one)), [*initial_state(one, Geometry.of(one))]
        start += [0.0] * (len(ode.state) - len(start))
        method = CompiledMethod(ode, RK4, compiled=numba_version() is not None)
        method.step_fixed(0.0, 1e-7, 1, start, (0.0,) * len(ode.drive))  # compiles
        runs.append((method, start, (0.0,) * len(ode.drive)))
    count, rounds = (TIMED_STEPS, ROUNDS) if runs[0][0].compiled else (TIMED_STEPS // 100, 3)
    times = [math.inf] * len(runs)
    for _ in range(rounds):
        for k, (method, start, drive) in enumerate(runs):
            began = time.perf_counter()
            method.step_fixed(0.0, 1e-7, count, start, drive)
            times[k] = min(times[k], time.perf_counter() - began)
    whole, *bare = (1e9 * took / (len(RK4.b) * count) for took in times)
    rows = [("all", operations(scene), whole)]
    for cost, ns in zip(found, bare, strict=True):
        # A term that folds into constants leaves the same number of operations, and its time.
        rows.append((cost.name, cost.adds, whole - ns if cost.adds else 0.0))
    return [
        {"scene": scene.name, "term": term, "operations": added, "ns": ns}
        for term, added, ns in rows
    ]
