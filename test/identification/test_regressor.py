# SPDX-License-Identifier: Apache-2.0
"""The regressor against the inverse dynamics."""

import numpy as np
import pytest
from identification import manipulators
from identification.test_consistency import of_points
from models import star_orientation

from sst_ros.errors import InputError
from sst_ros.identification import parameters
from sst_ros.identification.parameters import Regressor, find_base_parameters, find_independent
from sst_ros.mechanism.frames import quaternion_of
from sst_ros.mechanism.geometry import Geometry

SCENES = ("thin_arcs", "general", "payload")
FOREIGN = ("friction.gamma", "actuators.rotor_inertia", "offset")


def states(scene, count, seed=0):
    """Quaternion, and random W and W_dot, of poses with E inside the base triangle."""
    rng, geometry = np.random.default_rng(seed), Geometry.of(scene)
    turns = [star_orientation(geometry, rng.uniform(-1.0, 1.0, 4)) for _ in range(count)]
    rates = rng.normal(size=(2, count, 3)) * [[[1.0]], [[5.0]]]
    return np.array([quaternion_of(turn) for turn in turns]), *rates


BODIES = ("star", *(f"{kind}[{k}]" for kind in parameters.LINKS for k in range(3)))


def own(scene, names):
    return parameters.values(scene, names)


def by_chance(seed):
    """Seven bodies of random points: elsewhere Pinocchio and Lagrange check the torques."""
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
def test_torques_are_the_known_part_plus_regressor_times_parameters(name, wanted, values_of):
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
    rebuilt = base.of_columns(columns) @ base.transform
    assert np.abs(rebuilt - columns).max() < 1e-9 * np.abs(columns).max()
    assert find_independent(columns, regressor.names).chosen == base.chosen


def test_unknown_names_are_refused_with_the_nearest():
    scene = manipulators.thin_arcs()
    with pytest.raises(InputError, match=r"parameters = 'sta': begins no parameter"):
        parameters.select_names(scene, ("sta",))
    with pytest.raises(InputError, match="not both"):
        parameters.select_names(scene, ("actuated_links", "actuated_links[0]"))
