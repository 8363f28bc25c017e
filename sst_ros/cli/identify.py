# SPDX-License-Identifier: Apache-2.0
"""`identify`: constants of a scene from a recorded run."""

from __future__ import annotations

import argparse
from pathlib import Path

from sst_ros.cli.parsing import Commands, add_scene
from sst_ros.output_folder import require_free


def add(commands: Commands) -> None:
    """Add the command to the command line."""
    identify = commands.add_parser(
        "identify",
        help="inertias, friction and more from a recorded run",
        description="Fit the torques of a recorded run by weighted least squares: what the motion "
        "determines, with standard deviations, and the nearest scene whose bodies can exist.",
    )
    identify.add_argument("bag", type=Path, help="folder of the bag")
    add_scene(
        identify, "--scene", metavar="S",
        help="what is known, and the values to start from; default: the recorded scene",
    )  # fmt: skip
    identify.add_argument(
        "--parameters", nargs="+", metavar="P",
        help="unknowns by the beginning of their names, as in: star friction.gamma offset; "
        "default: bodies, friction, springs and rotors of the scene",
    )  # fmt: skip
    identify.add_argument(
        "--cutoff", type=float, metavar="HZ",
        help="of the zero-phase filter of measured angles; default: none, rates as recorded",
    )  # fmt: skip
    identify.add_argument(
        "--delay", type=float, default=0.0, metavar="SECONDS",
        help="by which measured torques come late; default: 0",
    )  # fmt: skip
    identify.add_argument("--out", type=Path, metavar="SCENE.yaml", help="write the scene")
    identify.add_argument("--force", action="store_true", help="overwrite the file of --out")
    identify.set_defaults(run=_identify)


def _identify(options: argparse.Namespace) -> None:
    if options.out is not None:
        require_free(options.out, "identify", force=options.force)
    from sst_ros.identification.identify import identify
    from sst_ros.scene.yaml_document import dump

    found = identify(
        options.bag, options.scene, options.parameters, cutoff=options.cutoff, delay=options.delay
    )
    print(found.table(), end="")
    if options.out is not None:
        options.out.write_text(dump(found.scene), encoding="utf-8")
        print(f"wrote {options.out}")
