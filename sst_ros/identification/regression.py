# SPDX-License-Identifier: Apache-2.0
"""The equations that torques give along a measured motion, and their weighted fit.

Equations are the samples themselves, or where angles are filtered their components
along sines of low frequency. The delay of the angles is one more unknown, in which they
are not linear: Gauss-Newton takes it, beside the base parameters.
"""

from __future__ import annotations

import copy
import operator
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.fft import dst
from scipy.linalg import solve_triangular

from sst_ros.errors import refusal, refuse_unless
from sst_ros.identification import contradictions, parameters
from sst_ros.identification.consistency import (
    find_consistent_values,
    fit_weighted,
    scales,
)
from sst_ros.identification.contradictions import Relabelling
from sst_ros.identification.measured_motion import MeasuredMotion
from sst_ros.identification.measured_path import MeasuredPath, PathEquations
from sst_ros.identification.parameters import BaseParameters, Regressor
from sst_ros.mechanism.geometry import Array

# chi^2 from which no bodies that can exist explain the estimates (5 sigma)
SIGNIFICANT = 25.0
# Share of a period from which angles that are taken as in time are called late.
LATE = 0.25
# [s] that is looked for: at 5 Hz this is a whole period of the motion
LONGEST_DELAY = 0.2
FIRST_DELAY = 10.0  # periods, up to which a delay is looked for first
INSIDE = 0.8  # share of the longest delay below which one counts as found
SETTLED = 1e-7  # change of the delay, in periods, that ends its iteration
DELAY_AT_BOUND = (
    f"the delay is at the longest that is looked for, {LONGEST_DELAY:g} s: torques and "
    "angles may be of different times"
)
LIKE_NOISE = 1.1  # ratio of residuals that are alike
MOST_TRIALS = 2  # signs and orders of torques that are fitted, the likeliest first
# share of a period by which the slope of the equations by the delay is taken
_SLOPE_STEP = 0.25
_DELAY_STEPS = 20  # of Gauss-Newton for the delay
_SLOPES = 4  # of the column of the delay, which depends on the estimates


class WeightedFit(NamedTuple):
    """What `RegressionEquations.fit` finds.

    The root R is such that R^T R is the inverse of the covariance.
    """

    base: BaseParameters
    estimate: Array  # of the base parameters, shape (b,)
    root: Array  # shape (b, b), with the uncertainty of the delay in it
    noise: Array  # standard deviations of the torques [N m], shape (3,)
    samples: int
    delay: float  # [s]
    delay_deviation: float | None  # None where it was not estimated
    notes: tuple[str, ...]


class FormedEquations(NamedTuple):
    """The equations of all segments: see `PathEquations`."""

    torque: Array  # measured [N m], shape (m, 3)
    known: Array  # of the scene without the parameters [N m], shape (m, 3)
    columns: Array  # shape (m, 3, p)
    # of components, over the highest, shape (m,); None of samples
    frequencies: Array | None
    samples: int  # that were taken
    notes: tuple[str, ...]


class RegressionEquations:
    """The equation of motion along measured segments, at any delay of the angles.

    Attributes:
        regressor: known torques, and columns of the parameters.
        band: frequency [Hz] up to which the equations are sound, where angles are
            filtered; else None.
        notes: what was done to the data.

    """

    def __init__(
        self,
        segments: Sequence[MeasuredMotion],
        regressor: Regressor,
        cutoff: float | None,
    ) -> None:
        self.regressor = regressor
        paths = list[MeasuredPath]()
        notes = dict[str, None]()
        for segment in segments:
            path, note = MeasuredPath.of(segment, regressor.scene, cutoff)
            paths.append(path)
            if note:
                notes[note] = None
        self.notes = tuple(notes)
        bands = [path.band for path in paths if path.band is not None]
        self.band = max(bands, default=None)
        self._paths = paths
        self._period = max(path.period for path in paths)
        self._relabelling: Relabelling | None = None
        self._components: dict[tuple[float, float], FormedEquations] = {}

    def fit(self, noise: Sequence[float] | None, delay: float | None) -> WeightedFit:
        """Fit the base parameters, and the delay [s] where none is given.

        The delay is fitted only where angles are filtered. The noise is that of the
        torques [N m], three, by default estimated. InputError is raised where the
        motion determines nothing.
        """
        if delay is not None:
            return self._fit_at(delay, noise, abs(delay))
        if self.band is None:
            fitted = self._fit_at(0.0, noise, 0.0)
            return fitted._replace(notes=(*fitted.notes, *self._find_late(noise)))
        longest = min(FIRST_DELAY * self._period, LONGEST_DELAY)
        while True:
            fitted = self._find_delay(noise, longest)
            if abs(fitted.delay) <= INSIDE * longest:
                return fitted
            if longest >= LONGEST_DELAY:
                return fitted._replace(notes=(*fitted.notes, DELAY_AT_BOUND))
            longest = min(2.0 * longest, LONGEST_DELAY)

    def _find_late(self, noise: Sequence[float] | None) -> list[str]:
        """Return a note where angles that are taken as in time are late, or early."""
        fitted = self._fit_with_delay(0.0, noise, self._period)
        certain = contradictions.CERTAIN * (fitted.delay_deviation or 0.0)
        delay = abs(fitted.delay)
        if delay < max(certain, LATE * self._period):
            return []
        direction = "late" if fitted.delay > 0.0 else "early"
        return [
            f"angles seem to be {direction} against the torques, by some "
            f"{1e3 * delay:.2g} ms: give the delay, or leave out gamma_dot, so that it "
            "is estimated"
        ]

    def _find_delay(self, noise: Sequence[float] | None, longest: float) -> WeightedFit:
        """Fit the delay up to a longest one [s] by Gauss-Newton."""
        delay = 0.0
        for _ in range(_DELAY_STEPS):
            fitted = self._fit_with_delay(delay, noise, longest)
            change = fitted.delay - delay
            limited = min(max(fitted.delay, -longest), longest)
            if abs(change) <= SETTLED * self._period or limited == delay:
                break
            delay = limited
        return fitted._replace(delay=limited)

    def _fit_at(
        self, delay: float, noise: Sequence[float] | None, longest: float
    ) -> WeightedFit:
        """Fit the base parameters at a delay [s].

        Segments are cut so that no delay up to the longest leaves them.
        """
        formed = self._form(delay, longest)
        base = self._find_base(formed)
        fit = fit_weighted(
            formed.columns[..., base.chosen],
            formed.torque - formed.known,
            noise,
            terms=self._size_of_terms(formed),
            frequencies=formed.frequencies,
        )
        return WeightedFit(
            base=base,
            estimate=fit.estimate,
            root=fit.root,
            noise=fit.noise,
            samples=formed.samples,
            delay=delay,
            delay_deviation=None,
            notes=formed.notes,
        )

    def _fit_with_delay(
        self, delay: float, noise: Sequence[float] | None, longest: float
    ) -> WeightedFit:
        """Fit the base parameters and the delay, linearized at a delay [s]."""
        step = _SLOPE_STEP * self._period
        formed = self._form(delay, longest)
        later = self._form(delay + step, longest)
        base = self._find_base(formed)
        columns = formed.columns[..., base.chosen]
        later_columns = later.columns[..., base.chosen]
        torque = formed.torque - formed.known
        later_torque = later.torque - later.known
        terms = self._size_of_terms(formed)
        estimate = fit_weighted(
            columns, torque, noise, terms=terms, frequencies=formed.frequencies
        ).estimate
        for _ in range(_SLOPES):
            residual = torque - columns @ estimate
            later_residual = later_torque - later_columns @ estimate
            slope = (later_residual - residual) / step
            # The delay comes first: what is below its row of the root is what it leaves
            # to the others.
            fit = fit_weighted(
                np.concatenate([-slope[..., None], columns], axis=2),
                torque,
                noise,
                terms=terms,
                frequencies=formed.frequencies,
            )
            estimate = fit.estimate[1:]
        inverse = solve_triangular(fit.root, np.eye(len(fit.root)))
        return WeightedFit(
            base=base,
            estimate=estimate,
            root=fit.root[1:, 1:],
            noise=fit.noise,
            samples=formed.samples,
            delay=delay + float(fit.estimate[0]),
            delay_deviation=float(np.linalg.norm(inverse[0])),
            notes=formed.notes,
        )

    def _find_base(self, formed: FormedEquations) -> BaseParameters:
        """Return the parameters that the motion determines, or refuse that of none."""
        names = self.regressor.names
        base = parameters.find_independent(formed.columns, names)
        requirement = (
            "must determine something: no torque depends on these parameters here"
        )
        refuse_unless(
            "identify", ("parameters", list(names), bool(base.chosen), requirement)
        )
        return base

    def _size_of_terms(self, formed: FormedEquations) -> float:
        """Return the RMS of the terms that sum up to the torques [N m]."""
        values = parameters.values(self.regressor.scene, self.regressor.names)
        sums = np.abs(formed.columns) @ np.abs(values)
        return float(np.sqrt(np.mean(sums**2)))

    def find_bodies(self, fitted: WeightedFit) -> tuple[Array, float]:
        """Return values of bodies that can exist, and chi^2 of them.

        See `consistency`.
        """
        scene = self.regressor.scene
        names = self.regressor.names
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

        Parameters x that the motion does not determine are those nearest to the given
        x_0 in sizes of the bodies: the least (x - x_0)^T S^-1 (x - x_0), of squared
        sizes S, under T x = beta is x = x_0 + S T^T (T S T^T)^-1 (beta - T x_0).
        """
        names = self.regressor.names
        sums = [path.sum_energies(self.regressor, fitted.delay) for path in self._paths]
        count = sum(each.samples for each in sums)
        known = sum(each.known for each in sums) / count
        slopes = np.sum([each.slopes for each in sums], axis=0) / count
        scene_values = parameters.values(self.regressor.scene, names)
        transform = fitted.base.transform
        weighted = transform * scales(names, scene_values) ** 2  # T S
        by_estimate = np.linalg.solve(weighted @ transform.T, weighted @ slopes)
        expected = known + float(slopes @ scene_values)
        change = by_estimate @ (fitted.estimate - transform @ scene_values)
        deviation = np.linalg.norm(
            solve_triangular(fitted.root, by_estimate, trans="T")
        )
        return expected + float(change), float(deviation), expected

    def refuse_relabelled(
        self, fitted: WeightedFit, noise: Sequence[float] | None, delay: float | None
    ) -> None:
        """Raise InputError where bodies fit the torques with another sign or order.

        Only the torques differ: equations that were formed are taken again, and those
        relabellings are fitted that leave the least noise in a fit linearized at no
        delay.
        """
        trials: list[tuple[float, RegressionEquations, Relabelling]] = []
        for relabelling in contradictions.RELABELLINGS:
            trial = copy.copy(self)
            trial._relabelling = relabelling
            rough = trial._fit_roughly(noise, delay)
            trials.append((float(np.linalg.norm(rough.noise)), trial, relabelling))
        trials.sort(key=operator.itemgetter(0))
        alike = LIKE_NOISE * np.linalg.norm(fitted.noise)
        for _, trial, relabelling in trials[:MOST_TRIALS]:
            refitted = trial.fit(noise, delay)
            if np.linalg.norm(refitted.noise) >= alike:
                continue
            _, excess = trial.find_bodies(refitted)
            if excess <= SIGNIFICANT:
                requirement = (
                    f"fit no bodies, but {relabelling.columns} do: must be those of"
                    " gamma"
                )
                raise refusal("identify", "columns of torque", [1, 2, 3], requirement)

    def _fit_roughly(
        self, noise: Sequence[float] | None, delay: float | None
    ) -> WeightedFit:
        """Fit in one step, linearized where `fit` begins."""
        if delay is not None:
            return self._fit_at(delay, noise, abs(delay))
        if self.band is None:
            return self._fit_at(0.0, noise, 0.0)
        longest = min(FIRST_DELAY * self._period, LONGEST_DELAY)
        return self._fit_with_delay(0.0, noise, longest)

    def correlate(self) -> Array:
        """Return the correlations of the torques with those of the scene, shape (3,).

        They are 0 where either is.
        """
        formed = self._form(0.0, 0.0)
        measured_size = np.linalg.norm(formed.torque, axis=0)
        known_size = np.linalg.norm(formed.known, axis=0)
        products = np.sum(formed.torque * formed.known, axis=0)
        return np.asarray(products / np.maximum(measured_size * known_size, 1e-300))

    def _form(self, delay: float, longest: float) -> FormedEquations:
        """Form the equations at a delay [s], which is no longer than the longest.

        Components are few, and kept.
        """
        formed = self._components.get((delay, longest))
        if formed is None:
            formed = self._evaluate(delay, longest)
        if self.band is not None:
            self._components[delay, longest] = formed
        if self._relabelling is None:
            return formed
        return formed._replace(torque=self._relabelling.apply(formed.torque))

    def _evaluate(self, delay: float, longest: float) -> FormedEquations:
        """Evaluate the equations of each segment, and put them together.

        Samples at which a torque is at the limit of the actuators are left out.
        """
        parameter_count = len(self.regressor.names)
        # one segment alone must determine all parameters
        least_sines = parameter_count if len(self._paths) == 1 else 0
        of_paths: list[PathEquations] = []
        frequencies: list[Array] = []
        total = 0
        samples = 0
        for path in self._paths:
            equations = path.evaluate(self.regressor, delay, longest)
            is_sound = np.abs(equations.torque).max(axis=1) < self._torque_limit
            count = int(is_sound.sum())
            total += len(is_sound)
            samples += count
            equations = PathEquations(*(array[is_sound] for array in equations))
            if path.band is not None:
                equations = _transform(equations, path.count_sines(count, least_sines))
                sines = np.arange(1, len(equations.torque) + 1)
                frequencies.append(sines / (2.0 * path.period * (count + 1)))
            of_paths.append(equations)
        requirement = (
            f"must leave more than {parameter_count} samples for {parameter_count}"
            " parameters"
        )
        refuse_unless(
            "identify", ("t", samples, samples > parameter_count, requirement)
        )
        notes: tuple[str, ...] = ()
        if samples < total:
            warning = (
                f"{total - samples} of {total} samples left out: a torque was at the"
                " limit of the actuators, and what was recorded may not be what acted"
            )
            notes = (warning,)
        relative = None
        if frequencies:
            relative = np.concatenate(frequencies)
            relative = relative / relative.max()
        return FormedEquations(
            torque=np.concatenate([equations.torque for equations in of_paths]),
            known=np.concatenate([equations.known for equations in of_paths]),
            columns=np.concatenate([equations.columns for equations in of_paths]),
            frequencies=relative,
            samples=samples,
            notes=notes,
        )

    @property
    def _torque_limit(self) -> float:
        """Torque [N m] below which an actuator is not at its limit, to rounding."""
        limit = self.regressor.scene.torque_limit
        return np.inf if limit is None else limit * (1.0 - 1e-9)


def _transform(equations: PathEquations, count: int) -> PathEquations:
    """Return the components of samples along the first sines."""
    spectra = (dst(array, type=1, norm="ortho", axis=0) for array in equations)
    return PathEquations(*(np.asarray(spectrum[:count]) for spectrum in spectra))
