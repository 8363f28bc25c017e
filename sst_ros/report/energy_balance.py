# SPDX-License-Identifier: Apache-2.0
"""The balance of energy of a recorded run: what its samples have, less the work put in between."""

from __future__ import annotations

from typing import Any

import numpy as np

from sst_ros.dynamics import energy
from sst_ros.dynamics.expression import trace
from sst_ros.dynamics.kernel import Model
from sst_ros.dynamics.traced_dynamics import Dynamics
from sst_ros.integration import codegen
from sst_ros.integration.ode import ode_with_work
from sst_ros.mechanism.geometry import Array, Geometry
from sst_ros.progress import slices
from sst_ros.recording.recording import Recording
from sst_ros.report import states
from sst_ros.report.fixed_step_motion import COMPILED_FROM, TickSequence, module, recorded_ticks
from sst_ros.report.reference import CHUNK, PLAIN_TICKS


def residual(recording: Recording, missing: list[str]) -> Array | None:
    """Return the energy balance residual since the start [J], shape (n,).

    Args:
        recording: a run.
        missing: gets a line for all that is not known.

    Returns:
        nan where it is not known, None where it cannot be known. Where ticks are lost, the balance
        goes on without them.

    """
    moment = recording.scene.moment
    if moment and moment.topic and recording.ticks.moment is None:
        missing.append("the moment on the star is not recorded: no energy residual")
        return None
    ticks = recorded_ticks(recording)
    many = len(ticks.start_ns) > COMPILED_FROM
    count = len(recording.time_ns)
    if many and codegen.numba_version() is None:
        count = int(np.searchsorted(recording.time_ns, ticks.end_ns[PLAIN_TICKS - 1])) + 1
        until = recording.seconds[count - 1]
        missing.append(f"energy after {until:g} s: there is no numba to balance it")
    stored, work = np.full((2, len(recording.time_ns)), np.nan)
    dynamics, geometry = Dynamics.of(recording.scene), Geometry.of(recording.scene)
    workers = _Workers(dynamics, ticks, recording, compiled=many)
    for part in slices(count, CHUNK, "energy", shown=False):
        rows = slice(part.start, min(part.stop + 1, count))
        state = states.recorded(geometry, recording, rows)
        energies = workers.stored(state)
        stored[rows] = energies
        work[rows.start : rows.stop - 1] = workers.work(state, rows)
    change = np.zeros(len(stored))
    change[1:] = np.diff(stored) - work[:-1]
    change[~np.isfinite(change)] = 0.0
    return np.asarray(np.where(np.isfinite(stored), np.cumsum(change), np.nan))


class _Workers:
    """Energy and work of one scene."""

    def __init__(
        self, dynamics: Dynamics, ticks: TickSequence, recording: Recording, *, compiled: bool
    ) -> None:
        self._ticks = ticks
        self._energy = trace(lambda *state: (_stored(dynamics.model, state),), dynamics.state)
        self._compiled = compiled and codegen.numba_version() is not None
        system = ode_with_work(dynamics)
        size, drive = len(system.state), len(system.drive)
        self._module = module(system.program, dynamics, size, drive, compiled=self._compiled)
        self._time = recording.time_ns

    def stored(self, state: Array) -> Array:
        """Kinetic and potential energy [J] of states (n, 7 or 10); nan stays nan."""
        return states.by_columns(self._energy, state)[:, 0]

    def work(self, state: Array, rows: slice) -> Array:
        """Work from each sample of `rows` to the next [J]; nan where ticks or states are lost."""
        time, places = self._time[rows], np.searchsorted(self._ticks.start_ns, self._time[rows])
        ticks = self._ticks.part(slice(places[0], places[-1]))
        result = np.full(len(state) - 1, np.nan)
        if not len(ticks.start_ns):
            return result
        places -= places[0]
        full = np.hstack([state, np.zeros((len(state), 1))])
        given = ticks.lengths, np.ascontiguousarray(ticks.drives)
        if self._compiled:
            self._module.work_done(full, places, *given, result)
        else:
            for k, row in enumerate(full[:-1].tolist()):
                few = [each[places[k] : places[k + 1]].tolist() for each in given]
                found = [np.nan]
                try:
                    self._module.work_done([row], [0, len(few[0])], *few, found)
                except (ArithmeticError, ValueError):
                    continue
                result[k] = found[0]
        # The ticks of a sample are all there if they follow each other from its time to the next.
        breaks = np.concatenate([[0], np.cumsum(ticks.start_ns[1:] != ticks.end_ns[:-1])])
        first, last = np.minimum(places[:-1], len(breaks) - 1), np.maximum(places[1:] - 1, 0)
        whole = (first <= last) & (breaks[first] == breaks[last])
        whole &= (ticks.start_ns[first] == time[:-1]) & (ticks.end_ns[last] == time[1:])
        return np.where(whole, result, np.nan)


def _stored(model: Model, state: Any) -> Any:
    return energy.kinetic(model, state) + energy.potential(model, state)
