# SPDX-License-Identifier: Apache-2.0
"""Two simulators side by side, each in its namespace, do not hear each other."""

import pytest
from diagnostic_msgs.msg import DiagnosticArray
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray
from std_srvs.srv import SetBool

pytestmark = pytest.mark.ros
SHARED = {"/diagnostics", "/rosout", "/parameter_events", "/clock"}
"""Names that are the same for all nodes, as everywhere in ROS 2."""


def begun(states):
    return [state for state in states if state.header.frame_id != "idle"]


def test_two_simulators_do_not_hear_each_other(nodes, observer):
    places = ("/left", "/right")
    started = {
        place: nodes.start(
            "simulator",
            "--ros-args",
            "-r",
            f"__ns:={place}",
            "-p",
            "wait_for_command:=true",
            "-p",
            "duration:=0.0",
        )
        for place in places
    }
    states = {place: observer.listen(JointState, f"{place}/joint_states") for place in places}
    health = observer.listen(DiagnosticArray, "/diagnostics")
    commands = {
        place: observer.publisher(Float64MultiArray, f"{place}/sst_simulator/commands")
        for place in places
    }
    observer.until(lambda: all(states.values()), "previews of both")

    commands["/left"].publish(Float64MultiArray(data=[0.5, 0.0, 0.0]))
    observer.until(lambda: len(begun(states["/left"])) > 10, "the run on the left")
    assert not begun(states["/right"])
    paused = observer.call(SetBool, "/left/sst_simulator/pause", data=True)
    assert (paused.success, paused.message) == (True, "paused")

    commands["/right"].publish(Float64MultiArray(data=[0.0, 0.0, -0.5]))
    observer.until(lambda: len(begun(states["/right"])) > 10, "the run on the right")
    assert begun(states["/left"])[-1].effort[0] == 0.5
    assert begun(states["/right"])[-1].effort[2] == -0.5

    def phases():
        said = {}
        for message in health:
            (status,) = message.status
            said[status.name] = {pair.key: pair.value for pair in status.values}["phase"]
        return said

    expected = {"/left/sst_simulator: run": "paused", "/right/sst_simulator: run": "running"}
    observer.until(lambda: phases() == expected, "what both say of themselves")

    for place in places:
        for offered in (
            observer.node.get_publisher_names_and_types_by_node("sst_simulator", place),
            observer.node.get_subscriber_names_and_types_by_node("sst_simulator", place),
            observer.node.get_service_names_and_types_by_node("sst_simulator", place),
        ):
            names = {name for name, _ in offered}
            assert names
            assert all(name.startswith(f"{place}/") for name in names - SHARED)
    assert [nodes.stop(process)[0] for process in started.values()] == [0, 0]
