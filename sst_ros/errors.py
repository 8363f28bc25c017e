# SPDX-License-Identifier: Apache-2.0
"""The errors that sst_ros raises on purpose, with values that explain them; optional modules."""

from __future__ import annotations

import difflib
import importlib
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

SHOWN_PROBLEMS = 20  # of one input in a message; `InputError.problems` has all of them
SHOWN = 80  # characters of a value in a message


class SstError(Exception):
    """Base of all errors that this package raises on purpose."""

    def __reduce__(self) -> tuple[Any, ...]:
        """Go to another process as it is: `__init__` takes other arguments than its text."""
        return Exception.__new__, (type(self), *self.args), vars(self)


@dataclass(frozen=True)
class Problem:
    """One fault in user input: the key it is at, the value found, what is allowed."""

    key: str
    value: object
    allowed: str
    line: int | None = None

    def __str__(self) -> str:
        where = f"line {self.line}: " if self.line is not None else ""
        text, half = repr(self.value), SHOWN // 2 - 2
        if len(text) > SHOWN:  # the end of a path names the file
            text = f"{text[:half]}...{text[-half:]}"
        return f"{where}{self.key or 'document'} = {text}: {self.allowed}"


class InputError(SstError):
    """User input (a scene, a parameter, a file) is refused; `problems` lists every fault."""

    def __init__(self, origin: str, problems: Sequence[Problem]) -> None:
        self.origin = origin
        self.problems = tuple(problems)
        lines = [f"{origin}: {problem}" for problem in self.problems[:SHOWN_PROBLEMS]]
        if more := len(self.problems) - len(lines):
            lines.append(f"{origin}: ... and {more} more")
        super().__init__("\n".join(map(printable, lines)))


def refuse_unless(origin: str, *checks: tuple[str, object, bool, str]) -> None:
    """Raise InputError for each argument that is not good: (name, value, good, what is allowed)."""
    problems = [Problem(name, value, allowed) for name, value, good, allowed in checks if not good]
    if problems:
        raise InputError(origin, problems)


class MotionRefused(InputError):
    """A desired motion leaves what the manipulator or its actuators can do."""


class AssemblyError(SstError):
    """The direct kinematics has no unique admissible answer at `gamma` [rad]."""

    def __init__(self, message: str, gamma: Array) -> None:
        self.gamma = gamma
        super().__init__(f"{message} at gamma = {np.array2string(gamma, precision=9)} rad")


class NoAdmissibleAssembly(AssemblyError):
    """No real assembly has E on the base triangle with 0 < beta_k <= beta_max."""


class AmbiguousAssembly(AssemblyError):
    """More than one assembly is admissible; `candidates` are all of them, each a `state.Assembly`.

    `quaternions` (x, y, z, w) are their orientations, shape (n, 4).
    """

    def __init__(self, gamma: Array, candidates: Sequence[Any], quaternions: Array) -> None:
        self.candidates = tuple(candidates)
        listed = ", ".join(np.array2string(q, precision=6, separator=", ") for q in quaternions)
        found = f"{len(self.candidates)} admissible assemblies, with the orientations {listed}"
        super().__init__(f"{found}: name one", gamma)


class SingularConfiguration(SstError):
    """A matrix that must be inverted is singular; `measure` is the number that shows it."""

    def __init__(self, message: str, measure: float) -> None:
        self.measure = measure
        super().__init__(f"{message} ({measure:.3e})")


class RunStopped(SstError):
    """The motion cannot continue; `state`, a `State`, is the last valid one, `time` [s] its end."""

    def __init__(self, reason: str, time: float, state: Any) -> None:
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


class Diverged(RunStopped):
    """No step, however small, resolves the motion to the tolerance with finite numbers."""


class StepBudgetExceeded(Diverged):
    """A step takes more evaluations of the right-hand side than `step_budget` allows."""


def printable(text: str) -> str:
    """Return one line of text with all that a terminal would act on written as an escape."""
    return "".join(
        letter if letter.isprintable() else letter.encode("unicode_escape").decode("ascii")
        for letter in text
    )


def suggestion(word: str, known: Iterable[str]) -> str:
    """Return "; did you mean NAME?" for the known name nearest to `word`, "" if none is near."""
    near = difflib.get_close_matches(word, list(known), n=1)
    return f"; did you mean {near[0]!r}?" if near else ""


_RECORD = ("lz4", "mcap", "pandas", "pyarrow", "rosbags", "zstandard")
EXTRAS = {
    **{"distributed": "cluster", "matplotlib": "plot", "numba": "fast", "pinocchio": "engines"},
    **{"viser": "view", "xarray": "all", **dict.fromkeys(_RECORD, "record")},
}
"""Extra of this package that installs a module."""

_ROS = ("ament_index_python", "rclpy", "rcl_interfaces", "builtin_interfaces", "launch")


class MissingDependency(SstError, ImportError):
    """An optional dependency is not installed; the message names the command that installs it."""


def require(module: str) -> Any:
    """Import an optional dependency; MissingDependency says how to install it."""
    try:
        return importlib.import_module(module)
    except ModuleNotFoundError as error:
        if message := explanation(error):
            raise MissingDependency(message, name=error.name) from None
        raise


def explanation(error: ModuleNotFoundError) -> str | None:
    """Return how to install what is missing; None for a module that is no optional dependency."""
    module = (error.name or "").partition(".")[0]
    ros = module in _ROS or module.endswith(("_msgs", "_srvs"))
    extra = "ros" if ros else EXTRAS.get(module)
    how = f"pip install 'sst_ros[{extra}]' (in the source folder: pip install '.[{extra}]')"
    more = "source a ROS 2 installation, or " * ros
    return f"{module} is not installed: {more}{how}" if extra else None
