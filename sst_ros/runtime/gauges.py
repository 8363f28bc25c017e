# SPDX-License-Identifier: Apache-2.0
"""What a simulation says about itself, as key and number. The one place that asks it."""

from __future__ import annotations

import math

from sst_ros.dynamics.limits import limits_of
from sst_ros.simulation import Simulation

GAUGES = {
    "error_estimate": "estimated error of the orientation so far [rad]",
    "rate_error_estimate": "estimated error of the body rate so far [rad/s]",
    "energy_residual_J": "energy, less that of the start, less the work done since [J]",
    "closure_residual": "largest abs(r_k . t_k), 0 where the loops are closed",
    "singularity_serial": "least sin(mu_k), 0 at a serial singularity",
    "singularity_parallel": "det J2, 0 at a parallel singularity",
    "stroke_margin_rad": "least distance of gamma to an end of the stroke [rad]",
    "workspace_margin_rad": "least distance of beta to the edge of the workspace [rad]",
    "integrator": "method in use",
    "integrator_changes": "how often it was changed",
}


def read(simulation: Simulation) -> dict[str, object]:
    """Read all gauges; in the thread that steps it. What there is none of is left out."""
    state = simulation.state
    conditioning = simulation.conditioning
    angles = (*state.joints.gamma, *state.joints.mu, *state.joints.beta)
    margins: dict[bool, list[float]] = {True: [], False: []}
    for limit in limits_of(simulation.scene, simulation.geometry):
        if limit.joint < 3 or limit.joint >= 6:
            margins[limit.joint < 3].append(limit.margin(angles))
    values: dict[str, object] = {
        "error_estimate": simulation.error_estimate,
        "rate_error_estimate": simulation.rate_error_estimate,
        "energy_residual_J": simulation.energy_residual,
        "closure_residual": simulation.closure_residual,
        "singularity_serial": conditioning["sin_mu"],
        "singularity_parallel": conditioning["det_j2"],
        "stroke_margin_rad": min(margins[True], default=None),
        "workspace_margin_rad": min(margins[False], default=None),
        "integrator": simulation.method,
        "integrator_changes": len(simulation.changes),
    }
    return {key: value for key, value in values.items() if _is_known(value)}


def _is_known(value: object) -> bool:
    return value is not None and not (isinstance(value, float) and not math.isfinite(value))
