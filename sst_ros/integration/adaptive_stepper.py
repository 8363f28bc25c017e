# SPDX-License-Identifier: Apache-2.0
"""Error-controlled steps through one control period, with the method that suits the motion."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from sst_ros.integration import coarse_solution
from sst_ros.integration.compiled_method import Machine, Method, Ranges, Slope, Stretch, Vector
from sst_ros.integration.methods import DOP853, DORMAND_PRINCE, METHODS, RODAS4, Rosenbrock
from sst_ros.integration.ode import System

STEP_BUDGET = 100_000
"""Attempts in one control period before it is given up."""

_SAFETY, _SHRINK, _GROW = 0.9, 0.2, 5.0
_LOOK_EVERY = 16
_STIFF, _EASY = 2.0, 0.5


class Leg(NamedTuple):
    """One accepted step: where it began, its length, state and companion at its end, its order."""

    t: float
    h: float
    y: list[float]
    z: list[float]
    order: int


class CannotStep(ArithmeticError):
    """No step is small enough, or there were too many; the text says which."""


class Change(NamedTuple):
    """A change of method: time [s], the new method, why."""

    time: float
    method: str
    reason: str


Mark = tuple[Machine, float, int, int]


class Walk:
    """Chooses methods and step sizes for a system.

    Args:
        system: what is integrated.
        method: name of a method in `tableaux.METHODS`, or auto.
        tolerance: largest local error estimate of a step: of the quaternion, and of the rate
            relative to its length.
        compiled: by numba.
        slope: see `Machine`; with it only explicit methods are used.
        ranges: see `Machine`.

    Attributes:
        history: changes of method.
        origin: time [s] of the run at which the times of `legs` are zero.
        attempts: steps tried by `legs` since construction, rejected ones included.

    """

    def __init__(
        self,
        system: System,
        method: str,
        tolerance: float,
        *,
        compiled: bool,
        slope: Slope | None = None,
        ranges: Ranges = (),
    ) -> None:
        self.tolerance = tolerance
        self.history: list[Change] = []
        self._system = system
        self._auto = method == "auto"
        self._compiled = compiled
        self._slope = slope
        self._ranges = ranges
        self._machines: dict[str, Machine] = {}
        self._machine = self._machine_of(DORMAND_PRINCE if self._auto else METHODS[method])
        self._h = float("inf")
        self._since_look = 0
        self.origin = 0.0
        self.attempts = 0

    @property
    def method(self) -> Method:
        """The method in use."""
        return self._machine.method

    def mark(self) -> Mark:
        """Return what the next steps depend on, to go back to."""
        return self._machine, self._h, self._since_look, len(self.history)

    def go_back(self, mark: Mark) -> None:
        """Forget what has happened since `mark`."""
        self._machine, self._h, self._since_look, changes = mark
        del self.history[changes:]

    def legs(
        self, t: float, end: float, y: Vector, z: Vector, d: Vector, order: int
    ) -> Iterator[Leg]:
        """Step from t to end; `order` is that of the method that has made the companion z.

        Raises:
            CannotStep: steps shrink below the rounding of time, or the budget is used up.

        """
        for _ in range(STEP_BUDGET):
            left = end - t
            h = min(self._h, left)
            if left - h < 1e-3 * h:
                h = left
            z = coarse_solution.rescaled(y, z, order, self.method.order)
            order = self.method.order
            self.attempts += 1
            new_y, new_z, size = self._machine.pair(t, h, y, z, d)
            factor = self._factor(size / self.tolerance)
            if size > self.tolerance:
                self._h = h * min(factor, 1.0)
                if self._h < 1e-15 * max(abs(t), end - t) or self._h < 1e-200:
                    raise CannotStep(f"steps of {self._h:.1e} s do not resolve it")
                self._look(t, h, y, d)
                continue
            if h < left or factor < 1.0 or self._h < float("inf"):
                self._h = max(self._h, h * factor) if h == left else h * factor
            yield Leg(t, h, new_y, new_z, order)
            if h < left or isinstance(self.method, Rosenbrock):
                self._look(t + h, h, new_y, d)
            if h == left:
                return
            t, y, z = t + h, new_y, new_z
        raise CannotStep(f"{STEP_BUDGET} steps do not reach the end of the period")

    def glide(
        self, h: float, count: int, at: Stretch, d: Vector, order: int
    ) -> tuple[int, Stretch]:
        """Do what `legs` does for up to `count` periods of h, as long as a leg each is enough.

        Returns how many were done, and where the last one ended: the next may need several legs or
        another method, or leave `ranges`. The bits are those of `legs`.
        """
        if self._h < h or self._slope is not None:
            return 0, at
        implicit = isinstance(self.method, Rosenbrock)
        if implicit and self._auto:
            count = min(count, _LOOK_EVERY - 1 - self._since_look)
        if order != self.method.order:
            at = (at[0], coarse_solution.rescaled(at[0], at[1], order, self.method.order), at[2])
        done, end = self._machine.glide(h, count, self.tolerance, at, d)
        if self._h < _GROW * h:
            for size in self._machine.sizes[:done]:
                self._h = max(self._h, h * self._factor(float(size) / self.tolerance))
        if implicit:
            self._since_look += done
        return done, end

    def retake(
        self, start: float, x: float, y: Vector, z: Vector, d: Vector, order: int
    ) -> tuple[list[float], list[float], int]:
        """Repeat a step that was accepted, with the shorter length x; state, companion, order."""
        z = coarse_solution.rescaled(y, z, order, self.method.order)
        new_y, new_z, _ = self._machine.pair(start, x, y, z, d) if x else (list(y), list(z), 0)
        return new_y, new_z, self.method.order

    def _factor(self, size: float) -> float:
        if size == 0.0:
            return _GROW
        if not size < float("inf"):
            return _SHRINK
        power = 1.0 / (self.method.error_order + 1)
        return float(min(max(_SAFETY * size**-power, _SHRINK), _GROW))

    def _look(self, t: float, h: float, y: Vector, d: Vector) -> None:
        """Now and then ask the spectrum whether another method would take longer steps."""
        self._since_look += 1
        if not self._auto or self._slope is not None or self._since_look < _LOOK_EVERY:
            return
        self._since_look = 0
        try:
            eigenvalues = self.spectrum(t, y, d)
        except (ArithmeticError, ValueError):
            return  # no finite Jacobian here; the step size has to do
        reach = h * np.abs(eigenvalues).max()
        decay = h * -eigenvalues.real.min()
        implicit = isinstance(self.method, Rosenbrock)
        if not implicit and decay > _STIFF and decay > 0.5 * reach:
            self._change(t, RODAS4, f"stiff: step times fastest decay is {decay:.2g}")
        elif implicit and reach < _EASY:
            self._change(t, DORMAND_PRINCE, f"no longer stiff: step times rate is {reach:.2g}")
        elif self.method is DORMAND_PRINCE and self.tolerance < 1e-7 and decay <= _STIFF:
            self._change(t, DOP853, "many small steps that accuracy asks for")

    def _change(self, t: float, method: Method, reason: str) -> None:
        self._machine = self._machine_of(method)
        self.history.append(Change(self.origin + t, method.name, reason))

    def spectrum(self, t: float, y: Vector, d: Vector) -> np.ndarray:
        """Eigenvalues of the exact Jacobian [1/s]."""
        size = len(self._system.state)
        flat = self._linearised(t, *y, *d)[2 * size :]
        return np.asarray(np.linalg.eigvals(np.array(flat).reshape(size, size).T))

    @property
    def _linearised(self) -> Slope:
        if "linearised" not in self.__dict__:
            from sst_ros.dynamics.traced_dynamics import compiled

            self.__dict__["linearised"] = compiled(self._system.jacobian)
        function: Slope = self.__dict__["linearised"]
        return function

    def _machine_of(self, method: Method) -> Machine:
        if method.name not in self._machines:
            self._machines[method.name] = Machine(
                self._system,
                method,
                compiled=self._compiled,
                slope=self._slope,
                ranges=self._ranges,
            )
        return self._machines[method.name]
