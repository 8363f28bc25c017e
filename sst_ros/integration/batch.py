# SPDX-License-Identifier: Apache-2.0
"""Many scenarios of one scene at once, compiled, on all cores."""

from __future__ import annotations

import os
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cached_property
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sst_ros.errors import InputError, Problem
from sst_ros.integration import backend
from sst_ros.integration.blocks import LANES, NOT_FINITE, batch_source
from sst_ros.integration.system import System
from sst_ros.integration.tableaux import DOP853, Tableau
from sst_ros.limits import Limit, limits_of
from sst_ros.mechanism import kernel, kinematics, virtual_work
from sst_ros.mechanism.compiled import QUATERNION, RATE, Dynamics
from sst_ros.mechanism.frames import quaternion_of
from sst_ros.mechanism.geometry import Array, Geometry
from sst_ros.mechanism.trace import Program, trace
from sst_ros.mechanism.triples import dot, rotation_rows
from sst_ros.progress import slices
from sst_ros.scene import Scene

_CHUNKS = 50
_NO_START = -1


@dataclass(frozen=True)
class Scenarios:
    """What became of N scenarios. A faulted one keeps its last valid state.

    Attributes:
        quaternion: orientations (x, y, z, w), shape (N, 4).
        body_rate: angular velocities in {E} [rad/s], shape (N, 3).
        fault: why a scenario ended early, "" where it did not, N texts.
        fault_time: end of the step in which it ended [s], nan where it did not, shape (N,).
        local_error: largest local error estimate of a quaternion in a step, shape (N,).
        kept: states (quaternion, body rate) every `keep_every` steps from the start on, shape
            (samples, N, 7); None unless asked for.

    """

    quaternion: Array
    body_rate: Array
    fault: tuple[str, ...]
    fault_time: Array
    local_error: Array
    kept: Array | None


class Batch:
    """A scene compiled for many scenarios, by an explicit method with fixed steps.

    Args:
        scene: what is simulated; its ends must not be rigid (impact).
        method: explicit method.
        profile: apply the scene's own torques over time on top of none given to `run`.

    Raises:
        InputError: numba is not installed, or the scene has impacts or no torque to apply.

    """

    def __init__(self, scene: Scene, method: Tableau = DOP853, *, profile: bool = False) -> None:
        problems = []
        if backend.numba_version() is None:
            problems.append(Problem("numba", None, "must be installed: pip install sst_ros[fast]"))
        if scene.stroke.at_end == "impact":
            problems.append(Problem("stroke.at_end", "impact", "must not be impact in a batch"))
        if profile and scene.torque is None:
            problems.append(Problem("torque", None, "must be given in the scene for its profile"))
        if problems:
            raise InputError(scene.name, problems)
        self.scene = scene
        self.geometry = Geometry.of(scene)
        self._dynamics = Dynamics(scene)
        self._system = System(self._dynamics, scene.torque if profile else None)
        self._limits = tuple(limits_of(scene, self.geometry))
        self._module = self._compile(method)

    def run(
        self,
        gamma: ArrayLike,
        gamma_dot: ArrayLike,
        torque: ArrayLike = (0.0, 0.0, 0.0),
        *,
        step: float,
        count: int,
        keep_every: int = 0,
        threads: int = 0,
        progress: bool = False,
    ) -> Scenarios:
        """Run all scenarios for `count` steps.

        Args:
            gamma: initial actuator angles [rad], shape (N, 3).
            gamma_dot: initial rates [rad/s], shape (N, 3) or (3,).
            torque: constant torques [N m], shape (N, 3) or (3,); not used with a profile.
            step: length of a step [s].
            count: number of steps.
            keep_every: keep the states every so many steps; 0 keeps none.
            threads: how many; 0 takes all cores. No bit depends on it.
            progress: draw a bar on a terminal.

        Raises:
            InputError: an argument is not finite or has another shape.

        """
        gamma = _rows("gamma", gamma, None)
        y, code = self.start(gamma, gamma_dot)
        given = self.drives(torque, len(gamma))
        when, error = np.full(len(gamma), np.nan), np.zeros(len(gamma))
        kept = [y[:7].T.copy()] if keep_every else []
        size = keep_every or max(1, count // _CHUNKS)
        for part in slices(count, size, self.scene.name, progress):
            span = part.stop - part.start
            self.advance(part.start, span, step, y, given, code, when, error, threads=threads)
            if keep_every and span == keep_every:
                kept.append(y[:7].T.copy())
        when[code == _NO_START] = 0.0
        return Scenarios(
            quaternion=y[:4].T.copy(),
            body_rate=y[4:7].T.copy(),
            fault=tuple(self._said(int(number)) for number in code),
            fault_time=when,
            local_error=error,
            kept=np.stack(kept) if kept else None,
        )

    def start(self, gamma: Array, gamma_dot: ArrayLike) -> tuple[Array, NDArray[np.int64]]:
        """States at t = 0, a column a scenario, and codes: 0, or of those that cannot start."""
        rates = _rows("gamma_dot", gamma_dot, len(gamma))
        y = np.zeros((len(self.state), len(gamma)))
        y[3] = 1.0
        code = np.full(len(gamma), _NO_START, dtype=np.int64)
        found = kinematics.direct_many(self.geometry, gamma)
        counts = np.bincount(found.configuration[found.admissible], minlength=len(gamma))
        for row in np.flatnonzero(found.admissible):
            n = int(found.configuration[row])
            if counts[n] == 1:
                rotation = found.rotation[row]
                posture = virtual_work.posture(self.geometry, gamma[n], rotation)
                y[:4, n] = quaternion_of(rotation)
                y[4:7, n] = rotation.T @ posture.j @ rates[n]
                code[n] = 0
        return y, code

    def drives(self, torque: ArrayLike, number: int) -> Array:
        """Return what acts from outside, a column a scenario."""
        given = np.zeros((max(len(self._system.drive), 1), number))
        if len(self._system.drive) >= 3:
            given[:3] = _rows("torque", torque, number).T
        return given

    def advance(
        self, first: int, count: int, step: float, *columns: NDArray[Any], threads: int = 0
    ) -> None:
        """Go on by `count` steps from step `first`: columns y, given, code, when, error change.

        Threads take whole blocks in turn, without the interpreter's lock.
        """
        threads = threads or len(os.sched_getaffinity(0))
        shares = _shares(-(-columns[0].shape[1] // LANES), threads)

        def run(share: tuple[int, int]) -> None:
            self._module.batch(step, first, count, *share, *columns)

        with ThreadPoolExecutor(threads) as pool:
            list(pool.map(run, shares))

    def _said(self, code: int) -> str:
        if code == 0:
            return ""
        if code == _NO_START:
            return "no unique admissible assembly"
        return "not finite" if code == NOT_FINITE else self._limits[code - 1].reason

    @property
    def state(self) -> tuple[str, ...]:
        """Names of the state's numbers."""
        return self._system.state

    @property
    def program(self) -> Program:
        """Derivative of the state."""
        return self._system.program

    def _compile(self, method: Tableau) -> ModuleType:
        text = batch_source(self.program, self.margins, method, len(self.state))
        nodes = {"NODES": method.c}
        return backend.load([text], nodes, numba=True, nogil=True)

    @cached_property
    def margins(self) -> Program:
        """Signs of the limits without an angle: positive inside, for angles less than pi away."""
        model = self._dynamics.model

        def signs(*state: Any) -> tuple[Any, ...]:
            rows = rotation_rows(state[:4])
            legs = [kernel.leg_motion(leg, rows, state[4:7]) for leg in model.legs]
            return tuple(
                _sign(limit, legs[limit.leg], model.legs[limit.leg]) for limit in self._limits
            )

        return trace(signs, (*QUATERNION, *RATE))


def _shares(blocks: int, threads: int) -> list[tuple[int, int]]:
    """First and last + 1 of the blocks of each share of the work; more shares than threads."""
    size = max(1, -(-blocks // (4 * threads)))
    return [(first, min(first + size, blocks)) for first in range(0, blocks, size)]


def _sign(limit: Limit, at: Any, leg: kernel.Leg) -> Any:
    """sin(sign * (angle - end)) times something positive."""
    if limit.joint < 3:
        along, across = dot(at.outward, leg.v), dot(at.outward, leg.across)
    elif limit.joint < 6:
        return at.u - np.sin(limit.end) ** 2
    else:
        along, across = at.p[2], at.p[0] * leg.e1 - at.p[1] * leg.e0
    cosine, sine = float(np.cos(limit.end)), float(np.sin(limit.end))
    return limit.sign * (across * cosine - along * sine)


def _rows(name: str, value: ArrayLike, count: int | None) -> Array:
    rows = np.asarray(value, dtype=float)
    if count is not None and rows.shape == (3,):
        rows = np.tile(rows, (count, 1))
    expected = "(N, 3)" if count is None else f"(3,) or ({count}, 3)"
    if rows.ndim != 2 or rows.shape[1] != 3 or (count is not None and len(rows) != count):
        raise InputError("batch", [Problem(name, rows.shape, f"must have the shape {expected}")])
    if not np.all(np.isfinite(rows)):
        raise InputError("batch", [Problem(name, rows, "must be finite")])
    return rows
