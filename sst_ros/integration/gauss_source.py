# SPDX-License-Identifier: Apache-2.0
"""Source of the loop of Gauss collocation: Picard's iteration over SIMD lanes, see `gauss`.

An iteration integrates the slopes at the nodes to rates, turns the quaternion with these rates,
and evaluates. Rows of `block` are read lane by lane before a loop, since SIMD needs that they are
the same for all lanes in it.
"""

from __future__ import annotations

import inspect
import re

from sst_ros.dynamics.expression import Program, Slots
from sst_ros.dynamics.traced_dynamics import ODE
from sst_ros.integration.simd_source import Layout, evaluated, flat_sin, indented, loop, split

HEAD = 3
"""Numbers before all: count of steps, count of iterations, length of a step."""


def source(system: ODE, nodes: int, limits: Program | None, slots: Slots | None) -> list[str]:
    """Texts of flat_sin and of `integrate(block, states)`, see `gauss.PreparedMotion`."""
    return [inspect.getsource(flat_sin), _integrate(system, nodes, limits, slots)]


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
    """Names of what is known from time alone, and is needed where the state is known too."""
    before, after, results = split(system.program, _time_only(system))
    needed = set(re.findall(r"\bv\d+\b", "\n".join([*after, *results])))
    return [name for line in before if (name := line.split(" = ")[0]) in needed]


def _time_only(system: ODE) -> list[bool]:
    return [True, *(False,) * len(system.state), *(True,) * len(system.drive)]


def _integrate(system: ODE, nodes: int, limits: Program | None, slots: Slots | None) -> str:
    at = layout(system, nodes, limits, slots)
    size, inputs = len(system.state), len(system.program.inputs)
    everything, quaternion, rates = range(size), range(4), range(4, size)
    known, count = _known(system), len(slots.values) if slots else 0
    _, after, results = split(system.program, _time_only(system), slots)
    held, moving, _ = split(system.program, [False, *(True,) * (inputs - 1)], slots)
    _, turn, turned = split(system.program.first(4), _time_only(system), slots)

    def read(rows: range) -> list[str]:
        return [f"g{j}_{k} = {at.lane('f', j, k)}" for j in rows for k in range(nodes)]

    def integrated(j: int) -> str:
        """State j at a node: short sums side by side take less time than a long one."""
        terms = [f"{at.lane('a', k)} * g{j}_{k}" for k in range(nodes)]
        sums = [f"({' + '.join(terms[k : k + 4])})" for k in range(0, nodes, 4)]
        return " + ".join([f"y{j}", *sums])

    def kept(rows: range) -> list[str]:
        """Loop over few rows, for what it reads to find place in registers."""
        return [*read(rows), *loop(at, [f"{at.lane('s', j)} = {integrated(j)}" for j in rows])]

    def summed(j: int, text: str) -> str:
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
                *(f"u{1 + j} = {integrated(j)}" for j in quaternion),
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
        *evaluated(limits, at.rows("s", 7), at, "far", slots),
        *loop(at, [nearer(m) for m in distances]),
    ]  # fmt: skip
    lines = [
        "def integrate(block, states):",
        "    count, iterations, h = int(block[0]), int(block[1]), block[2]",
        *(f"    y{j} = {at.lane('begin', 0, 1 + j)}" for j in everything),
        *(f"    u{i} = {at.lane('begin', 0, i)}" for i in range(1 + size, inputs)),
        *(f"    c{i} = {at.lane('numbers', 0, i)}" for i in range(count)),
        *indented(
            4, loop(at, [f"{at.lane('least', m)} = INFINITE" for m in distances] or ["pass"])
        ),
        "    worst = 0.0",
        "    for step in range(count):",
        f"        begin = {at.lane('begin', 0, 0)} + step * h",
        *indented(8, first),
        "        for iteration in range(1, iterations):",
        *indented(12, [*turning, *evaluating]),
        *indented(8, [*turning, *checking]),
        *(f"        worst = max(worst, abs({summed(j, '({f} - {old})')}))" for j in range(4, 7)),
        *(f"        y{j} = y{j} + {summed(j, '{f}')}" for j in everything),
        "        factor = 1.0 / sqrt(y0 * y0 + y1 * y1 + y2 * y2 + y3 * y3)",
        *(f"        y{j} = y{j} * factor" for j in quaternion),
        *(f"        states[{size} * step + {j}] = y{j}" for j in everything),
        f"    finite = {' + '.join(f'abs(y{j})' for j in everything)} < INFINITE",
        "    return worst if finite else INFINITE",
    ]
    return "\n".join(lines) + "\n"
