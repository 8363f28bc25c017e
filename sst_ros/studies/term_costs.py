# SPDX-License-Identifier: Apache-2.0
"""What each term of a scene costs: operations in the generated source, and time."""

from __future__ import annotations

import ast
import dataclasses
import math
import sys
import time
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from types import FrameType
from typing import Any

from sst_ros.dynamics import kernel
from sst_ros.dynamics.expression import Expression, Graph
from sst_ros.dynamics.initial_state import initial_state
from sst_ros.dynamics.traced_dynamics import ODE, Dynamics
from sst_ros.errors import InputError
from sst_ros.integration.compiled_method import CompiledMethod
from sst_ros.integration.methods import RK4
from sst_ros.mechanism.geometry import Geometry
from sst_ros.scene.bodies import Link
from sst_ros.scene.loads import Stroke
from sst_ros.scene.scene import Scene

TIMED_STEPS, ROUNDS = 2000, 200
"""Steps of a measurement of the time of an evaluation, and how many: a scene and what it is without
each term take turns, and each has the time of its fastest turn, which no other process has met."""


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
        if held is None:
            return scene
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
        lambda scene: (
            dataclasses.replace(scene, stroke=Stroke(at_end="ignore"))
            if scene.stroke.stiffness
            else scene
        ),
    ),
)


def operations(scene: Scene) -> int:
    """Operations in one evaluation of the right-hand side, counted in its generated source."""
    tree = ast.parse(Dynamics.of(scene).program.source("rhs"))
    return sum(
        isinstance(node, ast.BinOp | ast.Call | ast.IfExp)
        or (isinstance(node, ast.UnaryOp) and not isinstance(node.operand, ast.Constant))
        for node in ast.walk(tree)
    )


class _AttributedGraph(Graph):
    """A graph that keeps for each operation the term whose code has written it."""

    def __init__(self) -> None:
        super().__init__()
        self.terms: list[str] = []

    def node(self, op: str, *args: Any) -> Expression:
        """Return the expression op(args)."""
        found = super().node(op, *args)
        if len(self.terms) < len(self.nodes):
            self.terms.append(_term_of(sys._getframe(1)))
        return found


def _term_of(frame: FrameType | None) -> str:
    """Return the term whose function in `loads` or `kernel` is being run; empty for none."""
    called = ""
    while frame is not None and frame.f_code is not kernel.derivative.__code__:
        name, known = frame.f_code.co_name, frame.f_locals
        if name == "<genexpr>" and {"kind", "one"} <= known.keys():
            return f"friction in {('gamma', 'mu', 'beta')[known['kind']]}"
        if name == "<genexpr>" and {"kind", "spring"} <= known.keys():
            return "springs"
        if name == "<genexpr>" and {"asked", "has"} <= known.keys():
            return "actuator lag"
        if name in ("_weight", "field_of"):
            return "gravity"
        if name == "_on_star" and "total" in known:
            return "external moment" if "external" in known else "gravity"
        if name == "stop_torque" or (name == "joint_torques" and called == "angle"):
            return "elastic ends"
        called, frame = name, frame.f_back
    return ""


def operations_by_term(scene: Scene) -> Counter[str]:
    """Operations in the generated source by the term whose code has written them.

    What a term has in common with the rest counts for who needs it first. The key "" has all that
    is no load: geometry, the star, and links, payload and rotors, which are constants.
    """
    dynamics, graph = Dynamics.of(scene), _AttributedGraph()
    size = len(dynamics.state)
    state = [graph.node("input", name) for name in (*dynamics.state, *dynamics.drive)]
    torque, moment = (state[size], state[size + 1], state[size + 2]), state[size + 3 :]
    given = (moment[0], moment[1], moment[2]) if moment else None
    waiting = list(kernel.derivative(dynamics.model, tuple(state[:size]), torque, given))
    needed: set[int] = set()
    while waiting:
        value = waiting.pop()
        if isinstance(value, Expression) and value.index not in needed:
            op, args = graph.nodes[value.index]
            if op != "input":
                needed.add(value.index)
                waiting += args
    return Counter(graph.terms[index] for index in needed)


@dataclass(frozen=True)
class Cost:
    """What a term costs.

    Attributes:
        name: of the term.
        present: whether the scene has it.
        without: operations in the source that is generated for the scene without it.
        adds: operations that it adds to that.
        written: operations in the scene's source that the term's code has written; links, payload,
            rotors and the torque limit are constants or act outside, and have no code there.

    """

    name: str
    present: bool
    without: int
    adds: int
    written: int


def costs(scene: Scene) -> list[Cost]:
    """Count the operations of every term of a scene, in the sources with it and without it."""
    total, written, found = operations(scene), operations_by_term(scene), []
    for term in TERMS:
        without = operations(term.without(scene))
        present, adds = bool(term.value(scene)), total - without
        found.append(Cost(term.name, present, without, adds, written[term.name]))
    return found


def evaluation_ns(scenes: Sequence[Scene], *, compiled: bool = True) -> list[float]:
    """Return times of an evaluation of the right-hand sides of scenes in steps of RK4 [ns]."""
    runs = []
    for scene in scenes:
        ode, start = ODE(Dynamics.of(scene)), [*initial_state(scene, Geometry.of(scene))]
        start += [0.0] * (len(ode.state) - len(start))
        method = CompiledMethod(ode, RK4, compiled=compiled)
        method.step_fixed(0.0, 1e-7, 1, start, (0.0,) * len(ode.drive))  # compiles
        runs.append((method, start, (0.0,) * len(ode.drive)))
    count, rounds = (TIMED_STEPS, ROUNDS) if runs[0][0].compiled else (TIMED_STEPS // 100, 3)
    times = [math.inf] * len(runs)
    for _ in range(rounds):
        for k, (method, start, drive) in enumerate(runs):
            began = time.perf_counter()
            method.step_fixed(0.0, 1e-7, count, start, drive)
            times[k] = min(times[k], time.perf_counter() - began)
    return [1e9 * took / (len(RK4.b) * count) for took in times]


def cost_table(scene: Scene, *, compiled: bool = True) -> list[dict[str, Any]]:
    """Return operations and times [ns] of an evaluation: the whole, then each term present."""
    found = costs(scene)
    present = [(term, cost) for term, cost in zip(TERMS, found, strict=True) if cost.present]
    bare = [term.without(scene) for term, _ in present]
    whole_ns, *bare_ns = evaluation_ns([scene, *bare], compiled=compiled)
    rows = [{"scene": scene.name, "term": "all", "operations": operations(scene), "ns": whole_ns}]
    for (_, cost), ns in zip(present, bare_ns, strict=True):
        # A term that folds into constants leaves the same number of operations, and its time.
        rows.append({"scene": scene.name, "term": cost.name, "operations": cost.adds,
                     "ns": whole_ns - ns if cost.adds else 0.0})  # fmt: skip
    absent = [cost.written + cost.adds for cost in found if not cost.present]
    rows.append({"scene": scene.name, "term": f"absent: {len(absent)} terms",
                 "operations": sum(absent), "ns": 0.0})  # fmt: skip
    return rows
