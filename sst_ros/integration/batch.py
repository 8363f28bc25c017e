# SPDX-License-Identifier: Apache-2.0
"""Many scenarios of one scene at once, compiled, on all cores."""

from __future__ import annotations

import copy
import os
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from functools import cached_property
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sst_ros.dynamics.initial_state import SINGULAR
from sst_ros.dynamics.traced_dynamics import TORQUE
from sst_ros.errors import InputError, Problem
from sst_ros.extras import require
from sst_ros.host.output import slices
from sst_ros.integration import codegen
from sst_ros.integration.batch_result import NO_ASSEMBLY, NO_RATE, OUTSIDE, BatchResult, BatchStates
from sst_ros.integration.batch_source import EARLIEST, NOT_FINITE, SIMD_WIDTH, batch_source
from sst_ros.integration.methods import DOP853, Tableau
from sst_ros.integration.parametric_model import ParametricModel, Scenarios
from sst_ros.mechanism import kinematics
from sst_ros.mechanism.frames import quaternion_of
from sst_ros.mechanism.geometry import Array
from sst_ros.scene.scene import Scene

_UNUSED = {
    "initial": "is given to run, not as a parameter",
    **dict.fromkeys(("motion", "duration"), "has no effect on a batch"),
}

FINE = 16
"""Parts of a step that is repeated to locate an end: the error of a cubic falls 65,536 times."""

_BLOCK = 2000
"""Starts solved at once: their arrays fit the cache."""


Advance = Callable[..., None]
"""(first, count, step, *arrays, rows=None): advances states by steps from step `first`, and changes
the arrays of `batch_source`. `rows` are those whose last step is repeated; None for all."""


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
        unused = _UNUSED if profile else {**_UNUSED, "torque": "acts with profile=True only"}
        problems = [
            Problem(key, "given", unused[section])
            for key in parameters or ()
            if (section := key.partition(".")[0]) in unused
        ]
        if profile and scene.torque is None:
            problems.append(Problem("torque", None, "must be given in the scene for its profile"))
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
        problems = []
        if not (np.isfinite(step) and step > 0.0):
            problems.append(Problem("step", step, "must be finite and > 0 [s]"))
        for name, value in (("count", count), ("keep_every", keep_every), ("threads", threads)):
            if value < 0:
                problems.append(Problem(name, value, "must be >= 0"))
        if problems:
            raise InputError("batch", problems)

        def advance(first: int, count: int, step: float, *arrays: Any, rows: Any) -> None:
            self.advance(first, count, step, *arrays, threads=threads if rows is None else 1)

        how: Any = {"step": step, "count": count, "keep_every": keep_every, "progress": progress}
        return self.integrate(advance, gamma, gamma_dot, torque, **how)

    def integrate(
        self,
        advance: Advance,
        gamma: ArrayLike,
        gamma_dot: ArrayLike,
        torque: ArrayLike = (0.0, 0.0, 0.0),
        *,
        step: float,
        count: int,
        keep_every: int,
        progress: bool = False,
    ) -> BatchResult:
        """Do what `run` does, with a loop of one's own: start, advance, locate the ends."""
        y, code = self.start(gamma, gamma_dot, progress=progress)
        number = y.shape[1]
        given = self.drives(torque, number)
        time, error = np.full(number, np.nan), np.zeros(number)
        kept, ends = [y.copy()], [0]
        size = keep_every or (0 if progress else max(count, 1))  # few calls: each passes all rows
        for part in slices(count, size, self.scene.name, progress):
            span = part.stop - part.start
            advance(part.start, span, step, y, given, code, time, error, rows=None)
            if keep_every and span == keep_every:
                kept.append(y.copy())
                ends.append(part.stop)
        time[code < 0] = 0.0
        # A step in which a limit was passed is left out: its beginning is the last valid state.
        steps = np.where(code > 0, whole_steps(time, step), count)
        steps[code < 0] = 0
        _locate_ends(advance, step, steps, y, given, code, time)
        last = steps * step
        commanded = self.model.ode.drive[:3] == TORQUE
        torques = np.ascontiguousarray(given[:3].T) if commanded else np.zeros((number, 3))
        common = self.model, self.columns, torques, code >= 0
        samples = np.minimum.outer(step * np.array(ends, dtype=float), last)
        states = BatchStates(*common, samples, np.stack(kept)) if keep_every else None
        return BatchResult(
            *common, last, y, code=code, fault_time=time, local_error=error, kept=states
        )

    def start(
        self, gamma: ArrayLike, gamma_dot: ArrayLike, *, progress: bool = False
    ) -> tuple[Array, NDArray[np.int64]]:
        """States at t = 0, a column a scenario, and codes: 0, or why one cannot start."""
        count, columns = self._scenarios.count, self.columns
        # One start for all is solved once.
        alike = np.ndim(gamma) == np.ndim(gamma_dot) == columns.geometries.alpha.ndim == 1
        angles = _rows("gamma", gamma, 1 if alike and count else count)
        rates = _rows("gamma_dot", gamma_dot, len(angles))
        which = np.broadcast_to(columns.geometry[: len(angles)], len(angles))
        y = np.zeros((len(self.model.ode.state), len(angles)))
        y[3] = 1.0
        code = np.full(len(angles), NO_ASSEMBLY, dtype=np.int64)
        for part in slices(len(angles), _BLOCK, f"{self.scene.name}, starting", progress):
            self._start_rows(which[part], angles[part], rates[part], y[:, part], code[part])
        if alike and count:
            y, code = np.repeat(y, count, axis=1), np.repeat(code, count)
        return y, code

    def _start_rows(
        self, which: NDArray[Any], gamma: Array, gamma_dot: Array, y: Array, code: NDArray[Any]
    ) -> None:
        """Set states, at rest in {B} as yet, and codes; what cannot start does not stop others."""
        geometries = self.columns.geometries
        starts = np.column_stack([which, gamma])
        different, same = np.unique(starts, axis=0, return_inverse=True)
        own = geometries.of_rows(different[:, 0].astype(np.intp))
        found = kinematics.direct_many(own, different[:, 1:])
        valid = np.flatnonzero(found.admissible)
        owner = found.configuration[valid]
        one = np.zeros(len(different), dtype=np.intp)
        one[owner] = valid
        same = same.ravel()
        here = np.flatnonzero(np.bincount(owner, minlength=len(different))[same] == 1)
        chosen = one[same[here]]
        y[:4, here] = quaternion_of(found.rotation[chosen]).T
        moving = gamma_dot[here].any(axis=1)
        singular = moving & (np.abs(found.det_j2[chosen]) < SINGULAR)
        code[here] = np.where(singular, NO_RATE, 0)
        moves = moving & ~singular
        rows = here[moves]
        geometry = geometries.of_rows(which[rows])
        # gamma_dot_k = g_k . W, g_k = (w_k - a t_k) / (1 - a^2), a = t_k . w_k, all in {E}
        w = geometry.w @ found.rotation[chosen[moves]]
        a = np.sum(geometry.e * w, axis=-1, keepdims=True)
        g = (w - a * geometry.e) / (1.0 - a * a)
        y[4:7, rows] = np.linalg.solve(g, gamma_dot[rows][..., None])[..., 0].T
        if self.scene.stroke.at_end == "stop":
            outside = (gamma < 0.0) | (gamma > geometries.of_rows(which).arc)
            code[outside.any(axis=1)] = OUTSIDE

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

        Threads take whole blocks in turn, more shares than threads; the compiled code releases the
        interpreter's lock.
        """
        threads = threads or len(os.sched_getaffinity(0))
        blocks, run = -(-columns[0].shape[1] // SIMD_WIDTH), self.module.batch
        if threads == 1:
            run(step, first, count, 0, blocks, *columns)
            return
        size = max(1, -(-blocks // (4 * threads)))
        with ThreadPoolExecutor(threads) as pool:
            jobs = [
                pool.submit(run, step, first, count, begin, min(begin + size, blocks), *columns)
                for begin in range(0, blocks, size)
            ]
        for job in jobs:
            job.result()

    @cached_property
    def module(self) -> ModuleType:
        """The compiled function `batch`, see `batch_source`."""
        model, method = self.model, self._method
        text = batch_source(model.program, model.limit_distances, method, len(model.ode.state))
        return codegen.load([text], {"NODES": method.c}, numba=True, nogil=True)


def whole_steps(time: Array, step: float) -> Array:
    """Return how many steps ended before a time at which a limit was passed [s]."""
    return np.asarray(np.ceil(time / step - 0.1 * EARLIEST) - 1.0)


def _locate_ends(
    advance: Advance, step: float, steps: Array, y: Array, given: Array, code: Any, time: Array
) -> None:
    """Repeat the steps in which limits were passed by finer ones; `code` and `time` change."""
    ended = np.flatnonzero((code > 0) & (code < NOT_FINITE))
    for number in np.unique(steps[ended]):
        rows = ended[steps[ended] == number]
        found, when = np.zeros(len(rows), dtype=np.int64), np.full(len(rows), np.nan)
        arrays = np.ascontiguousarray(y[:, rows]), np.ascontiguousarray(given[:, rows]), found, when
        first = int(number) * FINE
        advance(first, FINE, step / FINE, *arrays, np.zeros(len(rows)), rows=rows)
        located = (found > 0) & (found < NOT_FINITE)
        code[rows[located]], time[rows[located]] = found[located], when[located]


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
