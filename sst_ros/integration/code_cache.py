# SPDX-License-Identifier: Apache-2.0
"""Machine code of a scene before it is needed: is it there, and make it.

Code is made once for each method and each structure of a scene - its terms, and which numbers are 0
or 1 - which takes seconds, and kept in `cache_folder()`; to load it takes tenths of a second.
"""

from __future__ import annotations

import fcntl
from collections.abc import Iterator

from sst_ros.dynamics.traced_dynamics import Dynamics, ode_with_work
from sst_ros.host.cache_folder import cache_folder
from sst_ros.integration import codegen
from sst_ros.integration.compiled_method import CompiledMethod, Method, has_code
from sst_ros.integration.methods import DOP853, DORMAND_PRINCE, METHODS, RODAS4
from sst_ros.scene.scene import Scene


def is_there(scene: Scene, integrator: str) -> bool:
    """Return whether all code of a run of the scene is there, for each method it may use."""
    if codegen.numba_version() is None:
        return False
    system = ode_with_work(Dynamics.of(scene))
    return all(has_code(system, method) for method in _methods(integrator))


def make(scene: Scene, integrator: str) -> Iterator[str]:
    """Make what is not there; yields the name of each method when its code is there.

    Where another process makes code this does nothing: it would take the processor from it.
    """
    system = ode_with_work(Dynamics.of(scene))
    folder = cache_folder()
    with (folder / "lock").open("w") as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            return
        for method in _methods(integrator):
            if not has_code(system, method):
                size, drive = len(system.state), (0.0,) * len(system.drive)
                y = [0.0, 0.0, 0.0, 1.0, *(0.0,) * (size - 4)]
                machine = CompiledMethod(system, method, compiled=True)
                # What comes out is of no interest: the calls have the code made.
                machine.step_pair(0.0, 1e-3, y, y, drive)
                machine.step_many(1e-3, 1, 1.0, (y, y, (0.0,) * 18), drive)
            yield method.name


def _methods(integrator: str) -> tuple[Method, ...]:
    return (METHODS[integrator],) if integrator in METHODS else (DORMAND_PRINCE, DOP853, RODAS4)
