# SPDX-License-Identifier: Apache-2.0
"""Processes that compile in cold threads, during forks, and without a home."""

import os
import subprocess
import sys

import pytest
from slow_cases import slow_after

from sst_ros import simulate

REPEATS = [
    0,
    pytest.param(1, marks=pytest.mark.slow),
    pytest.param(2, marks=pytest.mark.slow),
]
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

FORKS = """
import signal, time

def compile_others():
    for name in ("friction", "elastic_stops", "general"):
        simulate(name, duration=0.01)

thread = threading.Thread(target=compile_others, daemon=True)
thread.start()
children = []
while thread.is_alive() and len(children) < 12:
    child = os.fork()
    if child == 0:
        signal.alarm(60)  # a child that waits for a lost lock ends by this signal
        os.write(1, (bits() + "\\n").encode())
        os._exit(0)
    children.append(child)
    time.sleep(0.04)
codes = [os.waitpid(child, 0)[1] for child in children]
thread.join()
print(len(children), sum(codes))
"""

COMPUTED_MEANWHILE = """
import os, signal, threading
from sst_ros.state import cached_property

begun, forked = threading.Event(), threading.Event()

class Slow:
    @cached_property
    def number(self):
        if threading.current_thread() is not threading.main_thread():
            begun.set()
            forked.wait()
        return 7

slow = Slow()
thread = threading.Thread(target=lambda: slow.number)
thread.start()
begun.wait()
child = os.fork()
if child == 0:
    signal.alarm(20)  # a child that waits for a lost lock ends by this signal
    os._exit(0 if (slow.number, Slow().number) == (7, 7) else 1)
code = os.waitpid(child, 0)[1]
forked.set()
thread.join()
print(code, slow.number, "number" in vars(slow))
"""

IMPORTS = """
import sys
from sst_ros import simulate
before = set(sys.modules)
simulate("example2", duration=0.01, method="auto")
added = {name.partition(".")[0] for name in set(sys.modules) - before}
print(*sorted(added - set(sys.stdlib_module_names)))
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


@pytest.mark.parametrize("repeat", REPEATS)
def test_eight_cold_threads_have_the_bits_of_one(repeat):
    assert run_code(BEGIN + THREADS) == ["8", bits_here()]


@pytest.mark.slow
@pytest.mark.parametrize("home", slow_after(1, [None, "/nonexistent", "/proc"]))
def test_no_home_is_needed(home):
    assert run_code(BEGIN + "print(bits())", HOME=home) == [bits_here()]


def test_a_home_that_cannot_be_written_to_is_no_hindrance(tmp_path):
    home = tmp_path / "home"
    home.mkdir()
    home.chmod(0o500)
    assert run_code(BEGIN + "print(bits())", HOME=str(home)) == [bits_here()]
    assert list(home.iterdir()) == []


@pytest.mark.slow
@pytest.mark.skipif(not hasattr(os, "fork"), reason="the system has no fork")
@pytest.mark.parametrize("repeat", REPEATS)
def test_processes_forked_while_a_thread_compiles_have_its_bits(repeat):
    """A child neither hangs nor computes other numbers.

    This holds for what sst_ros does: tracing, compiling, and the import of llvmlite. A
    fork during any other first import (of `sst_ros` itself, SciPy or matplotlib) in
    another thread leaves that module's lock held in the child; Python offers no cure.
    """
    *printed, forks, codes = run_code(BEGIN + FORKS, timeout=150)
    assert codes == "0"
    assert printed == [bits_here()] * int(forks)
    assert printed


@pytest.mark.skipif(not hasattr(os, "fork"), reason="the system has no fork")
def test_a_process_forked_within_a_property_computes_it_too():
    assert run_code(COMPUTED_MEANWHILE, timeout=60) == ["0", "7", "True"]


def test_a_first_run_imports_llvmlite_alone():
    """A fork waits for the import of llvmlite, and could not wait for another one."""
    assert run_code(IMPORTS) in ([], ["llvmlite"])


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


@pytest.mark.slow
def test_a_process_ends_in_order_while_a_thread_compiles():
    """LLVM's assertions and faults ended a stopped node by SIGABRT and SIGSEGV."""
    pytest.importorskip("llvmlite")
    assert run_code(ENDING) == []
