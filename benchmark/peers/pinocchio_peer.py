# SPDX-License-Identifier: Apache-2.0
"""Pinocchio: constrained forward dynamics in C++, Runge-Kutta loops in Python and in
C++.

The loop in C++ is pinocchio_loop.cpp, compiled against the headers that come with `pin`
and those of Eigen (cmeel-eigen from PyPI, or Debian's libeigen3-dev).

A point tie has three rows of rank two, so the proximal steps matter: mu 0.1 and five of
them give the right acceleration to 1e-11 at the least cost.
"""

from __future__ import annotations

import ctypes
import math
import shutil
import subprocess
import sys
import tempfile
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np

from benchmark.peers.study import Engine, Failed, Series, list_steps
from benchmark.peers.task import (
    BASE,
    DURATION,
    Moving,
    Pose,
    Task,
    list_bodies,
    list_ties,
)
from sst_ros.integration.methods import DOP853, RK4, Tableau

ENGINE, PACKAGE = "Pinocchio", "pin"
MU, ITERATIONS = 0.1, 5


SOURCE = Path(__file__).with_name("pinocchio_loop.cpp")
EIGEN = Path("/usr/include/eigen3")
"""Headers of Debian's package, where there are none beside those of `pin`."""

FLAGS = (
    "-std=c++17",
    "-O3",
    "-DNDEBUG",
    "-DPINOCCHIO_ENABLE_TEMPLATE_INSTANTIATION",
    "-DBOOST_MPL_LIMIT_LIST_SIZE=30",
    "-DBOOST_MPL_LIMIT_VECTOR_SIZE=30",
    "-DBOOST_MPL_CFG_NO_PREPROCESSED_HEADERS",
    "-DBOOST_FUSION_INVOKE_MAX_ARITY=12",
    "-w",
)
"""As its CMake files ask. The algorithms are those of its library, whose arrays are
aligned as on any x86-64: with -march=native they would not be."""

LONGEST_BUILD_S = 900.0


def series(task: Task, quick: bool) -> list[Series]:
    """RK4 and DOP853 in a Python loop, and in C++ where it can be compiled."""
    model, factor = Model(task), 1.6 if quick else 1.2
    found, python = [], "the steps and the torques"
    for name, method, first, last in (
        ("RK4", RK4, 10, 1600),
        ("DOP853", DOP853, 5, 100),
    ):
        settings = list_steps(first, last, factor, partial(_Steps, model, method))
        name = f"{name} in a Python loop"
        found.append(Series(ENGINE, name, python, 1e-10, model.acceleration, settings))
    library = compile_loop()
    if library is None:
        return found
    loop = Loop(library, model)
    for name, method, first, last in (
        ("RK4", RK4, 10, 1600),
        ("DOP853", DOP853, 5, 100),
    ):
        settings = list_steps(first, last, factor, partial(_Compiled, loop, method))
        name = f"{name} in a C++ loop"
        found.append(
            Series(ENGINE, name, "nowhere", 1e-10, loop.acceleration, settings)
        )
    return found


@cache
def compile_loop() -> ctypes.CDLL | None:
    """Compile the loop in C++, which takes minutes; None where it cannot be."""
    import pinocchio as pin

    prefix = next(
        (path for path in Path(pin.__file__).parents if (path / "include").is_dir()),
        None,
    )
    headers = [] if prefix is None else [prefix / "include", prefix / "include/eigen3"]
    headers.append(EIGEN)
    eigen = any((folder / "Eigen/Core").exists() for folder in headers)
    if prefix is None or not eigen or shutil.which("g++") is None:
        print("no g++ or headers of Eigen: Pinocchio by Python alone", file=sys.stderr)
        return None
    with tempfile.TemporaryDirectory() as folder:
        library = Path(folder) / "pinocchio_loop.so"
        places = [f"-I{header}" for header in headers if header.is_dir()]
        libraries = [
            f"-L{prefix}/lib",
            "-lpinocchio_default",
            f"-Wl,-rpath,{prefix}/lib",
        ]
        words = ["g++", *FLAGS, *places, "-shared", "-fPIC", "-o", str(library)]
        subprocess.run(
            [*words, str(SOURCE), *libraries], check=True, timeout=LONGEST_BUILD_S
        )
        return ctypes.CDLL(str(library))


class Loop:
    """The mechanism in C++, and what calls it."""

    def __init__(self, library: ctypes.CDLL, model: Model) -> None:
        self.model, task = model, model.task
        self.drives = np.array(model.drives, dtype=np.int64)
        self.sines = np.array(task.sines())
        bodies, ties = list_bodies(task), list_ties(task)
        numbers = {body.name: 1 + i for i, body in enumerate(bodies)}
        numbers[BASE] = 0
        parents = np.array([numbers[body.parent] for body in bodies], dtype=np.int64)
        pairs = np.array([[numbers["s"], numbers[name]] for name, _ in ties])
        library.make.restype = ctypes.c_void_p
        self._library = library
        self._engine = ctypes.c_void_p(
            library.make(
                ctypes.c_long(len(bodies)),
                _pointer(parents),
                _pointer(np.array([body.axis for body in bodies])),
                _pointer(np.array([body.mass for body in bodies])),
                _pointer(np.array([body.centre for body in bodies])),
                _pointer(np.array([body.about_centre for body in bodies])),
                ctypes.c_long(len(ties)),
                _pointer(pairs),
                _pointer(np.array([point for _, point in ties])),
                ctypes.c_double(MU),
                ctypes.c_long(ITERATIONS),
            )
        )

    def acceleration(self, at: Moving) -> np.ndarray:
        q, v, force, result = np.zeros((4, self.model.model.nv))
        for name, place in self.model.place.items():
            q[place], v[place] = at.position[name], at.velocity[name]
        force[self.drives] = at.torque
        arrays = (_pointer(array) for array in (q, v, force, result))
        self._library.accelerate(self._engine, *arrays)
        answer: np.ndarray = result[self.drives]
        return answer

    def run(self, method: Tableau, steps: int) -> np.ndarray:
        """Do the second by steps of a method; return (q, v)."""
        stages = len(method.c)
        rows = [[*row, *(0.0,) * (stages - len(row))] for row in method.a]
        x = np.zeros(2 * self.model.model.nv)
        self._library.run(
            self._engine,
            ctypes.c_long(stages),
            _pointer(np.array(rows)),
            _pointer(np.array(method.b)),
            _pointer(np.array(method.c)),
            ctypes.c_long(steps),
            ctypes.c_double(DURATION),
            _pointer(self.drives),
            _pointer(self.sines),
            _pointer(x),
        )
        return x


def _pointer(array: np.ndarray) -> ctypes.c_void_p:
    """Return the address of an array, which lives as long as the pointer."""
    array = np.ascontiguousarray(array)
    pointer = ctypes.c_void_p(array.ctypes.data)
    pointer.array = array  # type: ignore[attr-defined]
    return pointer


class Model:
    """The tree with its ties; joint coordinates are differences to the start."""

    def __init__(self, task: Task) -> None:
        import pinocchio as pin

        self.pin: Any = pin
        self.task = task
        self.model = model = pin.Model()
        model.gravity = pin.Motion.Zero()
        still = pin.SE3.Identity()
        self.joints: dict[str, int] = {}
        at_body = {BASE: 0}
        for body in list_bodies(task):
            hinge = pin.JointModelRevoluteUnaligned(body.axis)
            index = model.addJoint(at_body[body.parent], hinge, still, body.joint)
            inertia = pin.Inertia(body.mass, body.centre, body.about_centre)
            model.appendBodyToJoint(index, inertia, still)
            at_body[body.name] = self.joints[body.joint] = index
        self.ties, self.tied = (
            pin.StdVec_RigidConstraintModel(),
            pin.StdVec_RigidConstraintData(),
        )
        for name, point in list_ties(task):
            place = pin.SE3(np.eye(3), point)
            tie = pin.RigidConstraintModel(
                pin.ContactType.CONTACT_3D,
                model,
                at_body["s"],
                place,
                at_body[name],
                place,
            )
            self.ties.append(tie)
            self.tied.append(tie.createData())
        self.data = model.createData()
        try:
            pin.initConstraintDynamics(model, self.data, self.ties, self.tied)
        except TypeError:  # before Pinocchio 4
            pin.initConstraintDynamics(model, self.data, self.ties)
        self.proximal = pin.ProximalSettings(1e-16, MU, ITERATIONS)
        self.place = {
            name: model.joints[index].idx_v for name, index in self.joints.items()
        }
        self.drives = [self.place[f"g{k}"] for k in range(3)]

    def acceleration(self, at: Moving) -> np.ndarray:
        q, v, force = np.zeros((3, self.model.nv))
        for name, place in self.place.items():
            q[place], v[place] = at.position[name], at.velocity[name]
        force[self.drives] = at.torque
        found = self.pin.constraintDynamics(
            self.model, self.data, q, v, force, self.ties, self.tied, self.proximal
        )
        return np.array(found[self.drives])

    def pose(self, x: np.ndarray) -> Pose:
        if not np.all(np.isfinite(x)):
            raise Failed("not finite")
        self.pin.forwardKinematics(self.model, self.data, x[: self.model.nv])
        turned = self.data.oMi[self.joints["b0"]].rotation
        return Pose(turned @ self.task.frames["s"], self.task.gamma + x[self.drives])


class _Steps(Engine):
    """A Runge-Kutta method, as lean as Python and NumPy allow.

    Stages are rows of one array, all views are made once, a stage is one product. The
    state is x = (q, v).
    """

    def __init__(self, model: Model, method: Tableau, steps: int) -> None:
        self.pose = model.pose
        n, h = model.model.nv, DURATION / steps
        force, at, k = np.zeros(n), np.zeros(2 * n), np.zeros((len(method.c), 2 * n))
        work = [
            (h * c, h * np.array(row), k[:i], k[i, :n], k[i, n:])
            for i, (c, row) in enumerate(zip(method.c, method.a, strict=True))
        ]
        self._given = model, steps, force, at, work, h * np.array(method.b), k

    def run(self) -> np.ndarray:
        model, steps, force, at, work, final, k = self._given
        dynamics, sin, dot = model.pin.constraintDynamics, math.sin, np.dot
        mechanism, data, ties, tied = model.model, model.data, model.ties, model.tied
        (p0, p1, p2), proximal, n = model.drives, model.proximal, mechanism.nv
        (a0, f0, s0), (a1, f1, s1), (a2, f2, s2) = model.task.sines()
        q, v, x = at[:n], at[n:], np.zeros(2 * n)
        for i in range(steps):
            begin = i * (DURATION / steps)
            for later, weight, earlier, rate, change in work:
                if len(weight):
                    dot(weight, earlier, at)
                    at.__iadd__(x)
                else:
                    at[:] = x
                t = begin + later
                force[p0] = a0 * sin(f0 * t + s0)
                force[p1] = a1 * sin(f1 * t + s1)
                force[p2] = a2 * sin(f2 * t + s2)
                rate[:] = v
                change[:] = dynamics(mechanism, data, q, v, force, ties, tied, proximal)
            x += dot(final, k)
        return x


class _Compiled(Engine):
    """The same in C++."""

    def __init__(self, loop: Loop, method: Tableau, steps: int) -> None:
        self.pose = loop.model.pose
        self.run = partial(loop.run, method, steps)
