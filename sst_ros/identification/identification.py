# SPDX-License-Identifier: Apache-2.0
"""The result of an identification: estimates, their uncertainty, the scene, and predictions."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from sst_ros.identification.base_parameters import BaseParameters
from sst_ros.identification.derivatives import equations
from sst_ros.identification.least_squares import LinearFit
from sst_ros.identification.measured_motion import Measured, measured_motion
from sst_ros.identification.regressor import Regressor
from sst_ros.mechanism.geometry import Array, Geometry
from sst_ros.scene.scene import Scene

SIGNIFICANT = 25.0
"""chi^2 above which the nearest bodies that can exist do not explain the estimates (5 sigma)."""


@dataclass(frozen=True)
class Identification:
    """Identified constants of a scene.

    Attributes:
        scene: the scene with identified values, whose bodies can exist.
        given: the scene as it was.
        names: of the parameters, length p.
        values: their values in `scene`, shape (p,).
        base: the combinations that the motion determines, b of them.
        fit: their estimates by weighted least squares, without the constraint.
        excess: chi^2 of the values against these estimates.
        undetermined: combinations that torques depend on, but not in this motion.
        vague: combinations whose standard deviation exceeds their size.
        warnings: what else to know.
        regressor: of the torques.

    """

    scene: Scene
    given: Scene
    names: tuple[str, ...]
    values: Array
    base: BaseParameters
    fit: LinearFit
    excess: float
    undetermined: tuple[str, ...]
    vague: tuple[str, ...]
    warnings: tuple[str, ...]
    regressor: Regressor

    @property
    def estimate(self) -> Array:
        """Estimates of the base parameters, shape (b,)."""
        return self.fit.estimate

    @property
    def deviation(self) -> Array:
        """Standard deviations of the base parameters, shape (b,)."""
        return self.fit.deviation

    @property
    def correlation(self) -> Array:
        """Correlations of the base parameters, shape (b, b)."""
        return np.asarray(self.fit.covariance / np.outer(self.deviation, self.deviation))

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
        states, rows, group = equations(measured, Geometry.of(self.given), cutoff)
        known, columns = self.regressor(*states)
        torque = known + self.base.of_columns(columns) @ self.estimate
        return torque.reshape(-1, group, 3).mean(axis=1), measured.torque[rows]

    def table(self) -> str:
        """Estimates with standard deviations, and what the motion does not determine, as text."""
        return "\n".join(self._lines()) + "\n"

    def _lines(self) -> Iterator[str]:
        before = self.base.transform @ _values(self)
        yield f"{'given':>12} {'estimate':>12} {'std. dev.':>10} {'relative':>9}  base parameter"
        rows = zip(before, self.estimate, self.deviation, self.base.labels, strict=True)
        for given, value, deviation, label in rows:
            share = f"{100.0 * deviation / abs(value):8.2f} %" if value else "        -"
            yield f"{given:12.5g} {value:12.5g} {deviation:10.2g} {share[:10]}  {label}"
        yield ""
        noise = ", ".join(f"{value:.3g}" for value in self.fit.noise)
        yield f"{len(self.fit.residual)} samples; noise of the torques {noise} N m (std. dev.)"
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
        for label in self.undetermined:
            yield f"not determined by this motion: {label}"
        for label in self.vague:
            yield f"uncertain by more than its size: {label}"
        if self.undetermined or self.vague:
            yield "another motion would help: `sst-ros identify design` makes one"
        yield from self.warnings


def _values(found: Identification) -> Array:
    from sst_ros.identification.parameters import values

    return values(found.given, found.names)
