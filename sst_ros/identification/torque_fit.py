# SPDX-License-Identifier: Apache-2.0
"""Identification by torques: weighted least squares on the inverse dynamics."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np

from sst_ros.errors import InputError, Problem
from sst_ros.identification import parameters
from sst_ros.identification.base_parameters import BaseParameters, independent, structural
from sst_ros.identification.consistency import consistent_values, scales
from sst_ros.identification.derivatives import equations
from sst_ros.identification.identification import Identification
from sst_ros.identification.least_squares import LinearFit, weighted_fit
from sst_ros.identification.measured_motion import Measured, measured_motion
from sst_ros.identification.regressor import Regressor
from sst_ros.identification.sine_components import components
from sst_ros.mechanism.geometry import Array, Geometry
from sst_ros.scene.scene import Scene

STILL = 1e-6
"""Range of gamma [rad] below which a motion is none."""

SIGNIFICANT = 25.0
"""chi^2 above which the nearest bodies that can exist do not explain the estimates (5 sigma)."""


@dataclass(frozen=True)
class TorqueFit(Identification):
    """Constants identified by torques; its estimates are those of the base parameters.

    Attributes:
        base: the combinations of parameters that the motion determines.
        fit: their estimates, without the constraint that bodies can exist.
        excess: chi^2 of `values` against these estimates.
        vague: combinations whose standard deviation exceeds their size.
        samples: of the torques that were fitted.
        band: frequency below which they were [Hz]; None where angles were not filtered.
        regressor: of the torques.

    """

    base: BaseParameters
    fit: LinearFit
    excess: float
    vague: tuple[str, ...]
    samples: int
    band: float | None
    regressor: Regressor

    @property
    def consistent(self) -> bool:
        """Whether bodies that can exist explain the estimates within their uncertainty."""
        return self.excess < SIGNIFICANT

    def predict(self, data: Measured, cutoff: float | None = None) -> tuple[Array, Array]:
        """Torques of another motion by the base parameters, and the measured ones.

        Returns:
            Predicted and measured torques [N m], each shape (m, 3): at the samples, or means over
            the intervals where torques are held; without those at the ends that a filter needs.

        Raises:
            InputError: the data are not sound.

        """
        measured = measured_motion(data, self.given)
        states, rows, group, _ = equations(measured, Geometry.of(self.given), cutoff)
        known, columns = self.regressor(*states)
        torque = known + self.base.of_columns(columns) @ self.estimate
        return torque.reshape(-1, group, 3).mean(axis=1), measured.torque[rows]

    def _notes(self) -> Iterator[str]:
        noise = ", ".join(f"{value:.3g}" for value in self.fit.noise)
        band = "" if self.band is None else f", frequencies up to {self.band:.3g} Hz"
        yield f"{self.samples} samples{band}; noise of the torques {noise} N m (std. dev.)"
        yield f"condition number {self.fit.condition:.3g} (columns of length one)"
        pairs = np.abs(np.triu(self.correlation, 1))
        if pairs.size > 1:
            i, j = np.unravel_index(int(np.argmax(pairs)), pairs.shape)
            first, second = self.names[self.base.chosen[i]], self.names[self.base.chosen[j]]
            yield f"largest correlation {self.correlation[i, j]:+.3f}: {first}, {second}"
        if not self.consistent:
            yield (
                f"no bodies that can exist have these estimates (chi^2 {self.excess:.3g}): the "
                "scene has the nearest; a load may be missing, or a torque may be wrong"
            )
        yield from (f"not determined by this motion: {label}" for label in self.undetermined)
        yield from (f"uncertain by more than its size: {label}" for label in self.vague)
        if self.undetermined or self.vague:
            yield "another motion would help: `sst-ros identify design` makes one"


def fit_torques(
    data: Measured,
    scene: Scene,
    wanted: Iterable[str] | None,
    cutoff: float | None,
    delay: float,
    noise: Iterable[float] | None,
) -> TorqueFit:
    """Identify by torques; arguments as for `identify`."""
    names = parameters.selected(scene, wanted)
    measured = measured_motion(data, scene, delay)
    moved = float(np.ptp(measured.gamma, axis=0).max())
    if moved < STILL and scene.gravity is None:
        allowed = f"moves by less than {STILL:g} rad: a manipulator at rest shows no inertia"
        raise InputError("identify", [Problem("gamma", moved, allowed)])
    regressor = Regressor(scene, names)
    states, rows, group, band = equations(measured, Geometry.of(scene), cutoff)
    known, columns = regressor(*states)
    known = known.reshape(-1, group, 3).mean(axis=1)
    columns = columns.reshape(-1, group, 3, len(names)).mean(axis=1)
    sound = ~measured.saturated[rows]
    warnings = []
    if not sound.all():
        warnings.append(
            f"{int((~sound).sum())} of {len(sound)} samples left out: a torque was at the limit of "
            "the actuators, and what was recorded may not be what acted"
        )
    torque, columns = (measured.torque[rows] - known)[sound], columns[sound]
    if len(torque) <= len(names):
        allowed = f"must leave more than {len(names)} samples for {len(names)} parameters"
        raise InputError("identify", [Problem("t", len(torque), allowed)])
    samples = len(torque)
    if band is not None:
        period = float(np.median(np.diff(measured.t)))
        torque, columns = (components(one, band, period, len(names)) for one in (torque, columns))
    base = independent(columns, names)
    if not base.chosen:
        allowed = "must determine something: no torque depends on these parameters here"
        raise InputError("identify", [Problem("parameters", list(names), allowed)])
    fit = weighted_fit(
        base.of_columns(columns), torque, None if noise is None else _deviations(noise)
    )
    given = parameters.values(scene, names)
    reach = max(scene.base.radius, scene.star.radius)
    values, excess = consistent_values(names, given, base, fit, reach)
    all_of = structural(regressor)
    lost = [i not in base.chosen for i in all_of.chosen]
    vague = fit.deviation > scales(names, given)[list(base.chosen)]
    note = f"identified from {samples} samples"
    return TorqueFit(
        scene=parameters.with_parameters(scene, names, values, note),
        given=scene,
        names=names,
        values=values,
        labels=base.labels,
        before=np.asarray(base.transform @ given),
        estimate=fit.estimate,
        covariance=fit.covariance,
        undetermined=_chosen(all_of.labels, lost),
        warnings=tuple(warnings),
        base=base,
        fit=fit,
        excess=excess,
        vague=_chosen(base.labels, vague.tolist()),
        samples=samples,
        band=band,
        regressor=regressor,
    )


def _chosen(labels: tuple[str, ...], chosen: list[bool]) -> tuple[str, ...]:
    return tuple(label for label, yes in zip(labels, chosen, strict=True) if yes)


def _deviations(noise: Iterable[float]) -> Array:
    numbers = np.asarray(list(noise), dtype=float)
    if numbers.shape != (3,) or not np.all(np.isfinite(numbers) & (numbers > 0.0)):
        allowed = "must be three finite standard deviations > 0 [N m]"
        raise InputError("identify", [Problem("noise", noise, allowed)])
    return numbers
