# SPDX-License-Identifier: Apache-2.0
"""Gauss collocation whose stages are the lanes of a SIMD loop: whole motions in few long steps.

A step puts a polynomial through the accelerations at the Gauss nodes (order 2 s with s nodes). Its
equations are solved by iteration (Picard; van der Houwen & Sommeijer, J. Comput. Appl. Math. 29
(1990) 111-127): all s accelerations are evaluated at once, which costs a compiler with SIMD little
more than one. The first evaluation of a step is at the state of its beginning, where only time
differs from lane to lane. Steps know nothing of each other.

For motions that are smooth over long steps, as under torques that are functions of time in a
scene; not for stiff scenes, nor for torques that jump, nor for ends.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.polynomial import legendre

from sst_ros.errors import InputError, Problem
from sst_ros.integration import codegen, gauss_source
from sst_ros.integration.ode import ODE
from sst_ros.mechanism.geometry import Array

NODES = 8
"""Two registers of AVX2; order 16."""


class Flight(NamedTuple):
    """Where a motion ends.

    Attributes:
        y: state.
        change: of a rate [rad/s] over a step by its last iteration, the largest of all steps.

    """

    y: list[float]
    change: float


class Course:
    """A stretch of motion whose numbers are laid out once, to be flown as often as one likes.

    Attributes:
        fly: go from the beginning to the end; returns the change of `Flight`, infinite where the
            motion has no finite end. It takes no argument and allocates nothing.

    """

    def __init__(self, march: Callable[[Any], float], block: Any, at: gauss_source.Places) -> None:
        self._block, self._at = block, at
        self.fly: Callable[[], float] = partial(march, block)

    def begin(self, t: float, y: Sequence[float], d: Sequence[float] = ()) -> None:
        """Say where `fly` begins: time [s], state, and a drive that is constant.

        Raises:
            InputError: there are more or fewer numbers than in the system's state and drive.

        """
        place = self._at.begin
        wanted, found = place.stop - place.start - 1, len(y) + len(d)
        if found != wanted:
            told = f"state and drive must have {wanted} numbers"
            raise InputError("collocation", [Problem("y, d", found, told)])
        for number, value in enumerate((t, *y, *d), start=place.start):
            self._block[number] = value

    @property
    def end(self) -> list[float]:
        """State where the last flight ended."""
        return [float(value) for value in self._block[self._at.end]]


class Collocation:
    """Motions of a system by Gauss collocation with steps of one length.

    Args:
        system: what is integrated.
        nodes: of a step; the order is twice as many.
        compiled: by numba; otherwise, or where there is no numba, as plain Python.

    Raises:
        InputError: nodes is less than 1.

    """

    def __init__(self, system: ODE, nodes: int = NODES, *, compiled: bool = True) -> None:
        _refuse(nodes=nodes)
        self._compiled = compiled and codegen.numba_version() is not None
        self._nodes = nodes
        self._at = gauss_source.places(system, nodes)
        self._module = codegen.load(
            gauss_source.source(system, nodes), {}, numba=self._compiled, rounding=False
        )

    def course(
        self, t: float, h: float, count: int, y: Sequence[float], d: Sequence[float] = (),
        *, iterations: int = 5,
    ) -> Course:  # fmt: skip
        """Lay out `count` steps of h from t.

        Args:
            t: time [s].
            h: length of a step [s].
            count: number of steps.
            y: state.
            d: drive, constant.
            iterations: evaluations of all nodes a step.

        Raises:
            InputError: count or iterations is less than 1.

        """
        _refuse(count=count, iterations=iterations)
        at, block = self._at, _aligned(self._at.numbers)
        block[at.counts] = count, iterations, h
        block[at.tables] = h * tables(self._nodes).ravel()
        numbers = block if self._compiled else block.tolist()
        march = _direct(self._module.march) if self._compiled else self._module.march
        course = Course(march, numbers, at)
        course.begin(t, y, d)
        return course

    def march(
        self, t: float, h: float, count: int, y: Sequence[float], d: Sequence[float] = (),
        *, iterations: int = 5,
    ) -> Flight:  # fmt: skip
        """Go on from t by `count` steps of h, see `course`.

        Raises:
            ArithmeticError: the motion has no finite end.

        """
        course = self.course(t, h, count, y, d, iterations=iterations)
        change = course.fly()
        if not math.isfinite(change):
            raise ArithmeticError(f"{count} steps of {h:g} s from t = {t:g} s end nowhere finite")
        return Flight(course.end, change)


def tables(nodes: int) -> Array:
    """Rows: nodes, weights, then columns of A.

    A integrates the polynomial through the nodes from 0 to each node.
    """
    x, w = legendre.leggauss(nodes)
    inverse = np.linalg.inv(legendre.legvander(x, nodes - 1))
    basis = [legendre.Legendre.basis(k) for k in range(nodes)]
    integrals = np.stack([p.integ(lbnd=-1)(x) / 2.0 for p in basis], axis=1) @ inverse
    return np.vstack([(x + 1.0) / 2.0, w / 2.0, integrals.T])


def _direct(function: Any) -> Callable[[Any], float]:
    """Machine code for one array: numba then need not look at the argument in each call."""
    import numba

    signature = (numba.types.Array(numba.float64, 1, "C"),)
    function.compile(signature)
    found: Callable[[Any], float] = function.get_overload(signature)
    return found


def _aligned(count: int) -> Array:
    """Return zeros whose address is that of a cache line, as no register then lies across two."""
    numbers = np.zeros(count + 8)
    first = -(numbers.ctypes.data // 8) % 8
    return numbers[first : first + count]


def _refuse(**counts: int) -> None:
    problems = [Problem(name, n, "must be at least 1") for name, n in counts.items() if n < 1]
    if problems:
        raise InputError("collocation", problems)
