# SPDX-License-Identifier: Apache-2.0
"""The paper's equations, stepped: the same motion as by those in the quaternion and
body rate.
"""

import dataclasses

import numpy as np
import pytest
from slow_cases import slow_after

from sst_ros import Simulation, load_scene
from sst_ros.errors import InputError
from sst_ros.scene.loads import Moment


def largest_difference(one, other):
    found = [
        np.subtract(one.quaternion, other.quaternion),
        np.subtract(one.joints, other.joints),
    ]
    return max(np.abs(each).max() for each in found)


def pair(scene, **options):
    return (
        Simulation(scene, **options, equations=e)
        for e in ("quaternion", "virtual_work")
    )


@pytest.mark.parametrize("name", slow_after(1, ["example1", "example2"]))
def test_it_gives_the_examples_of_the_paper(name):
    """Its evaluations differ by rounding, 1e-15; steps are the same."""
    scene = load_scene(name)
    one, other = pair(scene, integrator="dop853", tolerance=1e-12)
    for _ in range(round(scene.duration / 0.02)):
        states = (
            one.step(scene.torque, 20_000_000),
            other.step(scene.torque, 20_000_000),
        )
        assert largest_difference(*states) <= 1e-12
    assert abs(other.energy_residual) < 1e-12


def test_loads_that_fit_into_the_equations_are_there():
    """Full inertias, payload, rotors, torque limit, constant moment and torques of a
    function.
    """
    payload = {"payload.mass": 0.5, "payload.centre": [0.1, 0, 0.2]}
    drive = {"gear_ratio": 9.0, "rotor_inertia": 1e-4, "torque_limit": 0.3}
    drive = {f"actuators.{key}": value for key, value in drive.items()}
    scene = load_scene("general").with_values(payload | drive)
    for moment in (Moment(value=(0.1, -0.2, 0.3)), Moment(topic=True)):
        one, other = pair(dataclasses.replace(scene, moment=moment), tolerance=1e-12)
        for torque in ((0.1, -0.5, 0.2), lambda t: (t, 0.1, -0.4)):
            for simulation in (one, other):
                simulation.steps(torque, 2_000_000, 10, (0.2, 0.1, -0.1))
            assert largest_difference(one.state, other.state) <= 1e-12
            assert abs(other.energy_residual) < 1e-12


@pytest.mark.parametrize(
    ("scene", "options", "message"),
    [
        (
            "gravity_payload",
            {},
            r"gravity = .*equations of the paper have no such term",
        ),
        ("friction", {}, r"friction = .*use equations = quaternion"),
        ("stiff", {}, "springs = "),
        ("elastic_stops", {}, r"stroke\.at_end = 'elastic'"),
        ("example1", {"integrator": "rodas5p"}, "needs an explicit integrator"),
        (
            "example1",
            {"equations": "lagrange"},
            "must be one of quaternion, virtual_work",
        ),
    ],
)
def test_what_it_does_not_have_and_what_is_unknown_is_refused(scene, options, message):
    with pytest.raises(InputError, match=message):
        Simulation(scene, **{"equations": "virtual_work"} | options)
