# SPDX-License-Identifier: Apache-2.0
"""The launch files by `ros2 launch`: each ends when its work has, with the right
status.
"""

import contextlib
import json
import os
import re
import shutil
import signal
import subprocess
import time
from pathlib import Path

import pytest
from rosbags.highlevel import AnyReader
from rosbags.rosbag2 import Reader
from rosgraph_msgs.msg import Clock

from sst_ros.recording import recording

PREFIXES = [
    Path(path) for path in os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep)
]
RUN_S = 110
ROS2 = shutil.which("ros2")


def installed(package):
    index = Path("share", "ament_index", "resource_index", "packages", package)
    return any((prefix / index).is_file() for prefix in PREFIXES)


pytestmark = [
    pytest.mark.ros,
    pytest.mark.timeout(400),  # several launches in a test
    pytest.mark.skipif(
        not (ROS2 and installed("ros2launch") and installed("sst_ros")),
        reason=(
            "needs `ros2 launch` of a ROS installation with this package built by"
            " colcon"
        ),
    ),
]
needs_rosbag2 = pytest.mark.skipif(
    not installed("ros2bag"), reason="needs `ros2 bag` of a ROS installation"
)


class Launch:
    """A `ros2 launch` with all that it prints."""

    def __init__(self, folder, *words):
        self._printed = folder / f"printed_{len(list(folder.glob('printed_*')))}"
        with self._printed.open("w") as out:
            env = {**os.environ, "ROS_LOG_DIR": str(folder / "log")}
            self._process = subprocess.Popen(
                [ROS2, *words],
                cwd=folder,
                stdout=out,
                stderr=subprocess.STDOUT,
                env=env,
            )

    @property
    def text(self):
        return self._printed.read_text()

    def until(self, pattern, timeout=60):
        deadline = time.monotonic() + timeout
        while (found := re.search(pattern, self.text)) is None:
            assert time.monotonic() < deadline, f"no {pattern} in {self.text}"
            time.sleep(0.05)
        return found

    def interrupt(self):
        self._process.send_signal(signal.SIGINT)

    def ended(self, expected=0):
        """Wait for the end with this status; no process that it has started is left."""
        try:
            status = self._process.wait(RUN_S)
        except subprocess.TimeoutExpired:
            raise AssertionError(f"it does not end:\n{self.text}") from None
        pids = map(int, re.findall(r"process started with pid \[(\d+)\]", self.text))
        assert not [pid for pid in pids if Path("/proc", str(pid)).exists()]
        assert status == expected, self.text
        return self

    def close(self):
        if self._process.poll() is None:
            self.interrupt()
            try:
                self._process.wait(20)
            except subprocess.TimeoutExpired:
                self._process.kill()


@pytest.fixture
def launch(domain, tmp_path):
    started = []

    def start(name, *words):
        started.append(Launch(tmp_path, "launch", "sst_ros", name, *words))
        return started[-1]

    yield start
    for one in started:
        one.close()


def counts(bag):
    with Reader(bag) as reader:
        return {topic: info.msgcount for topic, info in reader.topics.items()}


def frames(bag, name):
    with AnyReader([bag]) as reader:
        connections = [
            one for one in reader.connections if one.topic.endswith(f"/{name}")
        ]
        for connection, _, data in reader.messages(connections):
            yield reader.deserialize(data, connection.msgtype).header.frame_id


@pytest.mark.parametrize("bag", ["sst", pytest.param("ros2", marks=needs_rosbag2)])
def test_a_recorded_run_is_complete_and_ends_the_launch(launch, tmp_path, bag):
    words = [
        "play:=true",
        "duration:=0.5",
        "record:=true",
        f"bag:={bag}",
        "output:=bag",
    ]
    launch("simulate.launch.py", *words).ended()
    read = recording.read(tmp_path / "bag")
    assert (read.time_ns == [2_000_000 * k for k in range(251)]).all()
    assert counts(tmp_path / "bag")["/sst_simulator/commands_stamped"] >= 250
    again = launch("simulate.launch.py", *words)  # into the same folder
    again.ended(1)
    assert str(tmp_path / "bag") in again.text or "'bag'" in again.text


def without(package):
    return pytest.mark.skipif(
        installed(package), reason=f"of an installation without {package}"
    )


NEEDS = r"this needs the ROS package\(s\) .*"
DISTRIBUTION = os.environ.get("ROS_DISTRO")
UNPLAYED = (
    r"(?s)(?=.*must have torque and duration).*torque_player failed with exit status 1"
)


@pytest.mark.parametrize(
    ("name", "words", "status", "said"),
    [
        ("simulate", "scene:=example2 play:=true", 0, "finished"),  # that of the README
        ("simulate", "play:=true duration:=0.0 sync:=lockstep", 0,
         "the profile of 1 s is played"),
        ("simulate", "scene:=swing play:=true", 1, UNPLAYED),
        pytest.param("view", "rviz:=true", 1, f"{NEEDS}rviz2", marks=without("rviz2")),
        pytest.param("simulate", "rviz:=true", 1, f"{NEEDS}rviz2",
                     marks=without("rviz2")),
        pytest.param("ros2_control", "", 1,
                     f"{NEEDS}controller_manager, .*joint_trajectory_contr.*"
                     f"apt install ros-{DISTRIBUTION}-controller-manager .*ros-",
                     marks=without("controller_manager")),
        ("ros2_control", "controllers:=nowhere.yaml", 1,
         "controllers:=nowhere.yaml: no such file"),
        ("simulate", "scen:=swing", 1,
         "scen:=swing: no such argument; did you mean 'scene'?"),
        ("simulate", "params_file:=nowhere.yaml", 1,
         "params_file:=nowhere.yaml: no such file"),
        ("simulate", "duration:=x play:=true", 1,
         "--duration = 'x': must be a finite number"),
        ("feedforward", "mode:=nosuch", 1, r"\"mode\".*\"nosuch\".*feedforward_pd.*pd"),
        ("simulate", "use_sim_time:=yes", 1, r"\"yes\" is not valid.*'true', 'false'"),
        ("record", "bag:=mcap", 1, r"\"mcap\" is not valid.*'ros2', 'sst'"),
    ],
)  # fmt: skip
def test_how_a_launch_ends(launch, name, words, status, said):
    run = launch(f"{name}.launch.py", *words.split()).ended(status)
    assert re.search(said, run.text), run.text
    assert ("process started" in run.text) == (status == 0 or said == UNPLAYED)


def test_a_part_that_dies_ends_the_launch_in_an_error(launch):
    run = launch("simulate.launch.py", "scene:=swing", "duration:=0.0")
    pid = int(run.until(r"\[simulator-1\]: process started with pid \[(\d+)\]")[1])
    run.until("running")
    os.kill(pid, signal.SIGKILL)
    run.ended(1)
    assert "simulator failed with exit status -9" in run.text


def test_feedforward_twice_and_beside_the_first_recording(launch, tmp_path):
    words = ["mode:=computed_torque", "real_time_factor:=0.0", "hold:=0.0", "bag:=sst"]
    for _ in range(2):
        launch("feedforward.launch.py", *words).ended()
    first, second = tmp_path.glob("feedforward_bag_*")
    assert counts(first)["/sst_inverse_dynamics/reference"] > 100
    run = launch("feedforward.launch.py", *words, f"output:={first}").ended(1)
    assert "must be a new folder" in run.text
    assert counts(second)["/joint_states"] > 100


def test_namespace_params_file_and_log_level_reach_the_nodes(launch, tmp_path):
    (tmp_path / "given.yaml").write_text(
        "/**: {ros__parameters: {duration: 0.2, scene: example1, rate: 500, sync:"
        " free}}"
    )
    words = [
        "namespace:=left",
        "params_file:=given.yaml",
        "log_level:=warn",
        "play:=true",
    ]
    run = launch(
        "simulate.launch.py", *words, "record:=true", "bag:=sst", "output:=bag"
    ).ended()
    assert "[INFO] [" not in "".join(re.findall(r"\[simulator-\d\] .*", run.text))
    found = counts(tmp_path / "bag")
    assert found["/left/joint_states"] >= 101
    assert found["/left/sst_simulator/scene"] == 1
    assert recording.read(tmp_path / "bag").scene.name == "example1"
    # as those of /tf
    assert {*frames(tmp_path / "bag", "orientation")} == {"left/base_link"}


def test_ctrl_c_ends_a_view_and_a_recorder_closes_its_bag(launch, tmp_path):
    view = launch("view.launch.py", "browser:=false")
    view.until("running")
    recorder = launch("record.launch.py", "bag:=sst", "output:=bag")
    recorder.until("ready: ")
    recorder.interrupt()
    recorder.ended()
    assert counts(tmp_path / "bag")["/joint_states"] > 0
    view.interrupt()
    view.ended()


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("simulate.launch.py", ["scene:=swing", "duration:=0.0"]),
        ("feedforward.launch.py", ["record:=false", "hold:=100.0"]),
    ],
)
def test_ctrl_c_ends_a_run_in_order(launch, name, words):
    run = launch(name, *words)
    run.until("running")
    run.interrupt()
    run.ended()
    assert "process has died" not in run.text


TWO_ROBOTS = """
from launch import LaunchDescription
from launch.actions import GroupAction, IncludeLaunchDescription
from launch_ros.actions import PushRosNamespace
from ament_index_python.packages import get_package_share_directory
FILE = get_package_share_directory("sst_ros") + "/launch/simulate.launch.py"
def robot(name, duration):
    given = {"scene": "swing", "duration": duration, "record": "true", "bag": "sst"}
    included = IncludeLaunchDescription(FILE, launch_arguments=given.items())
    return GroupAction([PushRosNamespace(name), included], scoped=SCOPED)
def generate_launch_description():
    return LaunchDescription([robot("left", "LEFT"), robot("/right", "0.0")])
"""


@pytest.mark.parametrize("ending", ["its end", "a kill"])
def test_the_end_of_one_of_two_robots_does_not_end_the_other(domain, tmp_path, ending):
    """A file is included twice, in scopes of their own or not.

    Each has its recorder and folder.
    """
    left = "0.5" if ending == "its end" else "0.0"
    text = TWO_ROBOTS.replace("LEFT", left).replace("SCOPED", str(ending == "its end"))
    (tmp_path / "two.launch.py").write_text(text)
    with contextlib.closing(Launch(tmp_path, "launch", "two.launch.py")) as run:
        for robot in ("left", "right"):
            run.until(rf"\[{robot}.sst_simulator\]: running")
        if ending == "a kill":
            pid = run.until(r"\[simulator-2\]: process started with pid \[(\d+)\]")[1]
            os.kill(int(pid), signal.SIGKILL)
        run.until(r"\[recorder-1\]: process has (finished|died)")
        assert "sending signal 'SIGINT' to process[recorder-3]" not in run.text
        run.interrupt()
        run.ended(0 if ending == "its end" else 1)
    assert ("simulator failed with exit status -9" in run.text) == (ending == "a kill")
    for robot in ("left", "right") if ending == "its end" else ("right",):
        (bag,) = tmp_path.glob(f"{robot}_sst_bag_*")
        read = recording.read(bag)
        assert read.signals.bag.topics["joint_states"] == f"/{robot}/joint_states"
        assert len(read.time_ns) > 1 and read.ticks.gaps == 0


CONTROLLER_MANAGER = """#!/usr/bin/env python3
import rclpy
from sensor_msgs.msg import JointState
rclpy.init()
node = rclpy.create_node("controller_manager")
commands = node.create_publisher(JointState, "/sst_simulator/commands_stamped", 10)
def write(states):
    command = JointState(name=states.name[:3], effort=[0.0] * 3)
    command.header.stamp = states.header.stamp
    commands.publish(command)
node.create_subscription(JointState, "/joint_states", write, 10)
try:
    rclpy.spin(node)
except (KeyboardInterrupt, rclpy.executors.ExternalShutdownException):
    pass
"""
"""Stands in for the real one, with the messages of its plug-ins for an effort
controller.
"""
STAND_INS = {
    "controller_manager": {
        "ros2_control_node": CONTROLLER_MANAGER,
        "spawner": "#!/bin/true\n",
    },
    "robot_state_publisher": {"robot_state_publisher": "#!/bin/sh\nexec sleep 60\n"},
    "joint_state_broadcaster": {},
    "joint_trajectory_controller": {},
    "joint_state_topic_hardware_interface": {},
    "sst_ros_hardware": {},
}
"""Programs of the packages that ros2_control.launch.py needs."""


def stand_in(monkeypatch, prefix, packages):
    """Make those packages that an installation lacks, with their programs."""
    index = prefix / "share" / "ament_index" / "resource_index" / "packages"
    index.mkdir(parents=True)
    for package, programs in packages.items():
        if not installed(package):
            (index / package).touch()
            (prefix / "lib" / package).mkdir(parents=True)
            for name, text in programs.items():
                path = prefix / "lib" / package / name
                path.write_text(text)
                path.chmod(0o755)
    monkeypatch.setenv(
        "AMENT_PREFIX_PATH", f"{prefix}:{os.environ['AMENT_PREFIX_PATH']}"
    )


LOSES_THE_FIRST = """#!/usr/bin/env -S --ignore-signal=INT python3
import signal, sys, time
signal.signal(signal.SIGTERM, lambda *_: sys.exit(0))
time.sleep(1000)
"""
"""`ros2 bag record` while it starts, between the handler of rclcpp and its own."""


def test_a_recorder_that_loses_a_signal_while_it_starts_is_ended(
    launch, tmp_path, monkeypatch
):
    """The controller fails at its start: what is not up yet ends as well, by the next
    signal.
    """
    stand_in(monkeypatch, tmp_path, {"ros2bag": {}, "rosbag2_storage_mcap": {}})
    path = tmp_path / "bin" / "ros2"
    path.parent.mkdir()
    path.write_text(LOSES_THE_FIRST)
    path.chmod(0o755)
    monkeypatch.setenv("PATH", f"{path.parent}:{os.environ['PATH']}")
    (tmp_path / "given.yaml").write_text("/**: {ros__parameters: {mode: nosuch}}")
    run = launch("feedforward.launch.py", "params_file:=given.yaml", "bag:=ros2").ended(
        1
    )
    assert "inverse_dynamics failed with exit status 1" in run.text
    assert "escalating to 'SIGTERM'" in run.text


@pytest.mark.parametrize("words", [(), ("sync:=lockstep", "publish_rate:=100")])
def test_ros2_control_begins_a_run_by_its_commands(
    launch, tmp_path, monkeypatch, words
):
    stand_in(monkeypatch, tmp_path, STAND_INS)
    run = launch("ros2_control.launch.py", *words)
    run.until("running")
    run.until(r"\[spawner-\d\]: process has finished cleanly")
    run.interrupt()
    run.ended()


def test_no_launch_file_is_left_out():
    text = Path(__file__).read_text(encoding="utf-8")
    found = {
        path.name for path in (Path(__file__).parents[2] / "launch").glob("*.launch.*")
    }
    assert found and all(f'"{name.partition(".")[0]}' in text for name in found)


def test_the_example_in_xml_runs_two_robots(launch):
    run = launch("two_robots.launch.xml", "left:=example1", "duration:=0.3")
    run.ended()
    for robot in ("left", "right"):
        assert re.search(rf"\[{robot}.sst_simulator\]: finished", run.text), run.text


def test_the_example_in_yaml_ends_with_the_motion(launch):
    run = launch("two_nodes.launch.yaml").ended()
    assert re.search(r"\[inverse_dynamics-2\]: process has finished cleanly", run.text)


@pytest.mark.parametrize("follows", [False, True])
def test_use_sim_time_is_the_time_of_all_nodes(launch, observer, follows):
    """The simulator is the source of /clock, or follows another one like the rest."""
    words = ["use_sim_time:=true", "scene:=swing", "duration:=0.0"]
    words += ["publish_clock:=false"] if follows else []
    run = launch("view.launch.py" if not follows else "simulate.launch.py", *words)
    run.until("sst_simulator")
    if follows:
        run.until("use_sim_time is set and there is no /clock")
    else:
        observer.until(lambda: observer.listen(Clock, "/clock"), "clock")
        assert observer.parameter("/sst_viewer", "use_sim_time") is True
    assert observer.parameter("/sst_simulator", "use_sim_time") is follows
    run.interrupt()
    run.ended()


@needs_rosbag2
def test_recorded_commands_are_played_into_a_fresh_simulator(launch, tmp_path):
    # It hardly moves by them, also where they are recorded and played for a long time.
    torques = [f"{k / 100},1e-8,2e-8,3e-8" for k in range(101)]
    (tmp_path / "torques.csv").write_text(
        "\n".join(["time,tau_1,tau_2,tau_3", *torques])
    )
    (tmp_path / "given.yaml").write_text(
        "/**: {ros__parameters: {csv: torques.csv, wait_for_command: true,"
        " command_timeout: 0.0}}"
    )
    words = ["params_file:=given.yaml", "record:=true", "bag:=sst"]
    launch(
        "simulate.launch.py", "play:=true", "sync:=free", *words, "output:=bag"
    ).ended()
    # has all the time it takes
    fresh = launch("simulate.launch.py", *words, "output:=again")
    fresh.until("waiting")
    topic = "/sst_simulator/commands"
    # A player that keeps ten messages, as it does by itself, cannot repeat those that a
    # busy machine has lost; the simulator keeps 50: slower than they were recorded.
    kept = {topic: {"reliability": "reliable", "history": "keep_last", "depth": 1000}}
    (tmp_path / "qos.yaml").write_text(json.dumps(kept))
    options = [
        "--rate",
        "0.25",
        "--delay",
        "10",
        "--qos-profile-overrides-path",
        "qos.yaml",
    ]
    options += ["--wait-for-all-acked", "10000"]
    player = Launch(tmp_path, "bag", "play", "bag", "--topics", topic, *options)
    player.ended()
    fresh.interrupt()
    fresh.ended()
    received = recording.read(tmp_path / "again").diagnostics["commands_received"]
    assert int(received) == counts(tmp_path / "bag")[topic] > 400
