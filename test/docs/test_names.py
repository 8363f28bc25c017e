# SPDX-License-Identifier: Apache-2.0
"""A file, module or name that is mentioned exists: texts, docstrings, comments."""

import ast
import builtins
import re
import sys
from functools import cache

import pytest
from docs.blocks import ROOT

TREES = (
    "sst_ros",
    "studies",
    "docs",
    "examples",
    "launch",
    "test",
    "tools",
    "benchmark",
)
FILE = re.compile(r"(?<![\w/.-])((?:\w+/)+\w+\.py)(?:::(\w+))?")
MODULE = re.compile(r"(?<![\w/.-])sst_ros(?:\.\w+)+")
NAME = re.compile(r"`([A-Za-z_][\w.]*)(?:\([^`]*\))?`")


def found(kind):
    return (path for tree in TREES for path in (ROOT / tree).rglob(kind))


TEXTS = [
    path
    for path in (*ROOT.glob("*.md"), *found("*.md"), *found("*.py"))
    if path.name != "CHANGELOG.md" and not {"gallery", "api"} & set(path.parts)
]


@cache
def split(path):
    """Docstrings and comments of a program, and the rest of it."""
    source = path.read_text(encoding="utf-8")
    lines = source.splitlines()
    said = []
    for node in ast.walk(ast.parse(source)):
        value = node.value if isinstance(node, ast.Expr) else None
        if isinstance(value, ast.Constant) and type(value.value) is str:
            said += lines[node.lineno - 1 : node.end_lineno]
            lines[node.lineno - 1 : node.end_lineno] = [""] * (
                node.end_lineno - node.lineno + 1
            )
    said += [line.partition("# ")[2] for line in lines]
    return "\n".join(said), "\n".join(line.partition("# ")[0] for line in lines)


@cache
def code():
    """Every word of the code, of scenes and of settings."""
    words = {*dir(builtins), *sys.stdlib_module_names, "scipy", "PPoly"}
    for path in found("*.py"):
        words |= set(re.findall(r"\w+", split(path)[1]))
    for path in (
        *ROOT.glob("config/**/*.yaml"),
        *ROOT.glob("*.cfg"),
        ROOT / "Makefile",
    ):
        words |= set(re.findall(r"\w+", path.read_text(encoding="utf-8")))
    return words


def missing(said, *, names):
    """Yield files, modules and, as far as they are meant, names that are not there."""
    said = re.sub(r"https?://\S+", "", said)
    for name, function in set(FILE.findall(said)):
        places = [
            top / name for top in (ROOT, ROOT / "sst_ros") if (top / name).exists()
        ]
        if not places or (
            function and f"def {function}(" not in places[0].read_text("utf-8")
        ):
            yield name
    for name in set(MODULE.findall(said)):
        place, (first, *rest) = ROOT, name.split(".")
        while (place / first).is_dir() and rest:
            place, (first, *rest) = place / first, rest
        is_module = (place / f"{first}.py").exists()
        attribute = (rest or [""])[0] if is_module else first
        module = place / (f"{first}.py" if is_module else "__init__.py")
        if not re.search(rf"\b{attribute}\b", module.read_text("utf-8")):
            yield name
    for name in set(NAME.findall(said)) if names else ():
        if not set(name.split(".")) <= code():
            yield name


@pytest.mark.slow
def test_what_a_text_names_is_there():
    """In the package's docstrings and comments, words in backquotes are names, too."""
    stale = {}
    for path in TEXTS:
        program = path.suffix == ".py"
        said = split(path)[0] if program else path.read_text(encoding="utf-8")
        names = program and ROOT / "sst_ros" in path.parents
        if gone := list(missing(said, names=names)):
            stale[str(path.relative_to(ROOT))] = gone
    assert stale == {}
