# SPDX-License-Identifier: Apache-2.0
import math
import signal

import pytest
from geometry_msgs.msg import QuaternionStamped, Vector3Stamped
from ros.conftest import Observer
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray
from trajectory_msgs.msg import JointTrajectory

from sst_ros import load_scene
from sst_ros.simulation.simulation import Simulation

pytestmark = pytest.mark.ros
COMMANDS = "/sst_simulator/commands"
nanoseconds = Observer.stamp


def test_publishes_all_joints_at_whole_periods_from_the_start(nodes, observer):
    states = observer.listen(JointState, "/joint_states")
    nodes.run("simulator", wait_for_command=True, duration=0.2)
    commands = observer.publisher(Float64MultiArray, COMMANDS)
    observer.until(lambda: states, "preview")
    assert (states[0].header.frame_id, states[0].header.stamp.sec > 1e9) == ("idle", True)
    commands.publish(Float64MultiArray(data=[0.1, 0.2, 0.3]))
    observer.until(lambda: sum(nanoseconds(s) > 0 for s in states) == 101, "the 101 samples")

    run = [state for state in states if nanoseconds(state)]
    stamps = [nanoseconds(state) for state in run]
    assert stamps == [stamps[0] + 2_000_000 * k for k in range(101)]
    assert run[0].name[:4] == ["gamma_1", "gamma_2", "gamma_3", "mu_1"]
    assert {len(run[0].name), len(run[0].position), len(run[0].velocity), len(run[0].effort)} == {9}
    assert list(run[0].effort[:3]) == [0.0, 0.0, 0.0]
    assert list(run[-1].effort) == [0.1, 0.2, 0.3] + 6 * [0.0]

    simulation = Simulation(load_scene("example2"))
    for _ in range(200):
        simulation.step((0.1, 0.2, 0.3), 1_000_000)
    expected = simulation.state.joints
    assert list(run[-1].position) == [*expected.gamma, *expected.mu, *expected.beta]
    assert list(run[-1].velocity) == [*expected.gamma_dot, *expected.mu_dot, *expected.beta_dot]


def test_orientation_euler_angles_and_torques_belong_to_the_same_instants(nodes, observer):
    orientation = observer.listen(QuaternionStamped, "/sst_simulator/orientation")
    euler = observer.listen(Vector3Stamped, "/sst_simulator/euler_zyz")
    applied = observer.listen(JointTrajectory, "/sst_simulator/applied_torques")
    nodes.run("simulator", wait_for_command=True, duration=0.05, publish_rate=250)
    commands = observer.publisher(Float64MultiArray, COMMANDS)
    observer.until(lambda: orientation and euler and applied, "preview of every topic")
    commands.publish(Float64MultiArray(data=[1.0, 0.0, 0.0]))
    observer.until(lambda: sum(nanoseconds(m) > 0 for m in euler) == 14, "the 14 samples")
    observer.until(lambda: sum(len(m.points) for m in applied) == 50, "torques of the 50 ticks")

    first = [nanoseconds(m) for m in orientation if nanoseconds(m)]
    assert first == [nanoseconds(m) for m in euler if nanoseconds(m)]
    ends = [
        nanoseconds(m) + p.time_from_start.sec * 10**9 + p.time_from_start.nanosec
        for m in applied
        for p in m.points
    ]
    assert ends == [first[0] + 1_000_000 * (k + 1) for k in range(50)]
    q = orientation[-1].quaternion
    assert orientation[-1].header.frame_id == "base_link"
    assert math.hypot(q.x, q.y, q.z, q.w) == pytest.approx(1.0, abs=1e-15)
    e = (2 * (q.x * q.z + q.y * q.w), 2 * (q.y * q.z - q.x * q.w), 1 - 2 * (q.x**2 + q.y**2))
    angles = euler[-1].vector
    assert angles.x == pytest.approx(math.atan2(e[1], e[0]), abs=1e-14)
    assert angles.y == pytest.approx(math.acos(e[2]), abs=1e-14)


def test_torques_are_published_every_50_ms_and_at_the_end(nodes, observer):
    applied = observer.listen(JointTrajectory, "/sst_simulator/applied_torques")
    nodes.run("simulator", wait_for_command=True, duration=0.131)
    observer.until(lambda: applied, "preview")
    observer.publisher(Float64MultiArray, COMMANDS).publish(Float64MultiArray(data=[1.0, 0.0, 0.0]))
    observer.until(lambda: sum(len(m.points) for m in applied) == 131, "torques of the 131 ticks")
    messages = [m for m in applied if m.points]
    assert [len(m.points) for m in messages] == [50, 50, 31]
    begins = [nanoseconds(m) for m in messages]
    assert begins == [begins[0] + k * 50_000_000 for k in range(3)]


def test_bad_commands_are_dropped_whole_and_counted(nodes, observer):
    states = observer.listen(JointState, "/joint_states")
    process = nodes.run("simulator", wait_for_command=True, command_timeout=0.0)
    commands = observer.publisher(Float64MultiArray, COMMANDS)
    bad = [[1.0, 2.0], [1.0] * 4, [], [math.nan, 0.0, 0.0], [0.0, math.inf, 0.0]]
    for data in ([0.1, 0.2, 0.3], *bad):
        commands.publish(Float64MultiArray(data=data))
    assert observer.told("commands_dropped", len(bad))["commands_received"] == "1"
    assert list(states[-1].effort[:3]) == [0.1, 0.2, 0.3]
    status, _, err = nodes.stop(process)
    (warning,) = (line for line in err.splitlines() if "command dropped" in line)
    assert status == 0 and "must be 3 finite torques" in warning


def test_without_a_command_the_torque_is_zero(nodes, observer):
    states = observer.listen(JointState, "/joint_states")
    nodes.run("simulator", scene="example1", real_time_factor=0.1)
    observer.until(lambda: len(states) > 20, "states")
    assert {tuple(state.effort) for state in states} == {(0.0,) * 9}
    assert states[-1].position[0] != states[0].position[0]


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_signals_end_it_and_who_looks_sees_at_once_that_it_has_left(nodes, observer, number):
    """Otherwise it would be there for 20 s more, and a new one would not be the only one.

    Its name may stay: rmw_dds_common keeps for ever what a node that has left said at last.
    """
    process = nodes.run("simulator")
    observer.told("phase", "running")
    status, _, err = nodes.stop(process, number)
    assert status == 0 and "Traceback" not in err
    observer.until(
        lambda: not observer.node.count_publishers("/sst_simulator/phase"), "end of it", 5.0
    )
