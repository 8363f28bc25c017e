# SPDX-License-Identifier: Apache-2.0
"""Models that are wrong, and nothing else about them."""

import dataclasses

import numpy as np
import pytest

from sst_ros.control.inverse_dynamics import InverseDynamics
from sst_ros.dynamics.initial_state import initial_state
from sst_ros.mechanism.geometry import Geometry
from sst_ros.scene.scene import Actuators, load
from studies.model_errors import heavier, model_errors, without_friction

REACH, EXAMPLE2 = load("reach"), load("example2_heavy")
RATE, ACCELERATION = (0.4, -0.7, 0.9), (3.0, 2.0, -5.0)


def torque(scene):
    start = initial_state(scene, Geometry.of(scene))[:4]
    return np.array(InverseDynamics(scene).torque(tuple(start), RATE, ACCELERATION))


def test_bodies_that_weigh_more_need_torques_as_much_larger():
    """All torques but those of friction are linear in masses and inertias."""
    rotors = dataclasses.replace(REACH, actuators=Actuators(rotor_inertia=1e-4, gear_ratio=10.0))
    scene = without_friction(rotors)
    np.testing.assert_allclose(torque(heavier(scene, 1.2)), 1.2 * torque(scene), rtol=1e-12)


def test_the_factor_one_changes_nothing():
    assert heavier(REACH, 1.0) == REACH


def test_every_error_is_one_and_the_first_is_none():
    errors = list(model_errors())
    assert [e.name for e in errors if not e.changes(REACH)] == ["nominal"] == [errors[0].name]
    assert len({error.name for error in errors}) == len(errors)


def test_what_a_plant_has_not_cannot_be_unknown():
    cannot = [e.name for e in model_errors() if not e.changes(EXAMPLE2)]
    assert cannot == ["nominal", "friction unknown", "gravity missing"]


@pytest.mark.parametrize("error", list(model_errors()), ids=lambda error: error.name)
def test_an_error_keeps_the_motion(error):
    model = error.model(REACH)
    kept = ("base", "initial", "motion", "stroke", "workspace")
    assert all(getattr(model, key) == getattr(REACH, key) for key in kept)
