# SPDX-License-Identifier: Apache-2.0
"""New processes that compile under odd conditions: cold threads, no home."""

import os
import subprocess
import sys

import pytest
from programs import python

from sst_ros import simulate

REPEATS = 3
SCENE = "example2_heavy"

BEGIN = """
import hashlib, os, sys, threading
import numpy as np
from sst_ros import simulate

def bits():
    motion = simulate("example2_heavy", duration=0.2)
    return hashlib.sha256(motion.quaternion.tobytes()).hexdigest()
"""

THREADS = """
found, barrier = [], threading.Barrier(8)

def run():
    barrier.wait()
    found.append(bits())

threads = [threading.Thread(target=run) for _ in range(8)]
for thread in threads:
    thread.start()
for thread in threads:
    thread.join()
print(len(found), *sorted(set(found)))
"""


def bits_here():
    """Return what all processes must print."""
    import hashlib

    quaternion = simulate(SCENE, duration=0.2).quaternion
    return hashlib.sha256(quaternion.tobytes()).hexdigest()


def run_code(code, timeout=120, **changes):
    """Run code in a new process; return what it has printed, and no traceback."""
    environment = {**os.environ, **changes}
    environment = {name: text for name, text in environment.items() if text is not None}
    result = subprocess.run(
        [sys.executable, "-W", "ignore::DeprecationWarning", "-c", code],
        env=environment,
        capture_output=True,
        text=True,
        timeout=timeout,
        check=False,
    )
    assert result.returncode == 0, result.stderr
    assert "Traceback" not in result.stderr
    return result.stdout.split()


@pytest.mark.parametrize("repeat", range(REPEATS))
def test_eight_cold_threads_have_the_bits_of_one(repeat):
    assert run_code(BEGIN + THREADS) == ["8", bits_here()]


@pytest.mark.parametrize("home", [None, "/nonexistent", "/proc"])
def test_no_home_is_needed(home):
    assert run_code(BEGIN + "print(bits())", HOME=home) == [bits_here()]


ENDING = r"""
import itertools, threading
from sst_ros.programs import llvm

begun, optimise = threading.Event(), llvm._optimise

def tell(module, machine):
    begun.set()
    optimise(module, machine)

llvm._optimise = tell
rows = [f"  %y{i + 1} = fmul double %y{i}, %y0" for i in range(4000)]
text = ["define double @power(double %y0) {", *rows, "  ret double %y4000", "}"]
compiled = ["\n".join(text)]
threading.Thread(target=llvm.compile_text, args=compiled, daemon=True).start()
assert begun.wait(60.0)
"""


def test_a_process_that_ends_while_a_thread_compiles_ends_in_order():
    """LLVM's assertions and faults are SIGABRT and SIGSEGV, of a node that is stopped."""
    pytest.importorskip("llvmlite")
    assert python(ENDING).stderr == ""
