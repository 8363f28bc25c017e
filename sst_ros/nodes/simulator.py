# SPDX-License-Identifier: Apache-2.0
"""The simulator node: torque commands in, joint states and orientation out."""

from __future__ import annotations

import dataclasses
import gc
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import Any

from rclpy.clock import ClockChange, JumpThreshold, TimeJump
from rclpy.duration import Duration
from rclpy.node import Node
from sensor_msgs.msg import JointState

from sst_ros.errors import InputError, SstError, refuse_unless
from sst_ros.nodes import simulation_interfaces, topics
from sst_ros.nodes.process import Worker, every
from sst_ros.nodes.publications import SimulatorTopics, follows_clock
from sst_ros.runtime.diagnostics import RunDiagnostics, read_gauges
from sst_ros.runtime.run_loop import Phase, Reply, RunLoop
from sst_ros.runtime.scheduling import CpuDmaLatency, quiet, schedule
from sst_ros.runtime.settings import SimulatorParameters
from sst_ros.runtime.tick_loop import Pacer, RunParts, SteadyTime
from sst_ros.runtime.torque_input import MessageRefused, TorqueInput, by_name
from sst_ros.scene import scene
from sst_ros.scene.loads import Moment
from sst_ros.scene.scene import Scene
from sst_ros.simulation.simulation import Simulation
from sst_ros.state import NANOSECONDS

_RUN_END_S = 0.5
"""Longest wait for the thread of the run at the end: a step may not end."""
FOLLOWED_STEP_NS = 200_000_000
"""Steps of a followed clock up to this length are simulated.

Longer ones are dropped time.
"""
_LONGEST_CLOCK_WAIT_S = 0.05
"""Longest wait for a followed clock between two looks for what interrupts the run."""
_STANDSTILL_S = 1.0
"""A followed clock that stands for longer is reported."""


class Simulator(Worker[SimulatorParameters]):
    """Worker of the process `simulator`: connects the parts, reports once a second."""

    def __init__(self) -> None:
        super().__init__("sst_simulator", SimulatorParameters, _defaults_of_scene)
        parameters = self.parameters
        simulated = _load_scene(parameters)
        self._topics = SimulatorTopics(self.node, simulated, parameters)
        run = self._run = parameters.run
        names = ["commands", "commands_stamped"]
        if simulated.moment is not None and simulated.moment.topic:
            names.append("external_moment")
        self._subscribed = (*names, "set_state_topic")
        readers = [topics.Reader(self.node, topics.SIMULATOR[name]) for name in names]
        self._input = TorqueInput(run, simulated.actuators, *readers)
        followed = follows_clock(self.node)
        self._followed = FollowedClock(self.node) if followed else None
        source = self._followed or SteadyTime()
        longest_ns = FOLLOWED_STEP_NS if followed else 0
        self._pacer = Pacer(
            run.period_ns, parameters.real_time_factor, source, longest_ns
        )
        build = partial(
            Simulation,
            integrator=parameters.integrator,
            tolerance=parameters.tolerance,
            equations=parameters.equations,
        )
        self._latency = CpuDmaLatency()
        parts = RunParts(run, self._input, self._pacer, self._topics)
        self._loop = RunLoop(simulated, build, parts)
        self._diagnostics = RunDiagnostics(self._loop)
        RunServices(self.node, self._loop, lambda: self.parameters)
        simulation_interfaces.offer(
            self.node, self._loop, self.done.set, parameters.base_frame
        )
        every(self.node, 1.0, self._report)
        self._read_gauges()
        self._loop.post(quiet)  # once the code of all methods is loaded
        self._thread = threading.Thread(target=self._live, name="run", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """End the run, publish the last diagnostics and print the table of errors.

        Raises:
            SstError: the run has failed.

        """
        self._loop.stop()
        self.done.set()
        self._thread.join(_RUN_END_S)
        if not self._thread.is_alive():
            self._read_gauges()
        self._report()
        print("\n".join(self._diagnostics.table()), flush=True)
        if self._loop.failed:
            raise SstError(self._loop.fault)

    def _live(self) -> None:
        self._schedule()  # at once: the run may begin before the first report
        try:
            self._loop.run()
        finally:
            self.done.set()

    def change(self, changed: SimulatorParameters) -> None:
        """Take over parameters that were set, and the speed between two samples."""
        before = self.parameters
        self.parameters = changed
        vars(self._run).update(vars(changed.run))  # its times, as all else stays
        if changed.real_time_factor != before.real_time_factor:
            self._loop.post(self._change_speed)

    def _change_speed(self) -> None:
        self._schedule()
        self._pacer.change(self.parameters.real_time_factor)

    def _schedule(self) -> None:
        """Ask for real-time scheduling where the run sleeps between deadlines.

        Without deadlines it would starve others, and the cores may sleep as they like.
        """
        parameters = self.parameters
        thread = self._thread.native_id
        diagnostics = self._diagnostics
        if thread is None or not self._thread.is_alive():
            return
        paced = parameters.real_time_factor > 0.0
        running = self._loop.phase is Phase.RUNNING
        try:
            scheduling = schedule(parameters.realtime_priority if paced else 0, thread)
        except ProcessLookupError:  # it has ended since
            return
        latency = self._latency.request(
            parameters.cpu_dma_latency if paced and running else -1
        )
        granted = {"scheduling": scheduling, "cpu_dma_latency": latency}
        for key, text in granted.items():
            if text != diagnostics.granted[key]:
                self.node.get_logger().info(f"{key}: {text}")
        diagnostics.granted = granted

    def _read_gauges(self) -> None:
        self._diagnostics.gauges = read_gauges(self._loop.simulation, self._loop.held)

    def _report(self) -> None:
        """Publish diagnostics, log what is new, request gauges for the next time."""
        self._schedule()  # the threads that have begun since: of callbacks and of DDS
        resolve = self.node.resolve_topic_name
        commands = [
            resolve(topics.SIMULATOR[name].name)
            for name in ("commands", "commands_stamped")
        ]
        publishers = sum(self.node.count_publishers(topic) for topic in commands)
        values = self._diagnostics.values(publishers)
        warnings = list(self._warnings(commands))
        level, text, news = self._diagnostics.status(values, warnings)
        for line in news:
            self.node.get_logger().warning(line)
        self._topics.diagnostics.publish(
            topics.diagnostics(self.node, "run", level, text, values)
        )
        gc.collect()  # the garbage since `quiet`
        if self._loop.phase is not Phase.FINISHED:
            self._loop.post(self._read_gauges)

    def _warnings(self, commands: Sequence[str]) -> Iterator[str]:
        """Conditions of the graph that keep a run from what its user expects."""
        own = self.node.get_fully_qualified_name()
        clocks = topics.publishers(self.node, "/clock")
        rivals = [name for name in clocks if name != own]
        if rivals and self.parameters.publish_clock:
            yield f"/clock is also published by {', '.join(rivals)}"
        if self._followed is not None:
            yield from self._followed.warnings()
        for name in self._subscribed:
            yield from topics.other_types(self.node, topics.SIMULATOR[name])
        for topic in commands:
            for name in topics.publishers(self.node, topic, best_effort=True):
                yield (
                    f"{topic} of {name} is best effort and not received: publish it"
                    " reliably"
                )
        joint_states = topics.SIMULATOR["joint_states"].name
        joint_states = self.node.resolve_topic_name(joint_states)
        for name in topics.publishers(self.node, joint_states):
            if name != own and self.node.count_publishers(f"{name}/phase"):
                yield (
                    f"{name} publishes the same joint_states: give each simulator a"
                    " namespace"
                )
        # Not by the names of the graph: a node that has ended may stay there.
        if self.node.count_publishers(f"{own}/phase") > 1:
            yield f"another node is named {own}, too"


def _defaults_of_scene(overrides: dict[str, Any]) -> dict[str, Any]:
    """Return the defaults that are those of the scene.

    They are its initial state, and in lockstep its duration. Faults of the scene are
    reported later.
    """
    try:
        simulated = scene.load(overrides.get("scene", SimulatorParameters().scene))
    except (InputError, TypeError):
        return {}
    defaults: dict[str, Any] = {
        "state_gamma": simulated.initial.gamma,
        "state_gamma_dot": simulated.initial.gamma_dot,
    }
    if overrides.get("sync") == "lockstep":
        defaults["duration"] = simulated.duration or 0.0
    return defaults


def _load_scene(settings: SimulatorParameters) -> Scene:
    """Load the scene; with `external_moment` its moment is that of the topic.

    Raises InputError where the scene cannot be read, or has a constant moment.
    """
    simulated = scene.load(settings.scene)
    if not settings.external_moment:
        return simulated
    is_constant = simulated.moment is not None and not simulated.moment.topic
    requirement = f"must be false: scene {simulated.name} has a constant moment"
    refuse_unless("simulator", ("external_moment", True, not is_constant, requirement))
    return dataclasses.replace(simulated, moment=Moment(topic=True))


class RunServices:
    """The services and the topic by which a run is controlled; the run decides.

    Args:
        node: whose services they are.
        loop: the run.
        settings: returns the present parameters.

    """

    def __init__(
        self, node: Node, loop: RunLoop, settings: Callable[[], SimulatorParameters]
    ) -> None:
        self._log = node.get_logger()
        self._loop = loop
        self._settings = settings
        for name in ("pause", "step", "reset", "set_state"):
            service = topics.SIMULATOR[name]
            node.create_service(
                service.kind,
                service.name,
                getattr(self, f"_{name}"),
                qos_profile=topics.SERVICE_QOS,
            )
        topics.subscribe(
            node, topics.SIMULATOR, set_state_topic=self._take_state_message
        )

    def _pause(self, request: Any, response: Any) -> Any:
        return self._answer(response, partial(self._loop.pause, request.data))

    def _step(self, _: Any, response: Any) -> Any:
        return self._answer(response, self._loop.step)

    def _reset(self, _: Any, response: Any) -> Any:
        return self._answer(response, self._loop.reset)

    def _set_state(self, _: Any, response: Any) -> Any:
        settings = self._settings()
        set_state = partial(
            self._loop.set_state, settings.state_gamma, settings.state_gamma_dot
        )
        return self._answer(response, set_state)

    def _answer(self, response: Any, request: Callable[[], Reply]) -> Any:
        response.success, response.message = self._loop.ask(request)
        return response

    def _take_state_message(self, message: JointState) -> None:
        """Take the angles and rates of the actuators; the log has the reply."""
        try:
            gamma = by_name(message.name, message.position, "angles [rad] in position")
            rates = message.velocity or [0.0] * len(message.name)
            gamma_dot = by_name(message.name, rates, "rates [rad/s] in velocity")
        except MessageRefused as refused:
            self._log.warning(f"set_state refused: {refused}")
            return
        reply = self._loop.ask(partial(self._loop.set_state, gamma, gamma_dot))
        if reply.success:  # rclpy refuses two severities from one line
            self._log.info(f"set_state: {reply.message}")
        else:
            self._log.warning(f"set_state: {reply.message}")


class FollowedClock(SteadyTime):
    """The ROS clock of a node with use_sim_time, as a time source of the pacer."""

    def __init__(self, node: Node) -> None:
        self._clock = node.get_clock()
        self._moved = threading.Event()
        self._moved_s = time.monotonic()  # the steady time of the last move
        self._jumps: list[float] = []  # back [s], of which no warning was given yet
        least = Duration(nanoseconds=1)
        threshold = JumpThreshold(
            min_forward=least, min_backward=Duration(nanoseconds=-1)
        )
        self._handle = self._clock.create_jump_callback(
            threshold, post_callback=self._take_move
        )

    def now_ns(self) -> int:
        """Return the time [ns]; 0 before the first /clock."""
        return int(self._clock.now().nanoseconds)

    def sleep(self, seconds: float) -> None:
        """Wait for the next /clock."""
        self._moved.wait(_LONGEST_CLOCK_WAIT_S)
        self._moved.clear()

    def warnings(self) -> Iterator[str]:
        """Yield what keeps the run from going on, and each jump back once."""
        if self.now_ns() == 0:
            yield "use_sim_time is set and there is no /clock: the run waits for it"
        elif time.monotonic() - self._moved_s > _STANDSTILL_S:
            yield "/clock stands still: the run waits for it"
        while self._jumps:
            yield (
                f"/clock jumped back by {self._jumps.pop(0):.9g} s; stamps of the run"
                " go on"
            )

    def _take_move(self, jump: TimeJump) -> None:
        moved_s = jump.delta.nanoseconds / NANOSECONDS
        if jump.clock_change == ClockChange.ROS_TIME_NO_CHANGE and moved_s < 0.0:
            self._jumps.append(-moved_s)
        self._moved_s = time.monotonic()
        self._moved.set()
