# SPDX-License-Identifier: Apache-2.0
"""A study ready to run in this process, and the table of one chunk of its rows."""

from __future__ import annotations

import math
import threading
from collections.abc import Mapping, Sequence
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from sst_ros.errors import InputError, Problem
from sst_ros.extras import require
from sst_ros.integration.batch import Batch, BatchResult, BatchStates
from sst_ros.mechanism.frames import angle_between
from sst_ros.mechanism.geometry import Array
from sst_ros.scene.scene import Scenarios
from sst_ros.state import DIMENSIONS, QUANTITIES, UNITS, Joints, columns_of
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

_JOINTS, _ENDS = Joints._fields, ("min", "max")

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
        self._ends, _ = self._split(find_range_ends(study))
        ends = Scenarios(study.model_scene, self._ends)
        for row, error in ends.faults(most=1).items():
            texts = [str(one).replace(f"scenario {row}: ", "") for one in error.problems]
            allowed = "within its range: " + "; ".join(texts)
            raise InputError("sweep", [Problem("vary", "makes no scene", allowed)])
        profile = study.model_scene.torque is not None
        self.batch = Batch(study.model_scene, profile=profile, parameters=ends.rows)
        self.controlled = None if study.control is None else ControlledBatch(self.batch, study)
        self.modules = [one.module for one in (self.batch, self.controlled) if one is not None]
        self.pilot_error = math.nan
        self.steps = steps or study.steps or self._choose_steps()

    def _choose_steps(self) -> int:
        """Find the least number of steps, about, that keeps the tolerance in the pilot rows.

        The error of c steps is the difference from 2c steps; it falls with the eighth power of c.
        It is nan where no run reaches the end.
        """
        values, tolerance = draw_pilot_rows(self.study), self.study.tolerance
        scenarios, starts, _ = self.scenarios(values)
        rows = np.arange(len(next(iter(values.values()))))
        unit = 1 if self.controlled is None else self.controlled.samples
        count = max(unit, 16)
        for _ in range(12):
            coarse, fine = (self.run(scenarios, starts, rows, n)[0] for n in (count, 2 * count))
            both = (coarse.status == 0) & (fine.status == 0)
            if not both.any():
                return count
            apart = angle_between(coarse.quaternion[both], fine.quaternion[both])
            self.pilot_error = error = float(apart.max())
            if error <= tolerance:
                return count
            factor = (error / (0.7 * tolerance)) ** (1.0 / 8.0) if math.isfinite(error) else 4.0
            count = unit * math.ceil(count * min(max(factor, 1.05), 8.0) / unit)
            if count > MOST_STEPS:
                break
        allowed = f"is not reached by {MOST_STEPS} steps; give `steps`, or a larger tolerance"
        raise InputError("sweep", [Problem("tolerance", tolerance, allowed)])

    def chunk(self, index: int) -> tuple[pa.Table, pa.Table | None]:
        """Table of the rows of a chunk, and of their trajectories if the study asks for some."""
        pyarrow, study = require("pyarrow"), self.study
        rows = np.arange(study.rows_of(index).start, study.rows_of(index).stop)
        values = study.sampler.rows(int(rows[0]), len(rows))
        columns, texts, reason = self._results(values, rows)
        arrays: Columns = {"scenario": rows}
        for one in study.variations:
            arrays |= dict(zip(one.columns, values[one.key].T, strict=True))
        # Arrow copies strided columns an entry at a time.
        arrays = {name: np.ascontiguousarray(x) for name, x in (arrays | columns).items()}
        arrays["reason"] = pyarrow.DictionaryArray.from_arrays(
            reason.astype(np.int32), pyarrow.array(texts, pyarrow.string())
        )
        asked = study.trajectory
        if asked is None or rows[0] >= asked["rows"]:
            return pyarrow.table(arrays), None
        kept = rows[rows < asked["rows"]]
        some = {key: array[: len(kept)] for key, array in values.items()}
        return pyarrow.table(arrays), pyarrow.table(self._trajectory(some, kept, asked["samples"]))

    def check(self, values: dict[str, Array]) -> None:
        """Raise InputError with the first ten problems if rows make no scene."""
        numbers, _ = self._split(values)
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

    def _results(
        self, values: dict[str, Array], rows: NDArray[np.int64]
    ) -> tuple[Columns, list[str], NDArray[np.intp]]:
        """Columns of the results, the texts of how runs ended, and the index of that of each."""
        scenarios, starts, faults = self.scenarios(values)
        result, more = self.run(scenarios, starts, rows, self.steps)
        columns: Columns = {
            "status": result.status.astype(np.int8),
            "t": result.t,
            "fault_time": result.fault_time,
            "local_error": result.local_error,
        }
        columns |= columns_of(result, self._quantities) | more
        distinct_texts, reason = result.reasons
        texts = distinct_texts.tolist()
        if faults:  # no numbers, and the first problem as the reason
            wrong, reason = list(faults), reason.copy()
            for name, array in columns.items():
                columns[name] = array.copy()
                columns[name][wrong] = -1 if name == "status" else np.nan
            columns["fault_time"][wrong] = 0.0
            keys = [error.problems[0].key.partition(": ")[2] for error in faults.values()]
            distinct = sorted(set(keys))
            reason[wrong] = [len(texts) + distinct.index(key) for key in keys]
            texts += [f"no scene: {key}" for key in distinct]
        return columns, texts, reason

    @property
    def _quantities(self) -> list[str]:
        """Outputs that are quantities of a state."""
        return [name for name in self.study.outputs if name != "extremes"]

    def scenarios(
        self, values: dict[str, Array]
    ) -> tuple[Scenarios, dict[str, Array], dict[int, InputError]]:
        """Scenarios of rows, their starts and gains, and the rows that make no scene."""
        numbers, starts = self._split(values)
        scenarios = Scenarios(self.study.model_scene, numbers)
        faults = scenarios.faults(most=len(next(iter(values.values()))))
        if faults:  # they run as a row that makes one
            numbers = {key: array.copy() for key, array in numbers.items()}
            for key, array in numbers.items():
                array[list(faults)] = self._ends[key][0]
            scenarios = Scenarios(self.study.model_scene, numbers)
        return scenarios, starts, faults

    def run(
        self,
        scenarios: Scenarios,
        starts: dict[str, Array],
        rows: NDArray[np.int64],
        steps: int,
        kept: int = 0,
    ) -> tuple[BatchResult, Columns]:
        """Return results of rows by a number of steps, and their extremes or tracking figures."""
        batch = self.batch.with_parameters(scenarios)
        every = kept or (-(-steps // PARTS) if "extremes" in self.study.outputs else 0)
        if self.controlled is not None:
            result, more = self.controlled.run(batch, starts, rows, steps, every)
        else:
            initial, more = self.study.scene.initial, {}
            gamma = starts.get("initial.gamma", np.array(initial.gamma))
            rate = starts.get("initial.gamma_dot", np.array(initial.gamma_dot))
            if scenarios.count is None:
                gamma = np.broadcast_to(gamma, (len(rows), 3))
            step = self.study.length / steps
            result = batch.run(gamma, rate, step=step, count=steps, keep_every=every, threads=1)
        if result.kept is not None and not kept:
            more |= extremes_of(result.kept)
            result.kept = None
        return result, more

    def _trajectory(
        self, values: dict[str, Array], rows: NDArray[np.int64], samples: int
    ) -> Columns:
        """States at equal intervals, in long form."""
        scenarios, starts, _ = self.scenarios(values)
        every = max(1, self.steps // samples)
        result, _ = self.run(scenarios, starts, rows, self.steps, every)
        assert result.kept is not None
        columns = columns_of(result.kept, self._quantities)
        scenario = np.tile(rows, len(result.kept.t))
        return {"scenario": scenario} | {name: x.ravel() for name, x in columns.items()}

    def _split(self, values: Mapping[str, Array]) -> tuple[dict[str, Array], dict[str, Array]]:
        """Numbers of the scene by key, and what a run is given: initial state and gains."""
        inside: dict[str, Array] = {}
        outside: dict[str, Array] = {}
        for one in self.study.variations:
            for key, array in one.parameters(values[one.key]).items():
                given = key in _STATE_KEYS or key.startswith("control.")
                (outside if given else inside)[key] = array
        return inside, outside


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


def find_range_ends(study: SweepStudy) -> dict[str, Array]:
    """Return values of what varies in its middle and at the ends of all ranges.

    Of a table these are the rows with the least and the largest number of a column.
    """
    listed = [one for one in study.variations if one.kind == "table"]
    picks = {pick for x in (study.table or {}).values() for pick in (x.argmin(), x.argmax())}
    middle = {one.key: one.ends()[0] for one in study.variations}
    rows = [middle | {one.key: one.numbers[pick] for one in listed} for pick in sorted({0} | picks)]
    for one in study.variations:
        if one.kind != "table":
            rows += [rows[0] | {one.key: end} for end in one.ends()]
    return {key: np.stack([row[key] for row in rows]) for key in middle}


def draw_pilot_rows(study: SweepStudy) -> dict[str, Array]:
    """Return the values of what varies in the pilot rows."""
    if study.table is None:
        return Sampler(study.variations, PILOT, study.seed, "random").rows(0, PILOT)
    chosen = np.linspace(0, study.rows - 1, min(PILOT, study.rows)).astype(int)
    parts = [study.sampler.rows(int(row), 1) for row in chosen]
    return {key: np.concatenate([part[key] for part in parts]) for key in parts[0]}


def units_of(variations: Sequence[Variation]) -> dict[str, str]:
    """Return the unit of each column that has one."""
    found = UNITS | {"fault_time": "s", "local_error": "1"}
    for k in DIMENSIONS["leg"]:
        found |= {f"{name}_{end}_{k}": QUANTITIES[name][0] for name in _JOINTS for end in _ENDS}
        found |= {f"error_rms_{k}": "rad", f"error_max_{k}": "rad"}
    for one in variations:
        found |= dict.fromkeys(one.columns, "1" if one.factor else one.targets[0].spec.unit)
    return found


def extremes_of(kept: BatchStates) -> Columns:
    """Least and largest angles and rates of joints at the ends of steps."""
    with np.errstate(all="ignore"):
        return {
            f"{name}_{end}_{k + 1}": getattr(getattr(kept, name)[..., k], end)(axis=0)
            for name in _JOINTS
            for end in _ENDS
            for k in range(3)
        }
