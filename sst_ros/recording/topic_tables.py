# SPDX-License-Identifier: Apache-2.0
"""Topics of a run, the numbers in their messages, and the tables that these become.

Columns bear their units. A recording that lacks a topic lacks its columns, and nothing
else.

A recording may hold more than one robot, and topics of others whose names end alike:
`/joint_state_broadcaster/joint_states`, the commands of another controller. The
simulator publishes its scene, so that the name of this topic names its node; its other
topics are named after the node, `joint_states` lies in the namespace of the node, and
so do the controllers that follow a reference.
"""

from __future__ import annotations

from array import array
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache, partial
from operator import attrgetter
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from sst_ros.errors import InputError, Problem, refusal
from sst_ros.recording.bag_reader import (
    CONTROLLER_NODE,
    EVERYBODY,
    NAMESPACE,
    SIMULATOR_NODE,
    Bag,
    Topic,
)
from sst_ros.scene.loads import ACTUATED_JOINTS, JOINTS, MOMENTS
from sst_ros.state import Array, is_idle, nanoseconds

LEG_NUMBERS = (1, 2, 3)
JOINT_KINDS = ("gamma", "mu", "beta")

Integers: TypeAlias = NDArray[np.int64]
Rows: TypeAlias = list[tuple[int, Sequence[float]]]
"""The rows of one message: stamps [ns], 0 for none, and numbers; empty for a message
that is no part of a run."""


ColumnGroup: TypeAlias = tuple[Sequence[str], str, str]
"""Quantities, the unit of all, and what they are."""


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

    @property
    def text(self) -> str:
        """What it is, its unit, its topic."""
        text = f"{self.what} [{self.unit}]"
        return f"{text}, from {self.topic}" if self.topic else text


@dataclass(frozen=True, kw_only=True)
class TopicTable(Topic):
    """A topic, the columns of its rows, and the function that reads a message.

    The function reads the rows of a message. It returns None for a message of another
    robot, and raises InvalidMessage.
    """

    columns: tuple[Column, ...]
    rows: Callable[[Any], Rows | None]


class InvalidMessage(ValueError):
    """A message has numbers or names that cannot be used.

    The text says what was found and what is allowed.
    """


@dataclass(frozen=True)
class Series:
    """Rows of one table: of one topic, or of all topics at the stamps of samples."""

    columns: tuple[Column, ...]  #: what the numbers are
    #: stamps of the messages [ns], shape (n,); 0 where they have none
    stamp_ns: Integers
    #: by the recorder's clock [ns], shape (n,); 0 where it failed
    received_ns: Integers
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
        index = places(self.stamp_ns, stamps_ns)
        has_row = index >= 0
        rows = np.full((len(stamps_ns), len(self.columns)), np.nan)
        rows[has_row] = self.values[index[has_row]]
        return rows


def places(among_ns: Integers, times_ns: Integers) -> Integers:
    """Find where each time stands among ascending ones; -1 where it does not."""
    if not len(among_ns):
        return np.full(len(times_ns), -1)
    index = np.minimum(np.searchsorted(among_ns, times_ns), len(among_ns) - 1)
    return np.where(among_ns[index] == times_ns, index, -1)


def sort_rows(
    table: TopicTable, times: array[int], numbers: array[float], path: Path
) -> Series:
    """Return the rows of a topic in order of time, one at each stamp.

    Their times are pairs of stamp and reception [ns]; their numbers follow each other,
    too. Raises InputError where one recording, at this path, has two rows at a stamp.
    """
    columns = table.columns
    pairs = np.frombuffer(times, dtype=np.int64).reshape(-1, 2)
    values = np.frombuffer(numbers, dtype=float).reshape(len(pairs), len(columns))
    stamps, received = pairs.T
    if table in STAMPED:
        order = _order_by_stamp(table, stamps, values, path)
    else:
        order = np.argsort(received, kind="stable")
    if np.array_equal(order, np.arange(len(pairs))):  # most are: the values are large
        stamps = stamps.copy()
        received = received.copy()
    else:
        stamps = stamps[order]
        received = received[order]
        values = values[order]
    if table is TICK_TABLE and np.isnan(values[:, -len(MOMENTS) :]).all():
        columns = columns[: -len(MOMENTS)]  # no moment was recorded
        values = values[:, : -len(MOMENTS)]
    return Series(columns, stamps, received, values)


def _order_by_stamp(
    table: TopicTable, stamps: Integers, values: Array, path: Path
) -> NDArray[np.intp]:
    """Return the rows in order of their stamps, the first one at each.

    Raises InputError where a stamp comes twice. An idle state shows the last sample
    again: topics that say nothing of that may repeat a row.
    """
    distinct, order = np.unique(stamps, return_index=True)
    again = np.delete(np.arange(len(stamps)), order)
    if table in (ORIENTATION_TABLE, EULER):
        first = order[np.searchsorted(distinct, stamps[again])]
        again = again[~(values[again] == values[first]).all(axis=1)]
    if len(again):
        requirement = (
            f"stamp {stamps[again[0]]} ns comes twice; record one simulator a bag"
        )
        raise refusal(path, table.key, len(again), requirement)
    return order


def _read_joints(joints: Sequence[str], message: Any) -> Rows | None:
    """Read positions, velocities and the efforts of actuators of a JointState message.

    What it does not have is nan: drivers leave out velocities, efforts and passive
    joints. A message without any of the joints is none of this robot.
    """
    stamp = nanoseconds(message.header.stamp)
    if is_idle(stamp, message.header.frame_id):
        return []
    names = tuple(message.name)
    index, absent = _find_joints(joints, names)
    if len(absent) == len(joints):
        return None
    quantities = message.position, message.velocity, message.effort
    sizes = {len(quantity) for quantity in quantities}
    if not sizes <= {0, len(names)}:
        requirement = (
            "name, position, velocity and effort must be equally long, or empty"
        )
        missing = f"; joints are missing: {', '.join(absent)}" if absent else ""
        raise InvalidMessage(sorted({len(names), *sizes}), requirement + missing)
    if not absent and 0 not in sizes:  # nearly all messages: fast
        rows = [quantity[index].tolist() for quantity in quantities]
    else:
        rows = [_take_known(quantity, index) for quantity in quantities]
    position, velocity, effort = rows
    return [(stamp, position + velocity + effort[: len(ACTUATED_JOINTS)])]


def _take_known(numbers: Sequence[float], index: Sequence[int]) -> list[float]:
    """Take numbers by their places; nan for what is not there, of the place -1."""
    return [float(numbers[k]) if k >= 0 and len(numbers) else np.nan for k in index]


@lru_cache(maxsize=64)  # all messages of a topic have the same names
def _find_joints(
    requested: Sequence[str], names: Sequence[str]
) -> tuple[list[int], tuple[str, ...]]:
    """Find the place of each joint among the names, and which are absent.

    An absent joint has the place -1.
    """
    index = [names.index(name) if name in names else -1 for name in requested]
    absent = tuple(name for name in requested if name not in names)
    return index, absent


def _parts(vector: str, names: str, *, stamped: bool = True) -> Callable[[Any], Rows]:
    """Return what reads a vector or quaternion of a message, by names of components.

    Where `stamped`, messages without a stamp are no part of a run.
    """
    components = attrgetter(*(f"{vector}.{name}" for name in names))
    return partial(_read_components, components, stamped)


def _read_command(message: Any) -> Rows:
    """Read three torques, which have no stamp."""
    if len(message.data) != len(LEG_NUMBERS):  # the simulator drops it, too
        return []
    return [(0, message.data.tolist())]


def _read_components(
    components: Callable[[Any], Sequence[float]], stamped: bool, message: Any
) -> Rows:
    stamp = nanoseconds(message.header.stamp)
    if stamped and not stamp:
        return []
    return [(stamp, components(message))]


def _read_ticks(message: Any) -> Rows:
    """Read the length of each tick, its torques, and moments or nan.

    The length [ns] is exact in a double.
    """
    start = nanoseconds(message.header.stamp)
    if not start:
        return []
    names = tuple(message.joint_names) or ACTUATED_JOINTS
    index = _places(ACTUATED_JOINTS, names)
    moments = _places(MOMENTS, names) if set(MOMENTS) <= set(names) else []
    rows = Rows()
    end = start
    for point in message.points:
        effort = point.effort.tolist()
        if len(effort) != len(names):
            raise InvalidMessage(
                effort, f"must be a torque for each actuator (stamp {start} ns)"
            )
        begin = end
        end = start + nanoseconds(point.time_from_start)
        if end <= begin:
            requirement = f"ticks must have a length; one at stamp {begin} ns has none"
            raise InvalidMessage(end - begin, requirement)
        torque = [effort[k] for k in index]
        moment = [effort[k] for k in moments] or [np.nan] * len(MOMENTS)
        rows.append((begin, [float(end - begin), *torque, *moment]))
    return rows


def _read_stamped_commands(message: Any) -> Rows:
    """Read three torques by name; the stamp is that of the sample they answer."""
    if sorted(message.name) != sorted(ACTUATED_JOINTS):
        return []
    if len(message.effort) != len(LEG_NUMBERS):
        return []
    index = _places(ACTUATED_JOINTS, tuple(message.name))
    return [(nanoseconds(message.header.stamp), message.effort[index].tolist())]


@lru_cache(maxsize=64)  # all messages of a topic have the same names
def _places(requested: Sequence[str], names: Sequence[str]) -> list[int]:
    """Return the place of each joint among the names of a message.

    Raises InvalidMessage where one is missing.
    """
    absent = [name for name in requested if name not in names]
    if absent:
        raise InvalidMessage(list(names), "joints are missing: " + ", ".join(absent))
    return [names.index(name) for name in requested]


def _legs(name: str) -> list[str]:
    """Return the names of a quantity of the three legs."""
    return [f"{name}_{leg}" for leg in LEG_NUMBERS]


def _table(
    key: str,
    message_type: str,
    rows: Callable[[Any], Rows | None],
    *groups: ColumnGroup,
    owner: str = SIMULATOR_NODE,
) -> TopicTable:
    """Make the table of a topic by its key and owner.

    A group is quantities with their unit and what they are.
    """
    columns: list[Column] = []
    for names, unit, description in groups:
        columns += (Column(name, unit, description, key) for name in names)
    return TopicTable(key, message_type, owner, columns=tuple(columns), rows=rows)


_JOINT_STATE = "sensor_msgs/msg/JointState"
_COMMANDED = (_legs("tau"), "N m", "commanded torque")
_MOMENT_LABEL = "external moment on the star in {B}"


def _angles_and_rates(prefix: str = "", truth: str = "") -> Iterator[ColumnGroup]:
    """Yield the groups of nine angles and nine rates, by kind of joint."""
    for kind in JOINT_KINDS:
        yield _legs(f"{prefix}{kind}"), "rad", f"{truth}joint angle {kind}"
    for kind in JOINT_KINDS:
        yield _legs(f"{prefix}{kind}_dot"), "rad/s", f"{truth}rate of {kind}"


JOINT_STATES = _table(
    "joint_states",
    _JOINT_STATE,
    partial(_read_joints, JOINTS),
    *_angles_and_rates(),
    (_legs("tau"), "N m", "torque of the actuator over the step that ends here"),
    owner=NAMESPACE,
)
TRUE_JOINT_STATES = _table(
    "true_joint_states",
    _JOINT_STATE,
    partial(_read_joints, JOINTS),
    *_angles_and_rates("true_", "true "),
    (_legs("true_tau"), "N m", "torque of the actuator over the step that ends here"),
)
ORIENTATION_TABLE = _table(
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
REFERENCE_TABLE = _table(
    "reference",
    _JOINT_STATE,
    partial(_read_joints, ACTUATED_JOINTS),
    (_legs("gamma_desired"), "rad", "desired angle of the actuator"),
    (_legs("gamma_dot_desired"), "rad/s", "desired rate of the actuator"),
    (_legs("tau_feedforward"), "N m", "torque of the model for the desired motion"),
    owner=CONTROLLER_NODE,
)
TRACKING_ERROR = _table(
    "tracking_error",
    _JOINT_STATE,
    partial(_read_joints, ACTUATED_JOINTS),
    (_legs("gamma_error"), "rad", "desired less measured angle"),
    (_legs("gamma_dot_error"), "rad/s", "desired less measured rate"),
    (_legs("tau_feedback"), "N m", "torque of the feedback"),
    owner=CONTROLLER_NODE,
)
TICK_TABLE = _table(
    "applied_torques",
    "trajectory_msgs/msg/JointTrajectory",
    _read_ticks,
    (("length",), "ns", "length of the tick, which begins at the stamp"),
    (_legs("tau"), "N m", "torque held over the tick"),
    (MOMENTS, "N m", f"{_MOMENT_LABEL} over the tick"),
)
COMMAND_TABLE = _table(
    "commands",
    "std_msgs/msg/Float64MultiArray",
    _read_command,
    _COMMANDED,
)
STAMPED_COMMANDS = _table(
    "commands_stamped", _JOINT_STATE, _read_stamped_commands, _COMMANDED
)
MOMENT_TABLE = _table(
    "external_moment",
    "geometry_msgs/msg/WrenchStamped",
    _parts("wrench.torque", "xyz", stamped=False),
    (MOMENTS, "N m", _MOMENT_LABEL),
)

SCENE_TOPIC = Topic("scene", "std_msgs/msg/String")
DIAGNOSTICS = Topic("diagnostics", "diagnostic_msgs/msg/DiagnosticArray", EVERYBODY)

TABLES: dict[str, tuple[TopicTable, ...]] = {
    "samples": (
        JOINT_STATES,
        TRUE_JOINT_STATES,
        ORIENTATION_TABLE,
        EULER,
        REFERENCE_TABLE,
        TRACKING_ERROR,
    ),
    "ticks": (TICK_TABLE,),
    "commands": (COMMAND_TABLE,),
    "commands_stamped": (STAMPED_COMMANDS,),
    "external_moment": (MOMENT_TABLE,),
}
"""The tables of a run and their topics: samples have a row at each of their stamps."""

# topics whose rows are ordered by stamps, one at each
STAMPED = (*TABLES["samples"], TICK_TABLE)
TOPIC_TABLES = tuple(table for tables in TABLES.values() for table in tables)

TIMES = (
    Column(
        "time",
        "ns",
        "time since the start of the run; of reception where there is no stamp",
    ),
    Column("stamp", "ns", "stamp of the message, 0 for none"),
    Column(
        "received", "ns", "when the recorder got it, by its clock; 0 where it did not"
    ),
)
"""The first columns of every table, whole numbers; all others are doubles."""

PUBLISHED = {
    SCENE_TOPIC.key,
    ORIENTATION_TABLE.key,
    EULER.key,
    TICK_TABLE.key,
    TRUE_JOINT_STATES.key,
}
"""Topics that a simulator publishes under its own name; others publish its commands."""


class RunTopics(NamedTuple):
    """The topics of one run."""

    namespace: str  # of the simulator, "/" for the root
    node: str | None  # full name of the simulator's node; None where no topic shows it
    names: dict[str, str]  # full name of each topic by its key
    others: frozenset[str] = frozenset()  # namespaces of other runs in the recording

    def is_of_another(self, name: str) -> bool:
        """Return whether a topic, or a status, is of another run.

        A status is named after its node.
        """
        return _parent(name.partition(":")[0]) in self.others


def select_topics(
    bag: Bag, heard: Collection[str], namespace: str | None = None
) -> RunTopics:
    """Return the topics of the run in a namespace, by default of the only one.

    `heard` are the topics that have messages of this robot. Raises InputError where
    there is no run in the namespace, or none is given and there are several, or where
    two nodes publish what only one can.
    """
    nodes = _find_simulators(bag.candidates)
    spaces = {_parent(node) for node in nodes} or _find_namespaces(bag.candidates)
    chosen = _choose_namespace(bag, spaces, namespace)
    present = sorted(node for node in nodes if _parent(node) == chosen)
    if len(present) > 1:
        requirement = (
            "are of several simulators in one namespace; record one simulator a bag"
        )
        raise refusal(bag.path, SCENE_TOPIC.key, ", ".join(present), requirement)
    node = present[0] if present else None
    names = dict[str, str]()
    for name, topic in bag.candidates.items():
        if topic.owner == SIMULATOR_NODE:
            is_own = _parent(name) == node
        elif topic.owner == NAMESPACE:
            is_own = name == chosen.rstrip("/") + topic.ending
        else:  # topics of controllers follow
            is_own = topic.owner == EVERYBODY
        if is_own:
            names[topic.key] = name
    alone = len(spaces) == 1
    names |= _find_controllers(bag, heard, chosen, alone)
    return RunTopics(chosen, node, names, frozenset({*spaces} - {chosen}))


def find_absent(
    bag: Bag, requested: Collection[Topic], run: RunTopics
) -> dict[str, Problem]:
    """Return why a requested topic of a run is missing, by its key."""
    absent = {}
    for topic in requested:
        if topic.key in run.names:
            continue
        similar = sorted(name for name in bag.channels if topic.may_be(name))
        if any(name in bag.candidates for name in similar):  # of other runs
            owner = run.node if topic.owner == SIMULATOR_NODE else run.namespace
            listed = ", ".join(similar)
            requirement = (
                f"no such topic is of {owner}, whose scene is recorded; record it"
            )
        else:  # of other types
            listed = ", ".join(f"{name} ({bag.channels[name]})" for name in similar)
            requirement = (
                f"no topic of type {topic.type} ends in {topic.ending}; record it"
            )
        absent[topic.key] = Problem(topic.key, listed or None, requirement)
    return absent


def _choose_namespace(bag: Bag, spaces: Collection[str], namespace: str | None) -> str:
    """Return the namespace that is asked for, or the only one; InputError names all."""
    listed = ", ".join(sorted(spaces))
    if namespace is not None:
        requested = "/" + namespace.strip("/")
        if requested not in spaces:
            requirement = (
                f"must be one in which a run is recorded: {listed or 'there is none'}"
            )
            raise refusal(bag.path, "namespace", namespace, requirement)
        return requested
    if len(spaces) > 1:
        requirement = (
            f"must be one of {listed}: the recording has a run in each (--namespace)"
        )
        raise refusal(bag.path, "namespace", None, requirement)
    return next(iter(spaces), "/")


def _find_simulators(candidates: Mapping[str, Topic]) -> list[str]:
    """Return the full names of the nodes that publish a scene.

    Without one they are the nodes that publish anything else of a simulator, and
    without these the nodes that only receive.
    """
    topics: dict[str, set[str]] = {}
    for name, topic in candidates.items():
        if topic.owner == SIMULATOR_NODE:
            topics.setdefault(_parent(name), set()).add(topic.key)
    publishing: list[str] = []
    with_scene: list[str] = []
    sure: list[str] = []
    for node, keys in topics.items():
        published = keys & PUBLISHED
        if published:
            publishing.append(node)
        if SCENE_TOPIC.key in published:
            with_scene.append(node)
            # Another node may publish a text of the name `scene`, but nothing else of a
            # simulator.
            if len(published) > 1:
                sure.append(node)
    return sure or with_scene or publishing or [*topics]


def _find_namespaces(candidates: Mapping[str, Topic]) -> set[str]:
    """Return namespaces of runs of which no topic of the simulator's node is recorded.

    They are those of joint states, and without these those of controllers.
    """
    of_joints: set[str] = set()
    of_controllers: set[str] = set()
    for name, topic in candidates.items():
        if topic.owner == NAMESPACE:
            of_joints.add(_parent(name))
        elif topic.owner == CONTROLLER_NODE:
            of_controllers.add(_parent(_parent(name)))
    return of_joints or of_controllers


def _find_controllers(
    bag: Bag, heard: Collection[str], namespace: str, alone: bool
) -> dict[str, str]:
    """Find the topics of the controller of a run by their keys.

    They are those of the node that publishes most of them. It is a node in the
    namespace; where the recording has one run `alone`, of any.
    """
    nodes: dict[str, dict[str, str]] = {}
    for name, topic in bag.candidates.items():
        if topic.owner == CONTROLLER_NODE and name in heard:
            nodes.setdefault(_parent(name), {})[topic.key] = name
    in_namespace = {
        node: topics for node, topics in nodes.items() if _parent(node) == namespace
    }
    chosen = in_namespace or (nodes if alone else {})
    most = max(map(len, chosen.values()), default=0)
    best = {node: topics for node, topics in chosen.items() if len(topics) == most}
    if len(best) > 1:
        requirement = (
            "are of several controllers of this robot; record one controller a bag"
        )
        problem = Problem("reference", ", ".join(sorted(best)), requirement)
        raise InputError(str(bag.path), [problem])
    return next(iter(best.values()), {})


def _parent(name: str) -> str:
    """Return the name of the node of a topic, or the namespace of a node."""
    return name.rpartition("/")[0] or "/"
