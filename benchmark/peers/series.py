# SPDX-License-Identifier: Apache-2.0
"""What an engine brings: a gate, and settings that can be run."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from benchmark.peers.task import Moving, Pose, Task, relative


class Run(NamedTuple):
    """A setting that is ready to go; both start anew each time.

    Attributes:
        whole: do the second, leave the end in the engine's own terms. This is what is timed.
        poses: do it in so many equal pieces and tell the pose at the end of each.

    """

    whole: Callable[[], Any]
    poses: Callable[[int], list[Pose]]


class Failed(Exception):
    """A run that has no result; says why."""


@dataclass(frozen=True)
class Setting:
    """One way to run.

    Attributes:
        label: for people.
        steps: how many, all of one length; 0 where they are adaptive.
        prepare: builds what is needed; it is not timed.
        samples: False where only the pose at the end can be had.

    """

    label: str
    steps: int
    prepare: Callable[[], Run]
    samples: bool = True


@dataclass(frozen=True)
class Series:
    """One engine by one method.

    Attributes:
        engine: whose times are taken together for "best setting".
        name: short name.
        python: where Python is interpreted.
        tolerance: largest relative difference of gamma_ddot at the moving states.
        acceleration: gamma_ddot of the engine at a moving state.
        settings: what is swept.

    """

    engine: str
    name: str
    python: str
    tolerance: float
    acceleration: Callable[[Moving], np.ndarray]
    settings: Sequence[Setting] = field(default_factory=list)

    def gate(self, task: Task) -> float:
        """Largest relative difference to the paper's equations at the moving states."""
        return max(relative(self.acceleration(at), at.answer) for at in task.moving)


def ladder(first: float, last: float, factor: float) -> list[int]:
    """Step counts from first to last, each about `factor` times the one before."""
    counts, now = [], float(first)
    while now <= last * 1.001:
        count = round(now) if now < 40 else 20 * round(now / 20)
        if count not in counts:
            counts.append(count)
        now *= factor
    return counts
