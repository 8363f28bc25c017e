# SPDX-License-Identifier: Apache-2.0
"""The catalogue of extreme cases, and its evaluation on all cores."""

from __future__ import annotations

from collections.abc import Iterator

from sst_ros.studies.extreme_cases import Case, CaseResult, evaluate_case
from sst_ros.studies.geometry_cases import geometry_cases
from sst_ros.studies.load_cases import load_cases
from sst_ros.studies.parallel import evaluate_grid
from sst_ros.studies.scaling_cases import scaling_cases


def cases() -> Iterator[Case]:
    """Yield the catalogue."""
    yield from scaling_cases()
    yield from geometry_cases()
    yield from load_cases()


def results(*, workers: int | None = None, shown: bool = False) -> list[CaseResult]:
    """Evaluate the whole catalogue on all cores."""
    count = len(list(cases()))
    return evaluate_grid(
        _numbered, range(count), workers=workers, label="extreme cases   ", shown=shown
    )


def _numbered(number: int) -> CaseResult:
    return evaluate_case(list(cases())[number])
