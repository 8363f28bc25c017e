# SPDX-License-Identifier: Apache-2.0
"""Ctrl-C ends each long call: a KeyboardInterrupt comes out of it."""

import importlib.util
import signal
import subprocess
import sys
import time

import pytest
from slow_cases import slow_except

PROGRAM = """
import os, signal, threading, time
import sst_ros

signal.signal(signal.SIGINT, signal.default_int_handler)
REST = (0.0, 0.0, 0.0)
VARY = {'star.mass': ('uniform', 0.9, 1.1, 'relative')}

def over_time(t):
    return (0.1, 0.0, 0.0)

def of_state(t, state):
    return REST

batch = sst_ros.Batch("swing")
simulation = sst_ros.Simulation("swing", step_budget=10**12)
gamma = [(0.8, 0.8, 0.8)] * 20_000
{first}
threading.Timer(0.5, print, ("running",), dict(flush=True)).start()
try:
    {call}
except KeyboardInterrupt:
    print(time.time(), flush=True)
    os._exit(0)
"""
"""`first` has the code compiled; the line comes some time after `call` has begun, which
takes minutes and more where nothing ends it. The process ends at once: CPython gives it
the signal as its status where Ctrl-C came inside the `exec` of a text, of any package.
"""

CALLS = {
    "simulate": (
        "sst_ros.simulate('swing', REST, 0.1)",
        "sst_ros.simulate('swing', REST, 3e5)",
    ),
    "function of time": (
        "sst_ros.simulate('swing', over_time, 0.1)",
        "sst_ros.simulate('swing', over_time, 1e4)",
    ),
    "function of the state": (
        "sst_ros.simulate('swing', of_state, 0.1)",
        "sst_ros.simulate('swing', of_state, 1e4)",
    ),
    "control period": (
        "sst_ros.simulate('swing', of_state, 0.1, control_period=1e-3)",
        "sst_ros.simulate('swing', of_state, 450.0, control_period=1e-3)",
    ),
    "step of a Simulation": (
        "simulation.step(REST, 1_000_000)",
        "simulation.step(REST, 10**15)",
    ),
    "Batch": (
        "batch.run(gamma[:8], REST, step=1e-3, count=2)",
        "batch.run(gamma, REST, step=1e-6, count=10**8)",
    ),
    "sweep": (
        "sst_ros.sweep('example2_heavy', VARY, duration=0.1, n=64, progress=False)",
        "sst_ros.sweep('example2_heavy', VARY, duration=1, n=10**7, progress=False)",
    ),
    "certify": (
        "sst_ros.certify('swing', REST, 0.01)",
        "sst_ros.certify('swing', REST, 1e3)",
    ),
}
NEEDS = {"sweep": "pandas", "certify": "flint"}
"""Packages of calls that need one."""

LATEST = 5.0
"""Time from the signal to the end of a call that passes on a laden machine [s].

On an idle one it takes some hundredths of a second.
"""


@pytest.mark.parametrize("name", slow_except(["simulate"], CALLS))
def test_ctrl_c_ends_a_call(name):
    if name in NEEDS and importlib.util.find_spec(NEEDS[name]) is None:
        pytest.skip(f"needs {NEEDS[name]}")
    first, call = CALLS[name]
    program = PROGRAM.replace("{first}", first).replace("{call}", call)
    with subprocess.Popen(
        [sys.executable, "-W", "ignore", "-c", program],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    ) as process:
        try:
            assert process.stdout.readline() == "running\n"
            sent = time.time()
            process.send_signal(signal.SIGINT)
            printed, errors = process.communicate(timeout=60)
        finally:
            process.kill()
    assert process.returncode == 0, errors
    delay = float(printed) - sent
    print(f"{name}: {delay:.3f} s")
    assert delay < LATEST
