# SPDX-License-Identifier: Apache-2.0
"""`simulate`, `plan`: a whole motion of a scene without nodes, and a check of one before it."""

from __future__ import annotations

import argparse
from pathlib import Path

from sst_ros.cli.parsing import Commands, add_scene_name, command, free_out, group, refuse
from sst_ros.errors import InputError, Problem
from sst_ros.extras import require
from sst_ros.host.output import require_free

FORMATS = (".parquet", ".csv")
MOST_SAMPLES = 10_000_000


def add_simulate(commands: Commands) -> None:
    """Add `simulate` to the command line."""
    simulate = command(
        commands, "simulate", _simulate, "simulate a scene under its own torques",
        description="Simulate a scene under its own torques. Exit status 1 if the motion ended "
        "before the duration, at a limit of the scene for example.",
    )  # fmt: skip
    add_scene_name(simulate, "scene", metavar="SCENE")
    simulate.add_argument("--duration", type=float, help="length [s]; default: that of the scene")
    simulate.add_argument("--method", default="auto", help="integrator; default: auto")
    simulate.add_argument(
        "--tolerance", type=float, default=1e-9, help="allowed error [rad]; default: 1e-9"
    )
    simulate.add_argument(
        "--samples", type=int, metavar="N", help="even intervals in time; default: ends of steps"
    )
    simulate.add_argument("--out", type=Path, metavar="FILE", help="trajectory, .parquet or .csv")
    simulate.add_argument(
        "--plot", action="store_true", help="draw it; beside FILE, or as SCENE.png"
    )
    simulate.add_argument("--force", action="store_true", help="overwrite earlier results")


def add_plan(commands: Commands) -> None:
    """Add `plan` to the command line."""
    kinds = group(commands, "plan", "check a reference motion: torques, limits, shortest duration")
    what = "check feasibility and the shortest duration; exit status 0 if feasible"
    check = command(kinds, "check", _check, what)
    add_scene_name(check, "scene", metavar="SCENE", help="scene with a motion: name, or .yaml file")
    check.add_argument("--json", action="store_true", help="print JSON instead of a table")
    check.add_argument("--csv", type=Path, metavar="OUT", help="write the torques to play")
    check.add_argument("--force", action="store_true", help="overwrite the file of --csv")
    check.add_argument(
        "--period", type=float, default=1e-3, help="length of a row of --csv [s]; default 0.001"
    )


def _simulate(options: argparse.Namespace) -> int:
    import numpy as np

    from sst_ros.simulation.simulate import simulate

    out, picture = options.out, None
    if out is not None:
        if out.suffix not in FORMATS:
            refuse(options, "--out", str(out), f"must end in {' or '.join(FORMATS)}")
        free_out(options, out)
        require("pyarrow" if out.suffix == ".parquet" else "pandas")
    if options.samples is not None and not 1 <= options.samples <= MOST_SAMPLES:
        allowed = f"must be a whole number from 1 to {MOST_SAMPLES}"
        refuse(options, "--samples", options.samples, allowed)
    if options.plot:
        picture = (out or Path(Path(options.scene).name)).with_suffix(".png")
        require_free(picture, "simulate", force=options.force)
        require("matplotlib")
    trajectory = simulate(
        options.scene,
        duration=options.duration,
        method=options.method,
        tolerance=options.tolerance,
        progress=True,
    )
    if options.samples is not None:
        begin, end = trajectory.t[0], trajectory.t[-1]
        trajectory = trajectory.at(np.linspace(begin, end, options.samples + 1))
    gamma = ", ".join(f"{angle:.9f}" for angle in trajectory.gamma[-1])
    print(f"{trajectory.scene.name}: {trajectory.message}")
    print(f"simulated        {trajectory.t[-1]:.9g} s, {len(trajectory)} samples")
    print(f"method           {trajectory.method}")
    print(f"gamma at the end {gamma} rad")
    print(f"error estimate   {trajectory.error_estimate:.1e} rad")
    print(f"energy residual  {trajectory.energy_residual:.1e} J")
    print(f"loop closure     {trajectory.closure_error:.1e}")
    if out is not None:
        if out.suffix == ".csv":
            trajectory.to_pandas().to_csv(out, index=False)
        else:
            trajectory.save(out, overwrite=options.force)
        print(out)
    if picture is not None:
        from sst_ros.plot.style import save_figure

        save_figure(trajectory.plot(), picture)
        print(picture)
    return 0 if trajectory.success else 1


def _check(options: argparse.Namespace) -> int:
    from sst_ros.control.plan import examine
    from sst_ros.control.reference_motions import reference_motion
    from sst_ros.control.time_scaling import as_json, table, time_scaling, write_torques
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
