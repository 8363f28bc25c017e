# SPDX-License-Identifier: Apache-2.0
"""Sensitivities of a motion: its exact derivatives by numbers of the scene, start and torques."""

from __future__ import annotations

from collections.abc import Iterable
from itertools import chain
from typing import Any, NamedTuple

import numpy as np

from sst_ros.dynamics.variational import VariationalEquations
from sst_ros.errors import refusal
from sst_ros.mechanism.generic_math import quaternion_rate
from sst_ros.scene.scene import Scene
from sst_ros.scene.schema import key_of
from sst_ros.scene.torque_profile import (
    FunctionTorque,
    LostTorque,
    TorqueProfile,
)
from sst_ros.scene.yaml_document import find_fields, find_number
from sst_ros.state import Array

OWN_TORQUE = "torque"
"""Parameter that means all numbers of the torques."""


class Sensitivity(NamedTuple):
    """Derivatives of a motion at n instants by the k numbers of a parameter.

    Their units are those below over the unit of the parameter. Samples stay at their times, also
    where a limit ends the motion.

    Attributes:
        gamma: of the angles of the actuators [rad], shape (n, 3, k).
        gamma_dot: of their rates [rad/s], shape (n, 3, k).
        rotation: of the orientation, as rotation vectors in {E} [rad], shape (n, 3, k).
        body_rate: of the angular velocity of the star in {E} [rad/s], shape (n, 3, k).

    """

    gamma: Array
    gamma_dot: Array
    rotation: Array
    body_rate: Array


class Sensitivities:
    """Derivatives of a motion by parameters as `simulate` takes them: each may be several numbers.

    A vector means each of its components, a list each of its entries, in their order, and "torque"
    the numbers of the profile: the three torques, `torques` of a `TorqueTable`, coefficients of a
    `PolynomialTorque`, or amplitudes, frequencies and phases of a `SineTorque`. InputError: one
    is no such number, or the torques are a function of the state.
    """

    def __init__(self, scene: Scene, names: Iterable[str], torque: TorqueProfile) -> None:
        keys = {name: [] if name == OWN_TORQUE else _list_numbers(scene, name) for name in names}
        flat = list(dict.fromkeys(chain(*keys.values())))
        self._columns: dict[str, Any] = {
            name: slice(len(flat), None) if name == OWN_TORQUE else [flat.index(key) for key in own]
            for name, own in keys.items()
        }
        by_torque, allowed = OWN_TORQUE in keys, ""
        if torque.feedback or isinstance(torque, LostTorque):
            allowed = "need torques that are known over time, not a function of the state"
        elif by_torque and isinstance(torque, FunctionTorque):
            allowed = "torque needs three numbers or a profile, not a function"
        if allowed:
            raise refusal("simulate", "sensitivities", list(keys), allowed)
        self._equations = VariationalEquations(scene, flat, torque, by_torque=by_torque)
        self._given = np.array([find_number(scene, name) for name in flat], dtype=float)

    def at(self, t: Array) -> dict[str, Sensitivity]:
        """Sensitivities by the name of their parameter at times [s] >= 0, ascending, shape (n,)."""
        states, slopes = self._equations.run(self._given, t)
        motion, slopes = states[:, :7].T, slopes[:, :7]
        turn = np.array([quaternion_rate(tuple(motion[:4]), tuple(row)) for row in np.eye(3)])
        rates = np.einsum("qcn,nqp->ncp", self._equations.differentiate_joints(motion), slopes)
        # quaternion_rate(q, .) has orthogonal columns of length abs(q) / 2.
        rotation = 4.0 * np.einsum("cqn,nqp->ncp", turn, slopes[:, :4])
        whole = Sensitivity(rates[:, :3], rates[:, 3:], rotation, slopes[:, 4:])
        return {
            name: Sensitivity(*(array[..., columns] for array in whole))
            for name, columns in self._columns.items()
        }


def _list_numbers(scene: Scene, name: str) -> list[str]:
    """Return the key of each number that a key names; itself where it names nothing."""
    try:
        fields = list(find_fields(scene, name, components=True))
    except ValueError:
        return [name]
    return [key_of((*place, *i)) for place, x, _ in fields for i in np.ndindex(np.shape(x))]
