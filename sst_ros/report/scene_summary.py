# SPDX-License-Identifier: Apache-2.0
"""Summary of a scene: what it consists of, what each term costs, advice for its step."""

from __future__ import annotations

import ast
import dataclasses
import math
import sys
import textwrap
import time
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from types import FrameType
from typing import Any

import numpy as np

from sst_ros.dynamics import kernel
from sst_ros.dynamics.expression import Expression, Graph
from sst_ros.dynamics.initial_state import initial_state
from sst_ros.dynamics.limits import limits_of
from sst_ros.dynamics.model import damping_of
from sst_ros.dynamics.traced_dynamics import ODE, Dynamics
from sst_ros.errors import InputError
from sst_ros.integration.compiled_method import CompiledMethod
from sst_ros.integration.methods import RK4
from sst_ros.mechanism.geometry import Geometry
from sst_ros.report.step_advice import step_advice
from sst_ros.scene.bodies import Link
from sst_ros.scene.loads import Stroke
from sst_ros.scene.scene import Scene

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
    "elastic ends": ("stroke", "stiffness"),
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
        bare = operations(without(scene, term))
        found.append(Cost(term, has(scene, term), bare, total - bare, written[term]))
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
    present = [cost for cost in found if cost.present]
    scenes = [scene, *(without(scene, cost.name) for cost in present)]
    whole_ns, *bare_ns = evaluation_ns(scenes, compiled=compiled)
    rows = [("all", operations(scene), whole_ns)]
    for cost, ns in zip(present, bare_ns, strict=True):
        # A term that folds into constants leaves the same number of operations, and its time.
        rows.append((cost.name, cost.adds, whole_ns - ns if cost.adds else 0.0))
    absent = [cost.written + cost.adds for cost in found if not cost.present]
    rows.append((f"absent: {len(absent)} terms", sum(absent), 0.0))
    names = ("term", "operations", "ns")
    return [{"scene": scene.name, **dict(zip(names, row, strict=True))} for row in rows]


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
        ["advice", *_wrapped(step_advice(scene).text, "  ")],
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
    found = costs(scene)
    lines = [
        f"right-hand side: {len(dynamics.state)} states, {sum(counted.values())} operations",
        f"  {by_kind}",
        "",
        "terms present           operations it adds   operations without it",
    ]
    for cost in found:
        if cost.present:
            lines.append(f"  {cost.name:<21}{cost.adds:>19}{cost.without:>24}")
    absent = [cost for cost in found if not cost.present]
    total = sum(cost.written + cost.adds for cost in absent)
    names = ", ".join(cost.name for cost in absent) or "none"
    lines += ["", f"terms absent, {total} operations", *_wrapped(names, "  ")]
    return lines


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
    yield "in", "~/commands" + (", ~/external_moment" if dynamics.moved else "")
    topics = "joint_states, ~/orientation, ~/euler_zyz, ~/applied_torques, ~/scene, /diagnostics"
    yield "out", topics


def _columns(rows: Iterable[tuple[str, str]]) -> Iterator[str]:
    """Write pairs in two columns, the second one wrapped."""
    pairs = list(rows)
    width = max((len(name) for name, _ in pairs), default=0)
    for name, text in pairs:
        yield from _wrapped(text, f"  {name:<{width}}  ")


def _wrapped(text: str, first: str) -> list[str]:
    return textwrap.wrap(
        text,
        WIDTH,
        initial_indent=first,
        subsequent_indent=" " * len(first),
        break_on_hyphens=False,
    )


def _list(numbers: Sequence[float]) -> str:
    return "(" + ", ".join(f"{x:.6g}" for x in numbers) + ")"
