# SPDX-License-Identifier: Apache-2.0
"""Identification by simulation: the motion that fits measured angles, by any constant of a scene.

Gauss-Newton steps of SciPy's `least_squares` with the sensitivities of the variational equations.
In sizes of the parameters, the singular values of the sensitivities over the measuring errors show
which combinations are known and how well: a motion, and even more a single number read off a
figure, may fix fewer combinations than there are parameters.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares

from sst_ros.errors import InputError, Problem
from sst_ros.identification.identification import Identification
from sst_ros.identification.measured_motion import Measured
from sst_ros.identification.possible_scene import possible_scene
from sst_ros.identification.readings import Readings, readings
from sst_ros.identification.scene_numbers import value_of
from sst_ros.identification.sensitivities import Sensitivities
from sst_ros.mechanism.geometry import Array
from sst_ros.scene.scene import Scene

OPEN = 1.0
"""Relative standard deviation of a combination from which on it counts as not determined."""

_SHOWN = 0.05


@dataclass(frozen=True)
class SimulationFit(Identification):
    """Constants identified by simulation; `values` differ from estimates that no body has.

    Attributes:
        relative: relative standard deviations of the combinations `directions`, rising, (p,).
        directions: combinations as rows, relative changes of the parameters, shape (p, p).
        error: root of the mean square of the residuals in standard deviations, or in [rad], [m]
            where those were not given.

    """

    relative: Array
    directions: Array
    error: float

    def _notes(self) -> Iterator[str]:
        yield f"root of the mean square of the residuals {self.error:.3g}"
        for deviation, row in zip(self.relative, self.directions, strict=True):
            text = combination(row, self.names)
            if deviation < OPEN:
                yield f"known to {deviation:.2g}: {text}"
            else:
                yield f"not determined: {text}"


def fit_simulation(data: Measured, scene: Scene, wanted: Iterable[str] | None) -> SimulationFit:
    """Identify by simulation; arguments as for `identify`."""
    names = (wanted,) if isinstance(wanted, str) else tuple(wanted or ())
    if not names:
        allowed = "must be keys of numbers of the scene, with method simulation"
        raise InputError("identify", [Problem("parameters", wanted, allowed)])
    read = readings(data, scene)
    motion = Sensitivities(scene, names, read.torque)
    given = np.array([value_of(scene, name) for name in names], dtype=float)
    size = np.abs(given) + (given == 0.0)

    known: dict[bytes, tuple[Array, Array]] = {}

    def both(x: Array) -> tuple[Array, Array]:
        key = x.tobytes()
        if key not in known:
            known.clear()
            known[key] = _residual(motion, read, x * size)
        return known[key]

    least = np.where([_positive(name) for name in names], 1e-3, -np.inf)
    found = least_squares(
        lambda x: both(x)[0], given / size, lambda x: both(x)[1] * size, bounds=(least, np.inf),
        xtol=1e-13, ftol=1e-13, gtol=None, max_nfev=100,
    )  # fmt: skip
    off, slopes = both(found.x)
    fitted = found.x * size
    scale = np.where(fitted == 0.0, 1.0, fitted)  # changes of logarithms
    error = float(np.sqrt(np.mean(off**2)))
    unit = 1.0
    if read.deviation is None:  # estimated from the residuals
        unit = float(np.sqrt(np.sum(off**2) / max(len(off) - len(names), 1))) + 1e-300
    _, singular, rows = np.linalg.svd(slopes * scale / unit, full_matrices=True)
    relative = np.full(len(names), np.inf)
    some = singular > 1e-12 * max(float(singular[0]), 1e-300)
    relative[: len(singular)][some] = 1.0 / singular[some]
    finite = np.minimum(relative, 1e9)
    spread = (rows.T * finite**2) @ rows * np.outer(scale, scale)
    text = (combination(row, names) for row in rows[relative >= OPEN])
    note = "identified by simulation"
    adjusted, values, warnings = possible_scene(scene, names, fitted, note)
    return SimulationFit(
        scene=adjusted,
        given=scene,
        names=names,
        values=values,
        labels=names,
        before=given,
        estimate=fitted,
        covariance=spread,
        undetermined=tuple(text),
        warnings=warnings,
        relative=relative,
        directions=rows,
        error=error,
    )


def combination(row: Array, names: tuple[str, ...]) -> str:
    """Write relative changes as a product of powers."""
    largest = float(np.abs(row).max())
    sign = np.sign(row[int(np.argmax(np.abs(row)))])
    parts = [
        f"{name}^{sign * value:+.2f}"
        for name, value in zip(names, row, strict=True)
        if abs(value) > _SHOWN * largest
    ]
    return " ".join(parts)


def _residual(motion: Sensitivities, read: Readings, values: Array) -> tuple[Array, Array]:
    """Residuals, shape (r,), and their derivatives by the parameters, shape (r, p)."""
    begin = read.t if read.t[-1] > 0.0 else np.append(read.t, 1e-9)
    states, slopes = motion.run(values, begin)
    count = len(read.t)
    off, by_pose = read.residual(motion.scene, states[:count])
    poses = slopes[:count][read.times_of_residuals][:, :4]
    return off, np.einsum("ri,rip->rp", by_pose, poses)


def _positive(name: str) -> bool:
    last = name.rpartition(".")[2]
    if name.startswith(("friction", "actuators", "stroke", "springs")):
        return last != "rest"
    return last in ("mass", "xx", "yy", "zz")
