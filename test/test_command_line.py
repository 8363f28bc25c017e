# SPDX-License-Identifier: Apache-2.0
"""The command `sst-ros`: help, names, one line for each error, and its exit status."""

import os
import signal
import subprocess
from pathlib import Path

import pytest
from missing_packages import needs
from programs import HIDDEN, python

from sst_ros.__main__ import main
from sst_ros.cli import commands
from sst_ros.cli.commands import NODE_HELP, SUBCOMMANDS, function, parser
from sst_ros.control.law import MODES
from sst_ros.errors import EXTRAS
from sst_ros.simulation.simulation import INTEGRATORS
from sst_ros.simulation.trajectory import Trajectory

BLOCKED = f"""{HIDDEN}
from sst_ros.__main__ import main

def status(words):
    try:
        return main(words)
    except SystemExit as end:
        return end.code

sys.exit(max(map(status, {{commands!r}})))
"""
OPTIONAL = (
    "rclpy", "std_msgs", "rosbags", "viser", "matplotlib", "pandas", "pyarrow",
    "llvmlite",
)  # fmt: skip

TOP = [name for name in SUBCOMMANDS if " " not in name]


INTERRUPTED = """
import os, signal, sys

class Interrupt:
    def find_spec(self, name, path=None, target=None):
        # NumPy makes an ImportError with a page of advice of this one.
        if name == "datetime":
            os.kill(os.getpid(), signal.SIGINT)

sys.modules.pop("datetime", None)
sys.meta_path.insert(0, Interrupt())
from sst_ros.__main__ import main

sys.argv = ["sst-ros", "workspace", "example2"]
sys.exit(main())
"""


def test_an_interrupt_while_modules_are_imported_ends_in_silence():
    told = {
        "preexec_fn": lambda: signal.signal(signal.SIGINT, signal.default_int_handler)
    }
    done = python(INTERRUPTED, status=-signal.SIGINT, **told)
    assert done.stdout == done.stderr == ""


def test_an_interrupt_after_the_command_makes_no_traceback():
    program = """if True:
        import atexit, os, signal, sys
        from sst_ros.__main__ import main

        atexit.register(os.kill, os.getpid(), signal.SIGINT)
        sys.argv = ["sst-ros", "scene", "list"]
        sys.exit(main())
        """
    told = {
        "preexec_fn": lambda: signal.signal(signal.SIGINT, signal.default_int_handler)
    }
    done = python(program, status=-signal.SIGINT, **told)
    assert "example2" in done.stdout and done.stderr == ""


def test_a_second_interrupt_at_once_makes_no_traceback():
    program = """if True:
        import os, signal, sys
        from sst_ros.__main__ import main

        class Stream:
            def write(self, text):
                os.kill(os.getpid(), signal.SIGINT)
            flush = write

        sys.stdout = sys.stderr = Stream()
        sys.argv = ["sst-ros", "scene", "list"]
        status = main()
        sys.stdout, sys.stderr = sys.__stdout__, sys.__stderr__
        sys.exit(status)
        """
    told = {
        "preexec_fn": lambda: signal.signal(signal.SIGINT, signal.default_int_handler)
    }
    assert python(program, status=130, **told).stderr == ""


def test_the_package_alone_imports_no_module_of_its_own():
    """Python would print a traceback for an interrupt that comes before `main`."""
    program = "import sys, sst_ros; print([x for x in sys.modules if 'sst_ros.' in x])"
    assert python(program).stdout == "[]\n"


def test_alone_it_prints_help_with_every_command_and_node(capsys):
    assert main([]) == 0
    said = capsys.readouterr().out
    assert said.startswith("usage: sst-ros ")
    for name in (*TOP, *NODE_HELP):
        assert f"\n    {name}" in said


def test_the_version_is_that_of_the_package(capsys):
    import sst_ros

    with pytest.raises(SystemExit) as ended:
        main(["--version"])
    assert ended.value.code == 0
    assert capsys.readouterr().out == f"sst-ros {sst_ros.__version__}\n"


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["simulater"], "did you mean 'simulate'?"),
        (["recoder"], "did you mean 'recorder'?"),
        (["sceen"], "did you mean 'scene'?"),
        (["scene", "lst"], "did you mean 'list'?"),
        (["report", "runn", "bag"], "did you mean 'run'?"),
        (["export", "bag", "--fromat", "csv"], "did you mean '--format'?"),
        (["plot", "bag", "--froce"], "did you mean '--force'?"),
        (["export", "bag", "--format", "parket"], "did you mean 'parquet'?"),
        *((["view", "bag", "--port", port], "must be a whole number from 1024 to 65535")
          for port in ("-1", "0", "65536", "http")),
        (["simulate", "example2", "--samples", "0"],
         "must be a whole number from 1 to 10000000"),
        (["identify", "bag", "--method", "inverse"],
         "did you mean 'inverse_dynamics'?"),
        (["simulate", "example2", "--samples", "\u0661"],
         "must be a whole number from 1 to"),
        (["simulate", "example2", "--duration", "1_0"], "must be a number, not '1_0'"),
        (["simulate", "example2", "--duration", "ten"], "invalid float value: 'ten'"),
        (["identify", "design", "reach", "--seed", "\u0661"], "must be a number, not"),
        (["demo", "feedforward", "--mode", "pdd"], "did you mean 'pd'?"),
        pytest.param(["demo", "--scene", "swing"], "are options of `demo feedforward`",
                     marks=needs("rosbags")),
    ],
)  # fmt: skip
def test_words_that_are_none_of_the_command_are_refused(words, said, capsys):
    with pytest.raises(SystemExit) as ended:
        main(words)
    assert ended.value.code == 2
    assert said in capsys.readouterr().err


def error_of(words, capsys):
    """Run a command that fails; return its one line.

    Skip where it needs what is not installed.
    """
    assert main(words) == 1
    said = capsys.readouterr().err
    if " is not installed: " in said:
        pytest.skip(said)
    assert said.startswith("sst-ros: ")
    assert said.count("\n") == 1
    return said


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["recover", "nowhere"], "nowhere"),
        (["report", "run", "nowhere"], "nowhere"),
        (["export", "nowhere"], "does not exist"),
        (["scene", "show", "exmple2"], "did you mean 'example2'?"),
        (["scene", "show", "nowhere"], "must be a readable .yaml file or one of"),
        (["report", "accuracy", "nowhere"], "must be a readable .yaml file or one of"),
        (["plan", "check", "spiral", "--csv", "{here}"], "--csv"),
        pytest.param(
            ["plan", "check", "spiral", "--force", "--csv", "{here}"],
            "Is a directory",
            marks=pytest.mark.slow,
        ),
        pytest.param(
            ["plan", "check", "spiral", "--csv", "/proc/torques.csv"],
            "/proc/torques.csv",
            marks=pytest.mark.slow,
        ),
        (["demo", "--out", "/etc/passwd"], "exists already"),
        (["demo", "--force", "--out", "/etc/passwd"], "Not a directory"),
        (["demo", "feedforward", "--scene", "example2"], "has no desired motion"),
        (
            ["workspace", "example2", "--out", "picture"],
            "must end in .png or .pdf or .svg",
        ),
        (
            ["simulate", "example2", "--out", "table.txt"],
            "must end in .parquet or .csv",
        ),
        (["scene", "show", "{here}/latin.yaml"], "latin.yaml"),
        (["view", "no_such_bag"], "does not exist"),
        (["view", "--scene", "no_such_scene"], "must be a readable .yaml file"),
        (["view", "some_bag", "--scene", "swing"], "a bag or a scene, not both"),
    ],
)
def test_an_error_is_one_line(words, said, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "file").touch()
    (tmp_path / "latin.yaml").write_bytes("name: é".encode("latin-1"))
    assert said in error_of([word.format(here=tmp_path) for word in words], capsys)
    assert {path.name for path in tmp_path.iterdir()} == {"file", "latin.yaml"}


BUG = "internal error, please report it with the output of --debug: "


@pytest.mark.parametrize(
    ("error", "status", "said"),
    [
        (
            ValueError("a bug\nwith two lines"),
            3,
            f"{BUG}ValueError: a bug with two lines",
        ),
        (KeyboardInterrupt(), 130, "interrupted"),
    ],
)
def test_a_failure_is_one_line_and_a_traceback_only_on_demand(
    error, status, said, monkeypatch, capsys
):
    def fail(options):
        raise error

    monkeypatch.setattr("sst_ros.cli.scenes.list_all", fail)
    assert main(["scene", "list"]) == status
    assert capsys.readouterr().err == f"sst-ros: {said}\n"
    assert main(["scene", "list", "--debug"]) == status
    assert "Traceback" in capsys.readouterr().err


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs /dev/full")
@pytest.mark.parametrize(
    ("reader", "said"), [("full", "sst-ros: No space left on device\n"), ("gone", "")]
)
def test_output_that_is_not_taken_is_no_traceback(reader, said):
    """A full disk is one line; a reader that leaves is no error of ours."""
    ours, theirs = (
        os.pipe() if reader == "gone" else (None, os.open("/dev/full", os.O_WRONLY))
    )
    if ours is not None:
        os.close(ours)
    pipes = {"stdout": theirs, "stderr": subprocess.PIPE, "capture_output": False}
    done = python("-m", "sst_ros", "scene", "schema", status=1, **pipes)
    os.close(theirs)
    assert done.stderr == said


def test_a_stdout_that_was_closed_before_the_start_is_no_error():
    closed = {
        "preexec_fn": lambda: os.close(1),
        "stdout": None,
        "capture_output": False,
    }
    assert (
        python(
            "-m", "sst_ros", "scene", "list", stderr=subprocess.PIPE, **closed
        ).stderr
        == ""
    )


BAGS = "mcap|rosbags|zstandard"
NEEDED = {
    "rclpy": [*NODE_HELP, "demo", "demo feedforward"],
    "rosbags|mcap|zstandard": [
        "export bag",
        "export bag --format parquet",
        "recover bag",
    ],
    "rosbags|mcap|zstandard|matplotlib": [
        "report run bag",
        "report accuracy",
        "plot bag",
        "plot --list",
    ],
    "matplotlib": ["workspace example2", "simulate example2 --plot"],
    "pyarrow": ["simulate example2 --out x.parquet"],
    "viser": ["view bag", "view --scene swing"],
}


@pytest.mark.parametrize(
    ("line", "modules"),
    [
        pytest.param(
            line, name, marks=pytest.mark.slow if number or name != "rclpy" else ()
        )
        for name, lines in NEEDED.items()
        for number, line in enumerate(lines)
    ],
)
def test_what_needs_an_extra_says_which(line, modules, tmp_path):
    """After a plain installation, every path ends in the line that says what to
    install.
    """
    program = BLOCKED.format(names=OPTIONAL, commands=[line.split()])
    said = python(program, status=1, cwd=tmp_path).stderr
    assert said.count("\n") == 1, said
    assert any(
        f"{name} is not installed: " in said
        and f"sst_ros[{EXTRAS.get(name, 'ros')}]'" in said
        for name in modules.split("|")
    ), said
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("line", "how"),
    [
        (
            "recover bag",
            "is not installed: pip install mcap rosbags, or pip install 'sst_",
        ),
        (
            "simulate example2 --plot",
            "matplotlib is not installed: apt install python3-matplotlib",
        ),
        ("view bag", "viser is not installed: pip install viser"),
        ("recorder", "rclpy is not installed: source a ROS 2 installation"),
    ],
)
def test_beside_ros_the_package_of_apt_or_pip_is_named(line, how):
    """Of a workspace there, `pip install sst_ros` would be a second one."""
    program = BLOCKED.format(names=OPTIONAL, commands=[line.split()])
    said = python(program, status=1, env={**os.environ, "ROS_DISTRO": "kilted"}).stderr
    assert how in said and said.count("\n") == 1, said


def test_what_needs_no_extra_runs_without_any():
    commands = [["scene", "list"], ["scene", "show", "reach"],
                ["plan", "check", "spiral"],
                ["describe"], [], ["--version"]]  # fmt: skip
    python(BLOCKED.format(names=OPTIONAL, commands=commands))


def test_scene_names_are_completed(tmp_path):
    pytest.importorskip("argcomplete", reason="needs argcomplete")
    line = "sst-ros scene show exam"
    asked = {"_ARGCOMPLETE": "1", "COMP_LINE": line, "COMP_POINT": str(len(line)),
             "_ARGCOMPLETE_STDOUT_FILENAME": str(tmp_path / "found"),
             "_ARGCOMPLETE_IFS": "\n"}  # fmt: skip
    python("-m", "sst_ros", env=asked)
    known = "example1 example2 example2_heavy example2_stroke"
    assert (tmp_path / "found").read_text().split() == known.split()


def test_choices_are_those_of_the_rooms():
    assert (commands._INTEGRATORS, commands._MODES) == (INTEGRATORS, MODES)


def test_every_command_names_itself_and_a_function_that_exists(capsys):
    for name, entry in SUBCOMMANDS.items():
        with pytest.raises(SystemExit):
            parser().parse_args([*name.split(), "--help"])
        assert capsys.readouterr().out.startswith(f"usage: sst-ros {name} ")
        assert isinstance(entry, str) or callable(function(entry.run))


def test_a_scene_is_simulated_from_the_command_line(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    pytest.importorskip("pyarrow", reason="needs pyarrow: pip install .[record]")
    words = [
        "simulate",
        "example2",
        "--duration",
        "0.05",
        "--out",
        "run.parquet",
        "--plot",
    ]
    assert main(words) == 0
    assert "example2: reached the end\n" in capsys.readouterr().out
    trajectory = Trajectory.load("run.parquet")
    assert trajectory.t[-1] == 0.05
    assert (tmp_path / "run.png").stat().st_size > 10_000
    assert "exists already" in error_of(words, capsys)
    assert main([*words[:4], "--samples", "20", "--out", "even.csv"]) == 0
    assert len((tmp_path / "even.csv").read_text().splitlines()) == 22
    assert main(["simulate", "example2_heavy", "--duration", "5"]) == 1
    said = capsys.readouterr()
    assert "stopped at t = 1.2853" in said.out
    assert said.err == ""


@pytest.mark.slow
def test_the_workspace_of_a_scene_is_drawn(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(["workspace", "example2"]) == 0
    assert "parallel: none inside" in capsys.readouterr().out
    assert (tmp_path / "example2_workspace.png").stat().st_size > 50_000
    assert "exists already" in error_of(["workspace", "example2"], capsys)
