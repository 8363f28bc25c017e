# SPDX-License-Identifier: Apache-2.0
"""Names of earlier versions are refused in one line that says what to use instead."""

import os
import subprocess
import sys

import pytest
from slow_cases import slow_after

import sst_ros
from sst_ros import InputError, Simulation, removed, simulate
from sst_ros.__main__ import main
from sst_ros.runtime.arguments import ros_arguments


def refuse(function, *arguments, **options):
    """Return the one line by which a call is refused."""
    with pytest.raises(InputError) as refused:
        function(*arguments, **options)
    (line,) = str(refused.value).splitlines()
    return line


def test_prepare_says_what_to_call():
    from sst_ros import prepare

    assert "call simulate" in refuse(prepare, "example2")
    assert "prepare" not in dir(sst_ros)
    with pytest.raises(AttributeError, match="has no attribute 'prepared'"):
        _ = sst_ros.prepared


def test_arguments_say_what_to_do_instead():
    line = refuse(Simulation, "example2", compiled=True)
    assert (
        line == f"simulation: compiled = True: {removed.REMOVED_ARGUMENTS['compiled']}"
    )
    with pytest.raises(TypeError, match="unexpected keyword argument 'compile'"):
        Simulation("example2", compile=True)


@pytest.mark.parametrize("name", ["gauss", "collocation"])
def test_methods_say_which_are_as_good(name):
    line = refuse(simulate, "example2", method=name)
    assert "auto and dop853 are as accurate and faster; must be one of auto" in line


@pytest.mark.parametrize(
    "words",
    [["--compiled"], ["--ros-args", "-p", "compiled:=true"]],
)
def test_parameters_of_nodes_say_what_to_do_instead(words):
    assert removed.REMOVED_ARGUMENTS["compiled"] in refuse(
        ros_arguments, "simulator", words
    )


def test_commands_say_what_to_do_instead(capsys):
    assert main(["compile", "example2"]) == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert removed.REMOVED_COMMANDS["compile"] in line


@pytest.mark.parametrize("name", slow_after(1, removed.REMOVED_VARIABLES))
def test_variables_are_refused_where_code_is_compiled(name):
    command = [sys.executable, "-m", "sst_ros", "simulate", "example2"]
    result = subprocess.run(
        command,
        env=os.environ | {name: "0"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert result.returncode == 1
    (line,) = result.stderr.splitlines()
    assert f"environment: {name} = '0': {removed.REMOVED_VARIABLES[name]}" in line
