# SPDX-License-Identifier: Apache-2.0
"""Simulator of the 3-RRP spherical star-triangle parallel manipulator.

`simulate` returns a whole motion as a `Trajectory`; `Simulation` goes step by step, for control
loops; `sweep` runs a study of many runs, on this machine or on a cluster. All names are imported
when they are first used.
"""

from __future__ import annotations

import importlib

from sst_ros.version import VERSION

TYPE_CHECKING = False  # typing takes long to import, and a node handles signals only after this
if TYPE_CHECKING:
    from sst_ros.control.actuator_space import ReferenceMotion as ReferenceMotion
    from sst_ros.control.controller import Controller as Controller
    from sst_ros.control.inverse_dynamics import InverseDynamics as InverseDynamics
    from sst_ros.control.law import ControllerSettings as ControllerSettings
    from sst_ros.control.reference_motions import reference_motion as reference_motion
    from sst_ros.errors import AssemblyError as AssemblyError
    from sst_ros.errors import InputError as InputError
    from sst_ros.errors import RunStopped as RunStopped
    from sst_ros.errors import SingularConfiguration as SingularConfiguration
    from sst_ros.errors import SstError as SstError
    from sst_ros.identification.identify import identify as identify
    from sst_ros.identification.parameters import Identification as Identification
    from sst_ros.integration.batch import Batch as Batch
    from sst_ros.mechanism import kinematics as _kinematics
    from sst_ros.mechanism.geometry import Geometry as Geometry
    from sst_ros.mechanism.workspace import workspace as workspace
    from sst_ros.plot.workspace import plot_workspace as plot_workspace
    from sst_ros.recording import recording as _recording
    from sst_ros.recording.recording import Recording as Recording
    from sst_ros.scene import scene as _scene
    from sst_ros.scene.bodies import arc_inertia as arc_inertia
    from sst_ros.scene.loads import SineTorque as SineTorque
    from sst_ros.scene.scene import Scene as Scene
    from sst_ros.scene.torque_profile import PolynomialTorque as PolynomialTorque
    from sst_ros.scene.torque_profile import TorqueTable as TorqueTable
    from sst_ros.simulation.simulate import prepare as prepare
    from sst_ros.simulation.simulate import simulate as simulate
    from sst_ros.simulation.simulation import Simulation as Simulation
    from sst_ros.simulation.trajectory import Trajectory as Trajectory
    from sst_ros.state import State as State
    from sst_ros.sweeps.sweep import sweep as sweep

    direct_kinematics, inverse_kinematics = _kinematics.direct, _kinematics.inverse
    load_scene, read_bag = _scene.load, _recording.read

__version__ = VERSION

# Module of each name, and its name there where that is another one.
_MODULES = {
    "AssemblyError": "errors",
    "Batch": "integration.batch",
    "Controller": "control.controller",
    "ControllerSettings": "control.law",
    "Geometry": "mechanism.geometry",
    "Identification": "identification.parameters",
    "InputError": "errors",
    "InverseDynamics": "control.inverse_dynamics",
    "PolynomialTorque": "scene.torque_profile",
    "Recording": "recording.recording",
    "ReferenceMotion": "control.actuator_space",
    "RunStopped": "errors",
    "Scene": "scene.scene",
    "Simulation": "simulation.simulation",
    "SineTorque": "scene.loads",
    "SingularConfiguration": "errors",
    "SstError": "errors",
    "State": "state",
    "TorqueTable": "scene.torque_profile",
    "Trajectory": "simulation.trajectory",
    "arc_inertia": "scene.bodies",
    "direct_kinematics": "mechanism.kinematics:direct",
    "identify": "identification.identify",
    "inverse_kinematics": "mechanism.kinematics:inverse",
    "load_scene": "scene.scene:load",
    "plot_workspace": "plot.workspace",
    "prepare": "simulation.simulate",
    "read_bag": "recording.recording:read",
    "reference_motion": "control.reference_motions",
    "simulate": "simulation.simulate",
    "sweep": "sweeps.sweep",
    "workspace": "mechanism.workspace",
}


if not TYPE_CHECKING:  # type checkers know the names above, and must refuse all others
    __all__ = ["__version__", *_MODULES]

    def __getattr__(name: str) -> object:
        if name not in _MODULES:
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        module, _, attribute = _MODULES[name].partition(":")
        value: object = getattr(importlib.import_module(f"sst_ros.{module}"), attribute or name)
        globals()[name] = value
        return value

    def __dir__() -> list[str]:
        return __all__
