# SPDX-License-Identifier: Apache-2.0
"""Integration error of a recorded run: its states against a reference integrated anew.

The reference is propagated by DOP853 with a tight tolerance, a step a tick or more. Its
distance from a second solution by steps of half the length is its own error. It begins
at the first sample, which the scene names, and again at a sample where torques are
lost. Long runs are compiled.

Actuators that lag are part of the state, and torques are held to the scene's limit. A
moment from a topic must be recorded; without it there is nothing to compare with.

What is compared is the true motion. Where only measured joint states are recorded,
which have noise or a delay, the angles are those of the recorded orientation; rates and
energies are not known, and the reference begins at the start of the run alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from typing import NamedTuple, TypeAlias

import numpy as np
import pandas as pd

from sst_ros.dynamics import kernel
from sst_ros.dynamics.initial_state import initial_state
from sst_ros.integration.methods import DOP853
from sst_ros.integration.point import Point
from sst_ros.integration.stepper import CannotStep, EvaluationBudget, Stepper
from sst_ros.mechanism.geometry import Array, Geometry, angle_between
from sst_ros.progress import Bar
from sst_ros.recording.recording import Recording
from sst_ros.recording.topic_tables import Integers, places
from sst_ros.scene.scene import Scene
from sst_ros.scene.torque_profile import SineTorque, Torque
from sst_ros.state import NANOSECONDS

Held: TypeAlias = tuple[Integers, Integers, Array]
"""Ticks: when each begins and ends, from the start of the run on [ns], shape (m,), and
what is held over it: torques, and a moment on the star in {B} where the scene takes one
[N m], (m, 3 or 6).
"""

LONGEST_TICK_NS = 1_000_000  # longer ticks are divided [ns]
TICK_TOLERANCE = 1e-13  # largest local error estimate of a step
TICK_BUDGET = 3600  # evaluations that a tick may take on average: a hundred steps
# so many ticks may take more: then the scene is too stiff, and tries take long
UNRESOLVED = 100
CHUNK = 25_000  # so many ticks at a time, which bounds the memory
SAME_START = 1e-9
"""Largest difference [rad], [rad/s] between a first sample and the start that its scene
asks for, where samples are lost and the first one may belong to a later time.
"""


class TickStepper(Stepper):
    """Advances a scene by DOP853 through ticks.

    Limits of the scene do not end the motion. Torques over time are within the limit of
    the actuators; without them they are those of each tick.
    """

    # the limit of the actuators is part of the program
    _traces_clamped_sines = True

    def __init__(self, scene: Scene, torque: SineTorque | None) -> None:
        self._sine = torque
        budget = EvaluationBudget(TICK_BUDGET)
        super().__init__(
            scene, DOP853.name, TICK_TOLERANCE, budget=budget, limits=False
        )

    def follow(self, ticks: Held, start: Array) -> Array:
        """Advance through m ticks from a state (quaternion, body rate, lagged torques).

        Returns solution and second solution at the end of each tick, with the work
        since the start [J], shape (m, 2, 8 or 11); of fewer ticks where no step
        resolves the next one.
        """
        ends: list[tuple[list[float], list[float]]] = []
        at = self.begin(start.tolist())
        with suppress(CannotStep), np.errstate(all="ignore"):
            for start_ns, end_ns, drive in zip(*ticks, strict=True):
                at = self._follow_tick(at, int(start_ns), int(end_ns), drive.tolist())
                ends.append((at.y, at.z))
        return np.array(ends).reshape(len(ends), 2, len(self.ode.state))

    def _follow_tick(
        self, at: Point, start_ns: int, end_ns: int, drive: Sequence[float]
    ) -> Point:
        """Advance through one tick; a long one is divided."""
        torque: Torque = self._sine or (drive[0], drive[1], drive[2])
        acting, moment = self.torque.acting(torque), tuple(drive[3:])
        parts = max(1, -(-(end_ns - start_ns) // LONGEST_TICK_NS))
        length = (end_ns - start_ns) / NANOSECONDS / parts
        for part in range(parts):
            at = self.advance(
                at, start_ns / NANOSECONDS + length * part, length, acting, moment
            )
        return at


def begins(recording: Recording) -> bool:
    """Return whether the first sample is that of the start of the run.

    Only a recording that lost samples is doubted: where all are there, a first sample
    that is not what the scene asks for is an error of the simulator, and must be seen
    as one.
    """
    if recording.time_ns[0] != 0 or recording.diagnostics.get("states_set", "0") != "0":
        return False
    if recording.diagnostics.get("samples_published") == str(len(recording.time_ns)):
        return True
    start = recording.scene.initial
    _, gamma, gamma_dot = _true_samples(recording)
    off = np.abs(gamma[0] - start.gamma), np.abs(gamma_dot[0] - start.gamma_dot)
    return bool(np.nanmax(off, initial=0.0) < SAME_START)


def _true_samples(run: Recording) -> tuple[Array, Array, Array]:
    """Quaternions, gamma [rad] and gamma_dot [rad/s] of the true motion.

    Nan if unknown.
    """
    if run.motion is not None:
        return run.quaternion, run.gamma, run.gamma_dot
    return run.quaternion, run.exact_gamma, np.full_like(run.gamma_dot, np.nan)


def _first_state(run: Recording) -> Array:
    """State of the first sample.

    Of the scene where the rates of the sample are not known.
    """
    if run.motion is not None:
        return np.asarray(run.states[0])
    start = np.array(initial_state(run.scene, Geometry.of(run.scene)))[:7]
    return np.append(start, run.effort[0] if run.scene.lags else [])


COMPARED_UNITS = {"gamma": "rad", "gamma_dot": "rad_per_s", "orientation": "rad"}
"""What is compared, and its unit in names."""


class Comparison(NamedTuple):
    """A recording against a reference."""

    error: pd.DataFrame
    """Distance of the recording from the reference, a row a sample, nan where there is
    none: gamma and gamma_dot, the largest difference of the actuator angles [rad] and
    rates [rad/s]; orientation, the angle between the orientations of {E} [rad].
    """
    own: pd.DataFrame  # the reference's own error, in the same columns
    energy: Array
    """Energy of each sample, less that of the first and the work of all torques on the
    reference [J], shape (n,), nan where it is not known; where ticks are lost, it goes
    on without them.
    """
    # where torques were lost: it begins at a sample again [ns]
    restarts_ns: tuple[int, ...] = ()
    steps: int = 0  # least number of steps a tick of the reference

    @property
    def compared(self) -> int:
        """Number of samples that were compared."""
        return int(self.error.gamma.count())


def integration(recording: Recording) -> Comparison:
    """Compare with the exact motion under the recorded torques.

    The difference is the error of the integrator. A sample from which the reference
    restarts is not compared, and neither are samples between lost torques and the next
    restart; none where the moment is not recorded.
    """
    ticks, moment = recording.ticks, recording.scene.moment
    drives = ticks.torque
    if moment is not None and moment.topic:
        drives = (
            np.empty((0, 6))
            if ticks.moment is None
            else np.hstack([drives, ticks.moment])
        )
    held = ticks.start_ns[: len(drives)], ticks.end_ns[: len(drives)], drives
    return _compare(recording, None, held, known=begins(recording))


def ideal(recording: Recording) -> Comparison | None:
    """Compare with the motion under continuous torques.

    The difference is the effect of hold and transport. None where the scene has no
    torques, its moment comes from a topic, or the recording lacks the start of the run.
    """
    scene, time = recording.scene, recording.time_ns
    pushed = scene.moment is not None and scene.moment.topic
    if scene.torque is None or pushed or not begins(recording):
        return None
    held = time[:-1], time[1:], np.empty((len(time) - 1, 0))
    return _compare(recording, scene.torque, held, known=True)


def _compare(
    run: Recording, torque: SineTorque | None, held: Held, *, known: bool
) -> Comparison:
    """Propagate a run with a second solution, and compare both at its samples.

    Its start is `known` or not. Under recorded torques, which may have gaps, the
    reference begins again at a sample after each, and after a tick that no step
    resolves.
    """
    time = run.time_ns
    samples, exact = _true_samples(run), run.motion is not None
    distances, energy = np.full((2, len(time), 3), np.nan), np.full(len(time), np.nan)
    start_ns, end_ns, drives = held
    motion, count = TickStepper(run.scene, torque), len(start_ns)
    model = motion.dynamics.model
    state = _first_state(run)
    known = known and bool(count and np.isfinite(state[0]))
    if known:  # by what the first sample is off, the simulator was
        start = run.scene.initial
        asked = samples[0][:1], np.array([start.gamma]), np.array([start.gamma_dot])
        distances[:, 0] = 0.0
        distances[0, :1] = _measure([values[:1] for values in samples], asked)
    # Ticks at which it can begin again: no sample is on the motion under continuous
    # torques.
    sample = places(time, start_ns)
    restarts = torque is None and exact
    usable = np.flatnonzero(
        (sample >= 0) & np.isfinite(samples[0][sample, 0]) & restarts
    )
    known = known and start_ns[0] == 0
    lost = np.append(not known, start_ns[1:] != end_ns[:-1])[:count]  # before each tick
    stops = np.append(np.flatnonzero(lost), count)
    begun, bar = list[int](), Bar("reference", count > CHUNK)
    k, failed, residual, done = 0, 0, 0.0, 0.0
    if known:
        energy[0], done = 0.0 if exact else np.nan, _energy(model, state[None])[0]
    while k < count and failed < UNRESOLVED:
        if not known:
            after = usable[np.searchsorted(usable, k) :]
            if not len(after):
                break
            if lost[k : after[0] + 1].any():
                begun.append(int(start_ns[after[0]]))
            k = int(after[0])
            state = run.states[sample[k]]
            energy[sample[k]], done = (
                residual,
                _energy(model, state[None])[0] - residual,
            )
        end = min(int(stops[np.searchsorted(stops, k, side="right")]), k + CHUNK)
        reached = motion.follow((start_ns[k:end], end_ns[k:end], drives[k:end]), state)
        rows = places(time, end_ns[k : k + len(reached)])
        found, rows = reached[rows >= 0], rows[rows >= 0]
        first, second = (
            _joints(model, states) for states in (found[:, 0], found[:, 1])
        )
        distances[0, rows] = _measure([values[rows] for values in samples], first)
        distances[1, rows] = _measure(second, first)
        if exact:
            energy[rows] = _energy(model, run.states[rows]) - done - found[:, 0, -1]
        residual = next(
            (x for x in energy[rows][::-1].tolist() if np.isfinite(x)), residual
        )
        k += len(reached)
        known = k == end and k not in stops
        if known:
            state, done = reached[-1, 0, :-1], done + reached[-1, 0, -1]
        elif k < end:
            failed, k = failed + 1, k + 1
        bar.draw(k / count)
    error, own = (pd.DataFrame(each, columns=[*COMPARED_UNITS]) for each in distances)
    steps = -(-run.ticks.period_ns // LONGEST_TICK_NS)
    return Comparison(error, own, energy, tuple(begun), steps)


def _joints(model: kernel.Model, states: Array) -> tuple[Array, Array, Array]:
    """Return unit quaternions, gamma [rad] and gamma_dot [rad/s] of states.

    States have the shape (n, 7 or more).
    """
    unit = states[:, :4] / np.linalg.norm(states[:, :4], axis=1)[:, None]
    found = kernel.joints(model, tuple(states[:, :7].T))
    return unit, np.stack(found.gamma, axis=1), np.stack(found.gamma_dot, axis=1)


def _energy(model: kernel.Model, states: Array) -> Array:
    """Kinetic and potential energy [J] of states, shape (n,)."""
    columns = tuple(states.T)
    kinetic = kernel.kinetic_energy(model, columns)
    return np.asarray(kinetic + kernel.potential_energy(model, columns))


def _measure(one: Sequence[Array], other: Sequence[Array]) -> Array:
    """Return distances of quaternions, gamma and gamma_dot, shape (n, 3).

    The columns are COMPARED_UNITS.
    """
    # Recorded angles may count whole turns, computed ones do not.
    turn, difference = 2.0 * np.pi, one[1] - other[1]
    gamma = np.abs(difference - turn * np.round(difference / turn)).max(axis=1)
    rate = np.abs(one[2] - other[2]).max(axis=1)
    return np.stack([gamma, rate, angle_between(one[0], other[0])], axis=1)
