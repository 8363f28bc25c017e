# SPDX-License-Identifier: Apache-2.0
import signal

import pytest
from rosbags.rosbag2 import Reader
from rosbags.typesys import Stores, get_typestore
from std_msgs.msg import Float64MultiArray

pytestmark = pytest.mark.ros


@pytest.mark.parametrize(
    "number", [signal.SIGINT, pytest.param(signal.SIGTERM, marks=pytest.mark.slow)]
)
def test_signals_leave_a_readable_bag_with_all_samples(nodes, observer, tmp_path, number):
    recorder = nodes.run("recorder", output=tmp_path / "bag")
    simulator = nodes.run("simulator", wait_for_command=True, duration=0.3)
    assert nodes.line(recorder) == "ready: 9 topics\n"
    commands = observer.publisher(Float64MultiArray, "/sst_simulator/commands", readers=2)
    commands.publish(Float64MultiArray(data=[0.0, 0.0, 0.0]))
    assert simulator.wait(timeout=20) == 0
    status, _, err = nodes.stop(recorder, number)
    assert status == 0
    assert "Traceback" not in err
    types = get_typestore(Stores.ROS2_KILTED)
    stamps = []
    with Reader(tmp_path / "bag") as bag:
        for connection, _, data in bag.messages():
            if connection.topic == "/joint_states":
                stamp = types.deserialize_cdr(data, connection.msgtype).header.stamp
                stamps.append(stamp.sec * 10**9 + stamp.nanosec)
    run = [stamp for stamp in stamps if stamp]
    assert run == [run[0] + 2_000_000 * k for k in range(151)]


def test_an_existing_folder_is_refused(nodes, tmp_path):
    process = nodes.run("recorder", output=tmp_path)
    _, err = process.communicate(timeout=20)
    assert process.returncode == 1
    assert f"output = '{tmp_path}': must be a new folder" in err.replace("PosixPath", "")
    assert "Traceback" not in err
