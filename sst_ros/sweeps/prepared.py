# SPDX-License-Identifier: Apache-2.0
"""A study ready to run in this process, and the table of one chunk of its rows."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from sst_ros.errors import InputError, refusal, require
from sst_ros.integration.batch import Batch, BatchResult
from sst_ros.mechanism.geometry import Array, angle_between
from sst_ros.scene.scene import Scenarios
from sst_ros.state import DIMENSIONS, QUANTITIES, UNITS, Joints
from sst_ros.sweeps.controlled_batch import ControlledBatch
from sst_ros.sweeps.sweep_study import SweepStudy
from sst_ros.version import VERSION

if TYPE_CHECKING:
    import pyarrow as pa

PARTS = 64  # extremes are those of the states at the ends of at most so many equal parts of a run

PILOT = 256
"""Rows by which the number of steps is chosen; drawn apart, so that no number of rows matters."""

MOST_STEPS = 1_000_000

EXTREMES = tuple(itertools.product(Joints._fields, ("min", "max")))

Columns = dict[str, NDArray[Any]]


class PreparedSweep:
    """A study with its compiled code and its number of steps, which may be known already.

    Refuses one whose ranges end in no scene, and one whose tolerance no number of steps reaches.
    """

    def __init__(self, study: SweepStudy, steps: int | None = None) -> None:
        self.study = study
        self._ends, _ = self._split(find_range_ends(study))
        ends = Scenarios(study.model_scene, self._ends)
        for row, error in ends.faults(most=1).items():
            texts = [str(one).replace(f"scenario {row}: ", "") for one in error.problems]
            allowed = "within its range: " + "; ".join(texts)
            raise refusal("sweep", "vary", "makes no scene", allowed)
        profile = study.model_scene.torque is not None
        self.batch = Batch(study.model_scene, profile=profile, parameters=ends.rows)
        self.controlled = None if study.control is None else ControlledBatch(self.batch, study)
        for one in (self.batch, self.controlled):
            _ = one and one.module  # compiled here, before several threads want it
        self._quantities = [name for name in study.outputs if name != "extremes"]  # of a state
        self.pilot_error = math.nan
        self.steps = steps or study.steps or self._choose_steps()

    def __reduce__(self) -> tuple[Any, ...]:
        return PreparedSweep, (self.study, self.steps)  # a worker compiles for itself

    def _choose_steps(self) -> int:
        """Find the least number of steps, about, that keeps the tolerance in the pilot rows.

        The error of c steps is the difference from 2c steps; it falls with the eighth power of c.
        It is nan where no run reaches the end.
        """
        study, tolerance = self.study, self.study.tolerance
        whole, kind = (PILOT, "random") if study.table is None else (study.rows, study.sampling)
        chosen = np.linspace(0, whole - 1, min(PILOT, whole)).astype(int)
        values = {key: x[chosen] for key, x in study.draw(0, whole, kind).items()}
        scenarios, starts, _ = self.scenarios(values)
        rows = np.arange(len(chosen))
        unit = 1 if self.controlled is None else self.controlled.samples
        count = max(unit, 16)
        for _ in range(12):
            coarse, fine = (self.run(scenarios, starts, rows, n)[0] for n in (count, 2 * count))
            both = coarse.success & fine.success
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
        raise refusal("sweep", "tolerance", tolerance, allowed)

    def check(self, values: dict[str, Array]) -> None:
        """Raise InputError with the first ten problems if rows make no scene."""
        Scenarios(self.study.model_scene, self._split(values)[0]).check()

    @cached_property
    def about(self) -> dict[str, Any]:
        """Metadata of the files: study, its digest, version, units."""
        units = UNITS | {"fault_time": "s", "local_error": "1"}
        for k in DIMENSIONS["leg"]:
            joints = {f"{name}_{end}_{k}": QUANTITIES[name][0] for name, end in EXTREMES}
            units |= joints | {f"error_rms_{k}": "rad", f"error_max_{k}": "rad"}
            units |= {f"torque_rms_{k}": "N m", f"torque_max_{k}": "N m", "settling_time": "s"}
        for one in self.study.variations:
            units |= dict.fromkeys(one.columns, "1" if one.factor else one.targets[0].spec.unit)
        return {
            "version": VERSION,
            "digest": self.study.digest,
            "steps": self.steps,
            "duration": self.study.length,
            "study": self.study.document(),
            "units": units,
            "inputs": [name for one in self.study.variations for name in one.columns],
        }

    def chunk(self, index: int) -> pa.Table:
        """Table of the rows of a chunk."""
        pyarrow, study = require("pyarrow"), self.study
        rows = np.arange(study.rows_of(index).start, study.rows_of(index).stop)
        values = study.draw(int(rows[0]), len(rows))
        scenarios, starts, faults = self.scenarios(values)
        result, more = self.run(scenarios, starts, rows, self.steps)
        columns: Columns = {
            "status": result.status.astype(np.int8),
            "t": result.t,
            "fault_time": result.fault_time,
            "local_error": result.local_error,
        }
        columns |= result.columns(self._quantities) | more
        texts, reason = result.reasons
        if faults:  # no numbers, and the first problem as the reason
            wrong = list(faults)
            keys = [error.problems[0].key.partition(": ")[2] for error in faults.values()]
            columns = {name: column.copy() for name, column in columns.items()}
            for name, column in columns.items():
                column[wrong] = {"status": -1, "fault_time": 0.0}.get(name, np.nan)
            distinct, which = np.unique([f"no scene: {key}" for key in keys], return_inverse=True)
            reason[wrong] = len(texts) + which
            texts = np.append(texts, distinct)
        inputs = {
            name: column
            for one in study.variations
            for name, column in zip(one.columns, values[one.key].T, strict=True)
        }
        # Arrow copies strided columns an entry at a time.
        named = {"scenario": rows, **inputs, **columns}
        arrays = {name: np.ascontiguousarray(column) for name, column in named.items()}
        arrays["reason"] = pyarrow.DictionaryArray.from_arrays(
            reason.astype(np.int32), pyarrow.array(texts, pyarrow.string())
        )
        return pyarrow.table(arrays)

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
    ) -> tuple[BatchResult, Columns]:
        """Return results of rows by a number of steps, and their extremes or tracking figures."""
        batch = self.batch.with_parameters(scenarios)
        every = -(-steps // PARTS) if "extremes" in self.study.outputs else 0
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
        if result.kept is not None:
            with np.errstate(all="ignore"):
                for (name, end), k in itertools.product(EXTREMES, range(3)):
                    angles = getattr(result.kept, name)[..., k]
                    more[f"{name}_{end}_{k + 1}"] = getattr(angles, end)(axis=0)
            result.kept = None
        return result, more

    def _split(self, values: Mapping[str, Array]) -> tuple[dict[str, Array], dict[str, Array]]:
        """Numbers of the scene by key, and what a run is given: initial state and gains."""
        inside: dict[str, Array] = {}
        outside: dict[str, Array] = {}
        for one in self.study.variations:
            for key, array in one.parameters(values[one.key]).items():
                (outside if key.startswith(("initial.", "control.")) else inside)[key] = array
        return inside, outside


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
