# SPDX-License-Identifier: Apache-2.0
"""Plain data that every room uses: joints, states, torques and assembly modes."""

from __future__ import annotations

import functools
import html
import math
import textwrap
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import date, timedelta
from typing import TYPE_CHECKING, Any, NamedTuple, TypeAlias, Union

import numpy as np
from numpy.typing import ArrayLike, NDArray

NANOSECONDS = 1_000_000_000  # of a second: time is integer nanoseconds

Array: TypeAlias = NDArray[np.float64]
Vector3: TypeAlias = tuple[float, float, float]
ZERO: Vector3 = (0.0, 0.0, 0.0)
Quaternion: TypeAlias = tuple[float, float, float, float]  # (x, y, z, w)
TimesLike: TypeAlias = Union[ArrayLike, timedelta]  # noqa: UP007 (at run time)
"""Times [s], as numbers or as durations of NumPy, pandas or `datetime`."""

QUATERNION = slice(4)
STAR_RATE = slice(4, 7)
STAR = slice(7)
LAGGED_TORQUES = slice(7, 10)
"""Places in the state that is integrated.

It has the quaternion of the star, its angular velocity in {E} [rad/s] (`STAR` is both),
the torques of actuators that lag [N m], if any, and the work [J], if it is asked for.
"""

TORQUES = slice(3)
MOMENT = slice(3, None)
"""Places in what drives the equations: torques of the actuators, then the moment on the
star in {B} [N m] where the scene takes one.
"""

JOINT_COUNT = 9
"""Three joints of each of three legs. Their rates follow their angles."""

SI_UNITS = frozenset(
    (
        "",
        "1",
        "dimensionless",
        "s",
        "rad",
        "rad/s",
        "rad/s^2",
        "N m",
        "J",
        "kg",
        "m",
        "kg m^2",
    )
)
"""Units that an array may carry, as those of `to_xarray` do.

The numbers of such an array are taken as they are.
"""

_DOUBLE = np.dtype(float)
_DEEPEST_LIST = 32
"""Levels of lists that are read.

NumPy allows 64 dimensions, a list in itself has more.
"""


class NotNumbers(ValueError):
    """Something that is given as numbers has none, or means more than they say."""


class LostMeaning(NotNumbers):
    """A conversion to doubles would drop what is given beside the numbers."""


def real_numbers(value: Any, *, seconds: bool = False) -> Array:
    """Return real numbers, in whatever form they are given, as an array of doubles.

    It is the given array itself where that is one already. A mask, an imaginary part, a
    unit, a date, text and truth values are refused rather than dropped. With `seconds`,
    durations are converted to seconds.

    Raises:
        NotNumbers: names what is allowed, and what would be lost.

    """
    if type(value) is np.ndarray and value.dtype is _DOUBLE:
        return value
    if reason := find_lost_meaning(value, seconds=seconds):
        raise LostMeaning(reason)
    try:
        array = np.asarray(value)
    except (TypeError, ValueError, OverflowError, MemoryError, RecursionError):
        raise NotNumbers("must be numbers, in rows of equal length") from None
    if reason := find_lost_meaning(array, seconds=seconds):  # of a table, or of a list
        raise LostMeaning(reason)
    if array.dtype.kind == "m":
        return np.asarray(array / np.timedelta64(1, "s"), dtype=float)
    if array.dtype.kind == "O":
        array = _read_objects(array, seconds)
    if array.dtype.kind not in "fiu":
        raise NotNumbers("must be numbers")
    with np.errstate(over="ignore"):  # what is too large for a double is not finite
        return np.asarray(array, dtype=float)


def freeze(array: Array) -> Array:
    """Return a read-only array: a copy, unless it is one already.

    A view is copied as well: who owns its numbers could write to them.
    """
    if array.flags.writeable or not array.flags.owndata:
        array = array.copy()
    array.flags.writeable = False
    return array


if TYPE_CHECKING:
    from functools import cached_property as cached_property
else:

    class cached_property(functools.cached_property):
        """Compute a property once, without a lock.

        Python 3.10 and 3.11 hold a lock of the property meanwhile, for all instances of
        the class. A process forked at that moment would wait for it without end, as the
        thread that holds it exists only in the parent. Threads that read the property
        at once compute it more than once, and all receive the result of the first to
        end.
        """

        def __get__(self, instance: Any, owner: type | None = None) -> Any:
            if instance is None:
                return self
            value = self.func(instance)
            return instance.__dict__.setdefault(self.attrname, value)


class ReadOnly:
    """An object whose arrays are read-only, as are those of its copies."""

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Take the state of a copy or a pickle, in which arrays can be written to."""
        vars(self).update(state)
        self._freeze()

    def _freeze(self) -> None:
        """Make all arrays read-only that the object holds."""
        for value in vars(self).values():
            if isinstance(value, np.ndarray):
                value.flags.writeable = False


def _read_objects(objects: NDArray[Any], seconds: bool) -> Array:
    """Return Python objects (fractions, decimals, durations) as doubles.

    The shape remains.
    """
    numbers = []
    for entry in objects.flat:
        if isinstance(entry, (str, bytes, bytearray, bool, np.bool_)):
            raise NotNumbers("must be numbers")
        if reason := find_lost_meaning(entry, seconds=seconds):
            raise LostMeaning(reason)
        try:
            if isinstance(entry, timedelta):
                numbers.append(entry.total_seconds())
            else:
                numbers.append(float(entry))
        except (TypeError, ValueError, OverflowError, ArithmeticError):
            raise NotNumbers("must be numbers") from None
    return np.array(numbers, dtype=float).reshape(objects.shape)


def find_lost_meaning(value: Any, *, seconds: bool = False, depth: int = 0) -> str:
    """Say what a conversion to doubles would drop, "" if nothing.

    With `seconds` durations are no loss. `depth` counts the lists around the value.
    """
    if type(value) in (float, int):
        return ""
    if isinstance(value, (list, tuple)):
        if depth == _DEEPEST_LIST:
            return "must be numbers, in rows of equal length"
        entry_types = set(map(type, value))
        suspects = tuple(
            entry_type for entry_type in entry_types if not _is_plain(entry_type)
        )
        if not suspects:
            return ""
        for entry in value:
            if isinstance(entry, suspects):
                reason = find_lost_meaning(entry, seconds=seconds, depth=depth + 1)
                if reason:
                    return reason
        return ""
    if _is_masked(value):
        return "must be numbers without a mask: fill in what is masked, or leave it out"
    if isinstance(value, timedelta):
        return "" if seconds else "must be numbers, no durations"
    dtype_kind = getattr(getattr(value, "dtype", None), "kind", "")
    if dtype_kind == "c" or isinstance(value, complex):
        return "must be real numbers, not complex ones"
    if dtype_kind == "m":
        time_unit, _ = np.datetime_data(np.asarray(value).dtype)
        # Years and months have no length.
        has_length = time_unit not in ("generic", "Y", "M")
        return "" if seconds and has_length else "must be numbers, no durations"
    # a datetime and a pandas Timestamp are dates
    if dtype_kind == "M" or isinstance(value, date):
        return "must be numbers, no dates: give seconds since the start"
    unit = getattr(value, "units", None) or getattr(value, "unit", None)
    if unit is not None and not callable(unit) and str(unit) not in SI_UNITS:
        return f"must be plain numbers in SI units and radians; these are in {unit}"
    return ""


def _is_masked(value: Any) -> bool:
    """Return whether a masked array has a masked number.

    `numpy.ma` need not be imported.
    """
    if not isinstance(value, np.ndarray) or value.dtype.names is not None:
        return False
    return bool(np.any(getattr(value, "mask", False)))


def _is_plain(number_type: type) -> bool:
    """Return whether a type is that of a number which is nothing more."""
    if issubclass(number_type, (bool, np.timedelta64)):
        return False
    return issubclass(number_type, (float, int, np.floating, np.integer))


def clamp(torque: Vector3, limit: float | None) -> Vector3:
    """Clamp torques [N m] to the limit of the actuators, where they have one."""
    if limit is None:
        return torque
    first, second, third = (min(max(tau, -limit), limit) for tau in torque)
    return first, second, third


def finite_vector(value: Any) -> Vector3 | None:
    """Return three finite numbers as floats; None where `value` is something else."""
    if type(value) is tuple and len(value) == 3:  # as in each step of a run
        first, second, third = value
        if type(first) is type(second) is type(third) is float:
            finite = math.isfinite(first + second + third)
            if finite or all(map(math.isfinite, value)):
                return value
            return None
    if isinstance(value, (str, bytes)):
        return None
    try:
        first, second, third = value
        plain = type(value) is np.ndarray and value.dtype.kind in "fiu"
        if not plain and find_lost_meaning([value, first, second, third]):
            return None
        if not all(map(math.isfinite, (first, second, third))):  # refuses texts
            return None
        return float(first), float(second), float(third)
    except (TypeError, ValueError, OverflowError):
        return None


class Explained:
    """An object that describes itself in at most ten lines, and as a notebook table."""

    def _facts(self) -> dict[str, object]:
        """Return what describes the object.

        There are at most nine names, with units, and their values.
        """
        raise NotImplementedError

    def __repr__(self) -> str:
        texts = {name: _say(value) for name, value in self._facts().items()}
        width = max(map(len, texts))
        lines = (f"  {name:<{width}}  {text}" for name, text in texts.items())
        return "\n".join([type(self).__name__, *lines])

    def _repr_html_(self) -> str:
        rows = "".join(
            f"<tr><th style='text-align:left'>{html.escape(name)}</th>"
            f"<td style='text-align:left'>{html.escape(_say(value))}</td></tr>"
            for name, value in self._facts().items()
        )
        return f"<table><caption>{type(self).__name__}</caption>{rows}</table>"


def _say(value: object) -> str:
    """Write a value on one line: floats with six digits, several in brackets."""
    if isinstance(value, float):
        return f"{value:.6g}"
    if isinstance(value, (tuple, list, np.ndarray)):
        text = ", ".join(_say(entry) for entry in value)
        return f"({text})" if isinstance(value[0], float) else text
    return textwrap.shorten(str(value), 200, placeholder=" ...")


class Joints(NamedTuple):
    """Angles [rad] and rates [rad/s] of all nine joints, by kind and leg."""

    gamma: Vector3
    mu: Vector3
    beta: Vector3
    gamma_dot: Vector3
    mu_dot: Vector3
    beta_dot: Vector3


@dataclass(frozen=True, repr=False)
class State(Explained):
    """The manipulator at one instant.

    Attributes:
        time_ns: simulated time since the start [ns].
        quaternion: orientation of {E} in {B}, (x, y, z, w).
        body_rate: angular velocity of the star in {E} [rad/s].
        joints: angles and rates of all nine joints.
        torque: torques that the actuators give at this instant [N m]; zero before the
            first step.

    """

    time_ns: int
    quaternion: Quaternion
    body_rate: Vector3
    joints: Joints
    torque: Vector3

    @classmethod
    def of(
        cls, time_ns: int, y: Sequence[float], joints: Sequence[float], torque: Vector3
    ) -> State:
        """Collect a state.

        y begins with quaternion and body rate; `joints` are 18 angles and rates.
        """
        qx, qy, qz, qw, wx, wy, wz, *_ = y
        (
            gamma_1, gamma_2, gamma_3, mu_1, mu_2, mu_3, beta_1, beta_2, beta_3,
            gamma_dot_1, gamma_dot_2, gamma_dot_3, mu_dot_1, mu_dot_2, mu_dot_3,
            beta_dot_1, beta_dot_2, beta_dot_3,
        ) = joints  # fmt: skip
        by_kind = Joints(
            (gamma_1, gamma_2, gamma_3),
            (mu_1, mu_2, mu_3),
            (beta_1, beta_2, beta_3),
            (gamma_dot_1, gamma_dot_2, gamma_dot_3),
            (mu_dot_1, mu_dot_2, mu_dot_3),
            (beta_dot_1, beta_dot_2, beta_dot_3),
        )
        return cls(time_ns, (qx, qy, qz, qw), (wx, wy, wz), by_kind, torque)

    def _facts(self) -> dict[str, object]:
        return {
            "time [s]": self.time_ns / NANOSECONDS,
            "quaternion": self.quaternion,
            "body_rate [rad/s]": self.body_rate,
            **{
                f"{angle} [rad]": getattr(self.joints, angle)
                for angle in ("gamma", "mu", "beta")
            },
            "gamma_dot [rad/s]": self.joints.gamma_dot,
            "torque [N m]": self.torque,
        }


@dataclass(frozen=True)
class Assembly:
    """One assembly mode at given actuator angles: a root of the direct kinematics.

    Arrays are read-only.

    Attributes:
        rotation: R of {E} in {B}, shape (3, 3).
        mu: angles of the passive revolute joints in (-pi, pi] [rad], shape (3,).
        beta: angles of the passive curved prismatic joints in (-pi, pi] [rad], shape
            (3,).
        det_j2: determinant of J2, zero at a parallel singularity.
        admissible: E lies on the base triangle (Eq. 4) with 0 < beta_k <= beta_max for
            all legs.

    """

    rotation: NDArray[np.float64]
    mu: NDArray[np.float64]
    beta: NDArray[np.float64]
    det_j2: float
    admissible: bool


QUANTITIES = {
    "quaternion": ("1", "part"),
    "body_rate": ("rad/s", "axis"),
    "torque": ("N m", "leg"),
    **dict.fromkeys(("gamma", "mu", "beta"), ("rad", "leg")),
    **dict.fromkeys(("gamma_dot", "mu_dot", "beta_dot"), ("rad/s", "leg")),
    "euler_zyz": ("rad", "angle"),
}
"""Unit and dimension of each array of a motion with more than one column."""

DIMENSIONS: dict[str, list[str] | list[int]] = {
    "part": ["x", "y", "z", "w"],
    "axis": ["x", "y", "z"],
    "leg": [1, 2, 3],
    "angle": ["theta", "phi", "psi"],
}

MOTION_UNITS = {"t": "s"}
"""Unit of each column of a table of states: of one motion, or of many at their end."""

for _name, (_unit, _dimension) in QUANTITIES.items():
    MOTION_UNITS |= {f"{_name}_{_part}": _unit for _part in DIMENSIONS[_dimension]}
MOTION_UNITS["energy"] = "J"


BASE_FRAME = "base_link"  # root of the robot (REP 105): frame {B} of the paper
# of joint_states that show a state before the run, in a pause or in a fault
IDLE_FRAME_ID = "idle"


def is_idle(stamp_ns: int, frame_id: str) -> bool:
    """Return whether a joint_states message shows a state and is not a sample of a run.

    Recordings of version 0.1 mark such messages by the stamp zero.
    """
    return stamp_ns == 0 or frame_id == IDLE_FRAME_ID


def nanoseconds(stamp: Any) -> int:
    """Return a Time or Duration as one number [ns]."""
    return int(stamp.sec) * NANOSECONDS + int(stamp.nanosec)
