# SPDX-License-Identifier: Apache-2.0
"""Source of many scenarios at once: blocks of lanes that a compiler can turn into SIMD.

A lane that leaves what its scene allows, or finite numbers, keeps its last valid state and a code;
the others go on. Lanes do not touch each other, so threads change no bit.
"""

from __future__ import annotations

from sst_ros.integration.tableaux import Tableau
from sst_ros.mechanism.trace import Program

LANES = 64
NOT_FINITE = 1000


def batch_source(program: Program, margins: Program, tableau: Tableau, size: int) -> list[str]:
    """Texts of a module whose `batch(h, first, count, y, d, code, when, error)` runs all lanes.

    Args:
        program: derivative; inputs t, state, drive.
        margins: numbers that are positive as long as the state is valid; inputs as the state's
            first seven.
        tableau: explicit method.
        size: numbers in the state.

    """
    drive = len(program.inputs) - 1 - size
    return [
        "@jit\n" + _lanes(program, "rhs", ["t", "state", "drive"], 1, size),
        "@jit\n" + _lanes(margins, "margins", ["state"], 0, 7),
        _step(tableau, size),
        _block(size, drive, len(margins.outputs), len(tableau.b)),
    ]


def _lanes(program: Program, name: str, arrays: list[str], scalars: int, size: int) -> str:
    """Wrap a program in a loop over lanes; arrays have one row per number."""
    lines = program.source("body").splitlines()
    loads = [f"        {x} = state[{i}, i]" for i, x in enumerate(program.inputs[scalars:][:size])]
    rest = program.inputs[scalars + size :]
    loads += [f"        {x} = drive[{i}, i]" for i, x in enumerate(rest)]
    body = ["    " + line for line in lines[1:-1]]
    results = lines[-1].strip().removeprefix("return (").removesuffix(",)").split(", ")
    stores = [f"        out[{i}, i] = {result}" for i, result in enumerate(results)]
    head = [f"def {name}({', '.join(arrays)}, out, lanes):", "    for i in range(lanes):"]
    return "\n".join([*head, *loads, *body, *stores]) + "\n"


def _step(tableau: Tableau, size: int) -> str:
    """One step of all lanes: k holds the stages, s the arguments, new and e the results.

    There is one call of `rhs` in the text; twelve would be compiled twelve times.
    """
    count = len(tableau.b)
    padded = [(*row, *(0.0,) * (count - len(row))) for row in tableau.a]
    return f"""\
A = np.array({padded!r})
C = np.array({tableau.c!r})
B = np.array({tableau.b!r})
FINE = np.array({tableau.error or (0.0,) * count!r})
COARSE = np.array({tableau.damping or (0.0,) * count!r})

@jit
def step(t, h, y, d, k, s, new, e, lanes):
    for stage in range({count}):
        for j in range({size}):
            for i in range(lanes):
                s[j, i] = 0.0
            for m in range(stage):
                weight = A[stage, m]
                if weight != 0.0:
                    for i in range(lanes):
                        s[j, i] += weight * k[m, j, i]
            for i in range(lanes):
                s[j, i] = y[j, i] + h * s[j, i]
        rhs(t + C[stage] * h, s, d, k[stage], lanes)
    for j in range({size}):
        for i in range(lanes):
            total = fine = coarse = 0.0
            for m in range({count}):
                total += B[m] * k[m, j, i]
                fine += FINE[m] * k[m, j, i]
                coarse += COARSE[m] * k[m, j, i]
            new[j, i] = y[j, i] + h * total
            if {bool(tableau.damping)}:
                fine *= abs(fine) / sqrt(fine * fine + 0.01 * (coarse * coarse) + 1e-300)
            e[j, i] = h * fine
"""


def _block(size: int, drive: int, margin_count: int, stages: int) -> str:
    return f"""\
@jit
def block(h, first, count, y, d, code, when, error, lanes):
    k = np.empty(({stages}, {size}, {LANES}))
    s = np.empty(({size}, {LANES}))
    new = np.empty(({size}, {LANES}))
    e = np.empty(({size}, {LANES}))
    far = np.empty(({margin_count}, {LANES}))
    for n in range(count):
        step((first + n) * h, h, y, d, k, s, new, e, lanes)
        for i in range(lanes):
            x0, x1, x2, x3 = new[0, i], new[1, i], new[2, i], new[3, i]
            scale = 1.0 / sqrt(x0 * x0 + x1 * x1 + x2 * x2 + x3 * x3)
            new[0, i] = x0 * scale
            new[1, i] = x1 * scale
            new[2, i] = x2 * scale
            new[3, i] = x3 * scale
        margins(new, far, lanes)
        for i in range(lanes):
            if code[i] != 0:
                continue
            found = 0
            total = 0.0
            for j in range({size}):
                total += new[j, i]
            if not total - total == 0.0:
                found = {NOT_FINITE}
            else:
                for j in range({margin_count}):
                    if far[j, i] < 0.0 and found == 0:
                        found = j + 1
            if found != 0:
                code[i] = found
                when[i] = (first + n + 1) * h
                continue
            for j in range({size}):
                y[j, i] = new[j, i]
                error[i] = max(error[i], abs(e[j, i])) if j < 4 else error[i]
"""


def driver() -> str:
    """Source of the loop over blocks, for all cores."""
    return f"""\
def batch(h, first, count, y, d, code, when, error):
    blocks = (y.shape[1] + {LANES - 1}) // {LANES}
    for b in prange(blocks):
        lo = b * {LANES}
        hi = min(lo + {LANES}, y.shape[1])
        lanes = hi - lo
        part = np.empty((y.shape[0], {LANES}))
        given = np.empty((d.shape[0], {LANES}))
        part[:, :lanes] = y[:, lo:hi]
        given[:, :lanes] = d[:, lo:hi]
        block(h, first, count, part, given, code[lo:hi], when[lo:hi], error[lo:hi], lanes)
        y[:, lo:hi] = part[:, :lanes]
"""
