# SPDX-License-Identifier: Apache-2.0
"""Text of loops for SIMD: columns of a Jacobian at once, a program in many lanes, a batch of runs.

All numbers live in one flat array, a row of lanes each, at offsets that are constants in the text,
and loops have a fixed length and no branches: so a compiler need not ask at run time what overlaps
what, and leaves no scalar copy of a loop.

Of many scenarios at once the operations of a lane are those of a run of its own in the same order.
A lane that leaves a limit of its scene, or whose numbers are not finite, keeps its last valid state
and a code; the others continue. Lanes do not depend on each other, so threads change no bit.

Which limit a step passes first is found from the distances to all: over a step each is a cubic in
its values and rates at both ends (Hermite). Its error is at most h^4 max|d^(4)| / 384. A step that
ends outside is found, and one that leaves and comes back.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Sequence
from itertools import accumulate

from sst_ros.dynamics.model import GRAZING
from sst_ros.integration.methods import Tableau
from sst_ros.integration.step_loops import combination
from sst_ros.programs.expression import Program, Slots

SIMD_WIDTH = 32
"""Scenarios of a block; a multiple of what a vector unit takes, and all fit the cache."""

NOT_FINITE = 1000
"""Code of a scenario whose numbers are no longer finite; others are 1 + the limit's index."""

EARLIEST = 1e-8
"""Least share of a step at which a crossing is reported, so that its time lies in this step."""

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


_LOCAL = re.compile(r"\b[uvg]\d+(_\d+)?\b")
"""What a program or a loop over lanes names, and uses only below in the text."""


def assign_once(lines: Sequence[str]) -> str:
    """Join lines to a text in which each such name is assigned once.

    Of names that are assigned in several places numba finds out which is meant, which takes half
    of its time.
    """
    newest, text = dict[str, str](), ""
    for number, line in enumerate(lines):
        place, equals, value = line.partition(" = ")
        value = _LOCAL.sub(lambda match: newest.get(match[0], match[0]), value)
        if _LOCAL.fullmatch(name := place.strip()):
            newest[name] = f"{name}_{number}"
            place = place.replace(name, newest[name])
        text += f"{place}{equals}{value}\n"
    return text


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


def batch_source(program: Program, distances: Program, tableau: Tableau, size: int) -> str:
    """Text of `batch(h, first, count, begin, end, y, d, code, when, error)`: blocks begin to end.

    The program is the derivative of `size` numbers by t, state and drive, of which the last may be
    parameters. Distances are positive as long as the state is valid; their rates follow them, and
    their inputs are the state's first seven, and the parameters. Of RK4, ten lines without those of
    `evaluate_lanes` and `crossings`:

        def batch(h, first, count, begin, end, y, d, code, when, error):
            block = vector(4512)
            for b in range(begin, end):
                lo = b * 32
                for step in range(first, first + count):
                    for stage in range(4):
                        if stage == 1:
                            for x in range(224):
                                block[224 + x] = block[0 + x] + h * (0.5 * block[992 + x])
                        time = step * h + NODES[stage] * h
    """
    drive = len(program.inputs) - 1 - size
    at = Layout(
        SIMD_WIDTH, y=size, s=size, f=size, new=size, d=drive, k=size * len(tableau.b), e=4,
        was=len(distances.outputs), far=len(distances.outputs), code=1, when=1, error=1,
        hit=1, found=1, share=1,
    )  # fmt: skip
    outside = at.rows("d", drive)
    given = ["time", *at.rows("s", size), *outside]
    parameters = outside[drive - (len(distances.inputs) - 7) :]

    def sum_of(weights: tuple[float, ...]) -> str:
        return combination(weights, lambda m: at.lane("k", m * size, "x"))

    def by_stage(line: Callable[[int], str]) -> list[str]:
        """Put a line for each stage, over all numbers of the state in one loop."""
        lines = []
        for stage in range(len(tableau.b)):
            lines += [
                f"{'elif' if stage else 'if'} stage == {stage}:",
                f"    for x in range({size * SIMD_WIDTH}):",
                f"        {line(stage)}",
            ]
        return lines

    def argument(stage: int) -> str:
        """Where a stage evaluates the derivative."""
        more = f" + h * ({sum_of(tableau.a[stage])})" if stage else ""
        return f"{at.lane('s', 0, 'x')} = {at.lane('y', 0, 'x')}{more}"

    load = load_lanes(at, y=size, d=drive)
    load += [f"    {at.lane(name)} = {name}[n]" for name in ("code", "when", "error")]
    limits, both = len(distances.outputs) // 2, len(distances.outputs) * SIMD_WIDTH
    lines = [
        "def batch(h, first, count, begin, end, y, d, code, when, error):",
        *over_blocks(at),
        *indent(8, load),
        *indent(8, evaluate_lanes(distances, [*at.rows("y", 7), *parameters], at, "was")),
        "        for step in range(first, first + count):",
        f"            for stage in range({len(tableau.b)}):",
        *indent(16, by_stage(argument)),
        *indent(16, ["time = step * h + NODES[stage] * h"]),
        *indent(16, evaluate_lanes(program, given, at, "f")),
        *indent(16, by_stage(lambda m: f"{at.lane('k', m * size, 'x')} = {at.lane('f', 0, 'x')}")),
        *indent(12, _results(tableau, size, at, sum_of)),
        *indent(12, evaluate_lanes(distances, [*at.rows("new", 7), *parameters], at, "far")),
        *indent(12, crossings(limits, at)),
        *indent(12, _accept(size, at)),
        f"            for x in range({both}):",
        f"                {at.lane('was', 0, 'x')} = {at.lane('far', 0, 'x')}",
        "        for i in range(last + 1):",
        *(f"            y[{j}, lo + i] = {at.lane('y', j)}" for j in range(size)),
        f"            code[lo + i] = int({at.lane('code')})",
        f"            when[lo + i] = {at.lane('when')}",
        f"            error[lo + i] = {at.lane('error')}",
    ]
    return assign_once(lines)


def over_blocks(at: Layout) -> list[str]:
    """Begin of a function of scenarios: a loop over the blocks begin to end."""
    return [
        f"    block = vector({at.numbers})",
        "    for b in range(begin, end):",
        f"        lo = b * {SIMD_WIDTH}",
        f"        last = min({SIMD_WIDTH}, y.shape[1] - lo) - 1",
    ]


def load_lanes(at: Layout, **rows: int) -> list[str]:
    """Lines that fill groups from arrays of their names; the last scenario is repeated."""
    lines = [f"for i in range({SIMD_WIDTH}):", "    n = lo + min(i, last)"]
    for name, count in rows.items():
        lines += [f"    {at.lane(name, j)} = {name}[{j}, n]" for j in range(count)]
    return lines


def _results(
    tableau: Tableau, size: int, at: Layout, sum_of: Callable[[tuple[float, ...]], str]
) -> list[str]:
    """Write the new state, with a quaternion of length 1, and errors of the quaternion."""
    lines = [
        f"for x in range({size * SIMD_WIDTH}):",
        f"    {at.lane('new', 0, 'x')} = {at.lane('y', 0, 'x')} + h * ({sum_of(tableau.b)})",
        f"for x in range({4 * SIMD_WIDTH}):",
    ]
    if tableau.damping:
        lines += [
            f"    fine = {sum_of(tableau.error)}",
            f"    coarse = {sum_of(tableau.damping)}",
            "    both = fine * fine + 0.01 * (coarse * coarse) + 1e-300",
            f"    {at.lane('e', 0, 'x')} = h * fine * abs(fine) / sqrt(both)",
        ]
    else:
        lines += [f"    {at.lane('e', 0, 'x')} = h * ({sum_of(tableau.error) or '0.0'})"]
    parts = at.rows("new", 4)
    squares = " + ".join(f"{part} * {part}" for part in parts)
    scaled = [f"{part} = {part} * factor" for part in parts]
    return [*lines, *loop(at, [f"factor = 1.0 / sqrt({squares})", *scaled])]


def _accept(size: int, at: Layout) -> list[str]:
    """Accept the new state where it is valid; otherwise record why not, and when."""
    inside = [
        f"found = {at.lane('found')}",
        f"total = {' + '.join(at.lane('new', j) for j in range(size))}",
        f"found = found if total - total == 0.0 else {NOT_FINITE}.0",
        f"before = {at.lane('code')}",
        f"since = {at.lane('when')}",
        "now = before if before != 0.0 else found",
        f"{at.lane('code')} = now",
        f"ends = (step + {at.lane('share')}) * h",
        f"{at.lane('when')} = since if before == now else ends",
        f"least = {at.lane('error')}",
        "worst = least",
    ]
    for j in range(4):
        inside += [f"here = abs({at.lane('e', j)})", "worst = here if here > worst else worst"]
    inside += [f"{at.lane('error')} = worst if now == 0.0 else least"]
    for j in range(size):
        inside += replace_valid(at.lane("y", j), at.lane("new", j))
    return loop(at, inside)


def replace_valid(place: str, new: str) -> list[str]:
    """Lines that put a new number into its place where its scenario runs on, at code `now` = 0."""
    return [f"old = {place}", f"new = {new}", f"{place} = new if now == 0.0 else old"]


def crossings(count: int, at: Layout) -> list[str]:
    """Lines that find which limit a step passes first, in `found`, and at which share of it.

    `was` and `far` hold distances and rates at both ends. Few steps pass one, so lanes only test
    the tangents there, which lie below a curve that turns; what is found is examined lane by lane.

    Ten lines, the last three of the search:

        for i in range(32):
            before = block[2016 + i]
            falling = h * block[2592 + i]
            after = block[3168 + i]
            rising = h * block[3744 + i]
            tangents = before * rising - falling * after + falling * rising
            hit = 1.0 if tangents < 0.0 else hit
        for k in range(32):
            if block[4416 + k] > 0.0:
                for j in range(18):
    """
    test = ["hit = 0.0"]
    for j in range(count):
        test += [
            f"before = {at.lane('was', j)}",
            f"falling = h * {at.lane('was', count + j)}",
            f"after = {at.lane('far', j)}",
            f"rising = h * {at.lane('far', count + j)}",
            "tangents = before * rising - falling * after + falling * rising",
            "tangents = tangents if falling < 0.0 else 1.0",
            "tangents = tangents if rising > 0.0 else 1.0",
            "hit = 1.0 if tangents < 0.0 else hit",
            f"hit = 1.0 if after < {-GRAZING} else hit",
        ]
    code, lanes = at.lane("code"), at.lanes
    test += [
        f"{at.lane('hit')} = hit if {code} == 0.0 else 0.0",
        f"{at.lane('found')} = 0.0",
        f"{at.lane('share')} = 1.0",
    ]
    was, far = at.first("was"), at.first("far")
    search = [
        f"for j in range({count}):",
        f"    before = block[{was} + j * {lanes} + k]",
        f"    falling = h * block[{was + count * lanes} + j * {lanes} + k]",
        f"    after = block[{far} + j * {lanes} + k]",
        f"    rising = h * block[{far + count * lanes} + j * {lanes} + k]",
        "    square = 3.0 * (after - before) - 2.0 * falling - rising",
        "    cube = falling + rising - 2.0 * (after - before)",
        "    root = square * square - 3.0 * cube * falling",
        "    root = sqrt(root) if root > 0.0 else 0.0",
        "    turns = 1.0 if falling < 0.0 else 0.0",
        "    turns = turns if rising > 0.0 else 0.0",
        "    high = -falling / (square + root) if turns > 0.0 else 1.0",
        f"    high = 1.0 if after < {-GRAZING} else high",
        "    least = before + high * (falling + high * (square + high * cube))",
        "    least = after if after < 0.0 else least",
        f"    if least < {-GRAZING}:",
        "        low = 0.0",
        "        for trial in range(52):",
        "            middle = 0.5 * (low + high)",
        "            value = before + middle * (falling + middle * (square + middle * cube))",
        "            low = middle if value >= 0.0 else low",
        "            high = high if value >= 0.0 else middle",
        f"        earlier = 1.0 if {at.lane('found', 0, 'k')} == 0.0 else 0.0",
        f"        earlier = 1.0 if high < {at.lane('share', 0, 'k')} else earlier",
        "        if earlier > 0.0:",
        f"            {at.lane('found', 0, 'k')} = j + 1.0",
        f"            {at.lane('share', 0, 'k')} = high if high > {EARLIEST} else {EARLIEST}",
    ]
    return [
        *loop(at, test),
        "hits = 0.0",
        f"for k in range({lanes}):",
        f"    hits = hits + {at.lane('hit', 0, 'k')}",
        "if hits > 0.0:",
        f"    for k in range({lanes}):",
        f"        if {at.lane('hit', 0, 'k')} > 0.0:",
        *indent(12, search),
    ]
