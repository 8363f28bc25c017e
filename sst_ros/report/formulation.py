# SPDX-License-Identifier: Apache-2.0
"""The physics itself, checked: the kernel against the paper's equations at recorded states.

What is compared is the mechanism of the paper: bodies, torques and the products of velocities.
Loads that a scene may have beside them are no part of the paper and are left out on both sides.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np

from sst_ros.dynamics import kernel
from sst_ros.dynamics.virtual_work_derivative import body_acceleration
from sst_ros.errors import SingularConfiguration
from sst_ros.mechanism import virtual_work
from sst_ros.mechanism.geometry import Array, Geometry
from sst_ros.recording.recording import Recording
from sst_ros.report import states
from sst_ros.scene.scene import Scene

STATES = 20

PAPER = (
    "name", "description", "base", "star", "actuated_links", "intermediate_links", "initial",
)  # fmt: skip
"""Sections of a scene that the paper has."""


def compare(
    scene: Scene, given: Iterable[tuple[Array, Sequence[float]]]
) -> tuple[float | None, int]:
    """Compare W_dot at states (seven numbers or more) under torques [N m]; loads are left out.

    Returns:
        The largest difference as a part of the largest W_dot of all states, None where no state
        could be compared; and the number of states compared, without those at a singularity of
        the paper's J2.

    """
    bare = Scene(**{name: getattr(scene, name) for name in PAPER})
    mechanism, model = virtual_work.Mechanism.of(bare), kernel.model_of(bare)
    differences, sizes = [], []
    for y, (first, second, third) in given:
        state = tuple(y[:7].tolist())
        try:
            paper, _ = body_acceleration(mechanism, state, (first, second, third))
        except (SingularConfiguration, np.linalg.LinAlgError):
            continue
        ours = np.array(kernel.derivative(model, state, (first, second, third))[4:7])
        differences.append(float(np.linalg.norm(ours - paper)))
        sizes.append(float(np.linalg.norm(paper)))
    if not sizes:
        return None, 0
    scale = max(sizes)
    return max(differences) / (scale if scale > 0.0 else 1.0), len(sizes)


def check(recording: Recording, count: int = STATES) -> tuple[float | None, int]:
    """Compare at samples spread over the run, under the torques recorded there."""
    whole = np.flatnonzero(np.isfinite(recording.quaternion).all(axis=1))
    chosen = np.unique(np.linspace(0, len(whole) - 1, count).round().astype(int))
    samples = whole[chosen] if len(whole) else np.empty(0, dtype=int)
    y = states.recorded(Geometry.of(recording.scene), recording, samples)
    # The torque that acts, lagged or not.
    return compare(recording.scene, zip(y, recording.effort[samples].tolist(), strict=True))
