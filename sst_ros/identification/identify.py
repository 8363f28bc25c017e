# SPDX-License-Identifier: Apache-2.0
"""identify(): constants of a scene from a recorded or simulated motion."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from sst_ros.errors import InputError, Problem
from sst_ros.identification import base_parameters, parameters
from sst_ros.identification.consistency import consistent_values, scales
from sst_ros.identification.derivatives import equations
from sst_ros.identification.identification import Identification
from sst_ros.identification.least_squares import weighted_fit
from sst_ros.identification.measured_motion import Measured, measured_motion
from sst_ros.identification.regressor import Regressor
from sst_ros.mechanism.geometry import Array, Geometry
from sst_ros.scene.given import scene_of
from sst_ros.scene.scene import Scene

METHODS = ("inverse_dynamics", "simulation")

STILL = 1e-6
"""Range of gamma [rad] below which a motion is none."""


def identify(
    data: Measured,
    scene: Scene | Mapping[str, Any] | str | Path | None = None,
    parameters: Iterable[str] | None = None,
    method: str = "inverse_dynamics",
    *,
    cutoff: float | None = None,
    delay: float = 0.0,
    noise: Iterable[float] | None = None,
) -> Identification:
    """Identify constants of a scene from a motion and its torques.

    Torques are linear in inertial parameters, friction coefficients, stiffness and rotor inertia;
    weighted least squares gives the combinations of them that the motion determines, with their
    covariance, and the nearest scene whose bodies can exist.

    Args:
        data: a recording or its path, a `Trajectory`, or a mapping of arrays: t [s], gamma [rad]
            (n, 3), torque [N m] (n, 3), and where they are known gamma_dot [rad/s] (n, 3),
            quaternion (4,) at the first sample, held (torques act to the next sample).
        scene: what is known of the manipulator, and the values to start from; by default the
            scene of the data.
        parameters: names of unknowns, or how their names begin ("star", "friction.gamma",
            "offset"); by default the bodies, friction, springs and rotors that the scene has.
        method: "inverse_dynamics", linear least squares on torques.
        cutoff: of the zero-phase filter of the angles [Hz]; by default none where rates were
            measured, else ten times the bandwidth of the motion.
        delay: time by which the measured torques come late [s].
        noise: standard deviations of the torques [N m], three; by default estimated.

    Raises:
        InputError: the data are not sound, the motion determines nothing, or an argument is not
            allowed.

    """
    if method not in METHODS:
        raise InputError("identify", [Problem("method", method, f"must be one of {METHODS}")])
    if scene is None:
        scene = getattr(data, "scene", None)
        if isinstance(data, (str, Path)):
            from sst_ros.recording.recording import read

            data = read(data)
            scene = data.scene
        if scene is None:
            raise InputError("identify", [Problem("scene", None, "must be given with arrays")])
    return _by_inverse_dynamics(data, scene_of(scene), parameters, cutoff, delay, noise)


def _by_inverse_dynamics(
    data: Measured,
    scene: Scene,
    wanted: Iterable[str] | None,
    cutoff: float | None,
    delay: float,
    noise: Iterable[float] | None,
) -> Identification:
    names = parameters.selected(scene, wanted)
    measured = measured_motion(data, scene, delay)
    if float(np.ptp(measured.gamma, axis=0).max()) < STILL and scene.gravity is None:
        allowed = f"moves by less than {STILL:g} rad: a manipulator at rest shows no inertia"
        raise InputError("identify", [Problem("gamma", float(np.ptp(measured.gamma)), allowed)])
    regressor = Regressor(scene, names)
    states, rows, group = equations(measured, Geometry.of(scene), cutoff)
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
    torque = (measured.torque[rows] - known)[sound]
    columns = columns[sound]
    if 3 * len(torque) < 3 * len(names) + 3:
        allowed = f"must leave more than {len(names) + 1} samples for {len(names)} parameters"
        raise InputError("identify", [Problem("t", len(torque), allowed)])
    base = base_parameters.independent(columns, names)
    if not base.chosen:
        allowed = "must determine something: no torque depends on these parameters here"
        raise InputError("identify", [Problem("parameters", list(names), allowed)])
    lost = [
        label for label, i in zip(*_of_mechanism(regressor), strict=True) if i not in base.chosen
    ]
    deviations = None if noise is None else _three(noise)
    fit = weighted_fit(base.of_columns(columns), torque, deviations)
    given = parameters.values(scene, names)
    reach = max(scene.base.radius, scene.star.radius)
    values, excess = consistent_values(names, given, base, fit, reach)
    sizes = scales(names, given)[list(base.chosen)]
    vague = [base.labels[i] for i in np.flatnonzero(fit.deviation > np.maximum(sizes, 1e-300))]
    return Identification(
        scene=parameters.with_parameters(
            scene, names, values, f"identified ({len(torque)} samples)"
        ),
        given=scene,
        names=names,
        values=values,
        base=base,
        fit=fit,
        excess=excess,
        undetermined=tuple(lost),
        vague=tuple(vague),
        warnings=tuple(warnings),
        regressor=regressor,
    )


def _of_mechanism(regressor: Regressor) -> tuple[tuple[str, ...], tuple[int, ...]]:
    found = base_parameters.structural(regressor)
    return found.labels, found.chosen


def _three(noise: Iterable[float]) -> Array:
    numbers = np.asarray(list(noise), dtype=float)
    if numbers.shape != (3,) or not np.all(np.isfinite(numbers) & (numbers > 0.0)):
        allowed = "must be three finite standard deviations > 0 [N m]"
        raise InputError("identify", [Problem("noise", noise, allowed)])
    return numbers
