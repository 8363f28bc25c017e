# SPDX-License-Identifier: Apache-2.0
"""What the simulator publishes: the run loop's audience.

Publishing happens in the run's thread, after the step, in the slack before the next deadline; a
topic that nobody reads is left out.
rclpy holds the interpreter's lock while it publishes (measured: 200 publications beside a busy
thread are never interrupted), so a thread of its own could not work beside the next step; it would
only add switches between threads.
"""

from __future__ import annotations

import contextlib

from rclpy.node import Node
from std_msgs.msg import String

from sst_ros.nodes import middleware, topics
from sst_ros.nodes.clocks import OwnClock
from sst_ros.nodes.messages import NotFinite, StateMessages, TorqueLog
from sst_ros.nodes.raw_messages import Outlet, Send, Template
from sst_ros.runtime.torque_input import Moving, Settings
from sst_ros.scene.scene import Scene
from sst_ros.scene.yaml_document import dump
from sst_ros.simulation import State, Triple

_HISTORY_S = 2
_FAST = 10
_LEAST_DEPTH, _MOST_DEPTH = 10, 20_000


class Publications:
    """Publishers of the simulator."""

    def __init__(self, node: Node, scene: Scene, settings: Settings) -> None:
        given = settings.parameters
        self._node = node
        self._clock = OwnClock(node) if given.publish_clock else None
        samples = _HISTORY_S * given.publish_rate * (given.real_time_factor or _FAST)
        depth = round(min(max(samples, _LEAST_DEPTH), _MOST_DEPTH))
        states = (topics.JOINT_STATES, topics.ORIENTATION, topics.EULER_ZYZ)
        state = [Outlet(topic.publisher(node, depth)) for topic in states]
        self._torques = Outlet(topics.APPLIED_TORQUES.publisher(node, depth))
        self._phase = topics.PHASE.publisher(node)
        self._scene = topics.SCENE.publisher(node)
        self._scene.publish(String(data=dump(scene)))
        self._messages = StateMessages()
        self._state = tuple(zip(state, self._messages.templates, strict=True))
        moments = scene.moment is not None and scene.moment.topic
        self._log = TorqueLog(given.ticks_per_sample, given.period_ns, moments=moments)
        self._period_ns = given.period_ns

    def begin_ns(self, earliest_ns: int) -> int:
        """Give the stamp of a new start; 0 as long as the clock that is followed has no time."""
        self._log.clear()
        if self._clock is not None:
            return max(self._clock.now_ns, earliest_ns)
        now = self._node.get_clock().now().nanoseconds
        return max(now, earliest_ns) if now else 0

    def ticks(self, torque: Triple, moment: Triple, count: int) -> None:
        """Note what acted over some ticks."""
        self._log.append(torque, moment, count)

    def sample(self, moving: Moving, stamp_ns: int) -> None:
        """Publish a sample of the run and the torques that led to it.

        Raises:
            NotFinite: nothing has been published.

        """
        read = self._read()
        if read:
            self._messages.fill(moving.state)
        if self._clock is not None:
            self._clock.tell(stamp_ns)
        if self._log and self._torques.readers():
            self._torques.send(self._log.take(stamp_ns - len(self._log) * self._period_ns))
        self._log.clear()
        for send, template in read:
            send(template.stamped(stamp_ns))

    def idle(self, state: State, *, still: bool) -> None:
        """Show a state that is no sample: stamped zero, `still` with zero rates."""
        if self._clock is not None:
            self._clock.repeat()
        self._log.clear()
        self._torques.send(self._log.take(0))
        with contextlib.suppress(NotFinite):  # then the last one that was is shown
            self._messages.fill(state)
        if still:
            self._messages.still()
        for send, template in self._read():
            send(template.stamped(0))

    def changed(self, phase: str) -> None:
        """Tell a change of the phase."""
        self._phase.publish(String(data=phase))
        log = self._node.get_logger()
        if phase.startswith("fault"):
            log.error(f"{phase}; the last valid state is held until ~/reset")
        else:
            log.info(phase)

    def rivals(self) -> list[str]:
        """Names of other nodes that publish /clock while this one does."""
        return [] if self._clock is None else self._clock.rivals()

    def finish(self) -> None:
        """Wait until readers have it all."""
        middleware.finish(self._node.publishers)

    def _read(self) -> list[tuple[Send, Template]]:
        """Messages of the state that somebody reads."""
        return [(outlet.send, template) for outlet, template in self._state if outlet.readers()]
