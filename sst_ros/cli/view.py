# SPDX-License-Identifier: Apache-2.0
"""`view`: the manipulator in a browser, live or from a bag."""

from __future__ import annotations

import argparse
import signal
import threading
from pathlib import Path

from sst_ros.cli.parsing import Commands, add_scene_name, command, integer_from, refuse
from sst_ros.extras import require
from sst_ros.host import child_process


def add_view(commands: Commands) -> None:
    """Add `view` to the command line."""
    view = command(
        commands, "view", _view, "show the manipulator in a browser, live or from a bag",
        description="Show a running simulator, one that is started for it (--scene), or a bag.",
    )  # fmt: skip
    view.add_argument("bag", nargs="?", type=Path, help="folder of a bag to play")
    add_scene_name(view, "--scene", metavar="S", help="start a simulator of this scene to look at")
    view.add_argument(
        "--simulator", default="sst_simulator", metavar="NAME", help="node of the simulator"
    )
    view.add_argument("--namespace", default="/", metavar="NS", help="namespace of its nodes")
    view.add_argument("--host", default="127.0.0.1", help="address to serve at (this machine only)")
    view.add_argument(
        "--port", type=integer_from(1024, 65535), default=8080,
        help="port; the next free one is taken",
    )  # fmt: skip
    view.add_argument("--open", action="store_true", help="open it, where there is a desktop")


def _view(options: argparse.Namespace) -> int:
    if options.bag is not None and options.scene is not None:
        refuse(options, "--scene", options.scene, "give a bag or a scene, not both")
    require("viser")
    if options.bag is not None:
        return _replay(options)
    require("rclpy")
    if options.scene is None:
        return _live(options)
    from sst_ros.scene.scene import load

    load(options.scene)
    from sst_ros.view.source import simulator

    with simulator(options.scene):
        return _live(options)


def _live(options: argparse.Namespace) -> int:
    from sst_ros.nodes import process

    given = {name: getattr(options, name) for name in ("simulator", "host", "port", "open")}
    space = f"__ns:={options.namespace}"
    return process.run(["viewer", "--ros-args", "-r", space, *child_process.words(given)])


def _replay(options: argparse.Namespace) -> int:
    from sst_ros.view.page import Page
    from sst_ros.view.source import Replay

    stop = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: stop.set())
    page = Page(Replay(options.bag), options.host, options.port)
    page.announce(opened=options.open)
    while not stop.wait(1.0):  # a wait without end could not be interrupted
        pass
    page.close()
    return 0
