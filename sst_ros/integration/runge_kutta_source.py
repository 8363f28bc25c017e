# SPDX-License-Identifier: Apache-2.0
"""Source of one step of an explicit Runge-Kutta method, written out for scalars.

The step calls a function `rhs(t, y0, .., d0, ..)` of the state y and of the drive d, which is
constant over the step. It returns the new state and then the local error estimate of each number
of the state, zero where the method has none: its steps are as long as they are asked to be.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

from sst_ros.integration.methods import Tableau


def explicit_step(tableau: Tableau, size: int, drive: int) -> str:
    """Source of `step(t, h, y0, .., d0, ..)` for `size` states and `drive` constants."""
    y, d = _names("y", size), _names("d", drive)
    lines = [f"def step({', '.join(['t', 'h', *y, *d])}):"]
    for stage, row in enumerate(tableau.a):
        for j in range(size) if stage else ():
            lines.append(f"    s{j} = y{j} + h * ({_combination(row, j)})")
        inputs = _names("s", size) if stage else y
        time = f"t + {tableau.c[stage]!r} * h" if tableau.c[stage] else "t"
        outputs = ", ".join(f"k{stage}_{j}" for j in range(size))
        lines.append(f"    {outputs} = rhs({', '.join([time, *inputs, *d])})")
    for j in range(size):
        lines.append(f"    n{j} = y{j} + h * ({_combination(tableau.b, j)})")
        if not tableau.error:
            lines.append(f"    e{j} = 0.0")
        elif not tableau.damping:
            lines.append(f"    e{j} = h * ({_combination(tableau.error, j)})")
        else:
            # Hairer's estimate for DOP853, each number of the state for itself.
            lines.append(f"    fine = {_combination(tableau.error, j)}")
            lines.append(f"    coarse = {_combination(tableau.damping, j)}")
            lines.append("    both = fine * fine + 0.01 * (coarse * coarse)")
            lines.append(f"    e{j} = h * fine * abs(fine) / sqrt(both) if both > 0.0 else 0.0")
    results = ", ".join([*_names("n", size), *_names("e", size)])
    lines.append(f"    return ({results},)")
    return "\n".join(lines) + "\n"


def combination(weights: Sequence[float], word: Callable[[int], str]) -> str:
    """Sum of weights times words, without the zeros; "" where there is nothing else."""
    terms = [f"{w!r} * {word(i)}" for i, w in enumerate(weights) if w]
    return " + ".join(terms).replace("+ -", "- ")


def _combination(weights: Sequence[float], j: int) -> str:
    return combination(weights, lambda i: f"k{i}_{j}")


def _names(letter: str, count: int) -> list[str]:
    return [f"{letter}{i}" for i in range(count)]
