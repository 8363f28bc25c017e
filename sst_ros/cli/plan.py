# SPDX-License-Identifier: Apache-2.0
"""`plan`: check a reference motion: torques, limits, shortest duration."""

from __future__ import annotations

import argparse
from pathlib import Path

from sst_ros.cli.parsing import Commands, add_scene, group
from sst_ros.errors import InputError, Problem
from sst_ros.output_folder import require_free


def add(commands: Commands) -> None:
    """Add the command to the command line."""
    kinds = group(
        commands.add_parser(
            "plan", help="check a reference motion: torques, limits, shortest duration"
        )
    )
    check = kinds.add_parser(
        "check",
        help="check feasibility and the shortest duration; exit status 0 if feasible",
    )
    add_scene(check, "scene", metavar="SCENE", help="scene with a motion: name, or .yaml file")
    check.add_argument("--json", action="store_true", help="print JSON instead of a table")
    check.add_argument("--csv", type=Path, metavar="OUT", help="write the torques to play")
    check.add_argument("--force", action="store_true", help="overwrite the file of --csv")
    check.add_argument(
        "--period", type=float, default=1e-3, help="length of a row of --csv [s]; default 0.001"
    )
    check.set_defaults(run=_check)


def _check(options: argparse.Namespace) -> int:
    from sst_ros.control.plan import examine
    from sst_ros.control.plan_table import as_json, table, write_torques
    from sst_ros.control.reference_motions import reference_motion
    from sst_ros.control.time_scaling import time_scaling
    from sst_ros.recording.recorded_motion import samples
    from sst_ros.scene.scene import load

    if not 1e-9 <= options.period < float("inf"):
        problem = Problem("--period", options.period, "must be a finite number >= 1e-9 [s]")
        raise InputError("plan check", [problem])
    if options.csv is not None:
        require_free(options.csv, "plan check", force=options.force, option="--csv")
    held = load(options.scene)
    plan = examine(reference_motion(held, samples), held)
    write = as_json if options.json else table
    print(write(plan, time_scaling(plan)).rstrip())
    if options.csv is not None:
        write_torques(plan, options.csv, options.period)
    return 1 if plan.problems else 0
