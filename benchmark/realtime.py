# SPDX-License-Identifier: Apache-2.0
"""How well the simulator keeps time: missed ticks, processor, memory.

And its fastest speed.

# the official figures, on an idle machine; namespaced simulators side by side
python -m benchmark.realtime --minutes 10 --write
python -m benchmark.realtime --fleet 10 --rate 200

Simulator and recorder run for so long with SCHED_FIFO, half as long with
cpu_dma_latency 0 as well, and as long with neither; in the same minutes a loop that
only sleeps to the same deadlines, in a process of its own at the same priority,
measures what the machine itself misses. Then the simulator runs as fast as possible,
without and with a subscriber to joint_states, then a fleet. Commands of zero torque
come at 100 Hz.

--minutes is that of each run at 1 kHz (0: none), --usual that of the two others;
--rounds and --seconds those beside the bare loops (0 rounds: none); --fleet measures
only so many at once, at --rate [Hz]; --plain runs no machine code.
"""

from __future__ import annotations

import argparse
import shutil
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray

from benchmark import bare_loops
from benchmark.bare_loops import Beside
from benchmark.measure import (
    DOCS,
    describe_machine,
    fill_page,
    format_columns,
    join_line,
    read_options,
)
from benchmark.nodes import Account, Client, Process, start_simulator
from sst_ros.nodes.topics import NeverSpun

TITLES = {
    "kept": "1 kHz, 500 samples a second, recorder attached",
    "loops": "Processor time beside bare loops",
    "free": "As fast as possible, 1 kHz control, no recorder",
    "fleet": "Namespaced simulators side by side",
}
"""Parts of the page."""

MISSED, RATIO = "missed ticks [%]", "missed ticks, times those of the loop"
BLOCKS = 20
"""Of a run: their scatter is the error of the ratio of missed ticks."""
PAGE = DOCS / "realtime.md"
Figures = dict[str, str]


@contextmanager
def command(watch: Client, topic: str, readers: int) -> Iterator[None]:
    """Publish zero torques at 100 Hz to a simulator, and perhaps a recorder."""
    commands = watch.node.create_publisher(Float64MultiArray, topic, 10)
    watch.wait_for(
        lambda: commands.get_subscription_count() >= readers, f"readers of {topic}"
    )
    stop, message = threading.Event(), Float64MultiArray(data=[0.0, 0.0, 0.0])

    def publish() -> None:
        while not stop.wait(0.01):
            commands.publish(message)

    thread = threading.Thread(target=publish)
    thread.start()
    try:
        yield
    finally:
        stop.set()
        thread.join()
        watch.node.destroy_publisher(commands)


def keep_time(watch: Client, minutes: float, given: dict[str, Any]) -> Figures:
    """1 kHz with the recorder attached."""
    name, folder = "/sst_simulator", Path(tempfile.mkdtemp())
    watch.values.clear()
    with ExitStack() as stack:
        stack.callback(shutil.rmtree, folder, ignore_errors=True)
        recorder = Process("recorder", output=folder / "bag")
        stack.callback(recorder.end)
        simulator = start_simulator(wait_for_command=True, **given)
        stack.callback(simulator.end)
        recorder.line()  # it is ready when it has heard all that speak
        memory: list[tuple[float, int]] = []
        counts: list[tuple[int, int, int, int]] = []

        def count() -> None:
            said = watch.values[name]
            counts.append((int(said["ticks"]), int(said["ticks_missed"]), *loop.counts))

        with command(watch, f"{name}/commands", readers=2):
            watch.wait_for_runs(name)
            with Beside(int(given["realtime_priority"])) as loop:
                watch.spin(3.0)  # until all have begun
                count()
                began, used = time.monotonic(), simulator.processor_s()
                while (passed := time.monotonic() - began) < 60.0 * minutes:
                    watch.spin(60.0 * minutes / BLOCKS)
                    count()
                    memory.append((passed, simulator.memory_kb()))
                wall, used = time.monotonic() - began, simulator.processor_s() - used
        simulator.end()
        watch.spin(1.5)
        recorder.end()
        said = watch.values[name]
        return {
            "scheduling": said["scheduling"],
            "cpu_dma_latency": said["cpu_dma_latency"],
            "length [min]": f"{wall / 60.0:.1f}",
            **_compare(np.diff(counts, axis=0)),
            "lateness, mean [us]": f"{float(said['late_mean_us']):.0f}",
            "lateness, standard deviation [us]": f"{float(said['late_std_us']):.0f}",
            "lateness, largest [us]": f"{float(said['late_max_us']):.0f}",
            "largest of the loop [us]": f"{loop.latest_us:.0f}",
            "processor [% of a core]": f"{100.0 * used / wall:.1f}",
            "mean step [us]": f"{float(said['step_mean_us']):.1f}",
            "memory [MB]": f"{memory[-1][1] / 1024.0:.0f}",
            "its growth after the first minute [MB]": _growth(memory, wall),
            "recorded": _count_recorded(folder / "bag"),
        }


def free_run(
    watch: Client,
    seconds: float,
    publish_rate: int,
    given: dict[str, Any],
    *,
    read: bool,
) -> Figures:
    """As fast as possible, without a recorder, and without or with a reader of
    joint_states.
    """
    name = "/sst_simulator"
    watch.values.clear()
    topic = "joint_states" if read else "unpublished"
    reader = watch.node.create_subscription(
        JointState, topic, print, qos_profile_sensor_data, callback_group=NeverSpun()
    )
    simulator = start_simulator(
        real_time_factor=0.0, publish_rate=publish_rate, **given
    )
    try:
        watch.wait_for_runs(name)
        watch.spin(seconds)
        said = watch.values[name]
        return {
            "publish_rate [Hz]": str(publish_rate),
            "joint_states": "read" if read else "not read",
            "real-time factor": f"{float(said['real_time_factor_now']):.0f}",
            "mean step [us]": f"{float(said['step_mean_us']):.2f}",
        }
    finally:
        watch.node.destroy_subscription(reader)
        simulator.end()
        watch.spin(1.5)  # its last diagnostics are not those of the next run


def fleet(
    watch: Client, number: int, rate: int, seconds: float, given: dict[str, Any]
) -> Figures:
    """Namespaced simulators side by side, each publishing at its rate."""
    names = [f"/sst_{k}/sst_simulator" for k in range(number)]
    watch.values.clear()
    nodes = [
        start_simulator(name.rpartition("/")[0], rate=rate, publish_rate=rate, **given)
        for name in names
    ]
    try:
        watch.wait_for_runs(*names)
        watch.spin(5.0)  # until all have found each other
        account = Account(watch, dict(zip(names, nodes, strict=True)))
        watch.spin(seconds)
        missed, busy = account.missed(), account.busy()
        return {
            "simulators": str(number),
            "rate [Hz]": str(rate),
            "scheduling": watch.values[names[0]]["scheduling"],
            "length [min]": f"{seconds / 60.0:.1f}",
            "missed ticks, all [%]": f"{missed.pop(''):.3f}",
            "missed ticks, worst of them [%]": f"{max(missed.values()):.3f}",
            "processor, all [% of a core]": f"{busy:.0f}",
        }
    finally:
        for node in nodes:
            node.end()


def _compare(blocks: np.ndarray) -> Figures:
    """Missed ticks of the node and of the loop beside it, of rows with ticks and missed
    of both.

    The standard error of their ratio is that of the jackknife over the rows.
    """
    ticks, missed, kept, lost = blocks.sum(axis=0)
    found = {
        MISSED: f"{100.0 * missed / (ticks + missed):.4f}",
        "of ticks": str(ticks + missed),
        "a loop that only sleeps, beside it: missed [%]": (
            f"{100.0 * lost / (kept + lost):.4f}"
        ),
    }
    others = blocks.sum(axis=0) - blocks
    if not others[:, 3].all():
        return {**found, RATIO: "the loop missed too few"}
    ratios = others[:, 1] / others[:, 3]
    error = np.sqrt((len(blocks) - 1) * ratios.var())
    return {**found, RATIO: f"{missed / lost:.2f} +- {error:.2f}"}


def _growth(memory: list[tuple[float, int]], wall: float) -> str:
    later = [kb for at, kb in memory if at >= min(60.0, wall / 2.0)]
    return f"{(max(later) - later[0]) / 1024.0:.2f}"


def _count_recorded(bag: Path) -> str:
    from sst_ros.recording import recording

    run = recording.read(bag)
    # The last sample is where the run was stopped, perhaps before its time.
    expected = -int((run.time_ns[0] - run.time_ns[-1]) // run.period_ns) + 1
    return f"{len(run.time_ns)} of {expected} samples"


def main() -> None:
    of_runs: dict[str, Any] = {
        "minutes": 1.0,
        "usual": float,
        "rounds": 3,
        "seconds": 20.0,
    }
    of_nodes = {"scene": "example2_heavy", "priority": 20, "fleet": 0, "rate": 200}
    options = read_options(
        "realtime", __doc__, None, **of_runs, **of_nodes, write=False
    )
    given = {"scene": options.scene, "realtime_priority": options.priority}
    with Client.start() as watch:
        parts = dict(_measure(watch, options, given))
    if options.write:
        none = dict.fromkeys(TITLES, "not measured")
        fill_page(PAGE, none | parts)


def _measure(
    watch: Client, options: argparse.Namespace, given: dict[str, Any]
) -> Iterator[tuple[str, str]]:
    """Yield the parts of the page by name, and print each."""

    def show(name: str, text: str) -> tuple[str, str]:
        print(f"## {TITLES[name]}\n\n{text}", end="\n\n", flush=True)
        return name, text

    if not options.fleet:
        if options.minutes:
            usual = options.usual or options.minutes / 2.0
            kept = [
                {"": name, **keep_time(watch, minutes, {**given, **more})}
                for name, minutes, more in (
                    ("SCHED_FIFO", options.minutes, {}),
                    ("and `cpu_dma_latency` 0", usual, {"cpu_dma_latency": 0}),
                    ("neither", usual, {"realtime_priority": 0}),
                )
            ]
            yield show("kept", format_columns(kept))
        if options.rounds:
            costs = bare_loops.compare(watch, options.seconds, options.rounds)
            yield show("loops", costs)
        seconds = min(60.0 * options.minutes, 8.0) or 8.0
        runs = [
            {"": f"run {k + 1}", **free_run(watch, seconds, rate, given, read=read)}
            for k, (rate, read) in enumerate(
                ((1000, True), (1000, False), (500, True), (500, False), (50, True))
            )
        ]
        yield show("free", format_columns(runs))
    number = options.fleet or (10 if options.minutes else 0)
    if number:
        seconds = min(60.0 * options.minutes, 60.0) or 20.0
        found = fleet(watch, number, options.rate, seconds, given)
        yield show("fleet", format_columns([{"": "fleet", **found}]))
    packages = ("rclpy", "llvmlite", "numpy", "ros-rclpy", "ros-rmw-fastrtps-cpp")
    said = f"Scene {options.scene}. {join_line(describe_machine(*packages))}."
    print(said, flush=True)
    yield "machine", said


if __name__ == "__main__":
    main()
