# SPDX-License-Identifier: Apache-2.0
"""MuJoCo: equality constraints; its integrators, softness and time steps swept.

Torques reach it in three ways: by a compiled callback (nothing of Python in the loop, exact times
at all stages), by a Python callback (the same times), and by `rollout` with a table of torques
held over each step (their values at its middle, which makes any integrator of order 2 at most).
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np

from benchmark.peers.mujoco_model import Model, NativeCallback, python_callback
from benchmark.peers.study import Failed, Run, Series, Setting, make_ladder
from benchmark.peers.task import DURATION, Moving, Pose, Task, find_relative

ENGINE, PACKAGE = "MuJoCo", "mujoco"

MOBILITIES, SETTLES = (0.01, 0.1, 1.0, 10.0), (0.003, 0.01, 0.03, 0.1)
TOLERANCE = 1e-3

model_of = cache(Model)


def series(task: Task, quick: bool) -> list[Series]:
    """RK4 with three sources of torque; the other integrators with the fastest source."""
    factor = 1.6 if quick else 1.25
    mobilities = MOBILITIES[1:3] if quick else MOBILITIES
    settles = SETTLES[1:3] if quick else SETTLES
    grid = [(mobility, settle) for mobility in mobilities for settle in settles]
    few = [pair for pair in grid if pair[1] <= 0.03]
    found = []

    def add(name: str, python: str, make: Callable[..., Setting], integrator: str, last: int,
            pairs: list[tuple[float, float]]) -> None:  # fmt: skip
        settings = [
            make(task, integrator, mobility, settle, steps)
            for mobility, settle in pairs
            for steps in make_ladder(40, last, factor)
        ]
        gates = [model_of(task, integrator, *pair, False) for pair in pairs]

        def worst(at: Moving) -> np.ndarray:
            answers = [gate.acceleration(at) for gate in gates]
            return max(answers, key=lambda answer: find_relative(answer, at.answer))

        found.append(Series(ENGINE, name, python, TOLERANCE, worst, settings))

    last = 6400 if quick else 16000
    add("RK4, compiled torques", "nowhere", _native, "RK4", last, grid)
    add("RK4, Python torques", "the torques", _python, "RK4", 3200, few)
    add("RK4, rollout", "nowhere", _rollout, "RK4", 6400, few)
    for integrator in ("EULER", "IMPLICIT", "IMPLICITFAST"):
        name = f"{integrator.lower()}, compiled torques"
        add(name, "nowhere", _native, integrator, 16000, grid[:: 1 if quick else 3])
    return found


@cache
def _callback(task: Task) -> NativeCallback:
    return NativeCallback(model_of(task, "RK4", MOBILITIES[0], SETTLES[1], False))


def _native(task: Task, integrator: str, mobility: float, settle: float, steps: int) -> Setting:
    def prepare() -> Run:
        model, callback = model_of(task, integrator, mobility, settle, False), _callback(task)
        callback.aim(model)

        def ready() -> None:
            callback.aim(model)
            model.mujoco.set_mjcb_control(callback.function)

        return _stepping(model, steps, ready)

    return Setting(_label(steps, mobility, settle), steps, prepare)


def _python(task: Task, integrator: str, mobility: float, settle: float, steps: int) -> Setting:
    def prepare() -> Run:
        model = model_of(task, integrator, mobility, settle, False)
        callback = python_callback(model)
        return _stepping(model, steps, lambda: model.mujoco.set_mjcb_control(callback))

    return Setting(_label(steps, mobility, settle), steps, prepare)


def _stepping(model: Model, steps: int, ready: Callable[[], None]) -> Run:
    mujoco: Any = model.mujoco

    def whole() -> None:
        model.reset(steps)
        ready()
        mujoco.mj_step(model.model, model.data, nstep=steps)
        mujoco.set_mjcb_control(None)

    def poses(pieces: int) -> list[Pose]:
        model.reset(steps)
        ready()
        found = []
        try:
            for _ in range(pieces):
                mujoco.mj_step(model.model, model.data, nstep=steps // pieces)
                found.append(model.pose())
        finally:
            mujoco.set_mjcb_control(None)
        return _checked(found, model.data.time)

    return Run(whole, poses)


def _rollout(task: Task, integrator: str, mobility: float, settle: float, steps: int) -> Setting:
    def prepare() -> Run:
        from mujoco import rollout

        model = model_of(task, integrator, mobility, settle, True)
        middles = (np.arange(steps) + 0.5) * (DURATION / steps)
        controls = np.array([task.torque_at(t) for t in middles])[None]
        model.reset(steps)
        kind = model.mujoco.mjtState.mjSTATE_FULLPHYSICS
        start = np.zeros(model.mujoco.mj_stateSize(model.model, kind))
        model.mujoco.mj_getState(model.model, model.data, start, kind)
        states = np.empty((1, steps, len(start)))
        sensors = np.empty((1, steps, 0))

        def whole() -> None:
            model.reset(steps)
            rollout.rollout(
                model.model, model.data, start[None], controls, nstep=steps, state=states,
                sensordata=sensors,
            )  # fmt: skip

        def poses(pieces: int) -> list[Pose]:
            whole()
            found = []
            for piece in range(pieces):
                row = states[0, (piece + 1) * (steps // pieces) - 1]
                model.mujoco.mj_setState(model.model, model.data, row, kind)
                found.append(model.pose())
            return _checked(found, model.data.time)

        return Run(whole, poses)

    return Setting(_label(steps, mobility, settle), steps, prepare)


def _checked(poses: list[Pose], time: float) -> list[Pose]:
    if not np.all(np.isfinite(poses[-1].rotation)):
        raise Failed("not finite")
    if abs(time - DURATION) > 1e-6:
        raise Failed(f"ended at {time:.3f} s: it reset itself")
    return poses


def _label(steps: int, mobility: float, settle: float) -> str:
    return f"{steps} steps, solref {settle:g}, mobility {mobility:g}"
