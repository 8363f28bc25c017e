# SPDX-License-Identifier: Apache-2.0
"""Parameters of the nodes: source of descriptors, checks, --help, tables of docs."""

from __future__ import annotations

import math
import sys
from functools import partial
from typing import Any, ClassVar

from sst_ros.control.law import ControlChannel, ControllerSettings
from sst_ros.dynamics.reactions import LINK_JOINTS
from sst_ros.runtime.torque_input import RunSettings
from sst_ros.scene.scene import share_directory
from sst_ros.scene.schema import FULL_TURN, Rules, Section, choice, entry
from sst_ros.simulation.simulation import EQUATIONS, INTEGRATORS
from sst_ros.state import BASE_FRAME, NANOSECONDS, ZERO, Vector3

REACTION_JOINTS = tuple(f"{joint}_{leg}" for joint in LINK_JOINTS for leg in (1, 2, 3))
"""Joints that ~/reaction can be of."""
_OF_A_GOAL = ", where the goal does not give it; 0 for none"
_TICK_ROUNDING = 1e-6
"""Share of a tick by which a number of ticks may be off: more than rounding."""

_number = partial(entry, least=0.0, most=1e6)
_positive = partial(entry, above=0.0, most=1.0)


def _integer(doc: str, unit: str, default: int, least: int, most: int) -> Any:
    return entry(doc, unit, default=default, least=least, most=most)


class NodeParameters(Section):
    """Parameters of a node."""

    CHANGEABLE: ClassVar[tuple[str, ...]] = ()
    """Those that can be set while the node runs."""


class SimulatorParameters(NodeParameters):
    """Parameters of sst_simulator."""

    CHANGEABLE: ClassVar[tuple[str, ...]] = (
        "real_time_factor",
        "command_timeout",
        "lockstep_timeout",
        "state_gamma",
        "state_gamma_dot",
    )

    scene: str = entry("scene, by name or by path of a .yaml file", default="example2")
    rate: int = _integer(
        "steps per second of simulated time, a divisor of 1e9", "Hz", 1000, 1, 10**5
    )
    publish_rate: int = _integer(
        "published samples per second of simulated time, a divisor of rate",
        "Hz",
        500,
        1,
        100000,
    )
    wait_for_command: bool = entry(
        "start the run at the first command, not at once", default=False
    )
    duration: float = _number(
        "length of the run, after which the node ends; 0 for no end; in lockstep by"
        " default the duration of the scene",
        "s",
        default=0.0,
        most=1e9,
    )
    real_time_factor: float = _number(
        "simulated time per time of the clock, 0.001 to 1000; 0 for as fast as"
        " possible",
        "1",
        default=1.0,
        most=1000.0,
    )
    publish_clock: bool = entry("publish the simulated time on /clock", default=False)
    publish_description: bool = entry(
        "publish the scene's URDF on robot_description", default=True
    )
    base_frame: str = entry(
        "frame {B} in headers; with a prefix where robot_state_publisher has it as"
        " frame_prefix",
        default=BASE_FRAME,
    )
    wait_for_subscribers: tuple[str, ...] = entry(
        "topics of the node, such as joint_states or ~/orientation, that must have a"
        " subscriber before the run starts",
        default=(),
    )
    subscriber_timeout: float = _number(
        "longest wait for them, after which the node ends with an error", "s", 10.0
    )
    sync: str = choice(
        "free: run by the clock; lockstep: wait for the command that answers each"
        " sample",
        ("free", "lockstep"),
    )
    lockstep_timeout: float = _number(
        "longest wait for the answer to a sample, then fault; 0 for no end", "s", 10.0
    )
    command_timeout: float = _number(
        "age at which a command is no longer held (steady clock); 0 for never", "s", 0.5
    )
    partial_commands: bool = entry(
        "an effort of commands_stamped that is nan means that the actuator is not"
        " commanded, as ros2_control sends it: zero torque; else such a command is"
        " refused",
        default=False,
    )
    integrator: str = choice("method of integration", INTEGRATORS)
    tolerance: float = _positive(
        "largest local error of a step of the integrator", "rad, relative", 1e-10
    )
    equations: str = choice(
        "equations of motion: those in the quaternion and the body rate, or the paper's"
        " Eqs. 1 to 92, which give the same motion by explicit methods in plain Python,"
        " about 20 times slower",
        EQUATIONS,
    )
    encoder_counts: int = _integer(
        "steps per turn of the encoders that joint_states come from, whose rates are"
        " differences of angles; 0 for exact angles and rates",
        "1",
        default=0,
        least=0,
        most=2**31 - 1,
    )
    angle_noise: float = entry(
        "standard deviation of noise on the angles of joint_states",
        "rad",
        0.0,
        least=0.0,
        most=1.0,
    )
    rate_noise: float = _number(
        "standard deviation of noise on the rates of joint_states",
        "rad/s",
        0.0,
        most=1e3,
    )
    measurement_delay: int = _integer(
        "samples by which the angles and rates of joint_states are late", "1", 0, 0, 100
    )
    dropped_samples: float = entry(
        "share of the samples without joint_states",
        "1",
        default=0.0,
        least=0.0,
        most=0.99,
    )
    measurement_seed: int = _integer(
        "seed of the noise, and of the samples that are dropped", "1", 0, 0, 2**31 - 1
    )
    imu: bool = entry(
        "publish ~/imu, an inertial measurement unit on the star; angle_noise and"
        " rate_noise act on its orientation and rate, measurement_delay on all",
        default=False,
    )
    imu_position: Vector3 = entry(
        "where it is in {E}, whose axes it has", "m", default=ZERO, least=-1e3, most=1e3
    )
    imu_frame: str = entry(
        "its frame, which is part of robot_description, too", default="imu_link"
    )
    acceleration_noise: float = _number(
        "standard deviation of noise on its acceleration", "m/s^2", 0.0, most=1e3
    )
    reaction: str = choice(
        "joint whose force and moment ~/reaction has, by kind and leg: base to actuated"
        " link, that to the intermediate link, that to the star",
        ("none", *REACTION_JOINTS),
    )
    external_moment: bool = entry(
        "take a moment on the star from ~/external_moment, as a scene with moment:"
        " {topic: true} does; refused where the scene has a constant one",
        default=False,
    )
    state_gamma: Vector3 = entry(
        "angles of the actuators that ~/set_state puts the run at",
        "rad",
        default=ZERO,
        least=-FULL_TURN,
        most=FULL_TURN,
    )
    state_gamma_dot: Vector3 = entry(
        "rates of the actuators that ~/set_state puts the run at",
        "rad/s",
        default=ZERO,
        least=-1e6,
        most=1e6,
    )
    realtime_priority: int = _integer(
        "SCHED_FIFO priority of the run's thread where that is permitted, the other"
        " threads of the node get half of it; 0 for none",
        "1",
        default=20,
        least=0,
        most=99,
    )
    cpu_dma_latency: int = _integer(
        "largest exit latency of idle states that the machine is asked to use during a"
        " run with deadlines, where /dev/cpu_dma_latency may be written; with 0 no core"
        " sleeps, which wakes the run earlier and costs power; -1 for no limit",
        "us",
        default=-1,
        least=-1,
        most=1000000,
    )

    def rules(self) -> Rules:
        """Refuse rates that have no whole period, and bounds too small to be meant."""
        rate = self.rate
        divides_second = "must divide 1e9, so that a step is whole nanoseconds"
        yield NANOSECONDS % rate, "rate", rate, divides_second
        divides_rate = f"must divide rate = {rate}"
        remainder = rate % self.publish_rate
        yield remainder, "publish_rate", self.publish_rate, divides_rate
        waits = self.sync == "lockstep" and self.dropped_samples
        requirement = "must be 0 in lockstep, where each sample is answered"
        yield waits, "dropped_samples", self.dropped_samples, requirement
        for name in ("real_time_factor", "command_timeout", "lockstep_timeout"):
            value = getattr(self, name)
            yield 0.0 < value < 1e-3, name, value, "must be 0 or >= 0.001"

    @property
    def _last_tick(self) -> int:
        """Number of the tick that ends the run, without an end the largest number.

        A duration may be a whole number of ticks but for its rounding.
        """
        ticks = self.duration * self.rate
        return math.ceil(ticks - _TICK_ROUNDING) or sys.maxsize

    @property
    def run(self) -> RunSettings:
        """Return what the run takes from them."""
        return RunSettings(
            period_ns=NANOSECONDS // self.rate,
            ticks_per_sample=self.rate // self.publish_rate,
            last_tick=self._last_tick,
            lockstep=self.sync == "lockstep",
            own_clock=self.publish_clock,
            waits=self.wait_for_command or self.sync == "lockstep",
            partial_commands=self.partial_commands,
            base_frame=self.base_frame,
            command_timeout_ns=self.command_timeout * NANOSECONDS,
            lockstep_timeout=self.lockstep_timeout,
            subscriber_timeout=self.subscriber_timeout,
        )

    @property
    def channel(self) -> ControlChannel | None:
        """Return what lies between the joints and joint_states; None for nothing."""
        channel = ControlChannel(
            period=1.0 / self.publish_rate,
            delay=self.measurement_delay,
            counts=self.encoder_counts,
            angle_noise=self.angle_noise,
            rate_noise=self.rate_noise,
        )
        exact = ControlChannel(period=channel.period)
        if channel == exact and not self.dropped_samples:
            return None
        return channel


class AnsweringParameters(NodeParameters):
    """Parameters of the nodes that answer joint states with torques."""

    rate: int = _integer(
        "commands per second of simulated time, a divisor of 1e9: publish_rate of the"
        " simulator",
        "Hz",
        default=500,
        least=1,
        most=100000,
    )
    simulator: str = entry("name of the simulator's node", default="sst_simulator")
    stamped: bool = entry(
        "answer on commands_stamped, which lockstep needs", default=False
    )
    min_subscribers: int = _integer(
        "least number of subscribers of the commands, before which none is sent",
        "1",
        1,
        1,
        100,
    )
    timeout: float = _number("longest silence of joint_states", "s", 10.0, least=0.1)

    def rules(self) -> Rules:
        """Refuse a rate without a whole period."""
        yield from super().rules()
        requirement = "must divide 1e9, so that a period is whole"
        yield NANOSECONDS % self.rate, "rate", self.rate, requirement

    @property
    def period_ns(self) -> int:
        """Time from one command to the next [ns]."""
        return NANOSECONDS // self.rate


class PlayerParameters(AnsweringParameters):
    """Parameters of sst_torque_player."""

    scene: str = entry(
        "scene whose torque is played, by name or by path", default="example2"
    )
    stamped: bool = entry(
        "answer on commands_stamped, which each simulator takes, one in lockstep no"
        " other",
        default=True,
    )
    csv: str = entry(
        "file with time, tau_1, tau_2, tau_3 to play instead; - for none", default="-"
    )
    hold: str = choice(
        "instant whose torque is held from a sample until the next: the middle of the"
        " hold gives an error of second order in the period, its start one of first"
        " order",
        ("middle", "start"),
    )


class ControllerNodeParameters(AnsweringParameters, ControllerSettings):
    """Parameters of sst_inverse_dynamics: those of the control law and of the node."""

    CHANGEABLE: ClassVar[tuple[str, ...]] = (
        "bandwidth",
        "damping_ratio",
        "stiffness",
        "damping",
        "integral_rate",
    )

    scene: str = entry(
        "scene of the controller's model, by name or by path", default="reach"
    )
    motion: str = choice(
        "scene: the scene's motion, once; topic: trajectories from ~/joint_trajectory"
        " and goals of ~/follow_joint_trajectory, until it is stopped",
        ("scene", "topic"),
    )
    allow_partial_joints_goal: bool = entry(
        "take trajectories of some of the actuators; the others hold their position",
        default=False,
    )
    hold: float = _number(
        "time for which the end of the scene's motion is held", "s", 0.0
    )
    start_tolerance: float = _positive(
        "largest distance of gamma from the start of the motion", "rad", 0.05
    )
    path_tolerance: float = _number(
        "largest error of gamma while a goal of ~/follow_joint_trajectory moves"
        + _OF_A_GOAL,
        "rad",
        default=0.0,
    )
    goal_tolerance: float = _number(
        "largest error of gamma at its end" + _OF_A_GOAL, "rad", 0.0
    )
    stopped_velocity_tolerance: float = _number(
        "largest error of the rate of gamma at its end" + _OF_A_GOAL, "rad/s", 0.01
    )
    goal_time_tolerance: float = _number(
        "longest time after its end until both are met, else it is aborted"
        + _OF_A_GOAL,
        "s",
        1.0,
    )
    stop_time: float = _number(
        "time in which a goal that is cancelled or aborted comes to rest, on its path",
        "s",
        default=0.2,
        least=0.001,
    )
    wait_for_recorder: bool = entry(
        "start when ~/reference and ~/tracking_error have subscribers, for a complete"
        " recording",
        default=False,
    )


def default_topics() -> tuple[str, ...]:
    """Topics in config/topics.txt, the list that `ros2 bag record` takes as well."""
    return tuple((share_directory() / "config" / "topics.txt").read_text().split())


class RecorderParameters(NodeParameters):
    """Parameters of sst_recorder."""

    output: str = entry(
        "folder of the bag, which must not exist; - for a dated name", default="-"
    )
    topics: tuple[str, ...] = entry("topics to record", default=default_topics())
    timeout: float = _number(
        "longest wait until they are recorded, after which the node ends with an error;"
        " 0 for no end",
        "s",
        default=60.0,
    )

    def rules(self) -> Rules:
        """Refuse to record nothing."""
        yield not any(self.topics), "topics", [*self.topics], "must name a topic"


class ViewerParameters(NodeParameters):
    """Parameters of sst_viewer."""

    simulator: str = entry("name of the simulator's node", default="sst_simulator")
    host: str = entry(
        "address to serve the page at; another than this opens the actuators to all who"
        " reach it",
        default="127.0.0.1",
    )
    port: int = _integer(
        "port of the page; the next free one is taken", "1", 8080, 1024, 65535
    )
    open: bool = entry(
        "open the page in a browser, where there is a desktop", default=False
    )


NODE_COMMANDS: dict[str, tuple[str, type[NodeParameters]]] = {
    "simulator": ("Simulator", SimulatorParameters),
    "torque_player": ("TorquePlayer", PlayerParameters),
    "inverse_dynamics": ("InverseDynamicsController", ControllerNodeParameters),
    "recorder": ("Recorder", RecorderParameters),
    "viewer": ("Viewer", ViewerParameters),
}
"""Class in `nodes.COMMAND` that does the work of sst_COMMAND, and its parameters."""
