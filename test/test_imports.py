# SPDX-License-Identifier: Apache-2.0
"""Every module is compiled and imported; warnings of our own sources are errors.

A newer Python announces by such warnings what it will refuse.
"""

import ast
import warnings
from pathlib import Path

import pytest
from programs import python

ROOT = Path(__file__).parents[1]
FOLDERS = ("sst_ros", "launch", "tools", "benchmark", "studies", "examples", "test")
IMPORTS = """
import importlib
import pkgutil
import warnings

import sst_ros
from sst_ros.errors import MissingDependency, explanation

warnings.filterwarnings("error", module="sst_ros")
for module in pkgutil.walk_packages(sst_ros.__path__, "sst_ros."):
    if module.name == "sst_ros.__main__":
        continue
    try:
        importlib.import_module(module.name)
    except MissingDependency:
        pass
    except ImportError as error:
        if explanation(error) is None:
            raise
    else:
        print(module.name)
"""


@pytest.mark.parametrize("folder", FOLDERS)
def test_sources_are_compiled_without_a_warning(folder):
    """Among them the SyntaxWarnings of 3.12 and of 3.14."""
    sources = [*(ROOT / folder).rglob("*.py")]
    assert sources
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for path in sources:
            compile(ast.parse(path.read_bytes(), path), path, "exec")


def test_every_module_is_imported_without_a_warning_of_ours():
    imported = python(IMPORTS).stdout.split()
    rooms = {path.parent.name for path in (ROOT / "sst_ros").glob("*/__init__.py")}
    assert {name.split(".")[1] for name in imported} >= rooms - {"nodes", "view"}


def test_every_class_variable_has_a_type():
    """Python 3.10 evaluates no bare `ClassVar`: no node would start there."""
    for path in (ROOT / "sst_ros").rglob("*.py"):
        for statement in ast.walk(ast.parse(path.read_bytes(), path)):
            if isinstance(statement, ast.AnnAssign):
                assert ast.unparse(statement.annotation) != "ClassVar", path
