# SPDX-License-Identifier: Apache-2.0
"""The errors that sst_ros raises on purpose, with values that explain them.

A missing optional module is one of them: the error says how to install it.
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
from types import NoneType, UnionType
from typing import Any, TypeAlias, TypeVar, Union, cast, get_args, get_origin

import numpy as np
from numpy.typing import ArrayLike

from sst_ros.removed import REMOVED_ARGUMENTS
from sst_ros.state import Array, NotNumbers, TimesLike, cached_property, real_numbers

SHOWN_PROBLEMS = 20  # of one input in a message; `InputError.problems` has all of them
SHOWN_CHARACTERS = 80  # of a value in a message
LONGEST_PATH = 4096  # characters of a path in a message: it is whole, to be copied


class SstError(Exception):
    """Base of all errors that this package raises on purpose."""

    def __reduce__(self) -> tuple[Any, ...]:
        """Support pickling: `__init__` takes other arguments than the error's text."""
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
        return f"{where}{self.key or 'document'} = {self._value_text()}: {self.allowed}"

    def _value_text(self) -> str:
        """Return the value as text, shortened in the middle."""
        try:
            text = repr(self.value)
        except Exception:  # of an object of the user
            text = f"{type(self.value).__name__} without a text"
            if isinstance(self.value, int) and self.value:  # of 5,000 digits has none
                text = f"an integer of {int(math.log10(abs(self.value))) + 1} digits"
        is_path = isinstance(self.value, str) and os.sep in text
        longest = LONGEST_PATH if is_path else SHOWN_CHARACTERS
        if len(text) <= longest:
            return text
        half = SHOWN_CHARACTERS // 2 - 2
        return f"{text[:half]}...{text[-half:]}"


class InputError(SstError):
    """User input (a scene, a parameter, a file) is refused.

    `problems` lists every fault.
    """

    def __init__(self, origin: str, problems: Sequence[Problem]) -> None:
        self.origin = origin
        self.problems = tuple(problems)
        lines = [f"{origin}: {problem}" for problem in self.problems[:SHOWN_PROBLEMS]]
        if hidden := len(self.problems) - len(lines):
            lines.append(f"{origin}: ... and {hidden} more")
        super().__init__("\n".join(map(printable, lines)))


Check: TypeAlias = tuple[str, object, bool, str]
"""Name of an argument, its value, whether it is good, and what is allowed."""


def refuse_unless(origin: str, *checks: Check) -> None:
    """Raise InputError with each argument that is not good."""
    problems = [
        Problem(name, value, requirement)
        for name, value, good, requirement in checks
        if not good
    ]
    if problems:
        raise InputError(origin, problems)


def refuse_other_rounding(origin: str) -> None:
    """Raise InputError where the processor does not round to nearest.

    A library in the same process may have changed the mode (fesetround). All numbers
    of this package, and those of Python itself, are specified for the default alone.
    """
    one = 1.0
    quarter_unit = 2.0**-54
    is_nearest = one + quarter_unit == one and one - quarter_unit == one
    allowed = "must be to nearest, the default of IEEE 754"
    refuse_unless(origin, ("rounding mode", "another one", is_nearest, allowed))


@dataclass(frozen=True)
class Kind:
    """A kind of argument: what accepts a value, and the words of a refusal."""

    accepts: Callable[[Any], Any]
    requirement: str

    def find_fault(self, value: Any) -> str:
        """Return why a value is not of this kind; "" if it is."""
        try:
            return "" if self.accepts(value) else self.requirement
        except NotNumbers as error:
            return str(error)
        except (TypeError, ValueError, OverflowError, MemoryError):
            return self.requirement


def _members(hint: Any) -> frozenset[Any]:
    """Return the types of an annotation, without None."""
    union = get_origin(hint) in (Union, UnionType)
    return frozenset(get_args(hint) if union else (hint,)) - {NoneType}


def _key(hint: Any) -> frozenset[Any]:
    """Return the types of an annotation, without None and without their parameters."""
    return frozenset(get_origin(member) or member for member in _members(hint))


def _is_whole(value: Any) -> bool:
    number = isinstance(value, Integral)
    excluded = isinstance(value, (bool, np.timedelta64))
    return number and not excluded and abs(int(value)) < 2**64


def _is_number(value: Any) -> bool:
    if not isinstance(value, Real) or isinstance(value, (bool, np.timedelta64)):
        return False
    float(value)  # an OverflowError: it is none
    return True


def _is_path(value: Any) -> bool:
    return isinstance(value, (str, os.PathLike)) and b"\0" not in os.fsencode(value)


def _all_text(values: Iterable[Any]) -> bool:
    return all(isinstance(value, str) for value in values)


def _is_flag(value: Any) -> bool:
    return isinstance(value, (bool, np.bool_))


def _is_text(value: Any) -> bool:
    return isinstance(value, str)


def _is_array(value: Any) -> bool:
    return real_numbers(value) is not None


def _is_time(value: Any) -> bool:
    return real_numbers(value, seconds=True) is not None


def _is_mapping(value: Any) -> bool:
    return isinstance(value, Mapping) and _all_text(value)


def _is_list_of_text(value: Any) -> bool:
    return isinstance(value, Collection) and _all_text(value)


_ARGUMENT_KINDS = {
    _key(bool): Kind(_is_flag, "must be True or False"),
    _key(int): Kind(_is_whole, "must be a whole number"),
    _key(float): Kind(_is_number, "must be a number"),
    _key(str): Kind(_is_text, "must be text"),
    _key(str | Path): Kind(_is_path, "must be a path"),
    _key(ArrayLike): Kind(_is_array, "must be numbers"),
    _key(TimesLike): Kind(_is_time, "must be times [s]"),
    _key(Mapping): Kind(_is_mapping, "must be a mapping from text"),
    _key(Collection): Kind(_is_list_of_text, "must be a list of text"),
    _key(Callable): Kind(callable, "must be a function"),
}
"""Kinds by the types of an annotation."""


def _kind_of(hint: Any) -> Kind | None:
    """Return the kind that an annotation asks for.

    None if the function itself checks.
    """
    kind = _ARGUMENT_KINDS.get(_key(hint))
    if kind is not None:
        return kind
    members = list(_members(hint))
    if len(members) > 1:
        return None  # several kinds, which the function itself distinguishes
    wanted = members[0]
    is_class = isinstance(wanted, type) and get_origin(wanted) is None
    if wanted is Any or not is_class:
        return None
    return Kind(lambda x: isinstance(x, wanted), f"must be a {wanted.__name__}")


_FAILURES = (
    TypeError,
    ValueError,
    AttributeError,
    LookupError,
    ArithmeticError,
    MemoryError,
)
"""Errors of a function that was given an argument of another kind."""

F = TypeVar("F", bound=Callable[..., Any])


class _ArgumentCheck:
    """What the annotations of a function say of its arguments."""

    def __init__(self, function: Callable[..., Any]) -> None:
        self._function = function
        self._names = list(inspect.signature(function).parameters)
        qualified_name = function.__qualname__.removesuffix(".__init__")
        _, _, last_name = qualified_name.rpartition(".")  # a class's, of its __init__
        self._origin = last_name.lower()

    @cached_property
    def _kinds(self) -> dict[str, tuple[Kind | None, bool]]:
        """The kind of each argument, and whether it may be None."""
        hints = inspect.get_annotations(self._function, eval_str=True)
        return {
            name: (_kind_of(hint), NoneType in get_args(hint))
            for name, hint in hints.items()
        }

    def _find_fault(self, name: str, value: Any) -> str:
        """Return why an argument is refused; "" if it is not."""
        if name not in self._names and name in REMOVED_ARGUMENTS:
            return REMOVED_ARGUMENTS[name]
        kind, optional = self._kinds.get(name, (None, False))
        if kind is None or (optional and value is None):
            return ""
        return kind.find_fault(value)

    def check(self, args: tuple[Any, ...], options: dict[str, Any]) -> None:
        """Raise InputError with each argument of another kind."""
        problems = []
        for name, value in [*zip(self._names, args, strict=False), *options.items()]:
            if fault := self._find_fault(name, value):
                problems.append(Problem(name, value, fault))
        if problems:
            raise InputError(self._origin, problems)


def check_kinds(function: F, *, late: bool = False) -> F:
    """Raise InputError for arguments of another kind than a function's annotations.

    Annotations are those of `_ARGUMENT_KINDS`, and classes, with or without `| None`.
    What else an argument must be is checked by the function itself.
    """
    arguments = _ArgumentCheck(function)

    @functools.wraps(function)
    def call(*args: Any, **options: Any) -> Any:
        if not late:
            arguments.check(args, options)
            return function(*args, **options)
        try:
            return function(*args, **options)
        except _FAILURES:
            arguments.check(args, options)
            raise

    return cast("F", call)


def check_kinds_late(function: F) -> F:
    """Apply `check_kinds` only where the function fails: it takes microseconds."""
    return check_kinds(function, late=True)


def refusal(origin: object, key: str, value: object, requirement: str) -> InputError:
    """Return the error of one fault of an origin, which may be a path."""
    return InputError(str(origin), [Problem(key, value, requirement)])


@contextlib.contextmanager
def refuse_errors(
    origin: str, key: str, value: object, requirement: str, *errors: type[Exception]
) -> Iterator[None]:
    """Raise InputError where a block raises one of the errors.

    The words of that error are given as the reason.
    """
    try:
        yield
    except errors as error:
        raise refusal(origin, key, value, f"{requirement} ({error})") from None


def check_regular(path: Path) -> None:
    """Raise OSError where a path is missing, or is a pipe or a device.

    Reading from a pipe or a device may never end.
    """
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
        message = (
            f"{len(self.candidates)} admissible assemblies, with the orientations"
            f" {listed}"
        )
        super().__init__(f"{message}: name one", gamma)


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
    """An actuator reached an end of its stroke: gamma_k = 0 or arc P_k P_k+1."""


class WorkspaceLeft(RunStopped):
    """beta_k left (0, beta_max].

    E reached an edge of the base triangle or of the star's arcs.
    """


class SingularityReached(RunStopped):
    """mu_k reached 0 or pi, where gamma_k has no value.

    The arc of the star lies along the base arc.
    """


class Diverged(RunStopped):
    """No step size resolves the motion to the tolerance with finite numbers."""


class StepBudgetExceeded(Diverged):
    """A step takes more right-hand side evaluations than `step_budget` allows."""


def printable(text: str) -> str:
    """Return one line of text with all that a terminal would act on escaped."""
    return "".join(
        (
            letter
            if letter.isprintable()
            else letter.encode("unicode_escape").decode("ascii")
        )
        for letter in text
    )


def suggestion(name: str, names: Iterable[str]) -> str:
    """Return "; did you mean NAME?" for the known name nearest to `name`.

    Where none is near, return "".
    """
    matches = difflib.get_close_matches(name, list(names), n=1)
    return f"; did you mean {matches[0]!r}?" if matches else ""


EXTRAS = {
    "argcomplete": "all",
    "casadi": "casadi",
    "control": "control",
    "distributed": "cluster",
    "flint": "proof",
    "jax": "jax",
    "llvmlite": "fast",
    "lz4": "record",
    "matplotlib": "plot",
    "mcap": "record",
    "mpmath": "mpmath",
    "pandas": "record",
    "pinocchio": "engines",
    "pyarrow": "record",
    "rosbags": "record",
    "sympy": "sympy",
    "trimesh": "view",
    "viser": "view",
    "websockets": "view",
    "xarray": "all",
    "zstandard": "record",
}
"""Extra of this package that installs a module."""

_APT = ("argcomplete", "llvmlite", "lz4", "matplotlib", "pandas", "xarray", "zstandard")
_PIP = {
    "distributed": "dask[distributed]",
    "flint": "python-flint",
    "mcap": "mcap rosbags",
    "pinocchio": "pin",
    "rosbags": "mcap rosbags",
    "trimesh": "viser",
    "websockets": "viser",
}
_ROS = ("ament_index_python", "rclpy", "rcl_interfaces", "builtin_interfaces")
_NO_WHEEL = ("launch", "launch_ros")  # only a ROS installation has them
_BUILT = {
    "sst_ros_hardware": "colcon build --base-paths src/sst_ros/hardware",
}
"""ROS packages that no distribution has, by the command that builds them.

The command runs in a workspace.
"""


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
    is_ros = module in _ROS or module.endswith(("_msgs", "_srvs"))
    extra = "ros" if is_ros else EXTRAS.get(module)
    if not extra:
        return None
    commands = []
    if is_ros:
        commands.append("source a ROS 2 installation")
    elif os.environ.get("ROS_DISTRO"):
        # beside a ROS installation, of a workspace there
        in_ubuntu = module in _APT
        apt = f"apt install python3-{module}"
        pip = f"pip install {_PIP.get(module, module)}"
        commands.append(apt if in_ubuntu else pip)
    commands.append(
        f"pip install 'sst_ros[{extra}]' (in the source folder: pip install"
        f" '.[{extra}]')"
    )
    return f"{module} is not installed: {', or '.join(commands)}"


def explain_missing_ros(packages: Sequence[str]) -> str:
    """Return how to install ROS packages or build those that cannot be installed."""
    distribution = os.environ.get("ROS_DISTRO", "DISTRIBUTION")
    names = [name.replace("_", "-") for name in packages if name not in _BUILT]
    apt = " ".join(f"ros-{distribution}-{name}" for name in names)
    commands = [f"apt install {apt}"] if apt else []
    commands += [_BUILT[name] for name in packages if name in _BUILT]
    return f"this needs the ROS package(s) {', '.join(packages)}: {'; '.join(commands)}"
