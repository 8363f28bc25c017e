# SPDX-License-Identifier: Apache-2.0
"""Pinocchio: constrained forward dynamics in C++, the Runge-Kutta loop in Python.

A point tie has three rows of rank two, so the proximal steps matter: mu 0.1 and five of them give
the right acceleration to 1e-11 at the least cost.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np

from benchmark.peers.study import Failed, Run, Series, Setting, make_ladder
from benchmark.peers.task import BASE, DURATION, Moving, Pose, Task, list_bodies, list_ties
from sst_ros.integration.methods import DOP853, RK4, Tableau

ENGINE, PACKAGE = "Pinocchio", "pin"
MU, ITERATIONS = 0.1, 5


def series(task: Task, quick: bool) -> list[Series]:
    """RK4 and DOP853 in a Python loop."""
    model = Model(task)
    factor = 1.6 if quick else 1.2
    rows = (("RK4", RK4, 10, 1600), ("DOP853", DOP853, 5, 100))
    found, python = [], "the steps and the torques"
    for name, method, first, last in rows:
        settings = [model.setting(method, n) for n in make_ladder(first, last, factor)]
        name = f"{name} in a Python loop"
        found.append(Series(ENGINE, name, python, 1e-10, model.acceleration, settings))
    return found


class Model:
    """The tree with its ties; joint coordinates are differences to the start."""

    def __init__(self, task: Task) -> None:
        import pinocchio as pin

        self.pin: Any = pin
        self.task = task
        self.sines = task.sines()
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
        self.ties, self.tied = pin.StdVec_RigidConstraintModel(), pin.StdVec_RigidConstraintData()
        for name, point in list_ties(task):
            place = pin.SE3(np.eye(3), point)
            tie = pin.RigidConstraintModel(
                pin.ContactType.CONTACT_3D, model, at_body["s"], place, at_body[name], place
            )
            self.ties.append(tie)
            self.tied.append(tie.createData())
        self.data = model.createData()
        try:
            pin.initConstraintDynamics(model, self.data, self.ties, self.tied)
        except TypeError:  # before Pinocchio 4
            pin.initConstraintDynamics(model, self.data, self.ties)
        self.proximal = pin.ProximalSettings(1e-16, MU, ITERATIONS)
        self.place = {name: model.joints[index].idx_v for name, index in self.joints.items()}
        self.drives = [self.place[f"g{k}"] for k in range(3)]

    def marcher(self, method: Tableau) -> Callable[[float, float, int, np.ndarray], None]:
        """march(t0, h, count, x) in place, x = (q, v): as lean as Python and NumPy allow.

        Stages are rows of one array, all views are made once, a stage is one product.
        """
        dynamics, sin, dot = self.pin.constraintDynamics, math.sin, np.dot
        model, data, ties, tied = self.model, self.data, self.ties, self.tied
        proximal, n = self.proximal, self.model.nv
        (p0, p1, p2), sines = self.drives, self.sines
        (a0, f0, s0), (a1, f1, s1), (a2, f2, s2) = sines
        force, at, k = np.zeros(n), np.zeros(2 * n), np.zeros((len(method.c), 2 * n))
        q, v = at[:n], at[n:]
        rows = [np.array(row) for row in method.a]
        last = np.array(method.b)
        stages = [(k[:i], k[i, :n], k[i, n:]) for i in range(len(method.c))]

        def march(t0: float, h: float, count: int, x: np.ndarray) -> None:
            weights = [h * row for row in rows]
            final = h * last
            work = [(h * c, w, *views)
                    for c, w, views in zip(method.c, weights, stages, strict=True)]  # fmt: skip
            for i in range(count):
                begin = t0 + i * h
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
                    change[:] = dynamics(model, data, q, v, force, ties, tied, proximal)
                x += dot(final, k)

        return march

    def acceleration(self, at: Moving) -> np.ndarray:
        q, v, force = np.zeros((3, self.model.nv))
        for name, place in self.place.items():
            q[place], v[place] = at.position[name], at.velocity[name]
        force[self.drives] = at.torque
        found = self.pin.constraintDynamics(
            self.model, self.data, q, v, force, self.ties, self.tied, self.proximal
        )
        return np.array(found[self.drives])

    def setting(self, method: Tableau, steps: int) -> Setting:
        def prepare() -> Run:
            march = self.marcher(method)

            def whole() -> np.ndarray:
                x = np.zeros(2 * self.model.nv)
                march(0.0, DURATION / steps, steps, x)
                return x

            def poses(pieces: int) -> list[Pose]:
                x, found = np.zeros(2 * self.model.nv), []
                for piece in range(pieces):
                    begin = piece * DURATION / pieces
                    march(begin, DURATION / steps, steps // pieces, x)
                    found.append(self.pose(x))
                return found

            return Run(whole, poses)

        return Setting(f"{steps} steps", steps, prepare)

    def pose(self, x: np.ndarray) -> Pose:
        if not np.all(np.isfinite(x)):
            raise Failed("not finite")
        self.pin.forwardKinematics(self.model, self.data, x[: self.model.nv])
        turned = self.data.oMi[self.joints["b0"]].rotation
        return Pose(turned @ self.task.frames["s"], self.task.gamma + x[self.drives])
