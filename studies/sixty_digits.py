# SPDX-License-Identifier: Apache-2.0
"""Motions to some 30 of 60 digits, by no code of the proof: mpmath and extrapolation.

The start comes from the closure of the loops, r_k . R e_k = 0. The constants of the
equations are made from a scene's numbers in mpmath, too.
"""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
from mpmath import mp, mpf
from numpy import cross

from sst_ros.dynamics import kernel
from sst_ros.dynamics.initial_state import start_of
from sst_ros.mechanism.generic_math import quaternion_rate, rotation_rows
from sst_ros.scene.scene import Scene
from sst_ros.scene.schema import leaves, rebuild
from sst_ros.scene.torque_profile import SineTorque

DIGITS, LOCAL, STAGES = 60, mpf(10) ** -32, 11
exact = np.frompyfunc(mpf, 1, 1)


def unit(a: Any) -> Any:
    """Return a vector of length 1."""
    return a / mp.sqrt(a @ a)


def solve(matrix: Any, right: Any) -> Any:
    """Solve linear equations."""
    return np.array(
        list(mp.lu_solve(mp.matrix(matrix.tolist()), mp.matrix(right.tolist())))
    )


class Motion:
    """A scene under a sine, a function of time, or torques that are held."""

    def __init__(self, scene: Scene, torque: Any = None) -> None:
        with mp.workdps(DIGITS):
            self.v = np.array([unit(row) for row in exact(np.array(scene.base.v))])
            self.w = np.array(
                [unit(cross(self.v[k], self.v[(k + 1) % 3])) for k in range(3)]
            )
            first, second, _ = (mpf(x) * mp.pi / 180 for x in scene.star.alpha_deg)
            angles = (mpf(0), first, first + second)
            self.e = np.array([[-mp.sin(x), mp.cos(x), mpf(0)] for x in angles])
            numbers = {
                p: mpf(x) for p, x in leaves(scene).items() if x and p[0] != "torque"
            }
            arrays: dict[str, Any] = {
                "v": self.v,
                "w": self.w,
                "e": self.e,
                "arc": [mp.pi / 2] * 3,
            }
            geometry: Any = SimpleNamespace(of_leg=lambda name, k: arrays[name][k])
            self.model = kernel.model_of(rebuild(scene, numbers), geometry)
            self.torque = scene.torque if torque is None else torque
            lagged = [mpf(0)] * (3 * scene.lags)
            self.known = {mpf(0): np.array([*self.start(scene), *lagged], dtype=object)}

    def start(self, scene: Scene) -> Any:
        """Return quaternion and body rate by Newton's method on the loop closure."""
        initial = scene.initial
        gamma, gamma_dot = (
            exact(np.array(initial.gamma)),
            exact(np.array(initial.gamma_dot)),
        )
        r = np.array([
            v * mp.cos(x) + cross(w, v) * mp.sin(x)
            for v, w, x in zip(self.v, self.w, gamma, strict=True)
        ])  # fmt: skip
        q = exact(np.array(start_of(scene)[:4]))
        for _ in range(8):  # Newton: a small turn d adds d . (e x R^T r) to r . R e
            x, y, z, w = q
            near = np.array(rotation_rows((x, y, z, w)), dtype=object)
            rows = np.array(
                [cross(e, near.T @ one) for e, one in zip(self.e, r, strict=True)]
            )
            off = np.array([one @ near @ e for e, one in zip(self.e, r, strict=True)])
            d = -solve(rows, off)
            q = q + np.array(quaternion_rate(tuple(q), tuple(d)))
        legs = zip(gamma_dot, self.w, r, self.e, strict=True)
        along = [-g * (cross(w, one) @ near @ e) for g, w, one, e in legs]
        rate = solve(rows, np.array(along))
        return np.array([*unit(q), *rate], dtype=object)

    def slope(self, t: Any, y: Any) -> Any:
        """Return the derivative of the state."""
        torque = self.torque or (0.0, 0.0, 0.0)
        if isinstance(torque, SineTorque):
            rows = zip(torque.amplitude, torque.frequency, torque.phase, strict=True)
            torque = [mpf(a) * mp.sin(mpf(f) * t + mpf(p)) for a, f, p in rows]
        elif callable(torque):
            torque = torque(t)
        return np.array(
            kernel.derivative(self.model, tuple(y), tuple(map(mpf, torque)))
        )

    def at(self, end: float) -> Any:
        """Return the state at a time [s], to about 1e-29."""
        with mp.workdps(DIGITS):
            h, end = mpf("0.02"), mpf(end)
            t = max(time for time in self.known if time <= end)
            y = self.known[t]
            while t < end:
                h = min(h, end - t)
                rows, first = list[Any](), self.slope(t, y)
                for n in range(2, 2 * STAGES + 1, 2):
                    small, before = h / n, y
                    here = y + small * first
                    for k in range(1, n):
                        before, here = (
                            here,
                            before + 2 * small * self.slope(t + k * small, here),
                        )
                    row = [(here + before + small * self.slope(t + h, here)) / 2]
                    for k, old in enumerate(rows[-1] if rows else [], start=1):
                        ratio = (mpf(n) / (n - 2 * k)) ** 2
                        row.append(row[-1] + (row[-1] - old) / (ratio - 1))
                    rows.append(row)
                error = max(abs(x) for x in rows[-1][-1] - rows[-1][-2])
                if error <= LOCAL:
                    t, y = t + h, rows[-1][-1]
                h *= min(
                    mpf(2),
                    max(
                        mpf("0.3"), (LOCAL / error) ** (mpf(1) / (2 * STAGES - 1)) * 0.9
                    ),
                )
            self.known[end] = y
            return y

    def joints(self, y: Any) -> list[Any]:
        """Return angles and rates of the joints."""
        with mp.workdps(DIGITS):
            return [x for row in kernel.joints(self.model, tuple(y)) for x in row]


def angle(q: Any, centre: Any) -> Any:
    """Return the angle between an orientation of 60 digits and floats [rad]."""
    with mp.workdps(DIGITS):
        one, other = unit(q), unit(exact(np.array(centre)))
        chord = min(mp.sqrt((one - s * other) @ (one - s * other)) for s in (1, -1))
        return 4 * mp.asin(chord / 2)
