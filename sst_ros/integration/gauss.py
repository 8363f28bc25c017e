# SPDX-License-Identifier: Apache-2.0
"""Gauss collocation whose nodes are the lanes of a SIMD loop: whole motions in few long steps.

A step puts a polynomial through the accelerations at the Gauss nodes (order 2 s with s nodes). Its
equations are solved by fixed-point iteration (Picard; van der Houwen & Sommeijer, J. Comput. Appl.
Math. 29 (1990) 111-127): all s accelerations are evaluated at once, which costs a compiler with
SIMD little more than one. The first evaluation of a step is at the state of its beginning, where
only time differs from lane to lane. Steps have one length and no memory of each other.

For motions that are smooth over long steps, as under torques that are functions of time in a
scene; not for stiff scenes, nor for torques that jump, nor for contacts.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import lru_cache, partial
from typing import Any

import numpy as np
from numpy.polynomial import legendre

from sst_ros.dynamics.expression import Program
from sst_ros.dynamics.traced_dynamics import ODE
from sst_ros.errors import InputError, Problem
from sst_ros.integration import codegen, gauss_source
from sst_ros.integration.gauss_source import HEAD
from sst_ros.integration.simd_source import Layout
from sst_ros.mechanism.geometry import Array

NODES = 8
"""Two registers of AVX2; order 16."""


class PreparedMotion:
    """A motion whose arrays are prepared once, to be computed any number of times.

    Attributes:
        run: compute it; returns the change of a rate [rad/s] over a step by its last iteration,
            the largest of all steps, infinite where the motion has no finite end. It takes no
            argument and allocates nothing.

    """

    def __init__(
        self,
        integrate: Callable[..., float],
        block: Any,
        states: Any,
        at: Layout,
        inputs: int,
    ) -> None:
        self._block, self._states, self._at, self._inputs = block, states, at, inputs
        self.run: Callable[[], float] = partial(integrate, block, states)

    def begin(self, t: float, y: Sequence[float], d: Sequence[float] = ()) -> None:
        """Set where `run` begins: time [s], state, and a drive that is constant.

        Raises:
            InputError: there are more or fewer numbers than in the state and the drive of the ODE.

        """
        wanted, found = self._inputs - 1, len(y) + len(d)
        if found != wanted:
            allowed = f"state and drive must have {wanted} numbers"
            raise InputError("collocation", [Problem("y, d", found, allowed)])
        for number, value in enumerate((t, *y, *d), start=self._at.first("begin")):
            self._block[number] = value

    def set_step(self, h: float) -> None:
        """Set the length of a step [s]."""
        self._block[HEAD - 1] = h
        scaled = (h * tables(self._at.lanes)).ravel()
        place = slice(self._at.first("node"), self._at.first("known"))
        self._block[place] = scaled.tolist() if type(self._block) is list else scaled

    @property
    def states(self) -> Array:
        """States at the ends of the steps of the last run, shape (count, numbers of the state)."""
        count = int(self._block[0])
        return np.array(self._states).reshape(count, -1)

    @property
    def end(self) -> list[float]:
        """State at the end of the last run."""
        size = len(self._states) // int(self._block[0])
        return [float(value) for value in self._states[-size:]]

    @property
    def least_distances(self) -> Array:
        """Least distance from each limit at all nodes of the last run, shape (limits,)."""
        least = np.asarray(self._block[self._at.first("least") :])
        return np.asarray(least.reshape(-1, self._at.lanes).min(axis=1))


class Collocation:
    """Motions of an ODE by Gauss collocation with steps of one length.

    Args:
        ode: what is integrated.
        nodes: of a step; the order is twice as many.
        limits: `limit_distances` of the first seven numbers, monitored at all nodes, or none.
        compiled: by numba; otherwise, or where there is no numba, as plain Python.

    Raises:
        InputError: nodes is less than 1.

    """

    def __init__(
        self,
        ode: ODE,
        nodes: int = NODES,
        *,
        limits: Program | None = None,
        compiled: bool = True,
    ) -> None:
        _refuse(nodes=nodes)
        self._compiled = compiled and codegen.numba_version() is not None
        self._size, self._inputs = len(ode.state), len(ode.program.inputs)
        slots = gauss_source.slots_of(ode, limits) if self._compiled else None
        self._at = gauss_source.layout(ode, nodes, limits, slots)
        self._numbers = slots.values if slots else []
        texts = gauss_source.source(ode, nodes, limits, slots)
        self._module = codegen.load(texts, {}, numba=self._compiled, rounding=False)

    def prepare(
        self, t: float, h: float, count: int, y: Sequence[float], d: Sequence[float] = (),
        *, iterations: int = 5,
    ) -> PreparedMotion:  # fmt: skip
        """Prepare `count` steps of h from t.

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
        block[:HEAD] = count, iterations, h
        first = at.first("numbers")
        block[first : first + len(self._numbers)] = self._numbers
        states = np.zeros(count * self._size)
        if self._compiled:
            integrate = _machine_code(self._module.integrate)
            motion = PreparedMotion(integrate, block, states, at, self._inputs)
        else:
            lists = block.tolist(), states.tolist()
            motion = PreparedMotion(self._module.integrate, *lists, at, self._inputs)
        motion.set_step(h)
        motion.begin(t, y, d)
        return motion


def has_code(ode: ODE, nodes: int = NODES, limits: Program | None = None) -> bool:
    """Return whether the machine code of a `Collocation` is there to be loaded."""
    slots = gauss_source.slots_of(ode, limits)
    texts = gauss_source.source(ode, nodes, limits, slots)
    known = codegen.numba_version() is not None
    return known and codegen.has_code(texts, {}, ("integrate",), rounding=False)


@lru_cache(maxsize=16)
def tables(nodes: int) -> Array:
    """Rows: nodes, weights, then columns of A.

    A integrates the polynomial through the nodes from 0 to each node.
    """
    x, w = legendre.leggauss(nodes)
    inverse = np.linalg.inv(legendre.legvander(x, nodes - 1))
    basis = [legendre.Legendre.basis(k) for k in range(nodes)]
    integrals = np.stack([p.integ(lbnd=-1)(x) / 2.0 for p in basis], axis=1) @ inverse
    return np.vstack([(x + 1.0) / 2.0, w / 2.0, integrals.T])


def _machine_code(function: Any) -> Callable[..., float]:
    """Machine code for two arrays: numba then need not look at the arguments in each call."""
    import numba

    array = numba.types.Array(numba.float64, 1, "C")
    function.compile((array, array))
    found: Callable[..., float] = function.get_overload((array, array))
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
