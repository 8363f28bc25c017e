# SPDX-License-Identifier: Apache-2.0
"""The regressor against the inverse dynamics, and against Pinocchio's of the tree of links."""

import numpy as np
import pytest
from identification import manipulators

from sst_ros import InverseDynamics
from sst_ros.errors import InputError
from sst_ros.identification import parameters
from sst_ros.identification.regressor import Regressor, find_base_parameters, find_independent
from sst_ros.mechanism import kinematics, rates, virtual_work
from sst_ros.mechanism.frames import quaternion_of
from sst_ros.mechanism.geometry import Geometry

SCENES = ("thin_arcs", "general", "payload")


def states(scene, count, seed=0):
    """gamma, R, and random W and W_dot of admissible poses."""
    rng, found = np.random.default_rng(seed), []
    geometry = Geometry.of(scene)
    while len(found) < count:
        gamma = rng.uniform(0.35, 0.65, 3) * geometry.arc
        poses = [one for one in kinematics.direct(geometry, gamma) if one.admissible]
        if len(poses) == 1:
            found.append((gamma, poses[0].rotation))
    gamma, rotation = (np.stack(parts) for parts in zip(*found, strict=True))
    return gamma, rotation, rng.normal(size=(count, 3)), 5.0 * rng.normal(size=(count, 3))


@pytest.mark.parametrize("name", SCENES)
def test_torques_are_the_known_part_plus_regressor_times_parameters(name):
    scene = getattr(manipulators, name)()
    names = parameters.select_names(scene, None)
    _, rotation, rate, acceleration = states(scene, 30)
    quaternion = quaternion_of(rotation)
    known, columns = Regressor(scene, names)(quaternion, rate, acceleration)
    inverse = InverseDynamics(scene)
    expected = [inverse.torque(*row) for row in zip(quaternion, rate, acceleration, strict=True)]
    found = known + columns @ parameters.values(scene, names)
    assert np.abs(found - expected).max() < 1e-13 * np.abs(expected).max()


def test_friction_that_the_scene_does_not_have_offsets_and_rotors_are_columns():
    scene = manipulators.thin_arcs()
    wanted = ("friction.gamma", "actuators.rotor_inertia", "offset")
    names = parameters.select_names(scene, wanted)
    assert names == (
        "friction.gamma.viscous", "friction.gamma.coulomb", "actuators.rotor_inertia",
        "offset[0]", "offset[1]", "offset[2]",
    )  # fmt: skip
    _, rotation, rate, acceleration = states(scene, 5)
    quaternion = quaternion_of(rotation)
    values = np.array([0.3, 0.2, 1e-3, 0.1, -0.2, 0.3])
    known, columns = Regressor(scene, names)(quaternion, rate, acceleration)
    more = scene.with_values(dict(zip(names[:3], values[:3], strict=True)))
    inverse = InverseDynamics(more)
    expected = [inverse.torque(*row) for row in zip(quaternion, rate, acceleration, strict=True)]
    expected = np.array(expected) + values[3:]
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
    _, rotation, rate, acceleration = states(scene, 40, seed=3)
    _, columns = regressor(quaternion_of(rotation), rate, acceleration)
    rebuilt = base.of_columns(columns) @ base.transform
    assert np.abs(rebuilt - columns).max() < 1e-9 * np.abs(columns).max()
    assert find_independent(columns, regressor.names).chosen == base.chosen


def test_unknown_names_are_refused_with_the_nearest():
    scene = manipulators.thin_arcs()
    with pytest.raises(InputError, match=r"parameters = 'sta': begins no parameter"):
        parameters.select_names(scene, ("sta",))
    with pytest.raises(InputError, match="not both"):
        parameters.select_names(scene, ("actuated_links", "actuated_links[0]"))


def test_pinocchio_has_the_same_regressor():
    """Tree of seven links, ten parameters each; the loops project it onto the actuators."""
    pin = pytest.importorskip("pinocchio", reason="Pinocchio is missing: pip install pin")
    scene = manipulators.general()
    geometry = Geometry.of(scene)
    separate = [f"{kind}[{k}]" for kind in parameters.LINKS for k in range(3)]
    names = parameters.select_names(scene, ("star", *separate))
    gamma, rotation, rate, acceleration = states(scene, 10)
    _, columns = Regressor(scene, names)(quaternion_of(rotation), rate, acceleration)
    for row in range(len(gamma)):
        tree = Tree(pin, geometry, gamma[row], rotation[row], scene.gravity.acceleration)
        expected = tree.regressor(rotation[row] @ rate[row], rotation[row] @ acceleration[row])
        for body, found in expected.items():
            indices = [names.index(f"{body}.{part}") for part in parameters.STANDARD]
            own = columns[row][:, indices]
            assert np.abs(own - found).max() < 1e-9 * np.abs(found).max()


class Tree:
    """Pinocchio's model of the links, built at one pose with the frames of the paper."""

    # Pinocchio's order: m, m c, Ixx, Ixy, Iyy, Ixz, Iyz, Izz.
    ORDER = (0, 1, 2, 3, 4, 6, 9, 5, 7, 8)

    def __init__(self, pin, geometry, gamma, rotation, gravity):
        self.pin, self.geometry, self.gamma, self.rotation = pin, geometry, gamma, rotation
        w, t = geometry.w, geometry.e @ rotation.T
        across = np.cross(w, geometry.v)
        r = np.cos(gamma)[:, None] * geometry.v + np.sin(gamma)[:, None] * across
        self.model = pin.Model()
        self.model.gravity = pin.Motion(np.array(gravity), np.zeros(3))
        self.joints, self.frames = {}, {}
        for k in range(3):
            self._hang(f"g{k}", 0, w[k], np.stack([r[k], np.cross(w[k], r[k]), w[k]], 1))
            frame = np.stack([r[k], np.cross(t[k], r[k]), t[k]], 1)
            self._hang(f"m{k}", f"g{k}", -r[k], frame)
            if k == 0:
                self._hang("b0", "m0", -t[0], rotation)

    def _hang(self, joint, parent, axis, frame):
        """Joints' frames have O as their origin and the axes of the body's own frame."""
        base = np.eye(3) if parent == 0 else self.frames[parent]
        place = self.pin.SE3(base.T @ frame, np.zeros(3))
        kind = self.pin.JointModelRevoluteUnaligned(frame.T @ axis)
        index = 0 if parent == 0 else self.joints[parent]
        self.joints[joint] = self.model.addJoint(index, kind, place, joint)
        self.frames[joint] = frame

    def regressor(self, omega, omega_dot):
        """Columns of the actuators' torques, shape (3, 10), by body."""
        at = virtual_work.posture(self.geometry, self.gamma, self.rotation)
        moving = rates.of_star(self.geometry, self.rotation, omega, omega_dot, self.gamma)
        v, a = np.zeros(self.model.nv), np.zeros(self.model.nv)
        projection = np.zeros((self.model.nv, 3))
        kinds = {
            "g": ("gamma_dot", "gamma_ddot"),
            "m": ("mu_dot", "mu_ddot"),
            "b": ("beta_dot", "beta_ddot"),
        }
        for joint, index in self.joints.items():
            place, k = self.model.joints[index].idx_v, int(joint[1])
            v[place], a[place] = (getattr(moving, name)[k] for name in kinds[joint[0]])
            for i, unit in enumerate(np.eye(3)):
                alone = rates.of_actuators(at, unit)
                projection[place, i] = getattr(alone, kinds[joint[0]][0])[k]
        q = self.pin.neutral(self.model)
        full = self.pin.computeJointTorqueRegressor(self.model, self.model.createData(), q, v, a)
        projected = projection.T @ full
        bodies = {"g": "actuated_links[{}]", "m": "intermediate_links[{}]", "b": "star"}
        return {
            bodies[joint[0]].format(joint[1]): projected[:, 10 * (index - 1) : 10 * index][
                :, self.ORDER
            ]
            for joint, index in self.joints.items()
        }
