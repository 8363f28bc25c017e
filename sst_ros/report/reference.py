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
from sst_ros.integration.point import Period, Point
from sst_ros.integration.stepper import CannotStep, EvaluationBudget, Stepper
from sst_ros.mechanism.geometry import Array, Geometry, angle_between
from sst_ros.progress import Bar
from sst_ros.recording.recording import Recording
from sst_ros.recording.topic_tables import Integers, places
from sst_ros.scene.scene import Scene
from sst_ros.scene.torque_profile import SineTorque, Torque
from sst_ros.state import NANOSECONDS

Ticks: TypeAlias = tuple[Integers, Integers, Array]
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

    def follow(self, ticks: Ticks, start: Array) -> Array:
        """Advance through m ticks from a state (quaternion, body rate, lagged torques).

        Returns solution and second solution at the end of each tick, with the work
        since the start [J], shape (m, 2, 8 or 11); of fewer ticks where no step
        resolves the next one.
        """
        ends: list[tuple[list[float], list[float]]] = []
        point = self.begin(start.tolist())
        with suppress(CannotStep), np.errstate(all="ignore"):
            for start_ns, end_ns, drive in zip(*ticks, strict=True):
                point = self._follow_tick(
                    point, int(start_ns), int(end_ns), drive.tolist()
                )
                ends.append((point.y, point.z))
        return np.array(ends).reshape(len(ends), 2, len(self.ode.state))

    def _follow_tick(
        self, point: Point, start_ns: int, end_ns: int, drive: Sequence[float]
    ) -> Point:
        """Advance through one tick; a long one is divided."""
        torque: Torque = self._sine or (drive[0], drive[1], drive[2])
        acting = self.torque.acting(torque)
        moment = tuple(drive[3:])
        count = max(1, -(-(end_ns - start_ns) // LONGEST_TICK_NS))
        begin = start_ns / NANOSECONDS
        length = (end_ns - start_ns) / NANOSECONDS / count
        for index in range(count):
            start = begin + length * index
            point = self.advance(point, Period(start, length, acting, moment))
        return point


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
    angle_off = np.abs(gamma[0] - start.gamma)
    rate_off = np.abs(gamma_dot[0] - start.gamma_dot)
    return bool(np.nanmax([angle_off, rate_off], initial=0.0) < SAME_START)


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
    ticks = recording.ticks
    moment = recording.scene.moment
    drives = ticks.torque
    if moment is not None and moment.topic:
        if ticks.moment is None:
            drives = np.empty((0, 6))
        else:
            drives = np.hstack([drives, ticks.moment])
    count = len(drives)
    held_torques = ticks.start_ns[:count], ticks.end_ns[:count], drives
    return _compare(recording, None, held_torques, known_start=begins(recording))


def ideal(recording: Recording) -> Comparison | None:
    """Compare with the motion under continuous torques.

    The difference is the effect of hold and transport. None where the scene has no
    torques, its moment comes from a topic, or the recording lacks the start of the run.
    """
    scene = recording.scene
    time_ns = recording.time_ns
    pushed = scene.moment is not None and scene.moment.topic
    if scene.torque is None or pushed or not begins(recording):
        return None
    no_drives = np.empty((len(time_ns) - 1, 0))
    intervals = time_ns[:-1], time_ns[1:], no_drives
    return _compare(recording, scene.torque, intervals, known_start=True)


class _Distances:
    """How far a run is from the reference, by sample; nan where it is not compared."""

    def __init__(self, run: Recording, model: kernel.Model) -> None:
        count = len(run.time_ns)
        self._run = run
        self._model = model
        self.samples = _true_samples(run)
        self.exact = run.motion is not None  # else rates and energies are not known
        self.error = np.full((count, 3), np.nan)
        self.own_error = np.full((count, 3), np.nan)
        self.energy = np.full(count, np.nan)

    def enter_start(self) -> None:
        """Enter by what the first sample is off the start that the scene asks for."""
        start = self._run.scene.initial
        quaternion = self.samples[0]
        begin = quaternion[:1], np.array([start.gamma]), np.array([start.gamma_dot])
        self.error[:1] = _measure([values[:1] for values in self.samples], begin)
        self.own_error[0] = 0.0

    def enter(self, rows: Integers, reached: Array, expected_energy: float) -> None:
        """Enter samples, by their rows, at which the reference has arrived.

        `reached` has solution and second solution, shape (n, 2, 8 or 11), each with the
        work [J] since a time at which the energy was `expected_energy` [J].
        """
        first = _joints(self._model, reached[:, 0])
        second = _joints(self._model, reached[:, 1])
        self.error[rows] = _measure([values[rows] for values in self.samples], first)
        self.own_error[rows] = _measure(second, first)
        if self.exact:
            energy = _energy(self._model, self._run.states[rows])
            self.energy[rows] = energy - expected_energy - reached[:, 0, -1]

    def last_residual(self, rows: Integers) -> float | None:
        """Return the last energy of some rows that is known [J]."""
        energy = self.energy[rows]
        finite = energy[np.isfinite(energy)]
        return float(finite[-1]) if len(finite) else None


def _compare(
    run: Recording, torque: SineTorque | None, ticks: Ticks, *, known_start: bool
) -> Comparison:
    """Propagate a run with a second solution, and compare both at its samples.

    Under recorded torques, which may have gaps, the reference begins again at a sample
    after each gap, and after a tick that no step resolves. It goes through at most
    CHUNK ticks at a time, and to the next gap.
    """
    start_ns, end_ns, drives = ticks
    count = len(start_ns)
    motion = TickStepper(run.scene, torque)
    model = motion.dynamics.model
    distances = _Distances(run, model)
    state = _first_state(run)
    known_start = known_start and bool(count and np.isfinite(state[0]))
    if known_start:
        distances.enter_start()
    # Ticks at which it can begin again: no sample is on the motion under continuous
    # torques.
    sample = places(run.time_ns, start_ns)
    has_sample = (sample >= 0) & np.isfinite(distances.samples[0][sample, 0])
    can_restart = torque is None and distances.exact
    usable = np.flatnonzero(has_sample & can_restart)
    on_reference = known_start and start_ns[0] == 0  # `state` begins the next tick
    lost_before = np.append(not on_reference, start_ns[1:] != end_ns[:-1])[:count]
    stops = np.append(np.flatnonzero(lost_before), count)
    restarts_ns: list[int] = []
    bar = Bar("reference", count > CHUNK)
    k = 0  # the next tick
    unresolved = 0
    residual = 0.0  # of the energy, at the last sample where it is known [J]
    expected_energy = 0.0  # at the beginning of tick k [J]
    if on_reference:
        distances.energy[0] = 0.0 if distances.exact else np.nan
        expected_energy = _energy(model, state[None])[0]
    while k < count and unresolved < UNRESOLVED:
        if not on_reference:
            later = usable[np.searchsorted(usable, k) :]
            if not len(later):
                break
            restart = int(later[0])
            if lost_before[k : restart + 1].any():
                restarts_ns.append(int(start_ns[restart]))
            k = restart
            state = run.states[sample[k]]
            distances.energy[sample[k]] = residual
            expected_energy = _energy(model, state[None])[0] - residual
        next_stop = int(stops[np.searchsorted(stops, k, side="right")])
        end = min(next_stop, k + CHUNK)
        reached = motion.follow((start_ns[k:end], end_ns[k:end], drives[k:end]), state)
        rows = places(run.time_ns, end_ns[k : k + len(reached)])
        at_sample = rows >= 0
        distances.enter(rows[at_sample], reached[at_sample], expected_energy)
        known_residual = distances.last_residual(rows[at_sample])
        if known_residual is not None:
            residual = known_residual
        k += len(reached)
        on_reference = k == end and k not in stops
        if on_reference:
            state = reached[-1, 0, :-1]
            expected_energy += reached[-1, 0, -1]
        elif k < end:  # no step resolves this tick
            unresolved += 1
            k += 1
        bar.draw(k / count)
    columns = [*COMPARED_UNITS]
    return Comparison(
        error=pd.DataFrame(distances.error, columns=columns),
        own=pd.DataFrame(distances.own_error, columns=columns),
        energy=distances.energy,
        restarts_ns=tuple(restarts_ns),
        steps=-(-run.ticks.period_ns // LONGEST_TICK_NS),
    )


def _joints(model: kernel.Model, states: Array) -> tuple[Array, Array, Array]:
    """Return unit quaternions, gamma [rad] and gamma_dot [rad/s] of states.

    States have the shape (n, 7 or more).
    """
    quaternion = states[:, :4] / np.linalg.norm(states[:, :4], axis=1)[:, None]
    joints = kernel.joints(model, tuple(states[:, :7].T))
    return (
        quaternion,
        np.stack(joints.gamma, axis=1),
        np.stack(joints.gamma_dot, axis=1),
    )


def _energy(model: kernel.Model, states: Array) -> Array:
    """Kinetic and potential energy [J] of states, shape (n,)."""
    columns = tuple(states.T)
    kinetic = kernel.kinetic_energy(model, columns)
    return np.asarray(kinetic + kernel.potential_energy(model, columns))


def _measure(motion: Sequence[Array], reference: Sequence[Array]) -> Array:
    """Return distances of quaternions, gamma and gamma_dot, shape (n, 3).

    The columns are COMPARED_UNITS.
    """
    quaternion, gamma, gamma_dot = motion
    quaternion_0, gamma_0, gamma_dot_0 = reference
    # Recorded angles may count whole turns, computed ones do not.
    turn = 2.0 * np.pi
    difference = gamma - gamma_0
    angle = np.abs(difference - turn * np.round(difference / turn)).max(axis=1)
    rate = np.abs(gamma_dot - gamma_dot_0).max(axis=1)
    return np.stack([angle, rate, angle_between(quaternion, quaternion_0)], axis=1)
