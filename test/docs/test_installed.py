# SPDX-License-Identifier: Apache-2.0
"""The checks of what pages say see what is wrong."""

import pytest
from docs.blocks import Block

pytest.importorskip("rclpy", reason="needs rclpy: pip install .[ros]")

from docs.session import Session

from docs import installed
from sst_ros.errors import SstError

BAD = (
    "ros2 run sst_ros simulater",
    "ros2 run sst_ros simulator --ros-args -p scen:=example2",
    "ros2 run sst_ros simulator --scen example2",
    "ros2 run sst_ros simulator --rate 500.5",
    "ros2 run sst_ros simulator --ros-args -p rate:=500.0",
    "ros2 run sst_ros simulator --ros-args -p compiled:=1",
    "ros2 topic echo /sst_simulator/command",
    "ros2 topic pub /sst_simulator/commands std_msgs/msg/Float64 '{data: 1.0}'",
    (
        "ros2 topic pub /sst_simulator/commands std_msgs/msg/Float64MultiArray '{dat:"
        " [1.0]}'"
    ),
    "ros2 service call /sst_simulator/restart std_srvs/srv/Trigger",
    "ros2 service call /sst_simulator/pause std_srvs/srv/SetBool '{data: 1}'",
    "ros2 param set /sst_simulator rate 500",
    "ros2 bag record /joint_state",
    "ros2 bag record $(cat $(ros2 pkg prefix --share sst_ros)/config/topic.txt)",
    "ros2 launch sst_ros simulate.launch.py plays:=true",
    "ros2 launch sst_ros simulation.launch.py",
    "make demos",
    "pip install 'sst_ros[export]'",
)


@pytest.mark.parametrize("line", BAD)
def test_what_does_not_exist_is_seen(line):
    with pytest.raises((AssertionError, KeyError, ValueError, OSError, SstError)):
        installed.check(line)


@pytest.mark.parametrize(
    ("language", "text", "said"),
    [
        ("python", "assert 1 == 2", "AssertionError"),
        pytest.param(
            *("bash", "true\nsst-ros scene show nowhere", "must be a readable"),
            marks=pytest.mark.slow,
        ),
        ("bash", "ros2 run sst_ros nothing", "ros2 run sst_ros nothing"),
        ("python", "# examples/push.py\nimport rclpy", "is not examples/push.py"),
        ("fortran", "END", "nobody knows what to do with fortran"),
    ],
)
def test_a_block_that_fails_is_named(language, text, said, tmp_path):
    session = Session(tmp_path, None)
    with pytest.raises(AssertionError, match=said) as caught:
        session.run(Block("page.md", 12, language, text))
    assert "page.md:12" in str(caught.value)
