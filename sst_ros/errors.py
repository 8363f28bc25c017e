# SPDX-License-Identifier: Apache-2.0
"""The errors that sst_ros raises on purpose, with values that explain them.

Optional modules.
"""

from __future__ import annotations

import contextlib
import difflib
import errno
import functools
import importlib
import inspect
import math
import os
import stat
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from numbers import Integral, Real
from pathlib import Path
from typing import Any, TypeAlias, TypeVar, cast

import numpy as np

from sst_ros.state import Array, NotNumbers, real_numbers

SHOWN_PROBLEMS = 20  # of one input in a message; `InputError.problems` has all of them
SHOWN, LONGEST_PATH = 80, 4096  # characters of a value in a message, and of a path


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
        text, half = f"{type(self.value).__name__} without a text", SHOWN // 2 - 2
        if isinstance(self.value, int) and self.value:  # of 5,000 digits has no text
            text = f"an integer of {int(math.log10(abs(self.value))) + 1} digits"
        with contextlib.suppress(Exception):
            text = repr(self.value)
        # is whole: it can be copied
        path = isinstance(self.value, str) and os.sep in text
        if len(text) > (LONGEST_PATH if path else SHOWN):
            text = f"{text[:half]}...{text[-half:]}"
        return f"{where}{self.key or 'document'} = {text}: {self.allowed}"


class InputError(SstError):
    """User input (a scene, a parameter, a file) is refused.

    `problems` lists every fault.
    """

    def __init__(self, origin: str, problems: Sequence[Problem]) -> None:
        self.origin = origin
        self.problems = tuple(problems)
        lines = [f"{origin}: {problem}" for problem in self.problems[:SHOWN_PROBLEMS]]
        if more := len(self.problems) - len(lines):
            lines.append(f"{origin}: ... and {more} more")
        super().__init__("\n".join(map(printable, lines)))


Check: TypeAlias = tuple[str, object, bool, str]
"""Name of an argument, its value, whether it is good, and what is allowed."""


def refuse_unless(origin: str, *checks: Check) -> None:
    """Raise InputError with each argument that is not good."""
    problems = [
        Problem(name, value, allowed)
        for name, value, good, allowed in checks
        if not good
    ]
    if problems:
        raise InputError(origin, problems)


_KINDS: dict[str, tuple[Callable[[Any], Any], str]] = {
    "bool": (lambda x: isinstance(x, (bool, np.bool_)), "must be True or False"),
    "int": (
        lambda x: (
            isinstance(x, Integral)
            and not isinstance(x, (bool, np.timedelta64))
            and abs(int(x)) < 2**64
        ),
        "must be a whole number",
    ),
    "float": (
        lambda x: (
            isinstance(x, Real)
            and not isinstance(x, (bool, np.timedelta64))
            and float(x) is not None
        ),
        "must be a number",
    ),
    "str": (lambda x: isinstance(x, str), "must be text"),
    "str | Path": (
        lambda x: isinstance(x, (str, os.PathLike)) and b"\0" not in os.fsencode(x),
        "must be a path",
    ),
    "ArrayLike": (lambda x: real_numbers(x) is not None, "must be numbers"),
    "TimesLike": (
        lambda x: real_numbers(x, seconds=True) is not None,
        "must be times [s]",
    ),
    "Mapping": (
        lambda x: isinstance(x, Mapping) and all(isinstance(key, str) for key in x),
        "must be a mapping from text",
    ),
    "Collection": (
        lambda x: isinstance(x, Collection) and all(isinstance(one, str) for one in x),
        "must be a list of text",
    ),
    "Callable": (callable, "must be a function"),
}
"""Whether an argument is what an annotation says up to its brackets, and this in words."""

_FAILURES = (
    TypeError,
    ValueError,
    AttributeError,
    LookupError,
    ArithmeticError,
    MemoryError,
)
"""Of a function that was given something else."""

F = TypeVar("F", bound=Callable[..., Any])


def check_kinds(function: F, *, late: bool = False) -> F:
    """Refuse arguments of another kind than the annotations of a function say, by InputError.

    Annotations are those of `_KINDS`, and classes, with or without `| None`. What else
    an argument must be is checked by the function itself.
    """
    names = inspect.signature(function).parameters
    texts = {name: str(function.__annotations__.get(name, "")) for name in names}
    origin = function.__qualname__.removesuffix(".__init__").rpartition(".")[2].lower()

    def find_fault(text: str, value: Any) -> str:
        kind = text.removesuffix(" | None")
        if value is None and kind != text:
            return ""
        known = function.__globals__.get(kind)
        good, allowed = _KINDS.get(kind.partition("[")[0], (None, f"must be a {kind}"))
        if good is None:
            wrong = (
                isinstance(known, type)
                and known is not Any
                and not isinstance(value, known)
            )
            return allowed if wrong else ""
        try:
            return "" if good(value) else allowed
        except NotNumbers as error:
            return str(error)
        except (TypeError, ValueError, OverflowError, MemoryError):
            return allowed

    def check(args: tuple[Any, ...], options: dict[str, Any]) -> None:
        given = [*zip(texts, args, strict=False), *options.items()]
        found = [
            (name, value, find_fault(texts.get(name, ""), value))
            for name, value in given
        ]
        if problems := [Problem(*one) for one in found if one[2]]:
            raise InputError(origin, problems)

    @functools.wraps(function)
    def call(*args: Any, **options: Any) -> Any:
        if not late:
            check(args, options)
            return function(*args, **options)
        try:
            return function(*args, **options)
        except _FAILURES:
            check(args, options)
            raise

    return cast("F", call)


def check_kinds_late(function: F) -> F:
    """Refuse as `check_kinds`, but only where the function fails: that takes microseconds."""
    return check_kinds(function, late=True)


def refusal(origin: object, key: str, value: object, allowed: str) -> InputError:
    """Return the error of one fault of an origin, which may be a path."""
    return InputError(str(origin), [Problem(key, value, allowed)])


@contextlib.contextmanager
def refuse_errors(
    origin: str, key: str, value: object, allowed: str, *errors: type[Exception]
) -> Iterator[None]:
    """Raise InputError where a block raises one of the errors, with its words as the reason."""
    try:
        yield
    except errors as error:
        raise refusal(origin, key, value, f"{allowed} ({error})") from None


def check_regular(path: Path) -> None:
    """Raise OSError where a path is a pipe or a device, which may never end, or is not there."""
    mode = path.stat().st_mode
    if not (stat.S_ISREG(mode) or stat.S_ISDIR(mode)):
        raise OSError(errno.EINVAL, "it is no regular file")


def read_numbers(origin: str, name: str, value: Any, *, seconds: bool = False) -> Array:
    """Return real numbers as `real_numbers` does; InputError names the argument."""
    try:
        return real_numbers(value, seconds=seconds)
    except NotNumbers as error:
        raise refusal(origin, name, value, str(error)) from None


class MotionRefused(InputError):
    """A desired motion leaves what the manipulator or its actuators can do."""


class AssemblyError(SstError):
    """The direct kinematics has no unique admissible answer at `gamma` [rad]."""

    def __init__(self, message: str, gamma: Array) -> None:
        self.gamma = gamma
        super().__init__(
            f"{message} at gamma = {np.array2string(gamma, precision=9)} rad"
        )


class NoAdmissibleAssembly(AssemblyError):
    """No real assembly has E on the base triangle with 0 < beta_k <= beta_max."""


class AmbiguousAssembly(AssemblyError):
    """More than one assembly is admissible.

    `candidates` are all of them, each a `state.Assembly`.

    `quaternions` (x, y, z, w) are their orientations, shape (n, 4).
    """

    def __init__(
        self, gamma: Array, candidates: Sequence[Any], quaternions: Array
    ) -> None:
        self.candidates = tuple(candidates)
        listed = ", ".join(
            np.array2string(q, precision=6, separator=", ") for q in quaternions
        )
        found = (
            f"{len(self.candidates)} admissible assemblies, with the orientations"
            f" {listed}"
        )
        super().__init__(f"{found}: name one", gamma)


class SingularConfiguration(SstError):
    """A matrix that must be inverted is singular.

    `measure` is the number that shows it.
    """

    def __init__(self, message: str, measure: float) -> None:
        self.measure = measure
        super().__init__(f"{message} ({measure:.3e})")


class RunStopped(SstError):
    """The motion cannot continue.

    `state`, a `State`, is the last valid one, `time` [s] its end.
    """

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
        (
            letter
            if letter.isprintable()
            else letter.encode("unicode_escape").decode("ascii")
        )
        for letter in text
    )


def suggestion(word: str, known: Iterable[str]) -> str:
    """Return "; did you mean NAME?" for the known name nearest to `word`, "" if none is near."""
    near = difflib.get_close_matches(word, list(known), n=1)
    return f"; did you mean {near[0]!r}?" if near else ""


EXTRAS = dict.fromkeys(
    ("lz4", "mcap", "pandas", "pyarrow", "rosbags", "zstandard"), "record"
)
EXTRAS |= {"distributed": "cluster", "matplotlib": "plot", "pinocchio": "engines"}
EXTRAS |= {
    "argcomplete": "all",
    "control": "control",
    "flint": "proof",
    "llvmlite": "fast",
}
EXTRAS |= {**dict.fromkeys(("trimesh", "viser", "websockets"), "view"), "xarray": "all"}
EXTRAS |= {"casadi": "casadi", "jax": "jax", "mpmath": "mpmath", "sympy": "sympy"}
"""Extra of this package that installs a module."""

_APT = ("argcomplete", "llvmlite", "lz4", "matplotlib", "pandas", "xarray", "zstandard")
_PIP = {
    **dict.fromkeys(("mcap", "rosbags"), "mcap rosbags"),
    "distributed": "dask[distributed]",
}
_PIP |= {
    "flint": "python-flint",
    "pinocchio": "pin",
    "trimesh": "viser",
    "websockets": "viser",
}
_ROS = ("ament_index_python", "rclpy", "rcl_interfaces", "builtin_interfaces")
_NO_WHEEL = ("launch", "launch_ros")  # only a ROS installation has them
_BUILT = {
    "sst_ros_hardware": "colcon build --base-paths src/sst_ros/hardware",
}
"""Packages of ROS that no distribution has, with the command that builds them in a workspace."""


class MissingDependency(SstError, ImportError):
    """An optional dependency is not installed.

    The message names the command that installs it.
    """


def require(module: str) -> Any:
    """Import an optional dependency; MissingDependency says how to install it."""
    try:
        return importlib.import_module(module)
    except ModuleNotFoundError as error:
        if message := explanation(error):
            raise MissingDependency(message, name=error.name) from None
        raise


def explanation(error: ModuleNotFoundError) -> str | None:
    """Return how to install what is missing.

    None for a module that is no optional dependency.
    """
    module = (error.name or "").partition(".")[0]
    if module in _NO_WHEEL:
        return f"{module} is not installed: source a ROS 2 installation"
    ros = module in _ROS or module.endswith(("_msgs", "_srvs"))
    extra = "ros" if ros else EXTRAS.get(module)
    how = (
        f"pip install 'sst_ros[{extra}]' (in the source folder: pip install"
        f" '.[{extra}]')"
    )
    more = "source a ROS 2 installation, or " * ros
    # beside a ROS installation, of a workspace there
    if os.environ.get("ROS_DISTRO") and not ros:
        apt, pip = (
            f"apt install python3-{module}",
            f"pip install {_PIP.get(module, module)}",
        )
        more = f"{apt if module in _APT else pip}, or "
    return f"{module} is not installed: {more}{how}" if extra else None


def explain_missing_ros(packages: Sequence[str]) -> str:
    """Return how to install packages of ROS, or to build those that cannot be installed."""
    distribution = os.environ.get("ROS_DISTRO", "DISTRIBUTION")
    names = [name.replace("_", "-") for name in packages if name not in _BUILT]
    apt = " ".join(f"ros-{distribution}-{name}" for name in names)
    commands = [f"apt install {apt}"] if apt else []
    commands += [_BUILT[name] for name in packages if name in _BUILT]
    return f"this needs the ROS package(s) {', '.join(packages)}: {'; '.join(commands)}"
