# SPDX-License-Identifier: Apache-2.0
"""Data of a wrong sign, unit, leg or time are refused or warned of by name."""

import numpy as np
import pytest
from slow_cases import slow_after

from benchmark.campaign.users import MEASURED_SCENE as SCENE
from benchmark.campaign.users import exact_measurement as exact
from sst_ros import identify, load_scene
from sst_ros.errors import InputError


def angles():
    return {name: values for name, values in exact().items() if name != "gamma_dot"}


def noisy():
    random = np.random.default_rng(3)
    data = angles()
    shape = data["gamma"].shape
    return data | {
        "gamma": data["gamma"] + 1e-5 * random.normal(size=shape),
        "torque": data["torque"] + 2e-3 * random.normal(size=shape),
    }


KINDS = pytest.mark.parametrize("make", slow_after(1, [exact, angles, noisy]))


@KINDS
def test_negated_torques_are_refused(make):
    data = make()
    with pytest.raises(
        InputError, match=r"mean kinetic energy = -0.02.*signs of torque and gamma"
    ):
        identify(data | {"torque": -data["torque"]}, SCENE)


@KINDS
@pytest.mark.parametrize(
    ("columns", "named"),
    [
        pytest.param([1, -2, 3], r"\[1, -2, 3\]", marks=pytest.mark.slow),
        ([2, 1, 3], r"\[2, 1, 3\]"),
    ],
)
def test_a_torque_of_another_leg_or_sign_is_named(make, columns, named):
    data = make()
    places = [abs(column) - 1 for column in columns]
    changed = data["torque"][:, places] * np.sign(columns)
    with pytest.raises(InputError, match=f"fit no bodies, but {named} do"):
        identify(data | {"torque": changed}, SCENE)


@KINDS
def test_sound_data_are_identified_as_before(make):
    found = identify(make(), SCENE)
    true = load_scene(SCENE).star.inertia.xx
    assert found.values[found.names.index("star.inertia.xx")] == pytest.approx(
        true, rel=0.02
    )
    assert found.warnings == () and found.consistent


@pytest.mark.parametrize("factor", [1e3, 1e6, 1e9])
def test_times_that_are_not_seconds_are_refused(factor):
    data = angles()
    with pytest.raises(InputError, match=r"inertia over that of the scene = .*t is in"):
        identify(data | {"t": factor * data["t"]}, SCENE)
    late = exact()
    with pytest.raises(InputError, match=r"integral of gamma_dot_1 = .*times in s"):
        identify(late | {"t": factor * late["t"]}, SCENE)


def test_degrees_are_refused():
    data, known = angles(), exact()
    with pytest.raises(InputError, match=r"range of gamma_1 = 17.1.*in radians"):
        identify(data | {"gamma": np.degrees(data["gamma"])}, SCENE)
    for wrong in (np.degrees(known["gamma_dot"]), known["gamma_dot"][:, [1, 0, 2]]):
        with pytest.raises(InputError, match="integral of gamma_dot_1"):
            identify(known | {"gamma_dot": wrong}, SCENE)


def test_torques_in_millimetres_are_told():
    data = angles()
    found = identify(data | {"torque": 1e3 * data["torque"]}, SCENE)
    assert any("1e+03 times the inertia" in one for one in found.warnings)


@pytest.mark.parametrize("last", [500, 201])
def test_a_jump_of_an_encoder_is_refused_with_its_row(last):
    """A step that stays, and a single wrong sample."""
    data = noisy()
    gamma = data["gamma"].copy()
    gamma[200:last, 0] += 0.3
    with pytest.raises(InputError, match=r"gamma_1 = 1.1.*jumps by \+0.3.* at row 200"):
        identify(data | {"gamma": gamma}, SCENE)


@pytest.mark.parametrize("name", slow_after(1, ["torque", "gamma"]))
def test_columns_that_do_not_change_are_told(name):
    data = angles()
    values = data[name].copy()
    values[:, 1] = values[0, 1]
    found = identify(data | {name: values}, SCENE)
    assert any(f"{name}_2 is" in one and "measured" in one for one in found.warnings)


def test_angles_that_are_taken_in_time_and_are_late_are_told():
    data = exact()
    late = {name: values[:-40] for name, values in data.items()}
    found = identify(late | {"torque": data["torque"][40:]}, SCENE)
    assert any("seem to be late against the torques" in one for one in found.warnings)


@pytest.mark.timeout(60)
def test_an_opposed_torque_is_refused_before_it_is_simulated():
    data = noisy()
    opposed = data | {"torque": data["torque"] * [1.0, 1.0, -1.0]}
    with pytest.raises(InputError, match=r"correlation of torque_3 .* = -1.0.*signs"):
        identify(opposed, SCENE, ["star.inertia.zz"], "simulation")
    degrees = data | {"gamma": np.degrees(data["gamma"])}
    with pytest.raises(InputError, match="in radians"):
        identify(degrees, SCENE, ["star.inertia.zz"], "simulation")
