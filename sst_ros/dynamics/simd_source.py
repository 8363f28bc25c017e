# SPDX-License-Identifier: Apache-2.0
"""Text of loops for SIMD: many evaluations of one program at once, columns of a Jacobian at once.

All numbers live in one flat array, a row of lanes each, at offsets that are constants in the text,
and loops have a fixed length and no branches: so a compiler need not ask at run time what overlaps
what, and leaves no scalar copy of a loop.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from itertools import accumulate

from sst_ros.dynamics.expression import Program, Slots

_COLUMNS = 4
"""The loop over the columns of a Jacobian is a multiple of this long: numbers in a register."""


class Layout:
    """Where in an array `block` of `numbers` the rows of some groups are, each of `lanes`."""

    def __init__(self, lanes: int, **rows: int) -> None:
        ends = list(accumulate(rows.values()))
        self._first = dict(zip(rows, [0, *ends], strict=False))
        self.lanes = lanes
        self.numbers = ends[-1] * lanes

    def first(self, group: str) -> int:
        """Return where a group begins."""
        return self._first[group] * self.lanes

    def lane(self, group: str, row: int = 0, lane: str | int = "i") -> str:
        """Return a lane of a row."""
        first = (self._first[group] + row) * self.lanes
        return f"block[{first + lane}]" if isinstance(lane, int) else f"block[{first} + {lane}]"

    def rows(self, group: str, count: int) -> list[str]:
        """Return lane i of the first rows of a group."""
        return [self.lane(group, row) for row in range(count)]


def evaluate_lanes(
    program: Program, given: Sequence[str], at: Layout, out: str, slots: Slots | None = None
) -> list[str]:
    """Lines of a program over all lanes, its results in the rows of `out`.

    What `given` names outside of `block` is the same for all lanes, and what depends on nothing
    else comes before the loop. Ten lines of the derivative in a batch:

        u0 = time
        for i in range(32):
            u1 = block[224 + i]
            u2 = block[256 + i]
            v0 = u1 * u1
            v1 = u2 * u2
            v2 = v0 + v1
            v7 = 2.0 / v6
            v8 = v7 * u1
            block[640 + i] = v257
    """
    names = [f"u{i}" for i in range(len(given))]
    late = [i for i, text in enumerate(given) if text.startswith("block[")]
    before, after, results = program.split(late, slots, names)
    loads = put(names, given)
    head = [line for i, line in enumerate(loads) if i not in late]
    inside = [loads[i] for i in late]
    stores = put(at.rows(out, len(results)), results)
    return [*head, *before, *loop(at, [*inside, *after, *stores])]


def put(places: Sequence[str], values: Iterable[str]) -> list[str]:
    """Lines that put values in places, of which there may be more."""
    return [f"{place} = {value}" for place, value in zip(places, values, strict=False)]


def loop(at: Layout, body: list[str]) -> list[str]:
    """Put a loop over all lanes i around lines."""
    return [f"for i in range({at.lanes}):", *indent(4, body)]


def indent(spaces: int, lines: list[str]) -> list[str]:
    """Move lines to the right."""
    return [" " * spaces + line for line in lines]


def linearise_by_columns(
    program: Program, state: Sequence[str], drive: Sequence[str], slots: Slots
) -> list[str]:
    """Texts of `differentiate` and `linearise`: all columns of a Jacobian in a loop.

    The program is the derivative by t, state and drive and its own along directions, the last
    inputs; of them the one of t, if it is there, comes last. The text is half as long as the
    operations of each column in a row, which takes half the time to compile, and the compiler takes
    four columns at once; the digits are those of the columns. Some lines of it:

        def differentiate(t, state, d, p, slope, columns):
            x = state[0]
            v0 = x * x
            slope[0] = v7
            for k in range(8):
                d_x = 1.0 if k == 0 else 0.0
                v8 = d_x * v0
                columns[0 + k] = v9
        def linearise(t, state, d, p, slope, by_time, matrix):
            columns = vector(64)
            differentiate(t, state, d, p, slope, columns)
            for i in range(8):
                for k in range(7):
                    matrix[i][k] = columns[8 * i + k]
    """
    size, first = len(state), 1 + len(state) + len(drive)
    directions = program.inputs[first:]
    before, along, results = program.split(range(first, len(program.inputs)), slots)
    width = -(-len(directions) // _COLUMNS) * _COLUMNS
    by_time = "d_t" in directions
    states = len(directions) - by_time
    differentiate = [
        "def differentiate(t, state, d, p, slope, columns):",
        *(f"{name} = state[{i}]" for i, name in enumerate(state)),
        *(f"{name} = d[{i}]" for i, name in enumerate(drive)),
        *slots.reads([*before, *along, *results]),
        *before,
        *(f"slope[{i}] = {result}" for i, result in enumerate(results[:size])),
        f"for k in range({width}):",
        *(f"    {name} = 1.0 if k == {k} else 0.0" for k, name in enumerate(directions)),
        *(f"    {line}" for line in along),
        *(f"    columns[{i * width} + k] = {x}" for i, x in enumerate(results[size:])),
    ]
    linearise = [
        "def linearise(t, state, d, p, slope, by_time, matrix):",
        f"columns = vector({size * width})",
        "differentiate(t, state, d, p, slope, columns)",
        f"for i in range({size}):",
        *([f"    by_time[i] = columns[{width} * i + {states}]"] if by_time else []),
        f"    for k in range({states}):",
        f"        matrix[i][k] = columns[{width} * i + k]",
    ]
    return ["\n    ".join(lines) + "\n" for lines in (differentiate, linearise)]


def flat_sin(x: float) -> float:
    """Return sin(x) to about one unit in the last place of x or of the result, for |x| < 1e15.

    As many times pi as there are in x are taken off in three parts, of which the first two have so
    few digits that their products are exact (W. J. Cody and W. Waite, Software Manual for the
    Elementary Functions, 1980); then comes Taylor's series, whose next term is below 1e-18.
    """
    # To add and subtract 1.5 * 2**52 rounds to an integer.
    turns = (x * 0.3183098861837907 + 6755399441055744.0) - 6755399441055744.0
    half = (0.5 * turns + 6755399441055744.0) - 6755399441055744.0
    odd = turns - 2.0 * half
    r = x - turns * 3.1415926534682512
    r = r - turns * 1.2154201012607932e-10
    r = r - turns * 4.044532497591901e-21
    z = r * r
    tail = 1.0 / 355687428096000.0 - z * (1.0 / 121645100408832000.0 - z / 51090942171709440000.0)
    tail = 1.0 / 6227020800.0 - z * (1.0 / 1307674368000.0 - z * tail)
    tail = 1.0 / 362880.0 - z * (1.0 / 39916800.0 - z * tail)
    tail = 1.0 / 6.0 - z * (1.0 / 120.0 - z * (1.0 / 5040.0 - z * tail))
    return (1.0 - 2.0 * odd * odd) * (r - r * z * tail)
