# SPDX-License-Identifier: Apache-2.0
"""The command `identify`: a scene from a recorded run, or a motion that determines one."""

from __future__ import annotations

import argparse

from sst_ros.cli.commands import free_out
from sst_ros.errors import InputError, Problem
from sst_ros.host.output import write_into
from sst_ros.identification.excitation import design
from sst_ros.identification.identify import identify
from sst_ros.scene.scene import load
from sst_ros.scene.yaml_document import dump

DESIGN = "design"
"""Word in place of a bag."""


def run_identification(options: argparse.Namespace) -> None:
    """Identify a scene from a recorded run, or design a motion that determines its parameters."""
    designing = options.bag == DESIGN
    ours, others = ("duration", "harmonics", "seed"), ("cutoff", "delay", "scene", "method")
    form = DESIGN if designing else "BAG"
    wrong = [
        Problem(f"--{name}", getattr(options, name), f"is no option of identify {form}")
        for name in (others if designing else ours)
        if getattr(options, name) is not None
    ]
    if designing != (options.designed is not None):
        allowed = "must be given after design, and only there"
        wrong.append(Problem("SCENE", options.designed, allowed))
    if wrong:
        raise InputError("identify", wrong)
    if options.out is not None:
        free_out(options, options.out)
    names = ours if designing else others
    chosen = {name: value for name in names if (value := getattr(options, name)) is not None}
    if designing:
        motion = design(load(options.designed), options.parameters, **chosen)
        lines, scene = motion.table(), motion.scene
    else:
        found = identify(options.bag, parameters=options.parameters, **chosen)
        lines, scene = found.table(), found.scene
    print(lines, end="")
    if options.out is not None:
        with write_into(options.out.parent, "identify"):
            options.out.write_text(dump(scene), encoding="utf-8")
        print(f"wrote {options.out}")
