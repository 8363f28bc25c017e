# SPDX-License-Identifier: Apache-2.0
"""gamma_ddot against Pinocchio: the same seven links as a tree with two loops closed.

Other engines are compared, on one scene, in test/benchmark/test_peers.py.
The tree is base -> actuated -> intermediate for each leg, the star hangs on leg 1, and a point of
the axis t_k on legs 2 and 3 is tied to the star. Each model is built at one pose and then moved.
"""

import numpy as np
import pytest
from mechanism.closed_chains import ISOTROPIC, random_sample

from sst_ros.mechanism import continuation, rates, virtual_work

PINOCCHIO = 1e-12
JOINTS = ("g0", "m0", "b0", "g1", "m1", "g2", "m2")


class Case:
    """A mechanism, the pose at which an engine's model is built, and moving states near it."""

    def __init__(self, seed):
        rng = np.random.default_rng(seed)
        sample = random_sample(rng, ISOTROPIC if seed % 4 == 0 else None)
        self.mechanism, at = sample.mechanism, sample.posture
        self.w, self.t, self.r = at.w, at.t, at.r
        links = zip(*virtual_work.link_frames(at), strict=True)
        self.frames = {"s": sample.rotation}
        self.tensors = {"s": self.mechanism.star}
        for k, (first, second) in enumerate(links):
            self.frames[f"a{k}"], self.frames[f"i{k}"] = first, second
            self.tensors[f"a{k}"] = self.mechanism.actuated[k]
            self.tensors[f"i{k}"] = self.mechanism.intermediate[k]
        geometry, gamma, rotation = sample.geometry, sample.gamma, sample.rotation
        self.states = [self._state(rng, geometry, gamma, rotation) for _ in range(4)]

    def _state(self, rng, geometry, gamma, rotation):
        """Angles and rates of the tree's joints, the loads, and what sst_ros answers."""
        while True:
            point = gamma + rng.uniform(-0.4, 0.4, 3)
            try:
                branch = continuation.follow(geometry, [gamma, point], rotation)
            except continuation.BranchEnds:
                continue
            if branch.sigma[1] > 0.1 and np.abs(np.sin(branch.mu[1])).min() > 0.1:
                break
        torque, moment, rate = rng.normal(size=(3, 3)) * [[1.0], [1.0], [2.0]]
        at = virtual_work.posture(geometry, point, branch.rotation[1])
        answer = virtual_work.direct_dynamics(self.mechanism, at, rate, torque, moment)
        motion = rates.of_actuators(at, rate, answer)
        kinds = {"g": "gamma", "m": "mu", "b": "beta"}
        angles = {kind: np.diff(getattr(branch, name), axis=0)[0] for kind, name in kinds.items()}
        speeds = {kind: getattr(motion, f"{name}_dot") for kind, name in kinds.items()}
        q, v = ({j: of[j[0]][int(j[1])] for j in JOINTS} for of in (angles, speeds))
        return q, v, torque, moment, answer


@pytest.fixture(params=range(8), scope="module")
def case(request):
    return Case(request.param)


def relative(found, expected):
    return np.linalg.norm(found - expected) / np.linalg.norm(expected)


def test_pinocchio(case):
    pin = pytest.importorskip("pinocchio", reason="Pinocchio is missing: pip install pin")
    model, still = pin.Model(), pin.SE3.Identity()
    model.gravity = pin.Motion.Zero()
    joints = {}

    def hang(joint, parent, axis, body):
        joints[joint] = model.addJoint(parent, pin.JointModelRevoluteUnaligned(axis), still, joint)
        tensor = case.frames[body] @ case.tensors[body] @ case.frames[body].T
        model.appendBodyToJoint(joints[joint], pin.Inertia(1.0, np.zeros(3), tensor), still)

    for k in range(3):
        hang(f"g{k}", 0, case.w[k], f"a{k}")
        hang(f"m{k}", joints[f"g{k}"], -case.r[k], f"i{k}")
        if k == 0:  # depth first: Pinocchio takes the joints of a subtree as neighbours
            hang("b0", joints["m0"], -case.t[0], "s")
    ties, tied = pin.StdVec_RigidConstraintModel(), pin.StdVec_RigidConstraintData()
    for k in (1, 2):
        point = pin.SE3(np.eye(3), case.t[k])
        kind = pin.ContactType.CONTACT_3D
        tie = pin.RigidConstraintModel(kind, model, joints["b0"], point, joints[f"m{k}"], point)
        ties.append(tie)
        tied.append(tie.createData())
    place = {name: model.joints[index].idx_v for name, index in joints.items()}
    for q_by, v_by, torque, moment, expected in case.states:
        data, q, v, u = model.createData(), *np.zeros((3, model.nv))
        for name, at in place.items():
            q[at], v[at] = q_by[name], v_by[name]
        for k in range(3):
            u[place[f"g{k}"]] = torque[k]
        pin.computeJointJacobians(model, data, q)
        aligned = pin.ReferenceFrame.LOCAL_WORLD_ALIGNED
        u += pin.getJointJacobian(model, data, joints["b0"], aligned)[3:].T @ moment
        try:
            pin.initConstraintDynamics(model, data, ties, tied)
        except TypeError:  # before Pinocchio 4
            pin.initConstraintDynamics(model, data, ties)
        # Each tie has three rows of rank two: proximal steps bring the least-squares answer.
        proximal = pin.ProximalSettings(1e-16, 1e-3, 30)
        found = pin.constraintDynamics(model, data, q, v, u, ties, tied, proximal)
        assert relative(found[[place[f"g{k}"] for k in range(3)]], expected) <= PINOCCHIO
