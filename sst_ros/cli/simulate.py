# SPDX-License-Identifier: Apache-2.0
"""`simulate`: a whole motion of a scene, without nodes."""

from __future__ import annotations

import argparse
from pathlib import Path

from sst_ros.cli.parsing import Commands, add_scene
from sst_ros.errors import InputError, Problem
from sst_ros.output_folder import require_free

FORMATS = (".parquet", ".csv")
MOST_SAMPLES = 10_000_000


def add(commands: Commands) -> None:
    """Add the command to the command line."""
    simulate = commands.add_parser(
        "simulate",
        help="simulate a scene under its own torques",
        description="Simulate a scene under its own torques. Exit status 1 if the motion ended "
        "before the duration, at a limit of the scene for example.",
    )
    add_scene(simulate, "scene", metavar="SCENE")
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
    simulate.set_defaults(run=_simulate)


def _simulate(options: argparse.Namespace) -> int:
    import numpy as np

    from sst_ros.extras import require
    from sst_ros.simulation.simulate import simulate

    out, picture = options.out, None
    if out is not None:
        if out.suffix not in FORMATS:
            allowed = f"must end in {' or '.join(FORMATS)}"
            raise InputError("simulate", [Problem("--out", str(out), allowed)])
        require_free(out, "simulate", force=options.force)
        require("pyarrow" if out.suffix == ".parquet" else "pandas")
    if options.samples is not None and not 1 <= options.samples <= MOST_SAMPLES:
        allowed = f"must be a whole number from 1 to {MOST_SAMPLES}"
        raise InputError("simulate", [Problem("--samples", options.samples, allowed)])
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
