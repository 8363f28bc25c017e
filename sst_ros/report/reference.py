# SPDX-License-Identifier: Apache-2.0
"""Integration error of a recorded run: its states against a reference integrated anew.

The reference is propagated by DOP853 with a tight tolerance, a step a tick or more. Its distance
from a second solution by steps of half the length is its own error. Long runs are compiled; without
numba only their first minute or so is compared, and the reasons that are returned say so.

Actuators that lag are part of the state, and torques are held to the scene's limit. A moment from a
topic must be recorded; without it there is nothing to compare with.

At recorded states the kernel is checked against the paper's equations. What is compared is the
mechanism of the paper: loads that a scene may have beside it are left out on both sides.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple, TypeAlias

import numpy as np
import pandas as pd

from sst_ros.dynamics import kernel
from sst_ros.dynamics.initial_state import accelerate_by_paper, initial_state
from sst_ros.errors import SingularConfiguration
from sst_ros.host.compiled_module import numba_version
from sst_ros.host.output import slices
from sst_ros.integration.adaptive_stepper import CannotStep, EvaluationBudget
from sst_ros.integration.methods import DOP853
from sst_ros.integration.propagator import LimitReached, Propagator
from sst_ros.mechanism import virtual_work
from sst_ros.mechanism.geometry import Array, Geometry, angle_between
from sst_ros.mechanism.rates import body_rates
from sst_ros.recording.recording import Recording
from sst_ros.recording.topic_tables import Integers, places
from sst_ros.scene.scene import Scene
from sst_ros.scene.torque_profile import SineTorque
from sst_ros.state import NANOSECONDS

if TYPE_CHECKING:
    from pandas import DataFrame

Held: TypeAlias = tuple[Integers, Integers, Array]
"""Ticks: when each begins and ends, from the start of the run on [ns], shape (m,), and what is held
over it: torques, and a moment on the star in {B} where the scene takes one [N m], (m, 3 or 6)."""

LONGEST_TICK_NS = 1_000_000  # longer ticks are divided [ns]
TICK_TOLERANCE = 1e-13  # largest local error estimate of a step
TICK_BUDGET = 3600  # evaluations that a tick may take on average: a hundred steps
UNRESOLVED = 100  # so many ticks may take more: then the scene is too stiff, and tries take long
COMPILED_FROM = 10_000  # from this number of ticks on compilation costs less than it saves
PLAIN_TICKS = 60_000  # so many are compared in plain Python, a minute's work
CHUNK = 25_000  # so many ticks at a time, which bounds the memory
SAME_START = 1e-9
"""Largest difference [rad], [rad/s] between a first sample and the start that its scene asks for,
where samples are lost and the first one may belong to a later time."""


class TickPropagator(Propagator):
    """Propagates a scene by DOP853 through ticks, all of one call in compiled code.

    Limits of the scene do not end the motion. Torques over time are within the limit of the
    actuators; without them they are those of each tick.
    """

    def __init__(self, scene: Scene, torque: SineTorque | None, *, compiled: bool) -> None:
        self.compiled, self._sine = compiled and numba_version() is not None, torque
        super().__init__(
            scene, DOP853.name, TICK_TOLERANCE, compiled=self.compiled,
            budget=EvaluationBudget(TICK_BUDGET), limits=False,
        )  # fmt: skip

    def follow(self, ticks: Held, starts: Array, again: Array | None = None) -> Array:
        """Propagate through m ticks.

        They begin at the states `starts` (quaternion, body rate, lagged torques), shape
        (m, 7 or 10); NaN where a tick goes on from the one before, and before the first. After one
        that no step resolves, the next of `starts` or of the states `again` is begun at. Returns
        solution and second solution at the end of each tick, with the work since the start [J],
        shape (m, 2, 8 or 11); NaN from a tick that is not resolved to the next state.
        """
        start_ns, end_ns, drives = ticks
        parts = np.maximum(1, -(-(end_ns - start_ns) // LONGEST_TICK_NS))
        first = np.cumsum(parts) - parts
        length = np.repeat((end_ns - start_ns) / NANOSECONDS / parts, parts)
        begin = np.repeat(start_ns / NANOSECONDS, parts)
        begin += length * (np.arange(len(length)) - np.repeat(first, parts))
        begins, known = np.full((2, len(length), len(self.ode.state)), np.nan)
        begins[first] = np.hstack([starts, 0.0 * starts[:, :1]])
        if again is not None:
            known[first] = np.hstack([again, 0.0 * again[:, :1]])
        known = np.where(np.isfinite(begins), begins, known)
        if self._sine is not None:  # phases of sines, or torques within the limit
            held = np.fmod(np.outer(begin, self._sine.frequency) + self._sine.phase, 2.0 * np.pi)
        else:
            held = np.repeat(drives, parts, axis=0)
            limit = np.inf if self.torque.limit is None else self.torque.limit
            held[:, :3] = np.clip(held[:, :3], -limit, limit)
        reached: Any = np.full((len(length), 2, len(self.ode.state)), np.nan)
        given: Any = (length, held, begins)
        if not self.compiled:
            reached, given = reached.tolist(), tuple(array.tolist() for array in given)
        stepper, _ = self._begin_period(self._sine or (0.0, 0.0, 0.0), 0.0, ())
        left = iter([*np.flatnonzero(np.isfinite(known[:, 0])).tolist(), len(length)])
        k, failed = next(left), 0
        at = stepper.begin(known[k % len(length), :-1].tolist())
        while k < len(length):
            k, at = stepper.step_through(k, len(length), given, at, len(length) - k, reached)
            if k == len(length):
                break
            torque = self._sine or (float(held[k, 0]), float(held[k, 1]), float(held[k, 2]))
            moment = tuple(held[k, 3:].tolist())
            try:
                at, _ = self.advance(at, float(begin[k]), float(length[k]), 1, torque, moment)
                reached[k][0][:], reached[k][1][:] = at.y, at.z
                k += 1
            except (LimitReached, CannotStep, ArithmeticError, ValueError):
                failed += 1
                k = next(n for n in left if n > k) if failed < UNRESOLVED else len(length)
                at = stepper.begin(known[k % len(length), :-1].tolist())
        return np.asarray(np.asarray(reached)[first + parts - 1])


def held_torques(recording: Recording) -> Held | None:
    """Return the recorded ticks; None where the moment came from a topic and is not recorded."""
    ticks, moment = recording.ticks, recording.scene.moment
    drives = [ticks.torque]
    if moment is not None and moment.topic:
        if ticks.moment is None:
            return None
        drives.append(ticks.moment)
    return ticks.start_ns, ticks.end_ns, np.hstack(drives)


def initial(scene: Scene) -> tuple[float, ...]:
    """State at t = 0 by the paper's kinematics: quaternion, W in {E} [rad/s], lagged torques.

    Raises AssemblyError where the initial gamma has no unique admissible assembly.
    """
    return (*initial_state(scene, Geometry.of(scene)), *(0.0,) * (scene.lags * 3))


def of_samples(recording: Recording, samples: slice | Integers) -> Array:
    """States at samples, shape (n, 7 or 10); nan where the orientation was lost.

    Torques that lag are the efforts.
    """
    quaternion = recording.quaternion[samples]
    rates = (recording.gamma_dot, recording.mu_dot, recording.beta_dot)
    rate = body_rates(
        Geometry.of(recording.scene), quaternion, *(joint[samples] for joint in rates)
    )
    lagged = [recording.effort[samples]] if recording.scene.lags else []
    return np.hstack([quaternion, rate, *lagged])


def begins(recording: Recording) -> bool:
    """Return whether the first sample is that of the start of the run.

    Only a recording that lost samples is doubted: where all are there, a first sample that is not
    what the scene asks for is an error of the simulator, and must be seen as one.
    """
    if recording.time_ns[0] != 0 or recording.diagnostics.get("states_set", "0") != "0":
        return False
    if recording.diagnostics.get("samples_published") == str(len(recording.time_ns)):
        return True
    start = recording.scene.initial
    off = np.abs(recording.gamma[0] - start.gamma), np.abs(recording.gamma_dot[0] - start.gamma_dot)
    return bool(np.max(off) < SAME_START)


def joint_columns(model: kernel.Model, states: Array) -> Array:
    """Nine angles [rad] and nine rates [rad/s], as in `kernel.Joints`, of states, shape (n, 18).

    Rows of nan stay nan.
    """
    with np.errstate(all="ignore"):
        found = kernel.joints(model, tuple(states[:, :7].T))
    return np.stack([column for triple in found for column in triple], axis=1)


PAPER = ("name", "description", "base", "star", "actuated_links", "intermediate_links", "initial")
"""Sections of a scene that the paper has."""


def compare_with_paper(
    scene: Scene, given: Iterable[tuple[Array, Sequence[float]]]
) -> tuple[float | None, int]:
    """Compare W_dot at states (seven numbers or more) under torques [N m]; loads are left out.

    Returns the largest difference as a part of the largest W_dot of all states, None where no state
    could be compared, and the number of those that were: without those at a singularity of J2.
    """
    bare = Scene(**{name: getattr(scene, name) for name in PAPER})
    mechanism, model = virtual_work.Mechanism.of(bare), kernel.model_of(bare)
    differences, sizes = [], []
    for y, (first, second, third) in given:
        state = tuple(y[:7].tolist())
        try:
            paper, _ = accelerate_by_paper(mechanism, state, (first, second, third))
        except (SingularConfiguration, np.linalg.LinAlgError):
            continue
        ours = np.array(kernel.derivative(model, state, (first, second, third))[4:7])
        differences.append(float(np.linalg.norm(ours - paper)))
        sizes.append(float(np.linalg.norm(paper)))
    return (max(differences) / (max(sizes) or 1.0) if sizes else None), len(sizes)


def check_with_paper(recording: Recording) -> tuple[float | None, int]:
    """Compare at twenty samples spread over the run, under the torques recorded there."""
    whole = np.flatnonzero(np.isfinite(recording.quaternion).all(axis=1))
    chosen = np.unique(np.linspace(0, len(whole) - 1, 20).round().astype(int))
    samples = whole[chosen] if len(whole) else whole
    # The torque that acts, lagged or not.
    acting = recording.effort[samples].tolist()
    given = zip(of_samples(recording, samples), acting, strict=True)
    return compare_with_paper(recording.scene, given)


QUANTITIES = {"gamma": "rad", "gamma_dot": "rad_per_s", "orientation": "rad"}
"""What is compared, and its unit in names."""


class Comparison(NamedTuple):
    """A recording against a reference."""

    error: DataFrame
    """Distance of the recording from the reference, a row a sample, nan where there is none: gamma
    and gamma_dot, the largest difference of the actuator angles [rad] and rates [rad/s];
    orientation, the angle between the orientations of {E} [rad]."""
    own: DataFrame  # the reference's own error, in the same columns
    restarts_ns: tuple[int, ...] = ()  # where torques were lost: it begins at a sample again [ns]
    steps: int = 0  # least number of steps a tick of the reference
    reasons: tuple[str, ...] = ()  # why samples are not compared, but for lost torques

    @property
    def compared(self) -> int:
        """Number of samples that were compared."""
        return int(self.error.gamma.count())


def integration(recording: Recording) -> Comparison:
    """Compare with the exact motion under the recorded torques: the error of the integrator.

    A sample from which the reference restarts is not compared, and neither are samples between
    lost torques and the next restart. Raises what `initial` does.
    """
    held = held_torques(recording)
    if held is None:
        reason = "the moment on the star came from a topic and is not recorded: nothing is compared"
        nothing = _frame(np.full((len(recording.time_ns), 3), np.nan))
        return Comparison(nothing, nothing, reasons=(reason,))
    return _compare(recording, None, held, known=begins(recording))


def ideal(recording: Recording) -> Comparison | None:
    """Compare with the motion under continuous torques: the effect of hold and transport.

    None where the scene has no torques, its moment comes from a topic, or the recording lacks the
    start of the run. Raises what `initial` does.
    """
    scene, time = recording.scene, recording.time_ns
    pushed = scene.moment is not None and scene.moment.topic
    if scene.torque is None or pushed or not begins(recording):
        return None
    held = time[:-1], time[1:], np.empty((len(time) - 1, 0))
    return _compare(recording, scene.torque, held, known=True)


def _compare(
    recording: Recording, torque: SineTorque | None, held: Held, *, known: bool
) -> Comparison:
    """Propagate a run with a second solution, and compare both at its samples.

    The state at time zero is `known` or not. Under recorded torques, which may have gaps, the
    reference begins again at a sample after each.
    """
    start_ns, end_ns, drives = held
    motion, until_ns, reason = _begin(recording, torque)
    count = int(np.searchsorted(end_ns, until_ns, side="right"))
    samples = recording.quaternion, recording.gamma, recording.gamma_dot
    distances = np.full((2, len(recording.time_ns), 3), np.nan)

    def note(rows: Integers, reached: Array) -> None:
        """Write down how far samples are from the solution, and the second one, (n, 2, m)."""
        found = []
        for states in (reached[:, 0], reached[:, 1]):
            unit = states[:, :4] / np.linalg.norm(states[:, :4], axis=1)[:, None]
            joints = joint_columns(motion.dynamics.model, states)
            found.append((unit, joints[:, :3], joints[:, 9:12]))
        first, second = found
        distances[0, rows] = _measure([values[rows] for values in samples], first)
        distances[1, rows] = _measure(second, first)

    unknown: Array = np.full(len(motion.ode.state) - 1, np.nan)
    state = np.array(initial(recording.scene)) if known else unknown
    if known:
        note(np.array([0]), np.stack([state, state])[None])
    known = known and start_ns[0] == 0
    # Where ticks are lost, those up to the next sample are left out.
    sample = places(recording.time_ns, start_ns)
    sample[~np.isfinite(recording.quaternion[sample, 0])] = -1  # as where there is none
    if torque is not None:
        sample[:] = -1  # no sample is on the motion under continuous torques
    usable = np.flatnonzero(sample >= 0)
    gaps = np.flatnonzero(np.append(not known, start_ns[1:] != end_ns[:-1])[:count])
    after = np.append(usable, count)[np.searchsorted(usable, gaps)].clip(max=count)
    kept = np.ones(count, dtype=bool)
    for gap, end in zip(gaps, after, strict=True):
        kept[gap:end] = False
    begun_ns = start_ns[np.unique(after[after < count])]
    start_ns, end_ns, drives = start_ns[:count][kept], end_ns[:count][kept], drives[:count][kept]
    sample = sample[:count][kept]
    state = state if known else unknown
    for part in slices(len(start_ns), CHUNK, "reference", len(start_ns) > CHUNK):
        again = of_samples(recording, sample[part])
        again[sample[part] < 0] = np.nan
        starts, begun = np.full_like(again, np.nan), np.isin(start_ns[part], begun_ns)
        starts[0], starts[begun] = state, again[begun]
        ticks = start_ns[part], end_ns[part], drives[part]
        reached = motion.follow(ticks, starts, again)[..., :-1]
        rows = places(recording.time_ns, end_ns[part])
        found = (rows >= 0) & np.isfinite(reached[:, 0, 0])  # nan where no step resolves a tick
        note(rows[found], reached[found])
        state = reached[-1, 0]
    distances[0, np.isin(recording.time_ns, begun_ns)] = np.nan
    error, own = map(_frame, distances)
    steps = -(-recording.ticks.period_ns // LONGEST_TICK_NS)
    return Comparison(error, own, tuple(begun_ns.tolist()), steps, (reason,) if reason else ())


def _begin(recording: Recording, torque: SineTorque | None) -> tuple[TickPropagator, int, str]:
    """Return what propagates a run, up to when [ns], and the reason why not to its end, or ""."""
    ends_ns = recording.ticks.end_ns
    motion = TickPropagator(recording.scene, torque, compiled=len(ends_ns) > COMPILED_FROM)
    if motion.compiled or len(ends_ns) <= PLAIN_TICKS:
        return motion, max(int(ends_ns[-1]), int(recording.time_ns[-1])), ""
    until_ns = int(ends_ns[PLAIN_TICKS - 1])
    until = until_ns / NANOSECONDS
    return motion, until_ns, f"only the first {until:g} s are compared: there is no numba for more"


def _frame(distances: Array) -> DataFrame:
    return pd.DataFrame(distances, columns=[*QUANTITIES])


def _measure(one: Sequence[Array], other: Sequence[Array]) -> Array:
    """Distances of quaternions, gamma and gamma_dot, in the columns QUANTITIES, shape (n, 3)."""
    # Recorded angles may count whole turns, computed ones do not.
    turn, difference = 2.0 * np.pi, one[1] - other[1]
    gamma = np.abs(difference - turn * np.round(difference / turn)).max(axis=1)
    rate = np.abs(one[2] - other[2]).max(axis=1)
    return np.stack([gamma, rate, angle_between(one[0], other[0])], axis=1)


def energy_residual(recording: Recording) -> tuple[Array, str]:
    """Return the balance of energy: what the samples have, less the work put in between.

    It is the residual since the start [J], shape (n,), nan where it is not known; where ticks are
    lost, it goes on without them. Beside it is the reason why it ends or is not there, or "".
    """
    time, held = recording.time_ns, held_torques(recording)
    stored, work = np.full((2, len(time)), np.nan)
    if held is None:
        return stored, "the moment on the star is not recorded: no energy residual"
    motion, until_ns, reason = _begin(recording, None)
    model, count = motion.dynamics.model, int(np.searchsorted(time, until_ns, side="right"))
    for part in slices(count, CHUNK, "energy", shown=False):
        rows = slice(part.start, min(part.stop + 1, count))
        state = of_samples(recording, rows)
        columns = tuple(state.T)
        kinetic = kernel.kinetic_energy(model, columns)
        stored[rows] = kinetic + kernel.potential_energy(model, columns)
        work[rows.start : rows.stop - 1] = _work(motion, held, state, time[rows])
    change = np.diff(stored, prepend=stored[0]) - np.append(0.0, work[:-1])
    change[~np.isfinite(change)] = 0.0
    return np.where(np.isfinite(stored), np.cumsum(change), np.nan), reason


def _work(motion: TickPropagator, held: Held, state: Array, time: Integers) -> Array:
    """Work from each of n samples to the next [J], shape (n - 1,); nan where something is lost."""
    some = slice(*np.searchsorted(held[0], time[[0, -1]]).tolist())
    start_ns, end_ns = held[0][some], held[1][some]
    first, last = places(start_ns, time[:-1]), places(end_ns, time[1:])
    # The ticks of a sample are all there if they last as long as it is to the next.
    whole = (first >= 0) & (last >= first) & np.isfinite(state[:-1]).all(axis=1)
    passed = np.append(0, np.cumsum(end_ns - start_ns))
    whole &= passed[last + 1] - passed[first] == np.diff(time)
    if not whole.any():
        return np.full(len(whole), np.nan)
    starts = np.full((len(start_ns), state.shape[1]), np.nan)
    starts[first[whole]] = state[:-1][whole]
    reached = motion.follow((start_ns, end_ns, held[2][some]), starts)[:, 0, -1]
    return np.where(whole, reached[last], np.nan)
