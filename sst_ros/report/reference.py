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
from typing import NamedTuple

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
from sst_ros.state import NANOSECONDS, QUATERNION


class HeldTicks(NamedTuple):
    """m ticks, over each of which torques are held."""

    start_ns: Integers  # from the start of the run on [ns], shape (m,)
    end_ns: Integers
    drives: Array
    """Torques of the actuators, and a moment on the star in {B} where the scene takes
    one [N m], shape (m, 3 or 6); (m, 0) where torques are those of the scene.
    """

    def part(self, first: int, end: int) -> HeldTicks:
        """Return the ticks from the first up to the end."""
        rows = slice(first, end)
        return HeldTicks(self.start_ns[rows], self.end_ns[rows], self.drives[rows])


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

    def follow(self, ticks: tuple[Integers, Integers, Array], start: Array) -> Array:
        """Advance through m ticks from a state (quaternion, body rate, lagged torques).

        The ticks have the parts of `HeldTicks`. Returns solution and second solution at
        the end of each tick, with the work since the start [J], shape (m, 2, 8 or 11);
        of fewer ticks where no step resolves the next one.
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
        torque: Torque
        moment: tuple[float, ...] = ()
        if self._sine is not None:
            torque = self._sine
        else:
            first, second, third, *components = drive
            torque = (first, second, third)
            moment = tuple(components)
        acting = self.torque.acting(torque)
        count = max(1, -(-(end_ns - start_ns) // LONGEST_TICK_NS))  # rounded up
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
    samples = _true_samples(recording)
    angle_off = np.abs(samples.gamma[0] - start.gamma)
    rate_off = np.abs(samples.gamma_dot[0] - start.gamma_dot)
    return bool(np.nanmax([angle_off, rate_off], initial=0.0) < SAME_START)


class _Samples(NamedTuple):
    """What is compared of a motion at n samples, nan if unknown."""

    quaternion: Array  # of length 1, shape (n, 4)
    gamma: Array  # [rad], shape (n, 3)
    gamma_dot: Array  # [rad/s], shape (n, 3)

    def at(self, rows: Integers | slice) -> _Samples:
        """Return some of the samples."""
        return _Samples(*(array[rows] for array in self))


def _true_samples(run: Recording) -> _Samples:
    """Return the samples of the true motion."""
    if run.motion is not None:
        return _Samples(run.quaternion, run.gamma, run.gamma_dot)
    unknown = np.full_like(run.gamma_dot, np.nan)
    return _Samples(run.quaternion, run.exact_gamma, unknown)


def _first_state(run: Recording) -> Array:
    """Return the state of the first sample.

    It is that of the scene where the rates of the sample are not known.
    """
    if run.motion is not None:
        return np.asarray(run.states[0])
    start = initial_state(run.scene, Geometry.of(run.scene))
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
    held = HeldTicks(ticks.start_ns[:count], ticks.end_ns[:count], drives)
    return _compare(recording, None, held, known_start=begins(recording))


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
    intervals = HeldTicks(time_ns[:-1], time_ns[1:], no_drives)
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
        first = self.samples.at(slice(0, 1))
        requested = _Samples(
            first.quaternion, np.array([start.gamma]), np.array([start.gamma_dot])
        )
        self.error[:1] = _measure(first, requested)
        self.own_error[0] = 0.0

    def enter(self, rows: Integers, reached: Array, expected_energy: float) -> None:
        """Enter samples, by their rows, at which the reference has arrived.

        `reached` has solution and second solution, shape (n, 2, 8 or 11), each with the
        work [J] since a time at which the energy was `expected_energy` [J].
        """
        solution, second_solution = np.moveaxis(reached, 1, 0)
        expected = _joints(self._model, solution)
        self.error[rows] = _measure(self.samples.at(rows), expected)
        second = _joints(self._model, second_solution)
        self.own_error[rows] = _measure(second, expected)
        if self.exact:
            energy = _energy(self._model, self._run.states[rows])
            work = solution[:, -1]
            self.energy[rows] = energy - expected_energy - work

    def last_residual(self, rows: Integers) -> float | None:
        """Return the last energy of some rows that is known [J]."""
        energy = self.energy[rows]
        finite = energy[np.isfinite(energy)]
        return float(finite[-1]) if len(finite) else None


class _Reference:
    """A reference that goes through the ticks of a run, compared at its samples.

    Under recorded torques, which may have gaps, it begins again at a sample after each
    gap, and after a tick that no step resolves. Under continuous torques no sample is
    on its motion, and it never begins again.

    Attributes:
        tick: the next tick; all others are done.
        ready: whether the state at the beginning of that tick is known.
        unresolved: number of ticks that no step resolved.
        restarts_ns: samples at which it began again.
        distances: of the run from the reference.

    """

    def __init__(
        self,
        run: Recording,
        torque: SineTorque | None,
        ticks: HeldTicks,
        *,
        known_start: bool,
    ) -> None:
        count = len(ticks.start_ns)
        self._run = run
        self._ticks = ticks
        self._stepper = TickStepper(run.scene, torque)
        self._model = self._stepper.dynamics.model
        self._state = _first_state(run)  # at the beginning of the next tick
        self.tick = 0
        self.unresolved = 0
        self.restarts_ns: list[int] = []
        self.distances = _Distances(run, self._model)
        # Of the energy, at the last sample where it is known [J]; a reference that
        # begins again goes on from it.
        self._residual = 0.0
        self._expected_energy = 0.0  # at the beginning of the next tick [J]
        known_start = known_start and bool(count and np.isfinite(self._state[0]))
        if known_start:
            self.distances.enter_start()
        self.ready = bool(known_start and ticks.start_ns[0] == 0)
        if self.ready:
            self.distances.energy[0] = 0.0 if self.distances.exact else np.nan
            self._expected_energy = self._energy_of(self._state)
        self._sample = places(run.time_ns, ticks.start_ns)  # of each tick; -1 for none
        # Ticks at which the reference can begin again.
        x_of_samples = self.distances.samples.quaternion[self._sample, 0]
        has_sample = (self._sample >= 0) & np.isfinite(x_of_samples)
        can_restart = torque is None and self.distances.exact
        self._usable = np.flatnonzero(has_sample & can_restart)
        # Ticks before which torques are lost, and the end.
        has_gap = ticks.start_ns[1:] != ticks.end_ns[:-1]
        self._lost_before = np.append(not self.ready, has_gap)[:count]
        self._stops = np.append(np.flatnonzero(self._lost_before), count)

    def restart(self) -> bool:
        """Begin again at the next sample where that is possible; else return False."""
        later = self._usable[np.searchsorted(self._usable, self.tick) :]
        if not len(later):
            return False
        restart = int(later[0])
        if self._lost_before[self.tick : restart + 1].any():
            self.restarts_ns.append(int(self._ticks.start_ns[restart]))
        sample = self._sample[restart]
        self.tick = restart
        self._state = self._run.states[sample]
        self.distances.energy[sample] = self._residual
        self._expected_energy = self._energy_of(self._state) - self._residual
        return True

    def advance(self) -> None:
        """Go through at most CHUNK ticks, and to the next gap."""
        begin = self.tick
        next_stop = int(self._stops[np.searchsorted(self._stops, begin, side="right")])
        end = min(next_stop, begin + CHUNK)
        reached = self._stepper.follow(self._ticks.part(begin, end), self._state)
        self.tick = begin + len(reached)
        rows = places(self._run.time_ns, self._ticks.end_ns[begin : self.tick])
        at_sample = rows >= 0
        self.distances.enter(rows[at_sample], reached[at_sample], self._expected_energy)
        residual = self.distances.last_residual(rows[at_sample])
        if residual is not None:
            self._residual = residual
        self.ready = self.tick == end and self.tick not in self._stops
        if self.ready:
            end_of_tick = reached[-1, 0]  # state and work
            self._state = end_of_tick[:-1]
            self._expected_energy += end_of_tick[-1]
        elif self.tick < end:  # no step resolves this tick
            self.unresolved += 1
            self.tick += 1

    def _energy_of(self, state: Array) -> float:
        return float(_energy(self._model, state[None])[0])


def _compare(
    run: Recording, torque: SineTorque | None, ticks: HeldTicks, *, known_start: bool
) -> Comparison:
    """Propagate a run with a second solution, and compare both at its samples."""
    count = len(ticks.start_ns)
    reference = _Reference(run, torque, ticks, known_start=known_start)
    bar = Bar("reference", count > CHUNK)
    while reference.tick < count and reference.unresolved < UNRESOLVED:
        if not reference.ready and not reference.restart():
            break
        reference.advance()
        bar.draw(reference.tick / count)
    columns = [*COMPARED_UNITS]
    distances = reference.distances
    return Comparison(
        error=pd.DataFrame(distances.error, columns=columns),
        own=pd.DataFrame(distances.own_error, columns=columns),
        energy=distances.energy,
        restarts_ns=tuple(reference.restarts_ns),
        steps=-(-run.ticks.period_ns // LONGEST_TICK_NS),  # rounded up
    )


def _joints(model: kernel.Model, states: Array) -> _Samples:
    """Return unit quaternions and joints of states, shape (n, 7 or more)."""
    quaternion = states[:, QUATERNION]
    joints = kernel.joints(model, tuple(states.T))
    return _Samples(
        quaternion / np.linalg.norm(quaternion, axis=1)[:, None],
        np.stack(joints.gamma, axis=1),
        np.stack(joints.gamma_dot, axis=1),
    )


def _energy(model: kernel.Model, states: Array) -> Array:
    """Kinetic and potential energy [J] of states, shape (n,)."""
    columns = tuple(states.T)
    kinetic = kernel.kinetic_energy(model, columns)
    return np.asarray(kinetic + kernel.potential_energy(model, columns))


def _measure(motion: _Samples, reference: _Samples) -> Array:
    """Return distances of gamma, gamma_dot and orientation, shape (n, 3).

    The columns are COMPARED_UNITS.
    """
    # Recorded angles may count whole turns, computed ones do not.
    turn = 2.0 * np.pi
    difference = motion.gamma - reference.gamma
    angle = np.abs(difference - turn * np.round(difference / turn)).max(axis=1)
    rate = np.abs(motion.gamma_dot - reference.gamma_dot).max(axis=1)
    orientation = angle_between(motion.quaternion, reference.quaternion)
    return np.stack([angle, rate, orientation], axis=1)
