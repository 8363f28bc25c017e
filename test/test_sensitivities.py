# SPDX-License-Identifier: Apache-2.0
"""Sensitivities of motions against differences of motions with other numbers."""

from dataclasses import replace

import numpy as np
import pytest
from loaded_scenes import loaded
from scipy.spatial.transform import Rotation
from slow_cases import slow_after, slow_except

from sst_ros import PolynomialTorque, SineTorque, TorqueTable, load_scene, simulate
from sst_ros.errors import InputError
from sst_ros.mechanism import rates
from sst_ros.mechanism.geometry import Geometry, rotation_matrix
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
        lambda x: SineTorque(
            **dict(zip(SineTorque.SPECS, x.reshape(3, 3).tolist(), strict=True))
        ),
    ),
    "table": (TABLE[1], lambda x: TorqueTable(TABLE[0], x.reshape(3, 3))),
    "polynomial": (
        PIECES,
        lambda x: PolynomialTorque(x.reshape(2, 2, 3), (0.0, 0.04, 0.06)),
    ),
}
TERMS = (
    "star.inertia.zz", "star.centre[2]", "payload.mass", "actuated_links[0].inertia.zz",
    "gravity.acceleration[1]", "moment.value[0]", "friction.gamma.smoothing",
    "friction.gamma.coulomb", "springs[0].stiffness", "springs[0].rest",
    "actuators.time_constant", "actuators.rotor_inertia", "initial.gamma[0]",
    "initial.gamma_dot[1]",
)  # fmt: skip
STOPS = (
    "stroke.stiffness",
    "stroke.damping",
    "star.inertia.xx",
    "initial.gamma_dot[0]",
)


def bouncing():
    """Actuator 1 meets the lower end of its stroke at 20 ms, and leaves it some 16 ms
    later.
    """
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
    slow_after(
        1,
        [
            ("polynomial", True),
            ("constant", True),
            ("table", False),
            slow("polynomial", False),
            slow("constant", False),
            slow("sine", False),
            slow("sine", True),
            slow("table", True),
        ],
    ),
)
def test_sensitivities_are_the_limit_of_differences(kind, at_stops):
    """Along a random direction in all parameters at once, and in all numbers of the
    torques.
    """
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
        return simulate(
            scene.with_values(changed), torque, span[-1], t_eval=span, tolerance=1e-13
        )

    motion = simulate(
        scene, build(given), span[-1], t_eval=span, sensitivities=[*terms, "torque"]
    )
    steps = np.array([-2.0, -1.0, 1.0, 2.0]) * 1e-3
    runs, weights = (
        [run(step) for step in steps],
        np.array([1.0, -8.0, 8.0, -1.0]) / 12e-3,
    )
    here = Rotation.from_quat(motion.quaternion).inv()
    turns = [(here * Rotation.from_quat(one.quaternion)).as_rotvec() for one in runs]
    found = motion.sensitivities
    for name in ("gamma", "gamma_dot", "body_rate", "rotation"):
        rows = turns if name == "rotation" else [getattr(one, name) for one in runs]
        change = getattr(found["torque"], name) @ push
        change = change + sum(
            getattr(found[key], name)[..., 0] * along[key] for key in terms
        )
        assert (
            np.abs(change - np.tensordot(weights, rows, 1)).max()
            < 1e-7 * np.abs(change).max()
        )


@pytest.mark.slow
def test_a_key_of_several_numbers_means_each_of_them():
    several = ("initial.gamma_dot", "actuated_links.inertia.zz")
    each = [f"initial.gamma_dot[{k}]" for k in range(3)]
    each += [f"actuated_links[{k}].inertia.zz" for k in range(3)]
    motion = simulate("general", (0.2, 0.0, 0.0), 0.1, sensitivities=[*several, *each])
    found = motion.at([0.0, 0.05]).sensitivities
    assert np.all(found[several[0]].gamma_dot[0] == pytest.approx(np.eye(3)))
    together = np.concatenate([found[name].gamma for name in several], axis=2)
    assert np.all(
        together == np.concatenate([found[name].gamma for name in each], axis=2)
    )
    assert simulate("example2").sensitivities == {}


@pytest.mark.parametrize(
    ("torque", "name", "message"),
    [
        (CONSTANT, "base.radius", "is no number of the equations of motion"),
        (CONSTANT, "workspace.beta_max_deg", "is no number of the equations of motion"),
        (CONSTANT, "duration", "is no number of the equations of motion"),
        (CONSTANT, "name", "sensitivities = .name.: must be the key of a number"),
        (lambda t: CONSTANT, "torque", "three numbers or a profile, not a function"),
        (lambda t, state: CONSTANT, "star.inertia.zz", "not a function of the state"),
    ],
)
def test_what_has_no_sensitivity_is_refused(torque, name, message):
    with pytest.raises(InputError, match=message):
        simulate("example2", torque, 0.1, sensitivities=[name])


def turned_by(scene, direction, size):
    """Return the scene with other directions and angles of its star, that sum to 360
    degrees.
    """
    moved = np.array(scene.base.v) + size * direction[:9].reshape(3, 3)
    alpha = np.array(scene.star.alpha_deg) + size * np.append(
        direction[9:], -direction[9:].sum()
    )
    return scene.with_values(
        {"base.v": moved.tolist(), "star.alpha_deg": alpha.tolist()}
    )


@pytest.mark.parametrize("at_stops", slow_except([False], [False, True]))
def test_sensitivities_by_geometry_are_the_limit_of_differences(at_stops):
    """At fixed initial angles and rates, so that the start moves, and the stops with
    the arcs.
    """
    scene, span = (bouncing() if at_stops else load_scene("general")), [0.0, 0.03, 0.05]
    direction = np.random.default_rng(7).normal(size=11) * np.repeat([0.1, 5.0], [9, 2])
    keys = ["base.v", "star.alpha_deg"]
    motion = simulate(scene, CONSTANT, span[-1], t_eval=span, sensitivities=keys)
    steps = np.array([-2.0, -1.0, 1.0, 2.0]) * 1e-3
    given = [turned_by(scene, direction, step) for step in steps]
    runs = [
        simulate(one, CONSTANT, span[-1], t_eval=span, tolerance=1e-13) for one in given
    ]
    weights = np.array([1.0, -8.0, 8.0, -1.0]) / 12e-3
    here = Rotation.from_quat(motion.quaternion).inv()
    turns = [(here * Rotation.from_quat(one.quaternion)).as_rotvec() for one in runs]
    of_v, of_alpha = (motion.sensitivities[key] for key in keys)
    along = np.append(direction[9:], -direction[9:].sum())
    for name in ("gamma", "gamma_dot", "body_rate", "rotation"):
        rows = turns if name == "rotation" else [getattr(one, name) for one in runs]
        change = getattr(of_v, name) @ direction[:9] + getattr(of_alpha, name) @ along
        expected = np.tensordot(weights, rows, 1)
        assert np.abs(change - expected).max() < 1e-8 * np.abs(expected).max()
    assert np.abs(of_v.gamma[0]).max() < 1e-14  # the angles at the start are given


def test_the_orientation_at_given_angles_by_the_geometry():
    """Two derivations: closed loops in vectors, and the traced joint angles of the
    dynamics.
    """
    scene = load_scene("general")
    geometry = Geometry.of(scene)
    motion = simulate(
        scene,
        CONSTANT,
        1e-3,
        sensitivities=["base.v", "star.alpha_deg", "initial.gamma"],
    )
    found = rates.orientation_sensitivity(
        geometry, rotation_matrix(motion.quaternion[0])
    )
    traced = motion.sensitivities
    assert found.gamma == pytest.approx(traced["initial.gamma"].rotation[0], abs=1e-12)
    lengths = np.linalg.norm(scene.base.v, axis=1)
    of_v = found.v / lengths[None, :, None]  # of directions of any length
    assert of_v.reshape(3, 9) == pytest.approx(traced["base.v"].rotation[0], abs=1e-12)
    of_alpha = np.radians(found.alpha)
    assert of_alpha == pytest.approx(traced["star.alpha_deg"].rotation[0], abs=1e-13)
    many = rates.orientation_sensitivity(
        geometry, rotation_matrix(motion.quaternion[:5])
    )
    assert many.v.shape == (5, 3, 3, 3) and np.all(many.v[0] == found.v)


def test_an_inertia_means_its_six_numbers():
    parts = [f"star.inertia.{part}" for part in ("xx", "yy", "zz", "xy", "xz", "yz")]
    motion = simulate(
        "example2", CONSTANT, 0.05, sensitivities=["star.inertia", *parts]
    )
    found = motion.sensitivities
    assert found["star.inertia"].gamma.shape == (len(motion), 3, 6)
    for number, part in enumerate(parts):
        assert np.array_equal(
            found["star.inertia"].gamma[..., number], found[part].gamma[..., 0]
        )


def test_a_refusal_names_the_argument():
    with pytest.raises(
        InputError, match=r"^simulate: sensitivities = 'star\.wool': must be"
    ):
        simulate("example2", CONSTANT, 0.05, sensitivities=["star.wool"])
