# SPDX-License-Identifier: Apache-2.0
"""Damaged and cut recordings: no silent difference, no traceback, losses counted.

What is kept.
"""

import gc
import random
import struct

import pytest
from mcap.opcode import Opcode
from mcap.records import ChunkIndex, MessageIndex
from mcap.writer import MCAP0_MAGIC
from rosbags.rosbag2 import Reader

from sst_ros.errors import InputError
from sst_ros.recording import bag_writer, recording
from sst_ros.recording.bag_reader import McapFile
from sst_ros.recording.bag_writer import BagWriter, recover
from sst_ros.recording.recording import export
from sst_ros.scene import scene

CHUNK = 40


@pytest.fixture(scope="module")
def entries(bags):
    return bags.simulated(scene.load("example2"), 0.1)


@pytest.fixture(scope="module")
def whole(tmp_path_factory, bags, entries):
    """A recording of many chunks."""
    return bags.record(tmp_path_factory.mktemp("whole") / "bag", entries, CHUNK)


def content_of(bag):
    (file,) = bag.glob("*.mcap")
    return file.read_bytes()


def damaged_copy(folder, whole, content):
    folder.mkdir(parents=True)
    (folder / "bag.mcap").write_bytes(content)
    (folder / "metadata.yaml").write_bytes((whole / "metadata.yaml").read_bytes())
    return folder


def messages_of(bag):
    with Reader(bag) as reader:
        return [(c.topic, at, bytes(raw)) for c, at, raw in reader.messages()]


def check_changes(whole, path, changes):
    """Change bytes, one at a time.

    Return how often that made no difference, and none was told.
    """
    content, expected = (
        content_of(whole),
        list(McapFile(next(whole.glob("*.mcap"))).messages()),
    )
    unnoticed = 0
    for at, bits in changes:
        changed = bytearray(content)
        changed[at] ^= bits
        path.write_bytes(changed)
        file = McapFile(path)
        kept = list(file.messages())
        unnoticed += not file.describe()
        assert kept == expected or file.describe(), f"byte {at}: a silent difference"
        assert set(kept) <= set(expected), f"byte {at}: an invented message"
        assert len(expected) - len(kept) == file.lost <= CHUNK, (
            f"byte {at}: losses not counted"
        )
    return unnoticed


def check_cuts(whole, folder, count, seed):
    """Cut files at random places: every chunk that lies before the cut comes back
    whole.
    """
    content, messages = content_of(whole), messages_of(whole)
    ends, position = [], 0
    for *_, data in messages:
        position = content.index(data, position) + len(data)
        ends.append(position)
    generator = random.Random(seed)
    for number in range(count):
        size = generator.randrange(len(MCAP0_MAGIC), len(content))
        bag = damaged_copy(folder / str(number), whole, content[:size])
        with pytest.raises(InputError, match="must be a whole rosbag2 recording"):
            recording.read(bag)
        try:
            found = recover(bag, folder / f"{number}_recovered")
        except InputError as error:
            assert "holds no message" in str(error) and size < ends[CHUNK - 1]
            continue
        kept = messages_of(found.bag)
        before = sum(end <= size for end in ends)
        before -= before % CHUNK if before < len(ends) else 0
        assert found.cut and kept == messages[:before]


@pytest.mark.parametrize(
    "count",
    [100, pytest.param(500, marks=[pytest.mark.slow, pytest.mark.timeout(900)])],
)
def test_a_changed_byte_is_never_silent(count, whole, tmp_path):
    size, generator = len(content_of(whole)), random.Random(count)
    changes = [
        (generator.randrange(size), generator.randrange(1, 256)) for _ in range(count)
    ]
    assert check_changes(whole, tmp_path / "bag.mcap", changes) <= max(1, count // 250)
    check_cuts(whole, tmp_path, 3 * count // 10, seed=count)


def test_a_flipped_bit_is_named_and_costs_a_chunk_at_most(whole, tmp_path):
    """In the first bytes of every record: its kind, its length and what else it is
    known by.
    """
    content, generator = content_of(whole), random.Random(5)
    heads, position = [0], len(MCAP0_MAGIC)
    while position < len(content) - len(MCAP0_MAGIC):
        heads.append(position)
        position += 9 + struct.unpack_from("<Q", content, position + 1)[0]
    assert len(heads) > 40 and position == len(content) - len(MCAP0_MAGIC)
    at = [min(head + generator.randrange(24), len(content) - 1) for head in heads * 4]
    flips = [(k, 1 << generator.randrange(8)) for k in at]
    assert check_changes(whole, tmp_path / "bag", flips) == 0


def test_an_index_with_a_wrong_checksum_says_nothing_of_losses(whole, tmp_path):
    content = bytearray(content_of(whole))
    (at,) = struct.unpack_from("<Q", content, len(content) - len(MCAP0_MAGIC) - 20)
    # no end of the data: the index is read on as what comes next
    content[at - 13] = 0x7F
    while content[at] != Opcode.STATISTICS:
        at += 9 + struct.unpack_from("<Q", content, at + 1)[0]
    content[at + 9 + 7] ^= 0x40  # of the number of messages
    (tmp_path / "changed.mcap").write_bytes(content)
    file = McapFile(tmp_path / "changed.mcap")
    assert list(file.messages())
    assert file.damage and file.lost == 0


def test_a_damaged_chunk_is_named_and_the_rest_read_when_asked(whole, tmp_path):
    content = bytearray(content_of(whole))
    content[content.index(b"gamma_1", len(content) // 2)] ^= 1
    bag = damaged_copy(tmp_path / "damaged", whole, bytes(content))
    with pytest.raises(InputError, match="wrong checksum"):
        export(bag, tmp_path / "out")
    with pytest.raises(InputError, match=r"byte \d+: chunk with wrong checksum \(0\."):
        recording.read(bag)
    run = recording.read(bag, damaged=True)
    assert 30 < len(run.time_ns) < 51
    assert any("40 messages are lost" in line for line in run.signals.bag.damage)
    found = recover(bag, tmp_path / "recovered")
    whole_messages, kept = messages_of(whole), messages_of(found.bag)
    assert set(kept) < set(whole_messages) and len(kept) == len(whole_messages) - CHUNK
    assert found.lost == CHUNK and found.damage and not found.cut


def test_rosbags_reads_the_recorders_checksums_and_index(whole, entries, example2_bag):
    file = McapFile(next(whole.glob("*.mcap")))
    assert sum(1 for _ in file.messages()) == len(entries) == len(messages_of(whole))
    assert not file.describe() and file.unverified == 0
    # Recordings without checksums are read and counted.
    assert recording.read(example2_bag).signals.bag.unverified > 0


@pytest.mark.slow
def test_a_late_flush_makes_no_large_chunk_and_keeps_no_index(tmp_path, monkeypatch):
    """What is held in memory is bounded: a chunk, and an entry of the index for each
    chunk.
    """
    bag = BagWriter(tmp_path / "bag")
    topics = [
        bag.connect(f"/topic_{k}", "sensor_msgs/msg/JointState") for k in range(8)
    ]
    for k in range(3000):  # three seconds of 1 kHz without a flush
        for topic in topics:
            bag.write(topic, k, bytes(300))
    monkeypatch.setattr(bag_writer, "FLUSH_PERIOD_S", 0.0)
    bag.save()
    kept = [
        one for one in gc.get_objects() if isinstance(one, ChunkIndex | MessageIndex)
    ]
    assert {type(one) for one in kept} == {ChunkIndex}
    # The garbage collector has them in any order; the last one is shorter.
    kept.sort(key=lambda index: index.chunk_start_offset)
    sizes = [one.uncompressed_size for one in kept[:-1]]
    bag.close()
    assert min(sizes) > 500_000 and max(sizes) < 530_000 and 13 < len(sizes) < 16
