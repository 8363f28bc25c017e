# SPDX-License-Identifier: Apache-2.0
"""The regressor against the inverse dynamics, and motions designed by it."""

import numpy as np
import pytest
from identification import manipulators
from identification.test_consistency import of_points
from models import star_orientation
from slow_cases import slow_after

from sst_ros import load_scene, reference_motion
from sst_ros.control.plan import examine_motion
from sst_ros.errors import InputError, MotionRefused
from sst_ros.identification import parameters
from sst_ros.identification.excitation import design
from sst_ros.identification.parameters import (
    Regressor,
    find_base_parameters,
    find_independent,
)
from sst_ros.mechanism.geometry import Geometry, quaternion_of
from sst_ros.scene.scene import Scene
from sst_ros.scene.yaml_document import dump, read

SCENES = ("thin_arcs", "general", "payload")
FOREIGN = ("friction.gamma", "actuators.rotor_inertia", "offset")


def states(scene, count, seed=0):
    """Quaternion, and random W and W_dot, of poses with E inside the base triangle."""
    rng, geometry = np.random.default_rng(seed), Geometry.of(scene)
    turns = [
        star_orientation(geometry, rng.uniform(-1.0, 1.0, 4)) for _ in range(count)
    ]
    rates = rng.normal(size=(2, count, 3)) * [[[1.0]], [[5.0]]]
    return np.array([quaternion_of(turn) for turn in turns]), *rates


BODIES = ("star", *(f"{kind}[{k}]" for kind in parameters.LINKS for k in range(3)))


def own(scene, names):
    return parameters.values(scene, names)


def by_chance(seed):
    """Seven bodies of random points: elsewhere Pinocchio and Lagrange check the
    torques.
    """
    rng = np.random.default_rng(seed)
    return lambda scene, names: np.concatenate([of_points(rng) for _ in BODIES])


@pytest.mark.parametrize(
    ("name", "wanted", "values_of"),
    [
        *((name, None, own) for name in SCENES),
        *(("general", BODIES, by_chance(seed)) for seed in range(4)),
        ("thin_arcs", FOREIGN, lambda *_: np.array([0.3, 0.2, 1e-3, 0.1, -0.2, 0.3])),
    ],
)
def test_torques_are_known_part_plus_regressor_times_parameters(
    name, wanted, values_of
):
    """Of the scene's own numbers, of other bodies, and of what it does not have."""
    scene = getattr(manipulators, name)()
    names = parameters.select_names(scene, wanted)
    values, at = values_of(scene, names), states(scene, 30)
    known, columns = Regressor(scene, names)(*at)
    other = parameters.with_parameters(scene, names, values, "by chance")
    expected = manipulators.torques(other, *at)
    if wanted is FOREIGN:
        friction = ("friction.gamma.viscous", "friction.gamma.coulomb")
        offsets = ("offset[0]", "offset[1]", "offset[2]")
        assert names == (*friction, "actuators.rotor_inertia", *offsets)
        expected += values[3:]
    apart = np.abs(known + columns @ values - expected).max()
    assert apart < 1e-13 * (1.0 if wanted is FOREIGN else np.abs(expected).max())


def test_base_parameters_are_those_of_the_kernel():
    """Star 6; a leg has A0, A2 and three products of inertia (`kernel`), here alike."""
    scene = manipulators.thin_arcs()
    regressor = Regressor(scene, parameters.select_names(scene, None))
    base = find_base_parameters(regressor)
    assert len(base.chosen) == 11
    axial = "actuated_links.inertia.zz + intermediate_links.inertia.zz"
    shape = (
        "intermediate_links.inertia.xx - intermediate_links.inertia.yy"
        " + intermediate_links.inertia.zz"
    )
    assert {axial, shape} <= set(base.labels)
    separate = parameters.select_names(scene, BODIES)
    assert len(find_base_parameters(Regressor(scene, separate)).chosen) == 6 + 3 * 5


@pytest.mark.parametrize("name", SCENES)
def test_the_columns_of_the_base_parameters_give_all_torques(name):
    scene = getattr(manipulators, name)()
    regressor = Regressor(scene, parameters.select_names(scene, None))
    base = find_base_parameters(regressor)
    _, columns = regressor(*states(scene, 40, seed=3))
    rebuilt = columns[..., base.chosen] @ base.transform
    assert np.abs(rebuilt - columns).max() < 1e-9 * np.abs(columns).max()
    assert find_independent(columns, regressor.names).chosen == base.chosen


def test_unknown_names_are_refused_with_the_nearest():
    scene = manipulators.thin_arcs()
    with pytest.raises(InputError, match=r"parameters = 'sta': begins no parameter"):
        parameters.select_names(scene, ("sta",))
    with pytest.raises(InputError, match="not both"):
        parameters.select_names(scene, ("actuated_links", "actuated_links[0]"))


LIMITS = {
    "actuators.torque_limit": 12.0,
    "actuators.velocity_limit": 2.5,
    "actuators.acceleration_limit": 15.0,
}


def condition(scene):
    """Of the regressor of the base parameters over the scene's motion, columns of
    length one.
    """
    motion = reference_motion(scene)
    regressor = Regressor(scene, parameters.select_names(scene, None))
    times = np.linspace(0.0, motion.duration, 200)
    _, columns = regressor(*manipulators.states(motion, times))
    base = find_independent(columns, regressor.names)
    matrix = columns[..., base.chosen].reshape(-1, len(base.chosen))
    return np.linalg.cond(matrix / np.linalg.norm(matrix, axis=0)), base


@pytest.fixture(scope="module")
def designed():
    scene = load_scene("reach").with_values(LIMITS)
    return scene, design(scene, duration=4.0, harmonics=4, iterations=15)


@pytest.mark.parametrize("iterations", slow_after(1, [2, 15]))
def test_a_designed_motion_keeps_limits_and_rests_at_both_ends(iterations):
    scene = load_scene("reach").with_values(LIMITS)
    found = design(scene, duration=4.0, harmonics=4, iterations=iterations)
    motion = reference_motion(found.scene)
    assert examine_motion(motion, found.scene).problems == ()
    for time in (0.0, motion.duration):
        at = motion.at(time)
        assert np.abs([*at.gamma_dot, *at.gamma_ddot]).max() < 1e-9
        assert at.gamma == pytest.approx(found.scene.initial.gamma, abs=1e-12)
    assert read(Scene, dump(found.scene), "designed") == found.scene
    assert found.scene.provenance != ()


@pytest.mark.slow
def test_it_is_better_conditioned_than_a_spiral_and_than_chirps(designed):
    scene, found = designed
    own, base = condition(found.scene)
    assert own == pytest.approx(found.condition, rel=0.1)
    assert base.chosen == found.base.chosen
    assert own < 50.0
    assert condition(scene)[0] > 2.5 * own
    assert condition(manipulators.sweeping(scene, 4.0, 1.0))[0] > 2.0 * own
    assert "condition number" in found.table()


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
