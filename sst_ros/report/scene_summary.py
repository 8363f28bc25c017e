# SPDX-License-Identifier: Apache-2.0
"""Summary of a scene: what it consists of, what each term costs, advice for its step.

The advice, also that of the accuracy and stability reports, is the run of `simulate`
with the method "auto" itself: they cannot disagree with it.

Applied to y' = lambda y with steps h, a method multiplies y by its stability function
R(z), z = h lambda; it is stable where abs(R) <= 1 (Hairer & Wanner, Solving ODEs II,
sections IV.2 and IV.3). The eigenvalues lambda are those of the linearised dynamics.
"""

from __future__ import annotations

import contextlib
import math
import textwrap
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sst_ros.dynamics.initial_state import initial_state
from sst_ros.dynamics.model import damping_of, limits_of
from sst_ros.dynamics.traced_dynamics import ODE, Dynamics, recent_ode
from sst_ros.errors import InputError, SstError
from sst_ros.integration.methods import DORMAND_PRINCE, Method, Rosenbrock
from sst_ros.mechanism.geometry import Geometry
from sst_ros.report.results import WHOLE_RUN_S, render
from sst_ros.scene.scene import SCENE_TERMS, Scene, terms
from sst_ros.scene.schema import build, drop_idle
from sst_ros.scene.yaml_document import replace_values
from sst_ros.simulation.simulate import simulate

COLUMNS = 100  # of the text
LONGEST_S = 10.0  # the advice is for a run of the scene's duration, but not of more [s]
# error of the orientation that it is for [rad]: the default of `simulate`
ADVICE_TOLERANCE = 1e-9
# abs(R) of a stable step may be so much above 1: dopri5 has 1 + 1e-7 at 0.1 i
STABLE_GROWTH = 1e-6
# Shares of the fastest rate: eigenvalues grow from a real part of that size on, smaller
# ones are rounding of zero.
GROWING = 1e-9
ZERO_RATE = 1e-6
# Steps that are tried, over the inverse of the fastest rate: they differ by 0.2 %.
TRIED_STEPS = np.geomspace(1e-2, 1e3, 5001)


def summary(scene: Scene) -> str:
    """Write the summary of a scene as text."""
    dynamics = Dynamics.of(scene)
    geometry = Geometry.of(scene)
    return render(
        "scene.txt",
        scene=scene,
        vertices=(geometry.v + 0.0).tolist(),
        arcs_deg=np.degrees(geometry.arc).tolist(),
        dynamics=dynamics,
        operations=ODE(dynamics).program.operations,
        costs=costs(scene),
        absent=[term for term in SCENE_TERMS if term not in terms(scene)],
        damping=damping_of(scene.stroke) if scene.stroke.at_end == "elastic" else 0.0,
        limits=len(list(limits_of(scene, geometry))),
        advice=step_advice(scene).text,
        wrap=_wrap,
    )


def _wrap(text: str, first: str) -> str:
    """Wrap a text whose first line begins with `first`, and others with blanks."""
    return textwrap.fill(
        text,
        COLUMNS,
        initial_indent=first,
        subsequent_indent=" " * len(first),
        break_on_hyphens=False,
    )


def without(scene: Scene, term: str) -> Scene:
    """Return a scene without one of SCENE_TERMS.

    Gravity goes with the last links that it acts on.
    """
    key = SCENE_TERMS[term]
    section = key.partition(".")[0]
    without_section: dict[str, Any] = {section: None}
    without_term: dict[str, Any] = {key: None}
    if term.endswith("links"):  # bodies without anything
        without_section = without_term = {section: [{}]}
    for change in (without_term, without_section):
        # refused: a kind of stops without its own numbers, or gravity on nothing
        with contextlib.suppress(InputError):
            document = replace_values(scene, change)
            return build(Scene, drop_idle(Scene, document), scene.name)
    return scene.with_values({**without_section, "gravity": None})


def operations(scene: Scene) -> int:
    """Operations in one evaluation of the right-hand side."""
    return ODE(Dynamics.of(scene)).program.operations.total()


class Cost(NamedTuple):
    """What a term of a scene costs."""

    name: str
    adds: int  # operations of the scene, less those of the scene without it
    without: int  # these


def costs(scene: Scene) -> list[Cost]:
    """Count the operations of every term that a scene has.

    The scene is traced with the term and without it.
    """
    total = operations(scene)
    bare = {term: operations(without(scene, term)) for term in terms(scene)}
    return [Cost(term, total - count, count) for term, count in bare.items()]


class StepAdvice(NamedTuple):
    """A recommendation, which is what `auto` takes."""

    text: str  # in words
    method: str = ""
    step: float = math.nan  # on average [s]; nan for none


def step_advice(scene: Scene) -> StepAdvice:
    """Recommend a method and a step for a scene: those that `auto` takes."""
    seconds = min(scene.duration or WHOLE_RUN_S, LONGEST_S)
    try:
        motion = simulate(scene, duration=seconds, tolerance=ADVICE_TOLERANCE)
        rates = eigenvalues(scene)
    except SstError as error:
        return StepAdvice(f"none, the scene cannot start: {error}")
    text = (
        f"for an error of {ADVICE_TOLERANCE:g} rad over {seconds:g} s: {motion.method}"
    )
    text += f"; its steps have {motion.step:.2g} s on average"
    fastest = float(np.abs(rates).max())
    text += f". The fastest rate at the start is {fastest:.3g} 1/s"
    limit = largest_stable_step(DORMAND_PRINCE, rates)
    if math.isfinite(limit):
        text += (
            f": steps of {DORMAND_PRINCE.name} above {limit:.2g} s would be unstable"
        )
    return StepAdvice(text, motion.method, motion.step)


def eigenvalues(
    scene: Scene,
    state: Sequence[float] | None = None,
    torque: Sequence[float] = (0.0, 0.0, 0.0),
) -> NDArray[np.complex128]:
    """Eigenvalues of the linearised dynamics [1/s], shape (7,) or (10,).

    They are of a state - quaternion, body rate [rad/s], lagged torques - by default the
    start, and of the torque that acts there [N m], shape (3,).
    """
    ode = recent_ode(Dynamics.of(scene))
    if state is None:
        state = initial_state(scene, Geometry.of(scene))
    lagged = (0.0,) * (len(ode.state) - len(state))
    moment = (0.0,) * (len(ode.drive) - len(torque))
    rates = ode.eigenvalues(0.0, (*state, *lagged), (*torque, *moment))
    return np.asarray(rates, dtype=complex)


def largest_stable_step(method: Method, eigenvalues: ArrayLike) -> float:
    """Return the longest step [s] below which all are stable; inf where every one is.

    Of the eigenvalues [1/s], shape (n,), growing ones are left out.
    """
    values = np.asarray(eigenvalues, dtype=complex)
    fastest = float(np.abs(values).max(initial=0.0))
    bounded = values.real <= GROWING * fastest
    values = values[bounded & (np.abs(values) > ZERO_RATE * fastest)]
    if not len(values):
        return math.inf
    steps = TRIED_STEPS / np.abs(values).max()
    growth = np.abs(stability_function(method, np.outer(steps, values)))
    stable = growth.max(axis=1) < 1 + STABLE_GROWTH
    if stable.all():
        return math.inf
    first_unstable = int(np.argmin(stable))
    return float(steps[max(first_unstable - 1, 0)])


def stability_function(
    method: Method, z: NDArray[np.complex128]
) -> NDArray[np.complex128]:
    """Evaluate R(z) of a method from its coefficients, for any shape of z."""
    stages: list[Any] = []
    identity = np.ones_like(z)
    if isinstance(method, Rosenbrock):
        for a, c in zip(method.a, method.c, strict=True):
            stage_value = identity + _combine(a, stages)
            stages.append(
                (z * stage_value + _combine(c, stages)) / (1.0 / method.gamma - z)
            )
        return np.asarray(stage_value + stages[-1])
    for row in method.a:
        stages.append(identity + z * _combine(row, stages))
    return np.asarray(identity + z * _combine(method.b, stages))


def _combine(weights: tuple[float, ...], stages: list[Any]) -> Any:
    """Return the weighted sum of stages; the last weights may have no stage yet."""
    return sum((w * k for w, k in zip(weights, stages, strict=False) if w), 0.0)
