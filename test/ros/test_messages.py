# SPDX-License-Identifier: Apache-2.0
"""Messages of states against what rclpy and rosbags read.

What is shown without a run.
"""

from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from rclpy.serialization import deserialize_message, serialize_message

from sst_ros import load_scene
from sst_ros.mechanism.geometry import rotation_matrix, zyz_angles
from sst_ros.nodes.publications import (
    SimulatorTopics,
    TorqueLog,
    state_messages,
    time_of,
)
from sst_ros.nodes.publications import (
    zyz_angles as fast_zyz_angles,
)
from sst_ros.nodes.sensors import Numbers
from sst_ros.runtime.settings import SimulatorParameters
from sst_ros.scene.loads import JOINTS
from sst_ros.simulation.simulation import Simulation
from sst_ros.state import nanoseconds

STAMP_NS = 1_700_000_000_123_456_789


@pytest.fixture(scope="module")
def state():
    simulation = Simulation(load_scene("example2"))
    return simulation.step((1.0, 2.0, 3.0), 50_000_000)


def received(message):
    """What a subscriber gets."""
    return deserialize_message(serialize_message(message), type(message))


def numbers_of(state):
    joints = sum(state.joints, ())
    return Numbers(state.quaternion, joints[:9], joints[9:], state.torque)


def filled(messages, stamp_ns, state):
    stamp, numbers = time_of(stamp_ns), numbers_of(state)
    return [received(message.fill(stamp, numbers)) for message in messages.values()]


def test_a_state_is_read_as_it_is(state):
    messages = state_messages()
    read, orientation, euler = filled(messages, STAMP_NS, state)
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


def test_a_refilled_message_keeps_nothing_of_the_last_state(state):
    messages = state_messages("idle", "left/base_link")
    filled(messages, STAMP_NS, state)
    start = Simulation(load_scene("example2")).state
    fresh = state_messages("idle", "left/base_link")
    assert filled(messages, 7, start) == filled(fresh, 7, start)


@pytest.mark.parametrize("moments", [False, True])
@pytest.mark.parametrize("counts", [(0, 1), (2, 3), (40, 40), (3, 2), (40, 0)])
def test_torques_of_every_tick_are_read_as_they_were(counts, moments):
    log = TorqueLog(1_500_000_000, moments=moments)
    for run, count in enumerate(counts):  # the second fills the same points anew
        rows = [(float(i), -1.0, run + 0.5) for i in range(count)]
        for row in rows:
            log.append(row, (7.0, 8.0, 9.0))
        assert len(log) == count
        read = received(log.take(STAMP_NS))
        assert len(log) == 0
        more = (7.0, 8.0, 9.0) if moments else ()
        assert [tuple(point.effort) for point in read.points] == [
            (*row, *more) for row in rows
        ]
        times = [nanoseconds(point.time_from_start) for point in read.points]
        assert times == [(i + 1) * 1_500_000_000 for i in range(count)]
        assert len(read.joint_names) == 3 + len(more)
        assert nanoseconds(read.header.stamp) == STAMP_NS


def test_ticks_noted_at_once_are_those_noted_one_by_one():
    one, other = TorqueLog(1_000_000), TorqueLog(1_000_000)
    one.append((1.0, 2.0, 3.0), (), 5)
    for _ in range(5):
        other.append((1.0, 2.0, 3.0), ())
    assert one.take(9) == other.take(9)


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
    found = np.array(fast_zyz_angles([float(length * part) for part in (x, y, z, w)]))
    assert np.all(np.abs(found) <= np.pi)
    apart = found - (theta, phi, psi)
    np.testing.assert_allclose(np.exp(1j * apart), 1.0, atol=1e-9)


@pytest.mark.parametrize(
    "q", [(0.0, 0.0, 0.6, 0.8), (0.6, 0.8, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0)]
)
def test_at_a_pole_psi_carries_it_all(q):
    np.testing.assert_allclose(
        fast_zyz_angles(q), zyz_angles(rotation_matrix(q)), atol=1e-15
    )


class Topic:
    """A topic with a subscriber."""

    def __init__(self, kind, name, _):
        self.topic_name, self.published = name, []

    def publish(self, message):
        self.published.append(received(message))

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
        return last["joint_states"][0], last

    return show


def test_a_state_at_rest_keeps_its_angles(shown, state):
    (moving, _), (rest, _) = shown(state), shown(state, at_rest=True)
    assert any(moving.velocity) and tuple(moving.effort[:3]) == state.torque
    assert rest.position == moving.position and all(rest.position)
    assert not any(rest.velocity) and not any(rest.effort)
