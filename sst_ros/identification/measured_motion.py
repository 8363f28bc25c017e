# SPDX-License-Identifier: Apache-2.0
"""What was measured: angles and torques of the actuators, cut where it was lost.

Torques are samples at the times of the angles, or each is held over an interval, as a
controller's are. Angles of encoders may count whole turns or wrap; stamps may be
uneven; samples may be missing: over some of them the motion is smooth, at more of them
it is cut into segments.
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
from sst_ros.state import Array, Quaternion

if TYPE_CHECKING:
    from sst_ros.recording.recording import Recording


Known: TypeAlias = NDArray[np.bool_]
"""Of each interval between samples whether its torque is known."""

Measured: TypeAlias = Union["Recording", Trajectory, Mapping[str, Any]]

# samples to identify anything: filters and splines have transients at both ends
FEWEST = 20
GAP = 10.0  # periods without a sample from which a motion is cut
EVEN = 1e-3  # share of a period by which even samples may be off
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
        yield (
            not torques.ascend(self.t),
            "t",
            self.t,
            "must be rising times [s], shape (n,)",
        )
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
    """Read a motion from a recording, a trajectory, or arrays, or refuse it.

    What is allowed is described in `identify`.
    """
    return _read(data)[0]


def read_segments(data: Measured) -> Segments:
    """Read a motion as `read_motion`, cut where samples or torques are lost."""
    motion, is_known, turns = _read(data)
    notes = [turns] if turns else []
    spacing = np.diff(motion.t)
    cuts = np.flatnonzero((spacing > GAP * np.median(spacing)) | ~is_known)
    bounds = [0, *(cuts + 1).tolist(), len(motion.t)]
    spans = [(a, b) for a, b in pairwise(bounds) if b - a >= FEWEST]
    if len(cuts):
        lost = ", ".join(
            f"{t:g} s" for t in (motion.t[cuts] - motion.t[0]).tolist()[:5]
        )
        ellipsis = ", ..." if len(cuts) > 5 else ""
        text = (
            f"samples or torques are lost after {lost}{ellipsis}: {len(spans)} segments"
            " are fitted"
        )
        notes.append(text)
    if not spans:
        requirement = f"must have {FEWEST} samples or more without a gap"
        raise refusal("identify", "t", len(motion.t), requirement)
    return Segments(
        motion, tuple(_cut(motion, first, end) for first, end in spans), tuple(notes)
    )


def resample(motion: MeasuredMotion) -> tuple[MeasuredMotion, str]:
    """Return the motion at even times, without rates, and a note of it.

    As it is where it is even.

    Angles, and torques that are not held, are interpolated by a cubic spline; held
    torques are averaged.
    """
    t = motion.t - motion.t[0]  # seconds since an epoch have few digits left
    spacing = np.diff(t)
    period = float(np.median(spacing))
    if np.abs(spacing - period).max() <= EVEN * period + 2.0 * np.spacing(motion.t[-1]):
        return replace(motion, t=np.linspace(0.0, t[-1], len(t)), gamma_dot=None), ""
    count = int(t[-1] / period * (1.0 + 1e-12)) + 1
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


def _read(data: Measured) -> tuple[MeasuredMotion, Known, str]:
    """Read a motion.

    Say of each interval whether its torque is known, and what was unwrapped.
    """
    arrays: dict[str, Any]
    is_known: Known | None
    if isinstance(data, Mapping):
        arrays, is_known = dict(data), None
    else:
        arrays, is_known = _take_samples(data)
    arrays = {name: value for name, value in arrays.items() if value is not None}
    motion = build(MeasuredMotion, arrays, "identify")
    if is_known is None:
        is_known = np.full(len(motion.t) - 1, True)
    jumps = np.argwhere(np.abs(np.diff(motion.gamma, axis=0)) > np.pi)
    if not len(jumps):
        return motion, is_known, ""
    row, leg = jumps[0].tolist()
    step = float(motion.gamma[row + 1, leg] - motion.gamma[row, leg])
    text = (
        f"angles wrap {len(jumps)} times, gamma_{leg + 1} first by {step:+.3f} rad at"
        f" row {row + 1}: whole turns are taken out"
    )
    return replace(motion, gamma=np.unwrap(motion.gamma, axis=0)), is_known, text


def _cut(motion: MeasuredMotion, first: int, end: int) -> MeasuredMotion:
    """Return the samples from the first up to the end, and the torques between them."""
    rows = slice(first, end)
    chosen: dict[str, Any] = {
        name: None if (array := getattr(motion, name)) is None else array[rows]
        for name in ("t", "gamma", "gamma_dot", "mu", "beta")
    }
    torque = motion.torque[first : end - motion.held]
    quaternion = motion.quaternion if first == 0 else None
    return replace(motion, **chosen, torque=torque, quaternion=quaternion)


def _take_samples(data: Recording | Trajectory) -> tuple[dict[str, Any], Known]:
    """Take a simulated motion, or what was measured in a recorded run.

    Of a run, samples count while it has torques. Returned is also whether the torque of
    each interval is known. Rates of a run count only where they are those of its
    motion: what was measured has noise, and its rates more than its angles.
    """
    if not isinstance(data, Trajectory) and hasattr(data, "measured"):
        return _take_measured(data)
    if not isinstance(data, Trajectory):
        requirement = (
            "must be a recording or its path, a Trajectory, or a mapping of arrays"
        )
        raise refusal("identify", "data", data, requirement)
    motion, law = data, data.law
    t, torque = motion.t, motion.torque
    # With a lag the torques at the joints are behind those of the law: they are
    # samples.
    held = not motion.scene.lags and (law is None or isinstance(law, _HELD))
    if held:  # without a law to their sample, see `Trajectory`
        torque = torque[1:] if law is None else _average(law, t)
    begin, end = t[:-1, None], t[1:, None]
    lost: Known = np.any(
        (begin < motion.gaps[:, 1]) & (end > motion.gaps[:, 0]), axis=1
    )
    return {
        "t": t,
        "gamma": np.unwrap(motion.gamma, axis=0),
        "gamma_dot": motion.gamma_dot,
        "torque": torque,
        "quaternion": next(iter(motion.quaternion), None),
        "held": held,
    }, ~lost


def _take_measured(run: Recording) -> tuple[dict[str, Any], Known]:
    """Take what was measured in a recorded run, while its torques are known."""
    passive: tuple[Array | None, Array | None] = (None, None)
    # samples without an orientation are none of the motion
    if run.motion is run.measured:
        motion = run.trajectory
        t, gamma, rates, effort = (
            motion.t,
            motion.gamma,
            motion.gamma_dot,
            motion.torque,
        )
        quaternions = motion.quaternion
    else:
        sensed = run.measured
        t, gamma, rates, effort = (
            sensed.time_ns / 1e9,
            sensed.gamma,
            None,
            sensed.effort,
        )
        nearest = np.searchsorted(run.time_ns[:-1], sensed.time_ns)
        passive, quaternions = (sensed.mu, sensed.beta), run.quaternion[nearest]
    ticks = run.ticks
    begins, ends = ticks.start_ns / 1e9, ticks.end_ns / 1e9
    rows = (t >= begins[0] - 1e-12) & (t <= ends[-1] + 1e-12)
    t, held = t[rows], not run.scene.lags
    torque = (
        _average(torques.TorqueTable(begins, ticks.torque), t) if held else effort[rows]
    )
    # How long torques are known from the start on, up to each sample.
    edges = np.stack([begins, ends], axis=1).ravel()
    lengths = np.stack([ends - begins, np.zeros(len(begins))], axis=1).ravel()
    so_far = np.append(0.0, np.cumsum(lengths))[:-1]
    is_known = np.diff(np.interp(t, edges, so_far)) > np.diff(t) - 1e-9
    quaternion = next(iter(quaternions[rows]), None)
    if quaternion is not None and not np.isfinite(quaternion).all():
        quaternion = None
    mu, beta = (None if angles is None else angles[rows] for angles in passive)
    return {
        "t": t,
        "gamma": np.unwrap(gamma[rows], axis=0),
        "gamma_dot": None if rates is None else rates[rows],
        "torque": torque,
        "quaternion": quaternion,
        "mu": mu,
        "beta": beta,
        "held": held,
    }, is_known


def _average(law: torques.TorqueProfile, t: Array) -> Array:
    """Return means of a torque over the intervals of t, (n - 1, 3).

    The torque is constant between its breaks.
    """
    if len(t) < 2:
        return np.empty((0, 3))
    breaks = law.kinks()
    edges = np.union1d(t, breaks[(breaks > t[0]) & (breaks < t[-1])])
    areas = law.values(0.5 * (edges[1:] + edges[:-1])) * np.diff(edges)[:, None]
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
        begins = np.round(data.ticks.start_ns / 1e9 - measured.t[0], 9)
        return torques.TorqueTable(begins, data.ticks.torque), t, measured.gamma
    # A simulated motion as well, while its torques are known: not of the state, and not
    # lost.
    if (
        isinstance(data, Trajectory)
        and data.t[0] == 0.0
        and data.scene.lags <= scene.lags
    ):
        law, limit = data.law, data.scene.torque_limit or np.inf
        if law and np.isfinite(values := law.values(t)).all():
            if limit == (scene.torque_limit or np.inf) or np.abs(values).max() <= limit:
                return law, t, measured.gamma
            held = isinstance(law, _HELD)  # cut off by a limit that the model has not
            acted = np.clip(_average(law, t) if held else values, -limit, limit)
            measured = replace(measured, torque=acted, held=held)
    if measured.held:
        return torques.TorqueTable(t[:-1], measured.torque), t, measured.gamma
    spline = CubicSpline(t, measured.torque)
    return torques.PolynomialTorque(spline.c, spline.x), t, measured.gamma
