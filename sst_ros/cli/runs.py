# SPDX-License-Identifier: Apache-2.0
"""Commands on one scene or one recording: contents, faults, motion, tables, view.

What needs an extra is imported by name where it is asked for: the rest runs without it.
"""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
import math
import signal
import threading
from collections.abc import Sequence
from decimal import Decimal
from pathlib import Path
from typing import Any

import numpy as np

from sst_ros.cli.commands import free_out, function, results_folder
from sst_ros.errors import (
    InputError,
    Problem,
    SstError,
    refuse_errors,
    refuse_unless,
    require,
)
from sst_ros.files import require_free
from sst_ros.mechanism import workspace
from sst_ros.mechanism.geometry import Geometry
from sst_ros.report.results import render
from sst_ros.report.scene_summary import summary
from sst_ros.runtime import child_process
from sst_ros.scene.scene import Scene, load, text_of
from sst_ros.scene.schema import NUMBER
from sst_ros.scene.yaml_document import line_of, read
from sst_ros.simulation.simulate import simulate
from sst_ros.simulation.simulation import Simulation
from sst_ros.simulation.tables import SUFFIXES
from sst_ros.view.source import Replay, run_simulator

PICTURE_SUFFIXES = (".png", ".pdf", ".svg")
INERTIA_ROUNDING = 1e-6  # relative, of inertias that a person has typed
DEFAULT_CONTROL_PERIOD = 1e-3  # of `certify --control` [s]


def show(options: argparse.Namespace) -> None:
    """Print the summary of a scene."""
    print(summary(load(options.scene)), end="")


def check_files(options: argparse.Namespace) -> int:
    """Check files of scenes; print their faults and warnings."""
    failed = 0
    for path in options.files:
        try:
            warning = implausible(check(path))
            if not warning:
                print(f"{path}: valid")
            else:
                print(f"{path}: valid, with warnings")
                print(f"{path}: warning: {warning}")
        except SstError as error:
            failed = 1
            print(error)
    return failed


def check(name_or_path: str | Path) -> Scene:
    """Read a scene and assemble it at its initial state, which `load` does not.

    One InputError has every fault, with its line.
    """
    source, origin = text_of(name_or_path)
    scene = read(Scene, source, origin)
    try:
        Simulation(scene)
        return scene
    except InputError as error:
        problems = list(error.problems)
    except SstError as error:
        problems = [
            Problem("initial.gamma", scene.initial.gamma, f"cannot start here: {error}")
        ]
    with_lines = []
    for problem in problems:
        line = line_of(source, problem.key)
        with_lines.append(dataclasses.replace(problem, line=line))
    raise InputError(origin, with_lines)


def implausible(scene: Scene) -> str:
    """Describe numbers of the star that no body can have, though each is allowed.

    The description is empty where a body can have them.
    """
    star = scene.star
    # A body of mass m within the distance r of O has trace(I) <= 2 m r^2 about O.
    trace = float(star.inertia.matrix.trace())
    largest_trace = 2.0 * star.mass * star.radius**2
    if star.mass == 0.0 or trace <= largest_trace * (1.0 + INERTIA_ROUNDING):
        return ""
    return (
        f"star.inertia: its trace is {trace:g} kg m^2; a body of star.mass ="
        f" {star.mass:g} kg within star.radius = {star.radius:g} m has at most 2 m r^2"
        f" = {largest_trace:g} kg m^2"
    )


def map_workspace(options: argparse.Namespace) -> None:
    """Draw the workspace of a scene and print its singular poses."""
    scene = load(options.scene)
    picture = options.out or Path(f"{Path(options.scene).stem}_workspace.png")
    requirement = f"must end in {' or '.join(PICTURE_SUFFIXES)}"
    refuse_unless(
        "workspace",
        ("--out", str(picture), picture.suffix in PICTURE_SUFFIXES, requirement),
    )
    free_out(options, picture)
    require("matplotlib")
    geometry = Geometry.of(scene)
    chart = workspace.workspace(geometry, divisions=60, turns=180, progress=True)
    print(workspace.report_singularities(geometry, chart))
    figure = function("plot.workspace:plot_workspace")(chart, titles=[scene.name])
    function("figures:save_figure")(figure, picture)
    print(picture)


def run_simulation(options: argparse.Namespace) -> int:
    """Simulate a scene; write and draw its trajectory."""
    target = options.out
    pictures = _check_simulation(options)
    names = ("duration", "method", "tolerance", "samples")
    choices = {name: getattr(options, name) for name in names}
    trajectory = simulate(options.scene, progress=True, **choices)
    print(render("motion.txt", motion=trajectory), end="")
    if target is not None:
        trajectory.save(target, overwrite=options.force, reactions=options.reactions)
        print(target)
    for subject, picture in pictures.items():
        drawn = trajectory if subject == "motion" else trajectory.reactions
        function("figures:save_figure")(drawn.plot(), picture)
        print(picture)
    return 0 if trajectory.success else 1


def _check_simulation(options: argparse.Namespace) -> dict[str, Path]:
    """Refuse what cannot be written; return the pictures to draw, by their subject."""
    target = options.out
    ends = f"must end in {' or '.join(SUFFIXES)}"
    is_file = target is None or target.suffix in SUFFIXES
    refuse_unless("simulate", ("--out", str(target), is_file, ends))
    if options.reactions:
        writes_csv = target is not None and target.suffix == ".csv"
        draws = options.plot and (target is None or writes_csv)
        requirement = "needs --plot, or --out FILE.csv"
        refuse_unless(
            "simulate", ("--reactions", True, writes_csv or draws, requirement)
        )
    if target is not None:
        free_out(options, target)
        library = {".parquet": "pyarrow", ".csv": "pandas"}.get(target.suffix)
        if library:
            require(library)
    if not options.plot:
        return {}
    stem = (target or Path(Path(options.scene).name)).with_suffix("")
    pictures = {"motion": stem.with_name(f"{stem.name}.png")}
    if options.reactions:
        pictures["reactions"] = stem.with_name(f"{stem.name}_reactions.png")
    for picture in pictures.values():
        require_free(picture, "simulate", force=options.force)
    require("matplotlib")
    return pictures


def certify_scene(options: argparse.Namespace) -> int:
    """Print what is proven of a scene's motion, or of a loop that tracks a motion."""
    for path in (options.out, options.tracking):
        if path is not None:
            require_free(path, "certify", force=options.force)
    choices: dict[str, Any] = {
        "duration": options.duration,
        "bound": options.bound,
        "ranges": _certified_ranges(options),
        "split": options.split or 1,
        "progress": True,
    }
    scene = load(options.scene)
    torque = None
    if options.control is not None:
        period = options.control_period
        if period is None:
            period = DEFAULT_CONTROL_PERIOD
        torque = _controller(scene, options, period)
        noise = tuple(options.noise or (0.0, 0.0))
        choices |= {"control_period": period, "noise": noise}
    else:
        names = "--gain, --noise, --control-period, --tracking"
        loop_options = (
            options.gain,
            options.noise,
            options.control_period,
            options.tracking,
        )
        requirement = "are given with --control"
        is_free = not any(loop_options)
        refuse_unless("certify", (names, loop_options, is_free, requirement))
    proven = function("proof.certify:certify")(scene, torque, **choices)
    print(proven)
    if options.out is not None:
        _write_in_full(proven.to_pandas(), options.out)
    if options.tracking is not None:
        table = require("pandas").DataFrame(proven.tracking)
        _write_in_full(table, options.tracking)
    return 0 if proven.success else 1


def _certified_ranges(options: argparse.Namespace) -> dict[str, object]:
    """Return the numbers that are not exact, by key, of --digits and --range."""
    ranges: dict[str, object] = dict.fromkeys(options.digits, "digits")
    for text in options.range:
        key, width = read_range(text)
        refuse_unless("certify", ("--range", text, key not in ranges, "names it twice"))
        ranges[key] = width
    return ranges


def prove_zone(options: argparse.Namespace) -> int:
    """Print what is proven of a zone of the workspace; draw and write it."""
    target = options.out
    picture = options.picture
    if target is not None:
        free_out(options, target)
    if picture is not None:
        is_picture = picture.suffix in PICTURE_SUFFIXES
        requirement = f"must end in {' or '.join(PICTURE_SUFFIXES)}"
        refuse_unless("zone", ("--picture", str(picture), is_picture, requirement))
        require_free(picture, "zone", force=options.force, option="--picture")
        require("matplotlib")
    zone = function("proof.zones:certify_zone")(
        options.scene,
        ranges=_read_ranges(options.ranges),
        max_boxes=options.boxes,
        progress=True,
        **_zone_limits(options),
    )
    print(zone)
    if picture is not None:
        figure = function("plot.workspace:plot_zone")(zone)
        function("figures:save_figure")(figure, picture)
        print(picture)
    if target is not None:
        _write_in_full(zone.to_pandas(), target)
    return 0 if zone.success else 1


def _write_in_full(table: Any, path: Path) -> None:
    """Write bounds as CSV, each double as the decimal number that it is.

    The shortest decimal number of a double may be below it, and so below the bound.
    """
    table.astype(float).map(Decimal).to_csv(path, index=False)
    print(path)


def _zone_limits(options: argparse.Namespace) -> dict[str, Any]:
    """Return the cap or the box of a zone, in radians."""
    half_turn = 180.0  # the default of --torsion
    if options.gamma_box is not None:
        box = np.radians(options.gamma_box).reshape(3, 2)
        is_alone = options.tilt is None and options.torsion == half_turn
        cap_limits = (options.tilt, options.torsion)
        requirement = "are those of a cap: leave them out with --gamma-box"
        refuse_unless("zone", ("--tilt, --torsion", cap_limits, is_alone, requirement))
        return {"gamma_box": box}
    torsion = math.radians(options.torsion)
    if options.torsion == half_turn:
        torsion = math.pi
    tilt = None if options.tilt is None else math.radians(options.tilt)
    return {"tilt": tilt, "torsion": torsion}


def _read_ranges(assignments: Sequence[str]) -> dict[str, float | str]:
    """Read KEY=WIDTH."""
    ranges: dict[str, float | str] = {}
    for assignment in assignments:
        key, _, width = assignment.partition("=")
        requirement = "must be KEY=WIDTH, a half-width or the word digits"
        with refuse_errors("zone", "--ranges", assignment, requirement, ValueError):
            ranges[key] = width if width == "digits" else float(width)
    return ranges


def read_range(text: str) -> tuple[str, object]:
    """Read KEY=HALF_WIDTH, KEY=LOW..HIGH or KEY=digits."""
    key, _, width = text.partition("=")
    low, dots, high = width.partition("..")
    if key and width == "digits":
        return key, width
    numbers = [low, high] if dots else [width]
    is_read = bool(key) and all(NUMBER.fullmatch(number) for number in numbers)
    requirement = "must be KEY=HALF_WIDTH, KEY=LOW..HIGH or KEY=digits"
    refuse_unless("certify", ("--range", text, is_read, requirement))
    if dots:
        return key, (float(low), float(high))
    return key, float(width)


def _controller(scene: Scene, options: argparse.Namespace, period: float) -> object:
    """Return the controller of the options, which tracks the motion of a scene."""
    settings = function("control.law:ControllerSettings")
    gains = {}
    for text in options.gain:
        name, _, number = text.partition("=")
        is_known = name in settings.SPECS and name != "mode"
        is_read = is_known and NUMBER.fullmatch(number) is not None
        requirement = "must be a setting of a controller and a number, as bandwidth=40"
        refuse_unless("certify", ("--gain", text, is_read, requirement))
        gains[name] = float(number)
    motion = function("control.reference_motions:reference_motion")(scene)
    controller = function("control.controller:Controller")
    return controller(scene, motion, settings(mode=options.control, **gains), period)


def view(options: argparse.Namespace) -> int:
    """Serve the page of a bag, of a running simulator, or of one started for it."""
    if options.bag is not None:
        _view_recording(options)
        return 0
    require("rclpy")
    if options.scene is not None:
        load(options.scene)  # refused before a process of its own would be
    parameters = {
        name: getattr(options, name) for name in ("simulator", "host", "port", "open")
    }
    ros_arguments = ["viewer", "--ros-args", "-r", f"__ns:={options.namespace or '/'}"]
    with contextlib.ExitStack() as end:
        if options.scene:
            end.enter_context(run_simulator(options.scene))
        status: int = function("nodes.process:run")(
            [*ros_arguments, *child_process.words(parameters)]
        )
    return status


def _view_recording(options: argparse.Namespace) -> None:
    """Serve the page of a bag until a signal comes."""
    is_alone = options.scene is None
    requirement = "give a bag or a scene, not both"
    refuse_unless("view", ("--scene", options.scene, is_alone, requirement))
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.default_int_handler)
    with contextlib.suppress(KeyboardInterrupt), contextlib.ExitStack() as end:
        replay = Replay(options.bag, options.namespace)
        page = function("view.page:Page")(replay, options.host, options.port)
        end.callback(page.close)
        page.announce(opened=options.open)
        threading.Event().wait()


def write_equations(options: argparse.Namespace) -> None:
    """Write the equations of a scene for another program."""
    target = options.target
    folder = free_out(options, Path(f"{Path(options.scene).stem}_{target}"))
    equations = function("code_generation.equations:equations")
    choices = {"parameters": options.parameters, "outputs": options.outputs}
    written = equations(options.scene, target, **choices)
    for path in written.write(folder, force=options.force):
        print(path)


def write_tables(options: argparse.Namespace) -> None:
    """Write the tables of a recorded run."""
    folder = free_out(options, results_folder(options.bag, "tables"))
    export = function("recording.recording:export")
    choices = {"force": options.force, "namespace": options.namespace}
    for path in export(options.bag, folder, options.format, **choices):
        print(path)


def write_recovered(options: argparse.Namespace) -> None:
    """Write what is intact in a recording as a new one."""
    recovered = function("recording.bag_writer:recover")(options.bag, options.out)
    messages = f"{recovered.messages} messages recovered into {recovered.bag}"
    print(f"{messages}, {recovered.lost} known to be lost")
    for line in recovered.damage:
        print(f"  {line}")
