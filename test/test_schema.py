# SPDX-License-Identifier: Apache-2.0
"""Arbitrary and hostile documents give an object or one InputError at once, and nothing
else.
"""

from __future__ import annotations

import unicodedata
from dataclasses import FrozenInstanceError, replace

import numpy as np
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st
from models import FAST
from test_scene_refusals import SOURCE, refusal

from sst_ros.__main__ import main
from sst_ros.errors import InputError
from sst_ros.scene.bodies import Base, Inertia, Link, Star, Stroke, Workspace
from sst_ros.scene.loads import Initial
from sst_ros.scene.scene import Scene, load
from sst_ros.scene.schema import Section, entry
from sst_ros.scene.yaml_document import MOST_NODES, dump, read

EXAMPLE2 = load("example2_heavy")


SIGNS = "[]{}:,-?&*!|>'\"%@`# \n\tab01.e~<"


@settings(FAST, max_examples=150)
@given(st.text(max_size=200) | st.text(alphabet=SIGNS, max_size=120))
def test_arbitrary_text_is_a_scene_or_refused(source):
    """A scene survives its own dump, and a refusal says something."""
    try:
        scene = read(Scene, source, "origin")
    except InputError as error:
        assert error.problems and str(error).startswith("origin: ")
    else:
        assert read(Scene, dump(scene), "dump") == scene


@FAST
@given(
    st.lists(st.floats(-1e3, 1e3), min_size=6, max_size=6),
    st.text(min_size=1, max_size=30),
)
def test_numbers_and_text_survive_a_dump_bit_by_bit(rates, description):
    initial = Initial(gamma=np.divide(rates[:3], 200.0), gamma_dot=rates[3:])
    try:
        scene = replace(EXAMPLE2, description=description, initial=initial)
    except InputError:
        assert not description.strip() or any(
            unicodedata.category(c) == "Cc" for c in description
        )
        return
    assert read(Scene, dump(scene), "dump") == scene


def test_sections_are_frozen_and_take_arrays():
    with pytest.raises(FrozenInstanceError):
        EXAMPLE2.duration = 2.0
    base = Base(v=np.eye(3), radius=np.float64(0.35))
    assert base.v == ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
    assert hash(base) == hash(Base(v=np.eye(3).tolist(), radius=0.35))


INERTIA = Inertia(xx=1.0, yy=1.0, zz=1.0)


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (
            lambda: Base(v=np.ones(2), radius=0.35),
            r"base: v = .*: must be 3 x 3 finite numbers",
        ),
        (
            lambda: Base(v=np.array(3.0), radius=0.35),
            r"base: v = .*: must be 3 x 3 finite",
        ),
        (lambda: Base(v="abc", radius=0.35), r"base: v = 'abc': must be 3 x 3"),
        (
            lambda: Base(v=np.eye(3), radius=True),
            r"base: radius = True: must be a finite number",
        ),
        (
            lambda: Base(v=np.eye(3), radius=None),
            r"base: radius = None: must be a finite number",
        ),
        (
            lambda: Base(v=np.eye(3), radius=10**400),
            r"base: radius = 1000.*: must be a finite",
        ),
        (
            lambda: Base(v=np.eye(3), radius=1j),
            r"base: radius = 1j: must be a finite number",
        ),
        (
            lambda: Star(alpha_deg=[120] * 3, radius=1.0, inertia=None),
            r"star: inertia = None",
        ),
        (
            lambda: Star(alpha_deg=[120] * 3, radius=1.0, inertia=Link),
            r"star: inertia = .*mapping",
        ),
        (
            lambda: Stroke(at_end=None),
            r"stroke: at_end = None: must be one of stop, ignore",
        ),
        (
            lambda: Workspace(beta_max_deg=np.nan),
            r"workspace: beta_max_deg = nan: must be",
        ),
    ],
)
def test_sections_built_in_python_are_held_to_the_same_rules(build, message):
    with pytest.raises(InputError, match=message):
        build()


def test_no_effect_and_contradictions_are_told_at_once():
    with pytest.raises(InputError) as caught:
        Star(
            alpha_deg=[120, 120, 121],
            radius=1.0,
            inertia=INERTIA,
            centre=(0.0, 0.0, 1.0),
        )
    assert [problem.key for problem in caught.value.problems] == ["centre", "alpha_deg"]


def test_long_values_are_cut_in_messages():
    said = str(refusal(SOURCE.replace("duration: 1 ", f"duration: {'x' * 500} ")))
    assert len(said) < 200
    assert "..." in said


class Switches(Section):
    on: bool = entry("a switch", default=False)
    count: int = entry("how many", "1", default=2, least=1, most=9)
    words: tuple[str, ...] = entry("some words", default=())


@pytest.mark.parametrize(
    ("source", "expected"),
    [
        ("on: true", Switches(on=True)),
        ("on: 'False'", Switches(on=False)),
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
        ("on: yes", r"line 1: on = 'yes': must be true or false"),
        (
            "count: 2.5",
            r"line 1: count = '2\.5': must be a whole number from 1 to 9 \[1\]",
        ),
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


# Documents that are made to hurt.


@pytest.mark.parametrize(
    "part",
    [
        "v: [" + "[1.0, 0.0], " * 200_000 + "]",
        "v: [" + "1, " * 60_000 + "]",
        "w: {" + "".join(f"a{i}: 1, " for i in range(30_000)) + "}",
        "w: '" + "x" * 2_000_000 + "'",
    ],
    ids=["directions", "numbers", "keys", "text"],
)
def test_a_document_of_great_size_is_refused_at_once(part, monkeypatch):
    """It took 50 s: PyYAML takes its time in parsing, event by event."""
    parsed = []
    parse = yaml.SafeLoader.get_event

    def counted(loader):
        parsed.append(parse(loader))
        return parsed[-1]

    monkeypatch.setattr(yaml.SafeLoader, "get_event", counted)
    error = refusal(SOURCE.replace("v: [[1, 0, 0], [0, 1, 0], [0, 0, 1]]", part))
    assert "no more than" in str(error)
    assert len(parsed) < MOST_NODES + 50  # beside nodes, the ends of sections


def test_many_faults_are_counted_and_few_are_printed():
    error = refusal(SOURCE + "".join(f"key{i}: 1\n" for i in range(3000)))
    assert len(error.problems) == 3000
    lines = str(error).splitlines()
    assert len(lines) == 21
    assert lines[-1] == "origin: ... and 2980 more"


@pytest.mark.parametrize(
    "line",
    [r'"\e[31mred\e[0m": 1', r'"bell\a": 1', r'"a\nb": 1', r'duration: "\e]0;title\a"',
     r'"\x9b31m": 1'],
)  # fmt: skip
def test_what_a_terminal_obeys_is_printed_as_an_escape(line, tmp_path, capsys):
    (tmp_path / "hostile.yaml").write_text(f"{SOURCE}\n{line}\n")
    assert main(["scene", "check", str(tmp_path / "hostile.yaml")]) == 1
    said = capsys.readouterr().out
    assert all(letter.isprintable() for letter in said.replace("\n", ""))
    assert len(said.splitlines()) <= 2


@pytest.mark.parametrize("name", [r"\ud800", r"a\eb", r"a\0b"])
def test_a_name_is_text_that_can_be_printed(name):
    error = refusal(SOURCE.replace("name: example2_heavy", f'name: "{name}"'))
    assert "name = " in str(error)
    str(error).encode("utf-8")


@pytest.mark.parametrize(
    "text", ["3_5", "1_000.0", "0x10", "0o17", "0b1", "1:30", "１２", "1e5 x"]
)
def test_a_number_is_written_as_yaml_1_2_and_json_write_it(text):
    assert "duration = " in str(
        refusal(SOURCE.replace("duration: 1 ", f"duration: {text} "))
    )


@pytest.mark.parametrize(
    ("text", "value"),
    [("010", 10.0), ("+1.5e1", 15.0), (".5", 0.5), ("5.", 5.0), ("1E-1", 0.1)],
)
def test_numbers_of_yaml_1_2_are_read_as_it_reads_them(text, value):
    changed = SOURCE.replace("duration: 1 ", f"duration: {text} ")
    assert read(Scene, changed, "origin").duration == value


@pytest.mark.parametrize("word", ["yes", "no", "on", "off"])
def test_the_switches_of_yaml_1_1_are_words(word):
    changed = SOURCE.replace("name: example2_heavy", f"name: {word}")
    assert read(Scene, changed, "origin").name == word
    error = refusal(SOURCE + f"moment: {{topic: {word}}}\n")
    assert "moment.topic = " in str(error)


@pytest.mark.parametrize(
    ("old", "new", "key"),
    [
        ("star.inertia.xx", 5e-324, "star.inertia"),
        ("star.inertia", {"xx": 1e-30, "yy": 1e-30, "zz": 1e-30}, "star.inertia"),
        ("base.radius", 5e-324, "base.radius"),
        ("payload", {"mass": 1e-300, "centre": [0, 0, 0]}, "payload.mass"),
        ("duration", 1e-300, "duration"),
        ("motion", {"to_angles": {"gamma": [1, 1, 1], "duration": 1e-300}},
         "motion.to_angles.duration"),
        ("motion", {"waypoints": [{"time": 0, "gamma": [1, 1, 1]},
                                  {"time": 1e-300, "gamma": [1, 1, 1]}]},
         "motion.waypoints[1].time"),
        ("friction", {"gamma": {"coulomb": 1, "smoothing": 1e-300}},
         "friction.gamma.smoothing"),
    ],
)  # fmt: skip
def test_numbers_that_only_a_slip_can_make_are_refused(old, new, key):
    with pytest.raises(InputError) as caught:
        EXAMPLE2.with_values({old: new})
    assert any(problem.key.startswith(key) for problem in caught.value.problems)
