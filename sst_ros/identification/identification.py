# SPDX-License-Identifier: Apache-2.0
"""The result of an identification: estimates, their uncertainty, and the scene."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from sst_ros.mechanism.geometry import Array
from sst_ros.scene.scene import Scene


@dataclass(frozen=True)
class Identification(ABC):
    """Identified constants of a scene, by torques or by simulation.

    Attributes:
        scene: the scene with identified values, whose bodies can exist.
        given: the scene as it was.
        names: of the parameters, length p.
        values: their values in `scene`, shape (p,).
        labels: quantities that are estimated: parameters or combinations of them, length b.
        before: their values in the scene that was given, shape (b,).
        estimate: their estimates, shape (b,).
        covariance: of the estimates, shape (b, b).
        undetermined: combinations that this motion leaves open, as text.
        warnings: what else to know.

    """

    scene: Scene
    given: Scene
    names: tuple[str, ...]
    values: Array
    labels: tuple[str, ...]
    before: Array
    estimate: Array
    covariance: Array
    undetermined: tuple[str, ...]
    warnings: tuple[str, ...]

    @property
    def deviation(self) -> Array:
        """Standard deviations of the estimates, shape (b,)."""
        return np.asarray(np.sqrt(np.diag(self.covariance)))

    @property
    def correlation(self) -> Array:
        """Correlations of the estimates, shape (b, b)."""
        return np.asarray(self.covariance / np.outer(self.deviation, self.deviation))

    def table(self) -> str:
        """Return estimates, standard deviations, and what the motion leaves open, as text."""
        return "\n".join([*self._rows(), "", *self._notes(), *self.warnings]) + "\n"

    @abstractmethod
    def _notes(self) -> Iterator[str]:
        """Yield lines below the estimates."""

    def _rows(self) -> Iterator[str]:
        yield f"{'given':>12} {'estimate':>12} {'std. dev.':>10} {'relative':>10}  parameter"
        rows = zip(self.before, self.estimate, self.deviation, self.labels, strict=True)
        for given, value, deviation, label in rows:
            share = f"{deviation / abs(value):10.2%}" if deviation < abs(value) else f"{'-':>10}"
            yield f"{given:12.5g} {value:12.5g} {deviation:10.2g} {share}  {label}"
