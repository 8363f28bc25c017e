# SPDX-License-Identifier: Apache-2.0
"""What was measured: angles and torques of the actuators, cut where it was lost.

Torques are samples at the times of the angles, or each is held over an interval, as a
controller's are. Angles of encoders may count whole turns or wrap; stamps may be
uneven; samples may be missing: where a few are, the motion goes on smoothly; at a
longer gap it is cut into segments.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from itertools import pairwise
from typing import TYPE_CHECKING, Any, NamedTuple, TypeAlias, Union

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from sst_ros.errors import Problem, refusal
from sst_ros.scene import torque_profile as torques
from sst_ros.scene.scene import Scene
from sst_ros.scene.schema import Rules, Section, build, entry
from sst_ros.simulation.trajectory import Trajectory
from sst_ros.state import NANOSECONDS, Array, Quaternion

if TYPE_CHECKING:
    from sst_ros.recording.recording import Recording


Known: TypeAlias = NDArray[np.bool_]
"""Whether the torque of each interval between samples is known."""

Measured: TypeAlias = Union["Recording", Trajectory, Mapping[str, Any]]

# samples to identify anything: filters and splines have transients at both ends
FEWEST = 20
GAP = 10.0  # periods without a sample from which a motion is cut
EVEN = 1e-3  # share of a period by which even samples may be off
CLOCK_STEP_NS = 1.0  # of the times of ticks [ns]
_SHOWN_GAPS = 5  # in a note
# torques that are constant from break to break
_HELD = (torques.TorqueTable, torques.ConstantTorque)


class MeasuredMotion(Section):
    """Samples of the actuators.

    Held torques act from sample k to the next (n or n - 1 rows).
    """

    ORIGIN = "identify"

    t: Array = entry("times, rising", "s")
    gamma: Array = entry("angles", "rad", shape=(3,))
    torque: Array = entry(
        "torques at the joints: at the samples, or means over the intervals between"
        " them where they are held",
        "N m",
        shape=(3,),
    )
    gamma_dot: Array | None = entry("measured rates", "rad/s", shape=(3,))
    quaternion: Quaternion | None = entry(
        "orientation (x, y, z, w) of {E} in {B} at the first sample, to select the"
        " assembly mode; by default the admissible one",
        "1",
    )
    mu: Array | None = entry(
        "measured angles of the carriages, checked alone", "rad", shape=(3,)
    )
    beta: Array | None = entry(
        "measured angles of the star, checked alone", "rad", shape=(3,)
    )
    held: bool = entry("whether torques are held over the intervals", default=False)

    def settle(self) -> Iterator[Problem]:
        """Leave out the torque that is held from the last sample on."""
        if self.held and len(self.torque) == len(self.t):
            vars(self).update(torque=self.torque[:-1])
        return super().settle()

    def rules(self) -> Rules:
        """Refuse times that do not rise, few samples, and other numbers of rows."""
        n = len(self.t)
        rising = torques.ascend(self.t)
        yield not rising, "t", self.t, "must be rising times [s], shape (n,)"
        yield n < FEWEST, "t", n, f"must be {FEWEST} samples or more"
        rows = {"gamma": n, "torque": n - self.held, "gamma_dot": n, "mu": n, "beta": n}
        for name, count in rows.items():
            array = getattr(self, name)
            wrong = array is not None and len(array) != count
            yield wrong, name, np.shape(array), f"must have the shape {count, 3}"


class Segments(NamedTuple):
    """A measured motion in parts, over each of which angles and torques are known."""

    motion: MeasuredMotion  # the whole
    parts: tuple[MeasuredMotion, ...]
    notes: tuple[str, ...]  # what was done to the data


def read_motion(data: Measured) -> MeasuredMotion:
    """Read a motion from a recording, a trajectory, or arrays; see `identify`.

    Raises InputError where it is none.
    """
    return _read(data).motion


def read_segments(data: Measured) -> Segments:
    """Read a motion as `read_motion`, cut where samples or torques are lost."""
    motion, is_known, notes = _read(data)
    spacing = np.diff(motion.t)
    cuts = np.flatnonzero((spacing > GAP * np.median(spacing)) | ~is_known)
    bounds = [0, *(cuts + 1).tolist(), len(motion.t)]
    spans = [(first, end) for first, end in pairwise(bounds) if end - first >= FEWEST]
    if len(cuts):
        times = (motion.t[cuts] - motion.t[0]).tolist()
        lost = ", ".join(f"{t:g} s" for t in times[:_SHOWN_GAPS])
        ellipsis = ", ..." if len(times) > _SHOWN_GAPS else ""
        text = (
            f"samples or torques are lost after {lost}{ellipsis}: {len(spans)} segments"
            " are fitted"
        )
        notes = (*notes, text)
    if not spans:
        requirement = f"must have {FEWEST} samples or more without a gap"
        raise refusal("identify", "t", len(motion.t), requirement)
    parts = tuple(_cut(motion, first, end) for first, end in spans)
    return Segments(motion, parts, notes)


def resample(motion: MeasuredMotion) -> tuple[MeasuredMotion, str]:
    """Return the motion at even times, without rates, and a note of it.

    Samples that are even already stay as they are, and the note is empty. Angles, and
    torques that are not held, are interpolated by a cubic spline; held torques are
    averaged.
    """
    t = motion.t - motion.t[0]  # seconds since an epoch have few digits left
    spacing = np.diff(t)
    period = float(np.median(spacing))
    rounding = 2.0 * np.spacing(motion.t[-1])
    if np.abs(spacing - period).max() <= EVEN * period + rounding:
        return replace(motion, t=np.linspace(0.0, t[-1], len(t)), gamma_dot=None), ""
    count = int(t[-1] / period * (1.0 + 1e-12)) + 1  # to the last sample, to rounding
    even: Array = period * np.arange(count, dtype=float)
    gamma = CubicSpline(t, motion.gamma)(even)
    if motion.held:
        torque = _average(torques.TorqueTable(t[:-1], motion.torque), even)
    else:
        torque = CubicSpline(t, motion.torque)(even)
    passive: dict[str, Any] = dict.fromkeys(("mu", "beta", "gamma_dot"))
    note = (
        f"stamps are uneven, {spacing.min():.3g} to {spacing.max():.3g} s apart: the"
        f" motion is sampled again each {period:.3g} s"
    )
    return replace(motion, t=even, gamma=gamma, torque=torque, **passive), note


class _Reading(NamedTuple):
    motion: MeasuredMotion
    is_known: Known
    notes: tuple[str, ...]  # what was unwrapped


def _read(data: Measured) -> _Reading:
    """Read a motion, with angles whose whole turns are taken out."""
    arrays: dict[str, Any]
    is_known: Known | None = None
    if isinstance(data, Mapping):
        arrays = dict(data)
    else:
        arrays, is_known = _take_samples(data)
    arrays = {name: value for name, value in arrays.items() if value is not None}
    motion = build(MeasuredMotion, arrays, "identify")
    if is_known is None:
        is_known = np.full(len(motion.t) - 1, True)
    wraps = np.argwhere(np.abs(np.diff(motion.gamma, axis=0)) > np.pi)
    if not len(wraps):
        return _Reading(motion, is_known, ())
    row, leg = wraps[0].tolist()
    step = float(motion.gamma[row + 1, leg] - motion.gamma[row, leg])
    note = (
        f"angles wrap {len(wraps)} times, gamma_{leg + 1} first by {step:+.3f} rad at"
        f" row {row + 1}: whole turns are taken out"
    )
    unwrapped = replace(motion, gamma=np.unwrap(motion.gamma, axis=0))
    return _Reading(unwrapped, is_known, (note,))


def _cut(motion: MeasuredMotion, first: int, end: int) -> MeasuredMotion:
    """Return the samples from the first up to the end, and the torques between them."""
    changed: dict[str, Any] = {"torque": motion.torque[first : end - motion.held]}
    for name in ("t", "gamma", "gamma_dot", "mu", "beta"):
        array = getattr(motion, name)
        if array is not None:
            changed[name] = array[first:end]
    if first > 0:  # the orientation is that of the first sample
        changed["quaternion"] = None
    return replace(motion, **changed)


def _take_samples(data: Recording | Trajectory) -> tuple[dict[str, Any], Known]:
    """Take a simulated motion, or what was measured in a recorded run.

    Of a run, samples count while it has torques. Returned is also whether the torque of
    each interval is known. Rates of a run count only where they are those of its
    motion: what was measured has noise, and its rates more than its angles.
    """
    if isinstance(data, Trajectory):
        return _take_simulated(data)
    if hasattr(data, "measured"):
        return _take_measured(data)
    requirement = (
        "must be a recording or its path, a Trajectory, or a mapping of arrays"
    )
    raise refusal("identify", "data", data, requirement)


def _take_simulated(motion: Trajectory) -> tuple[dict[str, Any], Known]:
    """Take a simulated motion, whose torques are not known in its gaps."""
    t = motion.t
    law = motion.law
    torque = motion.torque
    # With a lag the torques at the joints are behind those of the law: they are
    # samples.
    held = not motion.scene.lags and (law is None or isinstance(law, _HELD))
    if held and law is None:  # held to their sample, see `Trajectory`
        torque = torque[1:]
    elif held and law is not None:
        torque = _average(law, t)
    gap_begins, gap_ends = motion.gaps.T
    overlaps = (t[:-1, None] < gap_ends) & (t[1:, None] > gap_begins)
    is_lost: Known = np.any(overlaps, axis=1)
    samples = {
        "t": t,
        "gamma": np.unwrap(motion.gamma, axis=0),
        "gamma_dot": motion.gamma_dot,
        "torque": torque,
        "quaternion": next(iter(motion.quaternion), None),
        "held": held,
    }
    return samples, ~is_lost


def _take_measured(run: Recording) -> tuple[dict[str, Any], Known]:
    """Take what was measured in a recorded run, while its torques are known."""
    signals: dict[str, Array]
    if run.motion is run.measured:
        motion = run.trajectory  # without samples that have no orientation
        quaternions = motion.quaternion
        signals = {
            "t": motion.t,
            "gamma": motion.gamma,
            "gamma_dot": motion.gamma_dot,
            "torque": motion.torque,
        }
    else:
        sensed = run.measured
        quaternions = run.quaternion[np.searchsorted(run.time_ns[:-1], sensed.time_ns)]
        signals = {
            "t": sensed.time_ns / NANOSECONDS,
            "gamma": sensed.gamma,
            "torque": sensed.effort,
            "mu": sensed.mu,
            "beta": sensed.beta,
        }
    ticks = run.ticks
    begins = ticks.start_ns / NANOSECONDS
    ends = ticks.end_ns / NANOSECONDS
    all_times = signals["t"]
    # while torques are known, to the rounding of seconds
    rows = (all_times >= begins[0] - 1e-12) & (all_times <= ends[-1] + 1e-12)
    samples: dict[str, Any] = {name: array[rows] for name, array in signals.items()}
    t = samples["t"]
    held = not run.scene.lags
    if held:
        samples["torque"] = _average(torques.TorqueTable(begins, ticks.torque), t)
    samples["held"] = held
    samples["gamma"] = np.unwrap(samples["gamma"], axis=0)
    first_quaternion = next(iter(quaternions[rows]), None)
    if first_quaternion is not None and np.isfinite(first_quaternion).all():
        samples["quaternion"] = first_quaternion
    times_ns = t * NANOSECONDS
    return samples, ticks.known_between(times_ns) > np.diff(times_ns) - CLOCK_STEP_NS


def _average(law: torques.TorqueProfile, t: Array) -> Array:
    """Return means of a torque over the intervals of t, (n - 1, 3).

    The torque is constant between its breaks.
    """
    if len(t) < 2:
        return np.empty((0, 3))
    breaks = law.kinks()
    edges = np.union1d(t, breaks[(breaks > t[0]) & (breaks < t[-1])])
    middles = 0.5 * (edges[1:] + edges[:-1])
    areas = law.values(middles) * np.diff(edges)[:, None]
    # Sums over one interval each: a difference of long sums would lose digits.
    total = np.add.reduceat(areas, np.searchsorted(edges, t[:-1]), axis=0)
    return np.asarray(total / np.diff(t)[:, None])


def take_angles(
    data: Measured, scene: Scene
) -> tuple[torques.TorqueProfile, Array, Array]:
    """Take the torques that move a scene, times, and measured gamma.

    Times are from 0 on [s], shape (n,), gamma has the shape (n, 3).
    """
    measured = read_motion(data)
    t = measured.t - measured.t[0]
    # a recording: torques before the lag, which the model has
    if hasattr(data, "ticks"):
        begins = np.round(data.ticks.start_ns / NANOSECONDS - measured.t[0], 9)
        return torques.TorqueTable(begins, data.ticks.torque), t, measured.gamma
    # A simulated motion as well, while its torques are known: not of the state, and not
    # lost.
    if isinstance(data, Trajectory) and data.law is not None and data.t[0] == 0.0:
        law = data.law
        values = law.values(t)
        if data.scene.lags <= scene.lags and np.isfinite(values).all():
            limit = data.scene.torque_limit or np.inf
            same_limit = limit == (scene.torque_limit or np.inf)
            if same_limit or np.abs(values).max() <= limit:
                return law, t, measured.gamma
            # cut off by a limit that the model has not
            held = isinstance(law, _HELD)
            requested = _average(law, t) if held else values
            acted = np.clip(requested, -limit, limit)
            measured = replace(measured, torque=acted, held=held)
    if measured.held:
        return torques.TorqueTable(t[:-1], measured.torque), t, measured.gamma
    spline = CubicSpline(t, measured.torque)
    return torques.PolynomialTorque(spline.c, spline.x), t, measured.gamma
