# SPDX-License-Identifier: Apache-2.0
"""Torques over time, as a user gives them: all are a `TorqueProfile`.

They are numbers, sines, tables, polynomials or functions. A motion is divided at the
`kinks` of its profile; on each part a `piece` acts, which is smooth there. The
integrator holds its numbers, has it as a part of the traced equations, or evaluates it
by `at`.
"""

from __future__ import annotations

import contextlib
import csv
import inspect
import math
from collections.abc import Callable, Sequence
from itertools import chain
from pathlib import Path
from typing import Any, TextIO, TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from sst_ros.errors import (
    InputError,
    Problem,
    check_kinds,
    check_regular,
    read_numbers,
    refusal,
    refuse_errors,
    refuse_unless,
)
from sst_ros.scene.schema import NUMBER, Section, entry
from sst_ros.state import (
    ZERO,
    Array,
    ReadOnly,
    State,
    TimesLike,
    Vector3,
    finite_vector,
    freeze,
)

TorqueFunction: TypeAlias = (
    Callable[[float], Sequence[float]] | Callable[[float, State], Sequence[float]]
)
"""Torques [N m] at a time [s], or at a time and a state."""

# radians of a sine beyond which its clamping is not computed in advance: there would be
# some 1e5 times, each the begin of a step
_MOST_CROSSINGS = 1e5


def ascend(times: Array) -> bool:
    """Return whether times are finite and ascending, shape (n,)."""
    if times.ndim != 1:
        return False
    return bool(np.isfinite(times).all() and (times[1:] > times[:-1]).all())


class TorqueProfile(ReadOnly):
    """Torques that act over a motion.

    A motion keeps the profile that it was given, so nothing in it can change.

    Attributes:
        kind: name of the kind, in files.
        feedback: whether the torques depend on the state, too.
        is_known_ahead: whether they follow from numbers, not from a function.
        held: the torques where they are the same at all times [N m], else None.

    """

    kind = "function"
    feedback = False
    is_known_ahead = True
    held: Vector3 | None = None

    def __setattr__(self, name: str, value: Any) -> None:
        """Set an attribute once."""
        if name in vars(self):
            raise AttributeError(
                f"{name} is read-only: make another {type(self).__name__}"
            )
        super().__setattr__(name, value)

    def at(self, time: float, *state: State) -> Vector3:
        """Torques [N m] at a time [s], and a state if `feedback`."""
        first, second, third = self.values(np.array([time]))[0].tolist()
        return first, second, third

    def at_times(self, times: Sequence[float]) -> list[Vector3]:
        """Torques [N m] at times [s], each as by `at`."""
        return [self.at(time) for time in times]

    def values(self, t: Array) -> Array:
        """Torques [N m] at times [s], shape (n,) -> (n, 3); nan if not known from t."""
        return np.full((len(t), 3), np.nan)

    def kinks(self, limit: float | None = None, end: float = math.inf) -> Array:
        """Return the times [s] at which torques have kinks.

        There torques, or their derivatives, jump or pass a limit [N m]. Those of a
        limit are the ones from 0 to `end` [s].
        """
        return np.empty(0)

    def piece(self, begin: float, end: float) -> TorqueProfile:
        """Return the smooth torques of [begin, end], inside of which is no kink."""
        return self

    def record(self) -> dict[str, Any]:
        """Return kind and numbers, from which `profile_from` builds it again."""
        numbers = {name: np.asarray(x).tolist() for name, x in vars(self).items()}
        return {"kind": self.kind, **numbers}


class LostTorque(TorqueProfile):
    """Torques of a function that a file does not have: known at the samples alone."""

    is_known_ahead = False

    def at(self, time: float, *state: State) -> Vector3:
        """Refuse: raises InputError."""
        allowed = "must be given: the function of the torques is not in the file"
        raise refusal("simulate", "torque", "a lost function", allowed)


class ConstantTorque(TorqueProfile):
    """The same three torques [N m] at all times.

    InputError is raised for anything but three finite numbers.
    """

    kind = "constant"

    def __init__(self, torque: Any) -> None:
        self.torque = _three_numbers(torque, "torque")

    @property
    def held(self) -> Vector3:  # type: ignore[override]
        """The torques [N m]."""
        return self.torque

    def at(self, time: float, *state: State) -> Vector3:
        """See `TorqueProfile`."""
        return self.torque

    def values(self, t: Array) -> Array:
        """See `TorqueProfile`."""
        return np.tile(self.torque, (len(t), 1))


class SineTorque(TorqueProfile, Section):
    """Torques tau_k(t) = amplitude_k sin(frequency_k t + phase_k)."""

    kind = "sine"

    amplitude: Vector3 = entry("amplitudes", "N m")
    frequency: Vector3 = entry("angular frequencies", "rad/s", least=0.0)
    phase: Vector3 = entry("phases", "rad", default=ZERO)

    # A section of a scene, which nothing can change, is copied as one.
    __getstate__ = Section.__getstate__
    __setstate__ = Section.__setstate__

    def at(self, time: float, *state: State) -> Vector3:
        """See `TorqueProfile`; by the sine of `math`."""
        rows = zip(self.amplitude, self.frequency, self.phase, strict=True)
        first, second, third = (a * math.sin(f * time + p) for a, f, p in rows)
        return first, second, third

    def values(self, t: Array) -> Array:
        """Torques [N m] at times [s], shape (n,) -> (n, 3), by the sine of NumPy."""
        angles = np.multiply.outer(t, self.frequency) + self.phase
        return np.asarray(np.array(self.amplitude) * np.sin(angles))

    def kinks(self, limit: float | None = None, end: float = math.inf) -> Array:
        """See `TorqueProfile`."""
        crossings: list[Array] = []
        legs = zip(self.amplitude, self.frequency, self.phase, strict=True)
        for amplitude, f, phase in legs:
            if limit is None or abs(amplitude) <= limit:
                continue
            # The step control has to find those of a sine that is too fast.
            if not 0.0 < f * end <= _MOST_CROSSINGS:
                continue
            # The torque passes the limit, of either sign, where the sine's argument is
            # a multiple of pi plus or minus this angle.
            angle = np.arcsin(limit / amplitude)
            first_turn = np.floor(phase / np.pi) - 1
            last_turn = np.ceil((phase + f * end) / np.pi) + 2
            turns = np.arange(first_turn, last_turn)
            for crossing in (angle, -angle):
                crossings.append((np.pi * turns + crossing - phase) / f)
        if not crossings:
            return np.empty(0)
        times = np.unique(np.concatenate(crossings))
        return np.asarray(times[(times > 0.0) & (times < end)])


class PolynomialTorque(TorqueProfile):
    """Polynomial pieces, in the layout of `scipy.interpolate.PPoly`.

    Zero outside of them.

    The coefficients have the highest power first, shape (order + 1, pieces, 3); the
    breakpoints are the beginnings of the pieces and the end of the last [s], shape
    (pieces + 1,). InputError is raised where shapes, order or numbers are not allowed.
    """

    kind = "polynomial"

    @check_kinds
    def __init__(self, coefficients: ArrayLike, breakpoints: TimesLike) -> None:
        self.c = freeze(read_numbers("torque", "coefficients", coefficients))
        self.x = freeze(
            read_numbers("torque", "breakpoints", breakpoints, seconds=True)
        )
        ascending = self.x.size > 1 and ascend(self.x)
        count = max(self.x.size - 1, 1)
        size = self.c.shape
        shape = f"must have the shape (order + 1, {count}, 3)"
        finite = bool(np.all(np.isfinite(self.c)))
        times = "must be two or more ascending times [s]"
        refuse_unless(
            "torque",
            ("breakpoints", breakpoints, ascending, times),
            ("coefficients", size, size[1:] == (count, 3), shape),
            ("coefficients", "not finite", finite, "must be finite"),
        )

    __call__ = TorqueProfile.at

    def values(self, t: Array) -> Array:
        """See `TorqueProfile`."""
        from scipy.interpolate import PPoly  # takes 0.3 s; most runs have no polynomial

        return np.asarray(np.nan_to_num(PPoly(self.c, self.x, extrapolate=False)(t)))

    def kinks(self, limit: float | None = None, end: float = math.inf) -> Array:
        """See `TorqueProfile`."""
        from scipy.interpolate import PPoly

        # SciPy 1.11 finds no roots where the arrays are read-only.
        breaks = self.x.copy()
        times = [self.x]
        for coefficients in np.moveaxis(self.c, 2, 0):
            leg = PPoly(coefficients.copy(), breaks)
            if limit is not None:
                times.append(leg.solve(limit, extrapolate=False))
                times.append(leg.solve(-limit, extrapolate=False))
        candidates = np.concatenate(times)
        return np.unique(candidates[np.isfinite(candidates)])

    def piece(self, begin: float, end: float) -> TorqueProfile:
        """See `TorqueProfile`."""
        number = int(np.searchsorted(self.x, 0.5 * (begin + end))) - 1
        if not 0 <= number < self.c.shape[1]:
            return ConstantTorque(ZERO)
        return _PolynomialPiece(float(self.x[number]), self.c[:, number].tolist())


class _PolynomialPiece(TorqueProfile):
    """One piece of a `PolynomialTorque`, also outside of its breakpoints.

    Args:
        start: its breakpoint [s].
        rows: three coefficients for each power of the time since then, the highest
            first.

    """

    def __init__(self, start: float, rows: Sequence[Sequence[float]]) -> None:
        self._start = start
        self._rows = rows

    def at(self, time: float, *state: State) -> Vector3:
        """See `TorqueProfile`."""
        x = time - self._start
        first, second, third = ZERO
        for a, b, c in self._rows:  # Horner's scheme
            first = first * x + a
            second = second * x + b
            third = third * x + c
        return first, second, third

    def values(self, t: Array) -> Array:
        """See `TorqueProfile`."""
        return np.array([self.at(time) for time in t.tolist()]).reshape(-1, 3)


class FunctionTorque(TorqueProfile):
    """A function f(t), or f(t, state), of time and `State` -> three torques.

    The time is in s, the torques are in N m. `feedback` says whether the state is an
    argument. InputError: it needs other arguments.
    """

    is_known_ahead = False

    def __init__(self, function: Callable[..., Sequence[float]]) -> None:
        self._function = function
        self.feedback = count_arguments(function) == 2

    def at(self, time: float, *state: State) -> Vector3:
        """See `TorqueProfile`."""
        value = self._function(time, *state)
        vector = finite_vector(value)
        if vector is None:
            allowed = (
                "must be three finite numbers: a function must return three torques"
            )
            raise refusal("torque", f"torque({time:g})", value, f"{allowed} [N m]")
        return vector

    __call__ = at

    def at_times(self, times: Sequence[float]) -> list[Vector3]:
        """See `TorqueProfile`; the values are checked together."""
        values: list[Any] = [self._function(time) for time in times]
        if _are_plain_vectors(values):
            return values
        return super().at_times(times)

    def values(self, t: Array) -> Array:
        """See `TorqueProfile`."""
        if self.feedback:
            return super().values(t)
        return np.array(self.at_times(t.tolist())).reshape(-1, 3)

    def record(self) -> dict[str, Any]:
        """Return the kind alone: a function is in no file."""
        return {"kind": self.kind}


def _are_plain_vectors(values: Sequence[Any]) -> bool:
    """Return whether all values are tuples of three finite floats."""
    if set(map(type, values)) != {tuple} or set(map(len, values)) != {3}:
        return False
    numbers = list(chain.from_iterable(values))
    return set(map(type, numbers)) == {float} and math.isfinite(sum(numbers))


def _three_numbers(value: Any, name: str) -> Vector3:
    """Return three finite numbers as floats, or refuse them."""
    vector = finite_vector(value)
    if vector is not None:
        return vector
    requirement = (
        "must be three finite numbers [N m], a profile, or a function f(t) or f(t,"
        " state)"
    )
    raise refusal("simulate", name, value, requirement)


def count_arguments(function: Callable[..., Any]) -> int:
    """Return how many arguments a function must be given, 1 or 2, or refuse it."""
    refused = refusal(
        "simulate",
        "torque",
        function,
        "must be a function f(t) or f(t, state), in this order",
    )
    if isinstance(function, type):
        raise refused
    try:
        signature = inspect.signature(function)
    except (TypeError, ValueError):
        return 1
    for count in (1, 2):
        with contextlib.suppress(TypeError):
            signature.bind(*range(count))
            names = [*signature.parameters][:count]
            state_first = names[0] == "state"
            time_last = count == 2 and names[-1] in ("t", "time")
            if state_first or time_last:
                raise refused
            return count
    raise refused


_TORQUE_COLUMNS = ("time", "tau_1", "tau_2", "tau_3")


def _read_numbers(row: Sequence[str], places: Sequence[int]) -> list[float] | None:
    """Return the numbers in some places of a row of text.

    None where one is no finite number.

    Numbers are written as in scenes: Python would also take 1_0, nan and other digits.
    """
    texts = [row[place].strip() for place in places]
    if not all(map(NUMBER.fullmatch, texts)):
        return None
    numbers = [float(text) for text in texts]
    return numbers if all(map(math.isfinite, numbers)) else None


def open_table(path: Path) -> TextIO:
    """Open a CSV file; raises OSError for a pipe or a device, which may never end."""
    check_regular(path)
    # Spreadsheets begin a file with a byte order mark.
    return path.open(newline="", encoding="utf-8-sig")


def _read_rows(
    origin: str, header: list[str], lines: list[tuple[int, list[str]]]
) -> tuple[Array, Array]:
    """Return times [s], shape (n,), and torques [N m], shape (n, 3), of a table's rows.

    `lines` are the rows with the number of their line; blank ones at the end are left
    out. InputError lists every bad row.
    """
    while lines and not any(map(str.strip, lines[-1][1])):
        lines.pop()
    problems = []
    if not lines:
        problems.append(Problem("rows", 0, "must be one or more"))
    places = [header.index(column) for column in _TORQUE_COLUMNS]
    times = [-math.inf]  # before the first row; left out of the result
    torques = []
    for line, row in lines:
        numbers = None
        if len(row) == len(header):
            numbers = _read_numbers(row, places)
        if numbers is None:
            requirement = "must be four finite numbers"
            problems.append(Problem("row", row, requirement, line))
            continue
        time, *torque = numbers
        if time <= times[-1]:
            requirement = f"must be > {times[-1]:g} s, the last"
            problems.append(Problem("time", time, requirement, line))
            continue
        times.append(time)
        torques.append(torque)
    if problems:
        raise InputError(origin, problems)
    return np.array(times[1:]), np.array(torques)


class TorqueTable(TorqueProfile):
    """Held torques [N m], shape (n, 3): each row acts from its time until the next.

    They are zero before the first; times [s], shape (n,), are strictly ascending.
    InputError is raised where shapes, order or numbers are not allowed.
    """

    kind = "table"

    @check_kinds
    def __init__(self, times: TimesLike, torques: ArrayLike) -> None:
        self.times = freeze(read_numbers("torque table", "times", times, seconds=True))
        self.torques = freeze(read_numbers("torque table", "torques", torques))
        ascending = self.times.size > 0 and ascend(self.times)
        size = self.torques.shape
        shape = (self.times.size, 3)
        finite = bool(np.all(np.isfinite(self.torques)))
        order = "must be finite, ascending times [s], shape (n,)"
        refuse_unless(
            "torque table",
            ("times", times, ascending, order),
            ("torques", size, size == shape, f"must have the shape {shape} [N m]"),
            ("torques", "not finite", finite, "must be finite numbers [N m]"),
        )

    @classmethod
    @check_kinds
    def read(cls, path: str | Path) -> TorqueTable:
        """Read a CSV file with columns time, tau_1, tau_2 and tau_3 [s, N m].

        The columns may be in any order; columns of other names are skipped. InputError
        says why the file cannot be read, or lists every bad row with its line.
        """
        origin = str(path)
        reading_errors = (OSError, UnicodeDecodeError, csv.Error)
        with (
            refuse_errors(origin, "csv", origin, "must be readable", *reading_errors),
            open_table(Path(path)) as file,
        ):
            reader = csv.reader(file)
            header = [name.strip() for name in next(reader, [])]
            lines = [(reader.line_num, row) for row in reader]
        if any(header.count(column) != 1 for column in _TORQUE_COLUMNS):
            requirement = "must be " + ", ".join(_TORQUE_COLUMNS)
            raise InputError(
                origin, [Problem("header", header or None, requirement, 1)]
            )
        times, torques = _read_rows(origin, header, lines)
        return cls(times, torques)

    __call__ = TorqueProfile.at

    def values(self, t: Array) -> Array:
        """See `TorqueProfile`."""
        rows = np.vstack([np.zeros(3), self.torques])
        return np.asarray(rows[np.searchsorted(self.times, t, side="right")])

    def kinks(self, limit: float | None = None, end: float = math.inf) -> Array:
        """See `TorqueProfile`."""
        return self.times

    def piece(self, begin: float, end: float) -> TorqueProfile:
        """See `TorqueProfile`."""
        return ConstantTorque(self.at(0.5 * (begin + end)))


Torque: TypeAlias = Vector3 | TorqueProfile
"""What acts over a period of the integrator: torques that are held, or smooth ones."""

TorqueLike: TypeAlias = Sequence[float] | TorqueProfile | TorqueFunction | None
"""Torques as a user gives them; by default those of the scene."""


def profile_of(torque: Any) -> TorqueProfile:
    """Turn what a user gives into a profile.

    Raises InputError for anything that `simulate` does not allow.
    """
    if isinstance(torque, TorqueProfile):
        return torque
    if hasattr(torque, "c") and hasattr(torque, "x") and callable(torque):
        # scipy.interpolate.PPoly, CubicSpline
        return PolynomialTorque(torque.c, torque.x)
    if callable(torque):
        return FunctionTorque(torque)
    return ConstantTorque(torque)


_KINDS = (ConstantTorque, SineTorque, TorqueTable, PolynomialTorque)
_PROFILE_KINDS: dict[str, Callable[..., TorqueProfile]] = {
    profile.kind: profile for profile in _KINDS
}


def profile_from(record: dict[str, Any]) -> TorqueProfile:
    """Build the profile that `TorqueProfile.record` has described."""
    kind, *numbers = record.values()
    if kind == TorqueProfile.kind:
        return LostTorque()
    if kind == SineTorque.kind:
        return SineTorque(**dict(zip(SineTorque.SPECS, numbers, strict=True)))
    return _PROFILE_KINDS[kind](*numbers)
