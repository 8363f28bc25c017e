# SPDX-License-Identifier: Apache-2.0
"""Drake on the same second, in an environment of its own: it wants Python 3.12.

python -m benchmark.peers.drake_apart write task.json   where sst_ros is installed
python benchmark/peers/drake_apart.py run task.json     where Drake is installed

CENIC is Drake's integrator with error control, which closes loops by ball constraints;
its discrete solver takes fixed steps. Torques come from a system in Python.
"""

import json
import math
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

ACCURACIES = (1e-1, 1e-2, 1e-3, 1e-4, 1e-5, 1e-6, 1e-7, 1e-8)
STEPS = (1000, 10_000)
"""Of the discrete solver."""


def write(path: str) -> None:
    """Write the task and its reference as JSON."""
    from benchmark.peers.study import solve_task
    from benchmark.peers.task import Task, list_bodies, list_ties

    task = Task()
    bodies = [
        {
            "name": body.name,
            "parent": body.parent,
            "joint": body.joint,
            "axis": body.axis.tolist(),
            "mass": body.mass,
            "centre": body.centre.tolist(),
            "tensor": body.about_centre.tolist(),
        }
        for body in list_bodies(task)
    ]
    document = {
        "bodies": bodies,
        "ties": [[name, point.tolist()] for name, point in list_ties(task)],
        "sines": task.sines(),
        "frame": task.frames["s"].tolist(),
        "rotation": solve_task(task).pose.rotation.tolist(),
    }
    Path(path).write_text(json.dumps(document), encoding="utf-8")


def run(path: str) -> None:
    """Print error and processor time of each setting."""
    from pydrake.systems.analysis import (
        ApplySimulatorConfig,
        Simulator,
        SimulatorConfig,
    )

    task = json.loads(Path(path).read_text(encoding="utf-8"))
    for accuracy in ACCURACIES:
        diagram, plant, star = build(task, 0.0)
        simulator = Simulator(diagram)
        config = SimulatorConfig(
            integration_scheme="cenic",
            accuracy=accuracy,
            max_step_size=0.1,
            use_error_control=True,
            target_realtime_rate=0.0,
        )
        ApplySimulatorConfig(config, simulator)
        seconds = measure(simulator)
        steps = simulator.get_integrator().get_num_steps_taken()
        report(
            f"CENIC, accuracy {accuracy:g}",
            steps,
            task,
            plant,
            star,
            simulator,
            seconds,
        )
    for steps in STEPS:
        diagram, plant, star = build(task, 1.0 / steps)
        simulator = Simulator(diagram)
        seconds = measure(simulator)
        report("discrete solver", steps, task, plant, star, simulator, seconds)


def build(task: dict[str, Any], step: float) -> tuple[Any, Any, Any]:
    """Return the diagram, the plant in it and the star; a step of 0 is continuous."""
    from pydrake.multibody.plant import MultibodyPlant
    from pydrake.multibody.tree import RevoluteJoint, RotationalInertia, SpatialInertia
    from pydrake.systems.framework import DiagramBuilder, LeafSystem

    class Torques(LeafSystem):  # type: ignore[misc]
        def __init__(self) -> None:
            super().__init__()
            self.DeclareVectorOutputPort("torques", 3, self.calculate)

        def calculate(self, context: Any, output: Any) -> None:
            t = context.get_time()
            output.SetFromVector([a * math.sin(f * t + p) for a, f, p in task["sines"]])

    builder = DiagramBuilder()
    plant = builder.AddSystem(MultibodyPlant(step))
    plant.mutable_gravity_field().set_gravity_vector(np.zeros(3))
    bodies, joints = {"base": plant.world_body()}, {}
    for body in task["bodies"]:
        i = np.array(body["tensor"])
        tensor = RotationalInertia(i[0, 0], i[1, 1], i[2, 2], i[0, 1], i[0, 2], i[1, 2])
        inertia = SpatialInertia.MakeFromCentralInertia(
            body["mass"], np.array(body["centre"]), tensor
        )
        name, joint = body["name"], body["joint"]
        bodies[name] = plant.AddRigidBody(name, inertia)
        frames = bodies[body["parent"]].body_frame(), bodies[name].body_frame()
        hinge = RevoluteJoint(joint, *frames, np.array(body["axis"]))
        joints[joint] = plant.AddJoint(hinge)
    for leg in range(3):
        plant.AddJointActuator(f"g{leg}", joints[f"g{leg}"])
    for name, place in task["ties"]:
        point = np.array(place)
        plant.AddBallConstraint(bodies["s"], point, bodies[name], point)
    plant.Finalize()
    torques = builder.AddSystem(Torques())
    builder.Connect(torques.get_output_port(), plant.get_actuation_input_port())
    return builder.Build(), plant, bodies["s"]


def measure(simulator: Any) -> float:
    """Run the second; return its processor time [s]."""
    simulator.Initialize()
    begin = time.process_time()
    simulator.AdvanceTo(1.0)
    return time.process_time() - begin


def report(
    how: str,
    steps: int,
    task: dict[str, Any],
    plant: Any,
    star: Any,
    simulator: Any,
    seconds: float,
) -> None:
    """Print the error of the star's orientation at the end, and the time."""
    context = plant.GetMyContextFromRoot(simulator.get_context())
    turned = plant.EvalBodyPoseInWorld(context, star).rotation().matrix()
    e = turned @ np.array(task["frame"]) @ np.array(task["rotation"]).T
    sine = np.array([e[2, 1] - e[1, 2], e[0, 2] - e[2, 0], e[1, 0] - e[0, 1]]) / 2.0
    error = math.atan2(float(np.linalg.norm(sine)), (np.trace(e) - 1.0) / 2.0)
    print(f"{how}, {steps} steps: {error:.1e} rad, {1e3 * seconds:.1f} ms", flush=True)


if __name__ == "__main__":
    {"write": write, "run": run}[sys.argv[1]](sys.argv[2])
