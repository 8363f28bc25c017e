# SPDX-License-Identifier: Apache-2.0
"""MuJoCo: equality constraints; its integrators, softness and time steps swept.

Torques reach it in three ways: by a compiled callback (nothing of Python in the loop, exact times
at all stages), by a Python callback (the same times), and by `rollout` with a table of torques
held over each step (their values at its middle, which makes any integrator of order 2 at most).

Its ties are soft: their softness is (1 - d)/d times the mobility it keeps in body_invweight0, with
d at most 0.9999. Where the centres of mass are decides that mobility; here it is set outright and
swept, so that MuJoCo gets the best compromise between too soft and too stiff for its steps.
"""

from __future__ import annotations

import ctypes
import math
from collections.abc import Callable, Iterable
from functools import cache
from typing import Any

import numpy as np

from benchmark.peers.study import Failed, Run, Series, Setting, make_ladder
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
        self, task: Task, integrator: str, mobility: float, settle: float, motors: bool = False
    ) -> None:
        import mujoco

        self.mujoco: Any = mujoco
        # A setting that diverges is reported in our table; MuJoCo would write files about it.
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


def python_callback(model: Model) -> Callable[[Any, Any], None]:
    """Torques at the time of every evaluation, by Python."""
    rows = [(at, *sine) for at, sine in zip(model.drives, model.task.sines(), strict=True)]
    sin = math.sin

    def callback(_: Any, data: Any) -> None:
        t, force = data.time, data.qfrc_applied
        for at, amplitude, frequency, phase in rows:
            force[at] = amplitude * sin(frequency * t + phase)

    return callback


class NativeCallback:
    """The same compiled by numba, as a C function pointer that MuJoCo calls itself.

    MuJoCo hands no user data to a callback, so the addresses of the time and of the force that it
    reads and writes are kept in a small table, which `aim` fills.
    """

    def __init__(self, model: Model) -> None:
        import numba
        from numba import types
        from numba.np.numpy_support import carray

        self._table = np.zeros(2, dtype=np.int64)
        table = int(self._table.ctypes.data)
        words, doubles = _pointer(types.int64), _pointer(types.float64)
        (p0, p1, p2), sines = model.drives, tuple(model.task.sines())
        (a0, f0, s0), (a1, f1, s1), (a2, f2, s2) = sines

        @numba.cfunc(types.void(types.intp, types.intp))
        def callback(_model: Any, _data: Any) -> None:
            addresses = carray(words(table), 2)
            t = carray(doubles(addresses[0]), 1)[0]
            force = carray(doubles(addresses[1]), 7)
            force[p0] = a0 * math.sin(f0 * t + s0)
            force[p1] = a1 * math.sin(f1 * t + s1)
            force[p2] = a2 * math.sin(f2 * t + s2)

        self._kept = callback
        assert callback.address is not None
        kind = ctypes.CFUNCTYPE(None, ctypes.c_void_p, ctypes.c_void_p)
        self.function = kind(callback.address)

    def aim(self, model: Model) -> None:
        """Work on this model's data from now on."""
        data = model.data
        # In mjData the energies follow the time; make sure of it.
        address = int(data.energy.ctypes.data) - 8
        kept, data.time = data.time, 0.123456789
        found = ctypes.c_double.from_address(address).value
        data.time = kept
        if found != 0.123456789:
            raise RuntimeError("this MuJoCo keeps the time elsewhere: no native callback")
        self._table[:] = address, data.qfrc_applied.ctypes.data


def _pointer(kind: Any) -> Any:
    """A function for compiled code: address -> pointer to numbers of that kind."""
    import numba
    from numba.extending import intrinsic

    types: Any = numba.types

    @intrinsic
    def pointer(_context: Any, address: Any) -> Any:
        signature = types.CPointer(kind)(types.int64)

        def generate(context: Any, builder: Any, signature: Any, values: Any) -> Any:
            return builder.inttoptr(values[0], context.get_value_type(signature.return_type))

        return signature, generate

    return pointer


def _xml(task: Task, settle: float, motors: bool) -> str:
    text: dict[str, str] = {}
    children: dict[str, list[str]] = {}
    for body in list_bodies(task):
        six = body.about_centre[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]
        text[body.name] = (
            f'<body name="{body.name}"><inertial pos="{_numbers(body.centre)}" mass="{body.mass}"'
            f' fullinertia="{_numbers(six)}"/>'
            f'<joint name="{body.joint}" type="hinge" axis="{_numbers(body.axis)}"/>'
        )
        children.setdefault(body.parent, []).append(body.name)

    def nested(name: str) -> str:
        return text[name] + "".join(map(nested, children.get(name, []))) + "</body>"

    ties = "".join(
        f'<connect body1="s" body2="{name}" anchor="{_numbers(point)}" solref="{settle} 1"'
        ' solimp="0.9999 0.9999 0.001"/>'
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
