# SPDX-License-Identifier: Apache-2.0
"""A bound on the evaluations of the right-hand side in a period."""

from __future__ import annotations


class CannotStep(ArithmeticError):
    """No step is small enough to resolve the motion."""


class BudgetSpent(CannotStep):
    """The evaluations that a period may take are used up."""


class EvaluationBudget:
    """Evaluations of the right-hand side that a period may take; `spent` counts those of a run.

    Args:
        per_period: how many; None for no bound.
        whole_run: they are those of a run, whatever its periods.

    """

    def __init__(self, per_period: int | None = None, *, whole_run: bool = False) -> None:
        self.per_period, self._whole_run = per_period, whole_run
        self.spent = 0
        self._end: float = float("inf")

    def begin(self) -> None:
        """Begin a period."""
        if self.per_period is not None:
            self._end = self.per_period + (0 if self._whole_run else self.spent)

    def charge(self, evaluations: int) -> None:
        """Count evaluations before they are made.

        Raises:
            BudgetSpent: the period has none left.

        """
        if self.spent + evaluations > self._end:
            what = "motion" if self._whole_run else "step"
            raise BudgetSpent(f"{self.per_period} evaluations do not reach the end of the {what}")
        self.spent += evaluations
