# SPDX-License-Identifier: Apache-2.0
"""Singular poses of both kinds within the reach of a manipulator, or the finding that it has none.

Serial (det J1 = 0): c_k = sin(mu_k) = 0 means t_k = +-w_k, so w_k.s = 0: E lies on the base arc
P_k P_k+1. By Eq. 4 such poses are only ever at the edge of what is admissible, never inside.
Parallel (det J2 = 0): may lie inside when some alpha_k > 180 deg; none for all alpha_k < 180 deg
and beta_k < 90 deg.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sst_ros.mechanism import kinematics
from sst_ros.mechanism.direct_kinematics import columns, cross
from sst_ros.mechanism.geometry import Array, Geometry, frozen
from sst_ros.mechanism.workspace import OrientationMap, measures, orientations

_BISECTIONS = 55


@dataclass(frozen=True)
class SingularPoses:
    """Poses of one kind. Arrays are read-only.

    Attributes:
        kind: "parallel" or "serial".
        rotation: R, shape (m, 3, 3).
        gamma, beta: joint angles [rad], shape (m, 3); at a serial one gamma_k and beta_k of the
            singular leg have no value: NaN.
        leg: index k of the singular leg, shape (m,); -1 for parallel ones, which involve all.
        determinant: det J2 or c_k that was found, shape (m,): 0 up to rounding.

    """

    kind: str
    rotation: Array
    gamma: Array
    beta: Array
    leg: Array
    determinant: Array

    def __len__(self) -> int:
        """Count the poses."""
        return len(self.rotation)


def parallel(chart: OrientationMap) -> SingularPoses:
    """Admissible poses with det J2 = 0, one for each change of sign along psi in the map.

    The poses fill a surface in (s, psi); the resolution of the map sets how many points of it are
    found. Each is exact to rounding.
    """
    measured, geometry = chart.measures, chart.geometry
    after = np.roll(np.arange(len(chart.psi)), -1)
    change = np.sign(measured.det_j2) * np.sign(measured.det_j2[:, after]) < 0
    # gamma jumps by pi where the pose passes t_k = +-w_k, and det J2 with it: these are serial.
    smooth = np.abs(measured.gamma[:, after] - measured.gamma).max(axis=2) < 1.0
    rows, starts = np.nonzero(change & smooth & measured.admissible & measured.admissible[:, after])
    s = chart.s[rows]
    low = chart.psi[starts].copy()
    high = low + (chart.psi[1] - chart.psi[0])
    sign = np.sign(measured.det_j2[rows, starts])
    for _ in range(_BISECTIONS):
        middle = 0.5 * (low + high)
        same = np.sign(_det_j2(geometry, s, middle)) == sign
        low, high = np.where(same, middle, low), np.where(same, high, middle)
    rotation = orientations(s, low)
    gamma, _, beta = kinematics.inverse(geometry, rotation)
    leg = np.full(len(rows), -1)
    determinant = _det_j2(geometry, s, low)
    return SingularPoses("parallel", *frozen(rotation, gamma, beta, leg, determinant))


def serial(geometry: Geometry, points: int = 90) -> SingularPoses:
    """Poses with c_k = 0 at the edge of what is admissible: all other conditions hold there."""
    found: list[tuple[Array, Array, Array, int, float]] = []
    for k in range(3):
        angles = np.linspace(0.0, geometry.arc[k], points)
        s = np.cos(angles)[:, None] * geometry.v[k]
        s = s + np.sin(angles)[:, None] * cross(geometry.w[k], geometry.v[k])
        for sign in (1.0, -1.0):
            t = np.broadcast_to(sign * geometry.w[k], s.shape)
            # R maps e_k to t_k and z to s; in {E} the triad is (e_k x z, e_k, z).
            e, z = geometry.e[k], np.array([0.0, 0.0, 1.0])
            rotation = columns(cross(t, s), t, s) @ np.stack([np.cross(e, z), e, z])
            gamma, _, beta = kinematics.inverse(geometry, rotation)
            others = [i for i in range(3) if i != k]
            inside = np.all((s @ geometry.w.T)[:, others] > 0.0, axis=1)
            inside &= np.all((beta > 0.0)[:, others], axis=1)
            inside &= np.all((beta <= geometry.beta_max)[:, others], axis=1)
            inside &= np.all(((gamma >= 0.0) & (gamma <= geometry.arc))[:, others], axis=1)
            gamma[:, k] = beta[:, k] = np.nan
            c = np.linalg.norm(cross(t, np.broadcast_to(geometry.w[k], t.shape)), axis=1)
            for i in np.flatnonzero(inside):
                found.append((rotation[i], gamma[i], beta[i], k, float(c[i])))
    rotations = np.array([row[0] for row in found]).reshape(-1, 3, 3)
    gammas, betas = (np.array([row[i] for row in found]).reshape(-1, 3) for i in (1, 2))
    legs = np.array([row[3] for row in found], dtype=int)
    c_k = np.array([row[4] for row in found])
    return SingularPoses("serial", *frozen(rotations, gammas, betas, legs, c_k))


def report(geometry: Geometry, chart: OrientationMap) -> str:
    """Summarise the singular poses in a few lines."""
    lines = []
    for poses in (parallel(chart), serial(geometry)):
        if not len(poses):
            where = "inside" if poses.kind == "parallel" else "at the edge"
            lines.append(f"{poses.kind}: none {where}")
            continue
        row = len(poses) // 2
        gamma = ", ".join(f"{x:.4f}" for x in np.degrees(poses.gamma[row]))
        s = ", ".join(f"{x:.4f}" for x in poses.rotation[row, :, 2])
        leg = f", leg {poses.leg[row] + 1}" if poses.kind == "serial" else ""
        lines.append(
            f"{poses.kind}: {len(poses)} found; for example s = ({s}), gamma = ({gamma}) deg{leg}"
        )
    return "\n".join(lines)


def _det_j2(geometry: Geometry, s: Array, psi: Array) -> Array:
    rotation = orientations(s, psi)
    return measures(geometry, kinematics.inverse(geometry, rotation)[0], rotation).det_j2
