# SPDX-License-Identifier: Apache-2.0
"""Drake: its discrete multibody solver (SAP), the only one of its own that closes loops.

Torques come from Drake's own Sine source, so nothing of Python is in the loop; the solver holds
them over a step and is of order 1, whatever the step.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np

from benchmark.peers.study import Engine, Series, list_steps
from benchmark.peers.task import BASE, DURATION, Moving, Pose, Task, list_bodies, list_ties

ENGINE, PACKAGE = "Drake", "drake"
GATE_STEP, SETTLED, TOLERANCE = 1e-6, 300, 1e-3


def series(task: Task, quick: bool) -> list[Series]:
    """SAP at several steps.

    Its ties are soft over some tens of steps, so its acceleration is the change of rate over the
    300 steps of 1 us after the first 300.
    """
    settings = list_steps(100, 6400 if quick else 20000, 2.0, partial(_Model, task))
    gate = _Model(task, round(1.0 / GATE_STEP))
    return [Series(ENGINE, "SAP, discrete", "nowhere", TOLERANCE, gate.acceleration, settings)]


class _Model(Engine):
    def __init__(self, task: Task, steps: int) -> None:
        from pydrake.multibody.plant import DiscreteContactApproximation, MultibodyPlant
        from pydrake.multibody.tree import (
            RevoluteJoint,
            RotationalInertia,
            SpatialInertia,
            UnitInertia,
        )
        from pydrake.systems.analysis import Simulator
        from pydrake.systems.framework import DiagramBuilder
        from pydrake.systems.primitives import Sine

        self.task, self.steps = task, steps
        builder: Any = DiagramBuilder()
        self.plant = plant = builder.AddSystem(MultibodyPlant(1.0 / steps))
        plant.set_discrete_contact_approximation(DiscreteContactApproximation.kSap)
        plant.mutable_gravity_field().set_gravity_vector(np.zeros(3))
        at_body = {BASE: plant.world_body()}
        self.joints, drives = {}, []
        for body in list_bodies(task):
            unit = UnitInertia()
            about = body.about_o / body.mass
            unit.SetFromRotationalInertia(
                RotationalInertia(*about[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]), 1.0
            )
            inertia = SpatialInertia(body.mass, body.centre, unit)
            at_body[body.name] = plant.AddRigidBody(body.name, inertia)
            parent, child = at_body[body.parent], at_body[body.name]
            hinge = RevoluteJoint(body.joint, parent.body_frame(), child.body_frame(), body.axis)
            self.joints[body.joint] = joint = plant.AddJoint(hinge)
            if body.joint.startswith("g"):
                drives.append(plant.AddJointActuator(body.joint, joint))
        for name, point in list_ties(task):
            plant.AddBallConstraint(at_body["s"], point, at_body[name], point)
        plant.Finalize()
        amplitude, frequency, phase = (np.array(row) for row in zip(*task.sines(), strict=True))
        torques = builder.AddSystem(Sine(amplitude, frequency, phase, True))
        builder.Connect(torques.get_output_port(0), plant.get_actuation_input_port())
        self.simulator = Simulator(builder.Build())
        self.context = self.simulator.get_mutable_context()
        self.inner = plant.GetMyMutableContextFromRoot(self.context)
        self.star = at_body["s"]

    def start(self, time: float = 0.0, at: Moving | None = None) -> None:
        for name, joint in self.joints.items():
            joint.set_angle(self.inner, at.position[name] if at else 0.0)
            joint.set_angular_rate(self.inner, at.velocity[name] if at else 0.0)
        self.context.SetTime(time)
        self.simulator.Initialize()

    def acceleration(self, at: Moving) -> np.ndarray:
        self.start(at.time, at)
        rates = []
        for steps in (SETTLED, 2 * SETTLED):
            self.simulator.AdvanceTo(at.time + (steps + 0.5) * GATE_STEP)
            rates.append([self.joints[f"g{k}"].get_angular_rate(self.inner) for k in range(3)])
        mean = (np.array(rates[1]) - rates[0]) / (SETTLED * GATE_STEP)
        return self.task.at_once(at, mean, SETTLED * GATE_STEP, 2 * SETTLED * GATE_STEP)

    def run(self) -> None:
        self.start()
        # Half a step more: the last update is sure to be in, and the next is not.
        self.simulator.AdvanceTo(DURATION + 0.5 / self.steps)

    def pose(self, end: None) -> Pose:
        turned = self.plant.EvalBodyPoseInWorld(self.inner, self.star).rotation().matrix()
        turn = np.array([self.joints[f"g{k}"].get_angle(self.inner) for k in range(3)])
        return Pose(turned @ self.task.frames["s"], self.task.gamma + turn)
