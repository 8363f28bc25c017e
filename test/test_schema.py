# SPDX-License-Identifier: Apache-2.0
"""Arbitrary documents give an object or one InputError, and nothing else."""

from __future__ import annotations

import unicodedata
from dataclasses import FrozenInstanceError, dataclass, replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from models import FAST

from sst_ros.errors import InputError
from sst_ros.scene.bodies import Base, Inertia, Link, Star
from sst_ros.scene.loads import Initial, Stroke, Workspace
from sst_ros.scene.scene import Scene, load, text_of
from sst_ros.scene.schema import Section, flag, integer, texts
from sst_ros.scene.yaml_document import dump, read

SOURCE = text_of("example2_heavy")[0]
EXAMPLE2 = load("example2_heavy")
FUZZ = settings(FAST, max_examples=150)


def scene_or_refusal(source):
    """Read, and see that a scene survives its own dump and a refusal says something."""
    try:
        scene = read(Scene, source, "origin")
    except InputError as error:
        assert error.problems
        assert str(error).startswith("origin: ")
    else:
        assert read(Scene, dump(scene), "dump") == scene


SIGNS = "[]{}:,-?&*!|>'\"%@`# \n\tab01.e~<"


@FUZZ
@given(st.text(max_size=200) | st.text(alphabet=SIGNS, max_size=120))
def test_arbitrary_text_is_a_scene_or_refused(source):
    scene_or_refusal(source)


@FAST
@given(st.lists(st.floats(-1e3, 1e3), min_size=6, max_size=6), st.text(min_size=1, max_size=30))
def test_numbers_and_text_survive_a_dump_bit_by_bit(rates, description):
    initial = Initial(gamma=rates[:3], gamma_dot=rates[3:])
    try:
        scene = replace(EXAMPLE2, description=description, initial=initial)
    except InputError:
        assert not description.strip() or any(unicodedata.category(c) == "Cc" for c in description)
        return
    assert read(Scene, dump(scene), "dump") == scene


def test_sections_are_frozen():
    with pytest.raises(FrozenInstanceError):
        load("example2_heavy").duration = 2.0


def test_arrays_are_taken_and_frozen():
    base = Base(v=np.eye(3), radius=np.float64(0.35))
    assert base.v == ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
    assert hash(base) == hash(Base(v=np.eye(3).tolist(), radius=0.35))


INERTIA = Inertia(xx=1.0, yy=1.0, zz=1.0)


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (lambda: Base(v=np.ones(2), radius=0.35), r"base: v = .*: must be 3 x 3 finite numbers"),
        (lambda: Base(v=np.array(3.0), radius=0.35), r"base: v = .*: must be 3 x 3 finite"),
        (lambda: Base(v="abc", radius=0.35), r"base: v = 'abc': must be 3 x 3"),
        (lambda: Base(v=np.eye(3), radius=True), r"base: radius = True: must be a finite number"),
        (lambda: Base(v=np.eye(3), radius=None), r"base: radius = None: must be a finite number"),
        (lambda: Base(v=np.eye(3), radius=10**400), r"base: radius = 1000.*: must be a finite"),
        (lambda: Base(v=np.eye(3), radius=1j), r"base: radius = 1j: must be a finite number"),
        (lambda: Star(alpha_deg=[120] * 3, radius=1.0, inertia=None), r"star: inertia = None"),
        (lambda: Star(alpha_deg=[120] * 3, radius=1.0, inertia=Link), r"star: inertia = .*mapping"),
        (lambda: Stroke(at_end=None), r"stroke: at_end = None: must be one of stop, ignore"),
        (lambda: Workspace(beta_max_deg=np.nan), r"workspace: beta_max_deg = nan: must be"),
    ],
)
def test_sections_built_in_python_are_held_to_the_same_rules(build, message):
    with pytest.raises(InputError, match=message):
        build()


def test_what_has_no_effect_and_what_contradicts_itself_are_told_at_once():
    with pytest.raises(InputError) as caught:
        Star(alpha_deg=[120, 120, 121], radius=1.0, inertia=INERTIA, centre=(0.0, 0.0, 1.0))
    assert [problem.key for problem in caught.value.problems] == ["centre", "alpha_deg"]


def test_long_values_are_cut_in_messages():
    with pytest.raises(InputError) as caught:
        read(Scene, SOURCE.replace("duration: 1 ", f"duration: {'x' * 500} "), "origin")
    assert len(str(caught.value)) < 200
    assert "..." in str(caught.value)


@dataclass(frozen=True)
class Switches(Section):
    on: bool = flag("a switch", default=False)
    count: int = integer("how many", "1", default=2, least=1, most=9)
    words: tuple[str, ...] = texts("some words", default=())


@pytest.mark.parametrize(
    ("source", "expected"),
    [
        ("on: true", Switches(on=True)),
        ("on: False", Switches(on=False)),
        ("count: 9", Switches(count=9)),
        ("words: [a, b c]", Switches(words=("a", "b c"))),
    ],
)
def test_flags_whole_numbers_and_words_are_read(source, expected):
    assert read(Switches, source, "origin") == expected
    assert read(Switches, dump(expected), "dump") == expected


@pytest.mark.parametrize(
    ("source", "message"),
    [
        ("on: 1", r"line 1: on = '1': must be true or false"),
        ("on: 'true'", r"line 1: on = 'true': must be true or false"),
        ("on: yes", r"line 1: on = 'yes': must be true or false"),
        ("count: 2.5", r"line 1: count = '2\.5': must be a whole number from 1 to 9 \[1\]"),
        ("count: 10", r"line 1: count = '10': must be a whole number from 1 to 9"),
        ("count: 0x3", r"line 1: count = '0x3': must be a whole number"),
        ("count: true", r"line 1: count = 'true': must be a whole number"),
        ("words: a", r"line 1: words = 'a': must be a list of text"),
        ("words: [a, '']", r"line 1: words = \['a', ''\]: must be a list of text"),
    ],
)
def test_flags_whole_numbers_and_words_are_refused(source, message):
    with pytest.raises(InputError, match=message):
        read(Switches, source, "origin")
