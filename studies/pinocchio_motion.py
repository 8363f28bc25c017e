# SPDX-License-Identifier: Apache-2.0
"""The motion of a scene by Pinocchio, which shares nothing with the equations of this package.

The seven links are a tree, base -> actuated -> intermediate link of each leg with the star on leg
1; a point of the axis t_k on legs 2 and 3 is tied to the star. Pinocchio gives the accelerations,
SciPy's DOP853 integrates them in the angles of the seven joints of the tree.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.integrate import solve_ivp

from sst_ros.errors import InputError, Problem
from sst_ros.extras import require
from sst_ros.mechanism import rates, virtual_work
from sst_ros.mechanism.frames import quaternion_of
from sst_ros.mechanism.geometry import Array, Geometry
from sst_ros.scene.scene import Scene

TOLERANCE = 1e-12
"""Relative and absolute, of a step."""

PROXIMAL = (1e-16, 0.1, 5)
"""Accuracy, mu and number of iterations: a tie has three rows of rank two."""


class PinocchioMotion:
    """Pinocchio's model of a scene that has bodies and sine torques only, built at its start.

    Args:
        scene: what is simulated.

    Raises:
        MissingDependency: Pinocchio is not installed.
        InputError: the scene has no torques, or loads that this model does not have.

    """

    def __init__(self, scene: Scene) -> None:
        for name in ("gravity", "moment", "friction", "springs", "actuators"):
            if value := getattr(scene, name):
                problem = Problem(name, value, "is not part of this model of Pinocchio")
                raise InputError(scene.name, [problem])
        if scene.torque is None:
            raise InputError(scene.name, [Problem("torque", None, "must be given")])
        self._pin: Any = require("pinocchio")
        self._torque = scene.torque
        at = virtual_work.posture(Geometry.of(scene), scene.initial.gamma)
        self._gamma, self._rotation = at.gamma, at.rotation
        self._build(scene, at)
        start = rates.of_actuators(at, scene.initial.gamma_dot)
        self._start = np.zeros(self._model.nv)
        for name, index in self._joints.items():
            kind = {"g": start.gamma_dot, "m": start.mu_dot, "b": start.beta_dot}[name[0]]
            self._start[self._model.joints[index].idx_v] = kind[int(name[1])]

    def _build(self, scene: Scene, at: virtual_work.Posture) -> None:
        pin = self._pin
        self._model = model = pin.Model()
        model.gravity = pin.Motion.Zero()
        first, second = virtual_work.link_frames(at)
        self._joints: dict[str, int] = {}
        for k in range(3):
            actuated, intermediate = scene.actuated_inertias[k], scene.intermediate_inertias[k]
            self._hang(f"g{k}", 0, at.w[k], first[k], actuated)
            self._hang(f"m{k}", self._joints[f"g{k}"], -at.r[k], second[k], intermediate)
            if k == 0:  # depth first: Pinocchio takes the joints of a subtree as neighbours
                self._hang("b0", self._joints["m0"], -at.t[0], at.rotation, scene.star_inertia)
        self._ties, self._tied = pin.StdVec_RigidConstraintModel(), pin.StdVec_RigidConstraintData()
        for k in (1, 2):
            place, leg = pin.SE3(np.eye(3), at.t[k]), self._joints[f"m{k}"]
            kind, star = pin.ContactType.CONTACT_3D, self._joints["b0"]
            tie = pin.RigidConstraintModel(kind, model, star, place, leg, place)
            self._ties.append(tie)
            self._tied.append(tie.createData())
        self._data = model.createData()
        try:
            pin.initConstraintDynamics(model, self._data, self._ties, self._tied)
        except TypeError:  # before Pinocchio 4
            pin.initConstraintDynamics(model, self._data, self._ties)
        self._proximal = pin.ProximalSettings(*PROXIMAL)
        self._drives = [model.joints[self._joints[f"g{k}"]].idx_v for k in range(3)]

    def _hang(self, joint: str, parent: int, axis: Array, frame: Array, inertia: Array) -> None:
        """Add a body by a hinge through O; only its inertia about O matters."""
        pin, still = self._pin, self._pin.SE3.Identity()
        hinge = pin.JointModelRevoluteUnaligned(axis)
        self._joints[joint] = self._model.addJoint(parent, hinge, still, joint)
        body = pin.Inertia(1.0, np.zeros(3), frame @ inertia @ frame.T)
        self._model.appendBodyToJoint(self._joints[joint], body, still)

    def at(self, times: ArrayLike) -> tuple[Array, Array]:
        """Integrate from the start.

        Args:
            times: ascending times from 0 on [s], shape (n,).

        Returns:
            Quaternions of the star (n, 4) and actuator angles [rad], shape (n, 3).

        """
        wanted = np.asarray(times, dtype=float)
        size = self._model.nv
        run = solve_ivp(
            self._derivative, (0.0, float(wanted[-1])), np.append(np.zeros(size), self._start),
            "DOP853", t_eval=wanted, rtol=TOLERANCE, atol=TOLERANCE,
        )  # fmt: skip
        angles = run.y[:size].T
        rotations = np.empty((len(angles), 3, 3))
        for row, q in enumerate(angles):
            self._pin.forwardKinematics(self._model, self._data, q)
            rotations[row] = self._data.oMi[self._joints["b0"]].rotation @ self._rotation
        return quaternion_of(rotations), self._gamma + angles[:, self._drives]

    def _derivative(self, t: float, state: Array) -> Array:
        size = self._model.nv
        force, given = np.zeros(size), self._torque
        phase = np.multiply(given.frequency, t) + given.phase
        force[self._drives] = np.multiply(given.amplitude, np.sin(phase))
        acceleration = self._pin.constraintDynamics(
            self._model, self._data, state[:size], state[size:], force,
            self._ties, self._tied, self._proximal,
        )  # fmt: skip
        return np.append(state[size:], acceleration)
