# SPDX-License-Identifier: Apache-2.0
"""What a bag of a run may hold, topic by topic: the tables and columns that its messages become.

Columns bear their units. A bag that lacks a topic lacks its columns, and nothing else.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from sst_ros.mechanism.geometry import Array
from sst_ros.recording.bag_reader import Topic
from sst_ros.recording.cdr_fields import Columns
from sst_ros.recording.collector import (
    ACTUATED,
    JOINTS,
    KINDS,
    MOMENTS,
    joint_state,
    multi_array,
    trajectory,
)
from sst_ros.recording.time_series import Integers


class Column(NamedTuple):
    """A column: the quantity, its unit, what it is, and the topic it comes from."""

    quantity: str
    unit: str
    what: str
    topic: str = ""

    @property
    def name(self) -> str:
        """Name with the unit, as in "gamma_dot_1_rad_per_s"."""
        if self.unit == "1":
            return self.quantity
        return f"{self.quantity}_{self.unit.replace('/', '_per_').replace(' ', '_')}"


Rows = list[tuple[Integers, Array]]
"""Stamps [ns], 0 for none, shape (n,), and numbers, shape (n, w), of n messages of one layout."""

Fields = Callable[[Columns], Rows]


class Source(NamedTuple):
    """A topic, the columns that it gives, and how its messages are read.

    Where a message lacks joints, or numbers for them, reading it raises a ValueError.
    """

    topic: Topic
    columns: tuple[Column, ...]
    fields: Fields


def _joints(names: Sequence[str], efforts: Sequence[str]) -> Fields:
    def fields(message: Columns) -> Rows:
        stamp, found, parts = joint_state(message)
        wanted = (names, names, efforts)
        columns = [part[:, _places(found, at)] for part, at in zip(parts, wanted, strict=True)]
        return [(stamp, np.hstack(columns))]

    return fields


def _numbers(count: int, before: int = 0) -> Fields:
    """Read so many numbers after others that are passed over."""

    def fields(message: Columns) -> Rows:
        return [(message.stamp(), message.numbers("f8", before + count)[:, before:])]

    return fields


def _ticks(message: Columns) -> Rows:
    """Give the length of each tick beside its torques: exact in a double."""
    found = trajectory(message)
    names = found.names or ACTUATED
    at = [*_places(names, ACTUATED), *(names.index(m) for m in MOMENTS if m in names)]
    start, rows = found.stamp, []
    for effort, after in zip(found.efforts, found.ends, strict=True):
        row = np.full((len(start), 7), np.nan)
        row[:, 1 : 1 + len(at)] = effort[:, at]
        end = found.stamp + after
        row[:, 0] = end - start
        rows.append((start, row))
        start = end
    return rows


def _commands(message: Columns) -> Rows:
    torque = multi_array(message)
    # Others are not used by the simulator either.
    return [(np.zeros(len(torque), np.int64), torque)] if torque.shape[1] == 3 else []


def _places(names: Sequence[str], wanted: Sequence[str]) -> list[int]:
    return [list(names).index(name) for name in wanted]


def _source(
    key: str, ending: str, kind: str, fields: Fields, *parts: tuple[Sequence[str], str, str]
) -> Source:
    columns = [Column(name, unit, what, key) for names, unit, what in parts for name in names]
    return Source(Topic(key, ending, kind, False), tuple(columns), fields)


def _legs(name: str) -> list[str]:
    return [f"{name}_{leg}" for leg in (1, 2, 3)]


JOINT_STATE = "sensor_msgs/msg/JointState"

SAMPLES = (
    _source(
        "joint_states", "/joint_states", JOINT_STATE, _joints(JOINTS, ACTUATED),
        *((_legs(kind), "rad", f"joint angle {kind}") for kind in KINDS),
        *((_legs(f"{kind}_dot"), "rad/s", f"rate of {kind}") for kind in KINDS),
        (_legs("tau"), "N m", "torque of the actuator over the step that ends here"),
    ),
    _source(
        "orientation", "/orientation", "geometry_msgs/msg/QuaternionStamped", _numbers(4),
        (("q_x", "q_y", "q_z", "q_w"), "1", "quaternion of {E} in {B}"),
    ),
    _source(
        "euler_zyz", "/euler_zyz", "geometry_msgs/msg/Vector3Stamped", _numbers(3),
        (("theta", "phi", "psi"), "rad", "ZYZ angle of {E} in {B}"),
    ),
    _source(
        "reference", "/reference", JOINT_STATE, _joints(ACTUATED, ACTUATED),
        (_legs("gamma_desired"), "rad", "desired angle of the actuator"),
        (_legs("gamma_dot_desired"), "rad/s", "desired rate of the actuator"),
        (_legs("tau_feedforward"), "N m", "torque of the model for the desired motion"),
    ),
    _source(
        "tracking_error", "/tracking_error", JOINT_STATE, _joints(ACTUATED, ACTUATED),
        (_legs("gamma_error"), "rad", "desired less measured angle"),
        (_legs("gamma_dot_error"), "rad/s", "desired less measured rate"),
        (_legs("tau_feedback"), "N m", "torque of the feedback"),
    ),
)  # fmt: skip
"""Topics with one row at a sample's stamp."""

TICKS = _source(
    "applied_torques", "/applied_torques", "trajectory_msgs/msg/JointTrajectory", _ticks,
    (("length",), "ns", "length of the tick, which begins at the stamp"),
    (_legs("tau"), "N m", "torque held over the tick"),
    (MOMENTS, "N m", "external moment on the star in {B} over the tick"),
)  # fmt: skip
COMMANDS = _source(
    "commands", "/commands", "std_msgs/msg/Float64MultiArray", _commands,
    (_legs("tau"), "N m", "commanded torque"),
)  # fmt: skip
STAMPED = _source(
    "commands_stamped", "/commands_stamped", JOINT_STATE, _joints((), ACTUATED),
    (_legs("tau"), "N m", "commanded torque"),
)  # fmt: skip
MOMENT = _source(
    "external_moment", "/external_moment", "geometry_msgs/msg/WrenchStamped", _numbers(3, 3),
    (MOMENTS, "N m", "external moment on the star in {B}"),
)  # fmt: skip

SOURCES = (*SAMPLES, TICKS, COMMANDS, STAMPED, MOMENT)
SCENE = Topic("scene", "/scene", "std_msgs/msg/String", False)

TABLES: dict[str, tuple[Source, ...]] = {
    "samples": SAMPLES,
    "ticks": (TICKS,),
    "commands": (COMMANDS,),
    "commands_stamped": (STAMPED,),
    "external_moment": (MOMENT,),
}
"""The tables of a run, and the topics in each."""

TIMES = (
    Column("time", "ns", "time since the start of the run; of reception where there is no stamp"),
    Column("stamp", "ns", "stamp of the message, 0 for none"),
    Column("received", "ns", "when the recorder got it, by its clock; 0 where it did not"),
)
"""The first columns of every table, whole numbers; all others are doubles."""
