# SPDX-License-Identifier: Apache-2.0
"""Runs recorded by the nodes, on a machine that is kept busy: is each of them whole?

python -m benchmark.recorded_runs [--runs 20] [--crowds 3] [--busy 2]

Runs with the sensors and all topics, in turn by the clock and in lockstep, then crowds:
a recorder, two lockstep simulators and two controllers in namespaces, all started at
once. In lockstep it is `reach` under the controller, by the clock `swing` without one:
where a controller gets no processor for tenths of a second, the run may end in a fault.
Beside them so many processes keep the processors busy. A run is whole if no node fails,
and its bag has every sample and every tick, once, with all its topics. In lockstep all
runs have the same bits. Else the status is 1.
"""

from __future__ import annotations

import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.rosbag2 import Reader

from benchmark.measure import describe_machine, join_line, read_options
from benchmark.nodes import Process, own_domain, start_simulator
from sst_ros.recording import recording
from sst_ros.runtime.settings import default_topics

SCENES = {"lockstep": "reach", "free": "swing"}
SECONDS, RATE, TICKS_A_SAMPLE = 1.5, 500, 2
SAMPLES = round(SECONDS * RATE) + 1
BUSY = "while True: pass"
TIMEOUT_S = 300.0
"""Longest wait for a process: five of them start on a machine with others."""
NAMESPACES = ("/left", "/right")
AWAITED = (
    "joint_states",
    *(f"~/{name}" for name in ("orientation", "euler_zyz", "applied_torques")),
    *("~/imu", "~/reaction"),
)
SENSORS = ("imu", "reaction")
"""Their messages are counted one by one: reading a run does not need them."""


@contextmanager
def busy(number: int) -> Iterator[None]:
    """Keep so many processors busy."""
    with ExitStack() as stack:
        for _ in range(number):
            process = Process(BUSY, python=True)
            stack.callback(process.wait)
            stack.callback(process.kill)
        yield


def _simulator(namespace: str, sync: str, stderr: int) -> Process:
    return start_simulator(
        namespace,
        stderr=stderr,
        scene=SCENES[sync],
        duration=SECONDS,
        sync=sync,
        publish_rate=RATE,
        lockstep_timeout=TIMEOUT_S,
        wait_for_subscribers=f"[{','.join(AWAITED)}]",
        subscriber_timeout=TIMEOUT_S,
        imu=True,
        reaction="prismatic_1",
    )


def _controller(namespace: str, stderr: int) -> Process:
    return Process(
        "inverse_dynamics",
        namespace,
        stderr=stderr,
        scene=SCENES["lockstep"],
        stamped=True,
        mode="feedforward_pd",
        feedforward_at="middle",
        min_subscribers=2,
        timeout=TIMEOUT_S,
        wait_for_recorder=True,
        hold=10.0,
    )


def record(folder: Path, namespaces: tuple[str, ...], sync: str) -> list[str]:
    """Record one run in each namespace, all nodes of which start at once.

    Returns what went wrong.
    """
    topics = [
        topic if topic == "/diagnostics" else f"{namespace}{topic}"
        for namespace in namespaces
        for topic in default_topics()
    ]
    listed = f"[{','.join(dict.fromkeys(topics))}]"
    faults = []
    with (folder.parent / f"{folder.name}.err").open("w+") as errors:
        stderr = errors.fileno()
        recorder = Process(
            "recorder", stderr=stderr, output=folder, topics=listed, timeout=TIMEOUT_S
        )
        nodes = {}
        for namespace in namespaces:
            nodes[f"{namespace} simulator"] = _simulator(namespace, sync, stderr)
            if sync == "lockstep":
                nodes[f"{namespace} controller"] = _controller(namespace, stderr)
        deadline = time.monotonic() + TIMEOUT_S
        for name, process in nodes.items():
            status = _wait(process, max(1.0, deadline - time.monotonic()))
            if status != 0:
                faults.append(f"{name.strip()} ended with status {status}")
        status, _ = recorder.end()
        if status != 0:
            faults.append(f"recorder ended with status {status}")
        if faults:
            errors.seek(0)
            faults += [line.strip() for line in errors if "[INFO]" not in line][-4:]
    return faults


def _wait(process: Process, seconds: float) -> int:
    """Wait for the end of a process, end it after the time; return its status."""
    deadline = time.monotonic() + seconds
    while process.poll() is None and time.monotonic() < deadline:
        time.sleep(0.1)
    if process.poll() is None:
        process.end(timeout=10.0)
        return 255
    return process.wait()


def examine(run: recording.Recording, sync: str) -> Iterator[str]:
    """Yield what a recorded run lacks."""
    if len(run.time_ns) != SAMPLES:
        yield f"{len(run.time_ns)} of {SAMPLES} samples"
    apart = np.diff(run.time_ns)
    if sync == "lockstep" and np.any(apart != apart[0]):
        yield f"periods of {np.unique(apart).tolist()} ns"
    if np.any(apart <= 0):
        yield "stamps that do not rise"
    ticks = (SAMPLES - 1) * TICKS_A_SAMPLE
    if len(run.ticks.end_ns) != ticks or run.ticks.gaps:
        yield f"{len(run.ticks.end_ns)} of {ticks} ticks, {run.ticks.gaps} gaps"
    if np.isnan(run.quaternion).any() or np.isnan(run.euler).any():
        yield "samples without orientation"
    if sync == "lockstep" and len(run.commands.received_ns) < SAMPLES - 1:
        yield f"{len(run.commands.received_ns)} of {SAMPLES - 1} commands"


def count_readings(folder: Path, namespace: str) -> Iterator[str]:
    """Yield the sensors that do not have a message for each sample."""
    with Reader(folder) as reader:
        counts = {each.topic: each.msgcount for each in reader.connections}
    for sensor in SENSORS:
        topic = f"{namespace}/sst_simulator/{sensor}"
        count = counts.get(topic, 0)
        if count != SAMPLES:
            yield f"{count} of {SAMPLES} messages of {topic}"


def check(
    folder: Path, namespaces: tuple[str, ...], sync: str
) -> tuple[list[str], Any]:
    """Record, read and examine a run in each namespace.

    Returns what went wrong, and gamma of the first.
    """
    faults, gammas = record(folder, namespaces, sync), []
    for namespace in namespaces:
        named = namespace or None
        try:
            run = recording.read(folder, namespace=named)
        except Exception as error:
            faults.append(f"{namespace} {error}".strip())
            continue
        faults += [f"{namespace} {lack}".strip() for lack in examine(run, sync)]
        faults += count_readings(folder, namespace)
        gammas.append(run.gamma.tobytes())
    if len(set(gammas)) > 1:
        faults.append("the runs of the namespaces differ")
    return faults, gammas[0] if gammas else None


def main() -> None:
    options = read_options("recorded_runs", __doc__, runs=20, crowds=3, busy=2)
    plan = [("", ("free", "lockstep")[k % 2]) for k in range(options.runs)]
    plan += [("crowd", "lockstep")] * options.crowds
    failed, bits = 0, set()
    with own_domain(), busy(options.busy), tempfile.TemporaryDirectory() as name:
        for number, (kind, sync) in enumerate(plan, start=1):
            namespaces = NAMESPACES if kind else ("",)
            began = time.monotonic()
            folder = Path(name) / str(number)
            faults, gamma = check(folder, namespaces, sync)
            if sync == "lockstep" and gamma is not None:
                bits.add(gamma)
            failed += bool(faults)
            said = "; ".join(faults) or "whole"
            took = time.monotonic() - began
            print(
                f"{number:3d} {kind or 'run':5} {sync:8} {took:6.1f} s  {said}",
                flush=True,
            )
    print(
        f"{len(plan) - failed} of {len(plan)} whole;"
        f" {len(bits)} kinds of bits in lockstep"
    )
    print(join_line(describe_machine("rclpy", "ros-rmw-fastrtps-cpp")))
    sys.exit(failed > 0 or len(bits) > 1)


if __name__ == "__main__":
    main()
