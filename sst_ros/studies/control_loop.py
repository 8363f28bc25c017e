# SPDX-License-Identifier: Apache-2.0
"""A control loop: one controller on one plant, in lockstep in this process; errors of its hold."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from sst_ros.control.controller import Controller, ControlStopped, Measurement
from sst_ros.control.controller_settings import ControllerSettings
from sst_ros.control.inverse_dynamics import InverseDynamics
from sst_ros.control.reference import ReferenceMotion, Triple
from sst_ros.control.tracking import TrackingRecord
from sst_ros.errors import RunStopped
from sst_ros.integration.codegen import numba_version
from sst_ros.scene.scene import Initial, Scene
from sst_ros.simulation.simulation import NANOSECONDS, WHOLE_MOTION_BUDGET, Simulation
from sst_ros.studies.channel import Channel, ChannelState

WIDTHS = (1, 3, 3, 3, 3, 3, 3, 3)

EXACT_TOLERANCE = 1e-13
"""Local error of the simulation whose torques are a function of time."""

_SAMPLES = 20


@dataclass(frozen=True)
class ControlLoop:
    """A controller and a plant.

    Attributes:
        plant: what moves.
        model: the controller's model of it.
        motion: reference motion.
        settings: mode and gains.
        period_ns: time between samples, over which a torque is held [ns].
        channel: between plant and controller.
        seed: of the noise.
        rest_s: time for which the loop goes on after the motion [s].
        offset: by how much the plant's gamma is off at the start [rad].
        lost: error of gamma beyond which the run is aborted [rad].

    """

    plant: Scene
    model: Scene
    motion: ReferenceMotion
    settings: ControllerSettings
    period_ns: int
    channel: Channel = field(default_factory=Channel)
    seed: int = 0
    rest_s: float = 0.0
    offset: float = 0.0
    lost: float = math.inf


def run_loop(loop: ControlLoop) -> tuple[TrackingRecord, NDArray[np.bool_], str]:
    """Run a loop to its end.

    Returns:
        The track, with the errors of the true state, not of the measured one; by sample, whether
        the controller limited a torque; why the loop ended early, empty where it did not.

    """
    period = loop.period_ns / NANOSECONDS
    simulation = Simulation(
        at_start(loop.plant, loop.motion, loop.offset), compiled=numba_version() is not None
    )
    controller = Controller(loop.model, loop.motion, loop.settings, period)
    channel = ChannelState(loop.channel, period, loop.seed)
    rows, limited, failure = [], [], ""
    torque = (0.0, 0.0, 0.0)
    for k in range(round((loop.motion.duration + loop.rest_s) / period) + 1):
        time = k * loop.period_ns / NANOSECONDS
        try:
            if k > 0:
                simulation.step(torque, loop.period_ns)
            joints = simulation.state.joints
            measured = Measurement(*channel.measure(joints.gamma, joints.gamma_dot))
            command = controller.command(time, measured)
            torque = channel.delayed(command.torque)
            wanted = command.desired
            rows.append(
                (time, *wanted.gamma, *wanted.gamma_dot, *joints.gamma, *joints.gamma_dot,
                 *command.feedforward, *command.feedback, *torque)
            )  # fmt: skip
            limited.append(command.saturated)
            if math.dist(wanted.gamma, joints.gamma) > loop.lost:
                raise ControlStopped(f"off by more than {loop.lost:g} rad", time)
        except (RunStopped, ControlStopped) as error:
            failure = str(error)
            break
    columns = np.split(np.array(rows).reshape(len(rows), -1), np.cumsum(WIDTHS)[:-1], axis=1)
    time_s, gamma, gamma_dot, at, rate, feedforward, feedback, torques = columns
    track = TrackingRecord(
        time_s[:, 0], gamma, gamma_dot, gamma - at, gamma_dot - rate, feedforward, feedback, torques
    )
    return track, np.array(limited, dtype=bool), failure


def at_start(plant: Scene, motion: ReferenceMotion, offset: float = 0.0) -> Scene:
    """Return the plant at the start of a motion, its gamma off by `offset` [rad]."""
    start = motion.at(0.0)
    a, b, c = (angle + offset for angle in start.gamma)
    initial = Initial(gamma=(a, b, c), gamma_dot=start.gamma_dot, orientation=start.quaternion)
    return replace(plant, initial=initial)


def held_error(loop: ControlLoop) -> float:
    """Return the largest error of gamma [rad] under feedforward alone, held over the periods.

    nan where the loop fails.
    """
    settings = replace(loop.settings, mode="feedforward")
    track, _, failure = run_loop(replace(loop, settings=settings, rest_s=0.0))
    return math.nan if failure else float(np.abs(track.error).max())


def unheld_error(scene: Scene, motion: ReferenceMotion) -> tuple[float, float]:
    """Give a scene the torques of a motion as a function of time: nothing is held.

    Returns:
        The largest error of gamma over the motion, and the error estimate at its end [rad].

    """
    inverse = InverseDynamics(scene)

    def torque(time: float) -> Triple:
        now = motion.at(time)
        return inverse.torque(now.quaternion, now.body_rate, now.body_acceleration)

    simulation = Simulation(
        at_start(scene, motion), "dop853", tolerance=EXACT_TOLERANCE,
        step_budget=WHOLE_MOTION_BUDGET,
    )  # fmt: skip
    worst, step = 0.0, round(motion.duration * NANOSECONDS / _SAMPLES)
    for _ in range(_SAMPLES):
        state = simulation.step(torque, step)
        wanted = motion.at(state.time_ns / NANOSECONDS).gamma
        worst = max(worst, float(np.abs(np.subtract(wanted, state.joints.gamma)).max()))
    return worst, simulation.error_estimate
