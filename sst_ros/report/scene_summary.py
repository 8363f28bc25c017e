# SPDX-License-Identifier: Apache-2.0
"""Summary of a scene: what it consists of, what each term costs, advice for its step."""

from __future__ import annotations

import dataclasses
import math
import textwrap
import time
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
from sst_ros.report.results import render
from sst_ros.report.step_advice import step_advice
from sst_ros.scene.bodies import Link
from sst_ros.scene.loads import Stroke
from sst_ros.scene.scene import Scene

WIDTH = 100


def summary(scene: Scene) -> str:
    """Write the summary of a scene as text."""
    dynamics, geometry = Dynamics.of(scene), Geometry.of(scene)
    return render(
        "scene.txt",
        scene=scene,
        vertices=(geometry.v + 0.0).tolist(),
        arcs_deg=np.degrees(geometry.arc).tolist(),
        dynamics=dynamics,
        operations=dynamics.program.operations,
        costs=costs(scene),
        absent=[term for term in TERMS if not has(scene, term)],
        damping=damping_of(scene.stroke) if scene.stroke.at_end == "elastic" else 0.0,
        limits=len(list(limits_of(scene, geometry))),
        advice=step_advice(scene).text,
        wrap=_wrap,
    )


def _wrap(text: str, first: str) -> str:
    """Wrap a text whose first line begins with `first`, the others with as many blanks."""
    rest = " " * len(first)
    return textwrap.fill(
        text, WIDTH, initial_indent=first, subsequent_indent=rest, break_on_hyphens=False
    )


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
