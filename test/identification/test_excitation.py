# SPDX-License-Identifier: Apache-2.0
"""Designed motions: within the limits, better conditioned, and runnable by the controller."""

import numpy as np
import pytest
from identification import manipulators

from sst_ros import load_scene, reference_motion
from sst_ros.control.plan import examine_motion
from sst_ros.errors import InputError, MotionRefused
from sst_ros.identification import parameters
from sst_ros.identification.excitation import design
from sst_ros.identification.parameters import Regressor, find_independent
from sst_ros.scene.scene import Scene
from sst_ros.scene.yaml_document import dump, read

LIMITS = {
    "actuators.torque_limit": 12.0,
    "actuators.velocity_limit": 2.5,
    "actuators.acceleration_limit": 15.0,
}


def condition(scene):
    """Of the regressor of the base parameters over the scene's motion, columns of length one."""
    motion = reference_motion(scene)
    regressor = Regressor(scene, parameters.select_names(scene, None))
    times = np.linspace(0.0, motion.duration, 200)
    _, columns = regressor(*manipulators.states(motion, times))
    base = find_independent(columns, regressor.names)
    matrix = base.of_columns(columns).reshape(-1, len(base.chosen))
    return np.linalg.cond(matrix / np.linalg.norm(matrix, axis=0)), base


@pytest.fixture(scope="module")
def designed():
    scene = load_scene("reach").with_values(LIMITS)
    return scene, design(scene, duration=4.0, harmonics=4, iterations=15)


def test_a_designed_motion_keeps_within_all_limits_and_rests_at_both_ends(designed):
    _, found = designed
    motion = reference_motion(found.scene)
    assert examine_motion(motion, found.scene).problems == ()
    for time in (0.0, motion.duration):
        at = motion.at(time)
        assert np.abs([*at.gamma_dot, *at.gamma_ddot]).max() < 1e-9
        assert at.gamma == pytest.approx(found.scene.initial.gamma, abs=1e-12)


def test_it_is_better_conditioned_than_a_spiral_and_than_chirps(designed):
    scene, found = designed
    own, base = condition(found.scene)
    assert own == pytest.approx(found.condition, rel=0.1)
    assert base.chosen == found.base.chosen
    assert own < 50.0
    assert condition(scene)[0] > 2.5 * own
    assert condition(manipulators.sweeping(scene, 4.0, 1.0))[0] > 2.0 * own
    assert "condition number" in found.table()


def test_the_scene_is_a_document_like_any_other(designed):
    _, found = designed
    assert read(Scene, dump(found.scene), "designed") == found.scene
    assert found.scene.provenance != ()


def test_bad_arguments_are_refused():
    scene = load_scene("reach")
    for options, message in (
        ({"duration": 0.0}, "duration = 0.0: must be a number >= 0.1"),
        ({"harmonics": 2}, "harmonics = 2: must be from 3 to 30"),
        ({"requested": ("nothing",)}, "begins no parameter"),
    ):
        with pytest.raises(InputError, match=message):
            design(scene, **options)


@pytest.mark.slow
def test_gravity_beyond_the_actuators_is_refused():
    weak = load_scene("reach").with_values(
        {"actuators.torque_limit": 1e-3, "initial.gamma": [0.7, 0.8, 0.9]}
    )
    with pytest.raises(MotionRefused):
        design(weak, duration=1.0, iterations=1, harmonics=3)
