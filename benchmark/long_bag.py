# SPDX-License-Identifier: Apache-2.0
"""The report of a long run: time and memory of `report run` for ten minutes at 500 Hz.

# --bag: is kept there, used if it exists
python -m benchmark.long_bag [--seconds 600] [--bag FOLDER]

The bag is a true run: Example 2 with springs and friction in its actuators, so that it
stays inside for ever, solved by single steps at 1 kHz. Its messages are made by the
code of the nodes.
"""

from __future__ import annotations

import dataclasses
import json
import math
import resource
import subprocess
import sys
import tempfile
import time
from array import array
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from std_msgs.msg import Float64MultiArray, String

from benchmark.measure import describe_machine, join_line, read_options
from sst_ros.dynamics import kernel
from sst_ros.dynamics.initial_state import initial_state
from sst_ros.mechanism.geometry import Array, Geometry
from sst_ros.nodes.publications import TorqueLog, state_messages, time_of
from sst_ros.nodes.sensors import Numbers
from sst_ros.progress import slices
from sst_ros.recording.bag_reader import message_types
from sst_ros.recording.bag_writer import BagWriter
from sst_ros.report.reference import TickStepper
from sst_ros.scene import scene as scenes
from sst_ros.scene import yaml_document
from sst_ros.scene.loads import Friction, JointFriction, Spring
from sst_ros.scene.scene import Scene
from sst_ros.state import ZERO

AT_MOST_S, AT_MOST_GB = 60.0, 1.5
START_NS, TICK_NS, TICKS_A_SAMPLE = 1_700_000_000_000_000_000, 1_000_000, 2
SAMPLE_NS = TICKS_A_SAMPLE * TICK_NS
SENT_NS, ANSWER_NS = 150_000, 400_000
"""Receptions of a sample, and of the command answering it, after the sample's stamp."""

STORE = message_types()
TOPICS = {
    "/sst_simulator/scene": "std_msgs/msg/String",
    "/joint_states": "sensor_msgs/msg/JointState",
    "/sst_simulator/orientation": "geometry_msgs/msg/QuaternionStamped",
    "/sst_simulator/euler_zyz": "geometry_msgs/msg/Vector3Stamped",
    "/sst_simulator/applied_torques": "trajectory_msgs/msg/JointTrajectory",
    "/sst_simulator/commands": "std_msgs/msg/Float64MultiArray",
}
_CHUNK = 5000
SHOWN = (
    *("samples_recorded", "ticks_recorded", "samples_compared"),
    *("integration_error_gamma_rad", "integration_reference_error_gamma_rad"),
)
"""Of the report's summary."""


def endless() -> Scene:
    """Return a scene whose motion goes on inside for ever."""
    example = scenes.load("example2_heavy")
    springs = tuple(
        Spring(joint=f"gamma_{k}", stiffness=40.0, rest=math.pi / 4) for k in (1, 2, 3)
    )
    friction = JointFriction(gamma=Friction(viscous=1.0))
    return dataclasses.replace(
        example, name="endless", springs=springs, friction=friction, duration=None
    )


def write(path: Path, seconds: float, *, shown: bool = False) -> Path:
    """Write the bag of a run of the endless scene; its folder must not exist."""
    scene, samples = endless(), round(seconds * 1e9 / SAMPLE_NS)
    writer, log = BagWriter(path), TorqueLog(TICK_NS)
    states = state_messages()
    topics = {
        "joint_states": "/joint_states",
        "orientation": "/sst_simulator/orientation",
        "euler_zyz": "/sst_simulator/euler_zyz",
    }
    connections = {topic: writer.connect(topic, kind)
                   for topic, kind in TOPICS.items()}  # fmt: skip

    def send(topic: str, received_ns: int, message: Any) -> None:
        data = STORE.serialize_cdr(_of_rosbags(message), TOPICS[topic])
        writer.write(connections[topic], received_ns, bytes(data))

    text = String(data=yaml_document.dump(scene))
    send("/sst_simulator/scene", START_NS, text)
    for rows, *arrays in _run(scene, samples, shown):
        columns = zip(
            range(rows.start, rows.stop), *(a.tolist() for a in arrays), strict=True
        )
        for number, y, joints, torque in columns:
            at_ns = START_NS + number * SAMPLE_NS
            received_ns = at_ns + SENT_NS
            if number:  # a start has no torques before it
                asked_ns = at_ns - SAMPLE_NS
                command = Float64MultiArray(data=torque)
                send("/sst_simulator/commands", asked_ns + ANSWER_NS, command)
                log.append(torque, (), TICKS_A_SAMPLE)
                applied = log.take(asked_ns)
                send("/sst_simulator/applied_torques", received_ns, applied)
            acted = torque if number else ZERO
            numbers = Numbers(y[:4], joints[:9], joints[9:], acted)
            for key, topic in topics.items():
                message = states[key].fill(time_of(at_ns), numbers)
                send(topic, received_ns, message)
    writer.close()
    return path


def _of_rosbags(value: Any) -> Any:
    """Turn a message of rclpy into one of rosbags, which writes no bytes behind its
    end.

    `rclpy.serialization` does, for sequences of messages; `publish` does not.
    """
    if isinstance(value, array):
        return np.array(value)
    if isinstance(value, list) and value and not isinstance(value[0], str):
        return [_of_rosbags(entry) for entry in value]
    if not hasattr(value, "get_fields_and_field_types"):
        return value
    package = type(value).__module__.partition(".")[0]
    kind = STORE.types[f"{package}/msg/{type(value).__name__}"]
    names = value.get_fields_and_field_types()
    return kind(**{name: _of_rosbags(getattr(value, name)) for name in names})


def _run(
    scene: Scene, samples: int, shown: bool
) -> Iterator[tuple[slice, Array, Array, Array]]:
    """Solve the scene.

    Yield rows of samples in turn: quaternions, joints, and torques before.
    """
    torque = scene.torque
    assert torque is not None
    motion = TickStepper(scene, None)
    y = np.array(initial_state(scene, Geometry.of(scene)))
    for rows in slices(samples + 1, _CHUNK, "writing a run", shown):
        # Each sample is answered by a torque, which is held until the next one.
        answered = (
            np.maximum(np.arange(rows.start, rows.stop) - 1, 0)[:, None]
            * SAMPLE_NS
            / 1e9
        )
        held = torque.amplitude * np.sin(torque.frequency * answered + torque.phase)
        ticks = np.arange(
            (rows.start - 1) * TICKS_A_SAMPLE, (rows.stop - 1) * TICKS_A_SAMPLE
        )
        run = ticks >= 0
        start = ticks[run] * TICK_NS
        drives = np.repeat(held, TICKS_A_SAMPLE, axis=0)[run]
        reached = motion.follow((start, start + TICK_NS, drives), y)[:, 0, :-1]
        state = reached[TICKS_A_SAMPLE - 1 :: TICKS_A_SAMPLE]
        if not rows.start:
            state = np.vstack([y, state])
        y = state[-1]
        joints = kernel.joints(motion.dynamics.model, tuple(state.T))
        yield rows, state[:, :4], np.vstack([*joints]).T, held


def main(arguments: list[str] | None = None) -> int:
    """Write the bag, report it, print what that took and the verdict.

    The exit status is 0.
    """
    options = read_options("long_bag", __doc__, arguments, seconds=600.0, bag=Path)
    with tempfile.TemporaryDirectory() as folder:
        bag = options.bag or Path(folder) / "bag"
        if not bag.exists():
            write(bag, options.seconds, shown=True)
        size = sum(file.stat().st_size for file in bag.iterdir()) / 1e9
        words = [
            "-m",
            "sst_ros",
            "report",
            "run",
            str(bag),
            "--out",
            str(Path(folder) / "report"),
        ]
        began = time.perf_counter()
        subprocess.run([sys.executable, *words], check=True, stdout=subprocess.DEVNULL)
        wall, used = (
            time.perf_counter() - began,
            resource.getrusage(resource.RUSAGE_CHILDREN),
        )
        busy, memory = used.ru_utime + used.ru_stime, used.ru_maxrss * 1024 / 1e9
        summary = json.loads(
            (Path(folder) / "report" / "summary.json").read_text(encoding="utf-8")
        )
    recording = {"bag_GB": size, "wall_s": wall, "processor_s": busy, "peak_GB": memory}
    recording |= {name: summary[name] for name in SHOWN}
    for name, value in recording.items():
        print(
            f"{name:40} {value:.4g}"
            if isinstance(value, float)
            else f"{name:40} {value}"
        )
    good = wall < AT_MOST_S and memory < AT_MOST_GB
    print(
        f"{'met' if good else 'NOT MET'}: under {AT_MOST_S:g} s and {AT_MOST_GB:g} GB"
    )
    print(join_line(describe_machine("numpy", "llvmlite", "rosbags", "matplotlib")))
    return 0


if __name__ == "__main__":
    sys.exit(main())
