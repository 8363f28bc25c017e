# SPDX-License-Identifier: Apache-2.0
"""Each package that may be missing, hidden in turn: one line says how to install it."""

import ast
import re
import sys
from collections import defaultdict
from functools import cache
from importlib.util import find_spec
from pathlib import Path

import pytest
from programs import HIDDEN, python
from slow_cases import slow_after, slow_except

from sst_ros.errors import EXTRAS, explain_missing_ros, explanation

PACKAGE = Path(__file__).parents[1] / "sst_ros"
REQUIRED = {"jinja2", "numpy", "scipy", "sst_ros", "yaml"}
NEVER_MISSED = {
    "mpmath",  # imported only for numbers that are mpmath's
    "simulation_interfaces",  # its services are left out
    "typing_extensions",  # imported by type checkers only
}
IMPORTS = """
import importlib
from sst_ros.errors import MissingDependency, explanation

for module in {modules!r}:
    try:
        importlib.import_module(module)
    except MissingDependency as error:
        print(module, error)
    except ModuleNotFoundError as error:
        print(module, explanation(error))
"""
COMMAND = """
from sst_ros.__main__ import main

sys.exit(main({words!r}))
"""


def imported_names(tree):
    """Yield the name of each module a source imports, and whether by a statement."""
    for statement in ast.walk(tree):
        if isinstance(statement, ast.Import):
            yield from ((alias.name, True) for alias in statement.names)
        elif isinstance(statement, ast.ImportFrom):
            yield statement.module, True
        elif isinstance(statement, ast.Call) and isinstance(statement.func, ast.Name):
            first = statement.args[0] if statement.args else None
            if statement.func.id == "require" and isinstance(first, ast.Constant):
                yield first.value, False


@cache
def find_importers():
    """Return this package's modules that import each other package by a statement."""
    found = defaultdict(list)
    for path in sorted(PACKAGE.rglob("*.py")):
        if path.name == "launch_parts.py":  # its `require` names packages of ROS
            continue
        parts = path.relative_to(PACKAGE.parent).with_suffix("").parts
        for name, by_statement in imported_names(
            ast.parse(path.read_text(encoding="utf-8"))
        ):
            importers = found[name.partition(".")[0]]
            if by_statement:
                importers.append(".".join(parts).removesuffix(".__init__"))
    return {
        name: importers
        for name, importers in found.items()
        if name not in REQUIRED | NEVER_MISSED | sys.stdlib_module_names
    }


def test_each_optional_import_has_an_extra():
    importers = find_importers()
    assert {"pandas", "rclpy", "trimesh", "viser"} <= importers.keys()
    unexplained = [
        name
        for name in importers
        if explanation(ModuleNotFoundError(f"No module named {name!r}", name=name))
        is None
    ]
    assert unexplained == []


def check_explanation(hidden):
    """Hide a package; each module that imports it says how to install it."""
    modules = find_importers()[hidden]
    done = python(HIDDEN.format(names=[hidden]) + IMPORTS.format(modules=modules))
    for line in done.stdout.splitlines():
        message = line.partition(" ")[2]
        missing = re.match(r"(\w+) is not installed: ", message)
        assert missing, line
        if missing[1] != hidden:  # one that is missing here
            assert find_spec(missing[1]) is None, line


@pytest.mark.parametrize("hidden", ["matplotlib", "rclpy", "viser"])
def test_a_hidden_package_is_explained(hidden):
    check_explanation(hidden)


@pytest.mark.slow
def test_each_hidden_package_is_explained():
    for hidden, modules in find_importers().items():
        if modules:
            check_explanation(hidden)


@pytest.mark.parametrize(
    "hidden", slow_except(["viser"], ["viser", "trimesh", "websockets"])
)
@pytest.mark.parametrize("words", slow_after(1, [["viewer"], ["view"]]), ids=" ".join)
def test_the_page_names_the_extra_that_it_needs(hidden, words):
    pytest.importorskip("rclpy", reason="needs rclpy: pip install .[ros]")
    pytest.importorskip("viser", reason="needs viser: pip install .[view]")
    program = HIDDEN.format(names=[hidden]) + COMMAND.format(words=words)
    said = python(program, status=1).stderr
    assert re.fullmatch(
        rf"sst-ros: {hidden} is not installed: .*sst_ros\[view\].*\n", said
    ), said


def test_beside_ros_the_package_of_pip_with_a_module_is_named(monkeypatch):
    monkeypatch.setenv("ROS_DISTRO", "kilted")
    for module in ("trimesh", "viser", "websockets"):
        said = explanation(ModuleNotFoundError(name=module))
        assert f"{module} is not installed: pip install viser, or " in said
    assert EXTRAS["trimesh"] == "view"


@pytest.mark.parametrize("module", ["launch", "launch_ros"])
def test_no_wheel_is_advised_that_does_not_exist(module):
    said = explanation(ModuleNotFoundError(name=module))
    assert said == f"{module} is not installed: source a ROS 2 installation"


def test_a_package_that_apt_cannot_have_is_built(monkeypatch):
    """No distribution can release a package that lies inside another one."""
    monkeypatch.setenv("ROS_DISTRO", "kilted")
    said = explain_missing_ros(["controller_manager", "sst_ros_hardware"])
    assert said == (
        "this needs the ROS package(s) controller_manager, sst_ros_hardware: "
        "apt install ros-kilted-controller-manager; "
        "colcon build --base-paths src/sst_ros/hardware"
    )
    assert "apt" not in explain_missing_ros(["sst_ros_hardware"])
