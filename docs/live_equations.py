# SPDX-License-Identifier: Apache-2.0
"""Write the equations of motion as JavaScript, for the simulation on the first page."""

from __future__ import annotations

import json

from sst_ros import Scene, load_scene
from sst_ros.description import robot
from sst_ros.dynamics.initial_state import start_of
from sst_ros.dynamics.model import limits_of
from sst_ros.dynamics.traced_dynamics import ODE, Dynamics
from sst_ros.mechanism.geometry import Geometry
from sst_ros.programs.expression import Program

_TEXT = """// SPDX-License-Identifier: Apache-2.0
// Written by docs/live_equations.py from the scene {name}.
const {{ sqrt, tanh, exp, sin, cos, atan2, max }} = Math;
{functions}
const manipulator = {numbers};
"""


def live_scene() -> Scene:
    """Return the scene of `make view` with friction that calms the motion."""
    changes = {"friction.gamma.viscous": 0.6, "actuators.torque_limit": 6.0}
    return load_scene("swing").with_values(changes)


def write_equations(scene: Scene) -> str:
    """Write derivative and joint angles as functions, the numbers as an object."""
    dynamics, geometry = Dynamics.of(scene), Geometry.of(scene)
    programs = {"derivative": ODE(dynamics).program, "joints": dynamics.joints_program}
    shapes = {link: [*map(_draw, found)] for link, found in robot.shapes(scene).items()}
    numbers = {
        "initial": start_of(scene),
        "torque_limit": scene.torque_limit,
        "limits": [
            limit._asdict() | {"error": ""} for limit in limits_of(scene, geometry)
        ],
        "chain": [
            joint._asdict() | {"origin": joint.origin.tolist()}
            for joint in robot.joints_of(geometry)
            if joint.child in shapes  # the star as leg 1 sees it
        ],
        "shapes": shapes,
    }
    functions = "\n".join(
        _function(name, program) for name, program in programs.items()
    )
    text = json.dumps(numbers, allow_nan=False)
    return _TEXT.format(name=scene.name, functions=functions, numbers=text)


def _function(name: str, program: Program) -> str:
    """Write a program.

    Its lines are JavaScript, too, as they have only operators and functions.
    """
    lines, _, results = program.split(())
    body = "".join(f"  const {line};\n" for line in lines)
    given = ", ".join(program.inputs)
    return f"function {name}({given}) {{\n{body}  return [{', '.join(results)}];\n}}"


def _draw(shape: robot.Shape) -> dict[str, object]:
    """Return a shape as a line of points [m] with a radius [m] and a colour.

    A ball has one.
    """
    if isinstance(shape, robot.Arc):
        points, size = shape.points(), shape.thickness
    elif isinstance(shape, robot.Rod):
        points, size = [shape.begin, shape.end], shape.thickness
    elif isinstance(shape, robot.Ball):
        points, size = [shape.centre], shape.radius
    else:
        points, size = [shape.centre], float(max(shape.size)) / 2.0
    colour = [round(255.0 * part) for part in shape.colour]
    opacity = getattr(shape, "opacity", 1.0)
    text = f"rgba({', '.join(map(str, (*colour, opacity)))})"
    return {
        "points": [[float(x) for x in point] for point in points],
        "size": size,
        "colour": text,
    }
