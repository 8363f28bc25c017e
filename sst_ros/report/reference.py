# SPDX-License-Identifier: Apache-2.0
"""Integration error of a recorded run: its states against a reference integrated anew.

The reference is propagated by DOP853 with a tight tolerance, a step a tick or more. Its distance
from a second solution by steps of half the length is its own error. Long runs are compiled; without
numba only their first minute or so is compared, and `Comparison.reasons` reports that.

Actuators that lag are part of the state, and torques are held to the scene's limit. A moment from a
topic must be recorded; without it there is nothing to compare with.

At recorded states the kernel is checked against the paper's equations. What is compared is the
mechanism of the paper: loads that a scene may have beside it are left out on both sides.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, NamedTuple, TypeAlias

import numpy as np

from sst_ros.dynamics import kernel
from sst_ros.dynamics.initial_state import accelerate_by_paper, initial_state
from sst_ros.dynamics.traced_dynamics import Dynamics
from sst_ros.errors import SingularConfiguration
from sst_ros.extras import require
from sst_ros.host.output import Bar
from sst_ros.integration.propagator import LONGEST_TICK_NS, TickPropagator, TickSequence
from sst_ros.mechanism import virtual_work
from sst_ros.mechanism.frames import angle_between
from sst_ros.mechanism.geometry import Array, Geometry
from sst_ros.mechanism.rates import body_rates
from sst_ros.recording.recording import Recording
from sst_ros.recording.topic_tables import Integers, places
from sst_ros.scene.scene import Scene
from sst_ros.state import NANOSECONDS

if TYPE_CHECKING:
    from pandas import DataFrame

Places: TypeAlias = "slice | list[int] | Integers"

COMPILED_FROM = 10_000
"""From this number of ticks on compilation costs less than it saves."""
PLAIN_TICKS = 60_000
"""So many ticks are compared in plain Python, a minute's work."""
CHUNK = 25_000
"""So many ticks at a time, which bounds the memory."""
SAME_START = 1e-9
"""Largest difference [rad], [rad/s] between a first sample and the start that its scene asks for,
where samples are lost and the first one may belong to a later time."""


def ticks_of(recording: Recording) -> TickSequence:
    """Return the recorded ticks."""
    ticks, torque = recording.ticks, recording.ticks.torque
    if Dynamics.of(recording.scene).has_moment_topic and ticks.moment is not None:
        torque = np.hstack([torque, ticks.moment])
    return TickSequence(ticks.start_ns, ticks.end_ns, torque)


def initial(scene: Scene) -> tuple[float, ...]:
    """State at t = 0, seven numbers (quaternion, W in {E} [rad/s]), by the paper's kinematics.

    Actuators that lag add three: they give no torque yet.

    Raises:
        AssemblyError: the initial gamma has no unique admissible assembly.

    """
    lagged = (0.0,) * (scene.lags * 3)
    return (*initial_state(scene, Geometry.of(scene)), *lagged)


def of_samples(geometry: Geometry, recording: Recording, samples: Places) -> Array:
    """States at samples, shape (n, 7 or 10); nan where the orientation was lost.

    Torques that lag are the efforts.
    """
    quaternion = recording.quaternion[samples]
    rates = (recording.gamma_dot, recording.mu_dot, recording.beta_dot)
    rate = body_rates(geometry, quaternion, *(joint[samples] for joint in rates))
    lagged = [recording.effort[samples]] if recording.scene.lags else []
    return np.hstack([quaternion, rate, *lagged])


def begins(recording: Recording) -> bool:
    """Return whether the first sample is that of the start of the run.

    Only a recording that lost samples is doubted: where all are there, a first sample that is not
    what the scene asks for is an error of the simulator, and must be seen as one.
    """
    if recording.time_ns[0] != 0 or recording.diagnostics.get("states_set", "0") != "0":
        return False
    published = recording.diagnostics.get("samples_published", "")
    if published.isdecimal() and int(published) == len(recording.time_ns):
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


def outputs(model: kernel.Model, states: Array) -> tuple[Array, Array, Array]:
    """Compute unit quaternions (n, 4), gamma [rad] and gamma_dot [rad/s] (n, 3) of n states."""
    quaternion = states[:, :4] / np.linalg.norm(states[:, :4], axis=1)[:, None]
    joints = joint_columns(model, states)
    return quaternion, joints[:, :3], joints[:, 9:12]


STATES = 20

PAPER = ("name", "description", "base", "star", "actuated_links", "intermediate_links", "initial")
"""Sections of a scene that the paper has."""


def compare_with_paper(
    scene: Scene, given: Iterable[tuple[Array, Sequence[float]]]
) -> tuple[float | None, int]:
    """Compare W_dot at states (seven numbers or more) under torques [N m]; loads are left out.

    Returns:
        The largest difference as a part of the largest W_dot of all states, None where no state
        could be compared; and the number of states compared, without those at a singularity of
        the paper's J2.

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
    if not sizes:
        return None, 0
    scale = max(sizes)
    return max(differences) / (scale if scale > 0.0 else 1.0), len(sizes)


def check_with_paper(recording: Recording, count: int = STATES) -> tuple[float | None, int]:
    """Compare at samples spread over the run, under the torques recorded there."""
    whole = np.flatnonzero(np.isfinite(recording.quaternion).all(axis=1))
    chosen = np.unique(np.linspace(0, len(whole) - 1, count).round().astype(int))
    samples = whole[chosen] if len(whole) else np.empty(0, dtype=int)
    states = of_samples(Geometry.of(recording.scene), recording, samples)
    # The torque that acts, lagged or not.
    acting = recording.effort[samples].tolist()
    return compare_with_paper(recording.scene, zip(states, acting, strict=True))


QUANTITIES = {"gamma": "rad", "gamma_dot": "rad_per_s", "orientation": "rad"}
"""What is compared, and its unit in names."""


class Comparison(NamedTuple):
    """A recording against a reference.

    Attributes:
        error: distance of the recording from the reference, a row a sample, nan where there is
            none: gamma and gamma_dot, the largest difference of the actuator angles [rad] and rates
            [rad/s]; orientation, the angle between the orientations of {E} [rad].
        own: the reference's own error, in the same columns.
        restarts_ns: instants at which the reference had to begin again from a recorded sample,
            because torques before it were lost [ns].
        steps: least number of steps a tick of the reference.
        reasons: why samples are not compared; empty where all are, or only torques are missing.

    """

    error: DataFrame
    own: DataFrame
    restarts_ns: tuple[int, ...] = ()
    steps: int = 0
    reasons: tuple[str, ...] = ()

    @property
    def compared(self) -> int:
        """Number of samples that were compared."""
        return int(self.error.gamma.count())


def integration(recording: Recording) -> Comparison:
    """Compare with the exact motion under the recorded torques: the error of the integrator.

    A sample from which the reference restarts is not compared, and neither are samples between
    lost torques and the next restart.

    Raises:
        AssemblyError: the scene's initial gamma has no unique admissible assembly.

    """
    moment = recording.scene.moment
    if moment is not None and moment.topic and recording.ticks.moment is None:
        reason = "the moment on the star came from a topic and is not recorded: nothing is compared"
        return Comparison(_unknown(recording), _unknown(recording), reasons=(reason,))
    start = initial(recording.scene) if begins(recording) else None
    ticks = ticks_of(recording)
    motion = TickPropagator(recording.scene, None, compiled=len(ticks.start_ns) > COMPILED_FROM)
    return _compare(recording, motion, ticks, start, restart=True)


def ideal(recording: Recording) -> Comparison | None:
    """Compare with the motion under continuous torques: the effect of hold and transport.

    None where the scene has no torques, its moment comes from a topic, or the recording lacks the
    start of the run.

    Raises:
        AssemblyError: the scene's initial gamma has no unique admissible assembly.

    """
    torque, moment = recording.scene.torque, recording.scene.moment
    if torque is None or (moment and moment.topic) or not begins(recording):
        return None
    time = recording.time_ns
    between = TickSequence(time[:-1], time[1:], np.empty((len(time) - 1, 0)))
    many = len(recording.ticks.start_ns) > COMPILED_FROM
    motion = TickPropagator(recording.scene, torque, compiled=many)
    return _compare(recording, motion, between, initial(recording.scene), restart=False)


def _compare(
    recording: Recording,
    motion: TickPropagator,
    ticks: TickSequence,
    start: tuple[float, ...] | None,
    *,
    restart: bool,
) -> Comparison:
    """Propagate a run with a second solution, and compare both at its samples.

    Args:
        recording: what is compared.
        motion: propagates it.
        ticks: what acts, tick by tick.
        start: state at time zero; None where it is not known.
        restart: begin again at a recorded sample after lost torques; else the end is there.

    """
    error, own = _unknown(recording), _unknown(recording)
    reasons, restarts, count = [], [], len(ticks.start_ns)
    tick_ns = recording.ticks.period_ns
    if not motion.compiled:
        longest = PLAIN_TICKS * tick_ns // np.median(ticks.end_ns - ticks.start_ns)
        count = min(count, int(longest))
    if count < len(ticks.start_ns):
        until = ticks.end_ns[count - 1] / NANOSECONDS
        reasons.append(f"only the first {until:g} s are compared: there is no numba for more")

    def note(rows: Integers, reached: Array) -> None:
        """Write down how far samples are from the solution, and the second one, (n, 2, m)."""
        first, second = (outputs(motion.dynamics.model, reached[:, i]) for i in range(2))
        sampled = recording.quaternion[rows], recording.gamma[rows], recording.gamma_dot[rows]
        error.iloc[rows], own.iloc[rows] = _measure(sampled, first), _measure(second, first)

    if start is not None:
        note(np.array([0]), np.array([[start, start]]))
        if ticks.start_ns[0] != 0:
            start = None
    gaps = 1 + np.flatnonzero(ticks.start_ns[1:] != ticks.end_ns[:-1])
    ends = np.append(gaps[gaps < count], count)
    bar, first = Bar("reference", count > CHUNK), 0
    while first < count:
        if start is None:
            again = _find_restart(recording, ticks, first, count) if restart else None
            if again is None:
                break
            first, start = again
            restarts.append(int(ticks.start_ns[first]))
        end = int(ends[np.searchsorted(ends, first, side="right")])
        some = ticks.part(slice(first, min(first + CHUNK, end)))
        starts = np.full((len(some.start_ns), len(start)), np.nan)
        starts[0] = start
        reached = motion.follow(some, starts)[..., :-1]
        done = int(np.isfinite(reached[:, 0, 0]).sum())
        rows = places(recording.time_ns, some.end_ns[:done])
        note(rows[rows >= 0], reached[:done][rows >= 0])
        whole = done == len(starts)  # else no step resolves the next tick
        first += done if whole else done + 1
        start = tuple(reached[-1, 0].tolist()) if whole and first < end else None
        bar.draw(min(first / count, 1.0))
    error[np.isin(recording.time_ns, restarts)] = np.nan
    steps = -(-tick_ns // LONGEST_TICK_NS)
    return Comparison(error, own, tuple(restarts), steps, tuple(reasons))


def _unknown(recording: Recording) -> DataFrame:
    """Return the errors of samples of which none is compared yet."""
    count = len(recording.time_ns)
    table: DataFrame = require("pandas").DataFrame(
        np.full((count, 3), np.nan), columns=[*QUANTITIES]
    )
    return table


def _find_restart(
    recording: Recording, ticks: TickSequence, first: int, stop: int
) -> tuple[int, tuple[float, ...]] | None:
    """Find the next tick that begins at a sample, and the state of that sample."""
    at = places(recording.time_ns, ticks.start_ns[first:stop])
    usable = np.flatnonzero((at >= 0) & np.isfinite(recording.quaternion[at, 0]))
    if not len(usable):
        return None
    tick = int(usable[0])
    state = of_samples(Geometry.of(recording.scene), recording, [int(at[tick])])[0]
    return first + tick, tuple(state.tolist())


def _measure(one: Sequence[Array], other: Sequence[Array]) -> Array:
    """Distances of quaternions, gamma and gamma_dot, in the columns QUANTITIES, shape (n, 3)."""
    # Recorded angles may count whole turns, computed ones do not.
    turn, difference = 2.0 * np.pi, one[1] - other[1]
    gamma = np.abs(difference - turn * np.round(difference / turn)).max(axis=1)
    rate = np.abs(one[2] - other[2]).max(axis=1)
    return np.stack([gamma, rate, angle_between(one[0], other[0])], axis=1)
