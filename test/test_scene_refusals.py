# SPDX-License-Identifier: Apache-2.0
"""Every way to get a scene wrong has its own words, with key, value, what is allowed
and line.
"""

from __future__ import annotations

import re

import pytest

from sst_ros.cli.runs import check
from sst_ros.errors import InputError
from sst_ros.scene.scene import Scene, load, text_of
from sst_ros.scene.yaml_document import read

SOURCE, ORIGIN = text_of("example2_heavy")


def changed(old, new):
    """Example 2 with one passage changed."""
    assert SOURCE.count(old) == 1
    return SOURCE.replace(old, new)


def refusal(source):
    with pytest.raises(InputError) as caught:
        read(Scene, source, "origin")
    return caught.value


V = "v: [[1, 0, 0], [0, 1, 0], [0, 0, 1]]"
ALPHA = "alpha_deg: [120, 120, 120]"
STAR = "inertia: {xx: 0.39, yy: 0.39, zz: 0.26}"
LINKS = "intermediate_links:\n"
GAMMA = "gamma: [0.7853981633974483, 0.7853981633974483, 0.7853981633974483]"
LINK = "  - inertia: {xx: 9.0e-6, yy: 0.009609, zz: 0.009609}"
# What is changed, into what, and what the message must say after "origin: ".
REFUSED = [
    ("duration: 1 ", "durration: 1 ", r"durration = '1': unk.* mean 'duration'"),
    ("radius: 0.4 ", "radus: 0.4 ", r"star\.radus = '0\.4': unknown key"),
    ("duration: 1 ", "name: x\nduration: 1 ", r"name = 'x': is given twice.* 2"),
    (ALPHA,
     "", r"star\.alpha_deg = None: is missing; must be 3 finite numbers >= 1e-12"),
    (ALPHA, "alpha_deg: [180, 180]", r"alpha_deg = \['180', '180'\]: must be 3"),
    (ALPHA, "alpha_deg: 120", r"alpha_deg = '120': must be 3 finite numbers"),
    ("duration: 1 ", "duration: [1] ", r"duration = \['1'\]: must be a f"),
    ("duration: 1 ", "duration: soon ", r"duration = 'soon': must be a finite"),
    ("duration: 1 ", "duration: nan ", r"duration = 'nan': must be .* >= 1e-12 \[s\]"),
    ("duration: 1 ", "duration: 1e999 ",
     r"duration = '1e999': must be a finite number"),
    ("duration: 1 ", "duration: true ", r"duration = 'true': must be a finite number"),
    ("duration: 1 ", "duration: ~ ", r"duration = None: must be a finite number"),
    ("duration: 1 ", "duration: 0 ", r"duration = '0': must be .* >= 1e-12 \[s\]"),
    (STAR, "inertia: {xx: 1, yy: 1, zz: -1}",
     r"star\.inertia = \[1\.0, .*: .* must be > 0"),
    (STAR, "inertia: {xx: 1, yy: 1, zz: 1, xy: 2}",
     r"star\.inertia = \[1\.0.*positive definite"),
    (STAR, "inertia: {xx: 1, yy: 1, zz: 2.1}", r"no principal moment may exceed"),
    (LINK, "  - inertia: {xx: 0, yy: 1, zz: 1}",
     r"intermediate_links\[0\]\.inertia = .*: .*> 0"),
    (ALPHA, "alpha_deg: [120, 120, 119]",
     r"alpha_deg = .*: must sum to 360 deg; the sum is 359"),
    (ALPHA, "alpha_deg: [240, 240, -120]",
     r"alpha_deg = .*: must be 3 finite numbers >= 1e-12"),
    (V, "v: [[1, 0, 0], [0, 1, 0], [1, 1, 0]]", r"base\.v = .*degenerate"),
    (V, "v: [[0, 1, 0], [1, 0, 0], [0, 0, 1]]", r"base\.v = .*right-handed"),
    (V, "v: [[1, 0, 0], [0, 0, 0], [0, 0, 1]]", r"base\.v = .*may be zero"),
    (V, "arcs_deg: [70, 85, 155]",
     r"base\.arcs_deg = .*: must close: each less than the sum of"),
    (V, "arcs_deg: [120, 120, 120]",
     r"base\.arcs_deg = .*: must close: .*less than 360 deg"),
    (V, "arcs_deg: [1e-3, 1e-3, 1e-3]",
     r"base\.v = .*: P1, P2, P3 must lie 4e-05 rad apart"),
    (V, f"arcs_deg: [70, 85, 95]\n  {V}", r"base = .*: give one of v, arcs_deg"),
    (V, "", "base = None: give one of v, arcs_deg"),
    (STAR, "inertia: [[1, 0, 0], [0, 1, 0], [0, 0, 1]]",
     "a mapping with the keys xx, yy, zz, xy,"),
    (GAMMA, "gamma: [45, 45, 45]",
     r"initial\.gamma = .*: must be 3 .* \[rad\]: in rad\?"),
    ("duration: 1 ", "motion: {to_angles: {gamma: [9, 0, 0]}}\nduration: 1 ", "in rad"),
    ("radius: 0.35 ", "radius: 0 ", r"base\.radius = '0': must be .* >= 1e-12 \[m\]"),
    (LINK, f"{LINK}\n{LINK}", r"intermediate_links = .*: must be a list of 1 or 3"),
    (LINK, "  - steel", r"intermediate_links\[0\] = 'steel': must be a mapping"),
    (LINKS + LINK, "intermediate_links: steel", r"= 'steel': must be a list"),
    ("radius: 0.4 ", "radius: 0.4\n  centre: [0, 0, 0.1] #",
     r"star\.centre = .*: acts on mass: "),
    ("radius: 0.4 ", "radius: 0.4\n  mass: 1\n  centre: [0, 0, 0.5] #",
     r"star\.centre = .*: must lie within 0\.4 m of O"),
    ("radius: 0.4 ", "radius: 0.4\n  mass: 3\n  centre: [0.3, 0, 0.25] #",
     r"star\.centre = .*: must fit the inertia about O"),
    (LINK, "  - {mass: 0.1, centre: [0.1, 0, 0]}",
     r"intermediate_links\[0\]\.centre = .*: must fit the inertia about O"),
    (STAR, "inertia: {xx: 0.39, yy: 0.39, zz: 2.6e10}",
     "no principal moment may exceed"),
    (STAR, "inertia: {xx: 3e9, yy: 3e9, zz: 2e9}", r"xx = .*must not exceed 1e"),
    ("duration: 1 ", "stroke: {at_end: bounce}\nduration: 1 ",
     r"stroke\.at_end = 'bounce': must be one of stop, ignore"),
    ("duration: 1 ", "stroke: {at_end: [stop]}\nduration: 1 ",
     r"at_end = .*must be one of"),
    ("duration: 1 ", "workspace: {beta_max_deg: 181}\nduration: 1 ",
     r"workspace\.beta_max_deg = '181': must be a finite number >= 1e-12 and"
     r" <= 180 \[deg\]"),
    ("duration: 1 ", "workspace: {beta_max_deg: 0}\nduration: 1 ",
     r"max_deg = '0': .*>= 1e-12"),
    ("frequency: [18, 12, 24]", "frequency: [18, -12, 24]",
     r"frequency = .*: must be .*>= 0"),
    ("name: example2_heavy", "name: ''", r"name = '': must be text"),
    ("duration: 1 ", "workspace: big\nduration: 1 ", r"'big': must be a map"),
    ("  duration: printed", "  speed: guessed\n  duration: printed",
     r"provenance\.speed = 'guessed': is about a key that no scene has"),
    ("  duration: printed", "  base: again\n  duration: printed",
     r"provenance.base = 'again': is given twice"),
    ("  duration: printed in the paper, section 6.2", "  duration: [a]",
     r"\.duration = .*must be text"),
    (ALPHA, "alpha_deg: [120, 120, 120", r"document = .*expected .*must be YAML"),
    (f"  {ALPHA}", f"\t{ALPHA}", r"document = .*: must be YAML"),
    (V, "v: &a [[1, 0, 0], [0, 1, 0], [0, 0, 1]]\n  w: *a", r"\*a': .* no aliases"),
    (V, f"<<: {{radius: 1}}\n  {V}", r"base\.<< = .*: unknown key"),
]  # fmt: skip


@pytest.mark.parametrize(("old", "new", "message"), REFUSED)
def test_refused(old, new, message):
    error = refusal(changed(old, new))
    assert re.search(message, str(error)), str(error)
    assert str(error).startswith("origin: line ")
    # A missing key is told at the head of its section, broken YAML where it stops
    # making sense.
    near = 1 + SOURCE[: SOURCE.index(old)].count("\n")
    assert any(abs(problem.line - near) <= 2 for problem in error.problems)


NO_MAPPING = {
    "empty": ("", "origin: document = None: must be a mapping"),
    "comment": ("# nothing\n", "origin: document = None: must be a mapping"),
    "list": (
        "- 1\n- 2\n",
        r"origin: line 1: document = \['1', '2'\]: must be a mapping",
    ),
    "word": ("scene", "origin: line 1: document = 'scene': must be a mapping"),
    "two documents": ("a: 1\n---\nb: 2\n", "but found another document.*must be YAML"),
    "control character": ("name: \x00", "must be YAML"),
    "deep list": ("[" * 100_000, "no more than .* 20 levels are allowed"),
    "deep mapping": ("a: " + "{b: " * 100_000, "no more than .* 20 levels are allowed"),
}


@pytest.mark.parametrize(("source", "message"), NO_MAPPING.values(), ids=NO_MAPPING)
def test_documents_that_are_no_mapping_are_refused(source, message):
    assert re.search(message, str(refusal(source)))


BODIES = SOURCE[: SOURCE.index("provenance:")]


@pytest.mark.parametrize(
    ("section", "key", "line"),
    [
        (
            (
                "springs:\n- {joint: mu_1, stiffness: 4, rest: 0}\n- {joint: mu_2,"
                " rest: 0}"
            ),
            "springs[1].stiffness",
            3,
        ),
        ("provenance:\n  ' star-mass ': guessed", "provenance.star-mass", 1),
    ],
)
def test_a_key_without_a_line_has_that_of_its_deepest_part(section, key, line):
    (problem,) = refusal(BODIES + section).problems
    assert (problem.key, problem.line) == (key, len(BODIES.splitlines()) + line)


# One more section at the end of example 2, and what must be said of it after "origin:
# line N: ".
SECTIONS_REFUSED = [
    ("gravity: {acceleration: [0, 0, 0]}",
     r"gravity = None: has no effect without acc.*: leave"),
    ("gravity: {acceleration: [0, 0, -9.8]}",
     r"gravity = .*: acts on nothing: no body has a m"),
    ("gravity: -9.8", r"gravity = '-9\.8': must be a mapping"),
    ("gravity: {acceleration: [0, 9]}", r"on = .*: must be 3 .* \[m/s\^2\]"),
    ("moment: {}", r"moment = None: give one of value, topic"),
    ("moment: {value: [0, 0, 1], topic: true}",
     r"moment = .*: give one of value, topic"),
    ("moment: {topic: /wrench}", r"topic = '/wrench': must be true or false"),
    ("friction: {}", r"friction = None: has no effect without gamma or mu or"),
    ("friction: {mu: {viscous: 1}, gamma_1: {viscous: 1}}",
     r"friction\.gamma_1 = .*unknown key"),
    ("friction: {mu: {}}", r"friction\.mu = None: .* viscous or .*leave it out"),
    ("friction: {mu: {viscous: -1}}", r"viscous = '-1': must be .* >= 0 \[N m s/rad\]"),
    ("friction: {beta: {coulomb: -1}}", r"friction\.beta\.coulomb = '-1': .*>"),
    ("friction: {mu: {coulomb: 1, smoothing: 0}}",
     r"smoothing = '0': .*>= 1e-12 \[rad/s\]"),
    ("friction: {mu: {coulomb: 2, static: 1}}",
     r"static = 1\.0: must be >= coulomb = 2\.0 N m"),
    ("friction: {mu: {viscous: 2, smoothing: 1}}",
     r"smoothing = 1\.0: acts on coulomb or stat"),
    ("friction: {mu: {coulomb: 2, stribeck: 1}}",
     r"stribeck = 1\.0: acts on static: give it"),
    ("springs: [{joint: mu_1, stiffness: -4, rest: 0}]",
     r"springs\[0\]\.stiffness = '-4': must be a finite number >= 1e-12 \[N m/rad\]"),
    ("springs: [{joint: gamma_4, stiffness: 4, rest: 0}]",
     r"joint = 'gamma_4': must be one of"),
    ("springs: [{joint: mu_1, stiffness: 4}]",
     r"springs\[0\]\.rest = None: is missing.*\[rad\]"),
    ("springs: {joint: mu_1}", r"springs = .*: must be a list of map"),
    ("springs: [{joint: mu_1, stiffness: 4e12, rest: 0}]",
     r"stiffness = 4000000000000\.0: must not exceed 1e\+09 in size: use m, kg, s,"
     r" rad, N"),
    ("actuators: {rotor_inertia: -1}", r"rotor_inertia = '-1': .* >= 0 \[kg m"),
    ("actuators: {rotor_inertia: 1, gear_ratio: -50}",
     r"gear_ratio = '-50': .*>= 1e-12 \[1\]"),
    ("actuators: {gear_ratio: 50, torque_limit: 1}",
     r"gear_ratio = 50\.0: acts on rotor_"),
    ("actuators: {}",
     r"actuators = None: has no effect without rotor_i.*: leave it out"),
    ("actuators: {torque_limit: 0}", r"torque_limit = '0': .* >= 1e-12 \[N m\]"),
    ("actuators: {time_constant: 0}", r"time_constant = '0': must be .* >= 1e-12 \[s"),
    ("stroke: {at_end: elastic}",
     r"stroke\.stiffness = None: is given with at_end: elastic, an"),
    ("stroke: {stiffness: 10}", r"stroke\.stiffness = 10\.0: is given with at_end: e"),
    ("stroke: {damping: 1}", r"stroke\.damping = 1\.0: is given with at_end: elast"),
    ("stroke: {at_end: elastic, stiffness: 1, restitution: 1.1, impact_rate: 1}",
     r"restitution = '1\.1': .* >= 0\.01 and <= 1 \[1\]"),
    ("stroke: {at_end: elastic, stiffness: 1, restitution: 0.5}",
     r"impact_rate = None: is given with restitution, both or none"),
    ("stroke: {at_end: elastic, stiffness: 1, damping: 1, restitution: 0.5,"
     " impact_rate: 1}",
     r"damping = 1\.0: give either damping or restitution"),
    ("stroke: {at_end: elastic, stiffness: 1, damping: -1}",
     r"damping = '-1': .*>= 0 \[s/rad\]"),
    ("payload: {centre: [0, 0, 0]}", r"payload\.mass = None: is missing"),
    ("payload: {mass: 0, centre: [0, 0, 0]}",
     r"payload\.mass = '0': must be .* >= 1e-12 \[kg\]"),
    ("payload: {mass: 1, centre: [0, 0, 0], inertia: {xx: 1, yy: 1, zz: 3}}",
     r"payload\.inertia = .*: no principal moment may exceed"),
]  # fmt: skip


@pytest.mark.parametrize(("section", "message"), SECTIONS_REFUSED)
def test_a_section_is_refused(section, message):
    error = refusal(BODIES + section + "\n")
    (problem,) = error.problems
    lines = (BODIES + section).splitlines()
    assert re.match(rf"origin: line {problem.line}: \S*{message}", str(error))
    assert len(BODIES.splitlines()) < problem.line <= len(lines)


def test_a_fault_hides_no_other_and_their_lines_rise():
    source = BODIES.replace("radius: 0.35 ", "radius: wide ").replace(
        "duration: 1 ", "time: 1 "
    )
    source = source.replace("[120, 120, 120]", "[120, 120, 119]")
    source += (
        "gravity: {acceleration: [0, 0, -9.8]}\nstroke: {at_end: no, restitution: 2}\n"
    )
    source += "springs: [{joint: mu_1, stiffness: 1e11, rest: 0}, {joint: mu_1}]\n"
    source += "provenance: {durations: printed}\n"
    problems = refusal(source).problems
    told = {
        "base.radius": "radius: wide",
        "star.alpha_deg": "alpha_deg",
        "time": "time: 1",
        "stroke.at_end": "stroke:",
        "stroke.restitution": "stroke:",
        "springs[1].stiffness": "springs:",
        "springs[1].rest": "springs:",
    }
    assert [problem.key for problem in problems] == list(told)
    lines = source.splitlines()
    assert all(told[fault.key] in lines[fault.line - 1] for fault in problems)


def test_sections_that_contradict_each_other_are_refused():
    link = "  - {mass: 1, centre: [0, 0, 9], inertia: {xx: 90, yy: 90, zz: 9}}"
    keys = [problem.key for problem in refusal(BODIES.replace(LINK, link)).problems]
    assert keys == [f"intermediate_links[{k}].centre" for k in range(3)]


@pytest.mark.parametrize(
    ("gamma", "message"),
    [
        ("[0.05, 0.05, 1.5]", "cannot start here: no admissible assembly at gamma"),
        (
            "[2, 2, 2]",
            r"must lie in the stroke, 0 to \(1\.570796, 1\.570796, 1\.570796\) rad",
        ),
        ("[0.78, 0.78, -0.1]", "must lie in the stroke"),
    ],
)
def test_a_scene_that_cannot_start_is_told_with_key_and_line(tmp_path, gamma, message):
    path = tmp_path / "start.yaml"
    path.write_text(SOURCE.replace(GAMMA, f"gamma: {gamma}"), encoding="utf-8")
    line = 1 + SOURCE[: SOURCE.index(GAMMA)].count("\n")
    with pytest.raises(
        InputError, match=rf"start\.yaml: line {line}: initial\.gamma = .*{message}"
    ):
        check(path)


@pytest.mark.parametrize("name", ["general", ORIGIN])
def test_a_scene_that_can_start_is_returned(name):
    assert check(name) == load(name)
