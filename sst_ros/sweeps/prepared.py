# SPDX-License-Identifier: Apache-2.0
"""A study ready to run in this process, and the table of one chunk of its rows."""

from __future__ import annotations

import math
import threading
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from sst_ros.errors import InputError, Problem
from sst_ros.extras import require
from sst_ros.integration.batch import Batch
from sst_ros.integration.batch_result import BatchResult
from sst_ros.integration.parametric_model import OUTPUTS
from sst_ros.integration.scenarios import Scenarios
from sst_ros.mechanism.geometry import Array
from sst_ros.sweeps.controlled_batch import ControlledBatch
from sst_ros.sweeps.range_ends import parameters_of, range_ends
from sst_ros.sweeps.step_choice import chosen_steps, pilot_rows
from sst_ros.sweeps.sweep_columns import (
    Columns,
    components,
    extremes_of,
    units_of,
    with_faults,
)
from sst_ros.sweeps.sweep_study import SweepStudy
from sst_ros.version import VERSION

if TYPE_CHECKING:
    import pyarrow as pa

PARTS = 64
"""Extremes are those of the states at the ends of at most so many equal parts of a run."""

_STATE_KEYS = ("initial.gamma", "initial.gamma_dot")


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
        numbers, _ = _split(range_ends(self.study))
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
            values = pilot_rows(study)
            scenarios, starts, _ = self.scenarios(values)
            rows = np.arange(len(next(iter(values.values()))))
            self.steps, self.pilot_error = chosen_steps(
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
        columns, wanted = self._results(values, rows)
        arrays: dict[str, Any] = {"scenario": rows}
        for one in self.study.variations:
            for k, name in enumerate(one.columns):
                arrays[name] = np.ascontiguousarray(values[one.key][:, k])
        texts, reason = columns.pop("reason_texts"), columns.pop("reason")
        arrays |= columns
        arrays["reason"] = pyarrow.DictionaryArray.from_arrays(
            reason.astype(np.int32), pyarrow.array(texts.tolist(), pyarrow.string())
        )
        return pyarrow.table(arrays), None if wanted is None else pyarrow.table(wanted)

    def check(self, values: dict[str, Array]) -> None:
        """Raise InputError with the first ten problems if rows make no scene."""
        numbers, _ = _split(parameters_of(self.study, values))
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
            texts, reason = with_faults(columns, texts, reason, faults)
        columns |= {"reason_texts": texts, "reason": reason}
        return columns, self._trajectory(values, rows)

    def scenarios(
        self, values: dict[str, Array]
    ) -> tuple[Scenarios, dict[str, Array], dict[int, InputError]]:
        """Scenarios of rows, their starts and gains, and the rows that make no scene."""
        numbers, starts = _split(parameters_of(self.study, values))
        scenarios = Scenarios(self.study.model_scene, numbers)
        count = len(next(iter(values.values())))
        faults = scenarios.faults(most=count)
        if faults:
            known = {key: array[:1] for key, array in range_ends(self.study).items()}
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
        wanted = self.study.trajectory
        if wanted is None or rows[0] >= wanted["rows"]:
            return None
        count = min(len(rows), wanted["rows"] - int(rows[0]))
        some = {key: array[:count] for key, array in values.items()}
        scenarios, starts, _ = self.scenarios(some)
        every = max(1, self.steps // wanted["samples"])
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


def prepared(study: SweepStudy, steps: int | None = None) -> PreparedSweep:
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
