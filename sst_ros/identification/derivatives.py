# SPDX-License-Identifier: Apache-2.0
"""States of the star at which the equation of motion is asked for, from measured angles.

With measured rates the motion is a Hermite spline, exact to rounding where the data are. Without,
or with a cut-off, angles pass a Butterworth filter of order 4 forwards and backwards (no phase) and
a quintic spline, whose derivatives are the rates and accelerations.

Torques that are held ask for the mean of the equation over each interval (weak form with a box as
test function). Two Gauss points take it: there the second derivative of a cubic Hermite spline is
of third order, and the errors of the pair cancel, so that the mean is of fourth order in the period
although the acceleration jumps at each sample.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sst_ros.control.actuator_space import ActuatorSpaceMap
from sst_ros.errors import AssemblyError, InputError, Problem
from sst_ros.identification.measured_motion import MeasuredMotion
from sst_ros.identification.sine_components import BAND
from sst_ros.mechanism import continuation, kinematics
from sst_ros.mechanism.frames import cross, quaternion_of, rotation_matrix
from sst_ros.mechanism.geometry import Array, Geometry
from sst_ros.mechanism.kinematics import rotate

States = tuple[Array, Array, Array]
"""Quaternions (n, 4), W (n, 3) and W_dot (n, 3) in {E}."""


class Equations(NamedTuple):
    """Where the equation of motion is asked for.

    Attributes:
        states: g m of them; those of a row of torques follow each other, and its equation is their
            mean.
        rows: of the torques that they belong to, shape (m,).
        group: g.
        band: frequency up to which the equations are sound where angles were filtered [Hz].

    """

    states: States
    rows: NDArray[np.intp]
    group: int
    band: float | None


ORDER = 4
MARGIN = 10.0
"""Default cut-off over the frequency below which the motion has all but 1e-4 of its power."""

STEP = 0.03
"""Length of gamma [rad] between poses that continuation follows; Newton's method takes the rest."""

_NEWTON_STEPS = 8
_EDGE = 8
"""Samples at both ends at which an interpolating quintic spline has not its full order."""


def equations(
    measured: MeasuredMotion, geometry: Geometry, cutoff: float | None = None
) -> Equations:
    """States and the rows of torques that belong to them.

    Args:
        measured: the motion.
        geometry: base triangle and star.
        cutoff: of the filter [Hz]; by default none where rates were measured, else MARGIN times
            the bandwidth of the motion.

    Raises:
        InputError: no assembly of the manipulator has these angles, or samples are not evenly
            spaced where they are filtered.

    """
    t = measured.t
    path, unsettled = _path(measured, cutoff)
    if measured.held:
        middle, half = 0.5 * (t[1:] + t[:-1]), 0.5 * np.diff(t) / np.sqrt(3.0)
        times = np.stack([middle - half, middle + half], axis=1)
    else:
        times = t[:, None]
    rows = np.arange(unsettled, len(times) - unsettled)
    gamma, rate, acceleration = path(times[rows].ravel())
    quaternion = orientations(geometry, gamma, measured.quaternion, measured.gamma[0])
    found = ActuatorSpaceMap(geometry).star_rates(*quaternion.T, *rate.T, *acceleration.T)
    star = np.stack(found, axis=1)
    band = None
    if cutoff is not None or measured.gamma_dot is None:
        band = min(BAND * bandwidth(float(np.median(np.diff(t))), measured.gamma), cutoff or np.inf)
    states = quaternion, star[:, :3], star[:, 3:]
    return Equations(states, rows, int(times.shape[1]), band)


def orientations(geometry: Geometry, gamma: Array, quaternion: Array | None, first: Array) -> Array:
    """Quaternions (n, 4) of the assembly mode at gamma (n, 3) that has `quaternion` at `first`.

    Raises:
        InputError: the angles are not those of this manipulator.

    """
    start = None if quaternion is None else rotation_matrix(quaternion)
    points = np.vstack([first, gamma])
    length = np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))
    known = np.unique(np.searchsorted(length, np.arange(0.0, length[-1] + STEP, STEP)))
    known = known[known < len(gamma)]
    try:
        coarse = continuation.follow(geometry, np.vstack([first, gamma[known]]), start).rotation
    except (AssemblyError, continuation.BranchEnds) as error:
        allowed = f"must be angles of this manipulator ({error})"
        raise InputError("identify", [Problem("gamma", first.tolist(), allowed)]) from None
    nearest = np.searchsorted(known, np.arange(len(gamma)), side="right")
    rotation, r = coarse[nearest], kinematics.carriage_directions(geometry, gamma)
    for _ in range(_NEWTON_STEPS):
        t = geometry.e @ np.swapaxes(rotation, -1, -2)
        residual = np.sum(r * t, axis=-1)
        step = np.linalg.solve(cross(t, r), -residual[..., None])[..., 0]
        rotation = rotate(rotation, step)
        if np.abs(step).max(initial=0.0) < 1e-9:  # quadratic: the next would be rounding
            break
    return np.asarray(quaternion_of(rotation))


def _path(
    measured: MeasuredMotion, cutoff: float | None
) -> tuple[Callable[[Array], tuple[Array, Array, Array]], int]:
    """Gamma and two derivatives as a function of time, and the rows to leave out at both ends."""
    from scipy.interpolate import CubicHermiteSpline, make_interp_spline

    t, gamma, rate = measured.t, measured.gamma, measured.gamma_dot
    if cutoff is None and rate is not None:
        if measured.held:
            spline = CubicHermiteSpline(t, gamma, rate)
            return (lambda at: (spline(at), spline(at, 1), spline(at, 2))), 0
        rates = make_interp_spline(t, rate, k=5)
        angles = make_interp_spline(t, gamma, k=5)
        return (lambda at: (angles(at), rates(at), rates(at, 1))), min(_EDGE, len(t) // 4)
    smooth, unsettled = filtered(t, gamma, cutoff)
    spline = make_interp_spline(t, smooth, k=5)
    return (lambda at: (spline(at), spline(at, 1), spline(at, 2))), unsettled


def filtered(t: Array, gamma: Array, cutoff: float | None) -> tuple[Array, int]:
    """Angles after a zero-phase filter, and the samples at both ends that it has not settled for.

    Raises:
        InputError: samples are not evenly spaced, or the cut-off is not below half their rate.

    """
    from scipy.signal import butter, sosfiltfilt

    spacing = np.diff(t)
    period = float(np.median(spacing))
    if np.abs(spacing - period).max() > 1e-3 * period:
        allowed = "must be evenly spaced (to 0.1 %) for angles to be filtered"
        raise InputError("identify", [Problem("t", spacing, allowed)])
    if cutoff is None:
        cutoff = min(MARGIN * bandwidth(period, gamma), 0.4 / period)
    if not 0.0 < cutoff < 0.5 / period:
        allowed = f"must be > 0 and below half the rate of samples, {0.5 / period:g} Hz"
        raise InputError("identify", [Problem("cutoff", cutoff, allowed)])
    sections = butter(ORDER, cutoff, fs=1.0 / period, output="sos")
    settled = int(np.ceil(1.0 / (cutoff * period)))
    if len(t) < 4 * settled + 10:
        allowed = f"must last {(4 * settled + 10) * period:g} s or more at {cutoff:g} Hz"
        raise InputError("identify", [Problem("t", float(t[-1] - t[0]), allowed)])
    smooth = sosfiltfilt(sections, gamma, axis=0, padlen=min(3 * settled, len(t) - 1))
    return np.asarray(smooth), settled


def bandwidth(period: float, gamma: Array) -> float:
    """Frequency [Hz] below which the angles have all but 1e-4 of the power of their changes."""
    spread = (gamma - gamma.mean(axis=0)) * np.hanning(len(gamma))[:, None]
    power = np.sum(np.abs(np.fft.rfft(spread, axis=0)) ** 2, axis=1)
    share = np.cumsum(power) / max(float(power.sum()), 1e-300)
    frequencies = np.fft.rfftfreq(len(gamma), period)
    return float(frequencies[max(int(np.searchsorted(share, 1.0 - 1e-4)), 1)])
