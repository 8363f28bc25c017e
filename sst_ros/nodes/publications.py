# SPDX-License-Identifier: Apache-2.0
"""Topics of the simulator, as the output of the run loop.

Publishing happens in the thread of the run, after the step, in the slack before the next deadline;
a topic without subscribers is left out.
rclpy holds the interpreter's lock while it publishes (measured: 200 publications beside a busy
thread are never interrupted), so a thread of its own could not work beside the next step; it would
only add switches between threads.
"""

from __future__ import annotations

import contextlib
import math
import time
from collections.abc import Callable
from typing import Any

from rclpy.node import Node
from rclpy.publisher import Publisher
from std_msgs.msg import String

from sst_ros.description.urdf import urdf
from sst_ros.errors import InputError, Problem
from sst_ros.nodes import topics
from sst_ros.nodes.clocks import PublishedClock
from sst_ros.nodes.graph import COUNT_NS
from sst_ros.nodes.messages import NotFinite, Numbers, StateMessages, TorqueLog, finite, stamp
from sst_ros.runtime.settings import SimulatorParameters
from sst_ros.runtime.torque_input import ZERO, HasState
from sst_ros.scene.loads import JOINTS
from sst_ros.scene.scene import Scene
from sst_ros.scene.yaml_document import dump
from sst_ros.simulation.simulation import State
from sst_ros.state import IDLE_FRAME_ID, Vector3

_HISTORY_S = 2
_FAST = 10
_LEAST_DEPTH, _MOST_DEPTH = 10, 20_000
LOG_NS = 50_000_000
"""Torques are published once for about this time: with each sample they would take 16 us of the 180
of a wake."""

Message = Callable[[bytes, Numbers], bytes]
"""Makes a message of the bytes of a stamp and the numbers of a state."""
_AT_REST = (0.0,) * len(JOINTS)


class SimulatorTopics:
    """Publishers of the simulator.

    Raises:
        InputError: /clock has another publisher; wait_for_subscribers names a foreign topic.

    """

    def __init__(self, node: Node, scene: Scene, given: SimulatorParameters) -> None:
        self._node = node
        self._clock = PublishedClock(node) if given.publish_clock else None
        history = _HISTORY_S * given.publish_rate * (given.real_time_factor or _FAST)
        depth = round(min(max(history, _LEAST_DEPTH), _MOST_DEPTH))
        self._joints, self._orientation, self._euler, self._torques = (
            topic.publisher(node, depth)
            for topic in (
                topics.JOINT_STATES,
                topics.ORIENTATION,
                topics.EULER_ZYZ,
                topics.APPLIED_TORQUES,
            )
        )
        self._read: list[Publisher[Any]] = []
        self._states: list[tuple[Publisher[Any], Message]] = []
        self._counted_ns = 0
        self._phase = topics.PHASE.publisher(node)
        self._scene = topics.SCENE.publisher(node)
        self._scene.publish(String(data=dump(scene)))
        if given.publish_description:
            self._description = topics.ROBOT_DESCRIPTION.publisher(node)
            self._description.publish(String(data=urdf(scene)))
        self.diagnostics = topics.DIAGNOSTICS.publisher(node)
        self._awaited = self._named(given.wait_for_subscribers)
        self._samples, self._idles = StateMessages(), StateMessages(IDLE_FRAME_ID)
        self._valid: Numbers = (0.0, 0.0, 0.0, 1.0), _AT_REST * 2, ZERO
        moments = scene.moment is not None and scene.moment.topic
        samples = math.ceil(LOG_NS / (given.ticks_per_sample * given.period_ns))
        self._log_ticks = samples * given.ticks_per_sample
        self._log = TorqueLog(self._log_ticks, given.period_ns, moments=moments)
        self._log_from_ns = 0

    def now_ns(self) -> int:
        """Return the ROS time [ns]; 0 as long as a followed clock has none."""
        if self._clock is not None:
            return self._clock.now_ns
        return int(self._node.get_clock().now().nanoseconds)

    def missing_subscribers(self) -> list[str]:
        """Return the topics of wait_for_subscribers that have no subscriber."""
        return [one.topic_name for one in self._awaited if not one.get_subscription_count()]

    @property
    def unread(self) -> bool:
        """Whether nothing receives samples, so that only the last of several has to be made."""
        self._count_subscribers(COUNT_NS)
        return not self._read and self._clock is None

    def start(self) -> None:
        """Forget the torques of the run before."""
        self._log.clear()
        self._counted_ns = 0

    def ticks(self, torque: Vector3, moment: Vector3, count: int) -> None:
        """Log the torque [N m] and external moment [N m] of some ticks."""
        self._log.append(torque, moment, count)

    def sample(self, simulation: HasState, stamp_ns: int) -> None:
        """Publish a sample of the run, and from time to time the torques logged up to it.

        Raises:
            NotFinite: nothing has been published.

        """
        self._count_subscribers(COUNT_NS)
        numbers = finite(*simulation.sample)
        if self._clock is not None:
            self._clock.publish(stamp_ns)
        logged = len(self._log)
        if logged >= self._log_ticks or not logged or self._torques not in self._read:
            self.flush()
            self._log_from_ns = stamp_ns
        at = stamp(stamp_ns)
        for publisher, message in self._states:
            publisher.publish(message(at, numbers))

    def flush(self) -> None:
        """Publish the torques that have been logged, if any and if they are subscribed to."""
        if len(self._log) and self._torques in self._read:
            self._torques.publish(self._log.take(self._log_from_ns))
        self._log.clear()

    def idle(self, state: State, stamp_ns: int, *, at_rest: bool) -> None:
        """Publish a state that is no sample; `at_rest` with zero rates and efforts.

        joint_states has this stamp and IDLE_FRAME_ID, the other topics the stamp zero.
        """
        if self._clock is not None:
            self._clock.repeat()
        self.flush()
        self._torques.publish(self._log.take(0))
        with contextlib.suppress(NotFinite):  # then the last valid one is shown
            self._valid = finite(state.quaternion, sum(state.joints, ()), state.torque)
        quaternion, joints, torque = self._valid
        if at_rest:
            joints, torque = (*joints[:9], *_AT_REST), ZERO
        self._count_subscribers(0)
        for publisher, message in self._messages(self._idles):
            at = stamp(stamp_ns if publisher is self._joints else 0)
            publisher.publish(message(at, (quaternion, joints, torque)))

    def phase_changed(self, phase: str) -> None:
        """Publish and log the phase, with the reason of a fault."""
        self._phase.publish(String(data=phase))
        log = self._node.get_logger()
        if phase.startswith("fault"):
            log.error(f"{phase}; the last valid state is held until ~/reset")
        else:
            log.info(phase)

    def rivals(self) -> list[str]:
        """Names of other nodes that publish /clock while this one does."""
        return [] if self._clock is None else self._clock.rivals()

    def _count_subscribers(self, age_ns: int) -> None:
        """Find the topics that are subscribed to, unless that was done so long ago [ns]."""
        now = time.monotonic_ns()
        if now - self._counted_ns >= age_ns:
            self._counted_ns = now
            every = (self._joints, self._orientation, self._euler, self._torques)
            self._read = [topic for topic in every if topic.get_subscription_count()]
            self._states = self._messages(self._samples)

    def _messages(self, of: StateMessages) -> list[tuple[Publisher[Any], Message]]:
        """Messages of a state whose topics have subscribers."""
        publishers = (self._joints, self._orientation, self._euler)
        pairs = zip(publishers, (of.joint_states, of.orientation, of.euler_zyz), strict=True)
        return [pair for pair in pairs if pair[0] in self._read]

    def _named(self, names: tuple[str, ...]) -> list[Publisher[Any]]:
        own = {publisher.topic_name: publisher for publisher in self._node.publishers}
        found = [self._node.resolve_topic_name(name) for name in names if name]
        if unknown := [name for name in found if name not in own]:
            allowed = f"must be topics that the node publishes: {', '.join(sorted(own))}"
            problem = Problem("wait_for_subscribers", unknown, allowed)
            raise InputError(self._node.get_fully_qualified_name(), [problem])
        return [own[name] for name in found]
