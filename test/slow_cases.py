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
