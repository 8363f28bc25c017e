# SPDX-License-Identifier: Apache-2.0
"""Source of many scenarios at once: blocks of lanes that a compiler turns into SIMD.

The operations of a lane are those of a run of its own in the same order. A lane that leaves a limit
of its scene, or whose numbers are not finite, keeps its last valid state and a code; the others
continue. Lanes do not depend on each other, so threads change no bit.
"""

from __future__ import annotations

from typing import NamedTuple

from sst_ros.dynamics.expression import Program
from sst_ros.integration.codegen import combination
from sst_ros.integration.limit_crossings import crossings
from sst_ros.integration.methods import Tableau
from sst_ros.integration.simd_source import Layout, evaluated, indented, loop

SIMD_WIDTH = 32
"""Scenarios of a block; a multiple of what a vector unit takes, and all fit the cache."""

NOT_FINITE = 1000
"""Code of a scenario whose numbers are no longer finite; others are 1 + the limit's index."""


class SampledFeedback(NamedTuple):
    """A controller that acts every `hold` steps; its torques are held until it acts again.

    Attributes:
        program: outputs are the three torques and the new memory; inputs the references of a
            sample, which all scenarios share, the state, the memory, the noise, the rest of the
            drive with the parameters, and the gains.
        references, memory, noise, gains: how many numbers each are.

    """

    program: Program
    references: int
    memory: int
    noise: int
    gains: int


def batch_source(
    program: Program,
    distances: Program,
    tableau: Tableau,
    size: int,
    feedback: SampledFeedback | None = None,
) -> str:
    """Text of `batch(h, first, count, begin, end, y, d, code, when, error)`: blocks begin to end.

    With feedback it takes more: hold, references (samples, numbers), memory (numbers, N), gains
    (numbers, N), rows (N,) and seed; `gaussian(seed, row, counter)` gives its noise.

    Args:
        program: derivative; inputs t, state, drive, of which the last may be parameters.
        distances: numbers that are positive as long as the state is valid, then their rates; inputs
            are the state's first seven, and the parameters.
        tableau: explicit method.
        size: numbers in the state.
        feedback: gives the first three numbers of the drive; none by default.

    Of RK4, ten lines without those of `evaluated` and `crossings`:

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
    more = "" if feedback is None else _MORE
    stages = len(tableau.b)
    at = Layout(
        SIMD_WIDTH, y=size, s=size, f=size, new=size, d=drive, k=size * stages, e=4,
        was=len(distances.outputs), far=len(distances.outputs), code=1, when=1, error=1,
        hit=1, found=1, share=1,
        **_feedback_rows(feedback),
    )  # fmt: skip
    outside = at.rows("d", drive)
    given = ["time", *at.rows("s", size), *outside]
    parameters = outside[drive - (len(distances.inputs) - 7) :]
    limits, both = len(distances.outputs) // 2, len(distances.outputs) * SIMD_WIDTH
    lines = [
        f"def batch(h, first, count, begin, end, y, d, code, when, error{more}):",
        f"    block = vector({at.numbers})",
        "    for b in range(begin, end):",
        f"        lo = b * {SIMD_WIDTH}",
        f"        last = min({SIMD_WIDTH}, y.shape[1] - lo) - 1",
        # Lanes beyond the last repeat it, for all blocks to have the same length.
        f"        for i in range({SIMD_WIDTH}):",
        "            n = lo + min(i, last)",
        *(f"            {at.lane('y', j)} = y[{j}, n]" for j in range(size)),
        *(f"            {at.lane('d', j)} = d[{j}, n]" for j in range(drive)),
        *(f"            {at.lane(name)} = {name}[n]" for name in ("code", "when", "error")),
        *_loaded(feedback, at),
        *indented(8, evaluated(distances, [*at.rows("y", 7), *parameters], at, "was")),
        "        for step in range(first, first + count):",
        *_sampled(feedback, size, drive, at),
        f"            for stage in range({stages}):",
        *indented(16, _arguments(tableau, size, at)),
        *indented(16, ["time = step * h + NODES[stage] * h"]),
        *indented(16, evaluated(program, given, at, "f")),
        *indented(16, _kept(tableau, size, at)),
        *indented(12, _results(tableau, size, at)),
        *indented(12, evaluated(distances, [*at.rows("new", 7), *parameters], at, "far")),
        *indented(12, crossings(limits, at)),
        *indented(12, _accepted(size, at)),
        f"            for x in range({both}):",
        f"                {at.lane('was', 0, 'x')} = {at.lane('far', 0, 'x')}",
        "        for i in range(last + 1):",
        *(f"            y[{j}, lo + i] = {at.lane('y', j)}" for j in range(size)),
        f"            code[lo + i] = int({at.lane('code')})",
        f"            when[lo + i] = {at.lane('when')}",
        f"            error[lo + i] = {at.lane('error')}",
        *_stored(feedback, at),
    ]
    return "\n".join(lines) + "\n"


_MORE = ", hold, references, memory, gains, rows, seed"


def _feedback_rows(feedback: SampledFeedback | None) -> dict[str, int]:
    """Rows of a block that feedback needs."""
    if feedback is None:
        return {}
    return {
        "memory": feedback.memory,
        "noise": feedback.noise,
        "gains": feedback.gains,
        "command": 3 + feedback.memory,
    }


def _loaded(feedback: SampledFeedback | None, at: Layout) -> list[str]:
    # In a loop of its own: one over the arrays of the state, too, compiles for minutes.
    if feedback is None:
        return []
    kinds = {"memory": feedback.memory, "gains": feedback.gains}
    lines = [f"{at.lane(name, j)} = {name}[{j}, n]" for name, m in kinds.items() for j in range(m)]
    head = [f"for i in range({SIMD_WIDTH}):", "    n = lo + min(i, last)"]
    return indented(8, [*head, *indented(4, lines)])


def _stored(feedback: SampledFeedback | None, at: Layout) -> list[str]:
    if feedback is None:
        return []
    lines = [f"memory[{j}, lo + i] = {at.lane('memory', j)}" for j in range(feedback.memory)]
    lines += [f"d[{j}, lo + i] = {at.lane('d', j)}" for j in range(3)]
    return indented(12, lines)


def _sampled(feedback: SampledFeedback | None, size: int, drive: int, at: Layout) -> list[str]:
    """Evaluate the controller at the beginning of a period."""
    if feedback is None:
        return []
    given = [
        *(f"references[sample, {j}]" for j in range(feedback.references)),
        *at.rows("y", size),
        *at.rows("memory", feedback.memory),
        *at.rows("noise", feedback.noise),
        *at.rows("d", drive)[3:],
        *at.rows("gains", feedback.gains),
    ]
    noise = [
        f"{at.lane('noise', j)} = gaussian(seed, rows[n], {feedback.noise} * sample + {j})"
        for j in range(feedback.noise)
    ]
    if noise:
        noise = [f"for i in range({SIMD_WIDTH}):", "    n = lo + min(i, last)", *indented(4, noise)]
    held = [at.lane("d", j) for j in range(3)] + at.rows("memory", feedback.memory)
    accepted = [f"now = {at.lane('code')}"]
    for j, name in enumerate(held):
        accepted += [
            f"old = {name}",
            f"new = {at.lane('command', j)}",
            f"{name} = new if now == 0.0 else old",
        ]
    lines = [
        "sample = step // hold",
        *noise,
        *evaluated(feedback.program, given, at, "command"),
        *loop(at, accepted),
    ]
    return [*indented(12, ["if step % hold == 0:"]), *indented(16, lines)]


def _arguments(tableau: Tableau, size: int, at: Layout) -> list[str]:
    """Where a stage evaluates the derivative, all numbers of the state in one loop."""
    lines = []
    for stage, row in enumerate(tableau.a):
        total = combination(row, lambda m: at.lane("k", m * size, "x"))
        value = f"{at.lane('y', 0, 'x')} + h * ({total})" if stage else at.lane("y", 0, "x")
        lines += [
            f"{'elif' if stage else 'if'} stage == {stage}:",
            f"    for x in range({size * SIMD_WIDTH}):",
            f"        {at.lane('s', 0, 'x')} = {value}",
        ]
    return lines


def _kept(tableau: Tableau, size: int, at: Layout) -> list[str]:
    lines = []
    for stage in range(len(tableau.b)):
        lines += [
            f"{'elif' if stage else 'if'} stage == {stage}:",
            f"    for x in range({size * SIMD_WIDTH}):",
            f"        {at.lane('k', stage * size, 'x')} = {at.lane('f', 0, 'x')}",
        ]
    return lines


def _results(tableau: Tableau, size: int, at: Layout) -> list[str]:
    """Write the new state, with a quaternion of length 1, and errors of the quaternion."""

    def total(weights: tuple[float, ...]) -> str:
        return combination(weights, lambda m: at.lane("k", m * size, "x"))

    lines = [
        f"for x in range({size * SIMD_WIDTH}):",
        f"    {at.lane('new', 0, 'x')} = {at.lane('y', 0, 'x')} + h * ({total(tableau.b)})",
        f"for x in range({4 * SIMD_WIDTH}):",
    ]
    if tableau.damping:
        lines += [
            f"    fine = {total(tableau.error)}",
            f"    coarse = {total(tableau.damping)}",
            "    both = fine * fine + 0.01 * (coarse * coarse) + 1e-300",
            f"    {at.lane('e', 0, 'x')} = h * fine * abs(fine) / sqrt(both)",
        ]
    else:
        lines += [f"    {at.lane('e', 0, 'x')} = h * ({total(tableau.error) or '0.0'})"]
    parts = at.rows("new", 4)
    squares = " + ".join(f"{part} * {part}" for part in parts)
    scaled = [f"{part} = {part} * factor" for part in parts]
    return [*lines, *loop(at, [f"factor = 1.0 / sqrt({squares})", *scaled])]


def _accepted(size: int, at: Layout) -> list[str]:
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
        inside += [
            f"old = {at.lane('y', j)}",
            f"new = {at.lane('new', j)}",
            f"{at.lane('y', j)} = new if now == 0.0 else old",
        ]
    return loop(at, inside)
