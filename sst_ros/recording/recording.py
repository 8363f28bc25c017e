# SPDX-License-Identifier: Apache-2.0
"""A recorded run as arrays: what the nodes published between the start and the last sample."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from sst_ros.mechanism.geometry import Array
from sst_ros.recording.bag_reader import Bag, refused
from sst_ros.recording.collector import (
    ACTUATED,
    JOINTS,
    KINDS,
    MOMENTS,
    STAMPED,
    TOPICS,
    Collector,
    Commands,
)
from sst_ros.recording.time_series import NANOSECONDS, Integers, aligned, places, usual
from sst_ros.scene import yaml_document
from sst_ros.scene.scene import Scene

__all__ = ["ACTUATED", "JOINTS", "KINDS", "MOMENTS", "Recording", "Ticks", "read"]


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
        return usual(self.end_ns - self.start_ns)

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
        previews: number of samples before the start (stamp zero), which are not in the arrays.
        commands: recorded commands.
        reports: what the simulator said about its run: when it was received [ns], key to text.
        topics: names of the topics by key.
        missing: keys of the topics that are not in the bag.

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
    previews: int
    commands: Commands
    reports: tuple[tuple[int, dict[str, str]], ...]
    topics: dict[str, str]
    missing: tuple[str, ...]

    @property
    def period_ns(self) -> int:
        """The usual time between two samples [ns]; the last one may come early."""
        spacing = np.diff(self.time_ns)
        return usual(spacing[:-1] if len(spacing) > 1 else spacing)

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
        """The last word of the simulator about its run, key to text; may be empty."""
        return self.reports[-1][1] if self.reports else {}

    @property
    def seconds(self) -> Array:
        """Time of each sample since the start of the run [s], shape (n,)."""
        return np.asarray(self.time_ns / NANOSECONDS)


def read(path: Path) -> Recording:
    """Read a rosbag2 recording of a run.

    Raises:
        InputError: it is no recording of a run, or a damaged one; the error names what is wrong.

    """
    found = Collector(path)
    with Bag(path, (*TOPICS, STAMPED)) as bag:
        found.collect(bag)
    stamps, received, rows = found.joints.sorted()
    if len(stamps) < 2:
        allowed = f"a run has two samples or more ({found.previews} lie before its start)"
        if found.reports and (fault := found.reports[-1][1].get("fault")):
            allowed += f"; the simulator says: {fault}"
        raise refused(path, "joint_states", len(stamps), allowed)
    starts, _, ticks = found.ticks.sorted()
    if not len(starts):
        raise refused(path, "applied_torques", 0, "the run has no recorded torque")
    if len(found.scenes) != 1:
        raise refused(path, "scene", len(found.scenes), "the recording must hold one scene")
    scene = yaml_document.read(Scene, found.scenes.pop(), f"{path}: {bag.topics['scene']}")
    begin = min(int(stamps[0]), int(starts[0]))
    ends = starts + ticks[:, 0].astype(np.int64)
    if np.any(starts[1:] < ends[:-1]):
        at = starts[1:][starts[1:] < ends[:-1]][0]
        allowed = f"ticks overlap at stamp {at} ns; record one simulator a bag"
        raise refused(path, "applied_torques", int(at), allowed)
    quaternion = aligned(stamps, *found.turns.sorted())
    with np.errstate(over="ignore"):  # too long is refused just below
        length = np.sqrt(np.einsum("ij,ij->i", quaternion, quaternion))
    if np.any(np.abs(length - 1.0) > 1e-6):  # nan compares False: lost is not wrong
        worst = float(length[np.abs(length - 1.0) > 1e-6][0])
        raise refused(path, "orientation", worst, "quaternions must have length 1")
    gamma, mu, beta, gamma_dot, mu_dot, beta_dot, effort = np.split(rows, 7, axis=1)
    return Recording(
        path=path,
        scene=scene,
        start_ns=begin,
        time_ns=stamps - begin,
        received_ns=received,
        gamma=gamma,
        mu=mu,
        beta=beta,
        gamma_dot=gamma_dot,
        mu_dot=mu_dot,
        beta_dot=beta_dot,
        effort=effort,
        quaternion=quaternion,
        euler=aligned(stamps, *found.angles.sorted()),
        ticks=Ticks(
            starts - begin,
            ends - begin,
            ticks[:, 1:],
            found.moments.sorted()[2] if found.moved else None,
        ),
        previews=found.previews,
        commands=found.asked(),
        reports=tuple(sorted(found.reports, key=lambda report: report[0])),
        topics=bag.topics,
        missing=tuple(key for key in bag.missing if key != STAMPED.key),
    )
