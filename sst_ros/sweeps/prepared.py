# SPDX-License-Identifier: Apache-2.0
"""A study ready to run in this process, and the table of one chunk of its rows."""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Mapping, Sequence
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from sst_ros.errors import InputError, Problem
from sst_ros.extras import require
from sst_ros.integration.batch import Batch
from sst_ros.integration.batch_result import BatchResult, BatchStates
from sst_ros.integration.parametric_model import OUTPUTS, Scenarios
from sst_ros.mechanism.geometry import Array
from sst_ros.state import DIMENSIONS, QUANTITIES
from sst_ros.sweeps.controlled_batch import ControlledBatch
from sst_ros.sweeps.sweep_study import SweepStudy
from sst_ros.sweeps.variations import Sampler, Variation
from sst_ros.version import VERSION

if TYPE_CHECKING:
    import pyarrow as pa

PARTS = 64
"""Extremes are those of the states at the ends of at most so many equal parts of a run."""

PILOT = 256
"""Rows by which the number of steps is chosen; drawn apart, so that no number of rows matters."""

MOST_STEPS = 1_000_000

_STATE_KEYS = ("initial.gamma", "initial.gamma_dot")

_JOINTS = ("gamma", "mu", "beta", "gamma_dot", "mu_dot", "beta_dot")

Columns = dict[str, NDArray[Any]]


class PreparedSweep:
    """A study with its compiled code and its number of steps.

    Args:
        study: what runs.
        steps: number of steps of a run, where it has been chosen already.

    Raises:
        InputError: the ends of what varies make no scene, or no number of steps reaches the
            tolerance.

    """

    def __init__(self, study: SweepStudy, steps: int | None = None) -> None:
        self.study = study
        scene = study.model_scene
        numbers, _ = _split(find_range_ends(self.study))
        ends = Scenarios(scene, numbers)
        faults = ends.faults(most=1)
        if faults:
            ((row, error),) = faults.items()
            texts = [str(one).replace(f"scenario {row}: ", "") for one in error.problems]
            allowed = "within its range: " + "; ".join(texts)
            raise InputError("sweep", [Problem("vary", "makes no scene", allowed)])
        profile = scene.torque is not None
        self.batch = Batch(scene, profile=profile, parameters=ends.rows)
        self.controlled: ControlledBatch | None = None
        if study.controlled is not None:
            varied = {one.key for one in study.variations}
            self.controlled = ControlledBatch(
                self.batch, study.controlled, study.length, study.seed, varied
            )
        self.module = (self.controlled or self.batch).module
        self.steps, self.pilot_error = steps or study.steps or 0, math.nan
        if not self.steps:
            values = draw_pilot_rows(study)
            scenarios, starts, _ = self.scenarios(values)
            rows = np.arange(len(next(iter(values.values()))))
            self.steps, self.pilot_error = choose_steps(
                lambda number: self.run(scenarios, starts, rows, number)[0],
                1 if self.controlled is None else self.controlled.samples,
                study.tolerance,
            )

    def chunk(self, index: int) -> tuple[pa.Table, pa.Table | None]:
        """Table of the rows of a chunk, and of their trajectories if the study asks for some."""
        pyarrow = require("pyarrow")
        first = index * self.study.chunk
        count = min(self.study.chunk, self.study.rows - first)
        values = self.study.sampler.rows(first, count)
        rows = np.arange(first, first + count)
        columns, trajectory = self._results(values, rows)
        arrays: dict[str, Any] = {"scenario": rows}
        for one in self.study.variations:
            for k, name in enumerate(one.columns):
                arrays[name] = np.ascontiguousarray(values[one.key][:, k])
        texts, reason = columns.pop("reason_texts"), columns.pop("reason")
        arrays |= columns
        arrays["reason"] = pyarrow.DictionaryArray.from_arrays(
            reason.astype(np.int32), pyarrow.array(texts.tolist(), pyarrow.string())
        )
        return pyarrow.table(arrays), None if trajectory is None else pyarrow.table(trajectory)

    def check(self, values: dict[str, Array]) -> None:
        """Raise InputError with the first ten problems if rows make no scene."""
        numbers, _ = _split(list_parameters(self.study, values))
        Scenarios(self.study.model_scene, numbers).check()

    @cached_property
    def about(self) -> dict[str, Any]:
        """Metadata of the files: study, its digest, version, units."""
        return {
            "version": VERSION,
            "digest": self.study.digest,
            "steps": self.steps,
            "duration": self.study.length,
            "study": self.study.document(),
            "units": units_of(self.study.variations),
            "inputs": [name for one in self.study.variations for name in one.columns],
        }

    def _results(self, values: dict[str, Array], rows: NDArray[np.int64]) -> tuple[Columns, Any]:
        scenarios, starts, faults = self.scenarios(values)
        result, more = self.run(scenarios, starts, rows, self.steps)
        columns: Columns = {
            "status": result.status.astype(np.int8),
            "t": result.t,
            "fault_time": result.fault_time,
            "local_error": result.local_error,
        }
        result.compute(*(name for name in OUTPUTS if name in self.study.outputs))
        for name in self.study.outputs:
            if name == "energy":
                columns[name] = result.energy
            elif name != "extremes":
                columns |= components(name, getattr(result, name))
        columns |= more
        texts, reason = result.reasons
        if faults:
            texts, reason = mark_faults(columns, texts, reason, faults)
        columns |= {"reason_texts": texts, "reason": reason}
        return columns, self._trajectory(values, rows)

    def scenarios(
        self, values: dict[str, Array]
    ) -> tuple[Scenarios, dict[str, Array], dict[int, InputError]]:
        """Scenarios of rows, their starts and gains, and the rows that make no scene."""
        numbers, starts = _split(list_parameters(self.study, values))
        scenarios = Scenarios(self.study.model_scene, numbers)
        count = len(next(iter(values.values())))
        faults = scenarios.faults(most=count)
        if faults:
            known = {key: array[:1] for key, array in find_range_ends(self.study).items()}
            numbers = {key: array.copy() for key, array in numbers.items()}
            for key, array in numbers.items():
                array[list(faults)] = known[key]
            scenarios = Scenarios(self.study.model_scene, numbers)
        return scenarios, starts | {"count": np.array(count)}, faults

    def run(
        self,
        scenarios: Scenarios,
        starts: dict[str, Array],
        rows: NDArray[np.int64],
        steps: int,
        kept: int = 0,
    ) -> tuple[BatchResult, Columns]:
        """Return results of rows by a number of steps, and their extremes or tracking figures."""
        batch, count = self.batch.with_parameters(scenarios), int(starts["count"])
        initial = self.study.scene.initial
        if self.controlled is not None:
            return self.controlled.run(batch, starts, rows, steps, kept)
        gamma = starts.get("initial.gamma", np.array(initial.gamma))
        rate = starts.get("initial.gamma_dot", np.array(initial.gamma_dot))
        if scenarios.count is None:
            gamma = np.broadcast_to(gamma, (count, 3))
        step = self.study.length / steps
        every = kept or (-(-steps // PARTS) if "extremes" in self.study.outputs else 0)
        result = batch.run(gamma, rate, step=step, count=steps, keep_every=every, threads=1)
        if kept or result.kept is None:
            return result, {}
        extremes = extremes_of(result.kept)
        result.kept = None
        return result, extremes

    def _trajectory(self, values: dict[str, Array], rows: NDArray[np.int64]) -> Columns | None:
        """States of the first rows at equal intervals, in long form."""
        asked = self.study.trajectory
        if asked is None or rows[0] >= asked["rows"]:
            return None
        count = min(len(rows), asked["rows"] - int(rows[0]))
        some = {key: array[:count] for key, array in values.items()}
        scenarios, starts, _ = self.scenarios(some)
        every = max(1, self.steps // asked["samples"])
        result, _ = self.run(scenarios, starts, rows[:count], self.steps, every)
        assert result.kept is not None
        samples = len(result.kept.t)
        found: Columns = {
            "scenario": np.tile(rows[:count], samples),
            "t": result.kept.t.ravel(),
        }
        for name in self.study.outputs:
            array = getattr(result.kept, name, None)
            if name == "energy" and array is not None:
                found[name] = array.ravel()
            elif array is not None:
                found |= components(name, array.reshape(samples * count, -1))
        return found


_PREPARED: dict[tuple[str, int | None], PreparedSweep] = {}

_LOCK = threading.Lock()


def prepare(study: SweepStudy, steps: int | None = None) -> PreparedSweep:
    """Return the prepared study; prepared once in a process."""
    with _LOCK:
        key = study.digest, steps
        if key not in _PREPARED:
            _PREPARED.clear()
            _PREPARED[key] = PreparedSweep(study, steps)
        return _PREPARED[key]


def _split(parameters: dict[str, Array]) -> tuple[dict[str, Array], dict[str, Array]]:
    """Numbers of the scene, and what a run is given: initial state and gains."""
    outside = {
        key: array
        for key, array in parameters.items()
        if key in _STATE_KEYS or key.startswith("control.")
    }
    return {key: parameters[key] for key in parameters.keys() - outside.keys()}, outside


def find_range_ends(study: SweepStudy) -> dict[str, Array]:
    """Return rows at the middle and at the ends of all ranges, by key of the scene."""
    rows = []
    tabulated = [one for one in study.variations if one.kind == "table"]
    middle = {one.key: _middle(one) for one in study.variations if one.kind != "table"}
    picks = {0}
    for values in (study.table or {}).values():
        picks |= {int(np.argmin(values)), int(np.argmax(values))}
    for pick in sorted(picks) if tabulated else []:
        row = study.sampler.rows(pick, 1)
        rows.append(middle | {one.key: row[one.key][0] for one in tabulated})
    rows = rows or [middle]
    for one in study.variations:
        rows += [rows[0] | {one.key: end} for end in _ends(one)]
    stacked = {one.key: np.stack([row[one.key] for row in rows]) for one in study.variations}
    return list_parameters(study, stacked)


def list_parameters(study: SweepStudy, values: Mapping[str, Array]) -> dict[str, Array]:
    """Return arrays by key of the scene for the values of what varies."""
    found: dict[str, Array] = {}
    for one in study.variations:
        found |= one.parameters(values[one.key])
    return found


def _middle(one: Variation) -> Array:
    return np.asarray(one.numbers.mean(axis=0) if one.kind == "uniform" else one.numbers[0])


def _ends(one: Variation) -> list[Array]:
    """Values that differ in every component that can differ."""
    if one.kind == "normal":
        return [one.values(np.full((1, len(one.columns)), q))[0] for q in (0.4, 0.6)]
    return list(one.numbers)


def draw_pilot_rows(study: SweepStudy) -> dict[str, Array]:
    """Return the values of what varies in the pilot rows."""
    if study.table is None:
        return Sampler(study.variations, {}, PILOT, study.seed, "random").rows(0, PILOT)
    chosen = np.linspace(0, study.rows - 1, min(PILOT, study.rows)).astype(int)
    parts = [study.sampler.rows(int(row), 1) for row in chosen]
    return {key: np.concatenate([part[key] for part in parts]) for key in parts[0]}


def choose_steps(
    run: Callable[[int], BatchResult], unit: int, tolerance: float
) -> tuple[int, float]:
    """Least number of steps, about, whose error is within the tolerance; and that error [rad].

    The error of c steps is the difference from 2c steps; it falls with the eighth power of c.
    It is nan where no run reaches the end.

    Args:
        run: runs the pilot rows by a number of steps.
        unit: the number is a multiple of it.
        tolerance: of the orientation at the end [rad].

    Raises:
        InputError: no number of steps reaches the tolerance.

    """
    count = max(unit, 16)
    for _ in range(12):
        coarse, fine = run(count), run(2 * count)
        both = (coarse.status == 0) & (fine.status == 0)
        error = largest_angle(coarse.quaternion[both], fine.quaternion[both])
        if not both.any():
            return count, math.nan
        if error <= tolerance:
            return count, error
        factor = (error / (0.7 * tolerance)) ** (1.0 / 8.0) if math.isfinite(error) else 4.0
        count = unit * math.ceil(count * min(max(factor, 1.05), 8.0) / unit)
        if count > MOST_STEPS:
            break
    allowed = f"is not reached by {MOST_STEPS} steps; give `steps`, or a larger tolerance"
    raise InputError("sweep", [Problem("tolerance", tolerance, allowed)])


def units_of(variations: Sequence[Variation]) -> dict[str, str]:
    """Return the unit of each column that has one."""
    found = {"t": "s", "fault_time": "s", "energy": "J", "local_error": "1"}
    for name, (unit, dimension) in QUANTITIES.items():
        for part in DIMENSIONS[dimension]:
            for suffix in ("", "_min", "_max"):
                found[f"{name}{suffix}_{part}"] = unit
    for part in DIMENSIONS["leg"]:
        found |= {f"error_rms_{part}": "rad", f"error_max_{part}": "rad"}
    for one in variations:
        unit = "1" if one.factor else one.targets[0].spec.unit
        found |= dict.fromkeys(one.columns, unit)
    return found


def components(name: str, array: Array) -> Columns:
    """Return a column for each component of a quantity, shape (n, components)."""
    _, dimension = QUANTITIES[name]
    return {
        f"{name}_{part}": np.ascontiguousarray(array[:, i])
        for i, part in enumerate(DIMENSIONS[dimension])
    }


def extremes_of(kept: BatchStates) -> Columns:
    """Least and largest angles and rates of joints at the ends of steps."""
    found: Columns = {}
    with np.errstate(all="ignore"):
        for name in _JOINTS:
            array = getattr(kept, name)
            for suffix, reduced in (("min", array.min(axis=0)), ("max", array.max(axis=0))):
                for k in range(3):
                    found[f"{name}_{suffix}_{k + 1}"] = reduced[:, k]
    return found


def mark_faults(
    columns: Columns, texts: NDArray[Any], reason: NDArray[Any], faults: dict[int, InputError]
) -> tuple[NDArray[Any], NDArray[Any]]:
    """Mark rows that make no scene: status -1, no numbers, and the first problem as the reason."""
    rows, reason = list(faults), reason.copy()
    for name, array in columns.items():
        columns[name] = array.copy()
        columns[name][rows] = -1 if name == "status" else np.nan
    columns["fault_time"][rows] = 0.0
    found = [f"no scene: {error.problems[0].key.partition(': ')[2]}" for error in faults.values()]
    distinct = sorted(set(found))
    reason[rows] = [len(texts) + distinct.index(text) for text in found]
    return np.array([*texts, *distinct], dtype=object), reason


def largest_angle(one: Array, other: Array) -> float:
    """Largest angle between orientations [rad]."""
    if not len(one):
        return 0.0
    apart = np.minimum(np.linalg.norm(one - other, axis=1), np.linalg.norm(one + other, axis=1))
    return float(2.0 * apart.max())
