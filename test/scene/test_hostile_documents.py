# SPDX-License-Identifier: Apache-2.0
"""Documents that are made to hurt: refused at once, in few lines, without what a terminal obeys."""

import time

import pytest

from sst_ros.__main__ import main
from sst_ros.errors import InputError
from sst_ros.scene.scene import Scene, load, text_of
from sst_ros.scene.yaml_document import read

SOURCE = text_of("example2_heavy")[0]


def refusal(source):
    with pytest.raises(InputError) as caught:
        read(Scene, source, "origin")
    return caught.value


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
def test_a_document_of_great_size_is_refused_at_once(part):
    begin = time.process_time()
    error = refusal(SOURCE.replace("v: [[1, 0, 0], [0, 1, 0], [0, 0, 1]]", part))
    assert "no more than" in str(error)
    assert time.process_time() - begin < 2.0  # it took 50 s


def test_many_faults_are_counted_and_few_are_printed():
    error = refusal(SOURCE + "".join(f"key{i}: 1\n" for i in range(3000)))
    assert len(error.problems) == 3000
    lines = str(error).splitlines()
    assert len(lines) == 21
    assert lines[-1] == "origin: ... and 2980 more"


ESCAPE = "\x1b"


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


@pytest.mark.parametrize("text", ["3_5", "1_000.0", "0x10", "0o17", "0b1", "1:30", "１２", "1e5 x"])
def test_a_number_is_written_as_yaml_1_2_and_json_write_it(text):
    assert "duration = " in str(refusal(SOURCE.replace("duration: 1 ", f"duration: {text} ")))


@pytest.mark.parametrize(
    ("text", "value"), [("010", 10.0), ("+1.5e1", 15.0), (".5", 0.5), ("5.", 5.0), ("1E-1", 0.1)]
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
        ("friction", {"gamma": {"coulomb": 1, "smoothing": 1e-300}}, "friction.gamma.smoothing"),
    ],
)  # fmt: skip
def test_numbers_that_only_a_slip_can_make_are_refused(old, new, key):
    with pytest.raises(InputError) as caught:
        load("example2_heavy").with_values({old: new})
    assert any(problem.key.startswith(key) for problem in caught.value.problems)
