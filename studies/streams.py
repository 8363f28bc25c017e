# SPDX-License-Identifier: Apache-2.0
"""Streams of trajectories beside a real-time run: tracking error, missed periods.

Each message has one point, one second ahead on a slow path around the start, as jogging
tools send them. `python -m studies.streams --seconds 60` prints a row a rate;
docs/nodes.md has the figures.
"""

from __future__ import annotations

import argparse
import math
import os
import time
from collections.abc import Sequence
from pathlib import Path
from subprocess import DEVNULL
from typing import Any

import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from rclpy.duration import Duration
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from sst_ros.runtime.child_process import keep_domain, run_beside
from sst_ros.scene import scene
from sst_ros.scene.loads import ACTUATED_JOINTS

AHEAD_S, ROUND_S = 1.0, 8.0  # time of the point from now, and of a round of the path
AMPLITUDES = (0.1, 0.05, 0.02)  # [rad]
WAIT_S = 300.0  # a busy machine needs a minute to start them


def main(words: Sequence[str] | None = None) -> None:
    """Print a row for each rate."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "--rates", type=float, nargs="+", default=[3.0, 10.0, 50.0], metavar="HZ"
    )
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--scene", default="reach")
    parser.add_argument("--mode", default="computed_torque")
    parser.add_argument(
        "--realtime",
        action="store_true",
        help="SCHED_FIFO for the nodes, beside other work",
    )
    given = parser.parse_args(words)
    keep_domain()
    rclpy.init()
    columns = "{:>6} {:>6} {:>9} {:>12} {:>12} {:>11} {:>10}"
    print(
        columns.format("rate", "sent", "refused", "periods", "missed", "error", "ticks")
    )
    print(columns.format("[Hz]", "", "", "", "", "[rad]", "missed"))
    for rate in given.rates:
        print(columns.format(f"{rate:g}", *stream(given, rate)), flush=True)
    rclpy.shutdown()


def stream(given: argparse.Namespace, rate: float) -> tuple[str, ...]:
    """Stream at a rate [Hz]; return what the nodes counted."""
    node, said = rclpy.create_node("jogger"), dict[str, dict[str, str]]()
    publisher = node.create_publisher(
        JointTrajectory, "sst_inverse_dynamics/joint_trajectory", 10
    )

    def hear(message: DiagnosticArray) -> None:
        for status in message.status:
            said[status.name.rpartition(" ")[2]] = {
                one.key: one.value for one in status.values
            }

    node.create_subscription(DiagnosticArray, "/diagnostics", hear, 10)
    run = {"scene": given.scene, "duration": 0.0, "wait_for_command": True}
    control = {"scene": given.scene, "mode": given.mode, "motion": "topic"}
    with (
        run_beside("simulator", run, stdout=DEVNULL),
        run_beside("inverse_dynamics", control, stdout=DEVNULL) as controller,
    ):
        end = time.monotonic() + WAIT_S
        while said.get("control", {}).get("stage") != "waiting for a trajectory":
            rclpy.spin_once(node, timeout_sec=0.1)
            assert time.monotonic() < end and controller.poll() is None
        if given.realtime:
            _schedule(controller.pid)
            os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(5))
        begin, sent = time.monotonic(), 0
        while (passed := time.monotonic() - begin) < given.seconds:
            if sent <= passed * rate:
                publisher.publish(
                    _message(scene.load(given.scene).initial.gamma, passed)
                )
                sent += 1
            rclpy.spin_once(node, timeout_sec=0.5 / rate)
        assert controller.poll() is None, "the controller has ended"
        found, counts = said["control"], said["run"]
    node.destroy_node()
    assert counts["phase"] == "running", counts["fault"]
    keys = "trajectories_refused", "samples", "samples_irregular", "error_max_rad"
    return str(sent), *(found[key] for key in keys), counts["ticks_missed"]


def _schedule(process: int) -> None:
    """Give a process a priority below the simulator's, and its children a lower one."""
    tasks = [int(task.name) for task in Path(f"/proc/{process}/task").iterdir()]
    children = Path(f"/proc/{process}/task/{process}/children").read_text().split()
    for number, priority in [
        *((task, 9) for task in tasks),
        *((int(one), 5) for one in children),
    ]:
        os.sched_setscheduler(number, os.SCHED_FIFO, os.sched_param(priority))


def _message(start: Any, passed: float) -> JointTrajectory:
    turn = 2.0 * math.pi * (passed + AHEAD_S) / ROUND_S
    steps = zip(start, AMPLITUDES, strict=True)
    point = JointTrajectoryPoint(positions=[x + a * math.sin(turn) for x, a in steps])
    point.time_from_start = Duration(seconds=AHEAD_S).to_msg()
    return JointTrajectory(joint_names=list(ACTUATED_JOINTS), points=[point])


if __name__ == "__main__":
    main()
