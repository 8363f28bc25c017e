# SPDX-License-Identifier: Apache-2.0
"""Many scenarios of one scene at once, compiled, on all cores."""

from __future__ import annotations

import copy
import os
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from functools import cached_property
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sst_ros.dynamics.expression import Program
from sst_ros.dynamics.traced_dynamics import TORQUE
from sst_ros.errors import InputError, Problem
from sst_ros.extras import require
from sst_ros.integration import codegen
from sst_ros.integration.batch_result import BatchResult
from sst_ros.integration.batch_run import integrated
from sst_ros.integration.batch_source import SIMD_WIDTH, batch_source
from sst_ros.integration.initial_states import initial_states
from sst_ros.integration.methods import DOP853, Tableau
from sst_ros.integration.parametric_model import ParametricModel
from sst_ros.integration.scenarios import Scenarios
from sst_ros.mechanism.geometry import Array
from sst_ros.scene.scene import Scene

_UNUSED = {
    "initial": "is given to run, not as a parameter",
    **dict.fromkeys(("motion", "duration"), "has no effect on a batch"),
}


class Batch:
    """A scene compiled for many scenarios, by an explicit method with fixed steps.

    Args:
        scene: what is simulated.
        method: explicit method.
        profile: apply the scene's own torques over time on top of none given to `run`.
        parameters: numbers of the scene that differ between scenarios, by their keys in the
            document, as in {"star.inertia.zz": [...], "gravity.acceleration": [[...], ...]}: a row
            a scenario. A list without an index means all of its entries.
        progress: draw a bar on a terminal while scenarios are prepared.

    Attributes:
        model: the traced programs.
        columns: the numbers of the scenarios.

    Raises:
        InputError: the scene has no torque to apply, or the numbers of a scenario make no scene.
        MissingDependency: numba is not installed.

    """

    def __init__(
        self,
        scene: Scene,
        method: Tableau = DOP853,
        *,
        profile: bool = False,
        parameters: Mapping[str, ArrayLike] | None = None,
        progress: bool = False,
    ) -> None:
        if codegen.numba_version() is None:
            require("numba")
            raise InputError(scene.name, [Problem("SST_ROS_NUMBA", "0", "must not be set to 0")])
        problems = []
        if profile and scene.torque is None:
            problems.append(Problem("torque", None, "must be given in the scene for its profile"))
        unused = _UNUSED if profile else {**_UNUSED, "torque": "acts with profile=True only"}
        unused_keys = [(key, unused.get(key.partition(".")[0])) for key in parameters or ()]
        problems += [Problem(key, "given", reason) for key, reason in unused_keys if reason]
        if problems:
            raise InputError(scene.name, problems)
        self.scene, self._method = scene, method
        own = {key: copy.copy(values) for key, values in (parameters or {}).items()}
        self._scenarios = Scenarios(scene, own)
        self._scenarios.check(progress=progress)
        self.model = ParametricModel(self._scenarios, profile=profile)
        self.columns = self.model.columns(self._scenarios)

    def with_parameters(self, scenarios: Scenarios) -> Batch:
        """Return a batch of other scenarios, already checked, that shares this one's compiled code.

        Raises:
            InputError: numbers differ that do not differ in this batch.

        """
        other = copy.copy(self)
        other._scenarios, other.columns = scenarios, self.model.columns(scenarios)
        return other

    def scenario(self, row: int) -> Scene:
        """Return the scene of a scenario: a document that runs by itself."""
        return self._scenarios.scene(row)

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
    ) -> BatchResult:
        """Run all scenarios for `count` steps.

        Args:
            gamma: initial actuator angles [rad], shape (N, 3), or (3,) where parameters vary.
            gamma_dot: initial rates [rad/s], shape (N, 3) or (3,).
            torque: constant torques [N m], shape (N, 3) or (3,), within the actuators' limit where
                they have one; not used with a profile.
            step: length of a step [s].
            count: number of steps.
            keep_every: keep the states every so many steps, see `BatchResult.kept`; 0 keeps none.
            threads: how many; 0 takes all cores. No bit depends on it.
            progress: draw a bar on a terminal.

        Raises:
            InputError: an argument is not allowed; names it and what is.

        """
        _refuse_bad_steps(step, count, keep_every, threads)
        y, code = self.start(gamma, gamma_dot, progress=progress)

        def advance(first: int, count: int, step: float, *arrays: Any, rows: Any) -> None:
            self.advance(first, count, step, *arrays, threads=threads if rows is None else 1)

        return integrated(
            self.model, self.columns, (y, code), self.drives(torque, y.shape[1]), advance,
            step=step, count=count, keep_every=keep_every, progress=progress,
        )  # fmt: skip

    def start(
        self, gamma: ArrayLike, gamma_dot: ArrayLike, *, progress: bool = False
    ) -> tuple[Array, NDArray[np.int64]]:
        """States at t = 0, a column a scenario, and codes: 0, or why one cannot start."""
        count = self._scenarios.count
        # One start for all is solved once.
        alike = np.ndim(gamma) == np.ndim(gamma_dot) == self.columns.geometries.alpha.ndim == 1
        angles = _rows("gamma", gamma, 1 if alike and count else count)
        rates = _rows("gamma_dot", gamma_dot, len(angles))
        which = np.broadcast_to(self.columns.geometry[: len(angles)], len(angles))
        label = f"{self.scene.name}, starting"
        quaternion, rate, code = initial_states(
            self.columns.geometries,
            which,
            angles,
            rates,
            stroke=self.scene.stroke.at_end == "stop",
            label=label,
            progress=progress,
        )
        number = count if alike and count else len(angles)
        y = np.zeros((len(self.state), number))
        y[:4], y[4:7] = quaternion.T, rate.T
        return y, np.repeat(code, number) if alike else code

    def drives(self, torque: ArrayLike, number: int) -> Array:
        """Return what acts from outside and what differs, a column a scenario."""
        drive, columns = self.model.ode.drive, self.columns.inputs
        given = np.zeros((max(len(drive) + len(columns), 1), number))
        if drive[:3] == TORQUE:
            limit = self.columns.torque_limit
            given[:3] = np.clip(_rows("torque", torque, number).T, -limit, limit)
        given[len(drive) : len(drive) + len(columns)] = columns
        return given

    def advance(
        self, first: int, count: int, step: float, *columns: NDArray[Any], threads: int = 0
    ) -> None:
        """Advance by `count` steps from step `first`; y, given, code, time and error change.

        Threads take whole blocks in turn; the compiled code releases the interpreter's lock.
        """
        threads = threads or len(os.sched_getaffinity(0))
        shares = _shares(-(-columns[0].shape[1] // SIMD_WIDTH), threads)
        run = self.module.batch
        if threads == 1:
            run(step, first, count, 0, shares[-1][1] if shares else 0, *columns)
            return
        with ThreadPoolExecutor(threads) as pool:
            list(pool.map(lambda share: run(step, first, count, *share, *columns), shares))

    @property
    def state(self) -> tuple[str, ...]:
        """Names of the state's numbers."""
        return self.model.ode.state

    @property
    def program(self) -> Program:
        """Derivative of the state; inputs t, state, drive, and the numbers that differ."""
        return self.model.program

    @property
    def limit_distances(self) -> Program:
        """Distances to the limits, and their rates; see `ParametricModel`."""
        return self.model.limit_distances

    @cached_property
    def module(self) -> ModuleType:
        """The compiled function `batch`, see `batch_source`."""
        text = batch_source(self.program, self.limit_distances, self._method, len(self.state))
        return codegen.load([text], {"NODES": self._method.c}, numba=True, nogil=True)


def _shares(blocks: int, threads: int) -> list[tuple[int, int]]:
    """First and last + 1 of the blocks of each share of the work; more shares than threads."""
    size = max(1, -(-blocks // (4 * threads)))
    return [(first, min(first + size, blocks)) for first in range(0, blocks, size)]


def _refuse_bad_steps(step: float, count: int, keep_every: int, threads: int) -> None:
    problems = []
    if not (np.isfinite(step) and step > 0.0):
        problems.append(Problem("step", step, "must be finite and > 0 [s]"))
    for name, value in (("count", count), ("keep_every", keep_every), ("threads", threads)):
        if value < 0:
            problems.append(Problem(name, value, "must be >= 0"))
    if problems:
        raise InputError("batch", problems)


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
