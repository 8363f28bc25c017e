# SPDX-License-Identifier: Apache-2.0
"""`scene`: look at scenes."""

from __future__ import annotations

import argparse
import json
from pathlib import Path

from sst_ros.cli.parsing import Commands, add_scene, group
from sst_ros.errors import SstError


def add(commands: Commands) -> None:
    """Add the command to the command line."""
    kinds = group(commands.add_parser("scene", help="list, show and check scenes"))
    kinds.add_parser("list", help="list the shipped scenes").set_defaults(run=_list)
    show = kinds.add_parser("show", help="show contents, cost of a step and advice on the method")
    add_scene(show, "scene", metavar="SCENE")
    show.set_defaults(run=_show)
    check = kinds.add_parser("check", help="check scene files and report all faults")
    check.add_argument("files", nargs="+", type=Path, metavar="FILE")
    check.set_defaults(run=_check)
    kinds.add_parser("schema", help="print the JSON schema, for editors").set_defaults(run=_schema)


def _list(_: argparse.Namespace) -> None:
    from sst_ros.scene.scene import load, names

    for name in names():
        print(f"{name:<18}{load(name).description}")


def _show(options: argparse.Namespace) -> None:
    from sst_ros.scene.scene import load
    from sst_ros.studies.scene_summary import summary

    print(summary(load(options.scene)), end="")


def _check(options: argparse.Namespace) -> int:
    from sst_ros.cli.scene_check import check, implausible

    failed = 0
    for path in options.files:
        try:
            warnings = implausible(check(path))
            print(f"{path}: valid" + (", with warnings" if warnings else ""))
            for text in warnings:
                print(f"{path}: warning: {text}")
        except SstError as error:
            failed = 1
            print(error)
    return failed


def _schema(_: argparse.Namespace) -> None:
    from sst_ros.scene.json_schema import json_schema
    from sst_ros.scene.scene import Scene

    print(json.dumps(json_schema(Scene, "sst_ros scene"), indent=2))
