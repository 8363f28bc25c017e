# SPDX-License-Identifier: Apache-2.0
"""The house: imports run one way, and rclpy stays in its rooms."""

import ast
from pathlib import Path

import pytest

import sst_ros

PACKAGE = Path(sst_ros.__file__).parent
FLOORS = (
    {"state"},
    {"child_process", "errors", "extras", "output_folder", "progress"},
    {"scene"},
    {"mechanism"},
    {"dynamics"},
    {"integration"},
    {"simulation", "torque", "interpolation", "trajectory", "trajectory_file"}
    | {"simulate_gauss", "simulate_steps", "simulate_motion"},
    {"control", "description"},
    {"recording"},
    {"plot", "view"},
    {"report"},
    {"studies"},
    {"runtime"},
    {"nodes"},
    {"demo", "launch_parts"},
    {"cli", "__main__"},
)
FLOOR = {room: number for number, rooms in enumerate(FLOORS) for room in rooms}
FILES = sorted(PACKAGE.rglob("*.py"))
ROS = ("rclpy", "rosgraph_msgs", "sensor_msgs", "std_msgs", "geometry_msgs", "diagnostic_msgs")


def imports(path):
    """Modules that a file imports when it runs, in functions too: `sst_ros.x` by its full name."""
    tree = ast.parse(path.read_text())
    types = (node for node in ast.walk(tree) if isinstance(node, ast.If))
    told = {
        id(line)
        for node in types
        if ast.unparse(node.test) == "TYPE_CHECKING"
        for line in node.body
    }
    for node in ast.walk(tree):
        if id(node) in told:
            continue
        if isinstance(node, ast.Import):
            yield from (name.name for name in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module == "sst_ros":
            yield from (f"sst_ros.{name.name}" for name in node.names)
        elif isinstance(node, ast.ImportFrom):
            yield node.module


def room(path):
    return path.relative_to(PACKAGE).parts[0].removesuffix(".py")


@pytest.mark.parametrize("path", FILES, ids=lambda path: str(path.relative_to(PACKAGE)))
def test_a_file_imports_what_lies_below_it(path):
    if path == PACKAGE / "__init__.py":
        return
    here = FLOOR[room(path)]
    for name in imports(path):
        if name.startswith("sst_ros."):
            other = name.split(".")[1]
            assert FLOOR.get(other, -1) <= here, f"{path} imports {name}"
        if name.split(".")[0] in ROS:
            assert room(path) == "nodes", f"{path} imports {name}"
