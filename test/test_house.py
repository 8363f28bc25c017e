# SPDX-License-Identifier: Apache-2.0
"""Structure of the package: rooms in one order, no import cycle, each class name defined once."""

import ast
from collections import defaultdict
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

import sst_ros

PACKAGE = Path(sst_ros.__file__).parent
FLOORS = (
    {"state", "version"},
    {"errors", "extras", "host"},
    {"scene"},
    {"mechanism"},
    {"dynamics"},
    {"integration"},
    {"simulation"},
    {"control", "description"},
    {"recording"},
    {"plot", "view"},
    {"report"},
    {"runtime"},
    {"identification", "sweeps"},
    {"nodes"},
    {"demo", "launch_parts"},
    {"cli"},
    {"__main__"},
    {"sst_ros"},
)
"""Rooms from the lowest to the highest; a file imports from its own floor and from those below.

The face of the package imports every room, and no file imports it."""
FLOOR = {room: number for number, rooms in enumerate(FLOORS) for room in rooms}
FILES = {
    ".".join(path.relative_to(PACKAGE.parent).with_suffix("").parts).removesuffix(".__init__"): path
    for path in sorted(PACKAGE.rglob("*.py"))
}
ROS = ("rclpy", "rcl_interfaces", "builtin_interfaces")


def imports(name):
    """Every module that a file names in an import, in functions and under TYPE_CHECKING too."""
    path = FILES[name]
    package = name if path.name == "__init__.py" else name.rpartition(".")[0]
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = node.module or ""
            if node.level:
                parts = package.split(".")
                base = ".".join([*parts[: len(parts) - node.level + 1], *filter(None, [base])])
            for alias in node.names:
                full = f"{base}.{alias.name}"
                yield full if full in FILES else base


GRAPH = {name: {one for one in imports(name) if one in FILES and one != name} for name in FILES}


def room(name):
    return name.split(".")[1] if "." in name else name


@pytest.mark.parametrize("name", FILES)
def test_a_file_imports_from_its_own_floor_and_below(name):
    here = FLOOR[room(name)]
    for other in GRAPH[name]:
        assert FLOOR[room(other)] <= here, f"{name} imports {other}"


@pytest.mark.parametrize("name", FILES)
def test_only_nodes_import_ros(name):
    for other in imports(name):
        top = other.split(".")[0]
        if top in ROS or top.endswith(("_msgs", "_srvs")):
            assert room(name) == "nodes", f"{name} imports {other}"


def test_no_import_cycle():
    TopologicalSorter(GRAPH).prepare()  # a CycleError names the files


def test_every_class_name_has_one_definition():
    places = defaultdict(list)
    for name, path in FILES.items():
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.ClassDef):
                places[node.name].append(name)
    assert {name: where for name, where in places.items() if len(where) > 1} == {}


def test_every_test_file_has_a_name_of_its_own():
    # launch_testing's collector, which every ROS installation loads, refuses equal names.
    names = [path.name for path in Path(__file__).parent.rglob("test_*.py")]
    assert sorted(names) == sorted(set(names))


@pytest.mark.parametrize("name", FILES)
def test_a_constant_of_a_file_is_written_once(name):
    body = ast.parse(FILES[name].read_text(encoding="utf-8")).body
    targets = [
        target.id
        for node in body
        for target in (node.targets if isinstance(node, ast.Assign) else ())
        if isinstance(target, ast.Name)
    ]
    assert sorted(targets) == sorted(set(targets))
