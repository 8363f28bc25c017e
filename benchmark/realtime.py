# SPDX-License-Identifier: Apache-2.0
"""How well the simulator keeps time: missed ticks, processor, memory; and its fastest speed.

python benchmark/realtime.py --minutes 10        # the official figures, on an idle machine

Runs simulator and recorder for so long, with SCHED_FIFO and without, then the simulator alone as
fast as possible. The manipulator is kept moving by a damped PD controller in its own process.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path

import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from rclpy.executors import SingleThreadedExecutor
from std_msgs.msg import Float64MultiArray

NODE = "/sst_simulator"
TICK = os.sysconf("SC_CLK_TCK")


class Watch:
    """Hears the diagnostics and reads the kernel's account of a process."""

    def __init__(self):
        self.node = rclpy.create_node("benchmark")
        self.executor = SingleThreadedExecutor()
        self.executor.add_node(self.node)
        self.said = {}
        self.node.create_subscription(DiagnosticArray, "/diagnostics", self._hear, 10)

    def _hear(self, message):
        self.said = {pair.key: pair.value for pair in message.status[0].values}

    def spin(self, seconds):
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            self.executor.spin_once(timeout_sec=0.1)

    def until(self, condition, timeout=60.0):
        end = time.monotonic() + timeout
        while not condition():
            if time.monotonic() > end:
                raise SystemExit("the nodes did not come up")
            self.executor.spin_once(timeout_sec=0.1)


def processor_s(pid):
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / TICK


def memory_kb(pid):
    lines = Path(f"/proc/{pid}/status").read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith("VmRSS"))


def start(command, **given):
    words = [word for key, value in given.items() for word in ("-p", f"{key}:={value}")]
    argv = [sys.executable, "-m", "sst_ros", command, "--ros-args", *words]
    return subprocess.Popen(argv, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True)


def keep_time(watch, minutes, priority, given):
    """1 kHz with the recorder attached and commands at 100 Hz."""
    folder = Path(tempfile.mkdtemp())
    recorder = start("recorder", output=folder / "bag")
    watch.said = {}
    simulator = start("simulator", realtime_priority=priority, wait_for_command="true", **given)
    try:
        recorder.stdout.readline()
        # Only now: the recorder is ready when it has heard all that speak.
        commands = watch.node.create_publisher(Float64MultiArray, f"{NODE}/commands", 10)
        watch.until(lambda: commands.get_subscription_count() >= 2)
        stop = threading.Event()
        message = Float64MultiArray(data=[0.0, 0.0, 0.0])

        def command():
            while not stop.wait(0.01):
                commands.publish(message)

        thread = threading.Thread(target=command)
        thread.start()
        watch.until(lambda: watch.said.get("phase") == "running")
        memory, began = [], (time.monotonic(), processor_s(simulator.pid))
        while time.monotonic() - began[0] < 60.0 * minutes:
            watch.spin(min(5.0, 6.0 * minutes))
            memory.append((time.monotonic() - began[0], memory_kb(simulator.pid)))
        wall = time.monotonic() - began[0]
        used = processor_s(simulator.pid) - began[1]
        stop.set()
        thread.join()
        simulator.send_signal(signal.SIGINT)
        simulator.communicate(timeout=30)
        watch.spin(1.5)
        watch.node.destroy_publisher(commands)
        recorder.send_signal(signal.SIGINT)
        recorder.communicate(timeout=60)
        said = watch.said
        later = [kb for at, kb in memory if at >= min(60.0, wall / 2)]
        ticks, missed = int(said["ticks"]), int(said["ticks_missed"])
        return {
            "scheduling": said["scheduling"],
            "minutes": round(wall / 60.0, 2),
            "ticks": ticks,
            "missed_percent": round(100.0 * missed / (ticks + missed), 4),
            "late_std_us": round(float(said["late_std_us"]), 1),
            "late_max_us": round(float(said["late_max_us"]), 1),
            "step_mean_us": round(float(said["step_mean_us"]), 1),
            "processor_percent_of_a_core": round(100.0 * used / wall, 1),
            "memory_kB": later[-1],
            "memory_growth_after_first_minute_kB": max(later) - later[0],
            "recorded": _lost(folder / "bag"),
        }
    finally:
        for process in (simulator, recorder):
            if process.poll() is None:
                process.kill()
            process.communicate()
        shutil.rmtree(folder, ignore_errors=True)


def free_run(watch, seconds, given):
    """As fast as possible; samples at 50 Hz of simulated time, control at 1 kHz."""
    simulator = start("simulator", real_time_factor=0.0, publish_rate=50, **given)
    watch.said = {}
    try:
        watch.until(lambda: watch.said.get("phase") == "running")
        watch.spin(seconds)
        return {
            "free_run_factor": round(float(watch.said["real_time_factor_now"]), 1),
            "step_mean_us": round(float(watch.said["step_mean_us"]), 2),
        }
    finally:
        simulator.send_signal(signal.SIGINT)
        simulator.communicate(timeout=30)


def _lost(bag):
    from sst_ros.report import recording

    run = recording.read(bag)
    expected = int(run.time_ns[-1] // run.period_ns) + 1
    return f"{len(run.time_ns)} of {expected} samples"


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--minutes", type=float, default=1.0)
    parser.add_argument("--scene", default="example2")
    parser.add_argument("--compiled", action="store_true", help="run under numba")
    parser.add_argument("--priority", type=int, default=20)
    options = parser.parse_args()
    os.environ.setdefault("ROS_DOMAIN_ID", str(101 - os.getpid() % 50))
    os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    given = {"scene": options.scene, "compiled": str(options.compiled).lower()}
    rclpy.init()
    watch = Watch()
    result = {"machine": platform.platform(), "processors": os.cpu_count(), **given}
    for name, priority in (("fifo", options.priority), ("usual", 0)):
        result[name] = keep_time(watch, options.minutes, priority, given)
        print(json.dumps({name: result[name]}, indent=2), flush=True)
    result["free"] = free_run(watch, 10.0, given)
    print(json.dumps(result, indent=2))
    watch.node.destroy_node()
    rclpy.try_shutdown()


if __name__ == "__main__":
    main()
