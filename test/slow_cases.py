# SPDX-License-Identifier: Apache-2.0
"""Cases of which a few are quick tests and the others slow ones."""

import pytest


def slow_except(quick, cases):
    """Return parameters for a test: the cases, slow where they are not in `quick`."""
    assert all(case in cases for case in quick)
    return [
        case if case in quick else pytest.param(case, marks=pytest.mark.slow)
        for case in cases
    ]


def slow_after(count, cases):
    """Return parameters for a test: the first cases, and those after them as slow.

    A tuple is a case of several parameters, as in `pytest.mark.parametrize`.
    """
    cases = list(cases)
    return [*cases[:count], *(_slow(case) for case in cases[count:])]


def _slow(case):
    """Return the case of a slow test, with the marks and the id that it has already."""
    values, marks, name = case, (), None
    if isinstance(case, type(pytest.param())):
        values, marks, name = case.values, case.marks, case.id
    elif not isinstance(case, tuple):
        values = (case,)
    return pytest.param(*values, marks=[*marks, pytest.mark.slow], id=name)
