# SPDX-License-Identifier: Apache-2.0
"""The simulator node: torque commands in, joint states and orientation out."""

from __future__ import annotations

import math
import sys
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import QuaternionStamped, Vector3Stamped
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, QoSProfile
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray, String
from trajectory_msgs.msg import JointTrajectory

from sst_ros import scene
from sst_ros.document import dump
from sst_ros.errors import Problem, RunStopped
from sst_ros.nodes import parameters, process
from sst_ros.nodes.messages import StateMessages, TorqueLog, diagnostics
from sst_ros.nodes.pacing import Pacer
from sst_ros.schema import Section, flag, integer, number, text
from sst_ros.simulation import NANOSECONDS, Simulation

ZERO = (0.0, 0.0, 0.0)
_PREVIEW_PERIOD_S = 0.1
_HISTORY_S = 2
_ACKNOWLEDGE_S = 2.0


@dataclass(frozen=True)
class SimulatorParameters(Section):
    """Parameters of sst_simulator."""

    scene: str = text("scene, by name or by path of a .yaml file", default="example2")
    rate: int = integer(
        "steps per second of simulated time, a divisor of 1e9",
        "Hz",
        default=1000,
        least=1,
        most=100000,
    )
    publish_rate: int = integer(
        "published samples per second, a divisor of rate", "Hz", default=500, least=1, most=100000
    )
    wait_for_command: bool = flag("begin the run at the first command, not at once", default=False)
    duration: float = number(
        "length of the run, after which the node ends; 0 for no end",
        "s",
        default=0.0,
        least=0.0,
        most=1e9,
    )

    def check(self) -> Iterator[Problem]:
        """Refuse rates that have no whole period."""
        if NANOSECONDS % self.rate:
            yield Problem("rate", self.rate, "must divide 1e9, so that a step is whole nanoseconds")
        if self.rate % self.publish_rate:
            yield Problem("publish_rate", self.publish_rate, f"must divide rate = {self.rate}")


@dataclass
class RunRecord:
    """What a run has done so far; written by the run's thread, read by the diagnostics."""

    phase: str = "waiting"
    fault: str = ""
    ticks: int = 0
    published: int = 0
    step_total_s: float = 0.0
    step_max_s: float = 0.0
    started_s: float = 0.0
    wall_time_s: float = 0.0
    received: int = 0
    dropped: int = 0


class Simulator:
    """Worker of the process `simulator`."""

    def __init__(self) -> None:
        self.node = Node("sst_simulator")
        self.done = threading.Event()
        self._parameters = parameters.declare(self.node, SimulatorParameters)
        self._scene = scene.load(self._parameters.scene)
        self._simulation = Simulation(self._scene)
        self._period_ns = NANOSECONDS // self._parameters.rate
        self._decimation = self._parameters.rate // self._parameters.publish_rate
        self._record = RunRecord()
        self._pacer = Pacer(self._period_ns)
        self._torque = ZERO
        self._commanded = threading.Event()
        self._stop = threading.Event()
        self._messages = StateMessages()
        self._log = TorqueLog(self._decimation, self._period_ns)
        self._open_topics()
        self.node.create_timer(1.0, self._report)
        self._thread = threading.Thread(target=self._run, name="run", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """End the run, tell the last diagnostics, wait until readers have it all."""
        self._stop.set()
        self._thread.join()
        self._report()
        deadline = time.monotonic() + _ACKNOWLEDGE_S
        for publisher in self.node.publishers:
            left = max(0.0, deadline - time.monotonic())
            publisher.wait_for_all_acked(Duration(seconds=left))

    def _open_topics(self) -> None:
        depth = max(10, _HISTORY_S * self._parameters.publish_rate)
        states = QoSProfile(depth=depth)
        latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        open_topic = self.node.create_publisher
        self._joint_states: Publisher = open_topic(JointState, "joint_states", states)
        self._orientation: Publisher = open_topic(QuaternionStamped, "~/orientation", states)
        self._euler_zyz: Publisher = open_topic(Vector3Stamped, "~/euler_zyz", states)
        self._applied: Publisher = open_topic(JointTrajectory, "~/applied_torques", states)
        self._diagnostics: Publisher = open_topic(DiagnosticArray, "/diagnostics", 10)
        open_topic(String, "~/scene", latched).publish(String(data=dump(self._scene)))
        self.node.create_subscription(Float64MultiArray, "~/commands", self._command, 10)

    def _command(self, message: Float64MultiArray) -> None:
        """Hold the torques until the next message; a message that is not whole is not used."""
        data = message.data
        if len(data) != 3 or not all(map(math.isfinite, data)):
            self._record.dropped += 1
            self.node.get_logger().warning(
                f"command dropped: {list(data)[:6]} must be 3 finite torques [N m]"
                f" ({self._record.dropped} so far)",
                throttle_duration_sec=1.0,
            )
            return
        self._record.received += 1
        self._torque = (data[0], data[1], data[2])
        self._commanded.set()

    def _run(self) -> None:
        """Thread of the run: wait for its start, tick to its end."""
        try:
            self._wait_for_start()
            if not self._stop.is_set():
                self._tick_to_the_end()
        except Exception:
            self._record.phase, self._record.fault = "fault", "internal error"
            self.done.set()
            raise

    def _wait_for_start(self) -> None:
        """Show the initial state, stamped zero, so that readers can be seen to be there."""
        while self._parameters.wait_for_command and not self._stop.is_set():
            self._publish_sample(0)
            self._applied.publish(self._log.take(0))
            if self._commanded.wait(_PREVIEW_PERIOD_S):
                return

    def _tick_to_the_end(self) -> None:
        record, rate = self._record, self._parameters.rate
        ticks = math.ceil(self._parameters.duration * rate - 1e-6) or math.inf
        start_ns = self.node.get_clock().now().nanoseconds
        record.started_s = time.monotonic()
        record.phase = "running"
        self._pacer.start()
        self._publish(start_ns)
        while not self._stop.is_set() and record.ticks < ticks:
            self._pacer.wait()
            try:
                self._tick()
            except RunStopped as stopped:
                record.phase, record.fault = "fault", str(stopped)
                self.node.get_logger().error(f"{stopped}; the last valid state is held")
                break
            if record.ticks % self._decimation == 0:
                self._publish(start_ns)
        if record.ticks % self._decimation:
            self._publish(start_ns)
        record.wall_time_s = time.monotonic() - record.started_s
        if record.ticks == ticks:
            record.phase = "finished"
            self.done.set()

    def _tick(self) -> None:
        began = time.perf_counter()
        torque = self._torque
        self._simulation.step(torque, self._period_ns)
        self._log.append(torque)
        took = time.perf_counter() - began
        self._record.ticks += 1
        self._record.step_total_s += took
        self._record.step_max_s = max(self._record.step_max_s, took)

    def _publish(self, start_ns: int) -> None:
        """Publish a sample of the run and the torques that led to it."""
        stamp_ns = start_ns + self._record.ticks * self._period_ns
        began_ns = stamp_ns - self._log.count * self._period_ns
        if self._log.count:
            self._applied.publish(self._log.take(began_ns))
        self._publish_sample(stamp_ns)
        self._record.published += 1

    def _publish_sample(self, stamp_ns: int) -> None:
        self._messages.fill(self._simulation.state, stamp_ns)
        self._joint_states.publish(self._messages.joint_states)
        self._orientation.publish(self._messages.orientation)
        self._euler_zyz.publish(self._messages.euler_zyz)

    def _report(self) -> None:
        record = self._record
        simulated = record.ticks * self._period_ns / NANOSECONDS
        wall = record.wall_time_s
        if record.phase == "running":
            wall = time.monotonic() - record.started_s
        values: dict[str, object] = {
            "phase": record.phase,
            "ticks": record.ticks,
            "ticks_missed": self._pacer.missed,
            "samples_published": record.published,
            "step_mean_us": 1e6 * record.step_total_s / max(record.ticks, 1),
            "step_max_us": 1e6 * record.step_max_s,
            "real_time_factor": simulated / wall if wall else 0.0,
            "wall_time_s": wall,
            "simulated_time_s": simulated,
            "commands_received": record.received,
            "commands_dropped": record.dropped,
            "error_estimate": self._simulation.error_estimate,
            "integrator": self._simulation.method,
            "fault": record.fault,
        }
        level = DiagnosticStatus.ERROR if record.fault else DiagnosticStatus.OK
        name = f"{self.node.get_fully_qualified_name()}: run"
        stamp_ns = self.node.get_clock().now().nanoseconds
        said = record.fault or record.phase
        self._diagnostics.publish(diagnostics(name, stamp_ns, level, said, values))


def main(args: list[str] | None = None) -> int:
    """Entry point of `simulator`."""
    return process.run("simulator", Simulator, args)


if __name__ == "__main__":
    sys.exit(main())
