# SPDX-License-Identifier: Apache-2.0
"""The command `sst-ros`: its table of commands, and how one runs.

A function is named, not imported: its module, with the rooms and libraries that it
uses, is imported when its command runs, so that `sst-ros --help` imports none of them.
Errors become an exit status.
"""

from __future__ import annotations

import argparse
import importlib
import os
import re
import sys
import traceback
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, NoReturn

from sst_ros.errors import (
    SstError,
    explanation,
    printable,
    refusal,
    require,
    suggestion,
)
from sst_ros.files import require_free
from sst_ros.removed import REMOVED_COMMANDS
from sst_ros.version import VERSION

PROGRAM = "sst-ros"
_REFUSED_WORD = re.compile(
    r"invalid choice: '(?P<choice>[^']*)'"
    r"|unrecognized arguments: (?P<option>[^\s=]+)"
)
"""The word that an error of argparse refuses; of --option=value the option."""
_BAG_SUFFIXES = (".mcap", ".db3")


class Arg:
    """An argument for argparse, and `module:function` that completes it in a shell."""

    def __init__(
        self, name: str, description: str = "", *, completer: str = "", **options: Any
    ) -> None:
        self.name = name
        self.options = {**options, "help": description}
        self.completer = completer


class Subcommand:
    """A command.

    Attributes:
        description: its line of help.
        run: `module:function` that runs it.
        arguments: its arguments.
        needs: optional modules that are looked for before that of `run` is imported.
        details: what its page of help says in place of the description.

    """

    def __init__(
        self, description: str, run: str, *args: Arg, needs: str = "", details: str = ""
    ) -> None:
        self.description = description
        self.run = run
        self.arguments = args
        self.needs = needs.split()
        self.details = details


def _number_of(convert: Callable[[str], Any], text: str) -> Any:
    """Read a number as scenes have it: Python would also take 1_0 and other digits."""
    if "_" in text or not text.isascii():
        raise argparse.ArgumentTypeError(f"must be a number, not {text!r}")
    try:
        return convert(text)
    except ValueError:
        raise argparse.ArgumentTypeError(
            f"invalid {convert.__name__} value: {text!r}"
        ) from None


_flag = partial(Arg, action="store_true")
_path = partial(Arg, type=Path)
_number = partial(Arg, type=partial(_number_of, float))
_whole_number = partial(Arg, type=partial(_number_of, int))
_scene = partial(Arg, completer="scene.scene:names")  # shells complete it


def _output_options(description: str, default: str) -> tuple[Arg, Arg]:
    """Describe `--out` and `--force`, which `free_out` obeys."""
    force = _flag("--force", "overwrite earlier results in --out")
    return _path("--out", f"{description}; default: {default}"), force


def _count(
    name: str, most: int, description: str, least: int = 1, **options: Any
) -> Arg:
    """Describe an option that is a whole number in a range."""

    def read_count(text: str) -> int:
        if text.isascii() and text.isdecimal() and least <= int(text) <= most:
            return int(text)
        requirement = f"must be a whole number from {least} to {most}, not {text!r}"
        raise argparse.ArgumentTypeError(requirement)

    return Arg(name, description, type=read_count, metavar="N", **options)


_INTEGRATORS = ("auto", "rk4", "dopri5", "dop853", "rodas5p")
_MODES = ("feedforward", "feedforward_pd", "computed_torque", "pd", "gravity_pd")
_TARGETS = ("c", "numpy", "jax", "casadi", "mpmath", "sympy", "fmu", "mjcf")
_OF_SCENE = "name of a scene, or path of a .yaml file"
SCENE_ARGUMENT = _scene("scene", _OF_SCENE, metavar="SCENE")
BAG = _path("bag", "folder of the bag", metavar="BAG")
_RUN_OF = "namespace of the simulator, where the bag has several runs"
_NAMESPACE_ARGUMENT = Arg("--namespace", _RUN_OF, metavar="NS")
SUBCOMMANDS: dict[str, Subcommand | str] = {
    "simulate": Subcommand(
        "simulate a scene under its own torques",
        "cli.runs:run_simulation",
        SCENE_ARGUMENT,
        _number("--duration", "length [s]; default: that of the scene"),
        Arg("--method", "integrator; default: auto", default="auto"),
        _number("--tolerance", "allowed error [rad]; default: 1e-9", default=1e-9),
        _count("--samples", 10_000_000, "even intervals in time; default: 200"),
        _path("--out", "trajectory, .parquet, .csv or .npz", metavar="FILE"),
        _flag("--plot", "draw it; beside FILE, or as SCENE.png"),
        _flag(
            "--reactions",
            "forces and moments at every joint: in FILE (.csv), as a picture",
        ),
        _flag("--force", "overwrite earlier results"),
        details=(
            "Simulate a scene under its own torques. Exit status 1 if the motion ended "
            "before the duration, at a limit of the scene for example."
        ),
    ),
    "certify": Subcommand(
        "enclose the true motion of a scene: a proven bound of the error of simulate",
        "cli.runs:certify_scene",
        SCENE_ARGUMENT,
        _number("--duration", "length [s]; default: that of the scene"),
        _number("--bound", "angle to be proven [rad]; default: 1e-9", default=1e-9),
        Arg(
            "--digits",
            "keys of numbers known to their last digit",
            nargs="+",
            default=[],
        ),
        Arg(
            "--range",
            "KEY=HALF_WIDTH, KEY=LOW..HIGH or KEY=digits: numbers that are not exact",
            nargs="+",
            default=[],
            metavar="KEY=RANGE",
        ),
        _count("--split", 10_000, "parts of the box of ranges; default: 1"),
        Arg(
            "--control",
            "prove the loop of a controller that tracks the scene's reference motion",
            choices=_MODES,
        ),
        Arg(
            "--gain",
            "settings of the controller, as bandwidth=40; default: its own",
            nargs="+",
            default=[],
            metavar="NAME=NUMBER",
        ),
        _number("--control-period", "of the controller [s]; default: 1e-3"),
        _number(
            "--noise",
            "most that angles [rad] and rates [rad/s] are measured wrong",
            nargs=2,
            metavar=("ANGLE", "RATE"),
        ),
        _path("--tracking", "tube of the tracking error, .csv", metavar="FILE"),
        _path("--out", "table, .csv", metavar="FILE"),
        _flag("--force", "overwrite the file of --out"),
        needs="flint",
        details=(
            "Enclose the true motion of a scene under its own torques, with proof. Exit"
            " status 1 if it is not proven to its end, within the bound."
        ),
    ),
    "workspace": Subcommand(
        "map the workspace of a scene: reach, condition, singular poses",
        "cli.runs:map_workspace",
        SCENE_ARGUMENT,
        *_output_options("picture, .png, .pdf or .svg", "SCENE_workspace.png"),
    ),
    "zone": Subcommand(
        "prove a part of the workspace: regular and inside all limits, with tolerances",
        "cli.runs:prove_zone",
        SCENE_ARGUMENT,
        _number(
            "--tilt", "of E from the reference pose [deg]; default: to all corners"
        ),
        _number("--torsion", "about E [deg]; default: 180", default=180.0),
        Arg(
            "--gamma-box",
            "in place of a cap: least and largest angle of each actuator [deg]",
            nargs=6,
            type=partial(_number_of, float),
            metavar="DEG",
        ),
        Arg(
            "--ranges",
            "tolerances by key, half-widths or the word digits, as in: "
            "star.alpha_deg=0.1 base.v=digits",
            nargs="+",
            default=[],
            metavar="KEY=WIDTH",
        ),
        _count("--boxes", 20_000_000, "most boxes; default: 200000", default=200_000),
        _path("--picture", "draw it, .png, .pdf or .svg", metavar="FILE"),
        _path("--out", "table of the boxes, .csv", metavar="FILE"),
        _flag("--force", "overwrite the files of --picture and --out"),
        needs="flint",
        details="Prove where the manipulator has no singularity and is inside all "
        "limits, whatever its geometry within the tolerances. Exit status 1 if not all "
        "of the zone is proven.",
    ),
    "scene": "list, show and check scenes",
    "scene list": Subcommand("list the shipped scenes", "cli.scenes:list_all"),
    "scene show": Subcommand(
        "show contents, cost of a step and advice on the method",
        "cli.runs:show",
        SCENE_ARGUMENT,
    ),
    "scene check": Subcommand(
        "check scene files and report all faults",
        "cli.runs:check_files",
        _path("files", nargs="+", metavar="FILE"),
    ),
    "scene schema": Subcommand(
        "print the JSON schema, for editors", "cli.scenes:print_schema"
    ),
    "plan": "check a reference motion: torques, limits, shortest duration",
    "plan check": Subcommand(
        "check feasibility and the shortest duration; exit status 0 if feasible",
        "cli.motions:check_plan",
        SCENE_ARGUMENT,
        _flag("--json", "print JSON instead of a table"),
        _path("--csv", "write the torques to play", metavar="OUT"),
        _flag("--force", "overwrite the file of --csv"),
        _number(
            "--period", "length of a row of --csv [s]; default 0.001", default=1e-3
        ),
    ),
    "describe": Subcommand(
        "write a scene as URDF",
        "cli.scenes:describe",
        _scene("--scene", _OF_SCENE, default="example2", metavar="S"),
        Arg(
            "--ros2-control",
            "with the tags by which ros2_control drives a running simulator; free by"
            " default",
            nargs="?",
            const="free",
            choices=("free", "lockstep"),
        ),
        _flag(
            "--xacro",
            "a macro of xacro, which embeds the robot in a larger URDF",
        ),
    ),
    "equations": Subcommand(
        "write the equations of a scene for another program: C, CasADi, JAX, FMI,"
        " MuJoCo",
        "cli.runs:write_equations",
        SCENE_ARGUMENT,
        Arg("--target", "what to write", choices=_TARGETS, required=True),
        Arg(
            "--parameters",
            "keys of numbers that stay open, as in: star.inertia.zz payload.mass",
            nargs="+",
            default=[],
            metavar="KEY",
        ),
        Arg("--outputs", "equations; default: all", nargs="+", metavar="NAME"),
        *_output_options("folder of the files", "SCENE_TARGET"),
    ),
    "demo": Subcommand(
        "run the paper's examples or a reference motion by the nodes",
        "cli.reports:run_demo",
        Arg(
            "kind", "default: examples", nargs="?", choices=("examples", "feedforward")
        ),
        *_output_options("folder of the results", "demo_out or demo_out/feedforward"),
        _scene("--scene", "with feedforward: name of a scene, or path of a .yaml file"),
        Arg("--mode", "with feedforward: control modes", nargs="+", choices=_MODES),
        needs="rclpy rosbags matplotlib",
        details=(
            "Run the paper's examples, or have the node inverse_dynamics follow a"
            " scene's motion."
        ),
    ),
    "view": Subcommand(
        "show the manipulator in a browser, live or from a bag",
        "cli.runs:view",
        _path("bag", "folder of a bag to play", nargs="?"),
        _scene("--scene", "start a simulator of this scene to look at", metavar="S"),
        Arg(
            "--simulator",
            "node of the simulator",
            default="sst_simulator",
            metavar="NAME",
        ),
        Arg("--namespace", f"namespace of its nodes; with BAG {_RUN_OF}", metavar="NS"),
        Arg("--host", "address to serve at (this machine only)", default="127.0.0.1"),
        _count("--port", 65535, "port, or the next free one", 1024, default=8080),
        _flag("--open", "open it, where there is a desktop"),
        needs="viser",
        details=(
            "Show a running simulator, one that is started for it (--scene), or a bag."
        ),
    ),
    "report": "evaluate a recorded run or the integration methods",
    "report run": Subcommand(
        "evaluate a recorded run",
        "cli.reports:report_run",
        BAG,
        *_output_options("folder of the results", "BAG_report, beside the bag"),
        _NAMESPACE_ARGUMENT,
        _flag("--verbose", "print all figures"),
        _flag("--damaged", "evaluate the intact part of a damaged recording"),
    ),
    "report accuracy": Subcommand(
        "work-precision diagrams: error against cost of every method and step",
        "cli.reports:report_accuracy",
        _scene("scenes", f"{_OF_SCENE}; default: all", nargs="*", metavar="SCENE"),
        *_output_options("folder of the results", "accuracy_out"),
    ),
    "report stability": Subcommand(
        "stable steps along the motion of a scene; runs at its limits and with other"
        " numbers",
        "cli.reports:report_stability",
        SCENE_ARGUMENT,
        Arg(
            "--only",
            "rows of the table; default: all",
            nargs="+",
            default=[],
            metavar="ROW",
        ),
        *_output_options("folder of the results", "stability_out"),
        needs="pandas matplotlib",
    ),
    "plot": Subcommand(
        "draw a recorded run, as PDF and PNG",
        "cli.reports:draw_pictures",
        _path("bag", "folder of the bag", nargs="?", metavar="BAG"),
        *_output_options("folder of the pictures", "BAG_plots, beside the bag"),
        Arg("--only", "draw only these", nargs="+", default=[], metavar="NAME"),
        _NAMESPACE_ARGUMENT,
        _flag("--list", "list the pictures, and draw none"),
        _path(
            "--compare",
            "deprecated: `sst-ros compare`",
            nargs="+",
            default=[],
            metavar="BAG",
        ),
    ),
    "compare": Subcommand(
        "show by joint how recorded runs differ: table, pictures",
        "cli.reports:compare_runs",
        _path(
            "bags",
            "folders of two to six bags, or of one with several runs",
            nargs="+",
            metavar="BAG",
        ),
        Arg(
            "--namespace",
            f"{_RUN_OF}: one for all bags, one for each, or all of one bag",
            nargs="+",
            default=[],
            metavar="NS",
        ),
        *_output_options(
            "folder of the pictures", "BAG_compared, beside the first bag"
        ),
        Arg("--only", "draw only these", nargs="+", default=[], metavar="NAME"),
        _path("--csv", "write the table, with all digits", metavar="FILE"),
    ),
    "export": Subcommand(
        "write a recorded run as CSV or Parquet",
        "cli.runs:write_tables",
        BAG,
        _NAMESPACE_ARGUMENT,
        Arg("--format", "default: csv", choices=("csv", "parquet"), default="csv"),
        *_output_options("folder of the tables", "BAG_tables, beside the bag"),
    ),
    "recover": Subcommand(
        "write a valid recording from a truncated or damaged one",
        "cli.runs:write_recovered",
        BAG,
        _path("--out", "folder of the new bag; default: beside the old"),
    ),
    "sweep": Subcommand(
        "many runs of a scene with varied numbers",
        "cli.motions:run_sweep",
        _path("study", "study as a .yaml file; or the word plot", metavar="STUDY"),
        _path("folder", "with plot: folder of results", nargs="?", metavar="DIR"),
        _path("--out", "folder of the results; default: STUDY_sweep, or with plot DIR"),
        Arg(
            "--scheduler",
            "Dask scheduler, as tcp://host:8786; default: none",
            metavar="ADDRESS",
        ),
        _count("--workers", 1024, "threads; default: one a core"),
        _flag("--resume", "compute only the chunks that are missing in --out"),
        details="Run a study of many runs. `sst-ros sweep plot DIR` draws its results.",
    ),
    "identify": Subcommand(
        "identify inertias, friction and more from a recorded run; design excitation"
        " motions",
        "cli.motions:run_identification",
        Arg("bag", "folder of the bag, or the word design", metavar="BAG"),
        _scene(
            "designed",
            "after design: scene to make a motion for",
            nargs="?",
            metavar="SCENE",
        ),
        _scene(
            "--scene",
            "known numbers, and where to start; default: as recorded",
            metavar="S",
        ),
        Arg(
            "--parameters",
            "unknowns by the beginning of their names, as in: star friction.gamma"
            " offset; default: bodies, friction, springs and rotors of the scene; by"
            " simulation full names, as in: friction.gamma.smoothing"
            " stroke.restitution",
            nargs="+",
            metavar="P",
        ),
        _NAMESPACE_ARGUMENT,
        Arg(
            "--method",
            "default: inverse_dynamics",
            choices=("inverse_dynamics", "simulation"),
        ),
        _number(
            "--cutoff",
            "of a zero-phase filter of measured angles [Hz]; default: no filter",
        ),
        _number(
            "--delay",
            "of measured angles [s]; default: estimated where angles are filtered",
        ),
        _number("--duration", "of a designed motion [s]; default: 6"),
        _whole_number("--harmonics", "of a designed motion; default: 5"),
        _whole_number("--seed", "of a designed motion; default: 0"),
        _path("--out", "write the scene", metavar="SCENE.yaml"),
        _flag("--force", "overwrite the file of --out"),
        details=(
            "`identify BAG` fits the torques of a recorded run by weighted least"
            " squares: what the motion determines, with standard deviations, and the"
            " nearest scene whose bodies can exist. With --method simulation the motion"
            " is integrated and fitted to the recorded angles, by any numbers of the"
            " scene. `identify design SCENE` makes a motion that determines the"
            " parameters well, within stroke, workspace and the limits of the"
            " actuators."
        ),
    ),
}
"""A word names a group of commands."""

NODE_HELP = {
    "simulator": "node: integrate the equation of motion in real time",
    "torque_player": "node: play the torques of a scene",
    "inverse_dynamics": "node: follow a motion by feedforward and feedback",
    "recorder": "node: record a run as a rosbag2 recording",
    "viewer": "node: show a running simulator in a browser",
}


class Parser(argparse.ArgumentParser):
    """A parser whose errors suggest the nearest command, option or choice."""

    def __init__(self, **options: Any) -> None:
        options.setdefault("allow_abbrev", False)
        super().__init__(**options)
        self.set_defaults(parser=self)  # that of the innermost command remains

    def error(self, message: str) -> NoReturn:
        """Print the usage, the error and the nearest name; exit with status 2."""
        hint = ""
        refused = _REFUSED_WORD.search(message)
        if refused is not None:
            known: list[str] = []
            for action in self._actions:
                known += [str(choice) for choice in action.choices or ()]
            known += self._option_string_actions
            word = refused["choice"] or refused["option"]
            hint = suggestion(word, known)
        super().error(printable(message) + hint)


def parser() -> Parser:
    """Build the parser of all commands.

    Nodes are listed but parse their arguments themselves: a node takes those of ROS,
    too.
    """
    result = Parser(
        prog=PROGRAM,
        description=(
            "Simulator of the 3-RRP spherical star-triangle parallel manipulator."
        ),
        epilog=f"`{PROGRAM} COMMAND --help` describes a command or a node.",
    )
    result.add_argument("--version", action="version", version=f"{PROGRAM} {VERSION}")
    result.add_argument(
        "--debug", action="store_true", help="print the traceback of an error"
    )
    groups = {
        "": result.add_subparsers(
            dest="command", metavar="COMMAND", parser_class=Parser
        )
    }
    for name, entry in SUBCOMMANDS.items():
        group, _, last = name.rpartition(" ")
        if isinstance(entry, str):
            below = groups[group].add_parser(last, help=entry)
            groups[name] = below.add_subparsers(
                dest="kind", required=True, metavar="KIND"
            )
            continue
        command = groups[group].add_parser(
            last, help=entry.description, description=entry.details or None
        )
        command.set_defaults(entry=entry)
        for argument in entry.arguments:
            action: Any = command.add_argument(argument.name, **argument.options)
            if argument.completer:
                action.completer = partial(_complete, argument.completer)
    for name, description in NODE_HELP.items():
        groups[""].add_parser(name, help=description, add_help=False)
    return result


def _complete(name: str, **_: Any) -> Any:
    """Return the words that complete an argument, by the function that yields them."""
    return function(name)()


def function(name: str) -> Any:
    """Import the function that `module:function` names."""
    module, _, attribute = name.partition(":")
    return getattr(importlib.import_module(f"sst_ros.{module}"), attribute)


def results_folder(bag: Path, purpose: str) -> Path:
    """Return the default folder of results of a recording: BAG_PURPOSE, beside it."""
    path = bag.resolve() if bag.name in ("", "..") else bag
    name = path.stem if path.suffix in _BAG_SUFFIXES else path.name
    return path.with_name(f"{name}_{purpose}")


def free_out(options: argparse.Namespace, default: str | Path) -> Path:
    """Return the path of `--out`, or the default.

    Refuse to overwrite without `--force`.
    """
    target = options.out or Path(default)
    return require_free(target, options.command, force=getattr(options, "force", False))


def run_command(arguments: list[str]) -> int:
    """Run a command or a node; return the exit status.

    Errors are one line on stderr.
    """
    end = arguments.index("--ros-args") if "--ros-args" in arguments else len(arguments)
    debug = "--debug" in arguments[:end]  # wherever it is before the words of ROS
    before_ros = [argument for argument in arguments[:end] if argument != "--debug"]
    try:
        status = _run([*before_ros, *arguments[end:]])
        # does nothing where stdout was closed before the start
        print(end="", flush=True)
    except (Exception, KeyboardInterrupt) as error:
        if debug:
            traceback.print_exc()
        status, message = failure(error)
        if isinstance(error, OSError):
            try:
                print(end="", flush=True)
            except (OSError, ValueError):  # or Python fails once more when it ends
                os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
        for line in message.splitlines():
            print(f"{PROGRAM}: {printable(line)}", file=sys.stderr)
    return status


def _run(arguments: list[str]) -> int:
    if "_ARGCOMPLETE" in os.environ:
        importlib.import_module("argcomplete").autocomplete(parser())
    command = arguments[0] if arguments else ""
    if command in NODE_HELP:
        return int(function("nodes.process:run")(arguments))
    if command in REMOVED_COMMANDS:
        raise refusal("command", command, "given", REMOVED_COMMANDS[command])
    options, unknown = parser().parse_known_args(arguments)
    if unknown:
        options.parser.error(f"unrecognized arguments: {' '.join(unknown)}")
    if options.command is None:
        options.parser.print_help()
        return 0
    for module in options.entry.needs:
        require(module)
    status: int | None = function(options.entry.run)(options)
    return status or 0


def failure(error: BaseException) -> tuple[int, str]:
    """Return the exit status and the message, "" for none."""
    text = " ".join(str(error).split())
    match error:
        case KeyboardInterrupt():
            return 130, "interrupted"
        case BrokenPipeError():
            return 1, ""
        case SstError():
            return 1, str(error)
        case ModuleNotFoundError() if advice := explanation(error):
            return 1, advice
        case OSError():
            where = f"{error.filename}: " if error.filename is not None else ""
            return 1, f"{where}{error.strerror or error}"
        case UnicodeError():
            return 1, f"text cannot be encoded or decoded: {error}"
        case MemoryError():
            return 1, "not enough memory"
    if type(error).__module__.partition(".")[0] in ("rclpy", "rosbags"):
        return 1, text
    report = "internal error, please report it with the output of --debug"
    return 3, f"{report}: {type(error).__name__}: {text}"
