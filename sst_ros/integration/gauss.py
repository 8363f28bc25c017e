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

import inspect
import re
from collections.abc import Callable, Sequence
from functools import lru_cache, partial
from typing import Any

import numpy as np
from numpy.polynomial import legendre

from sst_ros.dynamics.expression import Program, Slots
from sst_ros.dynamics.traced_dynamics import ODE
from sst_ros.errors import InputError, Problem
from sst_ros.integration import codegen
from sst_ros.integration.simd_source import Layout, evaluate_lanes, flat_sin, indent, loop, split
from sst_ros.mechanism.geometry import Array

HEAD = 3
"""Numbers before all: count of steps, count of iterations, length of a step."""

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
        self, integrate: Callable[..., float], block: Any, states: Any, at: Layout, ode: ODE
    ) -> None:
        self._block, self._states, self._at = block, states, at
        self._size, self._inputs = len(ode.state), len(ode.program.inputs)
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
        """States where the last run began and at the ends of its steps, shape (count + 1, size)."""
        return np.array(self._states).reshape(-1, self._size)

    @property
    def end(self) -> list[float]:
        """State at the end of the last run."""
        return [float(value) for value in self._states[-self._size :]]

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
        compiled: by numba; otherwise, or where there is no numba, as plain Python. None compiles
            nothing, and takes machine code that is there already.

    Raises:
        InputError: nodes is less than 1.

    """

    def __init__(
        self,
        ode: ODE,
        nodes: int = NODES,
        *,
        limits: Program | None = None,
        compiled: bool | None = True,
    ) -> None:
        _refuse(nodes=nodes)
        known = compiled is not False and codegen.numba_version() is not None
        slots = slots_of(ode, limits) if known else None
        texts = source(ode, nodes, limits, slots)
        if known and compiled is None:
            known = codegen.has_code(texts, {}, ("integrate",), rounding=False)
        if slots is not None and not known:
            slots, texts = None, source(ode, nodes, limits, None)
        self._ode, self._compiled = ode, known
        self._at = layout(ode, nodes, limits, slots)
        self._numbers = slots.values if slots else []
        module = codegen.load(texts, {}, numba=self._compiled, rounding=False)
        self._integrate: Callable[..., float] = module.integrate
        if known:  # for two arrays: numba then need not look at the arguments in each call
            import numba

            array = numba.types.Array(numba.float64, 1, "C")
            module.integrate.compile((array, array))
            self._integrate = module.integrate.get_overload((array, array))

    def prepare(
        self, t: float, h: float, count: int, y: Sequence[float], d: Sequence[float] = (),
        *, iterations: int = 5,
    ) -> PreparedMotion:  # fmt: skip
        """Prepare `count` steps of h [s] from t [s] and state y under a constant drive d.

        A step has `iterations` evaluations of all nodes.

        Raises:
            InputError: count or iterations is less than 1.

        """
        _refuse(count=count, iterations=iterations)
        at = self._at
        block: Any = np.zeros(at.numbers + 8)
        # From the begin of a cache line on, as no register then lies across two.
        block = block[-(block.ctypes.data // 8) % 8 :][: at.numbers]
        block[:HEAD] = count, iterations, h
        first = at.first("numbers")
        block[first : first + len(self._numbers)] = self._numbers
        states: Any = np.zeros((count + 1) * len(self._ode.state))
        if not self._compiled:
            block, states = block.tolist(), states.tolist()
        motion = PreparedMotion(self._integrate, block, states, at, self._ode)
        motion.set_step(h)
        motion.begin(t, y, d)
        return motion


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


def _refuse(**counts: int) -> None:
    problems = [Problem(name, n, "must be at least 1") for name, n in counts.items() if n < 1]
    if problems:
        raise InputError("collocation", problems)


def slots_of(system: ODE, limits: Program | None) -> Slots:
    """Return the slots of the numbers in what `integrate` evaluates."""
    slots = Slots()
    for program in (system.program, *([limits] if limits else [])):
        program.body(slots)
    return slots


def layout(system: ODE, nodes: int, limits: Program | None, slots: Slots | None) -> Layout:
    """Allocate what `integrate` reads and writes.

    `head`, `begin` (time, state, drive) and `numbers` are set before a run, and from `node` to
    `known` the tables times the length of a step; `least`, the last group, has the distances from
    limits.
    """
    size, inputs = len(system.state), len(system.program.inputs)

    def rows(numbers: int) -> int:
        return -(-numbers // nodes)

    return Layout(
        nodes, head=rows(HEAD), begin=rows(inputs), numbers=rows(len(slots.values) if slots else 0),
        node=1, weight=1, a=nodes,
        known=max(1, len(_known(system))), s=size, f=size, old=size,
        far=len(limits.outputs) if limits else 1, least=len(limits.outputs) if limits else 1,
    )  # fmt: skip


def _known(system: ODE) -> list[str]:
    """List what is known from time alone, and is needed where the state is known too."""
    before, after, results = split(system.program, _time_only(system))
    needed = set(re.findall(r"\bv\d+\b", "\n".join([*after, *results])))
    return [name for line in before if (name := line.split(" = ")[0]) in needed]


def _time_only(system: ODE) -> list[bool]:
    return [True, *(False,) * len(system.state), *(True,) * len(system.drive)]


def source(system: ODE, nodes: int, limits: Program | None, slots: Slots | None) -> list[str]:
    """Texts of flat_sin and of `integrate(block, states)`, see `PreparedMotion`.

    An iteration integrates the slopes at the nodes to rates, turns the quaternion with these
    rates, and evaluates. Rows of `block` are read lane by lane before a loop, since SIMD needs
    that they are the same for all lanes in it.

        def integrate(block, states):
            count, iterations, h = int(block[0]), int(block[1]), block[2]
            y0 = block[9]
            for step in range(count):
                begin = block[8] + step * h
                for i in range(8):
                    u0 = begin + block[88 + i]
                    block[248 + i] = 0.5 * v12
                for iteration in range(1, iterations):
                    g4_0 = block[280]
                    for i in range(8):
                        block[200 + i] = y4 + (block[104 + i] * g4_0 + block[112 + i] * g4_1)
    """
    at = layout(system, nodes, limits, slots)
    size, inputs = len(system.state), len(system.program.inputs)
    everything, quaternion, rates = range(size), range(4), range(4, size)
    known, count = _known(system), len(slots.values) if slots else 0
    _, after, results = split(system.program, _time_only(system), slots)
    held, moving, _ = split(system.program, [False, *(True,) * (inputs - 1)], slots)
    _, turn, turned = split(system.program.first(4), _time_only(system), slots)

    def read(rows: range) -> list[str]:
        return [f"g{j}_{k} = {at.lane('f', j, k)}" for j in rows for k in range(nodes)]

    def at_node(j: int) -> str:
        """State j at a node: short sums side by side take less time than a long one."""
        terms = [f"{at.lane('a', k)} * g{j}_{k}" for k in range(nodes)]
        sums = [f"({' + '.join(terms[k : k + 4])})" for k in range(0, nodes, 4)]
        return " + ".join([f"y{j}", *sums])

    def kept(rows: range) -> list[str]:
        """Loop over few rows, for what it reads to find place in registers."""
        return [*read(rows), *loop(at, [f"{at.lane('s', j)} = {at_node(j)}" for j in rows])]

    def weigh(j: int, text: str) -> str:
        """Weights times a text with lanes {f} and {old}, over the nodes."""
        return " + ".join(
            f"{at.lane('weight', 0, k)} * "
            + text.format(f=at.lane("f", j, k), old=at.lane("old", j, k))
            for k in range(nodes)
        )

    first = [
        *(f"u{1 + j} = y{j}" for j in everything),
        *held,
        *loop(
            at,
            [
                f"u0 = begin + {at.lane('node')}",
                *(line.replace(" = sin(", " = flat_sin(") for line in moving),
                *(f"{at.lane('known', r)} = {name}" for r, name in enumerate(known)),
                *(f"{at.lane('f', j)} = {result}" for j, result in enumerate(results)),
                *(f"{at.lane('old', j)} = 0.0" for j in rates),
            ],
        ),
    ]
    turning = [
        *kept(rates),
        *read(quaternion),
        *loop(
            at,
            [
                *(f"u{1 + j} = {at_node(j)}" for j in quaternion),
                *(f"u{1 + j} = {at.lane('s', j)}" for j in rates),
                *turn,
                *(f"{at.lane('f', j)} = {result}" for j, result in enumerate(turned)),
            ],
        ),
    ]
    evaluating = [
        *kept(range(2)),
        *kept(range(2, 4)),
        *loop(
            at,
            [
                *(f"u{1 + j} = {at.lane('s', j)}" for j in everything),
                *(f"{name} = {at.lane('known', r)}" for r, name in enumerate(known)),
                *after,
                *(f"{at.lane('old', j)} = {at.lane('f', j)}" for j in rates),
                *(f"{at.lane('f', j)} = {result}" for j, result in enumerate(results)),
            ],
        ),
    ]
    distances = range(len(limits.outputs) if limits else 0)

    def nearer(m: int) -> str:
        far, least = at.lane("far", m), at.lane("least", m)
        return f"{least} = {far} if {far} < {least} else {least}"

    checking = [] if limits is None else [
        *kept(range(2)),
        *kept(range(2, 4)),
        *evaluate_lanes(limits, at.rows("s", 7), at, "far", slots),
        *loop(at, [nearer(m) for m in distances]),
    ]  # fmt: skip
    lines = [
        "def integrate(block, states):",
        "    count, iterations, h = int(block[0]), int(block[1]), block[2]",
        *(f"    y{j} = {at.lane('begin', 0, 1 + j)}" for j in everything),
        *(f"    u{i} = {at.lane('begin', 0, i)}" for i in range(1 + size, inputs)),
        *(f"    c{i} = {at.lane('numbers', 0, i)}" for i in range(count)),
        *indent(4, loop(at, [f"{at.lane('least', m)} = INFINITE" for m in distances] or ["pass"])),
        *(f"    states[{j}] = y{j}" for j in everything),
        "    worst = 0.0",
        "    for step in range(count):",
        f"        begin = {at.lane('begin', 0, 0)} + step * h",
        *indent(8, first),
        "        for iteration in range(1, iterations):",
        *indent(12, [*turning, *evaluating]),
        *indent(8, [*turning, *checking]),
        *(f"        worst = max(worst, abs({weigh(j, '({f} - {old})')}))" for j in range(4, 7)),
        *(f"        y{j} = y{j} + {weigh(j, '{f}')}" for j in everything),
        "        factor = 1.0 / sqrt(y0 * y0 + y1 * y1 + y2 * y2 + y3 * y3)",
        *(f"        y{j} = y{j} * factor" for j in quaternion),
        *(f"        states[{size} * step + {size + j}] = y{j}" for j in everything),
        f"    finite = {' + '.join(f'abs(y{j})' for j in everything)} < INFINITE",
        "    return worst if finite else INFINITE",
    ]
    return [inspect.getsource(flat_sin), "\n".join(lines) + "\n"]
