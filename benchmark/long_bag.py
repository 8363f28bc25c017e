# SPDX-License-Identifier: Apache-2.0
"""The report of a long run: time and memory of `report run` for ten minutes at 500 Hz.

python -m benchmark.long_bag [--seconds 600] [--bag FOLDER] [--json FILE]

The bag is a true run: Example 2 with springs and friction in its actuators, so that it stays inside
for ever, solved by single steps at 1 kHz. Every message is what the nodes would send, made by
writing numbers into the bytes of one.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import math
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from benchmark.measure import describe_machine, join_line, write_json
from sst_ros.host.output import slices
from sst_ros.integration.propagator import TickPropagator, TickSequence
from sst_ros.mechanism.frames import rotation_matrix, zyz_angles
from sst_ros.mechanism.geometry import Array
from sst_ros.recording.topic_tables import JOINTS
from sst_ros.report.states import initial, joint_columns
from sst_ros.scene import scene as scenes
from sst_ros.scene import yaml_document
from sst_ros.scene.loads import Friction, JointFriction, Spring
from sst_ros.scene.scene import Scene

AT_MOST_S, AT_MOST_GB = 60.0, 1.5
START_NS, TICK_NS, TICKS_A_SAMPLE = 1_700_000_000_000_000_000, 1_000_000, 2
SENT_NS, ANSWER_NS = 150_000, 400_000
"""Receptions of a sample, and of the command that answers it, after the sample's stamp."""

STORE = get_typestore(Stores.ROS2_KILTED)

_CHUNK = 5000
_MARK = 1.2345678901234567e300


def endless() -> Scene:
    """Return a scene whose motion goes on inside for ever."""
    example = scenes.load("example2_heavy")
    springs = tuple(Spring(joint=f"gamma_{k}", stiffness=40.0, rest=math.pi / 4) for k in (1, 2, 3))
    friction = JointFriction(gamma=Friction(viscous=1.0))
    return dataclasses.replace(
        example, name="endless", springs=springs, friction=friction, duration=None
    )


def write(path: Path, seconds: float, *, shown: bool = False) -> Path:
    """Write the bag of a run of the endless scene; its folder must not exist."""
    scene, samples = endless(), round(seconds * 1e9 / TICK_NS / TICKS_A_SAMPLE)
    kinds = _messages()
    with Writer(path, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        connections = {
            topic: writer.add_connection(topic, message.__msgtype__, typestore=STORE)
            for topic, message in kinds.items()
        }
        raw = {t: bytes(STORE.serialize_cdr(m, m.__msgtype__)) for t, m in kinds.items()}
        text = _make("std_msgs/String", data=yaml_document.dump(scene))
        connection = writer.add_connection(
            "/sst_simulator/scene", text.__msgtype__, typestore=STORE
        )
        writer.write(connection, START_NS, STORE.serialize_cdr(text, text.__msgtype__))
        for rows, run in _run(scene, samples, shown):
            stamps = START_NS + np.arange(rows.start, rows.stop) * TICK_NS * TICKS_A_SAMPLE
            before = stamps - TICK_NS * TICKS_A_SAMPLE
            numbers = {
                "/joint_states": (stamps, run["joints"]),
                "/sst_simulator/orientation": (stamps, run["quaternion"]),
                "/sst_simulator/euler_zyz": (stamps, run["euler"]),
                "/sst_simulator/applied_torques": (before, run["torque"]),
                "/sst_simulator/commands": (None, run["torque"][:, -3:]),
            }
            first = int(rows.start == 0)  # a start has no torques before it
            patched = {t: _patched(raw[t], *numbers[t]) for t in numbers}
            for k, stamp in enumerate(stamps.tolist()):
                for topic, connection in connections.items():
                    if k >= first or topic.endswith(("states", "orientation", "zyz")):
                        late = ANSWER_NS - 2 * TICK_NS if topic.endswith("commands") else SENT_NS
                        writer.write(connection, stamp + late, patched[topic][k].tobytes())
    return path


def _run(scene: Scene, samples: int, shown: bool) -> Iterator[tuple[slice, dict[str, Array]]]:
    """Solve the scene; yield rows of samples in turn, and what the messages of each hold."""
    torque = scene.torque
    assert torque is not None
    motion = TickPropagator(scene, None, compiled=True)
    y = np.array(initial(scene))
    for rows in slices(samples + 1, _CHUNK, "writing a run", shown):
        number = np.arange(rows.start, rows.stop)
        # Each sample is answered by a torque, which is held until the next one.
        answered = np.maximum(number - 1, 0)[:, None] * (TICKS_A_SAMPLE * TICK_NS / 1e9)
        held = torque.amplitude * np.sin(torque.frequency * answered + torque.phase)
        ticks = np.arange((rows.start - 1) * TICKS_A_SAMPLE, (rows.stop - 1) * TICKS_A_SAMPLE)
        run = ticks >= 0
        start = ticks[run] * TICK_NS
        ticks_of_part = TickSequence(
            start, start + TICK_NS, np.repeat(held, TICKS_A_SAMPLE, axis=0)[run]
        )
        starts = np.full((len(start), len(y)), np.nan)
        starts[:1] = y
        reached = motion.follow(ticks_of_part, starts)[:, 0, :-1]
        state = reached[TICKS_A_SAMPLE - 1 :: TICKS_A_SAMPLE]
        if not rows.start:
            state = np.vstack([y, state])
        y = state[-1]
        angles = joint_columns(motion.dynamics.model, state)
        effort = np.zeros((len(state), 9))
        effort[:, :3] = held * (number > 0)[:, None]
        numbers = {"joints": np.hstack([angles, effort]), "quaternion": state[:, :4]}
        numbers["euler"] = zyz_angles(rotation_matrix(state[:, :4]))
        yield rows, numbers | {"torque": np.tile(held, TICKS_A_SAMPLE)}


def _patched(raw: bytes, stamps: Any, numbers: Array) -> np.ndarray:
    """Copies of a serialized message with other stamps and numbers in the places of the marks."""
    rows = np.tile(np.frombuffer(raw, np.uint8), (len(numbers), 1))
    mark = np.float64(_MARK).tobytes()
    at = -8
    for column in numbers.T:
        at = raw.index(mark, at + 8)
        rows[:, at : at + 8] = np.ascontiguousarray(column)[:, None].view(np.uint8)
    if stamps is not None:
        time_ns = np.stack([stamps // 10**9, stamps % 10**9], axis=1).astype("<u4")
        rows[:, 4:12] = time_ns.view(np.uint8)
    return rows


def _make(kind: str, **fields: Any) -> Any:
    package, name = kind.split("/")
    return STORE.types[f"{package}/msg/{name}"](**fields)


def _messages() -> dict[str, Any]:
    """Give a message for each topic, with a mark in place of each number."""
    stamp = _make("builtin_interfaces/Time", sec=0, nanosec=0)
    header = _make("std_msgs/Header", stamp=stamp, frame_id="base")
    marks = {name: np.full(9, _MARK) for name in ("position", "velocity", "effort")}
    none = {name: np.empty(0) for name in ("positions", "velocities", "accelerations")}
    ends = [(k + 1) * TICK_NS for k in range(TICKS_A_SAMPLE)]
    points = [
        _make("trajectory_msgs/JointTrajectoryPoint", **none, effort=np.full(3, _MARK),
              time_from_start=_make("builtin_interfaces/Duration", sec=0, nanosec=end))
        for end in ends
    ]  # fmt: skip
    turn = _make("geometry_msgs/Quaternion", **dict.fromkeys("xyzw", _MARK))
    angles = _make("geometry_msgs/Vector3", **dict.fromkeys("xyz", _MARK))
    layout = _make("std_msgs/MultiArrayLayout", dim=[], data_offset=0)
    return {
        "/joint_states": _make(
            "sensor_msgs/JointState", header=header, name=list(JOINTS), **marks
        ),
        "/sst_simulator/orientation": _make(
            "geometry_msgs/QuaternionStamped", header=header, quaternion=turn
        ),
        "/sst_simulator/euler_zyz": _make(
            "geometry_msgs/Vector3Stamped", header=header, vector=angles
        ),
        "/sst_simulator/applied_torques": _make(
            "trajectory_msgs/JointTrajectory", header=header, joint_names=list(JOINTS[:3]),
            points=points,
        ),
        "/sst_simulator/commands": _make(
            "std_msgs/Float64MultiArray", layout=layout, data=np.full(3, _MARK)
        ),
    }  # fmt: skip


def main(arguments: list[str] | None = None) -> int:
    """Write the bag, report it, print what that took and the verdict; the exit status is 0."""
    parser = argparse.ArgumentParser(prog="python -m benchmark.long_bag", description=__doc__)
    parser.add_argument("--seconds", type=float, default=600.0)
    parser.add_argument("--bag", type=Path, help="write it there and keep it; used if it exists")
    parser.add_argument("--json", type=Path)
    options = parser.parse_args(arguments)
    with tempfile.TemporaryDirectory() as folder:
        bag = options.bag or Path(folder) / "bag"
        if not bag.exists():
            write(bag, options.seconds, shown=True)
        size = sum(file.stat().st_size for file in bag.iterdir()) / 1e9
        words = ["-m", "sst_ros", "report", "run", str(bag), "--out", str(Path(folder) / "report")]
        began = time.perf_counter()
        subprocess.run([sys.executable, *words], check=True, stdout=subprocess.DEVNULL)
        wall, used = time.perf_counter() - began, resource.getrusage(resource.RUSAGE_CHILDREN)
        busy, memory = used.ru_utime + used.ru_stime, used.ru_maxrss * 1024 / 1e9
        summary = json.loads((Path(folder) / "report" / "summary.json").read_text(encoding="utf-8"))
    found = {
        "samples": summary["samples_recorded"],
        "ticks": summary["ticks_recorded"],
        "samples_compared": summary["samples_compared"],
        "bag_GB": size,
        "wall_s": wall,
        "processor_s": busy,
        "peak_GB": memory,
        "integration_error_gamma_rad": summary["integration_error_gamma_rad"],
        "integration_reference_error_gamma_rad": summary["integration_reference_error_gamma_rad"],
    }
    for name, value in found.items():
        print(f"{name:40} {value:.4g}" if isinstance(value, float) else f"{name:40} {value}")
    good = wall < AT_MOST_S and memory < AT_MOST_GB
    print(f"{'met' if good else 'NOT MET'}: under {AT_MOST_S:g} s and {AT_MOST_GB:g} GB")
    host = describe_machine("numpy", "numba", "rosbags", "matplotlib")
    print(join_line(host))
    write_json(options.json, {"found": found, "machine": host})
    return 0


if __name__ == "__main__":
    sys.exit(main())
