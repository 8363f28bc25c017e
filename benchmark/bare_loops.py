# SPDX-License-Identifier: Apache-2.0
"""Processor time of the simulator's node, beside loops that only sleep, or sleep and
publish.

# scene swing, compiled, 1 kHz
python -m benchmark.bare_loops [--seconds 20] [--rounds 3]

All keep the deadlines of the node, one after the other, several times in turn, each
with a recorder of its own where messages are published. The loops make and publish the
messages of the node, of one state with a new stamp, look for commands as the node does,
and do nothing else: no program with these topics costs less by rclpy. Each is measured
as the machine is, and where it is asked to let no core sleep (cpu_dma_latency 0).
"""

from __future__ import annotations

import tempfile
import threading
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from contextlib import ExitStack
from multiprocessing import get_context
from pathlib import Path
from statistics import mean, median
from typing import Any

import rclpy

from benchmark.measure import read_options
from benchmark.nodes import Account, Client, Process, start_simulator, wait_for
from sst_ros.nodes import process, topics
from sst_ros.nodes.publications import LOG_NS, TorqueLog, state_messages, time_of
from sst_ros.nodes.sensors import Numbers
from sst_ros.nodes.topics import Reader
from sst_ros.report.results import data_frame, markdown
from sst_ros.runtime import scheduling
from sst_ros.runtime.tick_loop import Pacer, SteadyTime
from sst_ros.simulation.simulation import Simulation
from sst_ros.state import ZERO

TICK_NS = 1_000_000
LOG_TICKS = LOG_NS // TICK_NS
NODE = "the node"
LEAST = "and looks for commands on 2 topics"
LOOPS: dict[str, tuple[int, int, int]] = {
    "sleeps every tick": (1, 0, 0),
    "sleeps every sample": (2, 0, 0),
    "and publishes 3 topics": (2, 3, 0),
    "and publishes 4 topics": (2, 4, 0),
    LEAST: (2, 4, 2),
}
"""Ticks from one deadline to the next, how many topics are published and read."""


def exchange(number: int, read: int) -> Callable[[int], None]:
    """Return a function that reads the first command topics and publishes on the first
    topics.

    It takes the stamp of the sample [ns].
    """
    process.configure_middleware()
    rclpy.init()
    node = rclpy.create_node("sst_simulator")
    names = ("joint_states", "orientation", "euler_zyz", "applied_torques")
    publishers = [topics.SIMULATOR[name].publisher(node, 1000) for name in names]
    inputs = ("commands", "commands_stamped")[:read]
    readers = [Reader(node, topics.SIMULATOR[name]) for name in inputs]
    messages, log = [*state_messages().values()], TorqueLog(TICK_NS)
    (x, y, z, w, *_), joints, torque = Simulation("swing").sample
    numbers = Numbers((x, y, z, w), joints[:9], joints[9:], torque)
    wait_for(
        lambda: all(one.get_subscription_count() for one in publishers),
        "recorder",
        60.0,
    )

    def publish(stamp_ns: int) -> None:
        for reader in readers:
            reader.read(stamp_ns)
        if number > 3:
            log.append(ZERO, ZERO, 2)
            if len(log) == LOG_TICKS:
                publishers[3].publish(log.take(stamp_ns))
        stamp = time_of(stamp_ns)
        for publisher, message in zip(publishers, messages, strict=False):
            publisher.publish(message.fill(stamp, numbers))

    return publish


def run_loop(name: str, seconds: float, latency_us: int) -> dict[str, float]:
    """Run a loop in this process: time on a core [%], deadlines missed [%]."""
    latency = scheduling.CpuDmaLatency()
    latency.request(latency_us)
    ticks, number, read = LOOPS[name]
    publish = exchange(number, read) if number else None
    time.sleep(1.0)  # until discovery is quiet
    scheduling.schedule(20, threading.get_native_id())
    scheduling.quiet()
    missed, step_ns, used = 0, ticks * TICK_NS, time.process_time()
    began = deadline = time.monotonic_ns()
    while deadline < began + seconds * 1e9:
        deadline += step_ns
        if (left := deadline - time.monotonic_ns()) > 0:
            time.sleep(left / 1e9)
        late = time.monotonic_ns() - deadline
        if late >= TICK_NS:
            missed += late // TICK_NS
            deadline += late // TICK_NS * TICK_NS
        if publish is not None:
            publish(deadline)
    wall_ns, used = time.monotonic_ns() - began, time.process_time() - used
    return {
        "processor": 1e11 * used / wall_ns,
        "missed": 100.0 * missed * TICK_NS / wall_ns,
    }


class Beside:
    """A loop in a process of its own that only sleeps to the deadlines of the node's
    samples.

    What it misses beside the node, at the same priority and by the same rule, is the
    machine's.
    """

    def __init__(self, priority: int) -> None:
        own = get_context("spawn")
        self._counts = own.RawArray("q", 3)
        self._ends = own.Event()
        given = (self._counts, self._ends, priority)
        self._process = own.Process(target=_only_sleep, args=given, daemon=True)

    def __enter__(self) -> Beside:
        self._process.start()
        wait_for(lambda: self._counts[0], "loop beside the node", 60.0)
        return self

    def __exit__(self, *_: object) -> None:
        self._ends.set()
        self._process.join()

    @property
    def counts(self) -> tuple[int, int]:
        """Ticks kept and missed since its start."""
        return self._counts[0], self._counts[1]

    @property
    def latest_us(self) -> float:
        """Largest lateness since its start [us]."""
        return float(self._counts[2]) / 1000.0


def _only_sleep(counts: Any, ends: Any, priority: int) -> None:
    pacer, ticks = Pacer(TICK_NS, 1.0, SteadyTime()), LOOPS["sleeps every sample"][0]
    scheduling.schedule(priority, threading.get_native_id())
    scheduling.quiet()
    pacer.start()
    while not ends.is_set():
        pacer.wait(lambda: False, ticks)
        counts[0] += ticks
        counts[1] = pacer.missed
        counts[2] = max(counts[2], pacer.late_ns)


def measure(
    watch: Client, name: str, seconds: float, latency_us: int = -1
) -> dict[str, float]:
    """Measure a loop, or the node, in its own process, with this cpu_dma_latency."""
    with ExitStack() as stack:
        folder = Path(
            stack.enter_context(tempfile.TemporaryDirectory(ignore_cleanup_errors=True))
        )
        stack.callback(Process("recorder", output=folder / "bag").end)
        if name != NODE:
            with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as process:
                return process.submit(run_loop, name, seconds, latency_us).result()
        full = "/sst_simulator"
        watch.values.clear()
        simulator = start_simulator(scene="swing", cpu_dma_latency=latency_us)
        try:
            watch.wait_for_runs(full)
            watch.spin(2.5)
            account = Account(watch, {full: simulator})
            watch.spin(seconds)
            return {"processor": account.busy(), "missed": account.missed()[full]}
        finally:
            simulator.end()
            watch.spin(1.5)  # until its last diagnostics have come


def compare(watch: Client, seconds: float, rounds: int) -> str:
    """Measure all in turn.

    Markdown, a row for each, a table for each cpu_dma_latency.
    """
    settings = {-1: "no limit of the exit latency, the default"}
    table_text = scheduling.CpuDmaLatency().request(0)
    if scheduling.NO_LIMIT not in table_text:
        settings[0] = "`cpu_dma_latency` 0"
    medians: dict[tuple[int, str], list[dict[str, float]]] = {
        (latency_us, name): [] for name in (NODE, *LOOPS) for latency_us in settings
    }
    for _ in range(rounds):
        for (latency_us, name), runs in medians.items():
            runs.append(measure(watch, name, seconds, latency_us))
    tables = []
    for latency_us, title in settings.items():
        least = [run["processor"] for run in medians[latency_us, LEAST]]
        rows = []
        for name in (NODE, *LOOPS):
            runs = medians[latency_us, name]
            used = [run["processor"] for run in runs]
            ratio = median(a / b for a, b in zip(used, least, strict=True))
            row = {
                title: name,
                "processor [% of a core]": f"{median(used):.1f}",
                "of each run": ", ".join(f"{one:.1f}" for one in used),
                "times the least": f"{ratio:.2f}",
                "missed [%]": f"{mean(run['missed'] for run in runs):.3f}",
            }
            rows.append(row)
        tables.append(markdown(data_frame(rows)))
    if 0 not in settings:
        tables.append(f"With `cpu_dma_latency` 0: {table_text}.")
    return "\n\n".join(tables)


def main() -> None:
    options = read_options("bare_loops", __doc__, seconds=20.0, rounds=3)
    with Client.start() as watch:
        print(compare(watch, options.seconds, options.rounds))


if __name__ == "__main__":
    main()
