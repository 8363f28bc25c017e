# SPDX-License-Identifier: Apache-2.0
"""The simulator node: torque commands in, joint states and orientation out."""

from __future__ import annotations

import threading
from collections.abc import Iterator, Sequence
from typing import Any

from diagnostic_msgs.msg import DiagnosticStatus
from rclpy.node import Node

from sst_ros.errors import InputError, SstError
from sst_ros.host import scheduling
from sst_ros.nodes import graph, parameters, simulation_interfaces, topics
from sst_ros.nodes.clocks import FOLLOWED_STEP_NS, STEADY, FollowedClock, follows_clock
from sst_ros.nodes.compiled_code import CodeCompiler
from sst_ros.nodes.messages import diagnostics
from sst_ros.nodes.polling import Reader
from sst_ros.nodes.publications import SimulatorTopics
from sst_ros.nodes.services import Services
from sst_ros.runtime.diagnostics import RunDiagnostics, read_gauges
from sst_ros.runtime.pacing import Pacer, SteadyTime
from sst_ros.runtime.run_loop import Phase, Reply, RunLoop
from sst_ros.runtime.settings import SimulatorParameters
from sst_ros.runtime.torque_input import TorqueInput
from sst_ros.scene import scene
from sst_ros.scene.scene import Scene
from sst_ros.simulation.simulation import NANOSECONDS, Simulation

_LEVELS = (DiagnosticStatus.OK, DiagnosticStatus.WARN, DiagnosticStatus.ERROR)
_WATCH_S = 0.1
_END_S = 0.5
"""Wait for the thread of the run, where a step does not end."""


class Simulator:
    """Worker of the process `simulator`: connects the parts, reports once a second."""

    def __init__(self) -> None:
        self.node = Node("sst_simulator")
        self.done = threading.Event()
        given = self.parameters = parameters.declare(
            self.node, SimulatorParameters, self._change, _scene_duration
        )
        simulated = scene.load(given.scene)
        self._topics = SimulatorTopics(self.node, simulated, given)
        self._run = given.run
        self._input = TorqueInput(self._run, simulated.actuators, *self._readers(simulated))
        self._pacer = self._create_pacer()
        traced = given.equations == "quaternion"
        self._code = (
            CodeCompiler(self.node, simulated, given) if given.compiled and traced else None
        )
        self._latency = scheduling.CpuDmaLatency()
        self._loop = RunLoop(
            simulated, self._build, self._run, self._input, self._pacer, self._topics
        )
        period_s = given.period_ns / NANOSECONDS
        self._diagnostics = RunDiagnostics(self._loop, self._input, self._pacer, period_s)
        Services(self.node, self._loop)
        simulation_interfaces.offer(self.node, self._loop, self.done.set)
        self.node.create_timer(1.0, self._report, clock=STEADY)
        self._read_gauges()
        self._loop.post(self._quiet)
        self._thread = threading.Thread(target=self._live, name="run", daemon=True)
        self._thread.start()
        threading.Thread(target=self._watch, name="watch", daemon=True).start()

    def close(self) -> None:
        """End the run, publish the last diagnostics.

        Raises:
            SstError: the run has failed.

        """
        self._loop.stop()
        self.done.set()
        self._thread.join(_END_S)
        if not self._thread.is_alive():
            self._read_gauges()
        self._report()
        if self._code is not None:
            self._code.start()
        print("\n".join(self._diagnostics.table()), flush=True)
        if self._loop.failed:
            raise SstError(self._loop.fault)

    def _live(self) -> None:
        """Run in a thread of its own."""
        self._schedule()  # at once: the run may begin before the first report
        try:
            self._loop.run()
        finally:
            self.done.set()

    def _quiet(self) -> Reply:
        """Settle the process once the code of all methods is loaded: the run's first request."""
        scheduling.quiet()
        return Reply(True, "")

    def _watch(self) -> None:
        """Look after the run, in a thread of its own: a timer would go through the executor."""
        while not self.done.wait(_WATCH_S):
            self._loop.watch()
            if self._loop.failed:
                self.done.set()

    def _build(self, simulated: Scene) -> Simulation:
        given = self.parameters
        compiled = self._code is not None and self._code.available
        return Simulation(
            simulated,
            given.integrator,
            tolerance=given.tolerance,
            compiled=compiled,
            equations=given.equations,
        )

    def _create_pacer(self) -> Pacer:
        given = self.parameters
        if follows_clock(self.node):
            clock = FollowedClock(self.node)
            return Pacer(given.period_ns, given.real_time_factor, clock, FOLLOWED_STEP_NS)
        return Pacer(given.period_ns, given.real_time_factor, SteadyTime())

    def _readers(self, simulated: Scene) -> list[Reader]:
        inputs = [topics.COMMANDS, topics.COMMANDS_STAMPED]
        if simulated.moment is not None and simulated.moment.topic:
            inputs.append(topics.EXTERNAL_MOMENT)
        return [Reader(self.node, topic) for topic in inputs]

    def _change(self, changed: SimulatorParameters) -> None:
        """Take over parameters that were set, and the speed between two samples."""
        before, self.parameters, run = self.parameters, changed, changed.run
        self._run.command_timeout_ns = run.command_timeout_ns
        self._run.lockstep_timeout = run.lockstep_timeout
        if changed.real_time_factor != before.real_time_factor:
            self._loop.post(self._change_speed)

    def _change_speed(self) -> Reply:
        self._schedule()
        self._pacer.change(self.parameters.real_time_factor)
        return Reply(True, "")

    def _schedule(self) -> None:
        """Real-time scheduling for a run that sleeps; without deadlines it would starve others.

        The machine may sleep as it likes where no deadlines are kept.
        """
        given, thread = self.parameters, self._thread.native_id
        if thread is None or not self._thread.is_alive():
            return
        paced, log = given.real_time_factor > 0.0, self.node.get_logger()
        try:
            granted = scheduling.schedule(given.realtime_priority if paced else 0, thread)
        except ProcessLookupError:  # it has ended since
            return
        if granted != self._diagnostics.scheduling:
            self._diagnostics.scheduling = granted
            log.info(f"scheduling of the run: {granted}")
        running = self._loop.phase is Phase.RUNNING
        granted = self._latency.request(given.cpu_dma_latency if paced and running else -1)
        if granted != self._diagnostics.cpu_dma_latency:
            self._diagnostics.cpu_dma_latency = granted
            log.info(f"exit latency of idle states: {granted}")

    def _read_gauges(self) -> Reply:
        self._diagnostics.gauges = read_gauges(self._loop.simulation, self._loop.held)
        return Reply(True, "")

    def _report(self) -> None:
        """Publish the diagnostics, log what is new, request gauges for the next time."""
        self._schedule()  # the threads that have begun since: of callbacks and of DDS
        own = self.node.get_fully_qualified_name()
        commands = [topic.at(own) for topic in (topics.COMMANDS, topics.COMMANDS_STAMPED)]
        publishers = sum(map(self.node.count_publishers, commands))
        level, text, news = self._diagnostics.status(publishers, [*self._warnings(commands)])
        for line in news:
            self.node.get_logger().warning(line)
        stamp_ns = self.node.get_clock().now().nanoseconds
        values = self._diagnostics.values(publishers)
        message = diagnostics(f"{own}: run", stamp_ns, _LEVELS[level], text, values)
        self._topics.diagnostics.publish(message)
        scheduling.tidy()
        if self._loop.phase is not Phase.FINISHED:
            self._loop.post(self._read_gauges)

    def _warnings(self, commands: Sequence[str]) -> Iterator[str]:
        """Conditions of the graph that keep a run from what its user expects."""
        if rivals := self._topics.rivals():
            yield f"/clock is also published by {', '.join(rivals)}"
        if follows_clock(self.node) and self._topics.now_ns() == 0:
            yield "use_sim_time is set and there is no /clock: the run waits for it"
        for topic in commands:
            for name in graph.publishers(self.node, topic, best_effort=True):
                yield f"{topic} of {name} is best effort and not received: publish it reliably"
        own = self.node.get_fully_qualified_name()
        # Not by the names of the graph: a node that has ended may stay there.
        if self.node.count_publishers(topics.PHASE.at(own)) > 1:
            yield f"another node is named {own}, too"


def _scene_duration(given: dict[str, Any]) -> dict[str, Any]:
    """Return the scene's duration as a default; faults of the scene are reported later."""
    try:
        simulated = scene.load(given.get("scene", SimulatorParameters().scene))
    except (InputError, TypeError):
        return {}
    return {"duration": simulated.duration or 0.0}
