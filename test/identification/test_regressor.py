# SPDX-License-Identifier: Apache-2.0
"""The regressor against the inverse dynamics."""

import numpy as np
import pytest
from identification import manipulators
from identification.test_consistency import of_points

from sst_ros.errors import InputError
from sst_ros.identification import parameters
from sst_ros.identification.regressor import Regressor, find_base_parameters, find_independent
from sst_ros.mechanism import kinematics
from sst_ros.mechanism.frames import quaternion_of
from sst_ros.mechanism.geometry import Geometry

SCENES = ("thin_arcs", "general", "payload")


def states(scene, count, seed=0):
    """Quaternion, and random W and W_dot, of admissible poses."""
    rng, found = np.random.default_rng(seed), []
    geometry = Geometry.of(scene)
    while len(found) < count:
        gamma = rng.uniform(0.35, 0.65, 3) * geometry.arc
        poses = [one for one in kinematics.direct(geometry, gamma) if one.admissible]
        if len(poses) == 1:
            found.append(quaternion_of(poses[0].rotation))
    return np.array(found), rng.normal(size=(count, 3)), 5.0 * rng.normal(size=(count, 3))


@pytest.mark.parametrize("name", SCENES)
def test_torques_are_the_known_part_plus_regressor_times_parameters(name):
    scene = getattr(manipulators, name)()
    names = parameters.select_names(scene, None)
    at = states(scene, 30)
    known, columns = Regressor(scene, names)(*at)
    expected = manipulators.torques(scene, *at)
    found = known + columns @ parameters.values(scene, names)
    assert np.abs(found - expected).max() < 1e-13 * np.abs(expected).max()


@pytest.mark.parametrize("seed", range(4))
def test_the_columns_of_every_body_are_its_own(seed):
    """Seven bodies of random points: elsewhere Pinocchio and Lagrange check the torques."""
    scene = manipulators.general()
    separate = [f"{kind}[{k}]" for kind in parameters.LINKS for k in range(3)]
    names = parameters.select_names(scene, ("star", *separate))
    at, rng = states(scene, 30), np.random.default_rng(seed)
    known, columns = Regressor(scene, names)(*at)
    values = np.concatenate([of_points(rng) for _ in range(7)])
    other = parameters.with_parameters(scene, names, values, "by chance")
    expected = manipulators.torques(other, *at)
    assert np.abs(known + columns @ values - expected).max() < 1e-12 * np.abs(expected).max()


def test_friction_that_the_scene_does_not_have_offsets_and_rotors_are_columns():
    scene = manipulators.thin_arcs()
    wanted = ("friction.gamma", "actuators.rotor_inertia", "offset")
    names = parameters.select_names(scene, wanted)
    assert names == (
        "friction.gamma.viscous", "friction.gamma.coulomb", "actuators.rotor_inertia",
        "offset[0]", "offset[1]", "offset[2]",
    )  # fmt: skip
    at = states(scene, 5)
    values = np.array([0.3, 0.2, 1e-3, 0.1, -0.2, 0.3])
    known, columns = Regressor(scene, names)(*at)
    more = scene.with_values(dict(zip(names[:3], values[:3], strict=True)))
    expected = manipulators.torques(more, *at) + values[3:]
    assert np.abs(known + columns @ values - expected).max() < 1e-13


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
    separate = parameters.select_names(
        scene, ("star", *(f"{k}[{i}]" for k in parameters.LINKS for i in range(3)))
    )
    assert len(find_base_parameters(Regressor(scene, separate)).chosen) == 6 + 3 * 5


@pytest.mark.parametrize("name", SCENES)
def test_the_columns_of_the_base_parameters_give_all_torques(name):
    scene = getattr(manipulators, name)()
    regressor = Regressor(scene, parameters.select_names(scene, None))
    base = find_base_parameters(regressor)
    _, columns = regressor(*states(scene, 40, seed=3))
    rebuilt = base.of_columns(columns) @ base.transform
    assert np.abs(rebuilt - columns).max() < 1e-9 * np.abs(columns).max()
    assert find_independent(columns, regressor.names).chosen == base.chosen


def test_unknown_names_are_refused_with_the_nearest():
    scene = manipulators.thin_arcs()
    with pytest.raises(InputError, match=r"parameters = 'sta': begins no parameter"):
        parameters.select_names(scene, ("sta",))
    with pytest.raises(InputError, match="not both"):
        parameters.select_names(scene, ("actuated_links", "actuated_links[0]"))
