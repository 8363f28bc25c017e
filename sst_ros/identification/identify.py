# SPDX-License-Identifier: Apache-2.0
"""identify(): constants of a scene from a recorded or simulated motion.

Torques are fitted by weighted least squares on the inverse dynamics, which is linear in
most of them. Any other constant is found by simulation: the motion that fits measured
angles.

With measured rates the motion is a Hermite spline, exact to rounding where the data
are. Without, or with a cut-off, angles pass a Butterworth filter of order 4 forwards
and backwards (no phase) and a quintic spline. Torques that are held ask for the mean of
the equation over each interval (weak form with a box as test function). Two Gauss
points take it: there the second derivative of a cubic Hermite spline is of third order,
and the errors of the pair cancel, so that the mean is of fourth order in the period
although the acceleration jumps at each sample.

Noise of the angles shrinks estimates (errors in variables), and a lower cut-off of the
angles would change the motion itself. So the regressor is made of angles filtered
little, and then torques and columns alike are projected on the m sines of lowest
frequency,

    sqrt(2 / (n + 1)) sum over i of x_i sin(pi i k / (n + 1)), k = 1 to m.

What holds for samples holds for the components (Gautier, Proc. IEEE ICRA 1997,
1922-1927). The sines are orthonormal, so that white noise stays white, and vanish at
both ends, where cosines or sums would leave noise of the rates (Shinbrot, Trans. ASME
79 (1957) 547-552). docs/howto/identify.md has the bias with and without them, measured.

What was measured of the angles at a time is what they were a delay before, of sensors
and of what transports their readings. The delay is one more unknown, in which the
torques are not linear: by Gauss-Newton, beside the base parameters. Its column is the
derivative of the residuals, so that the standard deviations of the others hold its
uncertainty, too.
"""

from __future__ import annotations

import copy
import re
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import compress
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.fft import dst
from scipy.interpolate import CubicHermiteSpline, make_interp_spline
from scipy.linalg import solve_triangular
from scipy.optimize import least_squares
from scipy.signal import butter, sosfiltfilt

from sst_ros.control.actuator_space import ActuatorSpaceMap
from sst_ros.dynamics.kernel import joints, model_of
from sst_ros.dynamics.variational import VariationalEquations
from sst_ros.errors import (
    AssemblyError,
    InputError,
    check_kinds,
    refusal,
    refuse_errors,
    refuse_unless,
)
from sst_ros.identification import contradictions, parameters
from sst_ros.identification.consistency import (
    find_consistent_values,
    fit_weighted,
    scales,
)
from sst_ros.identification.measured_motion import (
    Measured,
    MeasuredMotion,
    read_segments,
    resample,
    take_angles,
)
from sst_ros.identification.parameters import BaseParameters, Identification, Regressor
from sst_ros.mechanism import continuation, kinematics
from sst_ros.mechanism.geometry import Array, Geometry, quaternion_of, rotation_matrix
from sst_ros.scene.scene import Scene, SceneInput, scene_of
from sst_ros.scene.yaml_document import find_number
from sst_ros.state import finite_vector

STILL = 1e-6  # range of gamma [rad] below which a motion is none
# chi^2 from which no bodies that can exist explain the estimates (5 sigma)
SIGNIFICANT = 25.0
# Highest frequency of the sines over the bandwidth of the motion: products of rates
# double the frequencies of torques. From 2 to 5, 95 % intervals cover 0.90 to 0.99 in
# 200 long recordings; the bias of short ones grows.
BAND = 3.0
CUTOFF_MARGIN = 10.0  # default cut-off over the bandwidth of the motion
# between poses that continuation follows [rad]; Newton's method takes the rest
CONTINUATION_STEP = 0.03
POSITIVE = re.compile(
    r"(friction|actuators|stroke|springs)(?!.*\.rest$)|.*\.(mass|xx|yy|zz)$"
)
NOT_DETERMINED = 1.0  # relative standard deviation of a combination that counts as such
INEXPLICABLE = 250.0  # chi^2 from which other signs and orders of torques are tried
# Share of a period from which angles that are taken as in time are called late.
LATE = 0.25
# [s] that is looked for: at 5 Hz this is a whole period of the motion
LONGEST_DELAY = 0.2
FIRST_DELAY = 10.0  # periods, up to which a delay is looked for first
SETTLED = 1e-7  # change of the delay, in periods, that ends its iteration
# median difference [rad] of measured mu and beta from those of gamma, that is refused
APART = 0.05
# largest difference [rad] of the first angles from those of a given orientation
NEAR = 0.1
# of the delay, and of its column, which depends on the estimates
_DELAY_STEPS, _SLOPES = 20, 4
MOST_POSES = 100  # of the kinetic energy
LIKE_NOISE = 1.1  # ratio of residuals that are alike
DELAY_AT_BOUND = (
    f"the delay is at the longest that is looked for, {LONGEST_DELAY:g} s: torques and "
    "angles may be of different times"
)
# samples at both ends at which an interpolating quintic spline has not its full order
_EDGE = 8


@dataclass(frozen=True)
class TorqueFit(Identification):
    """Constants identified by torques; its estimates are those of the base parameters.

    Attributes:
        base: the combinations of parameters that the motion determines; `estimate` is
            without the constraint that bodies can exist.
        noise: standard deviations of the torques [N m], shape (3,).
        condition: condition number of the weighted regressor with columns of length
            one.
        excess: chi^2 of `values` against the estimates.
        vague: combinations whose standard deviation exceeds their size.
        samples: of the torques that were fitted.
        band: frequency below which they were [Hz]; None where angles were not filtered.
        delay: of the measured angles [s].
        delay_deviation: its standard deviation [s]; None where the delay was given, or
            is none.

    """

    base: BaseParameters
    noise: Array
    condition: float
    excess: float
    vague: tuple[str, ...]
    samples: int
    band: float | None
    delay: float = 0.0
    delay_deviation: float | None = None

    @property
    def consistent(self) -> bool:
        """Whether bodies that can exist explain the estimates.

        They have to explain them within their uncertainty.
        """
        return self.excess < SIGNIFICANT

    @property
    def largest_correlation(self) -> tuple[float, str, str] | None:
        """The largest correlation of two estimates, and their parameters.

        None for one alone.
        """
        pairs = np.abs(np.triu(self.correlation, 1))
        if pairs.size < 2:
            return None
        i, j = np.unravel_index(int(np.argmax(pairs)), pairs.shape)
        first, second = (self.names[self.base.chosen[k]] for k in (i, j))
        return float(self.correlation[i, j]), first, second


@check_kinds
def identify(
    data: Measured | str | Path,
    scene: SceneInput | None = None,
    parameters: Collection[str] | None = None,
    method: str = "inverse_dynamics",
    *,
    cutoff: float | None = None,
    noise: ArrayLike | None = None,
    delay: float | None = None,
) -> Identification:
    """Identify constants of a scene from a motion.

    By inverse dynamics: torques are linear in inertial parameters, friction
    coefficients, stiffness and rotor inertia; weighted least squares gives the
    combinations of them that the motion determines, with their covariance, and the
    nearest scene whose bodies can exist.

    By simulation: the motion is integrated from the initial state of the scene, and
    nonlinear least squares fits it to measured angles by any number of the scene
    ("friction.gamma.smoothing", "actuators.time_constant", "stroke.restitution",
    "initial.gamma_dot[0]").

    Args:
        data: a recording or its path, a `Trajectory`, or a mapping of arrays: t [s],
            gamma [rad] (n, 3), torque [N m] (n, 3), and where they are known gamma_dot
            [rad/s] (n, 3), quaternion (4,) at the first sample, held (torques act to
            the next sample), mu and beta [rad] (n, 3), by which the angles are checked.
            Angles may wrap, times may be those of an epoch, uneven, and have gaps: what
            was done about it is in `warnings`.
        scene: what is known of the manipulator, and the values to start from; by
            default the scene of the data.
        parameters: names of unknowns, by inverse dynamics also how their names begin
            ("star", "friction.gamma", "offset"), and by default the bodies, friction,
            springs and rotors that the scene has.
        method: "inverse_dynamics" or "simulation".
        cutoff: of the zero-phase filter of the angles [Hz]; by default none where rates
            were measured, else ten times the bandwidth of the motion.
        noise: standard deviations of the torques [N m], three; by default estimated.
        delay: how long before its stamp a measured angle was what it says, against the
            torques [s]; by default estimated where angles are filtered, else none.

    Returns:
        A `TorqueFit` by inverse dynamics, a `SimulationFit` by simulation.

    Raises:
        InputError: the data are not sound, the motion determines nothing, or an
            argument is not allowed.

    """
    known = method in ("inverse_dynamics", "simulation")
    refuse_unless(
        "identify", ("method", method, known, "must be inverse_dynamics or simulation")
    )
    if isinstance(data, (str, Path)):
        # needs rosbags, which other data do not
        from sst_ros.recording.recording import read

        data = read(data)
    given: Any = scene if scene is not None else getattr(data, "scene", None)
    refuse_unless(
        "identify", ("scene", None, given is not None, "must be given with arrays")
    )
    given = scene_of(given)
    if method == "inverse_dynamics":
        return fit_torques(data, given, parameters, cutoff, noise, delay)
    plain = cutoff is None and noise is None and delay is None
    refuse_unless(
        "identify", ("method", method, plain, "takes no cutoff, noise or delay")
    )
    return fit_simulation(data, given, parameters)


def fit_torques(
    data: Measured,
    scene: Scene,
    requested: Iterable[str] | None,
    cutoff: float | None,
    noise: ArrayLike | None,
    delay: float | None,
) -> TorqueFit:
    """Identify by torques; arguments as for `identify`."""
    names = parameters.select_names(scene, requested)
    segments = read_segments(data)
    reached = max(float(np.ptp(part.gamma, axis=0).max()) for part in segments.parts)
    allowed = (
        f"moves by less than {STILL:g} rad: a manipulator at rest shows no inertia"
    )
    weights = finite_vector(noise)
    three = noise is None or (weights is not None and min(weights) > 0.0)
    late = delay is None or abs(delay) <= LONGEST_DELAY
    refuse_unless(
        "identify",
        ("gamma", reached, reached >= STILL or scene.gravity is not None, allowed),
        ("parameters", requested, bool(names), "must name one or more"),
        ("noise", noise, three, "must be three finite standard deviations > 0 [N m]"),
        (
            "delay",
            delay,
            late,
            f"must be from -{LONGEST_DELAY:g} to {LONGEST_DELAY:g} s",
        ),
    )
    notes = contradictions.check_angles(segments.motion)
    equations = RegressionEquations(segments.parts, Regressor(scene, names), cutoff)
    fitted = equations.fit(weights, delay)
    found, deviation, expected = equations.compare_energies(fitted)
    other_units = contradictions.check_energy(found, deviation, expected)
    base, estimate, root = fitted.base, fitted.estimate, fitted.root
    given = parameters.values(scene, names)
    inverse = solve_triangular(root, np.eye(len(root)))
    values, excess = equations.find_bodies(fitted)
    if excess > INEXPLICABLE and not other_units:
        equations.refuse_relabelled(fitted, weights, delay)
    whole = parameters.find_base_parameters(equations.regressor)
    lost = [chosen not in base.chosen for chosen in whole.chosen]
    vague = np.linalg.norm(inverse, axis=1) > scales(names, given)[base.chosen]
    note = f"identified from {fitted.samples} samples"
    return TorqueFit(
        scene=parameters.with_parameters(scene, names, values, note),
        names=names,
        values=values,
        labels=base.labels,
        before=np.asarray(base.transform @ given),
        estimate=estimate,
        covariance=inverse @ inverse.T,
        undetermined=tuple(compress(whole.labels, lost)),
        warnings=(
            *segments.notes,
            *equations.notes,
            *fitted.notes,
            *other_units,
            *notes,
        ),
        base=base,
        noise=fitted.noise,
        condition=float(np.linalg.cond(root / np.linalg.norm(root, axis=0))),
        excess=excess,
        vague=tuple(compress(base.labels, vague)),
        samples=fitted.samples,
        band=equations.band,
        delay=fitted.delay,
        delay_deviation=fitted.delay_deviation,
    )


class WeightedFit(NamedTuple):
    """What `RegressionEquations.fit` finds.

    Root, R^T R, is the inverse of the covariance.
    """

    base: BaseParameters
    estimate: Array  # of the base parameters, shape (b,)
    root: Array  # shape (b, b), with the uncertainty of the delay in it
    noise: Array  # standard deviations of the torques [N m], shape (3,)
    samples: int
    delay: float  # [s]
    delay_deviation: float | None  # None where it was not estimated
    notes: tuple[str, ...]


class RegressionEquations:
    """The equation of motion along measured segments.

    It is a function of the delay of the angles.

    Attributes:
        regressor: known torques, and columns of the parameters.
        band: frequency [Hz] up to which the equations are sound, where angles are
            filtered; else None.
        notes: what was done to the data.

    """

    def __init__(
        self,
        parts: Sequence[MeasuredMotion],
        regressor: Regressor,
        cutoff: float | None,
    ) -> None:
        self.regressor = regressor
        paths, notes = list[_Path](), list[str]()
        for part in parts:
            path, note = _Path.of(part, regressor.scene, cutoff)
            paths.append(path)
            notes += [note] if note and note not in notes else []
        self._paths, self.notes = paths, tuple(notes)
        bands = [path.band for path in paths if path.band is not None]
        self.band = max(bands, default=None)
        self._period = max(path.period for path in paths)

    def fit(self, noise: Sequence[float] | None, delay: float | None) -> WeightedFit:
        """Fit the base parameters, and the delay [s] where none is given.

        The delay is fitted only where angles are filtered. The noise is that of the
        torques [N m], three, by default estimated. InputError is raised where the
        motion determines nothing.
        """
        if delay is not None or self.band is None:
            given = delay or 0.0
            fitted = self._fit_at(given, None, noise, abs(given))
            if delay is None:
                fitted = fitted._replace(notes=(*fitted.notes, *self._find_late(noise)))
            return fitted
        longest = min(FIRST_DELAY * self._period, LONGEST_DELAY)
        while True:
            found = self._find_delay(noise, longest)
            inside = abs(found.delay) <= 0.8 * longest
            if inside:
                return found
            if longest >= LONGEST_DELAY:
                return found._replace(notes=(*found.notes, DELAY_AT_BOUND))
            longest = min(2.0 * longest, LONGEST_DELAY)

    def _find_late(self, noise: Sequence[float] | None) -> list[str]:
        """Return a note where angles that are taken as in time are late, or early."""
        late = self._fit_at(0.0, 0.25 * self._period, noise, self._period)
        deviation = late.delay_deviation or 0.0
        if abs(late.delay) < max(
            contradictions.CERTAIN * deviation, LATE * self._period
        ):
            return []
        word = "late" if late.delay > 0.0 else "early"
        return [
            f"angles seem to be {word} against the torques, by some "
            f"{1e3 * abs(late.delay):.2g} ms: give the delay, or leave out gamma_dot, "
            "so that it is estimated"
        ]

    def _find_delay(self, noise: Sequence[float] | None, longest: float) -> WeightedFit:
        """Fit the delay up to a longest one [s] by Gauss-Newton."""
        delay, step = 0.0, 0.25 * self._period
        for _ in range(_DELAY_STEPS):
            found = self._fit_at(delay, step, noise, longest)
            change = found.delay - delay
            limited = min(max(found.delay, -longest), longest)
            if abs(change) <= SETTLED * self._period or limited == delay:
                break
            delay = limited
        return found._replace(delay=limited)

    def _fit_at(
        self,
        delay: float,
        step: float | None,
        noise: Sequence[float] | None,
        longest: float,
    ) -> WeightedFit:
        """Fit the base parameters at a delay [s]; with a `step` [s] its change, too.

        Segments are cut so that no delay up to the longest leaves them.
        """
        names = self.regressor.names
        formed = self._form(delay, longest)
        torque, columns = formed.torque - formed.known, formed.columns
        base = parameters.find_independent(columns, names)
        allowed = "must determine something: no torque depends on these parameters here"
        refuse_unless(
            "identify", ("parameters", list(names), bool(base.chosen), allowed)
        )
        given = parameters.values(self.regressor.scene, names)
        terms = float(np.sqrt(np.mean((np.abs(columns) @ np.abs(given)) ** 2)))
        chosen = columns[..., base.chosen]
        weighting: Any = {"terms": terms, "frequencies": formed.frequencies}
        estimate, root, spread = fit_weighted(chosen, torque, noise, **weighting)
        found = WeightedFit(
            base, estimate, root, spread, formed.samples, delay, None, formed.notes
        )
        if step is None:
            return found
        later = self._form(delay + step, longest)
        moved = later.columns[..., base.chosen]
        moved_torque = later.torque - later.known
        for _ in range(_SLOPES):
            before = torque - chosen @ estimate
            slope = (moved_torque - moved @ estimate - before) / step
            # The delay comes first: what is below its row of the root is what it leaves
            # to the others.
            both = np.concatenate([-slope[..., None], chosen], axis=2)
            together, whole, spread = fit_weighted(both, torque, noise, **weighting)
            estimate = together[1:]
        inverse = solve_triangular(whole, np.eye(len(whole)))
        return found._replace(
            estimate=estimate,
            root=whole[1:, 1:],
            noise=spread,
            delay=delay + float(together[0]),
            delay_deviation=float(np.linalg.norm(inverse[0])),
        )

    def find_bodies(self, fitted: WeightedFit) -> tuple[Array, float]:
        """Return values of bodies that can exist, and chi^2 of them.

        See `consistency`.
        """
        scene, names = self.regressor.scene, self.regressor.names
        return find_consistent_values(
            names,
            parameters.values(scene, names),
            fitted.base.transform,
            fitted.estimate,
            fitted.root,
            max(scene.base.radius, scene.star.radius),
        )

    def compare_energies(self, fitted: WeightedFit) -> tuple[float, float, float]:
        """Compare the kinetic energy of the estimates with that of the given scene.

        Returns the mean energy [J] of the measured motion by the estimates, its
        standard deviation, and that of the given scene.

        Parameters that the motion does not determine are those nearest to the given.
        """
        scene, names = self.regressor.scene, self.regressor.names
        parts = [
            path.sum_energies(self.regressor, fitted.delay) for path in self._paths
        ]
        count = sum(part.samples for part in parts)
        known = sum(part.known for part in parts) / count
        slopes = np.sum([part.slopes for part in parts], axis=0) / count
        given = parameters.values(scene, names)
        transform = fitted.base.transform
        weighted = transform * scales(names, given) ** 2  # T S of the lift S T^T
        by_estimate = np.linalg.solve(weighted @ transform.T, weighted @ slopes)
        expected = known + float(slopes @ given)
        change = by_estimate @ (fitted.estimate - transform @ given)
        deviation = np.linalg.norm(
            solve_triangular(fitted.root, by_estimate, trans="T")
        )
        return expected + float(change), float(deviation), expected

    def refuse_relabelled(
        self, fitted: WeightedFit, noise: Sequence[float] | None, delay: float | None
    ) -> None:
        """Raise InputError where bodies fit the torques with another sign or order."""
        for other in contradictions.RELABELLINGS:
            trial = copy.copy(self)
            trial._paths = [
                path._replace(measured=path.measured.with_torque(other.apply))
                for path in self._paths
            ]
            fit = trial.fit(noise, delay)
            if trial.find_bodies(fit)[1] > SIGNIFICANT:
                continue
            if np.linalg.norm(fit.noise) < LIKE_NOISE * np.linalg.norm(fitted.noise):
                allowed = (
                    f"fit no bodies, but {other.columns} do: must be those of gamma"
                )
                raise refusal("identify", "columns of torque", [1, 2, 3], allowed)

    def correlate(self) -> Array:
        """Return the correlations of the torques with those of the scene, shape (3,).

        They are 0 where either is.
        """
        formed = self._form(0.0, 0.0)
        known = formed.known
        size = np.linalg.norm(formed.torque, axis=0) * np.linalg.norm(known, axis=0)
        products = np.sum(formed.torque * known, axis=0)
        return np.asarray(products / np.maximum(size, 1e-300))

    def _form(self, delay: float, longest: float) -> FormedEquations:
        """Form the equations at a delay [s], which is no longer than the longest."""
        scene, names = self.regressor.scene, self.regressor.names
        limit = (
            np.inf if scene.torque_limit is None else scene.torque_limit * (1.0 - 1e-9)
        )
        rows = list[tuple[Array, Array, Array]]()
        frequencies = list[Array]()
        samples = cut = total = 0
        for path in self._paths:
            known, part, torque = path.evaluate(self.regressor, delay, longest)
            sound = np.abs(torque).max(axis=1) < limit
            total += len(sound)
            cut += int((~sound).sum())
            torque, known, part = torque[sound], known[sound], part[sound]
            samples += len(torque)
            if path.band is not None:
                half_cycles = 2.0 * path.period * (len(torque) + 1)  # Hz^-1, of sine 1
                count = int(np.ceil(2.0 * path.band * path.period * len(torque)))
                count = max(count, len(names) if len(self._paths) == 1 else 0)
                torque, known, part = (
                    np.asarray(dst(one, type=1, norm="ortho", axis=0)[:count])
                    for one in (torque, known, part)
                )
                frequencies.append(np.arange(1, len(torque) + 1) / half_cycles)
            rows.append((torque, known, part))
        allowed = (
            f"must leave more than {len(names)} samples for {len(names)} parameters"
        )
        refuse_unless("identify", ("t", samples, samples > len(names), allowed))
        warning = (
            f"{cut} of {total} samples left out: a torque was at the limit of "
            "the actuators, and what was recorded may not be what acted"
        )
        torque, known, columns = (
            np.concatenate(each) for each in zip(*rows, strict=True)
        )
        relative = None
        if frequencies:
            relative = np.concatenate(frequencies)
            relative = relative / relative.max()
        return FormedEquations(
            torque, known, columns, relative, samples, notes=(warning,) if cut else ()
        )


class FormedEquations(NamedTuple):
    """torque = known + columns parameters, of samples, or of their components."""

    torque: Array  # measured [N m], shape (m, 3)
    known: Array  # of the scene without the parameters [N m], shape (m, 3)
    columns: Array  # shape (m, 3, p)
    # of components, over the highest, shape (m,); None of samples
    frequencies: Array | None
    samples: int  # that were taken
    notes: tuple[str, ...]


class EnergySums(NamedTuple):
    """Sums over samples of the kinetic energy, linear in the parameters."""

    known: float  # without the parameters [J]
    slopes: Array  # shape (p,)
    samples: int


class _Path(NamedTuple):
    """Angles, rates and accelerations along one segment.

    Also where the equation is taken. Without a `cutoff` [Hz] angles are filtered only
    where no rates were measured, at CUTOFF_MARGIN times the bandwidth of the motion.
    """

    measured: MeasuredMotion
    space: ActuatorSpaceMap
    # of the equation [s], shape (m, 1 or 2): the second is of held torques
    times: Array
    curves: Any  # angles, rates and accelerations over time
    # samples at both ends that the filter or the spline has not settled for
    unsettled: int
    # frequency up to which they are sound; None where they are not filtered
    band: float | None
    period: float  # usual time between samples [s]

    @classmethod
    def of(
        cls, measured: MeasuredMotion, scene: Scene, cutoff: float | None
    ) -> tuple[_Path, str]:
        """Return the path of a segment, and a note of what was done to its samples.

        Raises InputError where the cut-off is not allowed, the segment is too short to
        be filtered, or measured mu and beta are not those of gamma.
        """
        note, band, unsettled, rate = "", None, 0, measured.gamma_dot
        space = ActuatorSpaceMap(Geometry.of(scene))
        _check_passive(space, measured, scene)
        curves: Any
        if cutoff is not None or rate is None:
            measured, note = resample(measured)
            t, gamma = measured.t, measured.gamma
            bandwidth = find_bandwidth(float(np.median(np.diff(t))), gamma)
            band = min(BAND * bandwidth, cutoff or np.inf)
            smooth, unsettled = filter_angles(t, gamma, cutoff)
            spline = make_interp_spline(t, smooth, k=5)
            curves = spline, spline.derivative(), spline.derivative(2)
        else:
            t = measured.t - measured.t[0]
            if measured.held:
                spline = CubicHermiteSpline(t, measured.gamma, rate)
                curves = spline, spline.derivative(), spline.derivative(2)
            else:
                spline, unsettled = (
                    make_interp_spline(t, rate, k=5),
                    min(_EDGE, len(t) // 4),
                )
                curves = (
                    make_interp_spline(t, measured.gamma, k=5),
                    spline,
                    spline.derivative(),
                )
        times = t[:, None]
        if measured.held:  # two Gauss points in each interval
            middle, half = 0.5 * (t[1:] + t[:-1]), 0.5 * np.diff(t) / np.sqrt(3.0)
            times = np.stack([middle - half, middle + half], axis=1)
        period = float(np.median(np.diff(t)))
        return cls(measured, space, times, curves, unsettled, band, period), note

    def evaluate(
        self, regressor: Regressor, delay: float, longest: float
    ) -> tuple[Array, Array, Array]:
        """Evaluate the equation of motion at the samples.

        Where torques are held, its means are evaluated. Returns known and measured
        torques [N m], each shape (m, 3), between them the regressor of p parameters,
        shape (m, 3, p). Angles were measured a delay [s] late. Angles that no assembly
        has are refused.
        """
        cut = self.unsettled + int(np.ceil(longest / self.period * (1.0 - 1e-9)))
        rows = slice(cut, max(len(self.times) - cut, cut))
        times = self.times[rows]
        allowed = f"must last longer than {2.0 * cut * self.period:g} s"
        last = float(np.ptp(self.measured.t))
        refuse_unless("identify", ("t", last, len(times) > 1, allowed))
        angles, rates, accelerations = (
            one(times.ravel() + delay) for one in self.curves
        )
        quaternion = _follow_orientations(self.space, angles, self.measured)
        moving = *quaternion.T, *rates.T, *accelerations.T
        star = np.stack(self.space.star_accelerations(*moving), axis=1)
        found = regressor(quaternion, star[:, :3], star[:, 3:])
        known, columns = (
            one.reshape(*times.shape, *one.shape[1:]).mean(axis=1) for one in found
        )
        return known, columns, self.measured.torque[rows]

    def sum_energies(self, regressor: Regressor, delay: float) -> EnergySums:
        """Sum the kinetic energy at some of the samples.

        It is half the rates times the torques that, from rest and without gravity, give
        accelerations of the size of the rates.
        """
        step = max(len(self.times) // MOST_POSES, 1)
        chosen = self.times[:, 0] + delay
        inside = (chosen >= self.times[0, 0]) & (chosen <= self.times[-1, -1])
        times = chosen[inside][::step]
        angles, rates, _ = (curve(times) for curve in self.curves)
        quaternion = _follow_orientations(self.space, angles, self.measured)
        rest = np.zeros((len(times), 3))
        star = np.stack(
            self.space.star_accelerations(*quaternion.T, *rest.T, *rates.T), axis=1
        )
        moved = regressor(quaternion, rest, star[:, 3:])
        held = regressor(quaternion, rest, rest)
        known, columns = (one - other for one, other in zip(moved, held, strict=True))
        return EnergySums(
            known=0.5 * float(np.sum(rates * known)),
            slopes=0.5 * np.einsum("nk,nkp->p", rates, columns),
            samples=len(times),
        )


def _check_passive(
    space: ActuatorSpaceMap, measured: MeasuredMotion, scene: Scene
) -> None:
    """Refuse measured mu and beta that are not those of the measured gamma.

    What is measured need not close the loops: APART is what no sensor is off, but
    another assembly.
    """
    given = {name: getattr(measured, name) for name in ("mu", "beta")}
    if all(values is None for values in given.values()):
        return
    quaternion = _follow_orientations(space, measured.gamma, measured)
    at_rest = *quaternion.T, *np.zeros((3, len(quaternion)))
    found = joints(model_of(scene), at_rest)
    for name, values in given.items():
        if values is None:
            continue
        turns = np.exp(1j * (values - np.stack(getattr(found, name), axis=1)))
        apart = float(np.median(np.abs(np.angle(turns)).max(axis=1)))
        allowed = f"must be within {APART:g} rad of those that gamma has in this scene"
        refuse_unless(
            "identify", (name, f"{apart:.3g} rad off", apart <= APART, allowed)
        )


def _follow_orientations(
    space: ActuatorSpaceMap, gamma: Array, measured: MeasuredMotion
) -> Array:
    """Quaternions (n, 4) at gamma (n, 3) in the assembly mode of the first sample.

    A given orientation says which one that is: measured angles are only near those of
    it.
    """
    begin, first = measured.quaternion, measured.gamma[:1]
    length = np.cumsum(np.linalg.norm(np.diff(gamma, axis=0, prepend=first), axis=1))
    known = np.unique(
        np.searchsorted(
            length, np.arange(0.0, length[-1] + CONTINUATION_STEP, CONTINUATION_STEP)
        )
    )
    points = np.vstack([first, gamma[known[known < len(gamma)]]])
    refused = "gamma", first[0].tolist(), "must be angles of this manipulator"
    failures = AssemblyError, continuation.BranchEnds
    with refuse_errors("identify", *refused, *failures):
        start = None
        if begin is not None:
            rotation = rotation_matrix(np.array(begin))
            shown = kinematics.inverse(space.geometry, rotation)[0]
            off = np.angle(np.exp(1j * (first[0] - shown)))
            if not np.abs(off).max() <= NEAR:
                raise refusal("identify", *refused)
            start = continuation.advance(space.geometry, rotation, shown, shown + off)
        coarse, _ = continuation.follow(space.geometry, points, start)
    nearest = np.searchsorted(known, np.arange(len(gamma)), side="right")
    return space.orientations(quaternion_of(coarse)[nearest], gamma)


def filter_angles(t: Array, gamma: Array, cutoff: float | None) -> tuple[Array, int]:
    """Return angles after a zero-phase filter, and how many samples to leave out.

    Those are the samples at both ends that the filter has not settled for. Samples must
    be evenly spaced, and the cut-off be below half their rate.
    """
    spacing = np.diff(t)
    period = float(np.median(spacing))
    even = np.abs(spacing - period).max() <= 1e-3 * period
    if cutoff is None:
        cutoff = min(CUTOFF_MARGIN * find_bandwidth(period, gamma), 0.4 / period)
    settled = int(np.ceil(1.0 / (cutoff * period))) if cutoff > 0.0 else 0
    least = 4 * settled + 10
    slow = f"must be > 0 and below half the rate of samples, {0.5 / period:g} Hz"
    lasting = f"must last {least * period:g} s or more at {cutoff:g} Hz"
    refuse_unless(
        "identify",
        (
            "t",
            spacing,
            even,
            "must be evenly spaced (to 0.1 %) for angles to be filtered",
        ),
        ("cutoff", cutoff, 0.0 < cutoff < 0.5 / period, slow),
        ("t", float(t[-1] - t[0]), len(t) >= least, lasting),
    )
    sections = butter(4, cutoff, fs=1.0 / period, output="sos")
    smooth = sosfiltfilt(sections, gamma, axis=0, padlen=min(3 * settled, len(t) - 1))
    return np.asarray(smooth), settled


def find_bandwidth(period: float, gamma: Array) -> float:
    """Return the frequency [Hz] below which the angles have their power.

    That is all but 1e-4 of the power of their changes.
    """
    spread = (gamma - gamma.mean(axis=0)) * np.hanning(len(gamma))[:, None]
    power = np.sum(np.abs(np.fft.rfft(spread, axis=0)) ** 2, axis=1)
    share = np.cumsum(power) / max(float(power.sum()), 1e-300)
    frequencies = np.fft.rfftfreq(len(gamma), period)
    return float(frequencies[max(int(np.searchsorted(share, 1.0 - 1e-4)), 1)])


@dataclass(frozen=True)
class SimulationFit(Identification):
    """Constants identified by simulation.

    `values` differ from estimates that no body has.

    Attributes:
        relative: relative standard deviations of the combinations `directions`, rising,
            (p,).
        directions: combinations as rows, relative changes of the parameters, shape (p,
            p).
        error: root of the mean square of the residuals [rad].

    """

    relative: Array
    directions: Array
    error: float

    @property
    def combinations(self) -> list[tuple[float, str]]:
        """The combinations as text, each with its relative standard deviation."""
        texts = [describe_combination(row, self.names) for row in self.directions]
        return list(zip(self.relative.tolist(), texts, strict=True))


def fit_simulation(
    data: Measured, scene: Scene, requested: Iterable[str] | None
) -> SimulationFit:
    """Identify by simulation; arguments as for `identify`.

    Gauss-Newton steps take the sensitivities of the motion, exact to rounding. In sizes
    of the parameters, their singular values over the measuring errors show which
    combinations are known and how well: often fewer than there are parameters.
    """
    given = () if requested is None else requested
    names = (given,) if isinstance(given, str) else tuple(given)
    allowed = "must be keys of numbers of the scene, with method simulation"
    refuse_unless("identify", ("parameters", requested, bool(names), allowed))
    notes = _check_simulated(data, scene)
    torque, t, gamma = take_angles(data, scene)
    motion, model = (
        VariationalEquations(scene, names, torque, caller="identify"),
        model_of(scene),
    )
    given = np.array([find_number(scene, name) for name in names], dtype=float)
    least = np.where([bool(POSITIVE.match(name)) for name in names], 1e-3, -np.inf)
    allowed = "must not be 0 in the scene: it begins there, and must be > 0"
    begins = zip(names, given, (given > 0.0) | np.isinf(least), strict=True)
    refuse_unless(
        "identify", *((name, x, bool(good), allowed) for name, x, good in begins)
    )
    size = np.abs(given) + (given == 0.0)

    @lru_cache(maxsize=1)  # SciPy asks for residuals and slopes one after the other
    def compare(*x: float) -> tuple[Array, Array]:
        """Return computed less measured angles [rad], and derivatives.

        The angles have the shape (3 n,), the derivatives (3 n, p).
        """
        states, slopes = motion.run(np.array(x) * size, t)
        rows = states[:, :7].T
        turned = np.exp(
            1j * (np.stack(joints(model, tuple(rows)).gamma, axis=1) - gamma)
        )
        by_state = motion.differentiate_joints(rows)[:, :3]
        changes = np.einsum("qcn,nqp->ncp", by_state, slopes[:, :7])
        return np.angle(turned).ravel(), changes.reshape(-1, len(names))

    found = least_squares(
        lambda x: compare(*x)[0],
        given / size,
        lambda x: compare(*x)[1] * size,
        bounds=(least, np.inf),
        xtol=1e-13,
        ftol=1e-13,
        gtol=None,
        max_nfev=100,
    )
    off, slopes = compare(*found.x)
    fitted = found.x * size
    scale = np.where(fitted == 0.0, 1.0, fitted)  # changes of logarithms
    unit = float(np.sqrt(np.sum(off**2) / max(len(off) - len(names), 1))) + 1e-300
    _, singular, rows = np.linalg.svd(slopes * scale / unit, full_matrices=True)
    relative = np.full(len(names), np.inf)
    some = singular > 1e-12 * max(float(singular[0]), 1e-300)
    relative[: len(singular)][some] = 1.0 / singular[some]
    spread = (rows.T * np.minimum(relative, 1e9) ** 2) @ rows * np.outer(scale, scale)
    vague = rows[relative >= NOT_DETERMINED]
    note, kept, warnings = "identified by simulation", names, tuple(notes)
    try:
        adjusted = parameters.with_parameters(scene, names, fitted, note)
    except InputError:
        kept = tuple(name for name in names if ".inertia." not in name)
        if kept == names:
            raise
        chosen = [name in kept for name in names]
        adjusted = parameters.with_parameters(scene, kept, fitted[chosen], note)
        warnings += (
            "no bodies have the inertias that fit best: the scene keeps the given ones",
        )
    return SimulationFit(
        scene=adjusted,
        names=names,
        values=parameters.values(adjusted, names),
        labels=names,
        before=given,
        estimate=fitted,
        covariance=spread,
        undetermined=tuple(describe_combination(row, names) for row in vague),
        warnings=warnings,
        relative=relative,
        directions=rows,
        error=float(np.sqrt(np.mean(off**2))),
    )


def _check_simulated(data: Measured, scene: Scene) -> list[str]:
    """Return notes on a motion that is to be simulated.

    Raises InputError where a torque opposes that of the scene along the motion; motions
    that are too short to be filtered are not checked.
    """
    segments = read_segments(data)
    notes = contradictions.check_angles(segments.motion)
    try:
        equations = RegressionEquations(segments.parts, Regressor(scene, ()), None)
        correlation = equations.correlate()
    except InputError:
        return notes
    leg = int(np.argmin(correlation))
    allowed = "must be > 0: the signs of torque and gamma contradict each other"
    key = f"correlation of torque_{leg + 1} with that of the scene"
    opposed = correlation[leg] < contradictions.OPPOSED
    refuse_unless(
        "identify", (key, round(float(correlation[leg]), 2), not opposed, allowed)
    )
    return notes


def describe_combination(row: Array, names: tuple[str, ...]) -> str:
    """Write relative changes as a product of powers."""
    largest = float(row[int(np.argmax(np.abs(row)))])
    return " ".join(
        f"{name}^{np.sign(largest) * value:+.2f}"
        for name, value in zip(names, row, strict=True)
        if abs(value) > 0.05 * abs(largest)
    )
