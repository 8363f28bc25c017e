# SPDX-License-Identifier: Apache-2.0
"""Simulator of the 3-RRP spherical star-triangle parallel manipulator.

`simulate` returns a whole motion as a `Trajectory`; `Simulation` goes step by step, for control
loops; `sweep` runs a study of many runs, on this machine or on a cluster. All names are imported
when they are first used.
"""

from __future__ import annotations

import importlib

TYPE_CHECKING = False  # typing takes long to import, and a node handles signals only after this
if TYPE_CHECKING:
    from sst_ros.control.controller import Controller
    from sst_ros.control.controller_settings import ControllerSettings
    from sst_ros.control.inverse_dynamics import InverseDynamics
    from sst_ros.control.reference import ReferenceMotion
    from sst_ros.control.reference_motions import reference_motion
    from sst_ros.errors import (
        AssemblyError,
        InputError,
        RunStopped,
        SingularConfiguration,
        SstError,
    )
    from sst_ros.identification.identification import Identification
    from sst_ros.identification.identify import identify
    from sst_ros.integration.batch import Batch
    from sst_ros.mechanism.geometry import Geometry
    from sst_ros.mechanism.kinematics import direct as direct_kinematics
    from sst_ros.mechanism.kinematics import inverse as inverse_kinematics
    from sst_ros.mechanism.workspace import workspace
    from sst_ros.plot.workspace import plot_workspace
    from sst_ros.recording.recording import Recording
    from sst_ros.recording.recording import read as read_bag
    from sst_ros.scene.arcs import arc_inertia
    from sst_ros.scene.loads import SineTorque
    from sst_ros.scene.scene import Scene
    from sst_ros.scene.scene import load as load_scene
    from sst_ros.simulation.simulate import simulate
    from sst_ros.simulation.simulation import Simulation
    from sst_ros.simulation.torque import TorqueTable
    from sst_ros.simulation.torque_profile import PolynomialTorque
    from sst_ros.simulation.trajectory import Trajectory
    from sst_ros.state import State
    from sst_ros.sweeps.sweep import sweep

__version__ = "0.1.0"

__all__ = [
    "AssemblyError",
    "Batch",
    "Controller",
    "ControllerSettings",
    "Geometry",
    "Identification",
    "InputError",
    "InverseDynamics",
    "PolynomialTorque",
    "Recording",
    "ReferenceMotion",
    "RunStopped",
    "Scene",
    "Simulation",
    "SineTorque",
    "SingularConfiguration",
    "SstError",
    "State",
    "TorqueTable",
    "Trajectory",
    "__version__",
    "arc_inertia",
    "direct_kinematics",
    "identify",
    "inverse_kinematics",
    "load_scene",
    "plot_workspace",
    "read_bag",
    "reference_motion",
    "simulate",
    "sweep",
    "workspace",
]

# Module of each name, and its name there where that is another one.
_MODULES = {
    "AssemblyError": "errors",
    "Batch": "integration.batch",
    "Controller": "control.controller",
    "ControllerSettings": "control.controller_settings",
    "Geometry": "mechanism.geometry",
    "Identification": "identification.identification",
    "InputError": "errors",
    "InverseDynamics": "control.inverse_dynamics",
    "PolynomialTorque": "simulation.torque_profile",
    "Recording": "recording.recording",
    "ReferenceMotion": "control.reference",
    "RunStopped": "errors",
    "Scene": "scene.scene",
    "Simulation": "simulation.simulation",
    "SineTorque": "scene.loads",
    "SingularConfiguration": "errors",
    "SstError": "errors",
    "State": "state",
    "TorqueTable": "simulation.torque",
    "Trajectory": "simulation.trajectory",
    "arc_inertia": "scene.arcs",
    "direct_kinematics": "mechanism.kinematics:direct",
    "identify": "identification.identify",
    "inverse_kinematics": "mechanism.kinematics:inverse",
    "load_scene": "scene.scene:load",
    "plot_workspace": "plot.workspace",
    "read_bag": "recording.recording:read",
    "reference_motion": "control.reference_motions",
    "simulate": "simulation.simulate",
    "sweep": "sweeps.sweep",
    "workspace": "mechanism.workspace",
}


if not TYPE_CHECKING:  # type checkers know the names above, and must refuse all others

    def __getattr__(name: str) -> object:
        if name not in _MODULES:
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        module, _, attribute = _MODULES[name].partition(":")
        value: object = getattr(importlib.import_module(f"sst_ros.{module}"), attribute or name)
        globals()[name] = value
        return value


def __dir__() -> list[str]:
    return __all__
