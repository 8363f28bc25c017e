# SPDX-License-Identifier: Apache-2.0
"""Topics of a run, the numbers in their messages, and the tables that these become.

Columns bear their units. A recording that lacks a topic lacks its columns, and nothing else.
"""

from __future__ import annotations

from array import array
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache, partial
from operator import attrgetter
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from sst_ros.errors import refusal
from sst_ros.recording.bag_reader import Topic
from sst_ros.scene.loads import JOINTS, MOMENTS
from sst_ros.state import Array, is_idle, nanoseconds

ACTUATED = JOINTS[:3]

Integers: TypeAlias = NDArray[np.int64]
Rows: TypeAlias = list[tuple[int, Sequence[float]]]
"""Stamps [ns], 0 for none, and the numbers of one message; none for what is no part of a run."""


class Column(NamedTuple):
    """A column: the quantity, its unit, what it is, and the topic it comes from."""

    quantity: str
    unit: str
    what: str
    topic: str = ""

    @property
    def name(self) -> str:
        """Name with the unit, as in "gamma_dot_1_rad_per_s"."""
        unit = f"_{self.unit.replace('/', '_per_').replace(' ', '_')}"
        return self.quantity + unit * (self.unit != "1")

    @property
    def text(self) -> str:
        """What it is, its unit, its topic."""
        return f"{self.what} [{self.unit}]" + (f", from {self.topic}" if self.topic else "")


@dataclass(frozen=True, kw_only=True)
class TopicTable(Topic):
    """A topic, the columns of its rows, and the function that reads the rows of a message.

    The function raises InvalidMessage.
    """

    columns: tuple[Column, ...]
    rows: Callable[[Any], Rows]


class InvalidMessage(ValueError):
    """A message has numbers or names that cannot be used: what was found, what is allowed."""


@dataclass(frozen=True)
class Series:
    """Rows of one table: of one topic, or of all topics at the stamps of samples."""

    columns: tuple[Column, ...]  #: what the numbers are
    stamp_ns: Integers  #: stamps of the messages [ns], shape (n,); 0 where they have none
    received_ns: Integers  #: by the recorder's clock [ns], shape (n,); 0 where it failed
    values: Array  #: shape (n, number of columns); nan where a message was lost

    def __len__(self) -> int:
        return len(self.stamp_ns)

    def take(self, *names: str) -> Array:
        """Columns of quantities, as in "gamma_1", shape (n, number of names)."""
        quantities = [column.quantity for column in self.columns]
        return np.asarray(self.values[:, list(map(quantities.index, names))])

    @property
    def torque(self) -> Array:
        """Torques [N m] of a table that has some, shape (n, 3)."""
        return self.take("tau_1", "tau_2", "tau_3")

    def at(self, stamps_ns: Integers) -> Array:
        """Rows at these stamps, shape (m, columns); nan where there is none."""
        there = places(self.stamp_ns, stamps_ns)
        found = np.full((len(stamps_ns), self.values.shape[1]), np.nan)
        found[there >= 0] = self.values[there[there >= 0]]
        return found


def places(among_ns: Integers, times_ns: Integers) -> Integers:
    """Find where each time stands among ascending ones; -1 where it does not."""
    if not len(among_ns):
        return np.full(len(times_ns), -1)
    at = np.minimum(np.searchsorted(among_ns, times_ns), len(among_ns) - 1)
    return np.where(among_ns[at] == times_ns, at, -1)


def sort_rows(table: TopicTable, times: array[int], numbers: array[float], path: Path) -> Series:
    """Return the rows of a topic in order of time, one at each stamp.

    Their times are pairs of stamp and reception [ns]; their numbers follow each other, too. Raises
    InputError where one recording, at this path, has two rows at a stamp.
    """
    columns, at = table.columns, np.frombuffer(times, dtype=np.int64).reshape(-1, 2)
    values = np.frombuffer(numbers, dtype=float).reshape(len(at), len(columns))
    order = np.argsort(at[:, 1], kind="stable")
    if table in STAMPED:
        stamps, order = np.unique(at[:, 0], return_index=True)
        again = np.delete(np.arange(len(at)), order)
        if table in (ORIENTATION, EULER):  # an idle state shows the last sample again
            first = order[np.searchsorted(stamps, at[again, 0])]
            again = again[~(values[again] == values[first]).all(axis=1)]
        if len(again):
            allowed = f"stamp {at[again[0], 0]} ns comes twice; record one simulator a bag"
            raise refusal(path, table.key, len(again), allowed)
    if not np.array_equal(order, np.arange(len(at))):  # most need no copy
        at, values = at[order], values[order]
    if table is TICKS and np.isnan(values[:, -3:]).all():
        columns, values = columns[:-3], values[:, :-3]  # no moment was recorded
    stamps, received = at.T.copy()
    return Series(columns, stamps, received, values)


def _read_joints(joints: Sequence[str], message: Any) -> Rows:
    """Read positions, velocities and the efforts of actuators of a JointState message."""
    stamp = nanoseconds(message.header.stamp)
    if is_idle(stamp, message.header.frame_id):
        return []
    at = _places(joints, tuple(message.name))
    parts = message.position, message.velocity, message.effort
    sizes = {len(message.name), *map(len, parts)}
    if len(sizes) > 1:
        allowed = "name, position, velocity and effort must be equally long"
        raise InvalidMessage(sorted(sizes), allowed)
    position, velocity, effort = (part[at].tolist() for part in parts)
    return [(stamp, position + velocity + effort[: len(ACTUATED)])]


def _parts(vector: str, names: str, *, stamped: bool = True) -> Callable[[Any], Rows]:
    """Read the parts of a vector or quaternion; where `stamped`, of messages with a stamp only."""
    parts = attrgetter(*(f"{vector}.{name}" for name in names))
    return partial(_read_parts, parts, stamped)


def _read_command(message: Any) -> Rows:
    """Read three torques, which have no stamp."""
    return [(0, message.data.tolist())] if len(message.data) == 3 else []


def _read_parts(parts: Callable[[Any], Sequence[float]], stamped: bool, message: Any) -> Rows:
    stamp = nanoseconds(message.header.stamp)
    return [(stamp, parts(message))] if stamp or not stamped else []


def _read_ticks(message: Any) -> Rows:
    """Read the length of each tick [ns], exact in a double, its torques, and moments or nan."""
    start = nanoseconds(message.header.stamp)
    if not start:
        return []
    names = tuple(message.joint_names) or ACTUATED
    at = _places(ACTUATED, names)
    moments = _places(MOMENTS, names) if set(MOMENTS) <= set(names) else []
    rows, end = Rows(), start
    for point in message.points:
        effort = point.effort.tolist()
        if len(effort) != len(names):
            raise InvalidMessage(effort, f"must be a torque for each actuator (stamp {start} ns)")
        begin, end = end, start + nanoseconds(point.time_from_start)
        if end <= begin:
            allowed = f"ticks must have a length; one at stamp {begin} ns has none"
            raise InvalidMessage(end - begin, allowed)
        moment = [effort[k] for k in moments] or [np.nan] * 3
        rows.append((begin, [float(end - begin), *(effort[k] for k in at), *moment]))
    return rows


def _read_stamped_commands(message: Any) -> Rows:
    if sorted(message.name) != sorted(ACTUATED) or len(message.effort) != 3:
        return []
    at = _places(ACTUATED, tuple(message.name))
    return [(nanoseconds(message.header.stamp), message.effort[at].tolist())]


@lru_cache(maxsize=64)  # all messages of a topic have the same names
def _places(requested: Sequence[str], names: Sequence[str]) -> list[int]:
    if absent := [name for name in requested if name not in names]:
        raise InvalidMessage(list(names), "joints are missing: " + ", ".join(absent))
    return [names.index(name) for name in requested]


def _legs(name: str) -> list[str]:
    return [f"{name}_{leg}" for leg in (1, 2, 3)]


def _table(
    key: str, message_type: str, rows: Callable[[Any], Rows], *parts: tuple[Sequence[str], str, str]
) -> TopicTable:
    """Make the table of the topic that ends in its key; a part is columns, their unit and what."""
    columns = [Column(name, unit, what, key) for names, unit, what in parts for name in names]
    return TopicTable(key, message_type, columns=tuple(columns), rows=rows)


_JOINT_STATE = "sensor_msgs/msg/JointState"
_COMMANDED = (_legs("tau"), "N m", "commanded torque")
_MOMENT = "external moment on the star in {B}"

JOINT_STATES = _table(
    "joint_states",
    _JOINT_STATE,
    partial(_read_joints, JOINTS),
    *((_legs(kind), "rad", f"joint angle {kind}") for kind in ("gamma", "mu", "beta")),
    *((_legs(f"{kind}_dot"), "rad/s", f"rate of {kind}") for kind in ("gamma", "mu", "beta")),
    (_legs("tau"), "N m", "torque of the actuator over the step that ends here"),
)
ORIENTATION = _table(
    "orientation",
    "geometry_msgs/msg/QuaternionStamped",
    _parts("quaternion", "xyzw"),
    (("q_x", "q_y", "q_z", "q_w"), "1", "quaternion of {E} in {B}"),
)
EULER = _table(
    "euler_zyz",
    "geometry_msgs/msg/Vector3Stamped",
    _parts("vector", "xyz"),
    (("theta", "phi", "psi"), "rad", "ZYZ angle of {E} in {B}"),
)
REFERENCE = _table(
    "reference",
    _JOINT_STATE,
    partial(_read_joints, ACTUATED),
    (_legs("gamma_desired"), "rad", "desired angle of the actuator"),
    (_legs("gamma_dot_desired"), "rad/s", "desired rate of the actuator"),
    (_legs("tau_feedforward"), "N m", "torque of the model for the desired motion"),
)
TRACKING_ERROR = _table(
    "tracking_error",
    _JOINT_STATE,
    partial(_read_joints, ACTUATED),
    (_legs("gamma_error"), "rad", "desired less measured angle"),
    (_legs("gamma_dot_error"), "rad/s", "desired less measured rate"),
    (_legs("tau_feedback"), "N m", "torque of the feedback"),
)
TICKS = _table(
    "applied_torques",
    "trajectory_msgs/msg/JointTrajectory",
    _read_ticks,
    (("length",), "ns", "length of the tick, which begins at the stamp"),
    (_legs("tau"), "N m", "torque held over the tick"),
    (MOMENTS, "N m", f"{_MOMENT} over the tick"),
)
COMMANDS = _table(
    "commands",
    "std_msgs/msg/Float64MultiArray",
    # Others are dropped by the simulator too.
    _read_command,
    _COMMANDED,
)
STAMPED_COMMANDS = _table("commands_stamped", _JOINT_STATE, _read_stamped_commands, _COMMANDED)
MOMENT = _table(
    "external_moment",
    "geometry_msgs/msg/WrenchStamped",
    _parts("wrench.torque", "xyz", stamped=False),
    (MOMENTS, "N m", _MOMENT),
)

SCENE = Topic("scene", "std_msgs/msg/String")
DIAGNOSTICS = Topic("diagnostics", "diagnostic_msgs/msg/DiagnosticArray", anywhere=False)

TABLES: dict[str, tuple[TopicTable, ...]] = {
    "samples": (JOINT_STATES, ORIENTATION, EULER, REFERENCE, TRACKING_ERROR),
    "ticks": (TICKS,),
    "commands": (COMMANDS,),
    "commands_stamped": (STAMPED_COMMANDS,),
    "external_moment": (MOMENT,),
}
"""The tables of a run, and the topics in each: samples have a row at each stamp of their topics."""

STAMPED = (*TABLES["samples"], TICKS)  # topics whose rows are ordered by stamps, one at each
TOPIC_TABLES = tuple(table for tables in TABLES.values() for table in tables)

TIMES = (
    Column("time", "ns", "time since the start of the run; of reception where there is no stamp"),
    Column("stamp", "ns", "stamp of the message, 0 for none"),
    Column("received", "ns", "when the recorder got it, by its clock; 0 where it did not"),
)
"""The first columns of every table, whole numbers; all others are doubles."""
