# SPDX-License-Identifier: Apache-2.0
"""Ticks and states (q, W) of the equations of motion: from a scene, a sample, a recording.

At recorded states the kernel is checked against the paper's equations. What is compared is the
mechanism of the paper: bodies, torques and the products of velocities. Loads that a scene may have
beside them are no part of the paper and are left out on both sides.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import TypeAlias

import numpy as np

from sst_ros.dynamics import kernel
from sst_ros.dynamics.initial_state import accelerate_by_paper, initial_state
from sst_ros.dynamics.traced_dynamics import Dynamics
from sst_ros.errors import SingularConfiguration
from sst_ros.integration.propagator import TickSequence
from sst_ros.mechanism import virtual_work
from sst_ros.mechanism.geometry import Array, Geometry
from sst_ros.mechanism.rates import body_rates
from sst_ros.recording.recording import Recording
from sst_ros.recording.topic_tables import Integers
from sst_ros.scene.scene import Scene

Places: TypeAlias = "slice | list[int] | Integers"

COMPILED_FROM = 10_000
"""From this number of ticks on compilation costs less than it saves."""
PLAIN_TICKS = 60_000
"""So many ticks are compared in plain Python, a minute's work."""
CHUNK = 25_000
"""So many ticks at a time, which bounds the memory."""
WHOLE_RUN_S = 1.0
"""Length of a run [s] where the scene names no duration."""
SAME_START = 1e-9
"""Largest difference [rad], [rad/s] between a first sample and the start that its scene asks for,
where samples are lost and the first one may belong to a later time."""


def ticks_of(recording: Recording) -> TickSequence:
    """Return the recorded ticks."""
    ticks, torque = recording.ticks, recording.ticks.torque
    if Dynamics.of(recording.scene).has_moment_topic and ticks.moment is not None:
        torque = np.hstack([torque, ticks.moment])
    return TickSequence(ticks.start_ns, ticks.end_ns, torque)


def initial(scene: Scene) -> tuple[float, ...]:
    """State at t = 0, seven numbers (quaternion, W in {E} [rad/s]), by the paper's kinematics.

    Actuators that lag add three: they give no torque yet.

    Raises:
        AssemblyError: the initial gamma has no unique admissible assembly.

    """
    lagged = (0.0,) * (scene.lags * 3)
    return (*initial_state(scene, Geometry.of(scene)), *lagged)


def of_samples(geometry: Geometry, recording: Recording, samples: Places) -> Array:
    """States at samples, shape (n, 7 or 10); nan where the orientation was lost.

    Torques that lag are the efforts.
    """
    quaternion = recording.quaternion[samples]
    rates = (recording.gamma_dot, recording.mu_dot, recording.beta_dot)
    rate = body_rates(geometry, quaternion, *(joint[samples] for joint in rates))
    lagged = [recording.effort[samples]] if recording.scene.lags else []
    return np.hstack([quaternion, rate, *lagged])


def begins(recording: Recording) -> bool:
    """Return whether the first sample is that of the start of the run.

    Only a recording that lost samples is doubted: where all are there, a first sample that is not
    what the scene asks for is an error of the simulator, and must be seen as one.
    """
    if recording.time_ns[0] != 0 or recording.diagnostics.get("states_set", "0") != "0":
        return False
    published = recording.diagnostics.get("samples_published", "")
    if published.isdecimal() and int(published) == len(recording.time_ns):
        return True
    start = recording.scene.initial
    off = np.abs(recording.gamma[0] - start.gamma), np.abs(recording.gamma_dot[0] - start.gamma_dot)
    return bool(np.max(off) < SAME_START)


def joint_columns(model: kernel.Model, states: Array) -> Array:
    """Nine angles [rad] and nine rates [rad/s], as in `kernel.Joints`, of states, shape (n, 18).

    Rows of nan stay nan.
    """
    with np.errstate(all="ignore"):
        found = kernel.joints(model, tuple(states[:, :7].T))
    return np.stack([column for triple in found for column in triple], axis=1)


def outputs(model: kernel.Model, states: Array) -> tuple[Array, Array, Array]:
    """Compute unit quaternions (n, 4), gamma [rad] and gamma_dot [rad/s] (n, 3) of n states."""
    quaternion = states[:, :4] / np.linalg.norm(states[:, :4], axis=1)[:, None]
    joints = joint_columns(model, states)
    return quaternion, joints[:, :3], joints[:, 9:12]


STATES = 20

PAPER = ("name", "description", "base", "star", "actuated_links", "intermediate_links", "initial")
"""Sections of a scene that the paper has."""


def compare_with_paper(
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
            paper, _ = accelerate_by_paper(mechanism, state, (first, second, third))
        except (SingularConfiguration, np.linalg.LinAlgError):
            continue
        ours = np.array(kernel.derivative(model, state, (first, second, third))[4:7])
        differences.append(float(np.linalg.norm(ours - paper)))
        sizes.append(float(np.linalg.norm(paper)))
    if not sizes:
        return None, 0
    scale = max(sizes)
    return max(differences) / (scale if scale > 0.0 else 1.0), len(sizes)


def check_with_paper(recording: Recording, count: int = STATES) -> tuple[float | None, int]:
    """Compare at samples spread over the run, under the torques recorded there."""
    whole = np.flatnonzero(np.isfinite(recording.quaternion).all(axis=1))
    chosen = np.unique(np.linspace(0, len(whole) - 1, count).round().astype(int))
    samples = whole[chosen] if len(whole) else np.empty(0, dtype=int)
    states = of_samples(Geometry.of(recording.scene), recording, samples)
    # The torque that acts, lagged or not.
    acting = recording.effort[samples].tolist()
    return compare_with_paper(recording.scene, zip(states, acting, strict=True))
