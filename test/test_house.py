# SPDX-License-Identifier: Apache-2.0
"""Structure of the package: rooms in order, no import cycle, short paths, names defined
once.
"""

import ast
import importlib.util
import os
import re
from collections import defaultdict
from functools import cache
from graphlib import TopologicalSorter
from pathlib import Path

import pytest
from missing_packages import needs
from programs import python

import sst_ros

PACKAGE = Path(sst_ros.__file__).parent
FLOORS = (
    {"removed", "state", "version"},
    {"errors", "figures", "files", "progress"},
    {"scene"},
    {"mechanism", "programs"},
    {"dynamics"},
    {"integration"},
    {"simulation"},
    {"control", "description", "proof"},
    {"code_generation", "recording"},
    {"plot"},
    {"report"},
    {"runtime"},
    {"identification", "sweeps", "view"},
    {"nodes"},
    {"demo", "launch_parts"},
    {"cli"},
    {"__main__"},
    {"sst_ros"},
)
"""Rooms from the lowest to the highest.

A file imports from its own floor and from those below.

The face of the package imports every room, and no file imports it.
"""
FLOOR = {room: number for number, rooms in enumerate(FLOORS) for room in rooms}
FILES = {
    ".".join(path.relative_to(PACKAGE.parent).with_suffix("").parts).removesuffix(
        ".__init__"
    ): path
    for path in sorted(PACKAGE.rglob("*.py"))
}
ROS = ("rclpy", "rcl_interfaces", "builtin_interfaces")


@cache
def tree(name):
    """Syntax of a file of the package, read once for all tests."""
    return ast.parse(FILES[name].read_text(encoding="utf-8"))


def imports(name):
    """Every module that a file names in an import, in functions and under TYPE_CHECKING
    too.
    """
    path = FILES[name]
    package = name if path.name == "__init__.py" else name.rpartition(".")[0]
    for node in ast.walk(tree(name)):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = node.module or ""
            if node.level:
                parts = package.split(".")
                base = ".".join(
                    [*parts[: len(parts) - node.level + 1], *filter(None, [base])]
                )
            for alias in node.names:
                full = f"{base}.{alias.name}"
                yield full if full in FILES else base


def inner_imports(name):
    """Modules of the package that a file imports."""
    return {one for one in imports(name) if one in FILES and one != name}


def room(name):
    return name.split(".")[1] if "." in name else name


@pytest.mark.parametrize("name", FILES)
def test_a_file_imports_from_its_own_floor_and_below(name):
    here = FLOOR[room(name)]
    for other in inner_imports(name):
        assert FLOOR[room(other)] <= here, f"{name} imports {other}"


@pytest.mark.parametrize("name", FILES)
def test_only_nodes_import_ros(name):
    for other in imports(name):
        top = other.split(".")[0]
        if top in ROS or top.endswith(("_msgs", "_srvs")):
            assert room(name) == "nodes", f"{name} imports {other}"


def test_no_import_cycle():
    graph = {name: inner_imports(name) for name in FILES}
    TopologicalSorter(graph).prepare()  # a CycleError names the files


@pytest.mark.parametrize("name", sorted({*FILES} - {"sst_ros.state"}))
def test_no_property_holds_a_lock_that_a_fork_waits_for(name):
    """`functools.cached_property` does in Python 3.10 and 3.11; see `sst_ros.state`."""
    for node in ast.walk(tree(name)):
        if isinstance(node, ast.ImportFrom) and node.module == "functools":
            assert "cached_property" not in {alias.name for alias in node.names}
        assert not isinstance(node, ast.Attribute) or node.attr != "cached_property"


def test_every_class_name_has_one_definition():
    places = defaultdict(list)
    for name in FILES:
        for node in ast.walk(tree(name)):
            if isinstance(node, ast.ClassDef):
                places[node.name].append(name)
    assert {name: where for name, where in places.items() if len(where) > 1} == {}


def test_every_test_file_has_a_name_of_its_own():
    # launch_testing's collector, which every ROS installation loads, refuses equal
    # names.
    names = [path.name for path in Path(__file__).parent.rglob("test_*.py")]
    assert sorted(names) == sorted(set(names))


LONGEST_TEST_NAME = 60
"""Characters: with the name of its file a test fits on a line of a terminal."""


def test_names_of_tests_are_short():
    long_names = [
        node.name
        for path in Path(__file__).parent.rglob("*.py")
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if isinstance(node, ast.FunctionDef)
        and node.name.startswith("test_")
        and len(node.name) > LONGEST_TEST_NAME
    ]
    assert long_names == []


@pytest.mark.parametrize("name", FILES)
def test_a_constant_of_a_file_is_written_once(name):
    body = tree(name).body
    targets = [
        target.id
        for node in body
        for target in (node.targets if isinstance(node, ast.Assign) else ())
        if isinstance(target, ast.Name)
    ]
    assert sorted(targets) == sorted(set(targets))


PATHS = """
import pathlib, sys, threading, time
import bags, sst_ros
from sst_ros import Simulation, load_scene, read_bag, simulate
from programs import own_domain
from sst_ros.report.run import evaluate_run, summary_table

files, counts = set(), True
PACKAGE = str(pathlib.Path(sst_ros.__file__).parent)

def profile(frame, event, argument):
    file = frame.f_code.co_filename
    if not counts or event != "call" or not file.startswith(PACKAGE):
        return
    if threading.current_thread().name != "watch":
        files.add(".".join(pathlib.Path(file).parts[-2:]).removesuffix(".py"))

def passed(name, call):
    files.clear()
    # The run of a node and the report have threads of their own.
    threading.setprofile(profile)
    sys.setprofile(profile)
    try:
        call()
    finally:
        sys.setprofile(None)
        threading.setprofile(None)
    print(name, *files)

def answer():
    # Counts from the first sample of a run to the second, which is the last one.
    global counts
    import rclpy
    from sst_ros.nodes import publications, simulator, topics

    def sample(*given, show=publications.SimulatorTopics.sample):
        global counts
        show(*given)
        counts = not counts

    def run():
        node, command = simulator.Simulator(), topics.SIMULATOR["commands"]
        command.publisher(node.node).publish(command.kind(data=[0.1, 0.2, 0.3]))
        assert node.done.wait(60.0)

    publications.SimulatorTopics.sample = sample
    words = ["duration:=0.002", "wait_for_command:=true",
             "wait_for_subscribers:=['joint_states']"]
    given = [part for one in words for part in ("-p", one)]
    rclpy.init(args=["simulator", "--ros-args", *given])
    node, states = rclpy.create_node("observer"), topics.SIMULATOR["joint_states"]
    node.create_subscription(states.kind, "joint_states", print, 10)
    counts = False
    passed("answer", run)
    rclpy.shutdown()

def report():
    summary_table(evaluate_run(read_bag(bag)).summary)

simulation, made = Simulation("friction"), []
passed("made", lambda: made.append(Simulation("example2")))
passed("compiled", lambda: made[0].step((0.0, 0.0, 0.0), 1_000_000))
scene, bag = load_scene("example2"), pathlib.Path({folder!r})
bags.write(bag, bags.simulated(scene, 0.05))
calls = {{
    "step": lambda: simulation.step((0.0, 0.0, 0.0), 1_000_000),
    "simulation": lambda: Simulation("example2"),
    "simulate": lambda: simulate("example2"),
    "bag": lambda: read_bag(bag),
    "report": report,
}}
for name, call in calls.items():
    call()  # what is imported or compiled at the first call is not counted
    passed(name, call)
if {ros}:
    with own_domain():
        answer()
"""
MOST_FILES = {
    "step": 7,
    "answer": 10,  # to joint_states from a torque message
    "simulation": 14,  # from the name of a scene
    "simulate": 23,
    "bag": 9,  # with the one reader of YAML documents, for metadata.yaml
    "report": 26,  # from a bag, with that reader, too, to the table of `report run`
}
"""Files with a function that a call passes, not to grow. The loop and its steps are
files, where they were generated text before.
"""


@pytest.mark.slow
@needs("rosbags", "mcap")
@pytest.mark.timeout(320)  # where nothing is compiled yet
def test_calls_pass_few_files_and_those_that_contributing_names(tmp_path):
    ros, here = importlib.util.find_spec("rclpy") is not None, Path(__file__).parent
    code = PATHS.format(folder=str(tmp_path / "bag"), ros=ros)
    path = {"PYTHONPATH": f"{here.parent}{os.pathsep}{here}"}
    done = python(code, env=path, timeout=300)
    lines = [line.split() for line in done.stdout.splitlines()]
    found = {name: set(files) for name, *files in lines}
    counts = {name: len(found[name]) for name in MOST_FILES if ros or name != "answer"}
    assert {
        name: count for name, count in counts.items() if count > MOST_FILES[name]
    } == {}
    text = (here.parent / "CONTRIBUTING.md").read_text(encoding="utf-8")
    told = text[text.index("## Data paths") : text.index("## Where to add")].split(
        "```"
    )[1::2]
    passed = found["made"] | found["compiled"]
    for files, block in zip(
        (found.get("answer"), passed, found["report"]), told, strict=True
    ):
        modules = set(re.findall(r"^\w+\.\w+", block, re.MULTILINE))
        assert modules and modules <= (files or modules)
