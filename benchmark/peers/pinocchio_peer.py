# SPDX-License-Identifier: Apache-2.0
"""Pinocchio: constrained forward dynamics in C++, the Runge-Kutta loop in Python.

A point tie has three rows of rank two, so the proximal steps matter: mu 0.1 and five of
them give the right acceleration to 1e-11 at the least cost.
"""

from __future__ import annotations

import math
from functools import partial
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


def series(task: Task, quick: bool) -> list[Series]:
    """RK4 and DOP853 in a Python loop."""
    model, factor = Model(task), 1.6 if quick else 1.2
    found, python = [], "the steps and the torques"
    for name, method, first, last in (
        ("RK4", RK4, 10, 1600),
        ("DOP853", DOP853, 5, 100),
    ):
        settings = list_steps(first, last, factor, partial(_Steps, model, method))
        name = f"{name} in a Python loop"
        found.append(Series(ENGINE, name, python, 1e-10, model.acceleration, settings))
    return found


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
