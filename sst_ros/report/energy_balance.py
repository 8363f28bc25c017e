# SPDX-License-Identifier: Apache-2.0
"""The balance of energy of a recorded run: what its samples have, less the work put in between."""

from __future__ import annotations

from typing import Any

import numpy as np

from sst_ros.dynamics import energy
from sst_ros.dynamics.expression import Program, trace
from sst_ros.dynamics.traced_dynamics import Dynamics
from sst_ros.host.output import slices
from sst_ros.integration import codegen
from sst_ros.integration.tick_propagator import TickPropagator, TickSequence
from sst_ros.mechanism.geometry import Array, Geometry
from sst_ros.recording.recording import Recording
from sst_ros.recording.time_series import Integers
from sst_ros.report import states
from sst_ros.report.reference import CHUNK, COMPILED_FROM, PLAIN_TICKS, recorded_ticks


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
    geometry, energies = Geometry.of(recording.scene), _energy(recording)
    motion = TickPropagator(recording.scene, None, compiled=many)
    for part in slices(count, CHUNK, "energy", shown=False):
        rows = slice(part.start, min(part.stop + 1, count))
        state = states.recorded(geometry, recording, rows)
        stored[rows] = states.by_columns(energies, state)[:, 0]
        work[rows.start : rows.stop - 1] = _work(motion, ticks, state, recording.time_ns[rows])
    change = np.zeros(len(stored))
    change[1:] = np.diff(stored) - work[:-1]
    change[~np.isfinite(change)] = 0.0
    return np.asarray(np.where(np.isfinite(stored), np.cumsum(change), np.nan))


def _energy(recording: Recording) -> Program:
    """Kinetic and potential energy [J] of a state."""
    dynamics = Dynamics.of(recording.scene)

    def stored(*state: Any) -> tuple[Any]:
        return (energy.kinetic(dynamics.model, state) + energy.potential(dynamics.model, state),)

    return trace(stored, dynamics.state)


def _work(motion: TickPropagator, every: TickSequence, state: Array, time: Integers) -> Array:
    """Work from each of n samples to the next [J], shape (n - 1,).

    It is nan where ticks or states are lost.
    """
    places = np.searchsorted(every.start_ns, time)
    ticks = every.part(slice(places[0], places[-1]))
    if not len(ticks.start_ns):
        return np.full(len(state) - 1, np.nan)
    places -= places[0]
    # The ticks of a sample are all there if they follow each other from its time to the next.
    breaks = np.concatenate([[0], np.cumsum(ticks.start_ns[1:] != ticks.end_ns[:-1])])
    first, last = np.minimum(places[:-1], len(breaks) - 1), np.maximum(places[1:] - 1, 0)
    whole = (first <= last) & (breaks[first] == breaks[last])
    whole &= (ticks.start_ns[first] == time[:-1]) & (ticks.end_ns[last] == time[1:])
    whole &= np.isfinite(state[:-1]).all(axis=1)
    if not whole.any():
        return np.full(len(state) - 1, np.nan)
    starts = np.full((len(ticks.start_ns), state.shape[1]), np.nan)
    starts[first[whole]] = state[:-1][whole]
    begin = int(first[whole][0])
    reached = np.full(len(starts), np.nan)
    reached[begin:] = motion.follow(ticks.part(slice(begin, None)), starts[begin:])[:, 0, -1]
    return np.where(whole, reached[last], np.nan)
