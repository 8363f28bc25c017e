# SPDX-License-Identifier: Apache-2.0
"""Extreme cases as scenarios of batches: cases whose scenes have the same terms share one batch.

What a batch promises is held for each: the bits of fixed steps of the case's own scene; and where
its local error estimate is as small as that of a simulation, the end of the simulation, or the
same limit within a step of the same time.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from sst_ros.dynamics.initial_state import initial_state
from sst_ros.dynamics.traced_dynamics import ODE, Dynamics
from sst_ros.errors import RunStopped, SstError
from sst_ros.integration.batch import Batch
from sst_ros.integration.batch_source import NOT_FINITE
from sst_ros.integration.compiled_method import CompiledMethod
from sst_ros.integration.limit_crossings import whole_steps
from sst_ros.integration.methods import DOP853
from sst_ros.mechanism.geometry import Geometry
from sst_ros.scene.scene import Scene
from sst_ros.scene.schema import Section, specs
from sst_ros.simulation.simulation import NANOSECONDS
from studies.extreme_cases import Case, CaseRun, run
from studies.extreme_scenes import Triple

TOLERANCE = 1e-10
"""Local error estimate of a step up to which the end is that of a simulation: its default."""

SAME_ORIENTATION, SAME_RATE = 1e-9, 1e-8
"""Differences of quaternions, and of body rates relative to the largest or 1 rad/s, allowed."""

_GIVEN = ("name", "description", "provenance", "initial", "torque", "motion", "duration")
"""Fields that are given to a run, or have no effect on it."""


def batch_groups(cases: Sequence[Case]) -> list[tuple[int, ...]]:
    """Return the numbers of the cases that can run as a batch, those of one batch together.

    Torques that read the simulation, starts that are refused, and runs of ten million steps cannot.
    """
    groups: dict[Any, list[int]] = {}
    for number, case in enumerate(cases):
        if case.feedback or case.compiled_only:
            continue
        try:
            scene = case.scene()
            initial_state(scene, Geometry.of(scene))
        except SstError:
            continue
        groups.setdefault(_terms(scene), []).append(number)
    return [tuple(group) for group in groups.values()]


def run_batch(cases: Sequence[Case]) -> list[tuple[str, bool]]:
    """Run cases of the same terms as one batch; what was compared, and whether it agrees."""
    numbers = [_numbers(case.scene()) for case in cases]
    varied = {
        key: [row[key] for row in numbers]
        for key, value in numbers[0].items()
        if any(row[key] != value for row in numbers)
    }
    batch = Batch(cases[0].scene(), DOP853, parameters=varied)
    return [compared(batch, row, case, len(cases)) for row, case in enumerate(cases)]


def compared(batch: Batch, row: int, case: Case, count: int) -> tuple[str, bool]:
    """Run a case as a row of a batch of `count`; what was compared, and whether it agrees."""
    scene, h = case.scene(), case.period_ns / NANOSECONDS
    y, code = np.zeros((len(batch.state), 1)), np.zeros(1, dtype=np.int64)
    when, error = np.full(1, np.nan), np.zeros(1)
    y[:7, 0] = initial_state(scene, Geometry.of(scene))
    alone: list[float] = y[:, 0].tolist()
    for first, steps, torque in _spans(case):
        given = np.ascontiguousarray(batch.drives(torque, count)[:, [row]])
        batch.advance(first, steps, h, y, given, code, when, error, threads=1)
    done = case.steps
    if code[0]:  # the step in which it ends is left out
        done = int(whole_steps(when, h)[0])
    own = CompiledMethod(ODE(Dynamics.of(scene)), DOP853, compiled=False)
    with np.errstate(all="ignore"):
        for first, steps, torque in _spans(case):
            alone = own.step_fixed(0.0, h, max(0, min(steps, done - first)), alone, torque)
    if alone != y[:, 0].tolist():
        return "another end than fixed steps of its own", False
    if error[0] > TOLERANCE or code[0] >= NOT_FINITE:
        return "bits", True
    reason, stop = "", 0.0
    if code[0]:
        index = int(np.broadcast_to(batch.columns.geometry, count)[row])
        geometry = batch.columns.geometries.of_rows(index)
        reason, stop = batch.model.limits(geometry)[int(code[0]) - 1].reason, float(when[0])
    agree = _agrees(run(case), y[:7, 0].tolist(), reason, stop, h)
    return ("bits and end" if agree else "another end than the simulation"), agree


def _spans(case: Case) -> Iterator[tuple[int, int, Triple]]:
    """Yield first step, number of steps and torque of the spans of constant torque."""
    if callable(case.torque):
        for k in range(case.steps):
            yield k, 1, case.torque(k)
    else:
        yield 0, case.steps, case.torque


def _agrees(direct: CaseRun, y: list[float], reason: str, stop: float, h: float) -> bool:
    """Whether a simulation ends as a scenario does that ended in `y`, or at a limit."""
    if reason or direct.error is not None or direct.simulation is None:
        ended = direct.error
        return (
            isinstance(ended, RunStopped)
            and ended.reason == reason
            and abs(stop - ended.time) <= h + 1e-12
        )
    state = direct.simulation.state
    q, rate = np.array(state.quaternion), np.array(state.body_rate)
    apart = min(np.abs(q - y[:4]).max(), np.abs(q + y[:4]).max())
    return bool(
        apart < SAME_ORIENTATION
        and np.abs(rate - y[4:]).max() < SAME_RATE * max(1.0, np.abs(rate).max())
    )


def _flat(section: Section, path: str = "") -> Iterator[tuple[str, str, Any]]:
    """Yield key, kind and value of all fields of a scene that act on its motion."""
    for name, spec in specs(type(section)).items():
        value, key = getattr(section, name), f"{path}{name}"
        if name in _GIVEN:
            continue
        if spec.kind == "section" and value is not None:
            yield from _flat(value, f"{key}.")
        elif spec.kind == "sections":
            for i, entry in enumerate(value):
                yield from _flat(entry, f"{key}[{i}].")
        else:
            yield key, spec.kind, value


def _numbers(scene: Scene) -> dict[str, Any]:
    """Return the numbers of a scene by their keys in the document."""
    return {key: value for key, kind, value in _flat(scene)
            if kind == "number" and value is not None}  # fmt: skip


def _terms(scene: Scene) -> Any:
    """Return what is left of a scene without its numbers: which terms it has, and its choices."""
    return tuple(
        (key, value is not None if kind == "number" else value) for key, kind, value in _flat(scene)
    )
