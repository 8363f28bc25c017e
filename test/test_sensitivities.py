# SPDX-License-Identifier: Apache-2.0
"""Sensitivities of motions against differences of motions with other numbers."""

from dataclasses import replace

import numpy as np
import pytest
from loaded_scenes import loaded
from scipy.spatial.transform import Rotation

from sst_ros import PolynomialTorque, SineTorque, TorqueTable, load_scene, simulate
from sst_ros.errors import InputError
from sst_ros.scene.loads import Moment
from sst_ros.scene.yaml_document import find_number

CONSTANT = (0.3, -0.2, 0.1)
SINE = ((0.3, 0.5, 5.0), (5.0, 7.0, 9.0), (0.0, 1.0, 2.0))  # the limit cuts the third
TABLE = ((0.0, 0.04, 0.06), ((1.0, 0.0, -1.0), (0.0, 2.0, 9.0), (-1.0, 0.5, 0.0)))
PIECES = (((9.0, -5.0, 2.0), (-3.0, 0.0, 8.0)), ((0.3, 0.5, 1.0), (1.0, -0.2, 0.1)))
TORQUES = {
    "constant": (CONSTANT, lambda x: tuple(x)),
    "sine": (
        SINE,
        lambda x: SineTorque(**dict(zip(SineTorque.SPECS, x.reshape(3, 3).tolist(), strict=True))),
    ),
    "table": (TABLE[1], lambda x: TorqueTable(TABLE[0], x.reshape(3, 3))),
    "polynomial": (PIECES, lambda x: PolynomialTorque(x.reshape(2, 2, 3), (0.0, 0.04, 0.06))),
}
TERMS = (
    "star.inertia.zz", "star.centre[2]", "payload.mass", "actuated_links[0].inertia.zz",
    "gravity.acceleration[1]", "moment.value[0]", "friction.gamma.smoothing",
    "friction.gamma.coulomb", "springs[0].stiffness", "springs[0].rest", "actuators.time_constant",
    "actuators.rotor_inertia", "initial.gamma[0]", "initial.gamma_dot[1]",
)  # fmt: skip
STOPS = ("stroke.stiffness", "stroke.damping", "star.inertia.xx", "initial.gamma_dot[0]")


def bouncing():
    """Actuator 1 meets the lower end of its stroke at 20 ms, and leaves it some 16 ms later."""
    return load_scene("impacts").with_values(
        {
            "stroke": {"at_end": "elastic", "stiffness": 2e4, "damping": 0.3},
            "initial.gamma": [0.03, 0.5, 0.6],
            "initial.gamma_dot": [-1.5, 0.2, -0.1],
        }
    )


def slow(*case):
    return pytest.param(*case, marks=pytest.mark.slow)


@pytest.mark.parametrize(
    ("kind", "at_stops"),
    [
        ("constant", True),
        ("polynomial", True),
        ("table", False),
        slow("polynomial", False),
        slow("constant", False),
        slow("sine", False),
        slow("sine", True),
        slow("table", True),
    ],
)
def test_sensitivities_are_the_limit_of_differences(kind, at_stops):
    """Along a random direction in all parameters at once, and in all numbers of the torques."""
    rng = np.random.default_rng([len(kind), at_stops])
    scene, terms, span = bouncing(), STOPS, [0.02, 0.03, 0.05]
    if not at_stops:
        scene = replace(loaded(), moment=Moment(value=(0.1, 0.2, -0.3)))
        terms, span = TERMS, [0.03, 0.1]
    numbers, build = TORQUES[kind]
    given = np.ravel(numbers)
    values = {name: find_number(scene, name) for name in terms}
    along = {name: 0.3 * x * rng.uniform(-1.0, 1.0) for name, x in values.items()}
    push = 0.1 * given * rng.uniform(-1.0, 1.0, given.shape)

    def run(step):
        changed = {name: x + step * along[name] for name, x in values.items()}
        torque = build(given + step * push)
        return simulate(scene.with_values(changed), torque, span[-1], t_eval=span, tolerance=1e-13)

    motion = simulate(scene, build(given), span[-1], t_eval=span, sensitivities=[*terms, "torque"])
    steps = np.array([-2.0, -1.0, 1.0, 2.0]) * 1e-3
    runs, weights = [run(step) for step in steps], np.array([1.0, -8.0, 8.0, -1.0]) / 12e-3
    here = Rotation.from_quat(motion.quaternion).inv()
    turns = [(here * Rotation.from_quat(one.quaternion)).as_rotvec() for one in runs]
    found = motion.sensitivities
    for name in ("gamma", "gamma_dot", "body_rate", "rotation"):
        rows = turns if name == "rotation" else [getattr(one, name) for one in runs]
        change = getattr(found["torque"], name) @ push
        change = change + sum(getattr(found[key], name)[..., 0] * along[key] for key in terms)
        assert np.abs(change - np.tensordot(weights, rows, 1)).max() < 1e-7 * np.abs(change).max()


def test_a_key_of_several_numbers_means_each_of_them():
    several = ("initial.gamma_dot", "actuated_links.inertia.zz")
    each = [f"initial.gamma_dot[{k}]" for k in range(3)]
    each += [f"actuated_links[{k}].inertia.zz" for k in range(3)]
    motion = simulate("general", (0.2, 0.0, 0.0), 0.1, sensitivities=[*several, *each])
    found = motion.at([0.0, 0.05]).sensitivities
    assert np.all(found[several[0]].gamma_dot[0] == pytest.approx(np.eye(3)))
    together = np.concatenate([found[name].gamma for name in several], axis=2)
    assert np.all(together == np.concatenate([found[name].gamma for name in each], axis=2))
    assert simulate("example2").sensitivities == {}


@pytest.mark.parametrize(
    ("torque", "name", "message"),
    [
        (CONSTANT, "base.radius", "is geometry"),
        (CONSTANT, "duration", "is no number of the equations of motion"),
        (CONSTANT, "star.inertia", "must be the key of a number"),
        (lambda t: CONSTANT, "torque", "three numbers or a profile, not a function"),
        (lambda t, state: CONSTANT, "star.inertia.zz", "not a function of the state"),
    ],
)
def test_what_has_no_sensitivity_is_refused(torque, name, message):
    with pytest.raises(InputError, match=message):
        simulate("example2", torque, 0.1, sensitivities=[name])
