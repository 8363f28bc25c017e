# SPDX-License-Identifier: Apache-2.0
"""How soon any program could be there at all that evaluates these accelerations one at
a time.

A method that uses values of W_dot, and not its derivatives, needs as many as a
polynomial through them over the whole second to tell the orientation at its end to an
error. The nodes here are Gauss's, at the true motion, which no method knows beforehand.
Times the cost of an evaluation in C, that is a floor for one core without SIMD over
evaluations.
"""

from __future__ import annotations

import math
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
from numpy.polynomial import legendre

from benchmark import c_floor
from benchmark.measure import time_in_turn
from benchmark.peers.task import DURATION, Task
from sst_ros.integration.method_steps import MethodSteps
from sst_ros.integration.methods import DOP853, RK4
from sst_ros.integration.point import Drive
from sst_ros.mechanism.geometry import rotation_matrix

_STEPS = 400
_MOST = 80


@dataclass(frozen=True)
class Floor:
    """Evaluations that are needed at least, by error, and seconds of one in C.

    None without gcc.
    """

    evaluations: dict[float, int]
    seconds: float | None


def find_floor(task: Task, targets: tuple[float, ...]) -> Floor:
    """Count and measure."""
    return Floor({target: _needed(task, target) for target in targets}, _seconds(task))


def _needed(task: Task, target: float) -> int:
    """Fewest nodes whose polynomial of W_dot turns the star to within the error."""
    machine = MethodSteps(task.system, DOP853)
    names: dict[str, Any] = {}
    exec(
        "from math import cos, sin, sqrt, tanh\n" + task.system.program.source("rhs"),
        names,
    )
    x, weights = legendre.leggauss(_MOST)
    fine, w = DURATION * (x + 1.0) / 2.0, DURATION * weights / 2.0
    truth = _states(machine, task.start, fine)
    turned = np.array([rotation_matrix(y[:4]) for y in truth])
    for count in range(2, _MOST):
        nodes = legendre.leggauss(count)[0]
        times = DURATION * (nodes + 1.0) / 2.0
        states = _states(machine, task.start, times)
        slopes = [names["rhs"](t, *y)[4:7] for t, y in zip(times, states, strict=True)]
        fit = np.linalg.solve(legendre.legvander(nodes, count - 1), np.array(slopes))
        rate = DURATION / 2.0 * legendre.legval(x, legendre.legint(fit, lbnd=-1)).T
        # The error of the orientation, to first order: what the error of W adds up to
        # in {B}.
        off = np.einsum(
            "i,ijk,ik->j", w, turned, rate + task.start[4:7] - truth[:, 4:7]
        )
        if float(np.linalg.norm(off)) <= target:
            return count
    return _MOST


def _states(machine: MethodSteps, start: list[float], times: np.ndarray) -> np.ndarray:
    found, t, y = [], 0.0, start
    for time_ in times:
        steps = max(1, math.ceil((time_ - t) * _STEPS))
        y = machine.fixed(t, (time_ - t) / steps, steps, y, Drive(()))
        t = time_
        found.append(y)
    return np.array(found)


def _seconds(task: Task) -> float | None:
    if not c_floor.has_gcc():
        return None
    import ctypes

    count = 1000
    array = ctypes.c_double * len(task.start)
    with tempfile.TemporaryDirectory() as folder:
        text = c_floor.write_step(task.system.program, RK4)
        library = c_floor.compile_step(
            text, Path(folder), "floor", "-O3", "-march=native"
        )
        calls = {"": lambda: library.slopes(count, array(*task.start))}
        return median(time_in_turn(calls, 15, clock=time.process_time)[""]) / count
