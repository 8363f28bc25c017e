# SPDX-License-Identifier: Apache-2.0
"""identify(): constants of a scene from a recorded or simulated motion."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from sst_ros.errors import InputError, Problem
from sst_ros.identification.measured_motion import Measured, open_data
from sst_ros.identification.parameters import Identification
from sst_ros.identification.simulation_fit import fit_simulation
from sst_ros.identification.torque_fit import fit_torques
from sst_ros.scene.scene import Scene, scene_of

INVERSE_DYNAMICS, SIMULATION = "inverse_dynamics", "simulation"
Given = Scene | Mapping[str, Any] | str | Path | None


def identify(
    data: Measured,
    scene: Given = None,
    parameters: Iterable[str] | None = None,
    method: str = INVERSE_DYNAMICS,
    *,
    cutoff: float | None = None,
    delay: float = 0.0,
    noise: Iterable[float] | None = None,
) -> Identification:
    """Identify constants of a scene from a motion.

    By inverse dynamics: torques are linear in inertial parameters, friction coefficients, stiffness
    and rotor inertia; weighted least squares gives the combinations of them that the motion
    determines, with their covariance, and the nearest scene whose bodies can exist.

    By simulation: the motion is integrated from the initial state of the scene, and nonlinear least
    squares fits it to measured angles by any number of the scene ("friction.gamma.smoothing",
    "actuators.time_constant", "stroke.restitution", "initial.gamma_dot[0]").

    Args:
        data: a recording or its path, a `Trajectory`, or a mapping of arrays: t [s], gamma [rad]
            (n, 3), torque [N m] (n, 3), and where they are known gamma_dot [rad/s] (n, 3),
            quaternion (4,) at the first sample, held (torques act to the next sample). By
            simulation also numbers read off a figure: t, any of gamma_1 to gamma_3, theta, phi,
            psi [rad], x, y, z [m], and deviation, their standard deviation.
        scene: what is known of the manipulator, and the values to start from; by default the
            scene of the data.
        parameters: names of unknowns, by inverse dynamics also how their names begin ("star",
            "friction.gamma", "offset"), and by default the bodies, friction, springs and rotors
            that the scene has.
        method: "inverse_dynamics" or "simulation".
        cutoff: of the zero-phase filter of the angles [Hz]; by default none where rates were
            measured, else ten times the bandwidth of the motion.
        delay: time by which the measured torques come late [s].
        noise: standard deviations of the torques [N m], three; by default estimated.

    Returns:
        A `TorqueFit` by inverse dynamics, a `SimulationFit` by simulation.

    Raises:
        InputError: the data are not sound, the motion determines nothing, or an argument is not
            allowed.

    """
    if method not in (INVERSE_DYNAMICS, SIMULATION):
        allowed = f"must be {INVERSE_DYNAMICS} or {SIMULATION}"
        raise InputError("identify", [Problem("method", method, allowed)])
    data = open_data(data)
    known = scene if scene is not None else getattr(data, "scene", None)
    if known is None:
        raise InputError("identify", [Problem("scene", None, "must be given with arrays")])
    if method == INVERSE_DYNAMICS:
        return fit_torques(data, scene_of(known), parameters, cutoff, delay, noise)
    if cutoff is not None or delay or noise is not None:
        problem = Problem("method", method, "takes no cutoff, delay or noise")
        raise InputError("identify", [problem])
    return fit_simulation(data, scene_of(known), parameters)
