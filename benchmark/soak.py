# SPDX-License-Identifier: Apache-2.0
"""Hours of use in one command: what grows, what is lost, what is left behind.

python -m benchmark.soak --minutes 10

A simulator and a controller at 1 kHz, a recorder, the viewer and a subscriber with the
queues of robot_state_publisher and RViz run side by side in a ROS domain of their own.
Then the memory of each process must be flat, the recording complete, and no shared
memory of theirs left. Else the status is 1.
"""

from __future__ import annotations

import contextlib
import re
import signal
import sys
import tempfile
import time
from collections.abc import Iterable
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from benchmark.measure import describe_machine, format_columns, join_line, read_options
from benchmark.nodes import Process, own_domain, start_simulator, wait_for
from sst_ros.recording import recording

SCENE = "reach"
FLAT_MB = 2.0
"""Largest growth of a process after the first minute, or third, of the run."""
SUBSCRIBER = """
import rclpy
from rclpy.qos import QoSProfile, qos_profile_sensor_data
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import QuaternionStamped
from sensor_msgs.msg import JointState
from std_msgs.msg import String
rclpy.init()
node = rclpy.create_node("subscriber")
def read(message): pass
latched = QoSProfile(depth=1, durability=rclpy.qos.DurabilityPolicy.TRANSIENT_LOCAL)
node.create_subscription(JointState, "joint_states", read, qos_profile_sensor_data)
node.create_subscription(QuaternionStamped, "sst_simulator/orientation", read, 5)
node.create_subscription(String, "robot_description", read, latched)
node.create_subscription(DiagnosticArray, "/diagnostics", read, 10)
try:
    rclpy.spin(node)
except (KeyboardInterrupt, rclpy.executors.ExternalShutdownException):
    pass
"""
"""Reads what robot_state_publisher, which makes /tf from it, and RViz read."""


def start_all(stack: ExitStack, folder: Path, seconds: float) -> dict[str, Process]:
    """Start all processes.

    The controller when the recorder listens to the simulator.
    """
    rates: dict[str, Any] = {"scene": SCENE, "rate": 1000}
    waits: dict[str, Any] = {
        "publish_rate": 1000,
        "wait_for_command": True,
        "publish_description": True,
    }
    held: dict[str, Any] = {
        "mode": "computed_torque",
        "hold": seconds + 60.0,
        "min_subscribers": 2,
    }
    processes = {
        "recorder": Process("recorder", output=folder / "bag"),
        "simulator": start_simulator(**rates, **waits),
        "viewer": Process("viewer"),
        "subscriber": Process(SUBSCRIBER, python=True),
    }
    for process in processes.values():
        stack.callback(process.end)
    processes["recorder"].line()
    processes["controller"] = Process("inverse_dynamics", **rates, **held)
    stack.callback(processes["controller"].end)
    return processes


def list_shared(pids: Iterable[int | str]) -> set[Path]:
    """Files of Fast DDS in /dev/shm that these processes have open or mapped."""
    names: set[str] = set()
    for pid in pids:
        folder = Path(f"/proc/{pid}")
        with contextlib.suppress(OSError):  # it has ended, or belongs to another user
            names.update(re.findall(r"/dev/shm/fast\S+", (folder / "maps").read_text()))
            for path in (folder / "fd").iterdir():
                with contextlib.suppress(OSError):
                    names.update(
                        re.findall(r"^/dev/shm/fast\S+$", str(path.readlink()))
                    )
    return {Path(name) for name in names}


def list_left(files: set[Path], seconds: float = 10.0) -> list[str]:
    """Return which of them still exist after at most so long, unless a living process
    uses them.

    Other programs on this machine may use the same ports.
    """
    end = time.monotonic() + seconds
    while found := {file for file in files if file.exists()}:
        found -= list_shared(path.name for path in Path("/proc").glob("[0-9]*"))
        if not found or time.monotonic() > end:
            break
        time.sleep(0.2)
    return sorted(file.name for file in found)


def soak(folder: Path, seconds: float) -> tuple[list[dict[str, str]], list[str]]:
    """Run for so long; return a column for each process, and what is wrong."""
    wrong, before = [], set(Path("/dev/shm").iterdir())
    with ExitStack() as stack:
        processes = start_all(stack, folder, seconds)
        wait_for(lambda: any((folder / "bag").glob("*.mcap")), "recording")
        memory: dict[str, list[float]] = {name: [] for name in processes}
        began = time.monotonic()
        used = {name: process.processor_s() for name, process in processes.items()}
        while (passed := time.monotonic() - began) < seconds:
            time.sleep(min(2.0, seconds / 20.0))
            for name, process in processes.items():
                memory[name].append(process.memory_kb() / 1024.0)
        files = list_shared(process.pid for process in processes.values()) - before
        columns = []
        for name, process in processes.items():
            later = memory[name][
                int(len(memory[name]) * min(60.0 / seconds, 1.0 / 3.0)) :
            ]
            growth = max(later) - later[0]
            busy = 100.0 * (process.processor_s() - used[name]) / passed
            column = {
                "": name,
                "processor [% of a core]": f"{busy:.1f}",
                "memory at the end [MB]": f"{later[-1]:.1f}",
                "growth after the first minute [MB]": f"{growth:.2f}",
            }
            columns.append(column)
            if growth > FLAT_MB:
                wrong.append(f"{name} grows by {growth:.2f} MB")
    if remaining := list_left(files):
        wrong.append(f"left in /dev/shm: {remaining}")
    return columns, wrong


def main() -> int:
    """Soak, print the table and what is wrong."""
    options = read_options("soak", __doc__, minutes=10.0)
    with own_domain(), tempfile.TemporaryDirectory() as folder:
        columns, wrong = soak(Path(folder), 60.0 * options.minutes)
        stamps = recording.read(Path(folder) / "bag").time_ns
    missing = int((stamps[-1] - stamps[0]) // 1_000_000) + 1 - len(stamps)
    if missing:
        wrong.append(f"{missing} samples are not in the recording")
    print(format_columns(columns))
    print(f"\nsamples recorded {len(stamps)}, missing {missing}")
    print(join_line(describe_machine("rclpy", "ros-rmw-fastrtps-cpp", "viser")))
    for line in wrong:
        print(f"WRONG: {line}")
    return 1 if wrong else 0


if __name__ == "__main__":
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(1))
    sys.exit(main())
