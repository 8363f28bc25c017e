# SPDX-License-Identifier: Apache-2.0
"""Gallery documents with other values in them: a scene, or a refusal that says where.

No traceback.

What is taken is assembled, traced, differentiated and described as well.
"""

from __future__ import annotations

import copy
import functools
import operator

import pytest
import yaml
from hypothesis import example, given, settings
from hypothesis import strategies as st
from models import FAST

from sst_ros.cli.runs import check
from sst_ros.errors import InputError
from sst_ros.report.scene_summary import summary
from sst_ros.scene.scene import Scene, names, text_of
from sst_ros.scene.yaml_document import dump, read

SOURCES = {name: text_of(name)[0] for name in names()}
TREES = {name: yaml.safe_load(source) for name, source in SOURCES.items()}
FUZZ = settings(FAST, max_examples=60)


def paths(tree, path=()):
    if isinstance(tree, (dict, list)):
        for key, value in tree.items() if isinstance(tree, dict) else enumerate(tree):
            yield (*path, key)
            yield from paths(value, (*path, key))


def changed(place, value):
    """A scene as a plain tree, with another value in one place."""
    name, path = place
    tree = copy.deepcopy(TREES[name])
    inner = functools.reduce(operator.getitem, path[:-1], tree)
    inner[path[-1]] = value
    return written(tree)


PLACES = [(name, path) for name, tree in TREES.items() for path in paths(tree)]
SECTIONS = {
    key: value
    for tree in TREES.values()
    for key, value in tree.items()
    if key not in ("name", "description", "base", "star", "provenance")
}
SECTIONS |= {
    "moment": {"topic": True},
    "actuators": {
        "rotor_inertia": 1e-4,
        "gear_ratio": 9,
        "torque_limit": 1,
        "time_constant": 0.1,
    },
}
numbers = (
    st.floats()
    | st.integers()
    | st.sampled_from(
        [0, -1, 1e-320, 1e-12, 1e-9, 1e9, 1e308, 10**400, 1.5707963267948966]
    )
)
values = (
    numbers
    | st.none()
    | st.booleans()
    | st.text(max_size=5)
    | st.recursive(
        st.none() | numbers | st.text(max_size=8),
        lambda inner: (
            st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=5), inner)
        ),
        max_leaves=6,
    )
    | st.sampled_from([{}, [], [[]], {"xx": 1}, [{}], "gamma_1", "impact", "elastic"])
)


def judged(source, path, described=False):
    """Read a document; a refusal tells key and line, a scene is whole."""
    try:
        scene = read(Scene, source, "origin")
    except InputError as error:
        # Broken YAML has no key, and may make no sense only after its last line.
        lines = len(source.splitlines()) + 1
        for problem in error.problems:
            assert problem.line is not None and 1 <= problem.line <= lines
            assert problem.key or problem.allowed == "must be YAML"
        return
    assert read(Scene, dump(scene), "dump") == scene
    path.write_text(source, encoding="utf-8")
    try:
        assert check(path) == scene
    except InputError as error:
        assert [p.key for p in error.problems] == ["initial.gamma"]
        assert "gamma" in source.splitlines()[error.problems[0].line - 1]
    if described:
        assert summary(scene).startswith(scene.name)


@pytest.fixture(scope="module")
def path(tmp_path_factory):
    return tmp_path_factory.mktemp("fuzz") / "scene.yaml"


class Plain(yaml.SafeDumper):
    def ignore_aliases(self, data):
        return True


def written(tree):
    return yaml.dump(tree, Dumper=Plain)


@FUZZ
# its square is inf
@example(("gravity_payload", ("intermediate_links", 0, "centre", 0)), 2e154)
@given(st.sampled_from(PLACES), values)
def test_another_value_in_one_place(path, place, value):
    judged(changed(place, value), path)


@pytest.mark.slow
@settings(FAST, max_examples=15)
@given(st.sampled_from(PLACES), numbers)
def test_another_number_in_a_scene_that_is_described(path, place, value):
    judged(changed(place, value), path, described=True)


@FUZZ
@given(
    st.sampled_from(sorted(TREES)),
    st.dictionaries(
        st.sampled_from(sorted(SECTIONS)), st.sampled_from(sorted(SECTIONS))
    ),
    st.lists(st.sampled_from(sorted(SECTIONS)), max_size=3),
)
def test_sections_exchanged_added_and_left_out(path, name, mixed, dropped):
    tree = TREES[name] | {key: SECTIONS[other] for key, other in mixed.items()}
    tree |= {key: SECTIONS[key] for key in list(mixed.values())[:2]}
    judged(written({k: v for k, v in tree.items() if k not in dropped}), path)


@FUZZ
@given(st.sampled_from(sorted(SOURCES)), st.data())
def test_a_line_lost_doubled_or_moved_in(path, name, data):
    lines = SOURCES[name].splitlines()
    at = data.draw(st.integers(0, len(lines) - 1))
    action = data.draw(st.sampled_from(["lose", "double", "indent", "outdent", "cut"]))
    patch = {
        "lose": [],
        "double": [lines[at]] * 2,
        "indent": ["  " + lines[at]],
        "outdent": [lines[at].lstrip()],
        "cut": [lines[at][: len(lines[at]) // 2]],
    }[action]
    source = "\n".join([*lines[:at], *patch, *lines[at + 1 :]]) + "\n"
    judged(source, path)
