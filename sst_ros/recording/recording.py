# SPDX-License-Identifier: Apache-2.0
"""What a recording holds of a run: all its topics as tables, and a whole run as arrays.

Numbers have the bits of the recording. `read_signals` reads any recording in which some
topic of a run is found; what it lacks is left out and named. `read` makes a `Recording`
of it, which refuses what is not a whole run.
"""

from __future__ import annotations

import contextlib
from array import array
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sst_ros.dynamics import kernel
from sst_ros.dynamics.model import model_of
from sst_ros.dynamics.motion_table import JOINT_QUANTITIES
from sst_ros.errors import InputError, Problem, refusal, require
from sst_ros.files import require_free, write_into
from sst_ros.mechanism.geometry import Array, Geometry
from sst_ros.mechanism.rates import body_rates
from sst_ros.recording import topic_tables as topics
from sst_ros.recording.bag_reader import Bag, Received
from sst_ros.recording.topic_tables import (
    Integers,
    Series,
    TopicTable,
    find_absent,
    places,
    select_topics,
)
from sst_ros.scene import yaml_document
from sst_ros.scene.scene import Scene
from sst_ros.scene.torque_profile import TorqueTable
from sst_ros.simulation.tables import write_table
from sst_ros.simulation.trajectory import RunRecord, Trajectory
from sst_ros.state import (
    NANOSECONDS,
    Explained,
    Joints,
    ReadOnly,
    cached_property,
    freeze,
)

if TYPE_CHECKING:
    import pandas as pd

ESSENTIAL = (
    topics.JOINT_STATES,
    topics.ORIENTATION_TABLE,
    topics.TICK_TABLE,
    topics.SCENE_TOPIC,
)
"""Topics without which a recording is not that of a run."""
OPTIONAL = (topics.EULER, topics.DIAGNOSTICS, topics.COMMAND_TABLE)
MEASURED_APART = 1e-9
"""Angle [rad] by which joint_states are off the orientation where they are not the
motion itself: those of a simulator agree to rounding.
"""
LEAST_GAP = 10.0  # usual periods without a row over which no picture draws a line
MEASURED_SHARE = 0.1  # of the samples that must be, as single ones are faults
LEAST_SAMPLES = 2  # of a run, which has a duration
LENGTH_ROUNDING = 1e-6  # of quaternions, whose length is 1
JOINT_GROUPS = 7  # of three columns of joint states: angles and rates by kind, efforts


class RecordedStatus(NamedTuple):
    """One diagnostic status: when it was received [ns], its name, its values by key."""

    received_ns: int
    name: str
    values: dict[str, str]


@dataclass(frozen=True, repr=False)
class Signals:
    """All that a recording holds of a run, as tables."""

    bag: Bag  #: the recording: its path, topics, damage
    scene: Scene | None  #: what was simulated; None where it was not recorded
    start_ns: int  #: stamp of the start of the run [ns]
    #: rows of each topic, none if not recorded, by its key
    topic_series: dict[str, Series]
    idle_states: int  #: number of joint states that are no samples of the run
    foreign_states: int  #: number of joint states of other robots on the same topic
    statuses: tuple[RecordedStatus, ...]  #: diagnostics, in order of reception
    absent: dict[str, Problem]  #: why a topic of the run is missing, by its key
    namespace: str = "/"  #: of the simulator

    @cached_property
    def tables(self) -> dict[str, Series]:
        """Rows by the names of `TABLES`; only what was recorded.

        Topics of one table stand side by side at all stamps that any of them has.
        """
        by_name = {}
        for name, listed in topics.TABLES.items():
            series_of_table = [self.topic_series[table.key] for table in listed]
            recorded = [series for series in series_of_table if len(series)]
            if recorded:
                by_name[name] = _join(recorded)
        return by_name

    @cached_property
    def missing(self) -> tuple[str, ...]:
        """Keys of the topics that are not in the recording.

        Those without a row of the run are among them.
        """
        missing = [key for key, series in self.topic_series.items() if not len(series)]
        if self.scene is None:
            missing.append(topics.SCENE_TOPIC.key)
        return tuple(missing)

    def statuses_of(self, part: str, key: str) -> list[RecordedStatus]:
        """Diagnostics of a part of the node that publishes a topic.

        Other nodes send theirs, too. All of that part are returned where none has the
        name of the node, as in a bag that was played under another name and recorded
        again.
        """
        node, _, _ = self.bag.topics.get(key, "").rpartition("/")
        suffix = f": {part}"
        statuses = [status for status in self.statuses if status.name.endswith(suffix)]
        own = [status for status in statuses if status.name == node + suffix]
        return own or statuses

    def time_ns(self, table: str) -> Integers:
        """Time of each row since the start of the run [ns].

        Rows without a stamp have that of their reception by the recorder.
        """
        series = self.tables[table]
        stamps = np.where(series.stamp_ns > 0, series.stamp_ns, series.received_ns)
        return np.asarray(stamps - self.start_ns)

    def seconds(self, table: str = "samples") -> Array:
        """Time of each row since the start of the run [s]."""
        return np.asarray(self.time_ns(table) / NANOSECONDS)

    def gaps(self, table: str = "samples") -> Array:
        """Return begin and end of the gaps between rows [s], shape (g, 2).

        A gap is LEAST_GAP usual periods of the rows or longer.
        """
        times_ns = self.time_ns(table)
        spacing = np.diff(times_ns)
        if not len(spacing):
            return np.empty((0, 2))
        starts = np.flatnonzero(spacing > LEAST_GAP * max(_usual(spacing), 1))
        return np.stack([times_ns[starts], times_ns[starts + 1]], axis=1) / NANOSECONDS

    def take(self, *names: str, table: str = "samples") -> Array:
        """Columns of quantities, shape (n, number of names)."""
        return self.tables[table].take(*names)

    def legs(self, name: str, table: str = "samples") -> Array:
        """Columns of the three legs, as in "gamma" or "tau_feedback", shape (n, 3)."""
        names = (f"{name}_{leg}" for leg in topics.LEG_NUMBERS)
        return self.take(*names, table=table)

    def true_legs(self, name: str) -> Array:
        """Return true angles or rates, as `legs`.

        Where none are recorded, return what was measured.
        """
        recorded = len(self.topic_series[topics.TRUE_JOINT_STATES.key])
        return self.legs(f"true_{name}" if recorded else name)

    def table(self, name: str = "samples") -> pd.DataFrame:
        """Return a table as pandas, indexed by `time_ns`; `attrs` describes columns.

        Columns in ns are whole numbers. Raises InputError where the recording has no
        such table.
        """
        if name not in self.tables:
            requirement = "must be one of those in the bag: " + ", ".join(self.tables)
            raise refusal(self.bag.path, "table", name, requirement)
        series = self.tables[name]
        columns = (*topics.TIMES, *series.columns)
        times = (self.time_ns(name), series.stamp_ns, series.received_ns)
        arrays = {}
        for column, values in zip(columns, (*times, *series.values.T), strict=True):
            is_whole = column.unit == "ns"
            arrays[column.name] = values.astype(np.int64) if is_whole else values
        frame: pd.DataFrame = require("pandas").DataFrame(arrays).set_index("time_ns")
        frame.attrs = {column.name: column.text for column in columns}
        return frame


def _join(recorded: list[Series]) -> Series:
    """Put topics side by side at all stamps that any of them has.

    The reception of a row is that of the first topic that has its stamp.
    """
    if len(recorded) == 1:
        return recorded[0]
    stamps = np.unique(np.concatenate([series.stamp_ns for series in recorded]))
    received = np.zeros(len(stamps), dtype=np.int64)
    columns: tuple[topics.Column, ...] = ()
    for series in recorded:
        rows = np.searchsorted(stamps, series.stamp_ns)
        is_known = received[rows] > 0
        received[rows] = np.where(is_known, received[rows], series.received_ns)
        columns += series.columns
    values = np.hstack([series.at(stamps) for series in recorded])
    return Series(columns, stamps, received, values)


@dataclass
class _Heard:
    """Messages of one topic."""

    table: TopicTable | None  # None for scenes and diagnostics
    # Compact: an hour at 500 Hz has 1.8 million rows.
    times: array[int] = field(default_factory=lambda: array("q"))
    numbers: array[float] = field(default_factory=lambda: array("d"))
    scenes: set[str] = field(default_factory=set)
    statuses: list[RecordedStatus] = field(default_factory=list)
    messages: int = 0
    idle: int = 0  # messages that are no samples of a run
    foreign: int = 0  # messages of other robots
    fault: topics.InvalidMessage | None = None  # the first one

    def take(self, message: Received) -> None:
        """Take the numbers or the text of a message."""
        self.messages += 1
        content = message.content
        if message.topic == topics.SCENE_TOPIC:
            self.scenes.add(content.data)
        elif self.table is None:
            for status in content.status:
                texts = {pair.key: pair.value for pair in status.values}
                self.statuses.append(
                    RecordedStatus(message.received_ns, status.name, texts)
                )
        elif self.fault is None:
            self._take_rows(self.table, message)

    def _take_rows(self, table: TopicTable, message: Received) -> None:
        """Take the rows of a message, or note why it has none."""
        try:
            rows = table.rows(message.content)
        except topics.InvalidMessage as error:
            self.fault = error
            return
        if rows is None:
            self.foreign += 1
            return
        self.idle += not rows
        for stamp, values in rows:
            self.times.extend((stamp, message.received_ns))
            self.numbers.extend(values)


def read_signals(
    path: str | Path, *, damaged: bool = False, namespace: str | None = None
) -> Signals:
    """Read a run from a rosbag2 recording, MCAP or sqlite3, in one pass.

    With `damaged`, what is intact of a damaged recording; `Signals.bag.damage` names
    the rest. The `namespace` is that of the simulator, where several runs are recorded.
    Raises InputError where there is no recording, it is damaged, it has nothing of a
    run, or of several runs none is named.
    """
    path = Path(path)
    tables = {table.key: table for table in topics.TOPIC_TABLES}
    requested = [*tables.values(), topics.SCENE_TOPIC, topics.DIAGNOSTICS]
    bag = Bag(path, requested, damaged=damaged)
    heard: dict[str, _Heard] = {}
    for message in bag.messages():
        if message.name not in heard:
            heard[message.name] = _Heard(tables.get(message.topic.key))
        heard[message.name].take(message)
    own = [name for name, topic in heard.items() if topic.messages > topic.foreign]
    run = select_topics(bag, own, namespace)
    bag.select(run.names)
    of_run = {key: heard[name] for key, name in run.names.items() if name in heard}
    for key, topic in of_run.items():
        if topic.fault is not None:
            raise refusal(path, key, *topic.fault.args) from None
        # Other robots publish on joint_states, too; on no other topic of a run.
        if topic.foreign and key != topics.JOINT_STATES.key:
            raise refusal(
                path, key, topic.foreign, "messages have none of the robot's joints"
            )
    nothing = _Heard(None)
    topic_series = {}
    for key, table in tables.items():
        topic = of_run.get(key, nothing)
        topic_series[key] = topics.sort_rows(table, topic.times, topic.numbers, path)
    if not any(map(len, topic_series.values())):
        endings = ", ".join(table.ending for table in tables.values())
        listed = ", ".join(sorted(bag.channels)) or None
        raise refusal(path, "topics", listed, f"must have at least one of {endings}")
    scenes = of_run.get(topics.SCENE_TOPIC.key, nothing).scenes
    if len(scenes) > 1:
        requirement = "the recording must hold one scene"
        raise refusal(path, topics.SCENE_TOPIC.key, len(scenes), requirement)
    origin = f"{path}: {bag.topics.get(topics.SCENE_TOPIC.key)}"
    scene = yaml_document.read(Scene, next(iter(scenes)), origin) if scenes else None
    reported = of_run.get(topics.DIAGNOSTICS.key, nothing).statuses
    statuses = [status for status in reported if not run.is_of_another(status.name)]
    statuses.sort(key=lambda status: status.received_ns)
    joints = of_run.get(topics.JOINT_STATES.key, nothing)
    return Signals(
        bag=bag,
        scene=scene,
        start_ns=_find_start(topic_series),
        topic_series=topic_series,
        idle_states=joints.idle,
        foreign_states=joints.foreign,
        statuses=tuple(statuses),
        absent=find_absent(bag, requested, run),
        namespace=run.namespace,
    )


def _find_start(topic_series: dict[str, Series]) -> int:
    """Return the first stamp of a run [ns], or reception where nothing is stamped."""
    present = {key: series for key, series in topic_series.items() if len(series)}
    stamps = []
    for table in topics.STAMPED:
        if table.key in present:
            stamps.append(int(present[table.key].stamp_ns[0]))
    if stamps:
        return min(stamps)
    return min(int(series.received_ns[0]) for series in present.values())


def _require_scene(signals: Signals) -> Scene:
    """Return the scene of a recording that has the essential topics; else refuse it."""
    absent = signals.absent
    problems = [absent[topic.key] for topic in ESSENTIAL if topic.key in absent]
    if problems:
        raise InputError(str(signals.bag.path), problems)
    if signals.scene is None:
        requirement = "the recording must hold one scene"
        raise refusal(signals.bag.path, topics.SCENE_TOPIC.key, 0, requirement)
    return signals.scene


def _run_reports(signals: Signals) -> tuple[tuple[int, dict[str, str]], ...]:
    """Return receptions [ns] and values of the simulator's reports of its run."""
    reports = []
    for status in signals.statuses_of("run", topics.SCENE_TOPIC.key):
        if "phase" in status.values:
            reports.append((status.received_ns, status.values))
    return tuple(reports)


class JointSamples(NamedTuple):
    """Angles, rates and torques of the joints at n instants of a run."""

    time_ns: Integers  # since the start of the run [ns], shape (n,)
    received_ns: Integers  # by the recorder's clock [ns], shape (n,)
    gamma: Array  # angles [rad], shape (n, 3), of the actuators
    mu: Array  # of the carriages
    beta: Array  # of the star
    gamma_dot: Array  # rates [rad/s], shape (n, 3)
    mu_dot: Array
    beta_dot: Array
    # actuator torques of the tick that ends at the sample [N m], shape (n, 3)
    effort: Array

    @classmethod
    def of(cls, series: Series, start_ns: int) -> JointSamples:
        """Return the joint samples of a topic, in a run that begins at a stamp."""
        quantities = np.split(series.values, JOINT_GROUPS, axis=1)
        return cls(series.stamp_ns - start_ns, series.received_ns, *quantities)


@dataclass(frozen=True)
class Ticks:
    """Applied torques by tick, in order of time; m of them."""

    start_ns: Integers  # relative to the start of the run, shape (m,)
    end_ns: Integers
    torque: Array  # of the actuators, held over the tick [N m], shape (m, 3)
    # external moment on the star in {B} [N m], where recorded
    moment: Array | None = None

    @property
    def period_ns(self) -> int:
        """The usual length of a tick [ns]."""
        return _usual(self.end_ns - self.start_ns)

    @property
    def gaps(self) -> int:
        """How often a tick does not begin where the one before ended."""
        return int(np.count_nonzero(self.start_ns[1:] != self.end_ns[:-1]))

    def known_between(self, times_ns: NDArray[Any]) -> Array:
        """Return for how long [ns] torques are known from each time to the next.

        There are n times [ns], and n - 1 intervals.
        """
        edges = np.stack([self.start_ns, self.end_ns], axis=1).ravel()
        length = self.end_ns - self.start_ns
        steps = np.stack([length, 0 * length], axis=1).ravel()
        known_ns = np.append(0, np.cumsum(steps))[:-1]  # up to each edge
        return np.diff(np.interp(times_ns, edges, known_ns))


class Recording(Explained, ReadOnly):
    """A run from all tables of its bag. Samples are in order of time.

    Rows belong to samples.

    Raises InputError, which names the fault, where they are not those of a whole run.

    Attributes:
        path: where the bag is.
        scene: what was simulated.
        start_ns: stamp of the start of the run [ns]; all other times but `received_ns`
            are relative to it.
        time_ns, received_ns: instant of each sample, and when the recorder got it by
            its own clock [ns], shape (n,).
        measured: the samples of joint_states, as the robot's sensors gave them.
        gamma: joint angles of the actuators [rad], shape (n, 3): the true ones where
            they are recorded (true_joint_states), else those measured; so all that
            follow.
        mu: joint angles of the carriages.
        beta: joint angles of the star.
        gamma_dot: joint rates of the actuators [rad/s], shape (n, 3).
        mu_dot: joint rates of the carriages.
        beta_dot: joint rates of the star.
        effort: actuator torques of the tick that ends at the sample [N m], shape (n,
            3).
        quaternion: orientation of {E} in {B}, (x, y, z, w), shape (n, 4); nan where it
            was lost.
        euler: ZYZ angles (theta, phi, psi) [rad], shape (n, 3); nan where they were
            lost.
        ticks: applied torques.
        idle_states: number of joint states that are no samples, which are not in the
            arrays.
        foreign_states: number of joint states of other robots, which are not either.
        commands: recorded commands of both topics in order of their reception:
            `received_ns` and `stamp_ns`, that of the sample which is answered, 0 where
            commands have none [ns], shape (c,); `torque` [N m], shape (c, 3).
        reports: diagnostics of the simulator's run: when received [ns], text by key.
        diagnostics: the last of them; may be empty.
        missing: keys of the topics that are not in the recording.
        signals: those given.
        table: `Signals.table`, a table as pandas by its name: samples (the default),
            ticks, commands, commands_stamped or external_moment.

    """

    def __init__(self, found: Signals) -> None:
        if not isinstance(found, Signals):
            raise refusal(
                Path(), "found", found, "must be `Signals`, of `read_signals`"
            )
        self.signals = found
        self.path = found.bag.path
        self.table = found.table
        self.scene = _require_scene(found)
        self.idle_states = found.idle_states
        self.foreign_states = found.foreign_states
        self.missing = tuple(
            topic.key for topic in OPTIONAL if topic.key in found.absent
        )
        self.reports = _run_reports(found)
        self.diagnostics: dict[str, str] = {}
        if self.reports:
            _, self.diagnostics = self.reports[-1]
        joints = _finite_rows(found, topics.JOINT_STATES)
        truth = _finite_rows(found, topics.TRUE_JOINT_STATES)
        orientation = _finite_rows(found, topics.ORIENTATION_TABLE)
        euler = _finite_rows(found, topics.EULER)
        ticks = _finite_rows(found, topics.TICK_TABLE)
        self._require_run(joints, ticks)
        has_truth = len(truth) >= LEAST_SAMPLES
        samples = truth if has_truth else joints
        self.start_ns = min(int(samples.stamp_ns[0]), int(ticks.stamp_ns[0]))
        self.measured = JointSamples.of(joints, self.start_ns)
        self._truth: JointSamples | None = None
        if has_truth:
            self._truth = JointSamples.of(truth, self.start_ns)
        # The attributes that are declared below this function.
        vars(self).update((self._truth or self.measured)._asdict())
        self.quaternion = orientation.at(samples.stamp_ns)
        self.euler = euler.at(samples.stamp_ns)
        self._refuse_lengths()
        self.ticks = _read_ticks(self.path, ticks, self.start_ns)
        self.commands = _merge_commands(found)
        self._freeze()

    def _require_run(self, joints: Series, ticks: Series) -> None:
        """Refuse a run without samples or torques."""
        if len(joints) < LEAST_SAMPLES:
            requirement = (
                f"a run has two samples or more ({self.idle_states} lie before its"
                " start)"
            )
            fault = self.diagnostics.get("fault")
            if fault:
                requirement += f"; the simulator reports: {fault}"
            raise refusal(self.path, "joint_states", len(joints), requirement)
        if not len(ticks):
            raise refusal(
                self.path, "applied_torques", 0, "the run has no recorded torque"
            )

    def _refuse_lengths(self) -> None:
        """Refuse quaternions whose length is not 1."""
        with np.errstate(over="ignore"):  # too long is refused just below
            length = np.sqrt(np.einsum("ij,ij->i", self.quaternion, self.quaternion))
        # nan compares False: lost is not wrong
        wrong = length[np.abs(length - 1.0) > LENGTH_ROUNDING]
        if len(wrong):
            requirement = "quaternions must have length 1"
            raise refusal(self.path, "orientation", float(wrong[0]), requirement)

    time_ns: Integers
    received_ns: Integers
    gamma: Array
    mu: Array
    beta: Array
    gamma_dot: Array
    mu_dot: Array
    beta_dot: Array
    effort: Array

    @cached_property
    def motion(self) -> JointSamples | None:
        """The samples of the true motion.

        None where only what was measured of it is recorded.

        That is where joint_states are not those of the recorded orientation: they have
        noise, a delay or the steps of encoders. A few samples that are not are faults
        of the simulator, and are seen as such.
        """
        if self._truth is not None:
            return self._truth
        measured = self.measured
        turns = np.exp(1j * (measured.gamma - self.exact_gamma))
        angles_off = np.abs(np.angle(turns)).max(axis=1)
        # The body rate is the mean of those that the legs give: measured rates with
        # errors of their own are those of no body, and off the rates of this one.
        rates = np.hstack([measured.gamma_dot, measured.mu_dot, measured.beta_dot])
        of_body = self._joints_of_states
        rates_of_body = np.hstack(
            [
                self._columns(of_body.gamma_dot),
                self._columns(of_body.mu_dot),
                self._columns(of_body.beta_dot),
            ]
        )
        size = 1.0 + np.abs(rates).max(axis=1, initial=0.0)
        rates_off = np.abs(rates - rates_of_body).max(axis=1) / size
        off = np.maximum(angles_off, rates_off)
        off = off[np.isfinite(off)]  # where it is known
        apart = len(off) > 0 and np.mean(off > MEASURED_APART) > MEASURED_SHARE
        return None if apart else measured

    @cached_property
    def _joints_of_states(self) -> Joints:
        """Angles and rates of all joints at the recorded states, (n,) for each leg."""
        with np.errstate(all="ignore"):
            return kernel.joints(model_of(self.scene), tuple(self.states.T))

    def _columns(self, of_legs: Sequence[ArrayLike]) -> Array:
        """Return a quantity of the three legs at the samples, shape (n, 3)."""
        rows = [np.broadcast_to(row, self.time_ns.shape) for row in of_legs]
        return np.stack(rows, axis=1)

    @cached_property
    def exact_gamma(self) -> Array:
        """Angles of the actuators in the recorded orientations [rad], (n, 3).

        Nan where lost.
        """
        return freeze(self._columns(self._joints_of_states.gamma))

    @cached_property
    def measured_error(self) -> Array:
        """How far measured angles are from the true ones [rad], shape (m, 3), by leg.

        The true ones are those recorded, else those of the orientation; nan where
        neither is.
        """
        truth = self.exact_gamma if self._truth is None else self._truth.gamma
        index = places(self.time_ns, self.measured.time_ns)
        turns = np.exp(1j * (self.measured.gamma - truth[index]))
        return freeze(np.where((index >= 0)[:, None], np.abs(np.angle(turns)), np.nan))

    @property
    def period_ns(self) -> int:
        """The usual time between two samples [ns]; the last one may come early."""
        spacing = np.diff(self.time_ns)
        return _usual(spacing[:-1] if len(spacing) > 1 else spacing)

    @cached_property
    def effort_difference(self) -> Array:
        """Largest difference of a sample's effort and the torque of its tick.

        The tick is the one that ends at the sample. [N m], shape (n,); nan where that
        tick is not recorded. Where actuators lag it is the lag.
        """
        index = places(self.ticks.end_ns, self.time_ns)
        largest = np.abs(self.effort - self.ticks.torque[index]).max(axis=1)
        return freeze(np.where(index >= 0, largest, np.nan))

    def _facts(self) -> dict[str, object]:
        ticks = self.ticks
        reported = self.diagnostics
        return {
            "path": self.path,
            "scene": self.scene.name,
            "samples": (
                f"{len(self.time_ns)}, one in {self.period_ns / NANOSECONDS:g} s"
            ),
            "time [s]": (self.seconds[0], self.seconds[-1]),
            "ticks": (
                f"{len(ticks.end_ns)} of {ticks.period_ns / NANOSECONDS:g} s; "
                f"{ticks.gaps} gaps"
            ),
            "commands": len(self.commands),
            "ended": reported.get("fault") or reported.get("phase") or "not reported",
            "missing": self.missing or "nothing",
            "damage": self.signals.bag.damage or "none",
        }

    @property
    def seconds(self) -> Array:
        """Time of each sample since the start of the run [s], shape (n,)."""
        return np.asarray(self.time_ns / NANOSECONDS)

    @cached_property
    def states(self) -> Array:
        """Quaternion, body rate and torques that lag at each sample.

        The shape is (n, 7 or 10). Torques that lag are the efforts; nan where the
        orientation was lost.
        """
        lagged = [self.effort] if self.scene.lags else []
        return freeze(np.hstack([self.quaternion, self._body_rate, *lagged]))

    @cached_property
    def _body_rate(self) -> Array:
        """Angular velocity of the star in {E} by all rates [rad/s], shape (n, 3)."""
        rates = self.gamma_dot, self.mu_dot, self.beta_dot
        return body_rates(Geometry.of(self.scene), self.quaternion, *rates)

    @cached_property
    def trajectory(self) -> Trajectory:
        """The run as a `Trajectory`; samples whose orientation was lost are left out.

        Between samples `Trajectory.at` integrates under the recorded torques; where
        samples and torques are lost there is a gap. Its error estimate, method and
        message are those that the simulator reported.
        """
        has_orientation = np.isfinite(self.quaternion).all(axis=1)
        ticks = self.ticks
        joints = np.hstack([getattr(self, name) for name in JOINT_QUANTITIES])
        reported = self.diagnostics
        error_estimate = np.nan
        with contextlib.suppress(ValueError):
            error_estimate = float(reported.get("error_estimate", "nan"))
        fault = reported.get("fault", "")
        gaps = self._find_gaps(self.time_ns[has_orientation])
        lost = ticks.end_ns[:-1][ticks.start_ns[1:] != ticks.end_ns[:-1]]
        in_gaps = True
        for lost_ns in lost.tolist():
            in_gaps = in_gaps and any(begin <= lost_ns < end for begin, end in gaps)
        law = None
        if in_gaps:  # else torques that are not known would go on
            law = TorqueTable(ticks.start_ns / NANOSECONDS, ticks.torque)
        record = RunRecord(
            status=1 if fault else 0,
            message=fault or reported.get("phase", "recorded"),
            method=reported.get("integrator", ""),
            error_estimate=error_estimate,
            law=law,
        )
        return Trajectory(
            self.scene,
            self.seconds[has_orientation],
            self.quaternion[has_orientation],
            self._body_rate[has_orientation],
            self.effort[has_orientation],
            run=record,
            joints=joints[has_orientation],
            gaps=np.array(gaps) / NANOSECONDS,
        )

    def _find_gaps(self, time_ns: Integers) -> list[tuple[int, int]]:
        """Find the spans [ns] between samples of which torques are lost.

        A span counts also where only some torques are lost. A span of one period is
        none: the torque of its last tick is the effort of its sample.
        """
        begin = time_ns[:-1]
        end = time_ns[1:]
        with_torque_ns = self.ticks.known_between(time_ns)
        longer = end - begin > 1.5 * self.period_ns
        lost = longer & (with_torque_ns < (end - begin) - 0.5)
        return list(zip(begin[lost].tolist(), end[lost].tolist(), strict=True))


# Columns of a tick at which its torques and a moment begin; the length comes first.
_TICK_GROUPS = (1, 4)


def _read_ticks(path: Path, rows: Series, start_ns: int) -> Ticks:
    """Return the ticks of the rows of their topic; refuse some that overlap."""
    length, _, moment = np.split(rows.values, _TICK_GROUPS, axis=1)
    begin_ns = rows.stamp_ns - start_ns
    end_ns = begin_ns + length[:, 0].astype(np.int64)
    overlap = rows.stamp_ns[1:][begin_ns[1:] < end_ns[:-1]]
    if len(overlap):
        requirement = (
            f"ticks overlap at stamp {overlap[0]} ns; record one simulator a bag"
        )
        raise refusal(path, topics.TICK_TABLE.key, int(overlap[0]), requirement)
    has_moment = moment.size > 0 and bool(np.isfinite(moment).all())
    return Ticks(begin_ns, end_ns, rows.torque, moment if has_moment else None)


def _merge_commands(signals: Signals) -> Series:
    """Return the commands of both topics in order of their reception."""
    plain = signals.topic_series[topics.COMMAND_TABLE.key]
    stamped = signals.topic_series[topics.STAMPED_COMMANDS.key]
    received_ns = np.concatenate([plain.received_ns, stamped.received_ns])
    order = np.argsort(received_ns, kind="stable")
    stamp_ns = np.concatenate([plain.stamp_ns, stamped.stamp_ns])
    torques = np.concatenate([plain.values, stamped.values])
    return Series(
        topics.COMMAND_TABLE.columns,
        stamp_ns[order],
        received_ns[order],
        torques[order],
    )


def _finite_rows(signals: Signals, table: TopicTable) -> Series:
    """Return the rows of a topic, which must be finite; moments of ticks may be nan."""
    series = signals.topic_series[table.key]
    needed = series.values
    if table is topics.TICK_TABLE:
        needed, _ = np.split(needed, _TICK_GROUPS[-1:], axis=1)
    finite = np.isfinite(needed)
    if finite.all():
        return series
    absent = []
    for column, is_finite in zip(series.columns, finite.T, strict=False):
        if not is_finite.any():
            absent.append(column.quantity)
    if absent and table in (topics.JOINT_STATES, topics.TRUE_JOINT_STATES):
        requirement = (
            "must have these: a whole run has angles and rates of all nine joints, and"
            " efforts of the actuators; `export` writes what there is"
        )
        raise refusal(
            signals.bag.path, table.key, f"no {_shorten(absent)}", requirement
        )
    bad = ~finite.all(axis=1)
    stamp = int(series.stamp_ns[bad][0])
    row = series.values[bad][0].tolist()
    raise refusal(
        signals.bag.path, table.key, row, f"is not finite at stamp {stamp} ns"
    )


def _shorten(quantities: list[str]) -> str:
    """Write quantities, as in "mu_1, mu_2, mu_3, tau_1", in short.

    All three of a kind become one.
    """
    text = ", ".join(quantities)
    for quantity in dict.fromkeys(name.rpartition("_")[0] for name in quantities):
        legs = ", ".join(f"{quantity}_{leg}" for leg in topics.LEG_NUMBERS)
        text = text.replace(legs, f"{quantity}_1..3")
    return text


def _usual(lengths_ns: Integers) -> int:
    """Return the most frequent length, the shortest where several are."""
    values, counts = np.unique(lengths_ns, return_counts=True)
    return int(values[np.argmax(counts)])


def read(
    path: str | Path, *, damaged: bool = False, namespace: str | None = None
) -> Recording:
    """Read a rosbag2 recording of a run, MCAP or sqlite3, a folder or its file.

    Args:
        path: of the recording.
        damaged: read what is intact of a damaged one; `signals.bag.damage` names the
            rest.
        namespace: of the simulator, as "/left", where the recording has several runs.

    Raises:
        InputError: it is no recording of a run, or a damaged one, or it has several
            runs and none is named.

    """
    if not isinstance(path, (str, Path)):
        raise refusal(Path(), "path", path, "must be a path")
    if not isinstance(damaged, (bool, np.bool_)):
        raise refusal(path, "damaged", damaged, "must be True or False")
    if not (namespace is None or isinstance(namespace, str)):
        raise refusal(path, "namespace", namespace, "must be text")
    return Recording(read_signals(path, damaged=damaged, namespace=namespace))


def read_run_motion(bag: str | Path, namespace: str | None = None) -> Trajectory:
    """Read the motion of a run, to be done again.

    It needs two or more samples that have an orientation.
    """
    motion = read(bag, namespace=namespace).trajectory
    if len(motion) < 2:
        raise refusal(
            Path(bag), "orientation", len(motion), "two samples or more must have one"
        )
    for begin, end in motion.gaps.tolist():
        requirement = (
            f"must be of one motion: nothing is recorded from {begin:g} to {end:g} s"
        )
        raise refusal(Path(bag), "orientation", len(motion), requirement)
    return motion


def export(
    bag: Path,
    out: Path,
    form: str = "csv",
    *,
    force: bool = False,
    namespace: str | None = None,
) -> list[Path]:
    """Write each table of a recording, as csv or parquet, into a folder.

    Returns the paths. The folder is made if it is not there; `force` replaces earlier
    files; the `namespace` is that of `read_signals`. Raises InputError where the
    recording cannot be read, `out` cannot be written or is not empty, and
    MissingDependency.
    """
    require_free(out, "export", force=force)
    run = read_signals(bag, namespace=namespace)
    paths = [out / f"{name}.{form}" for name in run.tables]
    with write_into(out, "export"):
        for (name, series), path in zip(run.tables.items(), paths, strict=True):
            table = run.table(name).reset_index()
            columns = (*topics.TIMES, *series.columns)
            descriptions = {
                column.name: {"unit": column.unit, "description": column.text}
                for column in columns
            }
            arrays = {key: table[key].to_numpy() for key in table}
            write_table(arrays, path, descriptions)
    return paths
