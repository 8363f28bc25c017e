# SPDX-License-Identifier: Apache-2.0
"""A recorded run as arrays: what the nodes published between the start and the last sample."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from sst_ros.errors import InputError
from sst_ros.mechanism.geometry import Array, Geometry
from sst_ros.mechanism.rates import body_rates
from sst_ros.recording import signals
from sst_ros.recording.bag_reader import refusal
from sst_ros.recording.signals import Integers, Series, Signals, places
from sst_ros.recording.topic_tables import (
    COMMANDS,
    DIAGNOSTICS,
    EULER,
    JOINT_STATES,
    ORIENTATION,
    SCENE,
    STAMPED_COMMANDS,
    TICKS,
    TopicTable,
)
from sst_ros.scene.scene import Scene
from sst_ros.simulation.torque_profile import TorqueTable
from sst_ros.simulation.trajectory import Trajectory
from sst_ros.state import NANOSECONDS

if TYPE_CHECKING:
    import pandas as pd


ESSENTIAL = (JOINT_STATES.topic.key, ORIENTATION.topic.key, TICKS.topic.key, SCENE.key)
"""Topics without which a recording is not that of a run."""
OPTIONAL = (EULER.topic.key, DIAGNOSTICS.key, COMMANDS.topic.key)


@dataclass(frozen=True)
class Commands:
    """Recorded commands in order of their reception.

    Attributes:
        received_ns: by the recorder's clock [ns], shape (c,).
        stamp_ns: stamp of the sample that is answered [ns]; 0 where commands have none, shape (c,).
        torque: commanded torques [N m], shape (c, 3).

    """

    received_ns: Integers
    stamp_ns: Integers
    torque: Array


@dataclass(frozen=True)
class Ticks:
    """Applied torques by tick, in order of time.

    Attributes:
        start_ns, end_ns: the tick, relative to the start of the run [ns], shape (m,).
        torque: actuator torques held over the tick [N m], shape (m, 3).
        moment: external moment on the star in {B} held over the tick [N m], shape (m, 3); None
            where it was not recorded.

    """

    start_ns: Integers
    end_ns: Integers
    torque: Array
    moment: Array | None = None

    @property
    def period_ns(self) -> int:
        """The usual length of a tick [ns]."""
        return _usual(self.end_ns - self.start_ns)

    @property
    def gaps(self) -> int:
        """How often a tick does not begin where the one before ended."""
        return int(np.count_nonzero(self.start_ns[1:] != self.end_ns[:-1]))


@dataclass(frozen=True)
class Recording:
    """A run from its bag. Samples are in order of time; rows belong to samples.

    Attributes:
        path: where the bag is.
        scene: what was simulated.
        start_ns: stamp of the start of the run [ns]; all other times but `received_ns` are
            relative to it.
        time_ns, received_ns: instant of each sample, and when the recorder got it by its own
            clock [ns], shape (n,).
        gamma, mu, beta: joint angles [rad], shape (n, 3).
        gamma_dot, mu_dot, beta_dot: joint rates [rad/s], shape (n, 3).
        effort: actuator torques of the tick that ends at the sample [N m], shape (n, 3).
        quaternion: orientation of {E} in {B}, (x, y, z, w), shape (n, 4); nan where it was lost.
        euler: ZYZ angles (theta, phi, psi) [rad], shape (n, 3); nan where they were lost.
        ticks: applied torques.
        idle_states: number of joint states that are no samples, which are not in the arrays.
        commands: recorded commands.
        reports: diagnostics of the simulator's run: when received [ns], text by key.
        missing: keys of the topics that are not in the recording.
        signals: all columns of the recording.

    """

    path: Path
    scene: Scene
    start_ns: int
    time_ns: Integers
    received_ns: Integers
    gamma: Array
    mu: Array
    beta: Array
    gamma_dot: Array
    mu_dot: Array
    beta_dot: Array
    effort: Array
    quaternion: Array
    euler: Array
    ticks: Ticks
    idle_states: int
    commands: Commands
    reports: tuple[tuple[int, dict[str, str]], ...]
    missing: tuple[str, ...]
    signals: Signals

    @property
    def period_ns(self) -> int:
        """The usual time between two samples [ns]; the last one may come early."""
        spacing = np.diff(self.time_ns)
        return _usual(spacing[:-1] if len(spacing) > 1 else spacing)

    @cached_property
    def effort_difference(self) -> Array:
        """Largest difference of a sample's effort and the torque of the tick that ends at it.

        [N m], shape (n,); nan where that tick is not recorded. Where actuators lag it is the lag.
        """
        at = places(self.ticks.end_ns, self.time_ns)
        result = np.where(at >= 0, 0.0, np.nan)
        for effort, torque in zip(self.effort.T, self.ticks.torque.T, strict=True):
            np.maximum(result, np.abs(effort - torque[at]), out=result)  # nan stays
        return result

    @property
    def diagnostics(self) -> dict[str, str]:
        """The last diagnostics of the simulator's run, text by key; may be empty."""
        return self.reports[-1][1] if self.reports else {}

    @property
    def seconds(self) -> Array:
        """Time of each sample since the start of the run [s], shape (n,)."""
        return np.asarray(self.time_ns / NANOSECONDS)

    @cached_property
    def trajectory(self) -> Trajectory:
        """The run as a `Trajectory`; samples whose orientation was lost are left out.

        Between samples `Trajectory.at` integrates under the recorded torques. Its error estimate,
        method and message are those that the simulator reported.
        """
        known = np.isfinite(self.quaternion).all(axis=1)
        rates = (self.gamma_dot, self.mu_dot, self.beta_dot)
        body_rate = body_rates(Geometry.of(self.scene), self.quaternion, *rates)
        joints = np.hstack([self.gamma, self.mu, self.beta, *rates])
        reported = self.diagnostics
        try:
            error_estimate = float(reported.get("error_estimate", "nan"))
        except ValueError:
            error_estimate = np.nan
        fault = reported.get("fault", "")
        ticks = self.ticks
        return Trajectory(
            self.scene,
            self.seconds[known],
            self.quaternion[known],
            body_rate[known],
            self.effort[known],
            joints=joints[known],
            status=1 if fault else 0,
            message=fault or reported.get("phase", "recorded"),
            method=reported.get("integrator", ""),
            error_estimate=error_estimate,
            law=None if ticks.gaps else TorqueTable(ticks.start_ns / NANOSECONDS, ticks.torque),
        )

    def table(self, name: str = "samples") -> pd.DataFrame:
        """Return a table as pandas: samples, ticks, commands, commands_stamped, external_moment.

        Raises:
            InputError: the recording has no such table.
            MissingDependency: pandas is not installed.

        """
        return self.signals.table(name)


def read(path: str | Path, *, damaged: bool = False) -> Recording:
    """Read a rosbag2 recording of a run, MCAP or sqlite3.

    Args:
        path: folder of the recording, or its file.
        damaged: read what is intact of a damaged recording; `signals.damage` names the rest.

    Raises:
        InputError: it is no recording of a run, or a damaged one; the error names the fault.

    """
    path = Path(path)
    found = signals.read(path, damaged=damaged)
    absent = [found.absent[key] for key in ESSENTIAL if key in found.absent]
    if absent:
        raise InputError(str(path), absent)
    if found.scene is None:
        raise refusal(path, SCENE.key, 0, "the recording must hold one scene")
    reports = tuple(
        (one.received_ns, one.values)
        for one in found.statuses
        if one.name.endswith("run") and "phase" in one.values
    )
    joints, orientation, euler, ticks = (
        _finite_rows(found, table) for table in (JOINT_STATES, ORIENTATION, EULER, TICKS)
    )
    stamps = joints.stamp_ns
    if len(stamps) < 2:
        allowed = f"a run has two samples or more ({found.idle_states} lie before its start)"
        if reports and (fault := reports[-1][1].get("fault")):
            allowed += f"; the simulator reports: {fault}"
        raise refusal(path, "joint_states", len(stamps), allowed)
    if not len(ticks.stamp_ns):
        raise refusal(path, "applied_torques", 0, "the run has no recorded torque")
    start_ns = min(int(stamps[0]), int(ticks.stamp_ns[0]))
    quaternion = _rows_at(stamps, orientation)
    with np.errstate(over="ignore"):  # too long is refused just below
        length = np.sqrt(np.einsum("ij,ij->i", quaternion, quaternion))
    if np.any(np.abs(length - 1.0) > 1e-6):  # nan compares False: lost is not wrong
        wrong = float(length[np.abs(length - 1.0) > 1e-6][0])
        raise refusal(path, "orientation", wrong, "quaternions must have length 1")
    gamma, mu, beta, gamma_dot, mu_dot, beta_dot, effort = np.split(joints.values, 7, axis=1)
    return Recording(
        path=path,
        scene=found.scene,
        start_ns=start_ns,
        time_ns=stamps - start_ns,
        received_ns=joints.received_ns,
        gamma=gamma,
        mu=mu,
        beta=beta,
        gamma_dot=gamma_dot,
        mu_dot=mu_dot,
        beta_dot=beta_dot,
        effort=effort,
        quaternion=quaternion,
        euler=_rows_at(stamps, euler),
        ticks=_ticks(path, ticks, start_ns),
        idle_states=found.idle_states,
        commands=_commands(found),
        reports=reports,
        missing=tuple(key for key in OPTIONAL if key in found.absent),
        signals=found,
    )


def _finite_rows(found: Signals, table: TopicTable) -> Series:
    """Return the rows of a topic, none where it was not recorded; moments of ticks may be nan."""
    key = table.topic.key
    if key not in found.topic_series:
        none = np.empty(0, dtype=np.int64)
        return Series((), none, none, np.empty((0, len(table.columns))))
    series = found.topic_series[key]
    bad = ~np.isfinite(series.values[:, : 4 if table is TICKS else None]).all(axis=1)
    if bad.any():
        stamp, row = int(series.stamp_ns[bad][0]), series.values[bad][0].tolist()
        raise refusal(found.path, key, row, f"is not finite at stamp {stamp} ns")
    return series


def _rows_at(stamps_ns: Integers, series: Series) -> Array:
    """Pick the rows at the stamps; nan where there is none."""
    if np.array_equal(stamps_ns, series.stamp_ns):
        return series.values
    result = np.full((len(stamps_ns), series.values.shape[1]), np.nan)
    there = places(series.stamp_ns, stamps_ns)
    result[there >= 0] = series.values[there[there >= 0]]
    return result


def _ticks(path: Path, series: Series, start_ns: int) -> Ticks:
    """Return the ticks of a run that starts at `start_ns`; they must not overlap."""
    starts = series.stamp_ns
    ends = starts + series.values[:, 0].astype(np.int64)
    overlap = starts[1:] < ends[:-1]
    if overlap.any():
        at = int(starts[1:][overlap][0])
        allowed = f"ticks overlap at stamp {at} ns; record one simulator a bag"
        raise refusal(path, "applied_torques", at, allowed)
    torque, moment = series.values[:, 1:4], series.values[:, 4:]
    known = moment.shape[1] == 3 and bool(np.isfinite(moment).all())
    return Ticks(starts - start_ns, ends - start_ns, torque, moment if known else None)


def _commands(found: Signals) -> Commands:
    """Put the commands of both topics in order of their reception."""
    keys = (COMMANDS.topic.key, STAMPED_COMMANDS.topic.key)
    parts = [found.topic_series[key] for key in keys if key in found.topic_series]
    if not parts:
        none = np.empty(0, dtype=np.int64)
        return Commands(none, none, np.empty((0, 3)))
    received = np.concatenate([part.received_ns for part in parts])
    stamps = np.concatenate([part.stamp_ns for part in parts])
    torque = np.concatenate([part.values for part in parts])
    order = np.argsort(received, kind="stable")
    return Commands(received[order], stamps[order], torque[order])


def _usual(lengths_ns: Integers) -> int:
    """Return the most frequent length, the shortest where several are."""
    values, counts = np.unique(lengths_ns, return_counts=True)
    return int(values[np.argmax(counts)])
