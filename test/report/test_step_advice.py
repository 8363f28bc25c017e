# SPDX-License-Identifier: Apache-2.0
"""Advice is what a run with `auto` does, wherever it is given."""

import dataclasses
import math

import numpy as np
import pytest
from loaded_scenes import IGNORE
from models import seeded_samples

from sst_ros.integration.methods import METHODS
from sst_ros.mechanism.frames import quaternion_of
from sst_ros.report import work_precision
from sst_ros.report.accuracy import accuracy_page, documents
from sst_ros.report.scene_summary import (
    eigenvalues,
    largest_stable_step,
    stability_function,
    step_advice,
    summary,
)
from sst_ros.scene.loads import Friction, JointFriction, SineTorque
from sst_ros.scene.scene import Initial, load
from sst_ros.simulation.simulate import simulate

SHIPPED = ("example2", "stiff", "friction", "elastic_stops", "gravity_payload", "fast_spin")


def random_scenes():
    """Random manipulators that a sine moves: without friction, with some, with so much."""
    for sample, viscous in zip(seeded_samples(31, 3), (0.0, 1.0, 300.0), strict=True):
        start = Initial(
            gamma=tuple(sample.gamma.tolist()),
            gamma_dot=tuple((0.1 * sample.gamma_dot).tolist()),
            orientation=tuple(quaternion_of(sample.rotation).tolist()),
        )
        torque = SineTorque(amplitude=tuple(sample.torque.tolist()), frequency=(3.0, 5.0, 7.0))
        friction = JointFriction(gamma=Friction(viscous=viscous)) if viscous else None
        yield dataclasses.replace(
            sample.scene, initial=start, torque=torque, friction=friction, **IGNORE
        )


SCENES = [
    *(pytest.param(load(name), id=name) for name in SHIPPED),
    *(pytest.param(scene, id=f"random {k}") for k, scene in enumerate(random_scenes())),
]


@pytest.mark.parametrize("scene", SCENES)
def test_summary_report_and_auto_agree_on_method_and_step(scene, monkeypatch):
    scene = dataclasses.replace(scene, duration=0.05)
    motion = simulate(scene)
    assert motion.success and 0.0 < motion.step <= 0.05
    advice = step_advice(scene)
    assert (advice.method, advice.step) == (motion.method, motion.step)
    assert f"  {advice.text}" in summary(scene).replace("\n  ", " ").replace("advice ", "  ")
    monkeypatch.setattr(work_precision, "solver_grid", lambda *_: [])
    study = work_precision.work_precision(scene)
    assert study.advice == advice and study.measured[0] < 1e-8
    assert next(documents([study]))["advice"]["text"] == advice.text
    assert f"Advice: {advice.text}. Measured: {study.measured[0]:.1e} rad" in accuracy_page([study])


def test_a_stiff_scene_is_advised_the_implicit_method_and_the_rate_is_named():
    advice, rates = step_advice(load("stiff")), eigenvalues(load("stiff"))
    assert "then rodas5p from" in advice.method and "stiff: step times fastest decay" in advice.text
    assert f"rate at the start is {np.abs(rates).max():.3g} 1/s" in advice.text


def test_a_scene_that_cannot_start_has_none():
    away = dataclasses.replace(load("example2"), initial=Initial(gamma=(9.0, 0.5, 0.5)))
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
        assert np.abs(stability_function(method, 0.99 * limit * np.array(inside))).max() <= 1.00001
        assert np.abs(stability_function(method, 1.01 * limit * np.array(inside))).max() > 1.0
