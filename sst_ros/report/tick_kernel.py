# SPDX-License-Identifier: Apache-2.0
# mypy: disable-error-code="no-untyped-def, no-untyped-call, name-defined"
"""Loops of the report over many ticks, as text that `fixed_step_motion` compiles with a scene.

They call `step_fixed` of `integration.step_loops`; like it they run plain and under numba.
"""
# ruff: noqa: F821

from __future__ import annotations


def integrate_ticks(times, lengths, counts, drives, y, reached):
    """Take y through ticks, tick k by counts[k] steps; reached[k] becomes the state at its end.

    Returns how many ticks were done; there are fewer where a state is not finite.
    """
    for k in range(len(times)):
        h = lengths[k] / counts[k]
        for i in range(counts[k]):
            step_fixed(times[k] + i * h, h, 1, y, drives[k], y)
        total = 0.0
        for i in range(SIZE):
            total += y[i]
            reached[k][i] = y[i]
        if total - total != 0.0:
            return k
    return len(times)


def work_done(states, first, lengths, drives, work):
    """Work over the ticks first[k] to first[k + 1] from states[k] on, one step each: work[k]."""
    y = vector(SIZE)
    for k in range(len(work)):
        for i in range(SIZE - 1):
            y[i] = states[k][i]
        y[SIZE - 1] = 0.0
        for row in range(first[k], first[k + 1]):
            step_fixed(0.0, lengths[row], 1, y, drives[row], y)
        work[k] = y[SIZE - 1]
