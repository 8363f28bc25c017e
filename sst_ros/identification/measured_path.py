# SPDX-License-Identifier: Apache-2.0
"""The path of a measured motion: angles, rates and accelerations at any time.

With measured rates it is a Hermite spline, exact to rounding where the data are.
Without, or with a cut-off, angles pass a Butterworth filter of order 4 forwards and
backwards (no phase) and a quintic spline. Torques that are held ask for the mean of the
equation over each interval (weak form with a box as test function). Two Gauss points
take it: there the second derivative of a cubic Hermite spline is of third order, and
the errors of the pair cancel, so that the mean is of fourth order in the period
although the acceleration jumps at each sample.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from scipy.interpolate import CubicHermiteSpline, make_interp_spline
from scipy.signal import butter, sosfiltfilt

from sst_ros.control.actuator_space import ActuatorSpaceMap
from sst_ros.dynamics.kernel import joints, model_of
from sst_ros.errors import AssemblyError, refusal, refuse_errors, refuse_unless
from sst_ros.identification.measured_motion import MeasuredMotion, resample
from sst_ros.identification.parameters import Regressor
from sst_ros.mechanism import continuation, kinematics
from sst_ros.mechanism.geometry import Array, Geometry, quaternion_of, rotation_matrix
from sst_ros.scene.scene import Scene

_FILTER_ORDER = 4  # of the Butterworth filter
_SPLINE_DEGREE = 5  # accelerations are its second derivative, and are smooth
# Highest frequency of the sines over the bandwidth of the motion: products of rates
# double the frequencies of torques. From 2 to 5, 95 % intervals cover 0.90 to 0.99 in
# 200 long recordings; the bias of short ones grows.
BAND = 3.0
CUTOFF_MARGIN = 10.0  # default cut-off over the bandwidth of the motion
# between poses that continuation follows [rad]; Newton's method takes the rest
CONTINUATION_STEP = 0.03
# median difference [rad] of measured mu and beta from those of gamma, that is refused
APART = 0.05
# largest difference [rad] of the first angles from those of a given orientation
NEAR = 0.1
ENERGY_POSES = 100  # at which the kinetic energy is taken, about
GAUSS_POINT = 1.0 / np.sqrt(3.0)  # of the rule of two points, over half an interval
UNEVEN = 1e-3  # share of a period by which stamps of filtered angles may be off
# samples at both ends at which an interpolating quintic spline has not its full order
_EDGE = 8
# share of the power of the angles' changes that lies within their bandwidth
BANDWIDTH_POWER = 1.0 - 1e-4
# Default cut-off over the rate of samples, at most: half the rate is the limit.
HIGHEST_CUTOFF = 0.4


class PathEquations(NamedTuple):
    """torque = known + columns parameters, at m samples or of m components."""

    torque: Array  # measured [N m], shape (m, 3)
    known: Array  # of the scene without the parameters [N m], shape (m, 3)
    columns: Array  # shape (m, 3, p)


class EnergySums(NamedTuple):
    """Sums over samples of the kinetic energy, linear in the parameters."""

    known: float  # without the parameters [J]
    slopes: Array  # shape (p,)
    samples: int


class _Curves(NamedTuple):
    """Angles of the actuators and two derivatives: functions of the time [s]."""

    angle: Any
    rate: Any
    acceleration: Any


class MeasuredPath:
    """Angles, rates and accelerations along one segment, and where it is evaluated.

    Attributes:
        measured: the segment.
        times: of the equation [s], shape (m, 1 or 2): the second is of held torques.
        band: frequency [Hz] up to which they are sound; None where they are not
            filtered.
        period: usual time between samples [s].

    """

    def __init__(
        self,
        measured: MeasuredMotion,
        space: ActuatorSpaceMap,
        curves: _Curves,
        unsettled: int,
        band: float | None,
    ) -> None:
        """Take curves of angles, rates and accelerations over time.

        Unsettled are the samples at both ends that the filter or the spline has not
        settled for.
        """
        t = measured.t - measured.t[0]
        self.measured = measured
        self.times = t[:, None]
        if measured.held:
            middle = 0.5 * (t[1:] + t[:-1])
            offset = 0.5 * np.diff(t) * GAUSS_POINT
            self.times = np.stack([middle - offset, middle + offset], axis=1)
        self.band = band
        self.period = float(np.median(np.diff(t)))
        self._space = space
        self._curves = curves
        self._unsettled = unsettled
        # the angles whose orientations were found last, and these
        self._followed: tuple[Array, Array] | None = None

    @classmethod
    def of(
        cls, measured: MeasuredMotion, scene: Scene, cutoff: float | None
    ) -> tuple[MeasuredPath, str]:
        """Return the path of a segment, and a note of what was done to its samples.

        Without a `cutoff` [Hz] angles are filtered only where no rates were measured,
        at CUTOFF_MARGIN times the bandwidth of the motion. Raises InputError where the
        cut-off is not allowed, the segment is too short to be filtered, or measured mu
        and beta are not those of gamma.
        """
        rate = measured.gamma_dot
        space = ActuatorSpaceMap(Geometry.of(scene))
        _check_passive(space, measured, scene)
        if cutoff is not None or rate is None:
            measured, note = resample(measured)
            t = measured.t
            bandwidth = find_bandwidth(float(np.median(np.diff(t))), measured.gamma)
            band = min(BAND * bandwidth, cutoff or np.inf)
            smooth, unsettled = filter_angles(t, measured.gamma, cutoff)
            angle = make_interp_spline(t, smooth, k=_SPLINE_DEGREE)
            curves = _Curves(angle, angle.derivative(), angle.derivative(2))
            return cls(measured, space, curves, unsettled, band), note
        t = measured.t - measured.t[0]
        if measured.held:
            angle = CubicHermiteSpline(t, measured.gamma, rate)
            curves = _Curves(angle, angle.derivative(), angle.derivative(2))
            return cls(measured, space, curves, 0, None), ""
        angle = make_interp_spline(t, measured.gamma, k=_SPLINE_DEGREE)
        rates = make_interp_spline(t, rate, k=_SPLINE_DEGREE)
        curves = _Curves(angle, rates, rates.derivative())
        return cls(measured, space, curves, min(_EDGE, len(t) // 4), None), ""

    def count_sines(self, samples: int, least: int) -> int:
        """Return how many sines over this many samples lie within the band."""
        if self.band is None:
            raise ValueError("only a filtered path has a band")
        return max(int(np.ceil(2.0 * self.band * self.period * samples)), least)

    def evaluate(
        self, regressor: Regressor, delay: float, longest: float
    ) -> PathEquations:
        """Evaluate the equation of motion at the samples.

        Where torques are held, its means are evaluated. Angles were measured a delay
        [s] late. No delay up to the longest leaves the samples. Angles that no assembly
        has are refused.
        """
        # a whole number of periods needs no more samples for its rounding
        cut = self._unsettled + int(np.ceil(longest / self.period * (1.0 - 1e-9)))
        rows = slice(cut, max(len(self.times) - cut, cut))
        times = self.times[rows]
        requirement = f"must last longer than {2.0 * cut * self.period:g} s"
        duration = float(np.ptp(self.measured.t))
        refuse_unless("identify", ("t", duration, len(times) > 1, requirement))
        angles, rates, accelerations = self._evaluate_curves(times.ravel() + delay)
        quaternion = self._orientations(angles)
        body_rate, body_acceleration = self._star_motion(
            quaternion, rates, accelerations
        )
        known, columns = regressor(quaternion, body_rate, body_acceleration)
        return PathEquations(
            torque=self.measured.torque[rows],
            known=_mean_of_points(known, times),
            columns=_mean_of_points(columns, times),
        )

    def sum_energies(self, regressor: Regressor, delay: float) -> EnergySums:
        """Sum the kinetic energy at some of the samples.

        It is half the rates times the torques that, from rest and without gravity, give
        accelerations of the size of the rates.
        """
        step = max(len(self.times) // ENERGY_POSES, 1)
        late_times = self.times[:, 0] + delay
        inside = (late_times >= self.times[0, 0]) & (late_times <= self.times[-1, -1])
        angles, rates, _ = self._evaluate_curves(late_times[inside][::step])
        quaternion = _follow_orientations(self._space, angles, self.measured)
        zeros = np.zeros((len(angles), 3))
        _, acceleration = self._star_motion(quaternion, zeros, rates)
        accelerated_known, accelerated_columns = regressor(
            quaternion, zeros, acceleration
        )
        still_known, still_columns = regressor(quaternion, zeros, zeros)
        known = accelerated_known - still_known
        columns = accelerated_columns - still_columns
        return EnergySums(
            known=0.5 * float(np.sum(rates * known)),
            slopes=0.5 * np.einsum("nk,nkp->p", rates, columns),
            samples=len(angles),
        )

    def _evaluate_curves(self, times: Array) -> tuple[Array, Array, Array]:
        """Return angles, rates and accelerations at times [s], each shape (n, 3)."""
        curves = self._curves
        return curves.angle(times), curves.rate(times), curves.acceleration(times)

    def _star_motion(
        self, quaternion: Array, rates: Array, accelerations: Array
    ) -> tuple[Array, Array]:
        """Return W and W_dot of the star, each shape (n, 3)."""
        motion = *quaternion.T, *rates.T, *accelerations.T
        star = np.stack(self._space.star_accelerations(*motion), axis=1)
        rate, acceleration = np.split(star, 2, axis=1)
        return rate, acceleration

    def _orientations(self, gamma: Array) -> Array:
        """Quaternions (n, 4) at gamma (n, 3), which differ by a delay between calls.

        Where angles are near those of the last call, Newton's method begins at their
        orientations.
        """
        if self._followed is not None:
            last_gamma, last_quaternion = self._followed
            same_samples = last_gamma.shape == gamma.shape
            if same_samples and np.abs(gamma - last_gamma).max() <= CONTINUATION_STEP:
                return self._space.orientations(last_quaternion, gamma)
        quaternion = _follow_orientations(self._space, gamma, self.measured)
        self._followed = gamma, quaternion
        return quaternion


def _mean_of_points(values: Array, times: Array) -> Array:
    """Return the means over the points of each interval, (m, ...), of times (m, k)."""
    return np.asarray(values.reshape(*times.shape, *values.shape[1:]).mean(axis=1))


def _check_passive(
    space: ActuatorSpaceMap, measured: MeasuredMotion, scene: Scene
) -> None:
    """Refuse measured mu and beta that are not those of the measured gamma.

    What is measured need not close the loops: APART is what no sensor is off, but
    another assembly.
    """
    passive = {"mu": measured.mu, "beta": measured.beta}
    if all(angles is None for angles in passive.values()):
        return
    quaternion = _follow_orientations(space, measured.gamma, measured)
    at_rest = *quaternion.T, *np.zeros((3, len(quaternion)))
    of_gamma = joints(model_of(scene), at_rest)
    requirement = f"must be within {APART:g} rad of those that gamma has in this scene"
    for name, angles in passive.items():
        if angles is None:
            continue
        expected = np.stack(getattr(of_gamma, name), axis=1)
        turns = np.exp(1j * (angles - expected))  # without whole turns
        apart = float(np.median(np.abs(np.angle(turns)).max(axis=1)))
        refuse_unless(
            "identify", (name, f"{apart:.3g} rad off", apart <= APART, requirement)
        )


def _follow_orientations(
    space: ActuatorSpaceMap, gamma: Array, measured: MeasuredMotion
) -> Array:
    """Quaternions (n, 4) at gamma (n, 3) in the assembly mode of the first sample.

    A given orientation says which one that is: measured angles are only near those of
    it. Some of the angles, no more than CONTINUATION_STEP apart along the path where
    the samples allow it, are followed by continuation; Newton's method takes all others
    from the nearest of them before.
    """
    first = measured.gamma[:1]
    steps = np.diff(gamma, axis=0, prepend=first)
    length = np.cumsum(np.linalg.norm(steps, axis=1))
    marks = np.arange(0.0, length[-1] + CONTINUATION_STEP, CONTINUATION_STEP)
    knots = np.unique(np.searchsorted(length, marks))
    points = np.vstack([first, gamma[knots[knots < len(gamma)]]])
    fault = "gamma", first[0].tolist(), "must be angles of this manipulator"
    failures = AssemblyError, continuation.BranchEnds
    with refuse_errors("identify", *fault, *failures):
        start = None
        if measured.quaternion is not None:
            rotation = rotation_matrix(np.array(measured.quaternion))
            angles = kinematics.inverse(space.geometry, rotation)[0]
            off = np.angle(np.exp(1j * (first[0] - angles)))
            if not np.abs(off).max() <= NEAR:
                raise refusal("identify", *fault)
            start = continuation.advance(space.geometry, rotation, angles, angles + off)
        coarse, _ = continuation.follow(space.geometry, points, start)
    nearest = np.searchsorted(knots, np.arange(len(gamma)), side="right")
    return space.orientations(quaternion_of(coarse)[nearest], gamma)


def filter_angles(t: Array, gamma: Array, cutoff: float | None) -> tuple[Array, int]:
    """Return angles after a zero-phase filter, and how many samples to leave out.

    Those are the samples at both ends that the filter has not settled for. Samples must
    be evenly spaced, and the cut-off be below half their rate.
    """
    spacing = np.diff(t)
    period = float(np.median(spacing))
    even = np.abs(spacing - period).max() <= UNEVEN * period
    if cutoff is None:
        usual = CUTOFF_MARGIN * find_bandwidth(period, gamma)
        cutoff = min(usual, HIGHEST_CUTOFF / period)
    settled = 0
    if cutoff > 0.0:  # else refused below
        settled = int(np.ceil(1.0 / (cutoff * period)))  # a period of the cut-off
    least = 4 * settled + 10  # what is left is at least as long as both ends
    slow = f"must be > 0 and below half the rate of samples, {0.5 / period:g} Hz"
    lasting = f"must last {least * period:g} s or more at {cutoff:g} Hz"
    uneven = "must be evenly spaced (to 0.1 %) for angles to be filtered"
    refuse_unless(
        "identify",
        ("t", spacing, even, uneven),
        ("cutoff", cutoff, 0.0 < cutoff < 0.5 / period, slow),
        ("t", float(t[-1] - t[0]), len(t) >= least, lasting),
    )
    sections = butter(_FILTER_ORDER, cutoff, fs=1.0 / period, output="sos")
    smooth = sosfiltfilt(sections, gamma, axis=0, padlen=min(3 * settled, len(t) - 1))
    return np.asarray(smooth), settled


def find_bandwidth(period: float, gamma: Array) -> float:
    """Return the frequency [Hz] below which the angles have their power.

    That is BANDWIDTH_POWER of the power of their changes, and at least the lowest
    frequency of the samples.
    """
    window = np.hanning(len(gamma))[:, None]  # both ends are alike: zero
    changes = (gamma - gamma.mean(axis=0)) * window
    power = np.sum(np.abs(np.fft.rfft(changes, axis=0)) ** 2, axis=1)
    share = np.cumsum(power) / max(float(power.sum()), 1e-300)
    frequencies = np.fft.rfftfreq(len(gamma), period)
    highest = int(np.searchsorted(share, BANDWIDTH_POWER))
    return float(frequencies[max(highest, 1)])
