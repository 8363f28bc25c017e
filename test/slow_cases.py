# SPDX-License-Identifier: Apache-2.0
"""Cases of which a few are quick tests and the others slow ones."""

import pytest


def slow_except(quick, cases, mark=pytest.mark.slow):
    """Return parameters for a test: the cases, marked where they are not in `quick`."""
    assert all(case in cases for case in quick)
    return [case if case in quick else pytest.param(case, marks=mark) for case in cases]


def slow_after(count, cases, mark=pytest.mark.slow):
    """Return parameters for a test: the first cases, and those after them marked.

    A tuple is a case of several parameters, as in `pytest.mark.parametrize`.
    """
    cases = list(cases)
    return [*cases[:count], *(_marked(case, mark) for case in cases[count:])]


def _marked(case, mark):
    """Return a case with a mark beside the marks and the id that it has already."""
    values, marks, name = case, (), None
    if isinstance(case, type(pytest.param())):
        values, marks, name = case.values, case.marks, case.id
    elif not isinstance(case, tuple):
        values = (case,)
    return pytest.param(*values, marks=[*marks, mark], id=name)
