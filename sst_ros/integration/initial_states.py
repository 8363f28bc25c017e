# SPDX-License-Identifier: Apache-2.0
"""States at t = 0 of many scenarios; one that cannot start does not stop the others."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from sst_ros.dynamics.initial_state import body_rate
from sst_ros.errors import SingularConfiguration
from sst_ros.mechanism import kinematics
from sst_ros.mechanism.frames import quaternion_of
from sst_ros.mechanism.geometry import Array, Geometry
from sst_ros.progress import slices

NO_ASSEMBLY, NO_RATE = -1, -2
SAID = {
    NO_ASSEMBLY: "no unique admissible assembly",
    NO_RATE: "gamma_dot does not determine the body rate: singular start",
}
"""Why a scenario does not start, by its code."""


def starts(
    geometries: Sequence[Geometry],
    which: NDArray[np.intp],
    gamma: Array,
    gamma_dot: Array,
    label: str,
    progress: bool,
) -> tuple[Array, Array, NDArray[np.int64]]:
    """Quaternions (N, 4), body rates (N, 3) [rad/s] and codes (N,), 0 for those that start.

    Args:
        geometries: the distinct geometries.
        which: number of the geometry of each scenario, shape (N,).
        gamma: actuator angles [rad], shape (N, 3).
        gamma_dot: their rates [rad/s], shape (N, 3).
        label: what a bar is called.
        progress: draw a bar on a terminal.

    """
    count = len(gamma)
    quaternion, rate = np.tile([0.0, 0.0, 0.0, 1.0], (count, 1)), np.zeros((count, 3))
    code = np.full(count, NO_ASSEMBLY, dtype=np.int64)
    order = np.argsort(which, kind="stable")
    groups = np.split(order, np.cumsum(np.bincount(which, minlength=len(geometries)))[:-1])
    for part in slices(len(geometries), 0, label, progress):
        for geometry, rows in zip(geometries[part], groups[part], strict=True):
            found = kinematics.direct_many(geometry, gamma[rows])
            counts = np.bincount(found.configuration[found.admissible], minlength=len(rows))
            for i in np.flatnonzero(found.admissible):
                one = found.configuration[i]
                if counts[one] == 1:
                    n, rotation = rows[one], found.rotation[i]
                    try:
                        rate[n] = body_rate(geometry, gamma[n], gamma_dot[n], rotation)
                        quaternion[n], code[n] = quaternion_of(rotation), 0
                    except SingularConfiguration:
                        code[n] = NO_RATE
    return quaternion, rate, code
