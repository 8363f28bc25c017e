# SPDX-License-Identifier: Apache-2.0
"""`compile`: make the machine code of a scene before its first fast run."""

from __future__ import annotations

import argparse

from sst_ros.cli import Commands


def add(commands: Commands) -> None:
    """Add the command to the command line."""
    compile_ = commands.add_parser("compile", help="make machine code of a scene for fast runs")
    compile_.add_argument("scene", nargs="?", default="example2", help="by name or by path")
    compile_.add_argument("--integrator", default="auto", help="auto, or the name of a method")
    compile_.set_defaults(run=_compile)


def _compile(options: argparse.Namespace) -> int:
    from sst_ros.integration import code_cache, codegen
    from sst_ros.scene import scene

    if codegen.numba_version() is None:
        print("numba is not installed (or SST_ROS_NUMBA=0)")
        return 1
    simulated = scene.load(options.scene)
    for method in code_cache.make(simulated, options.integrator):
        print(f"{method}: there, in {codegen.cache_folder()}", flush=True)
    there = code_cache.is_there(simulated, options.integrator)
    if not there:
        print("another process makes machine code: try again when it is done")
    return 0 if there else 1
