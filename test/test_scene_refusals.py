# SPDX-License-Identifier: Apache-2.0
"""Every way to get a scene wrong has its own words, with key, value, what is allowed and line."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from sst_ros.errors import InputError
from sst_ros.scene.scene import Scene
from sst_ros.scene.yaml_document import read

FOLDER = Path(__file__).parents[1] / "config" / "scenes"
SOURCE = (FOLDER / "example2_heavy.yaml").read_text(encoding="utf-8")


def changed(old, new):
    """Example 2 with one passage changed."""
    assert SOURCE.count(old) == 1
    return SOURCE.replace(old, new)


V = "v: [[1, 0, 0], [0, 1, 0], [0, 0, 1]]"
ALPHA = "alpha_deg: [120, 120, 120]"
STAR = "inertia: {xx: 0.39, yy: 0.39, zz: 0.26}"
DRIVES = "actuated_links:                          # one entry: all three alike\n"
LINKS = "intermediate_links:\n"
GAMMA = "gamma: [0.7853981633974483, 0.7853981633974483, 0.7853981633974483]"
LINK = "  - inertia: {xx: 9.0e-6, yy: 0.009609, zz: 0.009609}"
# What is changed, into what, and what the message must say after "origin: ".
REFUSED = {
    "unknown key": ("duration: 1 ", "durration: 1 ", r"durration = '1': unk.* mean 'duration'"),
    "removed key": ("duration: 1 ", "markers: {}\nduration: 1 ", r"markers = .*: unknown key"),
    "unknown inner key": ("radius: 0.4 ", "radus: 0.4 ", r"star\.radus = '0\.4': unknown key"),
    "duplicate key": ("duration: 1 ", "name: x\nduration: 1 ", r"name = 'x': is given twice.* 2"),
    "missing key": (ALPHA, "", r"star\.alpha_deg = None: is missing; must be 3 finite numbers > 0"),
    "vector of two": (ALPHA, "alpha_deg: [180, 180]", r"alpha_deg = \['180', '180'\]: must be 3"),
    "scalar for vector": (ALPHA, "alpha_deg: 120", r"alpha_deg = '120': must be 3 finite numbers"),
    "vector for scalar": ("duration: 1 ", "duration: [1] ", r"duration = \['1'\]: must be a f"),
    "text for number": ("duration: 1 ", "duration: soon ", r"duration = 'soon': must be a finite"),
    "nan": ("duration: 1 ", "duration: nan ", r"duration = 'nan': must be .* > 0 \[s\]"),
    ".nan": ("duration: 1 ", "duration: .nan ", r"duration = '\.nan': must be a finite number"),
    "inf": ("duration: 1 ", "duration: inf ", r"duration = 'inf': must be a finite number"),
    "-.inf": (V, "v: [[1, 0, 0], [0, 1, 0], [0, 0, -.inf]]", r"base\.v = .*: must be 3 x 3 finite"),
    "1e999": ("duration: 1 ", "duration: 1e999 ", r"duration = '1e999': must be a finite number"),
    "bool": ("duration: 1 ", "duration: true ", r"duration = 'true': must be a finite number"),
    "null": ("duration: 1 ", "duration: ~ ", r"duration = None: must be a finite number"),
    "negative duration": ("duration: 1 ", "duration: -1 ", r"= '-1': must be .* > 0 \[s\]"),
    "zero duration": ("duration: 1 ", "duration: 0 ", r"duration = '0': must be .* > 0 \[s\]"),
    "not definite": (
        STAR, "inertia: {xx: 1, yy: 1, zz: -1}", r"star\.inertia = \[-1\.0, .*: .* must be > 0"
    ),
    "not definite by a product": (
        STAR, "inertia: {xx: 1, yy: 1, zz: 1, xy: 2}", r"star\.inertia = \[-1\.0.*positive definite"
    ),
    "triangle inequality": (
        STAR, "inertia: {xx: 1, yy: 1, zz: 2.1}", r"no principal moment may exceed"
    ),
    "link not definite": (
        LINK, "  - inertia: {xx: 0, yy: 1, zz: 1}", r"intermediate_links\[0\]\.inertia = .*: .*> 0"
    ),
    "alphas do not close": (
        ALPHA, "alpha_deg: [120, 120, 119]", r"alpha_deg = .*: must sum to 360 deg; the sum is 359"
    ),
    "negative alpha": (
        ALPHA, "alpha_deg: [240, 240, -120]", r"star\.alpha_deg = .*: must be 3 finite numbers > 0"
    ),
    "degenerate base": (V, "v: [[1, 0, 0], [0, 1, 0], [1, 1, 0]]", r"base\.v = .*degenerate"),
    "left-handed base": (V, "v: [[0, 1, 0], [1, 0, 0], [0, 0, 1]]", r"base\.v = .*right-handed"),
    "zero direction": (V, "v: [[1, 0, 0], [0, 0, 0], [0, 0, 1]]", r"base\.v = .*may be zero"),
    "zero radius": ("radius: 0.35 ", "radius: 0 ", r"base\.radius = '0': must be .* > 0 \[m\]"),
    "two links": (LINK, f"{LINK}\n{LINK}", r"intermediate_links = .*: must be a list of 1 or 3"),
    "no links": (LINK, "  []", r"intermediate_links = .*: must be a list of 1 or 3 mappings"),
    "link is text": (LINK, "  - steel", r"intermediate_links\[0\] = 'steel': must be a mapping"),
    "links are text": (LINKS + LINK, "intermediate_links: steel", r"= 'steel': must be a list"),
    "unknown choice": (
        "duration: 1 ", "stroke: {at_end: bounce}\nduration: 1 ",
        r"stroke\.at_end = 'bounce': must be one of stop, ignore",
    ),
    "choice is a list": (
        "duration: 1 ", "stroke: {at_end: [stop]}\nduration: 1 ", r"at_end = .*must be one of"
    ),
    "beta_max too large": (
        "duration: 1 ", "workspace: {beta_max_deg: 181}\nduration: 1 ",
        r"workspace\.beta_max_deg = '181': must be a finite number > 0 <= 180 \[deg\]",
    ),
    "beta_max zero": (
        "duration: 1 ", "workspace: {beta_max_deg: 0}\nduration: 1 ", r"beta_max_deg = '0': .*> 0"
    ),
    "negative frequency": (
        "frequency: [18, 12, 24]", "frequency: [18, -12, 24]", r"frequency = .*: must be .*>= 0"
    ),
    "empty name": ("name: example2_heavy", "name: ''", r"name = '': must be text"),
    "section is text": ("duration: 1 ", "workspace: big\nduration: 1 ", r"'big': must be a map"),
    "unknown provenance": (
        "  duration: printed", "  speed: guessed\n  duration: printed",
        r"provenance\.speed = 'guessed': is about a key that no scene has",
    ),
    "duplicate provenance": (
        "  duration: printed", "  base: again\n  duration: printed",
        r"provenance.base = 'again': is given twice",
    ),
    "provenance is no text": (
        "  duration: printed in the paper, section 6.2", "  duration: [a]",
        r"\.duration = .*must be text"
    ),
    "syntax": (ALPHA, "alpha_deg: [120, 120, 120", r"document = .*expected .*must be YAML"),
    "tab": (f"  {ALPHA}", f"\t{ALPHA}", r"document = .*: must be YAML"),
    "alias": (V, "v: &a [[1, 0, 0], [0, 1, 0], [0, 0, 1]]\n  w: *a", r"\*a': aliases are not"),
    "merge key": (V, f"<<: {{radius: 1}}\n  {V}", r"base\.<< = .*: unknown key"),
}  # fmt: skip


def line_of_change(before, after):
    """First line, counted from 1, at which two texts differ."""
    pairs = zip(before.splitlines(), after.splitlines(), strict=False)
    return next(number for number, (a, b) in enumerate(pairs, start=1) if a != b)


@pytest.mark.parametrize(("old", "new", "message"), REFUSED.values(), ids=REFUSED)
def test_refused(old, new, message):
    source = changed(old, new)
    with pytest.raises(InputError) as caught:
        read(Scene, source, "origin")
    assert re.search(message, str(caught.value)), str(caught.value)
    assert str(caught.value).startswith("origin: line ")
    # A missing key is told at the head of its section, broken YAML where it stops making sense.
    near = line_of_change(SOURCE, source)
    assert any(abs(problem.line - near) <= 2 for problem in caught.value.problems)


@pytest.mark.parametrize(
    ("source", "message"),
    [
        ("", "origin: document = None: must be a mapping"),
        ("# nothing\n", "origin: document = None: must be a mapping"),
        ("- 1\n- 2\n", r"origin: line 1: document = \['1', '2'\]: must be a mapping"),
        ("scene", "origin: line 1: document = 'scene': must be a mapping"),
        ("a: 1\n---\nb: 2\n", "but found another document.*must be YAML"),
        ("name: \x00", "must be YAML"),
        ("[" * 100_000, "no more than 20 levels are allowed"),
        ("a: " + "{b: " * 100_000, "no more than 20 levels are allowed"),
    ],
    ids=[
        "empty",
        "comment",
        "list",
        "word",
        "two documents",
        "control character",
        "deep list",
        "deep mapping",
    ],
)
def test_documents_that_are_no_mapping_are_refused(source, message):
    with pytest.raises(InputError, match=message):
        read(Scene, source, "origin")


def test_all_faults_are_told_at_once_in_order_of_their_lines():
    source = SOURCE.replace("duration: 1 ", "duration: -1 ").replace("radius: 0.35", "radius: no")
    source = source.replace(ALPHA, "alpha_deg: [1, 2, 3]") + "colour: red\n"
    with pytest.raises(InputError) as caught:
        read(Scene, source, "origin")
    problems = caught.value.problems
    keys = [problem.key for problem in problems]
    assert keys == ["base.radius", "star.alpha_deg", "duration", "colour"]
    assert [problem.line for problem in problems] == [
        number
        for number, line in enumerate(source.splitlines(), start=1)
        if re.match(r"\s*(radius: no|alpha_deg: \[1|duration: -|colour)", line)
    ]
