# SPDX-License-Identifier: Apache-2.0
"""Run scenarios by calls of a compiled loop, and locate where limits end them."""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from sst_ros.dynamics.traced_dynamics import TORQUE
from sst_ros.host.output import slices
from sst_ros.integration.batch_result import BatchResult, BatchStates
from sst_ros.integration.batch_source import NOT_FINITE
from sst_ros.integration.limit_crossings import whole_steps
from sst_ros.integration.parametric_model import ParameterColumns, ParametricModel
from sst_ros.mechanism.geometry import Array

FINE = 16
"""Parts of a step that is repeated to locate an end: the error of a cubic falls 65,536 times."""


class Advance(Protocol):
    """Advances states by steps from step `first`; changes the arrays of `batch_source`.

    `rows` are those whose last step is repeated; None for all scenarios.
    """

    def __call__(
        self, first: int, count: int, step: float, *arrays: Any, rows: NDArray[np.intp] | None
    ) -> None:
        """Advance by `count` steps."""


def integrated(
    model: ParametricModel,
    columns: ParameterColumns,
    start: tuple[Array, NDArray[np.int64]],
    given: Array,
    advance: Advance,
    *,
    step: float,
    count: int,
    keep_every: int,
    progress: bool = False,
) -> BatchResult:
    """Run all scenarios for `count` steps.

    Args:
        model: the programs.
        columns: the numbers of the scenarios.
        start: states, a column a scenario, and codes of those that cannot start.
        given: what acts from outside and what differs, a column a scenario.
        advance: the compiled loop.
        step: length of a step [s].
        count: number of steps.
        keep_every: keep the states every so many steps; 0 keeps none.
        progress: draw a bar on a terminal.

    """
    y, code = start
    number = y.shape[1]
    time, error = np.full(number, np.nan), np.zeros(number)
    kept, ends = [y.copy()], [0]
    size = keep_every or (0 if progress else max(count, 1))  # few calls: each passes all rows
    for part in slices(count, size, model.scene.name, progress):
        span = part.stop - part.start
        advance(part.start, span, step, y, given, code, time, error, rows=None)
        if keep_every and span == keep_every:
            kept.append(y.copy())
            ends.append(part.stop)
    time[code < 0] = 0.0
    # A step in which a limit was passed is left out: its beginning is the last valid state.
    steps = np.full(number, count)
    ended = code > 0
    steps[ended] = whole_steps(time[ended], step)
    steps[code < 0] = 0
    _locate(advance, step, steps, y, given, code, time)
    last = steps * step
    commanded = model.ode.drive[:3] == TORQUE
    torques = np.ascontiguousarray(given[:3].T) if commanded else np.zeros((number, 3))
    common = model, columns, torques, code >= 0
    samples = np.minimum.outer(step * np.array(ends, dtype=float), last)
    trajectories = BatchStates(*common, samples, np.stack(kept)) if keep_every else None
    return BatchResult(
        *common, last, y, code=code, fault_time=time, local_error=error, kept=trajectories
    )


def _locate(
    advance: Advance, step: float, steps: NDArray[np.int64], y: Array, given: Array,
    code: NDArray[np.int64], time: Array,
) -> None:  # fmt: skip
    """Repeat the steps in which limits were passed by finer ones; `code` and `time` change."""
    ended = np.flatnonzero((code > 0) & (code < NOT_FINITE))
    ended = ended[np.argsort(steps[ended], kind="stable")]
    for rows in np.split(ended, np.flatnonzero(np.diff(steps[ended])) + 1):
        if not len(rows):
            continue
        number, first = len(rows), int(steps[rows[0]]) * FINE
        found, when = np.zeros(number, dtype=np.int64), np.full(number, np.nan)
        arrays = np.ascontiguousarray(y[:, rows]), np.ascontiguousarray(given[:, rows]), found, when
        advance(first, FINE, step / FINE, *arrays, np.zeros(number), rows=rows)
        located = (found > 0) & (found < NOT_FINITE)
        code[rows[located]], time[rows[located]] = found[located], when[located]
