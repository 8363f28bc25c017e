# SPDX-License-Identifier: Apache-2.0
"""The regressor of the inverse dynamics: torque = known part + Y parameters.

Torques are linear in the inertial parameters, the friction coefficients, the stiffness of springs
and the inertia of the rotors (Atkeson, An and Hollerbach, Int. J. Robotics Research 5 (1986)
101-119). So Y is the derivative of the traced inverse dynamics by these parameters, which has no
parameter in it: the regressor is exact, and covers each term that the dynamics have.

Base parameters are the combinations of parameters that torques depend on, and no others. A QR
decomposition of the regressor shows which columns are combinations of earlier ones (Gautier,
J. Robotic Systems 8 (1991) 485-506). With random states it does so for the mechanism; with the
states of a motion it shows what that motion leaves undetermined as well.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from sst_ros.dynamics import kernel
from sst_ros.dynamics.expression import compile_for_arrays, mark_present, with_jacobian
from sst_ros.dynamics.traced_dynamics import BODY_ACCELERATION, QUATERNION, RATE
from sst_ros.identification.parameters import with_symbols
from sst_ros.mechanism import kinematics
from sst_ros.mechanism.frames import quaternion_of
from sst_ros.mechanism.geometry import Array, Geometry
from sst_ros.scene.scene import Scene

DEPENDENT = 1e-8
"""Distance of a column from the span of those before it, over its own length, below which it counts
as one of them: between rounding (1e-13) and the least of any mechanism tried (1e-4)."""

NEGLIGIBLE = 1e-10
"""Share of a column's length that is rounding."""


class Regressor:
    """Y and the known part of the torques of a scene.

    Args:
        scene: the manipulator; what is not among the parameters is known.
        names: the parameters, see `parameters`.

    """

    def __init__(self, scene: Scene, names: Sequence[str]) -> None:
        self.scene, self.names = scene, tuple(names)
        self._geometry = Geometry.of(scene)
        self._traced = [n for n in self.names if not n.startswith("offset") and n[-5:] != ".mass"]

    def __call__(self, quaternion: Array, rate: Array, acceleration: Array) -> tuple[Array, Array]:
        """Evaluate at n states.

        Args:
            quaternion: of {E} in {B}, (x, y, z, w), shape (n, 4).
            rate: W in {E} [rad/s], shape (n, 3).
            acceleration: W_dot in {E} [rad/s^2], shape (n, 3).

        Returns:
            The known torques [N m], shape (n, 3), and Y, shape (n, 3, len(names)).

        """
        count = len(quaternion)
        # A stiffness of zero leaves no rest angle: springs are evaluated at 1 N m/rad.
        at = [float(name.startswith("springs")) for name in self._traced]
        found = self._function(*quaternion.T, *rate.T, *acceleration.T, *at)
        rows = np.stack([np.broadcast_to(row, (count,)) for row in found]).reshape(-1, 3, count)
        columns = np.zeros((count, 3, len(self.names)))
        columns[:, :, [self.names.index(name) for name in self._traced]] = rows[1:].T
        for i, name in enumerate(self.names):
            if name.startswith("offset"):
                columns[:, int(name[7]), i] = 1.0
        springs = [name.startswith("springs") for name in self.names]
        return rows[0].T - columns[:, :, springs].sum(axis=2), columns

    @cached_property
    def _function(self) -> Any:
        """Three torques, then their derivatives by each parameter of the dynamics."""
        symbols = tuple(f"p{i}" for i in range(len(self._traced)))
        inputs = (*QUATERNION, *RATE, *BODY_ACCELERATION, *symbols)
        return compile_for_arrays(with_jacobian(self._torques, inputs, symbols))

    def _torques(self, *inputs: Any) -> tuple[Any, ...]:
        varied = [mark_present(symbol) for symbol in inputs[10:]]
        opened = with_symbols(
            self.scene, dict(zip(self._traced, varied, strict=True)), moments=True
        )
        model = kernel.model_of(opened, self._geometry)
        torque, _ = kernel.actuator_torque(model, inputs[:4], inputs[4:7], inputs[7:10])
        return torque


@dataclass(frozen=True)
class BaseParameters:
    """Combinations of parameters: beta = transform parameters.

    Attributes:
        names: of the parameters, length p.
        chosen: the parameters whose columns are independent, length b.
        transform: shape (b, p); row i has 1 at the chosen parameter i, and the coefficients of
            those whose columns depend on it.

    """

    names: tuple[str, ...]
    chosen: tuple[int, ...]
    transform: Array

    def of_columns(self, columns: Array) -> Array:
        """Pick the regressor of the base parameters out of that of all, shape (..., p)."""
        return columns[..., list(self.chosen)]

    @property
    def labels(self) -> tuple[str, ...]:
        """Each combination as text."""
        rows = zip(self.transform, self.chosen, strict=True)
        return tuple(_text(row, self.names, i) for row, i in rows)


def find_base_parameters(regressor: Regressor, seed: int = 0) -> BaseParameters:
    """Return the base parameters of the mechanism: those that some motion determines."""
    states = _draw_states(Geometry.of(regressor.scene), seed)
    return find_independent(regressor(*states)[1], regressor.names)


def find_independent(columns: Array, names: Sequence[str]) -> BaseParameters:
    """Return the base parameters of a regressor, shape (n, 3, p)."""
    matrix = _upper(columns.reshape(-1, columns.shape[-1]))
    lengths = np.linalg.norm(matrix, axis=0)
    there = np.flatnonzero(lengths > NEGLIGIBLE * lengths.max(initial=1e-300))
    scaled = matrix[:, there] / lengths[there]
    chosen: list[int] = []
    for i in range(len(there)):
        trial = [*chosen, i]
        # The last diagonal entry of R is the distance from the span of the columns before.
        if abs(_upper(scaled[:, trial])[-1, -1]) > DEPENDENT:
            chosen = trial
    solved = np.linalg.lstsq(scaled[:, chosen], scaled, rcond=None)[0]
    solved[np.abs(solved) < NEGLIGIBLE] = 0.0
    transform = np.zeros((len(chosen), len(names)))
    transform[:, there] = solved * lengths[there] / lengths[there[chosen]][:, None]
    return BaseParameters(tuple(names), tuple(there[chosen].tolist()), transform)


def _upper(matrix: Array) -> Array:
    """R of a QR decomposition."""
    return np.asarray(np.linalg.qr(matrix, mode="r"))


def _draw_states(geometry: Geometry, seed: int) -> tuple[Array, Array, Array]:
    """Random admissible poses within the stroke, rates and accelerations."""
    rng = np.random.default_rng(seed)
    found = kinematics.direct_many(geometry, rng.uniform(0.1, 0.9, (300, 3)) * geometry.arc)
    regular = found.admissible & (np.abs(found.det_j2) > 0.05) & np.all(np.sin(found.mu) > 0.1, 1)
    quaternion = quaternion_of(found.rotation[regular])
    rate, acceleration = rng.normal(size=(2, len(quaternion), 3)) * [[[2.0]], [[20.0]]]
    return quaternion, rate, acceleration


def _text(row: Array, names: Sequence[str], chosen: int) -> str:
    """Write a combination; the chosen parameter comes first."""
    others = [i for i in np.flatnonzero(row).tolist() if i != chosen]
    parts = (
        f" {'-' if row[i] < 0.0 else '+'} "
        + (f"{abs(row[i]):.4g} " if abs(abs(row[i]) - 1.0) > NEGLIGIBLE else "")
        + names[i]
        for i in others
    )
    return names[chosen] + "".join(parts)
