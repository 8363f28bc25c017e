# SPDX-License-Identifier: Apache-2.0
"""The summary of a scene: absent terms cost nothing, present ones are counted.

Its advice.
"""

from __future__ import annotations

import ast
import dataclasses
import math
import re
from dataclasses import replace

import numpy as np
import pytest
from loaded_scenes import IGNORE, loaded
from models import seeded_samples
from slow_cases import slow_after

from sst_ros import __main__ as cli
from sst_ros.dynamics.traced_dynamics import ODE, Dynamics
from sst_ros.integration.methods import METHODS
from sst_ros.mechanism.geometry import quaternion_of
from sst_ros.report import accuracy
from sst_ros.report.scene_summary import (
    COLUMNS,
    costs,
    eigenvalues,
    largest_stable_step,
    operations,
    stability_function,
    step_advice,
    summary,
    without,
)
from sst_ros.scene.loads import Actuators, Friction, Initial, JointFriction, Moment
from sst_ros.scene.own_loads import FormulaLoad
from sst_ros.scene.scene import SCENE_TERMS, load, names, terms
from sst_ros.scene.torque_profile import SineTorque
from sst_ros.simulation.simulate import simulate

EXAMPLE2 = load("example2_heavy")
QUICK = ("elastic_stops", "general")
every_scene = pytest.mark.parametrize(
    "name",
    [
        name if name in QUICK else pytest.param(name, marks=pytest.mark.slow)
        for name in names()
    ],
)


@pytest.mark.parametrize(("name", "bare"), [("example2_heavy", 290), ("general", 388)])
def test_a_plain_scene_costs_as_a_kernel_without_optional_terms(name, bare):
    """At most 3 % more than such a kernel, written once by hand, had operations."""
    assert operations(load(name)) <= 1.03 * bare


@every_scene
def test_operations_are_counted_in_the_generated_source(name):
    tree = ast.parse(ODE(Dynamics.of(load(name))).program.source("rhs"))
    assert operations(load(name)) == sum(
        isinstance(node, ast.BinOp | ast.Call | ast.IfExp)
        or (
            isinstance(node, ast.UnaryOp) and not isinstance(node.operand, ast.Constant)
        )
        for node in ast.walk(tree)
    )


def with_everything():
    own = FormulaLoad(name="own", potential="0.5 * R13**2 + sin(gamma_1)")
    return replace(loaded(), own_loads=(own,))


def test_a_scene_without_its_terms_is_the_plain_one_by_operation():
    scene = with_everything()
    for term in SCENE_TERMS:
        if term not in ("actuated links", "intermediate links"):
            assert term in terms(scene), term
            scene = without(scene, term)
    assert ODE(Dynamics.of(scene)).program == ODE(Dynamics.of(load("general"))).program


def test_each_term_of_a_full_scene_adds_operations_or_folds():
    """Inertias and limits fold into constants or act outside the right-hand side."""
    added = {cost.name: cost.adds for cost in costs(with_everything())}
    folded = {"actuated links", "payload", "rotors", "torque limit"}
    assert {name for name, adds in added.items() if not adds} == folded


def test_a_plain_scene_has_no_angle_and_no_root():
    plain = ODE(Dynamics.of(EXAMPLE2)).program.operations
    assert set(plain) == {"add", "sub", "mul", "div"}
    scene = replace(EXAMPLE2, friction=JointFriction(gamma=Friction(viscous=0.1)))
    extra = ODE(Dynamics.of(scene)).program.operations - plain
    assert set(extra) <= {"add", "sub", "mul"}
    assert 3 <= extra.total() <= 6


@every_scene
def test_a_summary_has_all_parts_and_each_term_adds_or_folds(name):
    scene, said = load(name), summary(load(name))
    assert said.startswith(f"{name}: {scene.description}\n")
    assert f"right-hand side: 7 states, {operations(scene)} operations" in said
    found = costs(scene)
    assert [cost.name for cost in found] == terms(scene)
    for cost in found:
        row = rf"^  {cost.name} +{cost.adds} +{cost.without}$"
        assert cost.adds >= 0 and re.search(row, said, re.MULTILINE)
    listed = " ".join(said[said.index("terms absent") : said.index("\nends")].split())
    assert all((term in listed) != (term in terms(scene)) for term in SCENE_TERMS)
    for key, reason in scene.provenance:
        assert re.search(rf"^  {key} +{re.escape(reason[:20])}", said, re.MULTILINE)
    assert step_advice(scene).text in " ".join(said.split())
    assert max(map(len, said.splitlines()[1:])) <= COLUMNS


@pytest.mark.parametrize(
    ("change", "words", "there"),
    slow_after(
        2,
        [
            ({"moment": Moment(topic=True)}, "~/external_moment", True),
            ({"moment": Moment(value=(0.0, 0.0, 1.0))}, "~/external_moment", False),
            ({}, "~/external_moment", False),
            (
                {"actuators": Actuators(time_constant=0.1)},
                "right-hand side: 10 states",
                True,
            ),
        ],
    ),
    ids=["a moment from a topic", "a moment of its own", "no moment", "a lag"],
)
def test_a_summary_shows_what_a_scene_takes(change, words, there):
    assert (words in summary(replace(EXAMPLE2, **change))) is there


@pytest.mark.slow
def test_the_commands_show_list_and_check_scenes(capsys, tmp_path):
    assert cli.main(["scene", "show", "stiff"]) == 0
    assert capsys.readouterr().out == summary(load("stiff"))
    assert cli.main(["scene", "list"]) == 0
    assert [line.split()[0] for line in capsys.readouterr().out.splitlines()] == names()
    bad = tmp_path / "bad.yaml"
    bad.write_text("name: 3\nfriction: {}\n", encoding="utf-8")
    assert cli.main(["scene", "check", str(bad)]) == 1
    assert "bad.yaml: line 2: friction = None: has no effect" in capsys.readouterr().out


SHIPPED = {
    "example2": (),
    **dict.fromkeys(
        ("elastic_stops", "fast_spin", "friction", "gravity_payload", "stiff"),
        (pytest.mark.slow,),
    ),
}


def random_scenes():
    """Random manipulators that a sine moves: with no, some and very much friction."""
    for sample, viscous in zip(seeded_samples(31, 3), (0.0, 1.0, 300.0), strict=True):
        start = Initial(
            gamma=tuple(sample.gamma.tolist()),
            gamma_dot=tuple((0.1 * sample.gamma_dot).tolist()),
            orientation=tuple(quaternion_of(sample.rotation).tolist()),
        )
        torque = SineTorque(
            amplitude=tuple(sample.torque.tolist()), frequency=(3.0, 5.0, 7.0)
        )
        friction = JointFriction(gamma=Friction(viscous=viscous)) if viscous else None
        yield dataclasses.replace(
            sample.scene, initial=start, torque=torque, friction=friction, **IGNORE
        )


SCENES = [
    *(
        pytest.param(load(name), id=name, marks=marks)
        for name, marks in SHIPPED.items()
    ),
    *(
        pytest.param(scene, id=f"random {k}", marks=pytest.mark.slow)
        for k, scene in enumerate(random_scenes())
    ),
]


@pytest.mark.parametrize("scene", SCENES)
def test_summary_report_and_auto_agree_on_method_and_step(scene, monkeypatch):
    scene = dataclasses.replace(scene, duration=0.05)
    motion = simulate(scene)
    assert motion.success and 0.0 < motion.step <= 0.05
    advice = step_advice(scene)
    assert (advice.method, advice.step) == (motion.method, motion.step)
    assert f"  {advice.text}" in summary(scene).replace("\n  ", " ").replace(
        "advice ", "  "
    )
    monkeypatch.setattr(accuracy, "list_settings", lambda _: [])
    study = accuracy.study_scene(scene)
    assert study.advice == advice and study.measured < 1e-8
    said = f"Advice: {advice.text}. Measured: {study.measured:.1e} rad"
    assert said in accuracy.accuracy_page([study])


def test_a_stiff_scene_is_advised_implicit_and_its_rate_is_named():
    advice, rates = step_advice(load("stiff")), eigenvalues(load("stiff"))
    assert (
        "then rodas5p from" in advice.method
        and "stiff: step times fastest decay" in advice.text
    )
    assert f"rate at the start is {np.abs(rates).max():.3g} 1/s" in advice.text


def test_a_scene_that_cannot_start_has_none():
    away = dataclasses.replace(load("example2"), initial=Initial(gamma=(3.0, 0.5, 0.5)))
    assert step_advice(away).text.startswith("none, the scene cannot start: ")
    assert math.isnan(step_advice(away).step)


@pytest.mark.parametrize("method", METHODS.values(), ids=METHODS)
def test_a_step_is_stable_up_to_the_largest_and_not_beyond(method):
    for values in ([-100.0, -3.0], [-50.0 + 40.0j, -50.0 - 40.0j], [2j, -2j, 50.0]):
        limit = largest_stable_step(method, values)
        inside = [z for z in values if np.real(z) <= 0.0]
        if method.name == "rodas5p":
            assert limit == math.inf
            continue
        assert (
            np.abs(stability_function(method, 0.99 * limit * np.array(inside))).max()
            <= 1.00001
        )
        assert (
            np.abs(stability_function(method, 1.01 * limit * np.array(inside))).max()
            > 1.0
        )
