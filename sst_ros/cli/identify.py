# SPDX-License-Identifier: Apache-2.0
"""`identify`: constants of a scene from a recorded run, and motions that show them."""

from __future__ import annotations

import argparse
from pathlib import Path

from sst_ros.cli.parsing import Commands, add_scene_name, command, free_out
from sst_ros.errors import InputError, Problem
from sst_ros.host.output import writing

DESIGN = "design"
INVERSE_DYNAMICS, SIMULATION = "inverse_dynamics", "simulation"


def add_identify(commands: Commands) -> None:
    """Add `identify` to the command line."""
    identify = command(
        commands, "identify", _identify,
        "identify inertias, friction and more from a recorded run; design excitation motions",
        description="`identify BAG` fits the torques of a recorded run by weighted least squares: "
        "what the motion determines, with standard deviations, and the nearest scene whose bodies "
        "can exist. With --method simulation the motion is integrated and fitted to the recorded "
        "angles, by any numbers of the scene. `identify design SCENE` makes a motion that "
        "determines the parameters well, within stroke, workspace and the limits of the actuators.",
    )  # fmt: skip
    identify.add_argument("bag", metavar="BAG", help="folder of the bag, or the word design")
    add_scene_name(
        identify, "designed", nargs="?", metavar="SCENE",
        help="after design: the scene to make a motion for, about its initial pose",
    )  # fmt: skip
    add_scene_name(
        identify, "--scene", metavar="S",
        help="what is known, and the values to start from; default: the recorded scene",
    )  # fmt: skip
    identify.add_argument(
        "--parameters", nargs="+", metavar="P",
        help="unknowns by the beginning of their names, as in: star friction.gamma offset; "
        "default: bodies, friction, springs and rotors of the scene; by simulation full names, as "
        "in: friction.gamma.smoothing stroke.restitution",
    )  # fmt: skip
    identify.add_argument(
        "--method", choices=(INVERSE_DYNAMICS, SIMULATION),
        help=f"default: {INVERSE_DYNAMICS}",
    )  # fmt: skip
    identify.add_argument(
        "--cutoff", type=float, metavar="HZ",
        help="of the zero-phase filter of measured angles; default: none, rates as recorded",
    )  # fmt: skip
    identify.add_argument(
        "--delay", type=float, metavar="SECONDS",
        help="by which measured torques come late; default: 0",
    )  # fmt: skip
    identify.add_argument("--duration", type=float, help="of a designed motion [s]; default: 6")
    identify.add_argument("--harmonics", type=int, help="of a designed motion; default: 5")
    identify.add_argument("--seed", type=int, help="of a designed motion; default: 0")
    identify.add_argument("--out", type=Path, metavar="SCENE.yaml", help="write the scene")
    identify.add_argument("--force", action="store_true", help="overwrite the file of --out")


def _identify(options: argparse.Namespace) -> None:
    designing = options.bag == DESIGN
    ours, others = ("duration", "harmonics", "seed"), ("cutoff", "delay", "scene", "method")
    wrong = [
        Problem(f"--{name}", getattr(options, name), f"is no option of identify {form}")
        for name in (others if designing else ours)
        if (form := DESIGN if designing else "BAG") and getattr(options, name) is not None
    ]
    if designing != (options.designed is not None):
        allowed = "must be given after design, and only there"
        wrong.append(Problem("SCENE", options.designed, allowed))
    if wrong:
        raise InputError("identify", wrong)
    if options.out is not None:
        free_out(options, options.out)
    from sst_ros.scene.scene import load
    from sst_ros.scene.yaml_document import dump

    names = ours if designing else others
    chosen = {name: value for name in names if (value := getattr(options, name)) is not None}
    if designing:
        from sst_ros.identification.excitation import design

        motion = design(load(options.designed), options.parameters, **chosen)
        table, scene = motion.table(), motion.scene
    else:
        from sst_ros.identification.identify import identify

        found = identify(options.bag, parameters=options.parameters, **chosen)
        table, scene = found.table(), found.scene
    print(table, end="")
    if options.out is not None:
        with writing(options.out.parent, "identify"):
            options.out.write_text(dump(scene), encoding="utf-8")
        print(f"wrote {options.out}")
