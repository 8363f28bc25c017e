# SPDX-License-Identifier: Apache-2.0
"""`compile`: compile a scene before its first fast run."""

from __future__ import annotations

import argparse

from sst_ros.cli.parsing import Commands, add_scene


def add(commands: Commands) -> None:
    """Add the command to the command line."""
    compile_ = commands.add_parser("compile", help="compile a scene before its first fast run")
    add_scene(compile_, "scene", nargs="?", default="example2", metavar="SCENE")
    compile_.add_argument(
        "--integrator", default="auto", help="auto, or the name of an integrator; default: auto"
    )
    compile_.set_defaults(run=_compile)


def _compile(options: argparse.Namespace) -> int:
    from sst_ros.errors import InputError, Problem, SstError, suggestion
    from sst_ros.extras import require
    from sst_ros.integration import code_cache, codegen
    from sst_ros.integration.cache_folder import cache_folder, configured_folder
    from sst_ros.scene.scene import load
    from sst_ros.simulation.simulation import INTEGRATORS

    if options.integrator not in INTEGRATORS:
        allowed = f"must be one of {', '.join(INTEGRATORS)}"
        allowed += suggestion(options.integrator, INTEGRATORS)
        raise InputError("compile", [Problem("--integrator", options.integrator, allowed)])
    if codegen.numba_version() is None:
        require("numba")
        raise SstError("numba is switched off by SST_ROS_NUMBA=0")
    if (folder := cache_folder()) != configured_folder():
        raise SstError("compiled code would not be kept; see the warning above")
    simulated = load(options.scene)
    for method in code_cache.make(simulated, options.integrator):
        print(f"{method}: compiled, in {folder}", flush=True)
    there = code_cache.is_there(simulated, options.integrator)
    if not there:
        raise SstError("another process is compiling: try again when it has ended")
    return 0
