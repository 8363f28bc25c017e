# SPDX-License-Identifier: Apache-2.0
"""Every error that sst_ros raises on purpose; each carries what explains it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

if TYPE_CHECKING:
    from sst_ros.mechanism.kinematics import Assembly
    from sst_ros.simulation import State


class SstError(Exception):
    """Base of all errors that this package raises on purpose."""


@dataclass(frozen=True)
class Problem:
    """One fault in user input: the key it is at, the value found, what is allowed."""

    key: str
    value: object
    allowed: str
    line: int | None = None

    def __str__(self) -> str:
        where = f"line {self.line}: " if self.line is not None else ""
        return f"{where}{self.key or 'document'} = {_shorten(self.value)}: {self.allowed}"


class InputError(SstError):
    """User input (a scene, a parameter, a file) is refused; `problems` lists every fault."""

    def __init__(self, origin: str, problems: Sequence[Problem]) -> None:
        self.origin = origin
        self.problems = tuple(problems)
        super().__init__("\n".join(f"{origin}: {problem}" for problem in self.problems))


class MotionRefused(InputError):
    """A desired motion leaves what the manipulator or its actuators can do."""


class AssemblyError(SstError):
    """The direct kinematics has no unique admissible answer at `gamma` [rad]."""

    def __init__(self, message: str, gamma: NDArray[np.float64]) -> None:
        self.gamma = gamma
        super().__init__(f"{message} at gamma = {np.array2string(gamma, precision=9)} rad")


class NoAdmissibleAssembly(AssemblyError):
    """No real assembly has E on the base triangle with 0 < beta_k <= beta_max."""


class AmbiguousAssembly(AssemblyError):
    """More than one assembly is admissible; `candidates` are all of them."""

    def __init__(self, gamma: NDArray[np.float64], candidates: Sequence[Assembly]) -> None:
        self.candidates = tuple(candidates)
        quaternions = (Rotation.from_matrix(one.rotation).as_quat() for one in candidates)
        told = ", ".join(np.array2string(q, precision=6, separator=", ") for q in quaternions)
        said = f"{len(candidates)} admissible assemblies, with the orientations {told}: name one"
        super().__init__(said, gamma)


class SingularConfiguration(SstError):
    """A matrix that must be inverted is singular; `measure` is the number that says so."""

    def __init__(self, message: str, measure: float) -> None:
        self.measure = measure
        super().__init__(f"{message} ({measure:.3e})")


class RunStopped(SstError):
    """The motion cannot go on; `state` is the last valid one, `time` [s] says when it ended."""

    def __init__(self, reason: str, time: float, state: State) -> None:
        self.reason = reason
        self.time = time
        self.state = state
        super().__init__(f"stopped at t = {time:.12f} s: {reason}")


class StrokeExceeded(RunStopped):
    """An actuator reached an end of its stroke, gamma_k = 0 or gamma_k = arc P_k P_k+1."""


class WorkspaceLeft(RunStopped):
    """beta_k left (0, beta_max]: E reached an edge of the base triangle or of the star's arcs."""


class SingularityReached(RunStopped):
    """mu_k reached 0 or pi: the arc of the star lies along the base arc, gamma_k has no value."""


class ImpactsAccumulate(RunStopped):
    """Impacts at an end of the stroke follow each other without coming to rest."""


class Diverged(RunStopped):
    """No step, however small, resolves the motion to the tolerance with finite numbers."""


def _shorten(value: object, limit: int = 80) -> str:
    text = repr(value)
    return text if len(text) <= limit else text[: limit - 3] + "..."
