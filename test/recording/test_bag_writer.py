# SPDX-License-Identifier: Apache-2.0
"""What a recording keeps in memory."""

import gc

from mcap.records import ChunkIndex, MessageIndex

from sst_ros.recording import bag_writer
from sst_ros.recording.bag_writer import BagWriter


def test_a_recording_keeps_one_index_entry_a_flush(tmp_path, monkeypatch):
    monkeypatch.setattr(bag_writer, "FLUSH_PERIOD_S", 0.0)
    bag = BagWriter(tmp_path / "bag")
    topics = [bag.connect(f"/topic_{k}", "sensor_msgs/msg/JointState") for k in range(8)]
    for _ in range(3):
        for k in range(1000):  # a second of 1 kHz
            for topic in topics:
                bag.write(topic, k, bytes(300))
        bag.save()
    kept = [type(one) for one in gc.get_objects() if isinstance(one, ChunkIndex | MessageIndex)]
    bag.close()
    assert kept == [ChunkIndex] * 3
