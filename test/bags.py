# SPDX-License-Identifier: Apache-2.0
"""Bags of a run as nodes would record it, without ROS: simulated, edited, written."""

import copy
import dataclasses
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer

from sst_ros.errors import RunStopped
from sst_ros.mechanism.geometry import rotation_matrix, zyz_angles
from sst_ros.recording.bag_reader import message_types
from sst_ros.recording.bag_writer import BagWriter
from sst_ros.recording.recording import Recording
from sst_ros.scene import yaml_document
from sst_ros.scene.loads import JOINTS as ALL_JOINTS
from sst_ros.simulation.simulation import Simulation
from sst_ros.state import nanoseconds

STORE = message_types()
START_NS = 1_700_000_000_123_456_789
TICK_NS = 1_000_000
TICKS_A_SAMPLE = 2
NAMES = list(ALL_JOINTS)

JOINTS = "/joint_states"
ORIENTATION, EULER = "/sst_simulator/orientation", "/sst_simulator/euler_zyz"
APPLIED, SCENE = "/sst_simulator/applied_torques", "/sst_simulator/scene"
DIAGNOSTICS, COMMANDS = "/diagnostics", "/sst_simulator/commands"
DESIRED, ERROR = (
    "/sst_inverse_dynamics/reference",
    "/sst_inverse_dynamics/tracking_error",
)
STAMPED = "/sst_simulator/commands_stamped"
KINDS = {
    **dict.fromkeys((JOINTS, STAMPED, DESIRED, ERROR), "sensor_msgs/msg/JointState"),
    ORIENTATION: "geometry_msgs/msg/QuaternionStamped",
    EULER: "geometry_msgs/msg/Vector3Stamped",
    APPLIED: "trajectory_msgs/msg/JointTrajectory",
    SCENE: "std_msgs/msg/String",
    DIAGNOSTICS: "diagnostic_msgs/msg/DiagnosticArray",
    COMMANDS: "std_msgs/msg/Float64MultiArray",
}


def make(kind: str, **fields: Any) -> Any:
    return STORE.types[kind if "/msg/" in kind else kind.replace("/", "/msg/")](
        **fields
    )


def time(ns: int, kind: str = "Time") -> Any:
    return make(f"builtin_interfaces/{kind}", sec=ns // 10**9, nanosec=ns % 10**9)


def header(stamp_ns: int) -> Any:
    return make("std_msgs/Header", stamp=time(stamp_ns), frame_id="base")


@dataclass
class Entry:
    """A message of a topic.

    `sample` is the index of the sample it belongs to, -1 for none.
    """

    topic: str
    received_ns: int
    content: Any
    sample: int = -1


def joint_state(stamp_ns: int, position: Any, velocity: Any, torque: Any) -> Any:
    """Numbers of the first joints; the torques are those of the actuators."""
    parts = {
        "position": position,
        "velocity": velocity,
        "effort": np.zeros(len(position)),
    }
    parts["effort"][:3] = torque
    names = NAMES[: len(position)]
    return make("sensor_msgs/JointState", header=header(stamp_ns), name=names, **parts)


def state_entries(state, stamp_ns: int, received_ns: int, sample: int) -> list[Entry]:
    position, velocity = np.reshape(state.joints, (2, 9))
    joints = joint_state(stamp_ns, position, velocity, state.torque)
    x, y, z, w = state.quaternion
    turn = make("geometry_msgs/Quaternion", x=x, y=y, z=z, w=w)
    theta, phi, psi = zyz_angles(rotation_matrix(state.quaternion)).tolist()
    angles = make("geometry_msgs/Vector3", x=theta, y=phi, z=psi)
    orientation = make(
        "geometry_msgs/QuaternionStamped", header=header(stamp_ns), quaternion=turn
    )
    euler = make("geometry_msgs/Vector3Stamped", header=header(stamp_ns), vector=angles)
    contents = {JOINTS: joints, ORIENTATION: orientation, EULER: euler}
    return [
        Entry(topic, received_ns, content, sample)
        for topic, content in contents.items()
    ]


def torque_entry(torques: list, start_ns: int, received_ns: int, sample: int) -> Entry:
    unused = dict.fromkeys(("positions", "velocities", "accelerations"), np.empty(0))
    ends = [time(i * TICK_NS, "Duration") for i in range(1, len(torques) + 1)]
    points = [
        make(
            f"{KINDS[APPLIED]}Point",
            **unused,
            effort=np.array(torque),
            time_from_start=end,
        )
        for torque, end in zip(torques, ends, strict=True)
    ]
    parts = {"header": header(start_ns), "joint_names": NAMES[:3], "points": points}
    return Entry(APPLIED, received_ns, make(KINDS[APPLIED], **parts), sample)


def command_entry(received_ns: int, torque: Any) -> Entry:
    layout = make("std_msgs/MultiArrayLayout", dim=[], data_offset=0)
    content = make("std_msgs/Float64MultiArray", layout=layout, data=np.array(torque))
    return Entry(COMMANDS, received_ns, content)


def diagnostics_entry(received_ns: int, **values: object) -> Entry:
    pairs = [
        make("diagnostic_msgs/KeyValue", key=key, value=str(v))
        for key, v in values.items()
    ]
    texts = {
        "level": 0,
        "name": "/sst_simulator: run",
        "message": "",
        "hardware_id": "",
    }
    status = make("diagnostic_msgs/DiagnosticStatus", **texts, values=pairs)
    content = make(
        "diagnostic_msgs/DiagnosticArray", header=header(received_ns), status=[status]
    )
    return Entry(DIAGNOSTICS, received_ns, content)


def simulated(scene, seconds: float) -> list[Entry]:
    """Messages of a run with the scene's sines held over each tick, as the nodes send
    them.
    """
    simulation, profile = Simulation(scene), scene.torque.at
    begun = START_NS - 300_000_000
    text = make("std_msgs/String", data=yaml_document.dump(scene))
    entries = [Entry(SCENE, begun, text)]
    for preview in range(3):
        entries += state_entries(simulation.state, 0, begun + preview * 100_000_000, -1)
        entries.append(torque_entry([], 0, begun + preview * 100_000_000, -1))
    entries += state_entries(simulation.state, START_NS, START_NS + 50_000, 0)
    held, samples, fault, ticks = [], 1, "", round(seconds * 1e9 / TICK_NS)
    state, done = simulation.state, 0
    for tick in range(ticks):
        torque = profile(tick * TICK_NS / 1e9)
        try:
            state = simulation.step(torque, TICK_NS)
        except RunStopped as stopped:
            fault = str(stopped)
        else:
            done += 1
            held.append(torque)
        # The end of a run is a sample, whether its time has come or not.
        if held and (len(held) == TICKS_A_SAMPLE or tick == ticks - 1 or fault):
            stamp = START_NS + done * TICK_NS
            start = stamp - len(held) * TICK_NS
            entries.append(torque_entry(held, start, stamp + 40_000, samples))
            entries += state_entries(state, stamp, stamp + 50_000, samples)
            held, samples = [], samples + 1
        if fault:
            break
    entries.append(command_entry(START_NS, np.zeros(3)))
    entries.append(
        diagnostics_entry(
            START_NS + done * TICK_NS + 60_000,
            phase="fault" if fault else "finished",
            ticks=done,
            ticks_missed=0,
            samples_published=samples,
            step_mean_us=160.5,
            step_max_us=400.25,
            real_time_factor=0.999,
            wall_time_s=seconds / 0.999,
            simulated_time_s=done * TICK_NS / 1e9,
            commands_received=ticks,
            commands_dropped=0,
            error_estimate=1e-12,
            fault=fault,
            integrator="dopri5",
        )
    )
    return sorted(entries, key=lambda entry: entry.received_ns)


def tracked(entries: list[Entry], desired) -> list[Entry]:
    """Add what a controller publishes.

    `desired` gives angles and rates at t [s], shape (2, 3).
    """
    more = []
    for entry in entries:
        if entry.topic == JOINTS and entry.sample >= 0:
            stamp = nanoseconds(entry.content.header.stamp)
            wanted = np.array(desired((stamp - START_NS) / 1e9))
            measured = np.array(
                [entry.content.position[:3], entry.content.velocity[:3]]
            )
            effort = entry.content.effort[:3]
            for topic, (position, velocity), torque in (
                (DESIRED, wanted, 0.75 * effort),
                (ERROR, wanted - measured, 0.25 * effort),
            ):
                content = joint_state(stamp, position, velocity, torque)
                more.append(Entry(topic, entry.received_ns + 1, content, entry.sample))
    return sorted([*entries, *more], key=lambda entry: entry.received_ns)


def write(
    path: Path, entries: list[Entry], *, sqlite: bool = False, namespace: str = "",
    mode: CompressionMode | None = None, chunks: Any = None,
) -> Path:  # fmt: skip
    """Write messages by rosbags, compressed as rosbag2 does it, or in chunks of some
    other kind.
    """
    plugin = StoragePlugin.SQLITE3 if sqlite else StoragePlugin.MCAP
    writer = Writer(path, version=9, storage_plugin=plugin)
    if mode is not None:
        writer.set_compression(mode, CompressionFormat.ZSTD)
    with writer:
        if chunks is not None:
            writer.storage.compression, writer.storage.compressor = chunks

        def connect(topic: str, kind: str) -> Any:
            name = topic if topic == DIAGNOSTICS else namespace + topic
            return writer.add_connection(name, kind, typestore=STORE)

        for message in _serialize(entries, connect):
            writer.write(*message)
    return path


def record(path: Path, entries: list[Entry], flush_every: int = 0) -> Path:
    """Write messages as the recorder does.

    With `flush_every`, a chunk for so many messages.
    """
    writer = BagWriter(path)
    for number, message in enumerate(_serialize(entries, writer.connect), 1):
        writer.write(*message)
        if flush_every and number % flush_every == 0:
            writer._flushed = -1e9
            writer.save()
    writer.close()
    return path


def _serialize(entries: list[Entry], connect: Any) -> Iterator[tuple[Any, int, bytes]]:
    connections: dict[str, Any] = {}
    for entry in entries:
        topic, kind = entry.topic, KINDS[entry.topic]
        if topic not in connections:
            connections[topic] = connect(topic, kind)
        data = bytes(STORE.serialize_cdr(entry.content, kind))
        yield connections[topic], entry.received_ns, data


def without(entries: list[Entry], *topics: str) -> list[Entry]:
    return [entry for entry in entries if entry.topic not in topics]


def edited(entries: list[Entry], topic: str, sample: int | None, change) -> list[Entry]:
    """Copy the messages.

    `change` gets the content of one, or of all of a topic, and returns it.
    """
    return [
        dataclasses.replace(entry, content=change(entry.content))
        if entry.topic == topic and sample in (None, entry.sample)
        else entry
        for entry in entries
    ]


def with_moment(entries: list[Entry], moment: Sequence[float]) -> list[Entry]:
    """Name a moment on the star beside the torques of every tick."""

    def change(message: Any) -> Any:
        points = [
            dataclasses.replace(point, effort=np.append(point.effort, moment))
            for point in message.points
        ]
        names = [*message.joint_names, "moment_x", "moment_y", "moment_z"]
        return dataclasses.replace(message, joint_names=names, points=points)

    return edited(entries, APPLIED, None, change)


def same(one: Recording, other: Recording) -> None:
    """Check that two recorded runs have the same numbers."""
    arrays = {
        name: mine for name, mine in vars(one).items() if isinstance(mine, np.ndarray)
    }
    assert len(arrays) == 11
    for name, mine in arrays.items():
        assert np.array_equal(mine, getattr(other, name), equal_nan=True), name
    assert np.array_equal(one.ticks.torque, other.ticks.torque)
    assert np.array_equal(one.commands.torque, other.commands.torque)
    assert one.scene == other.scene and one.reports == other.reports


def altered(run: Recording, **values: Any) -> Recording:
    """Copy a recorded run with other attributes."""
    again = copy.copy(run)
    vars(again).update(values)
    return again
