# SPDX-License-Identifier: Apache-2.0
"""Reading many messages at once gives what rosbags gives one by one, from every kind of bag."""

import dataclasses
import shutil
import struct
from pathlib import Path

import lz4.frame
import numpy as np
import pytest
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer

from sst_ros.recording import cdr_fields, collector, mcap_blocks, recording
from sst_ros.recording.bag_reader import Bag

GENERATOR = np.random.default_rng(3)


def _joint_state(bags, names, count):
    numbers = (GENERATOR.normal(size=count) for _ in range(3))
    fields = dict(zip(("position", "velocity", "effort"), numbers, strict=True))
    header = bags.header(int(GENERATOR.integers(1, 2**60)))
    return bags.make("sensor_msgs/JointState", header=header, name=names, **fields)


def _raw(bags, message, little=True):
    return bytes(bags.STORE.serialize_cdr(message, message.__msgtype__, little_endian=little))


def _rows(raws):
    return np.frombuffer(b"".join(raws), np.uint8).reshape(len(raws), -1)


@pytest.mark.parametrize("little", [True, False])
@pytest.mark.parametrize("count", [0, 1, 9])
def test_fields_are_those_of_rosbags(bags, little, count):
    sent = [_joint_state(bags, ["a", "bcd", ""][:count], count) for _ in range(5)]
    rows = _rows([_raw(bags, message, little) for message in sent])
    ((received, (stamp, names, fields)),) = cdr_fields.read(
        np.arange(5), rows, collector.joint_state
    )
    assert received.tolist() == list(range(5)) and names == ("a", "bcd", "")[:count]
    for k, message in enumerate(sent):
        told = message.header.stamp
        assert stamp[k] == told.sec * 10**9 + told.nanosec
        for mine, its in zip(
            fields, (message.position, message.velocity, message.effort), strict=True
        ):
            assert np.array_equal(mine[k], its)


def test_messages_of_one_length_and_different_layout_are_told_apart(bags):
    """Names in another order, and another split of the same number of bytes."""
    kinds = [(["ab", "c"], 2), (["c", "ab"], 2), (["abc", ""], 2)]
    sent = [_joint_state(bags, *kinds[k % 3]) for k in range(12)]
    raws = [_raw(bags, message) for message in sent]
    length = max(map(len, raws))
    rows = _rows([raw for raw in raws if len(raw) == length])
    same = [message for message, raw in zip(sent, raws, strict=True) if len(raw) == length]
    found = list(cdr_fields.read(np.arange(len(same)), rows, collector.joint_state))
    assert len(found) > 1 and sum(len(received) for received, _ in found) == len(same)
    for received, (_, names, fields) in found:
        for row, k in enumerate(received):
            assert list(names) == same[k].name
            assert np.array_equal(fields[2][row], same[k].effort)


def test_bytes_that_are_no_message_are_refused(bags):
    whole = _raw(bags, _joint_state(bags, ["a"], 1))
    huge = whole[:16] + struct.pack("<I", 2**31) + whole[20:]
    for wrong in (b"", b"\0\1", b"\7" + whole[1:], whole[:-8], whole + b"\0" * 8, huge):
        with pytest.raises(cdr_fields.Malformed):
            list(cdr_fields.read(np.zeros(1, np.int64), _rows([wrong]), collector.joint_state))


def _compressed(path, entries, bags, mode=None, compressor=None):
    """Write a bag that is compressed as rosbag2 does it, or in chunks of some other kind."""
    connections = {}
    writer = Writer(path, version=9, storage_plugin=StoragePlugin.MCAP)
    if mode is not None:
        writer.set_compression(mode, CompressionFormat.ZSTD)
    with writer:
        if compressor is not None:
            writer.storage.compression, writer.storage.compressor = compressor
        for entry in entries:
            if entry.topic not in connections:
                kind = bags.KINDS[entry.topic]
                connections[entry.topic] = writer.add_connection(
                    entry.topic, kind, typestore=bags.STORE
                )
            raw = _raw(bags, entry.content)
            writer.write(connections[entry.topic], entry.received_ns, raw)
    return path


def _without_chunks(path, plain):
    """Write the records of a bag's chunks beside each other, with no index, as `fastwrite` does."""
    (file,) = plain.glob("*.mcap")
    whole = file.read_bytes()
    head = whole[: 8 + 9 + struct.unpack_from("<Q", whole, 9)[0]]
    records = b"".join(mcap_blocks._pieces(file))
    end = struct.pack("<BQI", 0x0F, 4, 0) + struct.pack("<BQQQI", 2, 20, 0, 0, 0)
    shutil.copytree(plain, path)
    (path / file.name).write_bytes(head + records + end + whole[:8])
    return path


def _same(one, other):
    for field in dataclasses.fields(recording.Recording):
        mine, its = getattr(one, field.name), getattr(other, field.name)
        if isinstance(mine, np.ndarray):
            assert np.array_equal(mine, its, equal_nan=True), field.name
    assert np.array_equal(one.ticks.torque, other.ticks.torque)
    assert np.array_equal(one.commands.torque, other.commands.torque)
    assert one.scene == other.scene and one.reports == other.reports


def test_bags_of_every_kind_hold_the_same_run(tmp_path, bags, example2, monkeypatch):
    plain = bags.write(tmp_path / "plain", example2)
    expected = recording.read(plain)
    singly = recording.read(bags.write(tmp_path / "sqlite", example2, sqlite=True))
    _same(singly, expected)
    packed = ("lz4", lz4.frame.compress)
    lz4_bag = _compressed(tmp_path / "lz4", example2, bags, compressor=packed)
    modes = (CompressionMode.STORAGE, CompressionMode.MESSAGE, CompressionMode.FILE)
    others = [_compressed(tmp_path / str(mode), example2, bags, mode) for mode in modes]
    for path in (lz4_bag, *others, _without_chunks(tmp_path / "loose", plain)):
        _same(recording.read(path), expected)
    # And what is compared with is right: the same bag through rosbags' own messages.
    monkeypatch.setattr(Bag, "_mcap_files", lambda self: [])
    _same(recording.read(plain), expected)


def test_only_few_messages_are_taken_singly(tmp_path, bags, example2, monkeypatch):
    counted = []
    content = Bag.content
    monkeypatch.setattr(
        Bag, "content", lambda self, block: counted.append(len(block.rows)) or content(self, block)
    )
    recording.read(bags.write(tmp_path / "bag", example2))
    assert sum(counted) == 2  # the scene, and one of the diagnostics


def test_a_chunk_whose_bytes_have_changed_is_refused(tmp_path, bags, example2):
    path = bags.write(tmp_path / "bag", example2)
    (file,) = Path(path).glob("*.mcap")
    (records, *_) = [piece for piece in mcap_blocks._pieces(file) if piece]
    content = struct.pack("<QQQI", 0, 1, len(records), 1) + struct.pack("<IQ", 0, len(records))
    with pytest.raises(mcap_blocks.Damaged, match="not what was written"):
        mcap_blocks._unpacked(content + records)
