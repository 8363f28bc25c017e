# SPDX-License-Identifier: Apache-2.0
"""Cut recordings: kill -9, a full disk; and what comes out of them."""

import resource
import signal

import numpy as np
import pytest
from mcap.writer import MCAP0_MAGIC
from std_msgs.msg import Float64MultiArray

from sst_ros.errors import InputError
from sst_ros.recording import bag_writer, recording

pytestmark = pytest.mark.ros


def recorded(nodes, observer, bag, **given):
    """A recorder and a simulator that runs."""
    recorder = nodes.run("recorder", output=bag)
    simulator = nodes.run("simulator", wait_for_command=True, command_timeout=0.0, **given)
    assert nodes.line(recorder).startswith("ready")
    commands = observer.publisher(Float64MultiArray, "/sst_simulator/commands", readers=2)
    commands.publish(Float64MultiArray(data=[0.0, 0.0, 0.0]))
    return recorder, simulator


@pytest.mark.slow  # the campaign does the same
def test_kill_of_the_recorder_leaves_all_but_the_last_second(nodes, observer, tmp_path):
    recorder, simulator = recorded(nodes, observer, tmp_path / "bag")
    published = int(
        observer.told("samples_published", lambda n: int(n) > 1000)["samples_published"]
    )
    recorder.kill()
    recorder.communicate()
    assert nodes.stop(simulator)[0] == 0  # it does not care
    with pytest.raises(InputError, match="must be a whole rosbag2 recording"):
        recording.read(tmp_path / "bag")
    result = bag_writer.recover(tmp_path / "bag")
    assert (result.bag, result.cut) == (tmp_path / "bag_recovered", True)
    run = recording.read(result.bag)
    assert len(run.time_ns) > published - 750
    assert np.array_equal(run.time_ns, np.arange(len(run.time_ns)) * 2_000_000)


def test_kill_of_the_simulator_leaves_a_whole_bag(nodes, observer, tmp_path):
    recorder, simulator = recorded(nodes, observer, tmp_path / "bag")
    observer.told("samples_published", lambda n: int(n) > 300)
    simulator.kill()
    simulator.communicate()
    assert nodes.stop(recorder)[0] == 0
    run = recording.read(tmp_path / "bag")
    assert len(run.time_ns) > 300
    assert np.array_equal(run.time_ns, np.arange(len(run.time_ns)) * 2_000_000)
    assert run.diagnostics["phase"] == "running"  # the report says that it was cut


def test_a_full_disk_ends_the_recorder_in_words(nodes, observer, tmp_path):
    recorder, simulator = recorded(nodes, observer, tmp_path / "bag")
    resource.prlimit(recorder.pid, resource.RLIMIT_FSIZE, (700_000, 700_000))
    _, err = recorder.communicate(timeout=30)
    assert recorder.returncode == 1
    assert "bag is cut: " in err and "sst_ros recover" in err and "Traceback" not in err
    observer.told("phase", "running")
    assert nodes.stop(simulator, signal.SIGTERM)[0] == 0
    run = recording.read(bag_writer.recover(tmp_path / "bag").bag)
    assert len(run.time_ns) > 100
    assert np.array_equal(run.time_ns, np.arange(len(run.time_ns)) * 2_000_000)


def test_what_cannot_be_recovered_is_refused(tmp_path):
    (tmp_path / "noise.mcap").write_bytes(b"no bag at all")
    (tmp_path / "empty.mcap").write_bytes(MCAP0_MAGIC)
    (tmp_path / "folder").mkdir()
    for name, said in (
        ("noise.mcap", "must be an MCAP file"),
        ("empty.mcap", "holds no message"),
        ("nowhere.mcap", "must be readable"),
        ("folder", "must hold one .mcap file"),
    ):
        with pytest.raises(InputError, match=said):
            bag_writer.recover(tmp_path / name)
    with pytest.raises(InputError, match="must be a new folder"):
        bag_writer.recover(tmp_path / "empty.mcap", tmp_path / "folder")
