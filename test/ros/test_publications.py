# SPDX-License-Identifier: Apache-2.0
"""What the simulator publishes while there is no run, from messages that no middleware carries."""

import math
from dataclasses import replace

import pytest
from rclpy.serialization import deserialize_message
from sensor_msgs.msg import JointState

from sst_ros import load_scene
from sst_ros.nodes.publications import SimulatorTopics
from sst_ros.runtime.settings import SimulatorParameters
from sst_ros.simulation.simulation import Simulation


class Publisher:
    """A topic with a subscriber."""

    def __init__(self, kind, name, _):
        self.kind, self.topic_name, self.published = kind, name, []

    def publish(self, message):
        self.published.append(message)

    def get_subscription_count(self):
        return 1


class Node:
    """Creates publishers, and nothing else."""

    def __init__(self):
        self.publishers = []

    def create_publisher(self, *given):
        self.publishers.append(Publisher(*given))
        return self.publishers[-1]


@pytest.fixture
def node():
    return Node()


@pytest.fixture
def shown(node):
    """Return the joint_states of a state that is shown."""
    simulated = SimulatorTopics(node, load_scene("example2"), SimulatorParameters())
    (joints,) = (one for one in node.publishers if one.topic_name == "joint_states")

    def show(state, *, at_rest=False):
        simulated.idle(state, 7, at_rest=at_rest)
        return deserialize_message(joints.published[-1], JointState)

    return show


@pytest.fixture
def state():
    return Simulation("example2").step((1.0, 2.0, 3.0), 50_000_000)


def test_a_state_at_rest_keeps_its_angles(shown, state):
    moving, rest = shown(state), shown(state, at_rest=True)
    assert any(moving.velocity) and tuple(moving.effort[:3]) == state.torque
    assert rest.position == moving.position and all(rest.position)
    assert not any(rest.velocity) and not any(rest.effort)


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_in_place_of_what_is_not_finite_the_last_valid_state_is_shown(shown, node, state, bad):
    shown(state)
    before = [list(one.published[-1:]) for one in node.publishers]
    for broken in (
        replace(state, joints=state.joints._replace(mu_dot=(0.0, bad, 0.0))),
        replace(state, torque=(bad, 0.0, 0.0)),
        replace(state, quaternion=(bad, *state.quaternion[1:])),
    ):
        shown(broken)
        assert [list(one.published[-1:]) for one in node.publishers] == before
