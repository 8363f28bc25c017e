# SPDX-License-Identifier: Apache-2.0
"""Commands that print a scene as text: they need the documents, not the equations."""

from __future__ import annotations

import argparse
import json

from sst_ros.description.robot import TOPICS, urdf, xacro
from sst_ros.scene.scene import Scene, load, names
from sst_ros.scene.yaml_document import json_schema


def list_all(_: argparse.Namespace) -> None:
    """Print the names of the shipped scenes and what they are."""
    for name in names():
        print(f"{name:<18}{load(name).description}")


def print_schema(_: argparse.Namespace) -> None:
    """Print the JSON schema of scenes."""
    head = {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "title": "sst_ros scene",
    }
    print(json.dumps(head | json_schema(Scene), indent=2))


def describe(options: argparse.Namespace) -> None:
    """Print a scene as URDF, or as a macro of xacro."""
    sync = options.ros2_control
    write = xacro if options.xacro else urdf
    topics = TOPICS if sync else ()
    print(write(load(options.scene), topics, lockstep=sync == "lockstep"), end="")
