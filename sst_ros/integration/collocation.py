# SPDX-License-Identifier: Apache-2.0
"""Gauss collocation whose stages are the lanes of a SIMD loop: whole motions in few long steps.

A step puts a polynomial through the accelerations at the Gauss nodes (order 2 s with s nodes). Its
equations are solved by iteration (Picard; van der Houwen & Sommeijer, J. Comput. Appl. Math. 29
(1990) 111-127): all s accelerations are evaluated at once, which costs a compiler with SIMD little
more than one. An iteration takes rates from accelerations, then turns the quaternion with these
rates, then evaluates. It begins with the polynomial of the step before, continued.

For motions that are smooth over long steps, as under torques that are functions of time in a
scene; not for stiff scenes, nor for torques that jump, nor for ends.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.polynomial import legendre

from sst_ros.integration import backend
from sst_ros.integration.lanes import Layout, indented, loop, split
from sst_ros.integration.system import System
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


class Collocation:
    """Motions of a system by Gauss collocation with steps of one length.

    Args:
        system: what is integrated.
        nodes: of a step; the order is twice as many.
        compiled: by numba; otherwise, or where there is no numba, as plain Python.

    """

    def __init__(self, system: System, nodes: int = NODES, *, compiled: bool = True) -> None:
        self._compiled = compiled and backend.numba_version() is not None
        self._module = backend.load([collocation_source(system, nodes)], {}, numba=self._compiled)
        self._vector: Callable[[Sequence[float]], Any] = np.array if self._compiled else list
        self._tables = self._vector(tables(nodes).ravel().tolist())
        self._none = self._vector([0.0])

    def march(
        self, t: float, h: float, count: int, y: Sequence[float], d: Sequence[float] = (),
        *, iterations: int = 5,
    ) -> Flight:  # fmt: skip
        """Go on from t by `count` steps of h.

        Args:
            t: time [s].
            h: length of a step [s].
            count: number of steps.
            y: state.
            d: drive, constant.
            iterations: evaluations of all nodes a step; the first step takes two more.

        """
        new, drive = self._vector(y), self._vector(d) if d else self._none
        change = self._module.march(t, h, count, iterations, new, drive, self._tables)
        return Flight(new.tolist() if self._compiled else new, change)


def tables(nodes: int) -> Array:
    """Rows: nodes, weights, then columns of A, then of the continuation.

    A integrates the polynomial through the nodes from 0 to each node; the continuation gives its
    values one step later.
    """
    x, w = legendre.leggauss(nodes)
    inverse = np.linalg.inv(legendre.legvander(x, nodes - 1))
    basis = [legendre.Legendre.basis(k) for k in range(nodes)]
    integrals = np.stack([p.integ(lbnd=-1)(x) / 2.0 for p in basis], axis=1) @ inverse
    later = legendre.legvander(x + 2.0, nodes - 1) @ inverse
    return np.vstack([(x + 1.0) / 2.0, w / 2.0, integrals.T, later.T])


def collocation_source(system: System, nodes: int) -> str:
    """Text of `march(t, h, count, iterations, y, d, tables)`: y becomes the state at the end."""
    size, inputs = len(system.state), len(system.program.inputs)
    fixed = [True, *(False,) * size, *(True,) * len(system.drive)]
    before, after, results = split(system.program, fixed)
    _, turn, turned = split(system.program.first(4), fixed)
    early = [line.split(" = ")[0] for line in before]
    at = Layout(
        nodes, node=1, weight=1, a=nodes, later=nodes, early=max(1, len(early)), s=size, f=size,
        old=size,
    )  # fmt: skip

    def applied(matrix: str, row: int) -> str:
        """Lane i of a matrix times a row of values that are read."""
        return " + ".join(f"{at.lane(matrix, k)} * g{row}_{k}" for k in range(nodes))

    def read(values: str, rows: range) -> list[str]:
        """Lines that read what is the same for all lanes, before a loop, for it to be SIMD."""
        return [f"g{j}_{k} = {at.lane(values, j, k)}" for j in rows for k in range(nodes)]

    def integrated(rows: range) -> list[str]:
        """Texts of the state at the nodes, from the slopes that are read."""
        return [f"y{j} + h * ({applied('a', j)})" for j in rows]

    rates, quaternion, everything = range(4, size), range(4), range(size)
    loaded = [f"u{1 + j} = {at.lane('s', j)}" for j in everything]
    moved = [f"{at.lane('s', 4 + j)} = {text}" for j, text in enumerate(integrated(rates))]
    tried = [f"u{1 + j} = {text}" for j, text in enumerate(integrated(quaternion))]
    stores = [f"{at.lane('f', j)} = {result}" for j, result in enumerate(turned)]
    prepared = [
        *read("f", rates),
        *loop(at, moved),
        *read("f", quaternion),
        *loop(at, [*tried, *loaded[4:], *turn, *stores]),
    ]
    evaluated = [
        *read("f", quaternion),
        *loop(
            at,
            [
                *(f"{at.lane('old', j)} = {at.lane('f', j)}" for j in rates),
                *(f"{name} = {at.lane('early', r)}" for r, name in enumerate(early)),
                *tried,
                *loaded[4:],
                *after,
                *(f"{at.lane('f', j)} = {result}" for j, result in enumerate(results)),
            ],
        ),
    ]
    kept = [f"{at.lane('early', r)} = {name}" for r, name in enumerate(early)]
    copied = [f"{at.lane('old', j)} = {at.lane('f', j)}" for j in everything]
    continued = [f"{at.lane('f', j)} = {applied('later', j)}" for j in everything]
    changes = [_weighted(at, "({f} - {old})", j) for j in range(4, 7)]
    lines = [
        "def march(t, h, count, iterations, y, d, tables):",
        f"    block = vector({at.numbers})",
        f"    for i in range({(2 + 2 * nodes) * nodes}):",
        "        block[i] = tables[i]",
        *(f"    y{j} = y[{j}]" for j in everything),
        *(f"    u{i} = d[{i - 1 - size}]" for i in range(1 + size, inputs)),
        "    worst = 0.0",
        "    for step in range(count):",
        "        begin = t + step * h",
        *indented(8, loop(at, [f"u0 = begin + {at.lane('node')} * h", *before, *kept])),
        "        if step > 0:",
        *indented(12, [*loop(at, copied), *read("old", everything), *loop(at, continued)]),
        "        for iteration in range(iterations if step > 0 else iterations + 2):",
        *indented(12, [*prepared, *evaluated]),
        *indented(8, prepared),
        *(f"        worst = max(worst, abs(h * ({change})))" for change in changes),
        *(f"        y{j} = y{j} + h * ({_weighted(at, '{f}', j)})" for j in everything),
        "        factor = 1.0 / sqrt(y0 * y0 + y1 * y1 + y2 * y2 + y3 * y3)",
        *(f"        y{j} = y{j} * factor" for j in quaternion),
        *(f"    y[{j}] = y{j}" for j in everything),
        "    return worst",
    ]
    return "\n".join(lines) + "\n"


def _weighted(at: Layout, text: str, row: int) -> str:
    """Sum over the nodes of weights times a text about rows f and old."""
    return " + ".join(
        f"{at.lane('weight', 0, k)} * "
        + text.format(f=at.lane("f", row, k), old=at.lane("old", row, k))
        for k in range(at.lanes)
    )
