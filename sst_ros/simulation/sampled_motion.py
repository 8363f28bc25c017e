# SPDX-License-Identifier: Apache-2.0
"""The arrays of a motion over time, and what follows from them."""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property
from typing import TypeAlias, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sst_ros.dynamics import kernel
from sst_ros.dynamics.traced_dynamics import Dynamics
from sst_ros.errors import InputError, Problem
from sst_ros.mechanism import frames, kinematics
from sst_ros.mechanism.geometry import Geometry
from sst_ros.scene.scene import Scene
from sst_ros.simulation.torque_profile import FeedbackFunction, TorqueProfile

Array = NDArray[np.float64]
Law: TypeAlias = TorqueProfile | FeedbackFunction
T = TypeVar("T", bound="SampledMotion")


class SampledMotion:
    """Base of `Trajectory`, which has its arguments: the arrays, and what follows from them."""

    def __init__(
        self,
        scene: Scene,
        t: ArrayLike,
        quaternion: ArrayLike,
        body_rate: ArrayLike,
        torque: ArrayLike,
        *,
        joints: ArrayLike | None = None,
        status: int = 0,
        message: str = "",
        method: str = "",
        error_estimate: float = float("nan"),
        energy_residual: float | Callable[[], float] = float("nan"),
        evaluations: int = 0,
        step: float = float("nan"),
        law: Law | None = None,
        dense: Callable[[Array], Array] | None = None,
    ) -> None:
        given = {"t": t, "quaternion": quaternion, "body_rate": body_rate, "torque": torque}
        arrays = {name: _own(value) for name, value in given.items()}
        self.scene = scene
        self.t: Array = arrays["t"]
        self.quaternion: Array = arrays["quaternion"]
        self.body_rate: Array = arrays["body_rate"]
        self.torque: Array = arrays["torque"]
        if joints is not None:
            self._joints = arrays["joints"] = _own(joints)
        _refuse_misfits(arrays)
        self.status = status
        self.message = message
        self.method = method
        self.error_estimate = error_estimate
        self.evaluations = evaluations
        self.step = step
        self.law = law
        self.dense = dense
        self._residual = energy_residual

    def with_states(self: T, y: Array) -> T:
        """Return the same run with other read-only states (n, 7 or 10), before anything is derived.

        Nothing is checked again: a prepared run makes its results by it.
        """
        again = object.__new__(type(self))
        again.__dict__.update(self.__dict__, quaternion=y[:, :4], body_rate=y[:, 4:7])
        if y.shape[1] > 7:
            again.torque = y[:, 7:10]
        return again

    def __len__(self) -> int:
        return len(self.t)

    @property
    def success(self) -> bool:
        """Whether the motion reached its end."""
        return self.status == 0

    @cached_property
    def _joints(self) -> Array:
        """Angles and rates of the joints, shape (n, 18)."""
        with np.errstate(all="ignore"):
            found = kernel.joints(self._dynamics.model, self._columns)
        return np.stack([np.broadcast_to(x, self.t.shape) for row in found for x in row], axis=1)

    @property
    def gamma(self) -> Array:
        """Angles of the actuators [rad], shape (n, 3)."""
        return self._joints[:, 0:3]

    @property
    def mu(self) -> Array:
        """Angles between base arcs and arcs of the star [rad], shape (n, 3)."""
        return self._joints[:, 3:6]

    @property
    def beta(self) -> Array:
        """Angles from the carriages to E [rad], shape (n, 3)."""
        return self._joints[:, 6:9]

    @property
    def gamma_dot(self) -> Array:
        """Rates of gamma [rad/s], shape (n, 3)."""
        return self._joints[:, 9:12]

    @property
    def mu_dot(self) -> Array:
        """Rates of mu [rad/s], shape (n, 3)."""
        return self._joints[:, 12:15]

    @property
    def beta_dot(self) -> Array:
        """Rates of beta [rad/s], shape (n, 3)."""
        return self._joints[:, 15:18]

    @cached_property
    def euler_zyz(self) -> Array:
        """ZYZ angles (theta, phi, psi) of {E} in {B} without jumps [rad], shape (n, 3)."""
        return frames.unwrap_zyz(frames.zyz_angles(frames.rotation_matrix(self.quaternion)))

    @cached_property
    def energy(self) -> Array:
        """Kinetic and potential energy [J], shape (n,)."""
        with np.errstate(all="ignore"):
            model, columns = self._dynamics.model, self._columns
            total = kernel.kinetic_energy(model, columns) + kernel.potential_energy(model, columns)
        return np.asarray(np.broadcast_to(total, self.t.shape))

    @cached_property
    def energy_residual(self) -> float:
        """Energy at the end, less that at the start, less the work done [J]; nan if unknown."""
        return float(self._residual() if callable(self._residual) else self._residual)

    @cached_property
    def closure_error(self) -> float:
        """Largest abs(r_k . t_k) of all samples: how far the loops are from closed; 0 if exact."""
        rotation, geometry = frames.rotation_matrix(self.quaternion), Geometry.of(self.scene)
        return float(np.abs(kinematics.closure(geometry, self.gamma, rotation)).max(initial=0.0))

    @property
    def _dynamics(self) -> Dynamics:
        return Dynamics.of(self.scene)

    @property
    def _columns(self) -> tuple[Array, ...]:
        return (*self.quaternion.T, *self.body_rate.T)


def _own(value: ArrayLike) -> Array:
    """Return an array that nothing can change: a copy, unless it is one already."""
    array: Array = np.asarray(value, dtype=float)
    if array is value and (array.flags.writeable or not array.flags.owndata):
        array = array.copy()
    array.flags.writeable = False
    return array


def _refuse_misfits(arrays: dict[str, Array]) -> None:
    t, problems = arrays["t"], []
    if t.ndim != 1 or not np.isfinite(t).all() or (t[1:] <= t[:-1]).any():
        problems.append(Problem("t", t, "must be finite, ascending times [s], shape (n,)"))
    wanted = {"quaternion": 4, "body_rate": 3, "torque": 3, "joints": 18}
    for name, array in arrays.items():
        if name != "t" and array.shape != (len(t), wanted[name]):
            allowed = f"must have the shape ({len(t)}, {wanted[name]})"
            problems.append(Problem(name, array.shape, allowed))
    if problems:
        raise InputError("trajectory", problems)
