# SPDX-License-Identifier: Apache-2.0
"""Summary of a scene: what it consists of, what each term costs, advice for its step."""

from __future__ import annotations

import textwrap
from collections.abc import Iterable, Iterator, Sequence

import numpy as np

from sst_ros.dynamics.limits import limits_of
from sst_ros.dynamics.model import damping_of
from sst_ros.dynamics.traced_dynamics import Dynamics
from sst_ros.mechanism.geometry import Geometry
from sst_ros.scene.scene import Scene
from sst_ros.studies.step_advice import step_advice
from sst_ros.studies.term_costs import costs

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
