# SPDX-License-Identifier: Apache-2.0
"""Files of a recording as recorders leave them: unfinished, compressed, without
metadata.yaml.
"""

import contextlib
import shutil
import sqlite3

import pytest
import yaml
import zstandard
from mcap.reader import make_reader
from mcap.writer import CompressionType
from mcap.writer import Writer as McapWriter

from sst_ros.errors import InputError
from sst_ros.recording import recording
from sst_ros.recording.bag_reader import McapFile

MAGIC_BYTES = 8


@pytest.fixture
def whole(written, example2):
    """The run in a database, in a folder."""
    return written(example2, sqlite=True)


def database_of(bag):
    (file,) = bag.glob("*.db3")
    return file


def killed(bag, folder, keep, journal):
    """What a recorder that was killed leaves: rows behind the first ones are beside the
    file.

    With a write-ahead log they are only there; of a rollback journal half a transaction
    is in the file, which SQLite takes back when it opens it.
    """
    folder.mkdir()
    source, target = database_of(bag), folder / "killed_0.db3"
    shutil.copyfile(source, target)
    with contextlib.closing(sqlite3.connect(target, isolation_level=None)) as database:
        rows = database.execute(
            "SELECT topic_id, timestamp, data FROM messages"
        ).fetchall()
        database.execute(f"PRAGMA journal_mode = {journal}")
        database.execute("PRAGMA wal_autocheckpoint = 0")
        database.execute("PRAGMA cache_size = 1")  # pages go to the file before the end
        database.execute("DELETE FROM messages")
        add = "INSERT INTO messages (topic_id, timestamp, data) VALUES (?, ?, ?)"
        if journal == "WAL":
            database.executemany(add, rows[:keep])
            database.execute("PRAGMA wal_checkpoint(TRUNCATE)")
            database.executemany(add, rows[keep:])
            beside = "-wal"
        else:
            database.executemany(add, rows)
            database.execute("BEGIN")
            database.execute(
                "UPDATE messages SET data = zeroblob(length(data)) WHERE id > 0"
            )
            beside = "-journal"
        copy = folder.with_name("copy")
        copy.mkdir()
        for file in (target, target.with_name(target.name + beside)):
            shutil.copyfile(file, copy / file.name)
            assert (copy / file.name).stat().st_size > 0
    return copy


@pytest.mark.parametrize("journal", ["WAL", "PERSIST"])
def test_what_sqlite_keeps_beside_a_database_is_read(whole, tmp_path, bags, journal):
    bag = killed(whole, tmp_path / "killed", 300, journal)
    before = {path.name: path.read_bytes() for path in bag.iterdir()}
    bags.same(recording.read(bag), recording.read(whole))
    bags.same(recording.read(bag / "killed_0.db3"), recording.read(whole))
    assert before == {path.name: path.read_bytes() for path in bag.iterdir()}


@pytest.mark.parametrize("sqlite", [False, True])
@pytest.mark.parametrize("change", [-1, 1])
def test_other_counts_than_those_of_the_metadata_are_damage(
    written, example2, bags, sqlite, change
):
    bag = written(example2, sqlite=sqlite)
    text = bag / "metadata.yaml"
    document = yaml.safe_load(text.read_text())
    for one in document["rosbag2_bagfile_information"]["topics_with_message_count"]:
        if one["topic_metadata"]["name"] == bags.JOINTS:
            one["message_count"] += change
    text.write_text(yaml.safe_dump(document))
    said = f"/joint_states: 154 messages of {154 + change} that metadata.yaml counts"
    with pytest.raises(InputError, match=f"reading failed: {said}.*--damaged reads it"):
        recording.read(bag)
    run = recording.read(bag, damaged=True)
    assert run.signals.bag.damage == (said,) and len(run.time_ns) == 151


def test_rows_that_a_database_has_lost_are_damage(whole):
    with contextlib.closing(sqlite3.connect(database_of(whole))) as database, database:
        database.execute("DELETE FROM messages WHERE id % 3 = 0")
    with pytest.raises(InputError, match=r"that metadata.yaml counts"):
        recording.read(whole)


def rewritten(bag, path, chunked, *, repeat=True, crc=True):
    """Write the messages again, those of which `chunked` is false outside of chunks.

    As the specification allows it: descriptions, messages and chunks one after the
        other.
    """
    (source,) = bag.glob("*.mcap")
    with source.open("rb") as file, path.open("wb") as target:
        writer = McapWriter(
            target, 1 << 30, CompressionType.NONE, enable_data_crcs=crc,
            repeat_channels=repeat, repeat_schemas=repeat,
        )  # fmt: skip
        writer.start("ros2", "test")
        ids = {}
        for number, (schema, channel, message) in enumerate(
            make_reader(file).iter_messages()
        ):
            if channel.id not in ids:
                named = schema.name, schema.encoding, schema.data
                ids[channel.id] = writer.register_channel(
                    channel.topic, "cdr", writer.register_schema(*named)
                )
            if not chunked(number):
                writer.flush()
                kept, writer._Writer__chunk_builder = (
                    writer._Writer__chunk_builder,
                    None,
                )
            writer.add_message(
                ids[channel.id], message.log_time, message.data, message.publish_time
            )
            if not chunked(number):
                writer._Writer__chunk_builder = kept
        writer.finish()
    return path


@pytest.mark.parametrize("crc", [True, False])
@pytest.mark.parametrize(
    "chunked",
    [lambda k: k % 100 < 50, lambda k: k < 300, lambda k: k >= 300, lambda k: False],
)
def test_messages_outside_of_chunks_are_read(
    example2_bag, tmp_path, bags, chunked, crc
):
    path = rewritten(example2_bag, tmp_path / "mixed.mcap", chunked, crc=crc)
    file = McapFile(path)
    assert sum(1 for _ in file.messages()) == sum(1 for _ in messages(example2_bag))
    assert not file.describe() and not file.lost
    bags.same(recording.read(path), recording.read(example2_bag))


def test_a_flipped_bit_outside_of_chunks_is_named(example2_bag, tmp_path):
    path = rewritten(example2_bag, tmp_path / "mixed.mcap", lambda k: k % 100 < 50)
    content, expected = bytearray(path.read_bytes()), [*McapFile(path).messages()]
    at = content.index(expected[-1][3])  # of the last message outside, which come last
    content[at + 20] ^= 1
    path.write_bytes(content)
    file = McapFile(path)
    kept = [*file.messages()]
    assert set(kept) <= set(expected) and file.lost == len(expected) - len(kept)
    assert any("data section with wrong checksum" in line for line in file.describe())


def messages(bag):
    (source,) = bag.glob("*.mcap")
    return McapFile(source).messages()


@pytest.mark.parametrize("sqlite", [False, True])
def test_a_folder_without_metadata_is_what_its_files_are(
    written, example2, bags, sqlite
):
    bag = written(example2, sqlite=sqlite)
    expected = recording.read(bag)
    (bag / "metadata.yaml").unlink()
    bags.same(recording.read(bag), expected)
    (file,) = [*bag.glob("*.db3"), *bag.glob("*.mcap")]
    shutil.copyfile(file, bag / f"another{file.suffix}")
    with pytest.raises(InputError, match=r"files of several recordings.*name one file"):
        recording.read(bag)


def test_numbered_files_are_read_in_the_order_of_their_numbers(
    written, example2, bags, tmp_path
):
    bag = tmp_path / "numbered"
    bag.mkdir()
    parts = [example2[k::11] for k in range(11)]
    for number, part in enumerate(parts):
        (file,) = written(part, sqlite=True).glob("*.db3")
        shutil.copyfile(file, bag / f"numbered_{number}.db3")
    bags.same(recording.read(bag), recording.read(written(example2)))


@pytest.mark.parametrize("sqlite", [False, True])
@pytest.mark.parametrize("name", ["run{}.zstd", "run.bin", "folder"])
def test_compressed_files_are_known_by_their_first_bytes(
    written, example2, bags, tmp_path, sqlite, name
):
    bag = written(example2, sqlite=sqlite)
    (file,) = [*bag.glob("*.db3"), *bag.glob("*.mcap")]
    path = tmp_path / name.format(file.suffix)
    target = path
    if name == "folder":
        path.mkdir()
        target = path / f"folder_0{file.suffix}.zstd"
    target.write_bytes(zstandard.ZstdCompressor().compress(file.read_bytes()))
    bags.same(recording.read(path), recording.read(bag))
    cut = target.read_bytes()
    target.write_bytes(cut[: len(cut) // 2])
    with pytest.raises(InputError, match=r"must be a whole rosbag2 recording"):
        recording.read(path)


def test_a_database_without_messages_is_empty(written, example2):
    bag = written(example2, sqlite=True)
    (bag / "metadata.yaml").unlink()
    with contextlib.closing(sqlite3.connect(database_of(bag))) as database, database:
        database.execute("DELETE FROM messages")
    with pytest.raises(InputError, match=r"messages = 0: the recording is empty"):
        recording.read(bag)
