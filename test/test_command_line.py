# SPDX-License-Identifier: Apache-2.0
import subprocess
import sys

import pytest


def run(*words):
    return subprocess.run(
        [sys.executable, "-m", "sst_ros", *words], capture_output=True, text=True, timeout=60
    )


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["recover", "nowhere"], "nowhere"),
        (["report", "run", "nowhere"], "nowhere"),
        (["scene", "show", "nowhere"], "must be a readable .yaml file or one of"),
        (["report", "accuracy", "--scene", "nowhere"], "must be a readable .yaml file or one of"),
    ],
)
def test_what_is_not_there_is_named_without_a_traceback(words, said):
    done = run(*words)
    assert done.returncode == 1
    assert said in done.stderr
    assert "Traceback" not in done.stderr


def test_an_unknown_command_is_refused_with_the_known_ones():
    done = run("simulat")
    assert done.returncode == 2
    assert "demo" in done.stderr
    assert "recover" in done.stderr
