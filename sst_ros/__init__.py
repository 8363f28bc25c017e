# SPDX-License-Identifier: Apache-2.0
"""Simulator of the 3-RRP spherical star-triangle parallel manipulator.

`simulate` returns a whole motion as a `Trajectory`; `Simulation` goes step by step, for
control loops; `sweep` runs a study of many runs, on this machine or on a cluster. All
names are imported when they are first used, and no module of the package before: a
command handles an interrupt only after this.
"""

from __future__ import annotations

import importlib

# typing takes long to import
TYPE_CHECKING = False
if TYPE_CHECKING:
    from sst_ros.code_generation.equations import Equations as Equations
    from sst_ros.code_generation.equations import equations as equations
    from sst_ros.control.actuator_space import ReferenceMotion as ReferenceMotion
    from sst_ros.control.controller import Controller as Controller
    from sst_ros.control.controller import InverseDynamics as InverseDynamics
    from sst_ros.control.law import ControllerSettings as ControllerSettings
    from sst_ros.control.linearize import LinearModel as LinearModel
    from sst_ros.control.linearize import equilibrium as equilibrium
    from sst_ros.control.linearize import linearize as linearize
    from sst_ros.control.reference_motions import reference_motion as reference_motion
    from sst_ros.dynamics.own_loads import own_load as own_load
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
    from sst_ros.mechanism.nearest_singularity import (
        distance_to_singularity as distance_to_singularity,
    )
    from sst_ros.mechanism.workspace import workspace as workspace
    from sst_ros.plot.workspace import plot_workspace as plot_workspace
    from sst_ros.plot.workspace import plot_zone as plot_zone
    from sst_ros.proof.certify import ProvenMotion as ProvenMotion
    from sst_ros.proof.certify import certify as certify
    from sst_ros.proof.zones import ProvenZone as ProvenZone
    from sst_ros.proof.zones import certify_zone as certify_zone
    from sst_ros.recording import recording as _recording
    from sst_ros.recording.recording import Recording as Recording
    from sst_ros.scene import scene as _scene
    from sst_ros.scene.bodies import arc_inertia as arc_inertia
    from sst_ros.scene.scene import Scene as Scene
    from sst_ros.scene.torque_profile import PolynomialTorque as PolynomialTorque
    from sst_ros.scene.torque_profile import SineTorque as SineTorque
    from sst_ros.scene.torque_profile import TorqueTable as TorqueTable
    from sst_ros.simulation.simulate import simulate as simulate
    from sst_ros.simulation.simulation import Simulation as Simulation
    from sst_ros.simulation.trajectory import Trajectory as Trajectory
    from sst_ros.state import State as State
    from sst_ros.sweeps.sweep import sweep as sweep
    from sst_ros.version import VERSION

    direct_kinematics = _kinematics.direct
    inverse_kinematics = _kinematics.inverse
    load_scene = _scene.scene_of
    read_bag = _recording.read
    __version__ = VERSION

# Names of each module; one that has another name there is followed by it.
_MODULES = {
    "code_generation.equations": "Equations equations",
    "control.actuator_space": "ReferenceMotion",
    "control.controller": "Controller InverseDynamics",
    "control.law": "ControllerSettings",
    "control.linearize": "LinearModel equilibrium linearize",
    "control.reference_motions": "reference_motion",
    "dynamics.own_loads": "own_load",
    "errors": "AssemblyError InputError RunStopped SingularConfiguration SstError",
    "identification.identify": "identify",
    "identification.parameters": "Identification",
    "integration.batch": "Batch",
    "mechanism.geometry": "Geometry",
    "mechanism.kinematics": "direct_kinematics:direct inverse_kinematics:inverse",
    "mechanism.nearest_singularity": "distance_to_singularity",
    "mechanism.workspace": "workspace",
    "plot.workspace": "plot_workspace plot_zone",
    "proof.certify": "ProvenMotion certify",
    "proof.zones": "ProvenZone certify_zone",
    "recording.recording": "Recording read_bag:read",
    "scene.bodies": "arc_inertia",
    "scene.scene": "Scene load_scene:scene_of",
    "scene.torque_profile": "PolynomialTorque SineTorque TorqueTable",
    "simulation.simulate": "simulate",
    "simulation.simulation": "Simulation",
    "simulation.trajectory": "Trajectory",
    "state": "State",
    "sweeps.sweep": "sweep",
    "version": "__version__:VERSION",
}

if not TYPE_CHECKING:  # type checkers know the names above, and must refuse all others
    _EXPORTS = {}
    for _module, _names in _MODULES.items():
        for _export in _names.split():
            _public_name, _, _name = _export.partition(":")
            _EXPORTS[_public_name] = (_module, _name or _public_name)
    __all__ = sorted(_EXPORTS)

    def __getattr__(name: str) -> object:
        if name not in _EXPORTS:
            removed = importlib.import_module("sst_ros.removed").REMOVED_FUNCTIONS
            if name in removed:
                return _refuse_function(name, removed[name])
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        module_name, name_there = _EXPORTS[name]
        module = importlib.import_module(f"sst_ros.{module_name}")
        value: object = getattr(module, name_there)
        globals()[name] = value
        return value

    def _refuse_function(name: str, advice: str) -> object:
        """Return a function that refuses to be called, and says what to use instead."""

        def refuse(*_: object, **__: object) -> None:
            errors = importlib.import_module("sst_ros.errors")
            raise errors.refusal("sst_ros", name, "called", advice)

        return refuse

    def __dir__() -> list[str]:
        return __all__
