# SPDX-License-Identifier: Apache-2.0
"""Many runs of a scene: chunks of a study on threads, or on a Dask cluster.

The threads are those of this process.

A chunk depends on the study and its index alone, so it may be computed again. Its
Parquet file is complete or absent. The metadata of the file hold the study, its digest,
the version and the units, so that it explains itself and `--resume` knows which chunks
are there.
"""

from __future__ import annotations

import contextlib
import fcntl
import itertools
import json
import math
import os
import time
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from sst_ros.dynamics.reactions import LINK_JOINTS, SIZES, ScenarioReactions
from sst_ros.errors import InputError, check_kinds, refusal, refuse_unless, require
from sst_ros.files import TEMPORARY, replace_file, require_free, write_into
from sst_ros.integration.batch import Batch, BatchResult
from sst_ros.integration.many_runs import run_many
from sst_ros.mechanism.geometry import Array, angle_between
from sst_ros.progress import Bar
from sst_ros.report.results import render
from sst_ros.scene.scene import Scenarios
from sst_ros.simulation.tables import compute_checksum
from sst_ros.state import DIMENSIONS, MOTION_UNITS, QUANTITIES, Joints, cached_property
from sst_ros.sweeps.cluster import SweepFailed, run_on_cluster
from sst_ros.sweeps.controlled_batch import ControlledBatch
from sst_ros.sweeps.sweep_study import SweepStudy
from sst_ros.version import VERSION

if TYPE_CHECKING:
    import pandas as pd
    import pyarrow as pa

Table: TypeAlias = "pd.DataFrame"  # evaluated with the annotations of `sweep`
# extremes are those of the states at the ends of at most so many equal parts of a run
EXTREME_PARTS = 64
# runs whose reactions are computed at once: their arrays fit the cache
REACTION_ROWS = 256

PILOT = 256
"""Rows by which the number of steps is chosen.

Drawn apart, so that no number of rows matters.
"""

PILOT_STEPS = 16  # that are tried first, at least
PILOT_TRIES = 12  # numbers of steps that are tried
ERROR_ORDER = 8.0  # power of the number of steps with which the error falls
AIM = 0.7  # share of the tolerance that is aimed at
GROWTH_OF_STEPS = (1.05, 8.0)  # least and largest, from one try to the next
UNKNOWN_GROWTH = 4.0  # where the error is not finite
MOST_RUN_STEPS = 1_000_000
SHOWN_REASONS = 3  # for which runs ended early, beside the bar
SHOWN_CAUSES = 8  # inputs on which that depends, in the summary

EXTREMES = tuple(itertools.product(Joints._fields, ("min", "max")))
REACTIONS = tuple(itertools.product(SIZES, LINK_JOINTS, ("peak", "rms")))

METADATA = b"sst_ros"  # key of what a Parquet file says of itself
# what a row that makes no scene has; nan elsewhere
_NO_SCENE = {"status": -1, "fault_time": 0.0}
_NOT_OUTPUTS = ("status", "reason", "t", "fault_time", "local_error")


@check_kinds
def sweep(
    scene: Any,
    vary: Any,
    *,
    torque: Any = None,
    duration: float | None = None,
    n: int | None = None,
    seed: int = 0,
    out: str | Path | None = None,
    client: Any = None,
    workers: int = 0,
    resume: bool = False,
    progress: bool = True,
    **options: Any,
) -> Table:
    """Run a scene many times with other numbers; return a table, a row for each run.

    Args:
        scene: a Scene, its name, its path, or its document as a dict.
        vary: distribution or values by key of the scene, as in {"star.inertia":
            ("uniform", 0.8, 1.2, "relative"), "initial.gamma": ("normal", 0.785,
            0.05)}; or a table (a DataFrame) with a row for each run.
        torque: None for the scene's own torques over time if it has some, else zero;
            three constant torques [N m]; or a SineTorque.
        duration: length of a run [s]; by default that of the scene.
        n: number of runs; by default that of the grid or of the table.
        seed: of the random numbers. Row i depends on the seed and on i alone.
        out: folder of the results as Parquet files, one a chunk; nothing is written
            without it.
        client: a dask.distributed client; by default threads of this process.
        workers: number of threads without a client; 0 for one a core.
        resume: compute only the chunks that are missing in `out`.
        progress: draw a bar on a terminal.
        options: `sampling`, `tolerance`, `steps`, `control`, `outputs` and `chunk` of
            `SweepStudy`.

    Returns:
        Inputs, how each run ended (`status`, `reason`, `t`), `local_error`, and the
        outputs; units in `attrs`.

    Raises:
        InputError: an argument or a value in the study is not allowed; nothing has run
            then.
        SweepFailed: chunks could not be computed or written; those that are done
            remain.
        MissingDependency: pandas or pyarrow is not installed.

    """
    is_client = client is None or hasattr(client, "scheduler_info")
    has_text_keys = vary is not None
    if isinstance(vary, Iterable):
        has_text_keys = all(isinstance(key, str) for key in vary)
    refuse_unless(
        "sweep", ("client", client, is_client, "must be a dask.distributed Client")
    )
    refuse_unless(
        "sweep", ("vary", vary, has_text_keys, "must have keys of the scene, as text")
    )
    is_table = hasattr(vary, "columns")
    study = SweepStudy.from_values(
        {
            "scene": scene,
            "torque": torque,
            "duration": duration,
            "n": n,
            "seed": seed,
            **options,
            "table" if is_table else "vary": vary,
        }
    )
    return run_study(
        study,
        None if out is None else Path(out),
        client=client,
        workers=workers,
        resume=resume,
        progress=progress,
    )


def run_study(
    study: SweepStudy,
    out: Path | None,
    *,
    client: Any = None,
    workers: int = 0,
    resume: bool = False,
    progress: bool = True,
) -> pd.DataFrame:
    """Run a study and return its table; see `sweep`."""
    for module in ("pandas", "pyarrow"):
        require(module)
    is_count = type(workers) is int and 0 <= workers <= 1024
    refuse_unless(
        "sweep",
        ("workers", workers, is_count, "must be a whole number from 0 to 1024"),
        ("resume", resume, out is not None or not resume, "needs out"),
    )
    if out is None:
        return _compute(study, None, client=client, workers=workers, progress=progress)
    out = out.resolve() if resume else require_free(out.resolve(), "sweep")
    with hold_folder(out, "sweep"):
        if not resume:  # another run may have written since
            require_free(out, "sweep")
        return _compute(study, out, client=client, workers=workers, progress=progress)


@contextmanager
def hold_folder(out: Path, origin: str) -> Iterator[None]:
    """Make the folder `out` for a block that alone writes into it.

    It is removed if it stays empty. Raises InputError of `origin` where another writer
    has it, in this process or another.
    """
    with write_into(out, origin):
        lock = os.open(out, os.O_RDONLY | os.O_DIRECTORY)
    try:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            requirement = "is being written by another run: wait until that has ended"
            raise refusal(origin, "--out", str(out), requirement) from None
        except OSError:  # a network file system may not lock folders
            pass
        yield
    finally:
        os.close(lock)
        with contextlib.suppress(OSError):  # it is not empty
            out.rmdir()


def _compute(
    study: SweepStudy, out: Path | None, *, client: Any, workers: int, progress: bool
) -> pd.DataFrame:
    """Compute the chunks of a study not yet in `out`; return the whole table."""
    complete: set[int] = set()
    steps: int | None = None
    if out is not None:
        # With the number of steps that was chosen when it was started.
        complete, steps = find_complete(out, study)
    ready = PreparedSweep(study, steps)
    if study.table is not None:  # refuse rows that make no scene, before anything runs
        ready.check(study.draw(0, study.rows))
    if out is not None:
        with write_into(out, "sweep"):
            for left in out.glob(f"{TEMPORARY}*"):  # by killed processes
                left.unlink(missing_ok=True)
    missing = [index for index in range(study.chunks) if index not in complete]
    total = sum(len(study.rows_of(index)) for index in missing)
    bar = Bar("sweep", progress)
    began = time.monotonic()
    reasons: Counter[str] = Counter()
    runs = 0
    tables: dict[int, Any] = {}
    work = partial(run_chunk, ready, out)
    if client is None:
        results = run_many(work, missing, workers=workers)
    else:
        results = run_on_cluster(client, work, missing, name="chunk")
    try:
        for number, (early, table) in results:
            index = missing[number]
            tables[index] = table
            runs += len(study.rows_of(index))
            reasons.update(early)
            rate = max(runs / max(time.monotonic() - began, 1e-9), 1e-9)
            text = f"{rate:.0f} runs/s, {(total - runs) / rate:.0f} s left"
            if reasons:
                common = reasons.most_common(SHOWN_REASONS)
                counts = ", ".join(f"{count} {reason}" for reason, count in common)
                text += f"; early: {counts}"
            bar.draw(1.0 - (total - runs) / study.rows, text)
    except OSError as error:
        raise SweepFailed(f"{out}: {error}") from error
    if out is not None:
        return read_sweep(out)
    chunks = [tables[index] for index in range(study.chunks)]
    return to_frame(require("pyarrow").concat_tables(chunks), ready.about)


def run_chunk(
    ready: PreparedSweep, out: Path | None, index: int
) -> tuple[dict[str, int], Any]:
    """Return how runs of a chunk ended early, and its table if no folder is given.

    Raises OSError where the file cannot be written.
    """
    table = ready.chunk(index)
    counts = {}
    for row in table["reason"].value_counts().to_pylist():
        counts[row["values"]] = row["counts"]
    counts.pop("reached the end", None)
    if out is None:
        return counts, table
    write_part(table, out, index, ready.about)
    return counts, None


class PreparedSweep:
    """A study ready to run: its programs and its number of steps.

    The number of steps may be known already. A study whose ranges end in no scene is
    refused, and so is one whose tolerance no number of steps reaches.
    """

    def __init__(self, study: SweepStudy, steps: int | None = None) -> None:
        self.study = study
        self._ends, _ = self._split(find_range_ends(study))
        ends = Scenarios(study.model_scene, self._ends)
        for row, error in ends.faults(most=1).items():
            problems = "; ".join(map(str, error.problems))
            requirement = "within its range: " + problems.replace(
                f"scenario {row}: ", ""
            )
            raise refusal("sweep", "vary", "makes no scene", requirement)
        profile = study.model_scene.torque is not None
        self.batch = Batch(study.model_scene, profile=profile, parameters=ends.rows)
        self.controlled: ControlledBatch | None = None
        # Compiled here, before several threads want it.
        _ = self.batch.programs
        if study.control is not None:
            self.controlled = ControlledBatch(self.batch, study)
            _ = self.controlled.answer
        over_time = "extremes", "reactions"
        self._quantities = [name for name in study.outputs if name not in over_time]
        self.pilot_error = math.nan
        self.steps = steps or study.steps or self._choose_steps()

    def __reduce__(self) -> tuple[Any, ...]:
        return PreparedSweep, (self.study, self.steps)  # a worker compiles for itself

    def _choose_steps(self) -> int:
        """Find about the least number of steps that keeps the tolerance in pilot rows.

        The error of c steps is the difference from 2c steps; it falls with the eighth
        power of c. It is nan where no run reaches the end.
        """
        tolerance = self.study.tolerance
        values = self._draw_pilot()
        scenarios, starts, _ = self.scenarios(values)
        rows = np.arange(_count_rows(values))
        unit = 1 if self.controlled is None else self.controlled.samples
        count = max(unit, PILOT_STEPS)
        for _ in range(PILOT_TRIES):
            coarse, _ = self.run(scenarios, starts, rows, count)
            fine, _ = self.run(scenarios, starts, rows, 2 * count)
            completed = coarse.success & fine.success
            if not completed.any():
                return count
            apart = angle_between(
                coarse.quaternion[completed], fine.quaternion[completed]
            )
            error = float(apart.max())
            self.pilot_error = error
            if error <= tolerance:
                return count
            growth = UNKNOWN_GROWTH
            if math.isfinite(error):
                growth = (error / (AIM * tolerance)) ** (1.0 / ERROR_ORDER)
            least, most = GROWTH_OF_STEPS
            growth = min(max(growth, least), most)
            count = unit * math.ceil(count * growth / unit)
            if count > MOST_RUN_STEPS:
                break
        requirement = (
            f"is not reached by {MOST_RUN_STEPS} steps; give `steps`, or a larger"
            " tolerance"
        )
        raise refusal("sweep", "tolerance", tolerance, requirement)

    def _draw_pilot(self) -> dict[str, Array]:
        """Draw PILOT rows, or take so many from all over a table."""
        study = self.study
        if study.table is None:
            return study.draw(0, PILOT, "random")
        all_values = study.draw(0, study.rows)
        spread = np.linspace(0, study.rows - 1, min(PILOT, study.rows))
        chosen = spread.astype(int)
        return {key: numbers[chosen] for key, numbers in all_values.items()}

    def check(self, values: dict[str, Array]) -> None:
        """Raise InputError with the first ten problems if rows make no scene."""
        numbers, _ = self._split(values)
        Scenarios(self.study.model_scene, numbers).check()

    @cached_property
    def about(self) -> dict[str, Any]:
        """Metadata of the files: study, its digest, version, units."""
        inputs: list[str] = []
        for variation in self.study.variations:
            inputs += variation.columns
        return {
            "version": VERSION,
            "digest": self.study.digest,
            "steps": self.steps,
            "duration": self.study.length,
            "study": self.study.document(),
            "units": self._units(),
            "inputs": inputs,
        }

    def _units(self) -> dict[str, str]:
        """Return the units of all columns that a table may have."""
        units = MOTION_UNITS | {"fault_time": "s", "local_error": "1"}
        for leg in DIMENSIONS["leg"]:
            for size, name, statistic in REACTIONS:
                units[f"{size}_{name}_{statistic}_{leg}"] = SIZES[size]
            for name, end in EXTREMES:
                unit, _ = QUANTITIES[name]
                units[f"{name}_{end}_{leg}"] = unit
            units[f"error_rms_{leg}"] = "rad"
            units[f"error_max_{leg}"] = "rad"
            units[f"torque_rms_{leg}"] = "N m"
            units[f"torque_max_{leg}"] = "N m"
            units["settling_time"] = "s"
        for variation in self.study.variations:
            unit = "1" if variation.factor else variation.targets[0].spec.unit
            units |= dict.fromkeys(variation.columns, unit)
        return units

    def chunk(self, index: int) -> pa.Table:
        """Table of the rows of a chunk."""
        pyarrow = require("pyarrow")
        study = self.study
        rows = np.array(study.rows_of(index))
        values = study.draw(int(rows[0]), len(rows))
        scenarios, starts, faults = self.scenarios(values)
        result, over_time = self.run(scenarios, starts, rows, self.steps)
        columns: dict[str, NDArray[Any]] = {"scenario": rows}
        for variation in study.variations:
            components = values[variation.key].T
            columns.update(zip(variation.columns, components, strict=True))
        outputs: dict[str, NDArray[Any]] = {
            "status": result.status.astype(np.int8),
            "t": result.t,
            "fault_time": result.fault_time,
            "local_error": result.local_error,
            **result.columns(self._quantities),
            **over_time,
        }
        texts, reason = result.reasons
        if faults:  # no numbers, and the first problem as the reason
            outputs = {name: column.copy() for name, column in outputs.items()}
            for name, column in outputs.items():
                column[list(faults)] = _NO_SCENE.get(name, np.nan)
            messages = []
            for error in faults.values():
                _, _, key = error.problems[0].key.partition(": ")
                messages.append(f"no scene: {key}")
            distinct, text_index = np.unique(messages, return_inverse=True)
            reason[list(faults)] = len(texts) + text_index
            texts = np.append(texts, distinct)
        # Arrow copies strided columns an entry at a time.
        arrays = {
            name: np.ascontiguousarray(column)
            for name, column in (columns | outputs).items()
        }
        arrays["reason"] = pyarrow.DictionaryArray.from_arrays(
            reason.astype(np.int32), pyarrow.array(texts, pyarrow.string())
        )
        return pyarrow.table(arrays)

    def scenarios(
        self, values: dict[str, Array]
    ) -> tuple[Scenarios, dict[str, Array], dict[int, InputError]]:
        """Scenarios of rows, their starts and gains, and rows that make no scene."""
        numbers, starts = self._split(values)
        scenarios = Scenarios(self.study.model_scene, numbers)
        faults = scenarios.faults(most=_count_rows(values))
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
    ) -> tuple[BatchResult, dict[str, NDArray[Any]]]:
        """Return results of rows by a number of steps, and what is of their whole runs.

        That is extremes, reactions and tracking figures, by column.
        """
        batch = self.batch.with_parameters(scenarios)
        outputs = self.study.outputs
        every = 0
        if "extremes" in outputs or "reactions" in outputs:
            every = -(-steps // EXTREME_PARTS)  # rounded up
        if self.controlled is not None:
            result, over_time = self.controlled.run(batch, starts, rows, steps, every)
        else:
            over_time = {}
            initial = self.study.scene.initial
            gamma = starts.get("initial.gamma", np.array(initial.gamma))
            rate = starts.get("initial.gamma_dot", np.array(initial.gamma_dot))
            if scenarios.count is None:
                gamma = np.broadcast_to(gamma, (len(rows), 3))
            step = self.study.length / steps
            result = batch.run(
                gamma, rate, step=step, count=steps, keep_every=every, threads=1
            )
        if result.kept is not None and "reactions" in outputs:
            over_time |= self._reactions(batch, scenarios, result)
        if result.kept is not None and "extremes" in outputs:
            with np.errstate(all="ignore"):
                for name, end in EXTREMES:
                    values = getattr(result.kept, name)
                    for k in range(3):
                        extreme = getattr(values[..., k], end)(axis=0)
                        over_time[f"{name}_{end}_{k + 1}"] = extreme
        result.kept = None
        return result, over_time

    @staticmethod
    def _reactions(
        batch: Batch, scenarios: Scenarios, result: BatchResult
    ) -> dict[str, Array]:
        """Peak and RMS of the reactions of runs at the states that they kept."""
        kept = result.kept
        assert kept is not None
        model = batch.model.constants(list(batch.columns.inputs)).model
        reactions = ScenarioReactions(scenarios.columns(), model)
        states = np.concatenate([kept.quaternion, kept.body_rate], axis=-1)
        state = np.moveaxis(states, -1, 0)
        torque = np.moveaxis(kept.torque, -1, 0)
        count = result.t.shape[-1]
        columns = {}
        for size, name, statistic in REACTIONS:
            for k in range(3):
                columns[f"{size}_{name}_{statistic}_{k + 1}"] = np.full(count, np.nan)
        for first in range(0, count, REACTION_ROWS):
            rows = slice(first, first + REACTION_ROWS)
            block = kept.t[:, rows], state[..., rows], torque[..., rows]
            figures = reactions.of(*block, rows).figures
            for size, name, statistic in REACTIONS:
                values = getattr(figures[name][size], statistic)
                for k in range(3):
                    columns[f"{size}_{name}_{statistic}_{k + 1}"][rows] = values[..., k]
        for column in columns.values():
            column[result.code < 0] = np.nan
        return columns

    def _split(
        self, values: Mapping[str, Array]
    ) -> tuple[dict[str, Array], dict[str, Array]]:
        """Numbers of the scene by key, and those of a run: initial state, gains."""
        inside: dict[str, Array] = {}
        outside: dict[str, Array] = {}
        for variation in self.study.variations:
            for key, array in variation.parameters(values[variation.key]).items():
                if key.startswith(("initial.", "control.")):
                    outside[key] = array
                else:
                    inside[key] = array
        return inside, outside


def find_range_ends(study: SweepStudy) -> dict[str, Array]:
    """Return values of what varies in its middle and at the ends of all ranges.

    A table has the rows with the least and the largest number of a column, beside all
    else in its middle, and its first row beside all other ends.
    """
    of_table = [
        variation for variation in study.variations if variation.kind == "table"
    ]
    of_range = [
        variation for variation in study.variations if variation.kind != "table"
    ]
    table_rows = {0}
    for column in (study.table or {}).values():
        table_rows |= {int(column.argmin()), int(column.argmax())}
    middle = {variation.key: variation.ends()[0] for variation in study.variations}
    rows = []
    for number in sorted(table_rows):
        row = {variation.key: variation.numbers[number] for variation in of_table}
        rows.append(middle | row)
    first = rows[0]
    for variation in of_range:
        rows += (first | {variation.key: end} for end in variation.ends())
    return {key: np.stack([row[key] for row in rows]) for key in middle}


def _count_rows(values: Mapping[str, Array]) -> int:
    """Return the number of rows that were drawn, alike for all keys."""
    return len(next(iter(values.values())))


def write_part(
    table: pa.Table, folder: Path, index: int, about: Mapping[str, Any]
) -> None:
    """Write the table of a chunk as a file that is there whole or not at all."""
    record = {**about, "part": index, "columns": _describe_columns(table)}
    record["checksum"] = _checksum(record, table)
    table = table.replace_schema_metadata({METADATA: json.dumps(record).encode()})
    with replace_file(folder / _part_name(index)) as own:
        # Random mantissas do not compress, and their least and greatest help no reader.
        require("pyarrow.parquet").write_table(
            table,
            own,
            compression="none",
            use_dictionary=["reason"],
            write_statistics=False,
        )
        own.chmod(0o644)


def _checksum(about: Mapping[str, Any], table: pa.Table) -> str:
    """Return the checksum of what a file says of itself, and its columns' bits."""
    record = {key: value for key, value in about.items() if key != "checksum"}
    columns: dict[str, NDArray[Any]] = {}
    texts = {"about": json.dumps(record, sort_keys=True)}
    for name in table.column_names:
        if name == "reason":
            texts[name] = "\0".join(_read_texts(table[name]))
        else:
            columns[name] = table[name].to_numpy()
    return compute_checksum(texts, columns)


def _describe_columns(table: pa.Table) -> list[list[str]]:
    """Return name and type of each column: the checksum covers their bits alone."""
    described = []
    for name in table.column_names:
        kind = "text" if name == "reason" else table[name].to_numpy().dtype.str
        described.append([name, kind])
    return described


def _read_texts(column: pa.ChunkedArray) -> list[str]:
    """Return a column of texts, each distinct one of which is made once."""
    encoded = column.dictionary_encode().combine_chunks()
    texts: list[str] = encoded.dictionary.to_pylist()
    return [texts[code] for code in encoded.indices.to_numpy().tolist()]


def read_part(path: Path) -> tuple[dict[str, Any], pa.Table] | None:
    """Return metadata and table of a file; None where it is not whole.

    Raises InputError where its numbers are not those that were written, or it was
    written under another name. Files of earlier versions have no number, no names of
    columns or no checksum.
    """
    with contextlib.suppress(*_unreadable()):
        table = require("pyarrow.parquet").read_table(str(path), partitioning=None)
        about = json.loads(table.schema.metadata[METADATA])
        if not isinstance(about, dict):
            return None
        checksum = about.get("checksum")
        intact = checksum is None or checksum == _checksum(about, table)
        intact = intact and about.get("columns") in (None, _describe_columns(table))
        name = _part_name(about["part"]) if "part" in about else path.name
        damaged = "is damaged (its checksum is another): delete it"
        renamed = f"was written as {name}: delete or rename it"
        refuse_unless(
            "sweep",
            ("DIR", str(path), intact, damaged),
            ("DIR", str(path), name == path.name, renamed),
        )
        return about, table
    return None


def _part_name(index: int) -> str:
    return f"part-{index:07d}.parquet"


def _unreadable() -> tuple[type[Exception], ...]:
    """Return what reading a file raises that is none of a study, or is cut."""
    arrow = require("pyarrow").ArrowException
    return OSError, ValueError, LookupError, TypeError, arrow


def read_about(path: Path) -> dict[str, Any] | None:
    """Metadata of a file, with its number of rows.

    None if it is no complete file of a study.
    """
    try:
        with require("pyarrow.parquet").ParquetFile(path) as file:
            metadata: dict[str, Any] = json.loads(file.schema_arrow.metadata[METADATA])
            return metadata | {"rows": file.metadata.num_rows}
    except _unreadable():
        return None


def find_complete(folder: Path, study: SweepStudy) -> tuple[set[int], int | None]:
    """Return the chunks whose files are there, and the number of steps of their runs.

    Raises InputError at a file of another study or version, of none of its chunks, or
    whose numbers are not those that were written.
    """
    expected: dict[str, Any] = {"digest": study.digest, "version": VERSION}
    names = {_part_name(index): index for index in range(study.chunks)}
    complete = set()
    for path in sorted(folder.glob("part-*.parquet")):
        contents = read_part(path)
        index = names.get(path.name)
        requirement = f"is none of the {study.chunks} parts of this study: delete it"
        refuse_unless("sweep", ("--resume", str(path), index is not None, requirement))
        if contents is None or index is None:
            continue
        about, table = contents
        same = all(about.get(key) == value for key, value in expected.items())
        same = same and "checksum" in about
        requirement = "is of another study or version: choose another --out"
        refuse_unless("sweep", ("--resume", str(path), same, requirement))
        expected["steps"] = about["steps"]
        if table.num_rows == len(study.rows_of(index)):
            complete.add(index)
    return complete, expected.get("steps")


def read_sweep(folder: Path) -> pd.DataFrame:
    """Read the results in a folder as one table, or refuse it.

    Units and study are in its `attrs`.
    """
    descriptions: dict[Path, dict[str, Any]] = {}
    tables: list[pa.Table] = []
    not_whole: list[Path] = []
    for path in sorted(folder.glob("part-*.parquet")):
        contents = read_part(path)
        if contents is None:
            not_whole.append(path)
            continue
        descriptions[path], table = contents
        table = table.replace_schema_metadata(None)
        same = not tables or table.schema.equals(tables[0].schema)
        requirement = "is damaged (its columns are others): delete it"
        refuse_unless("sweep", ("DIR", str(path), same, requirement))
        tables.append(table)
    if not tables:
        requirement = "must be a folder with files part-*.parquet of `sst-ros sweep`"
        raise refusal("sweep", "DIR", str(folder), requirement)
    if not_whole:
        requirement = "is not whole: --resume computes it again"
        raise refusal("sweep", "DIR", str(not_whole[0]), requirement)
    first_path = next(iter(descriptions))
    first = descriptions[first_path]
    requirement = f"is of another study or version than {first_path.name}"
    for path, about in descriptions.items():
        for key in ("digest", "version", "steps"):
            same = about.get(key) == first.get(key)
            refuse_unless("sweep", ("DIR", str(path), same, requirement))
    attributes = {
        key: value
        for key, value in first.items()
        if key not in ("part", "columns", "checksum")
    }
    return to_frame(require("pyarrow").concat_tables(tables), attributes)


def to_frame(table: pa.Table, about: Mapping[str, Any]) -> pd.DataFrame:
    """Return a table as pandas, with its metadata as `attrs`."""
    frame: pd.DataFrame = (
        table.replace_schema_metadata(None).to_pandas().set_index("scenario")
    )
    frame.attrs = {key: value for key, value in about.items() if key != "rows"}
    return frame


def summarize(table: pd.DataFrame) -> str:
    """Return a text of the table of a study."""
    outputs = table.loc[table["status"] == 0, list_outputs(table)]
    described = outputs.describe(percentiles=[0.01, 0.99]).T
    units = [table.attrs["units"].get(name, "") for name in described.index]
    statistics = described[["mean", "std", "1%", "99%"]].assign(unit=units)
    statistics_text = ""
    if len(outputs):
        statistics_text = statistics.to_string(float_format="{:.6g}".format)
    return render(
        "sweep.txt",
        runs=len(table),
        about=table.attrs,
        reasons=table["reason"].value_counts(),
        causes=correlate(table).head(SHOWN_CAUSES).to_dict(),
        outputs=statistics_text,
    )


def list_outputs(table: pd.DataFrame) -> list[str]:
    """Names of the outputs of a study."""
    not_outputs = (*table.attrs["inputs"], *_NOT_OUTPUTS)
    return [name for name in table.columns if name not in not_outputs]


def correlate(table: pd.DataFrame, column: pd.Series | None = None) -> pd.Series:
    """Spearman's rank correlation of each input with a column, largest first.

    The column is by default whether a run ended early. Constant inputs have none, and
    no input has one with a constant column.
    """
    if column is None:
        column = (table["status"] != 0).astype(float)
    inputs = [name for name in table.attrs["inputs"] if table[name].nunique() > 1]
    if column.nunique() < 2 or not inputs:
        return table[[]].sum()
    correlations = table[inputs].corrwith(column, method="spearman")
    return correlations.sort_values(key=abs, ascending=False)
