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
    from sst_ros.control.controller import InverseDynamics as InverseDynamics
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
    from sst_ros.scene.scene import Scene as Scene
    from sst_ros.scene.torque_profile import PolynomialTorque as PolynomialTorque
    from sst_ros.scene.torque_profile import SineTorque as SineTorque
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

_RENAMED = {
    "direct_kinematics": ("sst_ros.mechanism.kinematics", "direct"),
    "inverse_kinematics": ("sst_ros.mechanism.kinematics", "inverse"),
    "load_scene": ("sst_ros.scene.scene", "load"),
    "read_bag": ("sst_ros.recording.recording", "read"),
}

if not TYPE_CHECKING:  # type checkers know the names above, and must refuse all others

    def _read_exports() -> dict[str, tuple[str, str]]:
        """Read modules and names of the exports from the imports above, which are their list."""
        lines = __spec__.loader.get_data(__file__).decode().splitlines()
        words = [line.split() for line in lines if line.startswith("    from sst_ros.")]
        own = {shown: (module, name) for _, module, _, name, _, shown in words if name == shown}
        return own | _RENAMED

    _EXPORTS = _read_exports()
    __all__ = ["__version__", *sorted(_EXPORTS)]

    def __getattr__(name: str) -> object:
        if name not in _EXPORTS:
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        module, attribute = _EXPORTS[name]
        value: object = getattr(importlib.import_module(module), attribute)
        globals()[name] = value
        return value

    def __dir__() -> list[str]:
        return __all__
