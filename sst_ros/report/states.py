# SPDX-License-Identifier: Apache-2.0
"""States (q, W) of the equations of motion: from a scene, from a sample, and back to joints."""

from __future__ import annotations

import numpy as np

from sst_ros.mechanism import kernel
from sst_ros.mechanism.frames import rotation_matrix
from sst_ros.mechanism.geometry import Array, Geometry
from sst_ros.mechanism.start import initial_state
from sst_ros.report.recording import Recording
from sst_ros.scene import Scene

Vector = tuple[float, ...]

SAME_START = 1e-9
"""Largest difference [rad], [rad/s] between a first sample and the start that its scene asks for,
where samples are lost and the first one may belong to a later time."""


def initial(scene: Scene) -> Vector:
    """State at t = 0, seven numbers (quaternion, W in {E} [rad/s]), by the paper's kinematics.

    Actuators that lag add three: they give no torque yet.

    Raises:
        AssemblyError: the initial gamma has no unique admissible assembly.

    """
    lagged = (0.0,) * (lags(scene) * 3)
    return (*initial_state(scene, Geometry.of(scene)), *lagged)


def lags(scene: Scene) -> bool:
    """Tell whether the torques of the actuators are part of the state."""
    return scene.actuators is not None and scene.actuators.time_constant is not None


def recorded(geometry: Geometry, recording: Recording, sample: int) -> Vector | None:
    """State at a sample, or None where its orientation was lost.

    W follows from each leg, W = w gamma_dot - r mu_dot - t beta_dot (Eq. 10), without a matrix
    that could be singular; the mean of the three is taken. Torques that lag are its effort.
    """
    quaternion = recording.quaternion[sample]
    if not np.all(np.isfinite(quaternion)):
        return None
    t, w = geometry.e, geometry.w @ rotation_matrix(quaternion)  # rows in {E}
    r = np.cross(t, w)
    r /= np.linalg.norm(r, axis=1)[:, None]
    gamma_dot, mu_dot, beta_dot = (
        rate[sample][:, None]
        for rate in (recording.gamma_dot, recording.mu_dot, recording.beta_dot)
    )
    rate = (w * gamma_dot - r * mu_dot - t * beta_dot).mean(axis=0)
    lagged = recording.effort[sample].tolist() if lags(recording.scene) else ()
    return (*quaternion.tolist(), *rate.tolist(), *lagged)


def begins(recording: Recording) -> bool:
    """Tell whether the first sample is that of the start of the run.

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


def outputs(model: kernel.Model, states: Array) -> tuple[Array, Array, Array]:
    """Compute unit quaternions (n, 4), gamma [rad] and gamma_dot [rad/s] (n, 3) of n states.

    Rows of nan stay nan.
    """
    quaternion = states[:, :4] / np.linalg.norm(states[:, :4], axis=1)[:, None]
    gamma, gamma_dot = np.full((2, len(states), 3), np.nan)
    for row in np.flatnonzero(np.isfinite(states).all(axis=1)):
        joints = kernel.joints(model, tuple(states[row].tolist()))
        gamma[row], gamma_dot[row] = joints.gamma, joints.gamma_dot
    return quaternion, gamma, gamma_dot
