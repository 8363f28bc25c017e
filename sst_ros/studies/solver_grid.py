# SPDX-License-Identifier: Apache-2.0
"""The ways to solve a run: each method by fixed steps, and by tolerances, from coarse to fine.

Fixed steps are `Machine.march`, a loop that looks at no error estimate. Tolerances are given to
`Walk`, which is what `Simulation` steps with; its companion, for the global error, is counted and
timed with it. Where the motion has kinks they are given to `Simulation` itself, under torques that
are functions, with all that this costs in plain Python.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from sst_ros.integration.adaptive_stepper import Mark, Walk
from sst_ros.integration.compiled_method import Machine, Method
from sst_ros.integration.methods import METHODS, Rosenbrock
from sst_ros.mechanism.geometry import Array
from sst_ros.studies.work_precision import Trial

Solution = tuple[Array, int | None]
FIXED, TOLERANCE = "fixed steps", "tolerance"

_PER_INTERVAL = (1, 2, 5, 10, 20, 50, 100, 200, 500, 1000, 2000)
_TOLERANCES = tuple(10.0**-n for n in range(4, 14))


@dataclass(frozen=True)
class Way:
    """One way to solve a run.

    Attributes:
        method: name of the method.
        kind: FIXED or TOLERANCE.
        setting: length of the steps [s], or the tolerance.
        solve: returns the states at the instants, and how often the right-hand side was evaluated,
            None where nobody counts. Raises SstError or ArithmeticError or ValueError.
        timed: does the same work with as little else as there can be.

    """

    method: str
    kind: str
    setting: float
    solve: Callable[[], Solution]
    timed: Callable[[], object]


def ladders(trial: Trial, compiled: bool) -> list[Iterator[Way]]:
    """Return the ways by method and kind, each from coarse to fine."""
    found: list[Iterator[Way]] = []
    for method in METHODS.values():
        if not trial.clamped:  # a march knows no limit of torque
            found.append(_fixed(trial, method, compiled))
        if not method.error_order:
            continue
        if not trial.kinked:
            found.append(_chosen(trial, method, compiled))
        elif not isinstance(method, Rosenbrock):  # which takes no torques that are functions
            found.append(_simulated(trial, method))
    return found


def _fixed(trial: Trial, method: Method, compiled: bool) -> Iterator[Way]:
    machine = Machine(trial.system, method, compiled=compiled)
    for steps in _PER_INTERVAL:
        count, h = steps * trial.count, trial.interval / steps

        def solve(steps: int = steps, count: int = count) -> tuple[Array, int]:
            return trial.marched(machine, steps), len(method.a) * count

        def timed(count: int = count, h: float = h) -> None:
            machine.march(0.0, h, count, list(trial.start), trial.drive)

        yield Way(method.name, FIXED, h, solve, timed)


class _Counting(Walk):
    """A walk that counts the steps that it tries."""

    tried = 0

    def _machine_of(self, method: Method) -> Machine:
        new = method.name not in self._machines
        machine = super()._machine_of(method)
        if new:
            pair = machine.pair

            def counted(*arguments: object) -> object:
                self.tried += 1
                return pair(*arguments)  # type: ignore[arg-type]

            vars(machine)["pair"] = counted
        return machine


def _chosen(trial: Trial, method: Method, compiled: bool) -> Iterator[Way]:
    for tolerance in _TOLERANCES:
        walk = _Counting(trial.system, method.name, tolerance, compiled=compiled)

        def travel(walk: Walk = walk, fresh: Mark = walk.mark()) -> Array:  # noqa: B008
            walk.go_back(fresh)
            rows = [list(trial.start)]
            y, z, order = list(trial.start), list(trial.start), method.order
            for k in range(trial.count):
                begin, end = k * trial.interval, (k + 1) * trial.interval
                for leg in walk.legs(begin, end, y, z, trial.drive, order):
                    y, z, order = leg.y, leg.z, leg.order
                rows.append(y)
            return np.array(rows)

        def solve(walk: _Counting = walk, travel: Callable[[], Array] = travel) -> Solution:
            walk.tried = 0
            return travel(), 3 * len(method.a) * walk.tried

        yield Way(method.name, TOLERANCE, tolerance, solve, travel)


def _simulated(trial: Trial, method: Method) -> Iterator[Way]:
    for tolerance in _TOLERANCES:

        def solve(tolerance: float = tolerance) -> tuple[Array, None]:
            return trial.simulated(method.name, tolerance)[0], None

        yield Way(method.name, TOLERANCE, tolerance, solve, solve)
