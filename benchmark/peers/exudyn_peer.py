# SPDX-License-Identifier: Apache-2.0
"""Exudyn: redundant coordinates, generalised-alpha and the index-2 trapezoidal rule.

Seven rigid bodies in Euler parameters; hinges of five conditions, ties of the two that are
independent, so that the equations are not singular. Torques come from a symbolic user function,
which Exudyn evaluates in C++ without Python.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from benchmark.peers.study import Engine, Failed, Series, list_steps
from benchmark.peers.task import BASE, DURATION, Moving, Pose, Task, list_bodies, list_ties

ENGINE, PACKAGE = "Exudyn", "exudyn"
TOLERANCE = 1e-4
GATE_STEP = 1e-5


def series(task: Task, quick: bool) -> list[Series]:
    """Two implicit methods; the acceleration is the change of rate over steps of 10 us."""
    found = []
    for name, kind, radius in (
        ("generalised-alpha, index 3", "GeneralizedAlpha", 0.9),
        ("trapezoidal, index 2", "TrapezoidalIndex2", 1.0),
    ):
        make = partial(_Model, task, kind, radius)
        settings = list_steps(40, 1000 if quick else 8000, 2.0, make)
        gate = partial(_find_acceleration, task, kind, radius)
        found.append(Series(ENGINE, name, "nowhere", TOLERANCE, gate, settings))
    return found


class _Model(Engine):
    """The mechanism at a state, at rest at the start by default."""

    def __init__(
        self, task: Task, kind: str, radius: float, steps: int, at: Moving | None = None
    ) -> None:
        import exudyn

        self.exudyn: Any = exudyn
        self.task, self.kind, self.radius, self.steps = task, kind, radius, steps
        self.system = exudyn.SystemContainer()
        self.mbs: Any = self.system.AddSystem()
        self.nodes: dict[str, Any] = {}
        self._add_bodies(at)
        self._add_joints()
        self._add_torques()
        self.mbs.Assemble()
        self.settings = self._settings()

    def _add_bodies(self, at: Moving | None) -> None:
        import exudyn.itemInterface as items
        from exudyn.rigidBodyUtilities import AngularVelocity2EulerParameters_t as rates_of
        from exudyn.rigidBodyUtilities import RotationMatrix2EulerParameters as parameters_of

        self.bodies = {BASE: self.mbs.AddObject(items.ObjectGround())}
        placed = {BASE: (np.eye(3), np.zeros(3))}
        for body in list_bodies(self.task):
            above, spin = placed[body.parent]
            angle = at.position[body.joint] if at else 0.0
            rate = at.velocity[body.joint] if at else 0.0
            rotation = above @ Rotation.from_rotvec(angle * body.axis).as_matrix()
            omega = spin + rate * (above @ body.axis)
            placed[body.name] = rotation, omega
            parameters = np.array(parameters_of(rotation))
            node = self.mbs.AddNode(items.NodeRigidBodyEP(
                referenceCoordinates=[0.0, 0.0, 0.0, *parameters],
                initialVelocities=[0.0, 0.0, 0.0, *rates_of(omega, parameters)],
            ))  # fmt: skip
            self.nodes[body.name] = node
            tensor = body.about_o
            # Centre of mass at O: Exudyn needs no mobility, and O does not move.
            self.bodies[body.name] = self.mbs.AddObject(items.ObjectRigidBody(
                mass=body.mass, nodeNumber=node,
                inertia=tensor[[0, 1, 2, 1, 0, 0], [0, 1, 2, 2, 2, 1]].tolist(),
            ))  # fmt: skip

    def _add_joints(self) -> None:
        import exudyn.itemInterface as items

        def tie(first: str, second: str, axis: np.ndarray, axes: list[int], at: Any) -> None:
            across = _frame(axis)
            markers = [
                self.mbs.AddMarker(
                    items.MarkerBodyRigid(bodyNumber=self.bodies[name], localPosition=list(at))
                )
                for name in (first, second)
            ]
            self.mbs.AddObject(items.ObjectJointGeneric(
                markerNumbers=markers, constrainedAxes=axes, rotationMarker0=across,
                rotationMarker1=across,
            ))  # fmt: skip

        for body in list_bodies(self.task):
            tie(body.parent, body.name, body.axis, [1, 1, 1, 1, 1, 0], np.zeros(3))
        for name, point in list_ties(self.task):
            tie("s", name, point, [1, 1, 0, 0, 0, 0], point)

    def _add_torques(self) -> None:
        import exudyn.itemInterface as items
        from exudyn.utilities import CreateSymbolicUserFunction

        # Exudyn does not keep them alive.
        self.functions: list[Any] = []

        def torque(amplitude: float, frequency: float, phase: float) -> Any:
            # Exudyn runs this once on symbols and evaluates the record in C++.
            sin = self.exudyn.symbolic.sin
            return lambda mbs, t, load: amplitude * sin(frequency * t + phase) * load

        for k, sine in enumerate(self.task.sines()):
            marker = self.mbs.AddMarker(
                items.MarkerBodyRigid(bodyNumber=self.bodies[f"a{k}"], localPosition=[0, 0, 0])
            )

            axis = [float(part) for part in self.task.w[k]]
            number = self.mbs.AddLoad(items.LoadTorqueVector(markerNumber=marker, loadVector=axis))
            function = CreateSymbolicUserFunction(
                self.mbs, torque(*sine), itemTypeName="LoadTorqueVector",
                userFunctionName="loadVectorUserFunction",
            )  # fmt: skip
            self.functions.append(function)
            self.mbs.SetLoadParameter(number, "loadVectorUserFunction", function)

    def _settings(self) -> Any:
        settings = self.exudyn.SimulationSettings()
        settings.solutionSettings.writeSolutionToFile = False
        settings.solutionSettings.sensorsWritePeriod = 10.0
        time = settings.timeIntegration
        time.verboseMode = 0
        time.newton.useModifiedNewton = True
        time.newton.relativeTolerance, time.newton.absoluteTolerance = 1e-11, 1e-12
        time.generalizedAlpha.computeInitialAccelerations = True
        time.generalizedAlpha.spectralRadius = self.radius
        if self.kind == "TrapezoidalIndex2":
            time.generalizedAlpha.useIndex2Constraints = True
            time.generalizedAlpha.useNewmark = True
        settings.displayStatistics = False
        return settings

    def run(self) -> None:
        self.solve(0.0, DURATION, self.steps)

    def solve(self, begin: float, end: float, steps: int) -> None:
        time = self.settings.timeIntegration
        time.startTime, time.endTime, time.numberOfSteps = begin, end, steps
        done = self.mbs.SolveDynamic(
            self.settings, solverType=getattr(self.exudyn.DynamicSolverType, self.kind),
            updateInitialValues=False, showHints=False, autoAssemble=False,
        )  # fmt: skip
        if done is False:
            raise Failed("its Newton iteration does not converge")

    def output(self, name: str, what: str) -> np.ndarray:
        variable = getattr(self.exudyn.OutputVariableType, what)
        return np.array(self.mbs.GetNodeOutput(self.nodes[name], variable))

    def pose(self, end: None) -> Pose:
        task, gamma = self.task, []
        for k in range(3):
            moved = self.output(f"a{k}", "RotationMatrix").reshape(3, 3) @ task.r[k]
            across = np.cross(task.w[k], task.r[k])
            gamma.append(task.gamma[k] + np.arctan2(moved @ across, moved @ task.r[k]))
        turned = self.output("s", "RotationMatrix").reshape(3, 3)
        return Pose(turned @ task.frames["s"], np.array(gamma))


def _find_acceleration(task: Task, kind: str, radius: float, at: Moving) -> np.ndarray:
    model = _Model(task, kind, radius, 4, at)
    before = np.array([at.velocity[f"g{k}"] for k in range(3)])
    model.solve(at.time, at.time + GATE_STEP, 4)
    after = np.array([task.w[k] @ model.output(f"a{k}", "AngularVelocity") for k in range(3)])
    return task.at_once(at, (after - before) / GATE_STEP, 0.0, GATE_STEP)


def _frame(axis: np.ndarray) -> np.ndarray:
    """A rotation whose third column is the axis."""
    other = np.eye(3)[np.argmin(np.abs(axis))]
    first = np.cross(other, axis)
    first /= np.linalg.norm(first)
    return np.stack([first, np.cross(axis, first), axis], axis=1)
