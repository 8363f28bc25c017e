# SPDX-License-Identifier: Apache-2.0
"""Optional terms: each wrong one has its own words and its line, and faults do not hide others."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from sst_ros.cli.scenes import check
from sst_ros.dynamics.traced_dynamics import Dynamics
from sst_ros.errors import InputError
from sst_ros.scene.scene import Scene, load
from sst_ros.scene.yaml_document import read

FOLDER = Path(__file__).parents[1] / "config" / "scenes"
SOURCE = (FOLDER / "example2_heavy.yaml").read_text(encoding="utf-8")
BODIES = SOURCE[: SOURCE.index("provenance:")]

# One more section at the end of example 2, and what must be said of it after "origin: line N: ".
REFUSED = {
    "no field": ("gravity: {acceleration: [0, 0, 0]}", r"gravity\.acceleration .*: must not be z"),
    "gravity on nothing": (
        "gravity: {acceleration: [0, 0, -9.8]}", r"gravity = .*: acts on nothing: no body has a m"
    ),
    "gravity is a number": ("gravity: -9.8", r"gravity = '-9\.8': must be a mapping"),
    "gravity of two": ("gravity: {acceleration: [0, 9]}", r"on = .*: must be 3 .* \[m/s\^2\]"),
    "moment without value": ("moment: {}", r"moment = None: give either value or topic: true"),
    "moment twice": ("moment: {value: [0, 0, 1], topic: true}", r"moment = .*: give either value"),
    "topic is a name": ("moment: {topic: /wrench}", r"topic = '/wrench': must be true or false"),
    "friction of nothing": ("friction: {}", r"friction = None: names no joint: give gamma, mu or"),
    "friction of a leg": (
        "friction: {mu: {viscous: 1}, gamma_1: {viscous: 1}}", r"friction\.gamma_1 = .*unknown key"
    ),
    "no coefficient": ("friction: {mu: {}}", r"friction\.mu\.viscous = 0\.0: .*leave it out"),
    "negative viscous": (
        "friction: {mu: {viscous: -1}}", r"viscous = '-1': must be .* >= 0 \[N m s/rad\]"
    ),
    "negative coulomb": ("friction: {beta: {coulomb: -1}}", r"friction\.beta\.coulomb = '-1': .*>"),
    "sudden coulomb": (
        "friction: {mu: {coulomb: 1, smoothing: 0}}", r"smoothing = '0': .*> 0 \[rad/s\]"
    ),
    "static below coulomb": (
        "friction: {mu: {coulomb: 2, static: 1}}", r"static = 1\.0: must be >= coulomb = 2 N m"
    ),
    "smoothing of nothing": (
        "friction: {mu: {viscous: 2, smoothing: 1}}", r"smoothing = 1\.0: acts on coulomb or stat"
    ),
    "stribeck of nothing": (
        "friction: {mu: {coulomb: 2, stribeck: 1}}", r"stribeck = 1\.0: acts on static: give it"
    ),
    "spring that pushes": (
        "springs: [{joint: mu_1, stiffness: -4, rest: 0}]",
        r"springs\[0\]\.stiffness = '-4': must be a finite number > 0 \[N m/rad\]",
    ),
    "spring nowhere": (
        "springs: [{joint: gamma_4, stiffness: 4, rest: 0}]", r"joint = 'gamma_4': must be one of"
    ),
    "spring without rest": (
        "springs: [{joint: mu_1, stiffness: 4}]", r"springs\[0\]\.rest = None: is missing.*\[rad\]"
    ),
    "second spring": (
        "springs:\n  - {joint: mu_1, stiffness: 4, rest: 0}\n  - {joint: mu_2, rest: 0}",
        r"springs\[1\]\.stiffness = None: is missing",
    ),
    "springs are a mapping": ("springs: {joint: mu_1}", r"springs = .*: must be a list of map"),
    "spring in N/mm": (
        "springs: [{joint: mu_1, stiffness: 4e12, rest: 0}]",
        r"stiffness = 4000000000000\.0: must not exceed 1e\+09 in size: use m, kg, s, rad, N",
    ),
    "negative rotor": ("actuators: {rotor_inertia: -1}", r"rotor_inertia = '-1': .* >= 0 \[kg m"),
    "negative gear": (
        "actuators: {rotor_inertia: 1, gear_ratio: -50}", r"gear_ratio = '-50': .*> 0 \[1\]"
    ),
    "gear of nothing": ("actuators: {gear_ratio: 50}", r"gear_ratio = 50\.0: acts on rotor_"),
    "actuators of nothing": ("actuators: {}", r"actuators = None: changes nothing: leave it out"),
    "no torque at all": ("actuators: {torque_limit: 0}", r"torque_limit = '0': .* > 0 \[N m\]"),
    "lag of no time": ("actuators: {time_constant: 0}", r"time_constant = '0': must be .* > 0 \[s"),
    "elastic without stiffness": (
        "stroke: {at_end: elastic}", r"stroke\.stiffness = None: is given with at_end: elastic, an"
    ),
    "soft stop": ("stroke: {stiffness: 10}", r"stroke\.stiffness = 10\.0: is given with at_end: e"),
    "damped stop": ("stroke: {damping: 1}", r"stroke\.damping = 1\.0: is given with at_end: elast"),
    "rigid impact": (
        "stroke: {at_end: impact}", r"stroke\.at_end = 'impact': must be one of stop, ignore, elast"
    ),
    "impact that drives": (
        "stroke: {at_end: elastic, stiffness: 1, restitution: 1.1, impact_rate: 1}",
        r"restitution = '1\.1': .* >= 0\.01 <= 1 \[1\]",
    ),
    "restitution at no rate": (
        "stroke: {at_end: elastic, stiffness: 1, restitution: 0.5}",
        r"impact_rate = None: is given with restitution, both or none",
    ),
    "restitution and damping": (
        "stroke: {at_end: elastic, stiffness: 1, damping: 1, restitution: 0.5, impact_rate: 1}",
        r"damping = 1\.0: give either damping or restitution",
    ),
    "negative damping": (
        "stroke: {at_end: elastic, stiffness: 1, damping: -1}", r"damping = '-1': .*>= 0 \[s/rad\]"
    ),
    "payload without mass": ("payload: {centre: [0, 0, 0]}", r"payload\.mass = None: is missing"),
    "weightless payload": (
        "payload: {mass: 0, centre: [0, 0, 0]}", r"payload\.mass = '0': must be .* > 0 \[kg\]"
    ),
    "flat payload": (
        "payload: {mass: 1, centre: [0, 0, 0], inertia: {xx: 1, yy: 1, zz: 3}}",
        r"payload\.inertia = .*: no principal moment may exceed",
    ),
    "impossible edge": ("workspace: {at_edge: elastic}", r"at_edge = 'elastic': must be one of st"),
}  # fmt: skip


@pytest.mark.parametrize(("section", "message"), REFUSED.values(), ids=REFUSED)
def test_refused(section, message):
    with pytest.raises(InputError) as caught:
        read(Scene, BODIES + section + "\n", "origin")
    (problem,) = caught.value.problems
    lines = (BODIES + section).splitlines()
    assert re.match(rf"origin: line {problem.line}: \S*{message}", str(caught.value))
    assert len(BODIES.splitlines()) < problem.line <= len(lines)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("radius: 0.4 ", "radius: 0.4\n  centre: [0, 0, 0.1] #", r"star\.centre = .*: needs mass"),
        (
            "radius: 0.4 ",
            "radius: 0.4\n  mass: 1\n  centre: [0, 0, 0.5] #",
            r"star\.centre = .*: must lie within 0\.4 m of O",
        ),
        (
            "radius: 0.4 ",
            "radius: 0.4\n  mass: 3\n  centre: [0.3, 0, 0.25] #",
            r"star\.centre = .*: must fit the inertia about O",
        ),
        (
            "  - inertia: {xx: 9.0e-6, yy: 0.009609, zz: 0.009609}",
            "  - {mass: 0.1, centre: [0.1, 0, 0]}",
            r"intermediate_links\[0\]\.centre = .*: must fit the inertia about O",
        ),
        ("yy: 0.39, zz: 0.26", "yy: 0.39, zz: 2.6e10", "no principal moment may exceed"),
        ("xx: 0.39, yy: 0.39, zz: 0.26", "xx: 3e9, yy: 3e9, zz: 2e9", r"xx = .*must not exceed 1e"),
    ],
)
def test_bodies_that_contradict_themselves_are_refused(old, new, message):
    assert SOURCE.count(old) == 1
    with pytest.raises(InputError, match=message):
        read(Scene, SOURCE.replace(old, new), "origin")


def test_a_fault_in_one_place_hides_none_in_another():
    source = BODIES.replace("radius: 0.35 ", "radius: wide ").replace("duration: 1 ", "time: 1 ")
    source = source.replace("[120, 120, 120]", "[120, 120, 119]")
    source += "gravity: {acceleration: [0, 0, -9.8]}\nstroke: {at_end: no, restitution: 2}\n"
    source += "springs: [{joint: mu_1, stiffness: 1e11, rest: 0}, {joint: mu_1}]\n"
    source += "provenance: {durations: printed}\n"
    with pytest.raises(InputError) as caught:
        read(Scene, source, "origin")
    keys = [problem.key for problem in caught.value.problems]
    assert keys == [
        "base.radius",
        "star.alpha_deg",
        "time",
        "stroke.at_end",
        "stroke.restitution",
        "springs[1].stiffness",
        "springs[1].rest",
    ]


def test_what_contradicts_itself_across_sections_is_checked_once_each_of_them_is_valid():
    source = BODIES
    link = "{mass: 1, centre: [0, 0, 9], inertia: {xx: 90, yy: 90, zz: 9}}"
    source = source.replace("inertia: {xx: 9.0e-6, yy: 0.009609, zz: 0.009609}", link)
    with pytest.raises(InputError) as caught:
        read(Scene, source, "origin")
    keys = [problem.key for problem in caught.value.problems]
    assert keys == [f"intermediate_links[{k}].centre" for k in range(3)]


def massless(*which):
    source = SOURCE
    if "actuated" in which:
        source = re.sub(r"  - inertia: .*xz: .*", "  - {}", source)
    if "intermediate" in which:
        source = source.replace("  - inertia: {xx: 9.0e-6, yy: 0.009609, zz: 0.009609}", "  - {}")
    return read(Scene, source, "origin")


def test_links_without_inertia_are_legal_and_cost_nothing():
    counts = [
        sum(Dynamics.of(scene).program.operations.values())
        for scene in (
            load("example2_heavy"),
            massless("actuated"),
            massless("intermediate"),
            massless("actuated", "intermediate"),
        )
    ]
    assert counts[0] == counts[1] > counts[2] > counts[3]
    for scene in (massless("actuated"), massless("actuated", "intermediate")):
        slope = Dynamics.of(scene).derivative(0.1, 0.2, 0.3, 0.9, 1.0, -1.0, 0.5, 1.0, 2.0, 3.0)
        assert np.all(np.isfinite(slope))


START = "gamma: [0.7853981633974483, 0.7853981633974483, 0.7853981633974483]"


@pytest.mark.parametrize(
    ("gamma", "message"),
    [
        ("[0.05, 0.05, 1.5]", "cannot start here: no admissible assembly at gamma"),
        ("[45, 45, 45]", r"must lie in the stroke, 0 to \(1\.570796, 1\.570796, 1\.570796\) rad"),
        ("[0.78, 0.78, -0.1]", "must lie in the stroke"),
    ],
)
def test_a_scene_that_cannot_start_is_told_with_key_and_line(tmp_path, gamma, message):
    path = tmp_path / "start.yaml"
    path.write_text(SOURCE.replace(START, f"gamma: {gamma}"), encoding="utf-8")
    line = 1 + SOURCE.splitlines().index(next(x for x in SOURCE.splitlines() if START in x))
    with pytest.raises(
        InputError, match=rf"start\.yaml: line {line}: initial\.gamma = .*{message}"
    ):
        check(path)


@pytest.mark.parametrize("name", ["example2_heavy", FOLDER / "general.yaml"])
def test_a_scene_that_can_start_is_returned(name):
    assert check(name) == load(name)
