# SPDX-License-Identifier: Apache-2.0
"""MuJoCo: equality constraints; its integrators, softness and time steps swept.

Torques reach it in three ways: by a callback in C (nothing of Python in the loop, exact
times at all stages), by a Python callback (the same times), and by `rollout` with a
table of torques held over each step (their values at its middle, which makes any
integrator of order 2 at most).

Its ties are soft: their softness is (1 - d)/d times the mobility it keeps in
body_invweight0, with d at most 0.9999. Where the centres of mass are decides that
mobility; here it is set outright and swept, so that MuJoCo gets the best compromise
between too soft and too stiff for its steps.
"""

from __future__ import annotations

import ctypes
import math
import tempfile
from collections.abc import Iterable
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np

from benchmark import c_floor
from benchmark.peers.study import Engine, Failed, Series, list_steps
from benchmark.peers.task import (
    BASE,
    DURATION,
    JOINTS,
    Moving,
    Pose,
    Task,
    find_relative,
    list_bodies,
    list_ties,
)

ENGINE, PACKAGE = "MuJoCo", "mujoco"
MOBILITIES, SETTLES = (0.01, 0.1, 1.0, 10.0), (0.003, 0.01, 0.03, 0.1)
TOLERANCE = 1e-3
CALLBACK = """
#include <math.h>
double *t, *force;
void torques(const void *model, void *data) {{
{lines}
}}
"""
"""MuJoCo hands no user data to a callback: it reads and writes where `t` and `force`
point.
"""


def series(task: Task, quick: bool) -> list[Series]:
    """RK4 with three sources of torque.

    The other integrators with the fastest source.
    """
    factor = 1.6 if quick else 1.25
    grid = [
        (mobility, settle)
        for mobility in (MOBILITIES[1:3] if quick else MOBILITIES)
        for settle in (SETTLES[1:3] if quick else SETTLES)
    ]
    few = [pair for pair in grid if pair[1] <= 0.03]
    found = []

    def add(name: str, kind: type[Python], integrator: str, last: int,
            pairs: list[tuple[float, float]]) -> None:  # fmt: skip
        settings, gates = [], []
        for mobility, settle in pairs:
            given = task, integrator, mobility, settle
            gates.append(model_of(*given, False))
            note = f", solref {settle:g}, mobility {mobility:g}"
            settings += list_steps(40, last, factor, partial(kind, *given), note)

        def find_worst(at: Moving) -> np.ndarray:
            answers = [gate.acceleration(at) for gate in gates]
            return max(answers, key=lambda answer: find_relative(answer, at.answer))

        found.append(Series(ENGINE, name, kind.PYTHON, TOLERANCE, find_worst, settings))

    add("RK4, compiled torques", Compiled, "RK4", 6400 if quick else 16000, grid)
    add("RK4, Python torques", Python, "RK4", 3200, few)
    add("RK4, rollout", Rollout, "RK4", 6400, few)
    for integrator in ("EULER", "IMPLICIT", "IMPLICITFAST"):
        name = f"{integrator.lower()}, compiled torques"
        add(name, Compiled, integrator, 16000, grid[:: 1 if quick else 3])
    return found


class Model:
    """A model with its data; all settings but the time step are fixed.

    Args:
        task: the work.
        integrator: name in mjtIntegrator.
        mobility: of every body, in place of body_invweight0 [1/kg].
        settle: time constant of the ties (solref) [s].
        motors: torques come as controls; otherwise by a callback.

    """

    def __init__(
        self,
        task: Task,
        integrator: str,
        mobility: float,
        settle: float,
        motors: bool = False,
    ) -> None:
        import mujoco

        self.mujoco: Any = mujoco
        # A setting that diverges is reported in our table; MuJoCo would write files
        # about it.
        mujoco.set_mju_user_warning(lambda text: None)
        self.task = task
        self.model = model = mujoco.MjModel.from_xml_string(_xml(task, settle, motors))
        model.body_invweight0[:] = mobility
        option, bits = model.opt, mujoco.mjtDisableBit
        option.integrator = getattr(mujoco.mjtIntegrator, f"mjINT_{integrator}")
        for name in ("CONTACT", "GRAVITY", "REFSAFE", "ISLAND", "AUTORESET"):
            option.disableflags |= getattr(bits, f"mjDSBL_{name}", 0)
        self.data = mujoco.MjData(model)
        self.star = model.body("s").id
        self.place = {name: int(model.joint(name).dofadr[0]) for name in JOINTS}
        self.drives = [self.place[f"g{k}"] for k in range(3)]
        self.sines = list(zip(self.drives, task.sines(), strict=True))

    def reset(self, steps: int) -> None:
        self.mujoco.mj_resetData(self.model, self.data)
        self.model.opt.timestep = 1.0 / steps

    def pose(self) -> Pose:
        self.mujoco.mj_kinematics(self.model, self.data)
        turned = self.data.xmat[self.star].reshape(3, 3)
        gamma = self.task.gamma + self.data.qpos[self.drives]
        return Pose(turned @ self.task.frames["s"], gamma)

    def acceleration(self, at: Moving) -> np.ndarray:
        mujoco, data = self.mujoco, self.data
        mujoco.mj_resetData(self.model, data)
        for name, place in self.place.items():
            data.qpos[place], data.qvel[place] = at.position[name], at.velocity[name]
        data.qfrc_applied[self.drives] = at.torque
        mujoco.mj_forward(self.model, data)
        return np.array(data.qacc[self.drives])


def _xml(task: Task, settle: float, motors: bool) -> str:
    text: dict[str, str] = {}
    children: dict[str, list[str]] = {}
    for body in list_bodies(task):
        six = body.about_centre[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]
        text[body.name] = (
            f'<body name="{body.name}"><inertial pos="{_numbers(body.centre)}"'
            f' mass="{body.mass}" fullinertia="{_numbers(six)}"/><joint'
            f' name="{body.joint}" type="hinge" axis="{_numbers(body.axis)}"/>'
        )
        children.setdefault(body.parent, []).append(body.name)

    def nested(name: str) -> str:
        return text[name] + "".join(map(nested, children.get(name, []))) + "</body>"

    ties = "".join(
        f'<connect body1="s" body2="{name}" anchor="{_numbers(point)}" solref="{settle}'
        ' 1" solimp="0.9999 0.9999 0.001"/>'
        for name, point in list_ties(task)
    )
    drives = "".join(f'<motor joint="g{k}"/>' for k in range(3)) if motors else ""
    return (
        '<mujoco><compiler angle="radian" balanceinertia="false" boundmass="0"/>'
        '<option gravity="0 0 0" solver="Newton" jacobian="dense"/>'
        f"<worldbody>{''.join(map(nested, children[BASE]))}</worldbody>"
        f"<equality>{ties}</equality><actuator>{drives}</actuator></mujoco>"
    )


def _numbers(values: Iterable[float]) -> str:
    return " ".join(f"{value:.17g}" for value in values)


model_of = cache(Model)


class Python(Engine):
    """Steps with torques by a callback in Python."""

    PYTHON, MOTORS = "the torques", False

    def __init__(
        self, task: Task, integrator: str, mobility: float, settle: float, steps: int
    ) -> None:
        self.model = model_of(task, integrator, mobility, settle, self.MOTORS)
        self.mujoco, self.steps = self.model.mujoco, steps
        self.prepare()

    def prepare(self) -> None:
        """Make what `run` needs besides the model."""

    def callback(self) -> Any:
        """Return what MuJoCo calls for the torques at the time of every evaluation."""
        rows, sin = [(at, *sine) for at, sine in self.model.sines], math.sin

        def torques(_: Any, data: Any) -> None:
            t, force = data.time, data.qfrc_applied
            for at, amplitude, frequency, phase in rows:
                force[at] = amplitude * sin(frequency * t + phase)

        return torques

    def run(self) -> None:
        self.model.reset(self.steps)
        self.mujoco.set_mjcb_control(self.callback())
        self.mujoco.mj_step(self.model.model, self.model.data, nstep=self.steps)
        self.mujoco.set_mjcb_control(None)

    def pose(self, end: None) -> Pose:
        if abs(self.model.data.time - DURATION) > 1e-6:
            raise Failed(f"ended at {self.model.data.time:.3f} s: it reset itself")
        return self.model.pose()


class Compiled(Python):
    """The same in C."""

    PYTHON = "nowhere"

    def prepare(self) -> None:
        self.library, self.function = _compile(tuple(self.model.sines))
        # In mjData the energies follow the time; make sure of it.
        data = self.model.data
        self.address = int(data.energy.ctypes.data) - 8
        data.time = 0.123456789
        if ctypes.c_double.from_address(self.address).value != 0.123456789:
            raise RuntimeError(
                "this MuJoCo keeps the time elsewhere: no compiled callback"
            )
        self.force = int(data.qfrc_applied.ctypes.data)

    def callback(self) -> Any:
        for name, address in (("t", self.address), ("force", self.force)):
            ctypes.c_void_p.in_dll(self.library, name).value = address
        return self.function


@cache
def _compile(
    sines: tuple[tuple[int, tuple[float, float, float]], ...],
) -> tuple[Any, Any]:
    """Return the library of the callback, and its function."""
    if not c_floor.has_gcc():
        raise Failed("there is no gcc")
    lines = [
        f"force[{at}] = {a!r} * sin({f!r} * *t + {s!r});" for at, (a, f, s) in sines
    ]
    with tempfile.TemporaryDirectory() as folder:
        text = CALLBACK.format(lines="\n".join(lines))
        library, _ = c_floor.compile_c(text, Path(folder), "torques", "-O3")
    kind = ctypes.CFUNCTYPE(None, ctypes.c_void_p, ctypes.c_void_p)
    return library, kind(("torques", library))


class Rollout(Python):
    """MuJoCo's own loop over a table of torques."""

    PYTHON, MOTORS = "nowhere", True

    def __init__(
        self, task: Task, integrator: str, mobility: float, settle: float, steps: int,
        copies: int = 1, threads: int = 1,
    ) -> None:  # fmt: skip
        from mujoco import rollout

        super().__init__(task, integrator, mobility, settle, steps)
        model, data = self.model.model, self.model.data
        middles = (np.arange(steps) + 0.5) * (DURATION / steps)
        controls = np.array([task.torque_at(t) for t in middles])[None].repeat(
            copies, axis=0
        )
        self.model.reset(steps)
        self.kind = self.mujoco.mjtState.mjSTATE_FULLPHYSICS
        start = np.zeros(self.mujoco.mj_stateSize(model, self.kind))
        self.mujoco.mj_getState(model, data, start, self.kind)
        self.states = np.empty((copies, steps, len(start)))
        own = (
            data
            if threads == 1
            else [self.mujoco.MjData(model) for _ in range(threads)]
        )
        self.rollout = partial(
            rollout.rollout,
            model,
            own,
            start[None].repeat(copies, axis=0),
            controls,
            nstep=steps,
            state=self.states,
            sensordata=np.empty((copies, steps, 0)),
        )

    def run(self) -> None:
        self.model.reset(self.steps)
        self.rollout()

    def pose(self, end: None) -> Pose:
        data = self.model.data
        self.mujoco.mj_setState(self.model.model, data, self.states[0, -1], self.kind)
        return super().pose(end)
