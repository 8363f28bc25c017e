# SPDX-License-Identifier: Apache-2.0
"""The simulator node: torque commands in, joint states and orientation out."""

from __future__ import annotations

import contextlib
import sys
import threading
from collections.abc import Callable
from typing import Any

from diagnostic_msgs.msg import DiagnosticStatus
from rclpy.node import Node

from sst_ros import scene
from sst_ros.errors import RunStopped
from sst_ros.nodes import (
    compiled_code,
    parameters,
    process,
    robot_description,
    simulation_interfaces,
    topics,
)
from sst_ros.nodes.clocks import HEARD_GRAIN_NS, STEADY, HeardTime, follows_clock
from sst_ros.nodes.messages import diagnostics
from sst_ros.nodes.publications import Publications
from sst_ros.nodes.raw_readers import reader
from sst_ros.nodes.services import Services
from sst_ros.nodes.topics import Endpoint
from sst_ros.runtime import gauges, realtime
from sst_ros.runtime.diagnostics import Health
from sst_ros.runtime.pacing import Pacer, SteadyTime
from sst_ros.runtime.run_loop import RunLoop
from sst_ros.runtime.run_types import Phase, Reply
from sst_ros.runtime.settings import SimulatorParameters
from sst_ros.runtime.torque_input import ZERO, CommandBoard
from sst_ros.scene.scene import Scene
from sst_ros.simulation import NANOSECONDS, Simulation

_LEVELS = (DiagnosticStatus.OK, DiagnosticStatus.WARN, DiagnosticStatus.ERROR)


class Simulator:
    """Worker of the process `simulator`: wires the parts, reports once a second."""

    def __init__(self) -> None:
        self.node = Node("sst_simulator")
        self.done = threading.Event()
        self.parameters = parameters.declare(self.node, SimulatorParameters, self._change)
        given = self.parameters
        simulated = scene.load(given.scene)
        self._publications = Publications(self.node, simulated, self)
        self._board = CommandBoard(self, simulated.actuators, *self._readers(simulated))
        self._pacer = self._paced()
        self._compiled = given.compiled and compiled_code.use(self.node, simulated, given)
        self._loop = RunLoop(
            simulated, self._build, self, self._board, self._pacer, self._publications
        )
        self._health = Health(self._loop, self._board, self._pacer, given.period_ns / NANOSECONDS)
        self._diagnostics = topics.DIAGNOSTICS.publisher(self.node)
        Services(self.node, self._loop)
        simulation_interfaces.offer(self.node, self._loop)
        robot_description.offer(self.node, simulated, given)
        self.node.create_timer(1.0, self._report, clock=STEADY)
        self._read_gauges()
        realtime.quiet()
        self._thread = threading.Thread(target=self._live, name="run", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """End the run, tell the last diagnostics, wait until readers have it all."""
        self._loop.stop()
        self._thread.join()
        self._read_gauges()
        self._report()
        self._publications.finish()
        print("\n".join(self._health.table()), flush=True)

    def _live(self) -> None:
        """Thread of the run."""
        self._schedule()
        try:
            self._loop.run()
        finally:
            self.done.set()

    def _build(self, simulated: Scene) -> Simulation:
        """Make a simulation whose first step takes no longer than the others."""
        given = self.parameters
        simulation = Simulation(
            simulated, given.integrator, tolerance=given.tolerance, compiled=self._compiled
        )
        with contextlib.suppress(RunStopped):
            simulation.step(ZERO, given.period_ns)
        simulation.reset()
        return simulation

    def _paced(self) -> Pacer:
        given = self.parameters
        if follows_clock(self.node):
            heard = HeardTime(self.node)
            return Pacer(given.period_ns, given.real_time_factor, heard, HEARD_GRAIN_NS)
        return Pacer(given.period_ns, given.real_time_factor, SteadyTime())

    def _readers(self, simulated: Scene) -> list[Callable[[], Any]]:
        listened: list[Endpoint] = [topics.COMMANDS, topics.COMMANDS_STAMPED]
        if simulated.moment is not None and simulated.moment.topic:
            listened.append(topics.EXTERNAL_MOMENT)
        return [reader(self.node, topic) for topic in listened]

    def _change(self, changed: SimulatorParameters) -> None:
        """Take over parameters that were set, and the speed between two samples."""
        before, self.parameters = self.parameters, changed
        if changed.real_time_factor != before.real_time_factor:
            self._loop.post(self._change_speed)

    def _change_speed(self) -> Reply:
        self._schedule()
        self._pacer.change(self.parameters.real_time_factor)
        return Reply(True, "")

    def _schedule(self) -> None:
        """Real-time scheduling for a run that sleeps; without deadlines it would starve others."""
        given = self.parameters
        said = realtime.schedule(given.realtime_priority if given.real_time_factor else 0)
        if said != self._health.scheduling:
            self._health.scheduling = said
            self.node.get_logger().info(f"scheduling of the run: {said}")

    def _read_gauges(self) -> Reply:
        self._health.gauges = gauges.read(self._loop.simulation)
        return Reply(True, "")

    def _report(self) -> None:
        """Publish the diagnostics, log what is new, ask for gauges for the next time."""
        publishers = sum(
            self.node.count_publishers(topic.at(self.node.get_fully_qualified_name()))
            for topic in (topics.COMMANDS, topics.COMMANDS_STAMPED)
        )
        level, said, news = self._health.judge(publishers, self._publications.rivals())
        for line in news:
            self.node.get_logger().warning(line)
        name = f"{self.node.get_fully_qualified_name()}: run"
        stamp_ns = self.node.get_clock().now().nanoseconds
        values = self._health.values(publishers)
        self._diagnostics.publish(diagnostics(name, stamp_ns, _LEVELS[level], said, values))
        realtime.tidy()
        if self._loop.phase is not Phase.FINISHED:
            self._loop.post(self._read_gauges)


def main(args: list[str] | None = None) -> int:
    """Entry point of `simulator`."""
    return process.run("simulator", Simulator, args)


if __name__ == "__main__":
    sys.exit(main())
