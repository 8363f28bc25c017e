# SPDX-License-Identifier: Apache-2.0
"""Samples and torques that a simulator publishes; two of them side by side."""

import signal

import pytest
from geometry_msgs.msg import QuaternionStamped, Vector3Stamped
from ros.conftest import NODE, torques
from sensor_msgs.msg import JointState
from slow_cases import slow_after
from std_msgs.msg import Float64MultiArray
from trajectory_msgs.msg import JointTrajectory

from sst_ros import load_scene
from sst_ros.simulation.simulation import Simulation

pytestmark = pytest.mark.ros
SHARED = {"/diagnostics", "/rosout", "/parameter_events", "/clock"}
"""Names that are the same for all nodes, as everywhere in ROS 2."""


def test_publishes_all_joints_at_whole_periods_from_the_start(nodes, observer):
    nodes.run("simulator", wait_for_command=True, duration=0.2, command_timeout=0.0)
    first = observer.preview()
    assert (first.header.frame_id, first.header.stamp.sec > 1e9) == ("idle", True)
    observer.command(0.1, 0.2, 0.3)
    observer.until(lambda: len(observer.samples()) == 101, "the 101 samples")

    run, stamps = observer.samples(), observer.stamps()
    assert stamps == [stamps[0] + 2_000_000 * k for k in range(101)]
    assert list(run[0].effort[:3]) == [0.0, 0.0, 0.0]
    assert list(run[-1].effort) == [0.1, 0.2, 0.3] + 6 * [0.0]

    simulation = Simulation(load_scene("example2"))
    for _ in range(200):
        simulation.step((0.1, 0.2, 0.3), 1_000_000)
    expected = simulation.state.joints
    assert list(run[-1].position) == [*expected.gamma, *expected.mu, *expected.beta]
    assert list(run[-1].velocity) == [
        *expected.gamma_dot,
        *expected.mu_dot,
        *expected.beta_dot,
    ]


def test_the_other_topics_belong_to_the_same_instants(nodes, observer):
    """Torques of every tick come every 50 ms and at the end.

    All are in the frame of this robot.
    """
    orientation = observer.listen(QuaternionStamped, f"{NODE}/orientation")
    euler = observer.listen(Vector3Stamped, f"{NODE}/euler_zyz")
    applied = observer.listen(JointTrajectory, f"{NODE}/applied_torques")
    nodes.run(
        "simulator", wait_for_command=True, duration=0.131, base_frame="left/base_link"
    )
    observer.until(lambda: orientation and euler and applied, "preview of every topic")
    observer.command(1.0, 0.0, 0.0)
    stamps = observer.stamps
    observer.until(
        lambda: len(stamps(euler)) == len(stamps(orientation)) == 67, "the 67 samples"
    )
    observer.until(
        lambda: sum(len(m.points) for m in applied) == 131, "torques of the 131 ticks"
    )

    start = stamps(orientation)[0]
    assert (
        stamps(orientation)
        == stamps(euler)
        == [start + 1_000_000 * min(2 * k, 131) for k in range(67)]
    )
    frames = {message.header.frame_id for message in (*orientation, *euler, *applied)}
    assert frames == {"left/base_link"}
    messages = [message for message in applied if message.points]
    assert [len(message.points) for message in messages] == [50, 50, 31]
    assert stamps(messages) == [start + k * 50_000_000 for k in range(3)]


@pytest.mark.parametrize(
    "number", slow_after(1, [signal.SIGINT, signal.SIGTERM], mark=pytest.mark.breadth)
)
def test_signals_end_it_and_others_see_at_once_that_it_has_left(
    nodes, observer, number
):
    """Otherwise it would be there for 20 s more, and a new one would not be the only
    one.

    Its name may stay: rmw_dds_common keeps for ever what a node that has left said at
        last.
    """
    process = nodes.run("simulator")
    observer.phase("running")
    assert nodes.stop(process, number)[0] == 0
    observer.until(
        lambda: not observer.node.count_publishers(f"{NODE}/phase"), "end of it", 15.0
    )


def test_two_simulators_do_not_hear_each_other(nodes, observer):
    places = ("/left", "/right")
    given = {"wait_for_command": True, "command_timeout": 0.0}
    started = {
        place: nodes.run("simulator", "--ros-args", "-r", f"__ns:={place}", **given)
        for place in places
    }
    states = {
        place: observer.listen(JointState, f"{place}/joint_states") for place in places
    }
    commands = {
        place: observer.publisher(Float64MultiArray, f"{place}{NODE}/commands")
        for place in places
    }
    observer.until(lambda: all(states.values()), "previews of both")

    def begun(place):
        return [state for state in states[place] if observer.stamp(state)]

    commands["/left"].publish(torques(0.5, 0.0, 0.0))
    observer.until(lambda: len(begun("/left")) > 10, "the run on the left")
    assert not begun("/right")
    paused = observer.pause(True, f"/left{NODE}")
    assert (paused.success, paused.message) == (True, "paused")

    commands["/right"].publish(torques(0.0, 0.0, -0.5))
    observer.until(lambda: len(begun("/right")) > 10, "the run on the right")
    assert begun("/left")[-1].effort[0] == 0.5
    assert begun("/right")[-1].effort[2] == -0.5

    for place in places:
        for offered in (
            observer.node.get_publisher_names_and_types_by_node("sst_simulator", place),
            observer.node.get_subscriber_names_and_types_by_node(
                "sst_simulator", place
            ),
            observer.node.get_service_names_and_types_by_node("sst_simulator", place),
        ):
            names = {name for name, _ in offered}
            assert names
            assert all(name.startswith(f"{place}/") for name in names - SHARED)
    assert [nodes.stop(process)[0] for process in started.values()] == [0, 0]
