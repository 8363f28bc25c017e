# SPDX-License-Identifier: Apache-2.0
"""Messages as bytes, against what rclpy and rosbags read from them.

What is shown without a run.
"""

from types import SimpleNamespace

import numpy as np
import pytest
from geometry_msgs.msg import QuaternionStamped, Vector3Stamped
from hypothesis import given
from hypothesis import strategies as st
from rclpy.serialization import deserialize_message, serialize_message
from rosbags.typesys import Stores, get_typestore
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import JointState
from trajectory_msgs.msg import JointTrajectory

from sst_ros import load_scene
from sst_ros.mechanism.geometry import rotation_matrix, zyz_angles
from sst_ros.nodes import publications
from sst_ros.nodes.publications import SimulatorTopics, TorqueLog, state_messages
from sst_ros.runtime.settings import SimulatorParameters
from sst_ros.scene.loads import JOINTS
from sst_ros.simulation.simulation import Simulation
from sst_ros.state import nanoseconds

STAMP_NS = 1_700_000_000_123_456_789
SHOWN = (JointState, QuaternionStamped, Vector3Stamped)


@pytest.fixture(scope="module")
def state():
    simulation = Simulation(load_scene("example2"))
    return simulation.step((1.0, 2.0, 3.0), 50_000_000)


def stamped(messages, stamp_ns, state):
    """Those of `SHOWN`."""
    numbers = state.quaternion, sum(state.joints, ()), state.torque
    at = publications.stamp(stamp_ns)
    return [message(at, numbers) for message in messages]


def test_a_state_is_read_as_it_is(state):
    made = stamped(state_messages(), STAMP_NS, state)
    read, orientation, euler = map(deserialize_message, made, SHOWN)
    at = state.joints
    assert (read.header.stamp.sec, read.header.stamp.nanosec) == divmod(STAMP_NS, 10**9)
    assert tuple(read.name) == JOINTS
    assert tuple(read.position) == at.gamma + at.mu + at.beta
    assert tuple(read.velocity) == at.gamma_dot + at.mu_dot + at.beta_dot
    assert tuple(read.effort) == state.torque + (0.0,) * 6
    q, angles = orientation.quaternion, euler.vector
    assert ((q.x, q.y, q.z, q.w), orientation.header.frame_id) == (
        state.quaternion,
        "base_link",
    )
    expected = zyz_angles(rotation_matrix(state.quaternion))
    np.testing.assert_allclose((angles.x, angles.y, angles.z), expected, atol=1e-14)


@pytest.mark.parametrize("moments", [False, True])
@pytest.mark.parametrize("count", [0, 1, 2, 3, 40])
def test_torques_of_every_tick_are_read_as_they_were(count, moments):
    log = TorqueLog(1_500_000_000, moments=moments)
    for run in range(2):  # the second fills the same bytes anew
        rows = [(float(i), -1.0, run + 0.5) for i in range(count)]
        for row in rows:
            log.append(row, (7.0, 8.0, 9.0))
        assert len(log) == count
        data = log.take(STAMP_NS)
        assert len(log) == 0
        more = (7.0, 8.0, 9.0) if moments else ()
        read = deserialize_message(data, JointTrajectory)
        assert [tuple(point.effort) for point in read.points] == [
            (*row, *more) for row in rows
        ]
        times = [nanoseconds(point.time_from_start) for point in read.points]
        assert times == [(i + 1) * 1_500_000_000 for i in range(count)]
        assert len(read.joint_names) == 3 + len(more)


def test_ticks_noted_at_once_are_those_noted_one_by_one():
    one, other = TorqueLog(1_000_000), TorqueLog(1_000_000)
    one.append((1.0, 2.0, 3.0), (), 5)
    for _ in range(5):
        other.append((1.0, 2.0, 3.0), ())
    assert one.take(9) == other.take(9)


@pytest.mark.parametrize("frame_id", ["", "idle", "four"])
def test_the_layout_is_that_of_the_middleware(state, frame_id):
    """Byte for byte, except padding, which the middleware leaves as it is.

    None is left over.
    """
    store = get_typestore(Stores.ROS2_JAZZY)  # rosbags refuses bytes that are left over
    states = stamped(state_messages(frame_id), 7, state)
    log = TorqueLog(1_000_000, moments=True)
    none = log.take(9)
    log.append((1.0, 2.0, 3.0), (4.0, 5.0, 6.0), 2)
    made = [*states, log.take(9), none, publications.clock_message(STAMP_NS)]
    kinds = (*SHOWN, JointTrajectory, JointTrajectory, Clock)
    for data, kind in zip(made, kinds, strict=True):
        package = kind.__module__.partition(".")[0]
        store.deserialize_cdr(data, f"{package}/msg/{kind.__name__}")
        again = serialize_message(deserialize_message(data, kind))
        assert all(
            ours == theirs for ours, theirs in zip(data, again, strict=False) if ours
        ), kind
        assert deserialize_message(again, kind) == deserialize_message(data, kind)


angle = st.floats(-np.pi, np.pi)


@given(
    theta=angle,
    phi=st.floats(1e-6, np.pi - 1e-6),
    psi=angle,
    length=st.sampled_from([1, -1]),
)
def test_zyz_angles_are_those_of_the_rotation(theta, phi, psi, length):
    """Where the sine of phi is small both forms lose digits of theta and psi: compare
    rotations.
    """
    half = phi / 2.0, (theta + psi) / 2.0, (theta - psi) / 2.0
    x, y = -np.sin(half[0]) * np.sin(half[2]), np.sin(half[0]) * np.cos(half[2])
    z, w = np.cos(half[0]) * np.sin(half[1]), np.cos(half[0]) * np.cos(half[1])
    found = np.array(
        publications.zyz_angles([float(length * part) for part in (x, y, z, w)])
    )
    assert np.all(np.abs(found) <= np.pi)
    apart = found - (theta, phi, psi)
    np.testing.assert_allclose(np.exp(1j * apart), 1.0, atol=1e-9)


@pytest.mark.parametrize(
    "q", [(0.0, 0.0, 0.6, 0.8), (0.6, 0.8, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0)]
)
def test_at_a_pole_psi_carries_it_all(q):
    np.testing.assert_allclose(
        publications.zyz_angles(q), zyz_angles(rotation_matrix(q)), atol=1e-15
    )


class Topic:
    """A topic with a subscriber."""

    def __init__(self, kind, name, _):
        self.topic_name, self.published = name, []
        self.publish = self.published.append

    def get_subscription_count(self):
        return 1


@pytest.fixture
def shown():
    """A function that shows a state, and the last messages of all topics, by their
    names.
    """
    made = []
    create = lambda *given: made.append(Topic(*given)) or made[-1]  # noqa: E731
    node = SimpleNamespace(
        publishers=made, create_publisher=create, get_fully_qualified_name=str
    )
    simulated = SimulatorTopics(node, load_scene("example2"), SimulatorParameters())

    def show(state, *, at_rest=False):
        simulated.idle(state, 7, at_rest=at_rest)
        last = {topic.topic_name: topic.published[-1:] for topic in made}
        return deserialize_message(*last["joint_states"], JointState), last

    return show


def test_a_state_at_rest_keeps_its_angles(shown, state):
    (moving, _), (rest, _) = shown(state), shown(state, at_rest=True)
    assert any(moving.velocity) and tuple(moving.effort[:3]) == state.torque
    assert rest.position == moving.position and all(rest.position)
    assert not any(rest.velocity) and not any(rest.effort)
