# SPDX-License-Identifier: Apache-2.0
"""Many scenarios of one scene at once, on all cores; the results as arrays.

Results have the names of a `Trajectory`, with an axis of scenarios before that of
components.
"""

from __future__ import annotations

import math
import os
from collections.abc import Mapping
from functools import lru_cache, partial
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sst_ros.dynamics.initial_state import NO_ASSEMBLY, NO_RATE, initial_states
from sst_ros.dynamics.model import limits_of
from sst_ros.dynamics.motion_table import MotionTable
from sst_ros.dynamics.traced_dynamics import (
    STATE_SIZE,
    TORQUE_SYMBOLS,
    ParameterColumns,
    ParametricModel,
)
from sst_ros.errors import Check, check_kinds, read_numbers, refuse_unless
from sst_ros.integration.batch_session import BatchSession
from sst_ros.integration.batch_step import (
    LANE_BLOCK,
    NOT_FINITE_CODE,
    Advance,
    Block,
    Columns,
    ColumnStep,
    Endings,
    advance_blocks,
    locate_ends,
    steps_of_ends,
    whole_lanes,
)
from sst_ros.integration.many_runs import run_many
from sst_ros.integration.methods import DOP853, Tableau
from sst_ros.mechanism.geometry import Array
from sst_ros.progress import slices
from sst_ros.scene.scene import Scenarios, Scene, SceneInput, scene_of
from sst_ros.scene.schema import FULL_TURN
from sst_ros.state import (
    LAGGED_TORQUES,
    QUATERNION,
    STAR,
    STAR_RATE,
    TORQUES,
    Explained,
    cached_property,
    freeze,
)

_UNUSED = {
    "initial": "is given to run, not as a parameter",
    **dict.fromkeys(("motion", "duration"), "has no effect on a batch"),
}

_BATCH_BLOCK = 1024
"""States whose joints are computed at once.

All numbers of the program are arrays of this length.
"""

_MOST_BATCH_STEPS = 10**9
"""Most steps of a run."""

_THREAD_COLUMNS = 64
"""Columns that are worth a thread of their own."""
_SHARES_OF_A_THREAD = 4
"""Shares of the blocks that a thread takes one after the other, as some take longer."""

OUTSIDE_STATUS = -3
_REASONS = {
    0: "reached the end",
    NO_ASSEMBLY: "no unique admissible assembly",
    NO_RATE: "gamma_dot does not determine the body rate: singular start",
    OUTSIDE_STATUS: "initial gamma outside the stroke",
    NOT_FINITE_CODE: "not finite",
}
"""How a scenario ended, by its code, where no limit ended it.

With a code below zero it did not start.
"""

_SCENARIO = {"status": "", "message": "", "fault_time": "s", "local_error": ""}
"""Attributes of a result that are one number or text a scenario, with units."""


class Batch(Explained):
    """Many scenarios of a scene, by an explicit method with fixed steps.

    With llvmlite the steps are machine code; without it NumPy takes them, slower, to
    the same bits.

    Args:
        scene: what is simulated.
        method: explicit method.
        profile: apply the scene's own torques over time; `run` is given none then.
        parameters: numbers of the scene that differ between scenarios, by their keys in
            the document, as in {"star.inertia.zz": [...], "gravity.acceleration":
            [[...], ...]}: a row a scenario. A list without an index means all of its
            entries.

    Attributes:
        model: the traced programs.
        columns: the numbers of the scenarios.

    Raises:
        InputError: the scene has no torque to apply, or the numbers of a scenario make
            no scene.

    """

    @check_kinds
    def __init__(
        self,
        scene: SceneInput,
        method: Tableau = DOP853,
        *,
        profile: bool = False,
        parameters: Mapping[str, ArrayLike] | None = None,
    ) -> None:
        scene = scene_of(scene)
        unused = dict(_UNUSED)
        if not profile:
            unused["torque"] = "acts with profile=True only"
        has_torque = not profile or scene.torque is not None
        checks: list[Check] = []
        for key in parameters or ():
            section = key.partition(".")[0]
            is_used = section not in unused
            checks.append((key, "given", is_used, unused.get(section, "")))
        requirement = "must be given in the scene for its profile"
        refuse_unless(scene.name, *checks, ("torque", None, has_torque, requirement))
        self.scene = scene
        self._method = method
        self._scenarios = Scenarios(scene, parameters or {})
        self._scenarios.check()
        self.model = ParametricModel.of(self._scenarios, profile=profile)
        self.columns = self.model.columns(self._scenarios)

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle what was given.

        Programs are traced and compiled again where they are needed.
        """
        return _make_batch, (
            self.scene,
            self._method,
            self.model.profile,
            self._scenarios.rows,
        )

    def result_of(self, endings: Endings, t: Array, y: Array) -> BatchResult:
        """Return the states of all scenarios as a `BatchResult`.

        See there for the arguments.
        """
        return BatchResult(self.model, self.columns, endings, t, y)

    def with_parameters(self, scenarios: Scenarios) -> Batch:
        """Return a batch of other scenarios that shares this one's programs.

        The scenarios are already checked. Numbers that do not differ in this batch must
        not differ in that.
        """
        batch = Batch.__new__(Batch)  # a copy would trace its programs again
        vars(batch).update(vars(self))
        batch._scenarios = scenarios
        batch.columns = self.model.columns(scenarios)
        return batch

    @check_kinds
    def scenario(self, row: int) -> Scene:
        """Return the scene of a scenario: a document that runs by itself."""
        return self._scenarios.scene(row)

    @check_kinds
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
        advance: Advance | None = None,
    ) -> BatchResult:
        """Run all scenarios for `count` steps.

        Args:
            gamma: initial actuator angles [rad], shape (N, 3), or (3,) where parameters
                vary.
            gamma_dot: initial rates [rad/s], shape (N, 3) or (3,).
            torque: constant torques [N m], shape (N, 3) or (3,), within the actuators'
                limit where they have one; not used with a profile.
            step: length of a step [s].
            count: number of steps.
            keep_every: keep the states every so many steps, see `BatchResult.kept`; 0
                keeps none.
            threads: how many; 0 takes all cores. No bit depends on it.
            progress: draw a bar on a terminal.
            advance: a loop of one's own in place of `Batch.advance`, see `Advance`.

        Raises:
            InputError: an argument is not allowed; names it and what is.

        """
        requirement = f"must be >= 0 and <= {_MOST_BATCH_STEPS:g}"
        checks = [_check_step(step)]
        whole_numbers = {"count": count, "keep_every": keep_every, "threads": threads}
        for name, n in whole_numbers.items():
            checks.append((name, n, 0 <= n <= _MOST_BATCH_STEPS, requirement))
        refuse_unless("batch", *checks)
        step = float(step)
        count = int(count)
        loop = advance or partial(self.advance, threads=threads)
        y, code = self.initial(gamma, gamma_dot)
        number = y.shape[1]
        columns = Columns(
            y=y,
            drives=self.drives(torque, number),
            code=code,
            time=np.full(number, np.nan),
            error=np.zeros(number),
        )
        kept = [y.copy()]
        ends = [0]
        size = keep_every
        if not keep_every and not progress:
            size = max(count, 1)  # one call: each passes all rows
        for step_range in slices(count, size, self.scene.name, progress):
            span = step_range.stop - step_range.start
            loop(step_range.start, span, step, *columns, rows=None)
            if keep_every and span == keep_every:
                kept.append(y.copy())
                ends.append(step_range.stop)
        columns.time[code < 0] = 0.0
        # A step in which a limit was passed is left out: its beginning is the last
        # valid state.
        steps = np.where(code > 0, steps_of_ends(columns.time, step), count)
        steps[code < 0] = 0
        locate_ends(loop, step, steps, columns)
        last = steps * step
        torques = columns.drives[TORQUES].T
        endings = Endings(torques, code, columns.time, columns.error)
        result = self.result_of(endings, last, y)
        if keep_every:
            samples = np.minimum.outer(step * np.array(ends, dtype=float), last)
            result.kept = self.result_of(endings, samples, np.stack(kept))
        return result

    def _facts(self) -> dict[str, object]:
        return {
            "scene": self.scene.name,
            "method": f"{self._method.name}, fixed steps",
            "scenarios": self._scenarios.count or "as many as are given to run",
            "varied": [*self._scenarios.rows] or "the start and the torques alone",
        }

    @check_kinds
    def start(
        self,
        gamma: ArrayLike,
        gamma_dot: ArrayLike = (0.0, 0.0, 0.0),
        *,
        step: float,
        substeps: int = 1,
    ) -> BatchSession:
        """Start robots that are driven step by step, as by a policy.

        Args:
            gamma: initial actuator angles [rad], shape (N, 3), or (3,) where parameters
                vary.
            gamma_dot: initial rates [rad/s], shape (N, 3) or (3,).
            step: length of a step of the session, in which torques are constant [s].
            substeps: steps of the method in it.

        Raises:
            InputError: an argument is not allowed, or the batch has a profile of
                torques.

        """
        allowed_range = f"must be >= 1 and <= {_MOST_BATCH_STEPS:g}"
        no_profile = "must be False: the torques are given step by step"
        refuse_unless(
            "batch",
            _check_step(step),
            ("substeps", substeps, 1 <= substeps <= _MOST_BATCH_STEPS, allowed_range),
            ("profile", True, self._takes_torques, no_profile),
        )
        return BatchSession(self, gamma, gamma_dot, float(step), int(substeps))

    def initial(
        self,
        gamma: ArrayLike,
        gamma_dot: ArrayLike,
        rows: NDArray[np.intp] | None = None,
    ) -> tuple[Array, NDArray[np.int64]]:
        """Return states at t = 0, a column a scenario, and codes.

        A code is 0, or why a scenario cannot start. Only the scenarios `rows` start, by
        default all.
        """
        columns = self.columns
        count = self._scenarios.count if rows is None else len(rows)
        # One start for all is solved once, and copied.
        is_one_geometry = columns.geometries.alpha.ndim == 1
        is_one_start = np.ndim(gamma) == 1 and np.ndim(gamma_dot) == 1
        is_alike = rows is None and is_one_geometry and is_one_start
        copies = count if is_alike else None
        angles = _rows("gamma", gamma, 1 if copies else count)
        rates = _rows("gamma_dot", gamma_dot, len(angles))
        geometry_rows = columns.geometry
        if rows is not None and len(geometry_rows) > 1:
            geometry_rows = geometry_rows[rows]
        geometry_rows = np.broadcast_to(geometry_rows[: len(angles)], len(angles))
        start, code = initial_states(columns.geometries, geometry_rows, angles, rates)
        if self.scene.stroke.at_end == "stop":
            arcs = columns.geometries.of_rows(geometry_rows).arc
            outside = (angles < 0.0) | (angles > arcs)
            code[outside.any(axis=1)] = OUTSIDE_STATUS
        y = np.zeros((len(self.model.ode.state), len(angles)))
        y[STAR] = start
        if copies:
            y = np.repeat(y, copies, axis=1)
            code = np.repeat(code, copies)
        return y, code

    def drives(self, torque: ArrayLike, number: int) -> Array:
        """Return what acts from outside and what varies, a column a scenario."""
        drive_size = len(self.model.ode.drive)
        varied = self.columns.inputs
        size = drive_size + len(varied)
        drives = np.zeros((max(size, 1), number))
        if self._takes_torques:
            limit = self.columns.torque_limit
            torques = _rows("torque", torque, number)
            drives[TORQUES] = np.clip(torques.T, -limit, limit)
        drives[drive_size:size] = varied
        return drives

    @property
    def _takes_torques(self) -> bool:
        """Whether torques are given: not where the scene's profile is traced."""
        return bool(self.model.ode.drive[TORQUES] == TORQUE_SYMBOLS)

    def advance(
        self,
        first: int,
        count: int,
        step: float,
        *columns: NDArray[Any],
        threads: int = 0,
        rows: NDArray[np.intp] | None = None,
    ) -> None:
        """Advance by `count` steps of `step` [s] from step `first`; see `Advance`.

        Threads take several blocks in turn; the interpreter's lock is released in each
        step. A few `rows` need no threads.
        """
        threads = threads or len(os.sched_getaffinity(0))
        if rows is not None:
            threads = 1
        number = columns[0].shape[1]
        width = block_width(number, threads)
        begins = range(0, number, width)
        shares = 1 if threads == 1 else _SHARES_OF_A_THREAD * threads
        size = max(1, math.ceil(len(begins) / shares))
        thread_shares = [begins[i : i + size] for i in range(0, len(begins), size)]

        programs = self.programs  # compiled here, not by each thread

        def advance_share(block_begins: range) -> None:
            advance_blocks(
                Block(programs, width), block_begins, first, count, step, *columns
            )

        for _ in run_many(advance_share, thread_shares, workers=threads):
            pass

    @cached_property
    def programs(self) -> ColumnStep:
        """The programs of a step, compiled when they are first needed."""
        return programs_of(self.model, self._method)


@lru_cache(maxsize=16)
def programs_of(model: ParametricModel, method: Tableau) -> ColumnStep:
    """Return the programs of a step, traced once for all batches of the same model."""
    return ColumnStep(model, method)


def block_width(number: int, threads: int = 1) -> int:
    """Return how many of a number of columns are advanced together."""
    least_blocks = math.ceil(number / LANE_BLOCK)
    worth_threads = min(threads, math.ceil(number / _THREAD_COLUMNS))
    blocks = max(least_blocks, worth_threads, 1)
    return whole_lanes(max(1, math.ceil(number / blocks)))


def _make_batch(
    scene: Scene, method: Tableau, profile: bool, parameters: Mapping[str, ArrayLike]
) -> Batch:
    return Batch(scene, method, profile=profile, parameters=parameters)


def _check_step(step: float) -> Check:
    return ("step", step, 0.0 < step < np.inf, "must be finite and > 0 [s]")


def _rows(name: str, value: ArrayLike, count: int | None) -> Array:
    """Return three numbers for each of `count` scenarios, or for as many as given."""
    rows = read_numbers("batch", name, value)
    if count is not None and rows.shape == (3,):
        rows = np.tile(rows, (count, 1))
    expected = "(N, 3)" if count is None else f"(3,) or ({count}, 3)"
    fits = rows.ndim == 2 and rows.shape[1] == 3 and count in (None, len(rows))
    most = FULL_TURN if name == "gamma" else np.inf
    refuse_unless(
        "batch",
        (name, rows.shape, fits, f"must have the shape {expected}"),
        (name, rows, bool(np.isfinite(rows).all()), "must be finite"),
        (name, rows, not np.any(np.abs(rows) > most), "must not exceed 2 pi: in rad?"),
    )
    return rows


class BatchResult(MotionTable):
    """N scenarios, each in its state at the end, or in its last valid one.

    Arrays are read-only.

    Attributes:
        t: times of the states [s], shape (N,).
        quaternion: orientations (x, y, z, w) of {E} in {B}, shape (N, 4).
        body_rate: angular velocities of the star in {E} [rad/s], shape (N, 3).
        status: 0 where a scenario reached its end, 1 where a limit ended it, -1 where
            it has no start or its numbers ceased to be finite, shape (N,).
        code: 0 at the end, 1 + the index of a limit, NOT_FINITE_CODE, < 0 without a
            start, shape (N,).
        fault_time: when a scenario passed a limit [s], the end of the step in which its
            numbers ceased to be finite, 0 without a start, nan where it reached its
            end, shape (N,).
        local_error: largest local error estimate of a quaternion in a step, shape (N,).
        kept: the same scenarios every `keep_every` steps from the start on, with an
            axis of samples before that of scenarios in t and in all states; None unless
            asked for.

    """

    def __init__(
        self,
        model: ParametricModel,
        columns: ParameterColumns,
        endings: Endings,
        t: Array,  # shape (N,) or (samples, N)
        y: Array,  # state of the integration, shape (state, N) or (samples, state, N)
    ) -> None:
        self._model = model
        self._columns = columns
        self._torque = endings.torque
        self.scene = model.scene
        self._axes = ("time", "scenario") if t.ndim == 2 else ("scenario",)
        code = endings.code
        self.code = code
        self.fault_time = endings.fault_time
        self.local_error = endings.local_error
        has_failed = (code < 0) | (code == NOT_FINITE_CODE)
        self.status = np.where(has_failed, -1, np.sign(code))
        self.t = t
        self._state = np.moveaxis(y, -2, -1)
        self.quaternion: Array = self._state[..., QUATERNION]
        self.body_rate: Array = self._state[..., STAR_RATE]
        self.kept: BatchResult | None = None
        # torques of a controller, where they are not `torque`
        self.sent: Array | None = None
        self._computed: dict[str, Array] = {}
        self._freeze()

    @property
    def energy(self) -> Array:
        """Kinetic and potential energy [J], shape (..., N)."""
        return self._joint("energy")[..., 0]

    def _joint(self, name: str) -> Array:
        """Return an output of the model for all states, computed once."""
        if name not in self._computed:
            function = self._model.outputs[name]
            inputs = self._columns.inputs
            states = np.moveaxis(self._state, -1, 0)[STAR]
            count = self.t.shape[-1]
            components = np.empty((1 if name == "energy" else 3, *self.t.shape))
            size = max(1, _BATCH_BLOCK * count // max(self.t.size, 1))
            with np.errstate(all="ignore"):
                for first in range(0, count, size):
                    rows = slice(first, first + size)
                    numbers = function(*states[..., rows], *inputs[:, rows])
                    for component, number in zip(components, numbers, strict=True):
                        component[..., rows] = number
            components[..., self.code < 0] = np.nan
            self._computed[name] = freeze(np.moveaxis(components, 0, -1))
        return self._computed[name]

    @cached_property
    def torque(self) -> Array:
        """Torques that act at the actuators [N m], shape (..., N, 3)."""
        if self._state.shape[-1] > STATE_SIZE:
            return self._state[..., LAGGED_TORQUES]
        if self.sent is not None:
            return self.sent
        profile = self._model.constants(list(self._columns.inputs)).torque
        if profile is None:
            return np.broadcast_to(self._torque, self.body_rate.shape)
        torques = []
        for amplitude, frequency, phase in zip(
            profile.amplitude, profile.frequency, profile.phase, strict=True
        ):
            torques.append(amplitude * np.sin(frequency * self.t + phase))
        return np.stack(torques, axis=-1)

    @property
    def success(self) -> NDArray[np.bool_]:
        """Whether a scenario reached its end, shape (N,)."""
        return np.equal(self.status, 0)

    @cached_property
    def message(self) -> tuple[str, ...]:
        """How each scenario ended, N texts."""
        texts, index = self.reasons
        return tuple(texts[index].tolist())

    @cached_property
    def reasons(self) -> tuple[NDArray[np.object_], NDArray[np.intp]]:
        """The distinct texts of how scenarios ended.

        With them comes the index of the text of each scenario, shape (N,).
        """
        geometry = np.broadcast_to(self._columns.geometry, self.code.shape)
        # only these depend on the geometry
        limited = (self.code > 0) & (self.code < NOT_FINITE_CODE)
        # One number for each pair, as np.unique is slow with pairs: a tenth of the time
        # of a sweep. Codes are less than 2 NOT_FINITE_CODE from zero.
        own_geometry = np.where(limited, geometry, 0)
        geometry_and_code = 4 * NOT_FINITE_CODE * own_geometry + self.code
        _, first, index = np.unique(
            geometry_and_code, return_index=True, return_inverse=True
        )
        texts = []
        for row, code in zip(first, self.code[first].tolist(), strict=True):
            own = self._columns.geometries.of_rows(geometry[row])
            limits = tuple(limits_of(self._model.scene, own))
            texts.append(_REASONS.get(code) or limits[code - 1].reason)
        return np.array(texts, dtype=object), index

    def _of_each(self) -> dict[str, tuple[Any, str]]:
        return {name: (getattr(self, name), unit) for name, unit in _SCENARIO.items()}

    def _facts(self) -> dict[str, object]:
        span = f"{self.t.min():g} to {self.t.max():g}" if self.t.size else "none"
        return {
            "scene": self.scene.name,
            "scenarios": len(self),
            "ended early": np.count_nonzero(self.status),
            "time [s]": span,
        }
