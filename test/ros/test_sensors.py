# SPDX-License-Identifier: Apache-2.0
"""The inertial measurement unit and the reaction of a joint, against differentiated
orientations and the balances of Newton and Euler.
"""

import xml.etree.ElementTree as ET

import numpy as np
import pytest
from geometry_msgs.msg import QuaternionStamped, WrenchStamped
from ros.conftest import NODE
from sensor_msgs.msg import Imu
from std_msgs.msg import String

from sst_ros import Simulation, load_scene
from sst_ros.dynamics.reactions import LINK_JOINTS, reactions_of
from sst_ros.mechanism.geometry import rotation_matrix
from sst_ros.nodes.publications import sensor_messages, time_of
from sst_ros.nodes.sensors import Numbers
from sst_ros.runtime.settings import REACTION_JOINTS, SimulatorParameters
from sst_ros.scene.scene import replace
from sst_ros.state import nanoseconds

pytestmark = pytest.mark.ros
SCENE, POINT = "gravity_payload", (0.02, -0.05, 0.11)
TORQUE, MOMENT = (0.4, -0.3, 0.2), (0.3, -0.2, 0.1)
STEP_NS, STEP = 1_000_000, 1e-3

# Central differences of order six at the middle one of seven values.
FIRST = np.array([-1.0, 9.0, -45.0, 0.0, 45.0, -9.0, 1.0]) / (60.0 * STEP)
SECOND = np.array([2.0, -27.0, 270.0, -490.0, 270.0, -27.0, 2.0]) / (180.0 * STEP**2)


def numbers_of(simulation):
    y, joints, torque = simulation.sample
    return Numbers(
        tuple(y[:4]),
        joints[:9],
        joints[9:],
        torque,
        tuple(y[4:7]),
        simulation.body_acceleration,
    )


@pytest.fixture(scope="module")
def motion():
    """Seven states, one step apart, under constant torques and an external moment."""
    scene = replace(load_scene(SCENE), moment={"topic": True})
    simulation = Simulation(scene, "dop853", tolerance=1e-13)
    simulation.steps(TORQUE, STEP_NS, 50, MOMENT)
    states = []
    for _ in range(7):
        simulation.steps(TORQUE, STEP_NS, 1, MOMENT)
        states.append(numbers_of(simulation))
    return scene, states


def vector(message):
    return np.array((message.x, message.y, message.z))


def filled(key, settings, scene, numbers):
    message = sensor_messages(scene, SimulatorParameters(scene=SCENE, **settings))[key]
    return message.fill(time_of(7), numbers)


def test_the_imu_reads_the_differentiated_orientation(motion):
    scene, states = motion
    rotations = np.array([rotation_matrix(one.quaternion) for one in states])
    middle, rate = rotations[3], np.tensordot(FIRST, rotations, 1)
    spin = middle.T @ rate
    acceleration = np.tensordot(SECOND, rotations @ np.array(POINT), 1)
    force = middle.T @ (acceleration - np.array(scene.gravity.acceleration))
    assert np.linalg.norm(acceleration) > 0.1  # it is no rest
    message = filled("imu", {"imu": True, "imu_position": POINT}, scene, states[3])
    assert message.header.frame_id == "imu_link"
    np.testing.assert_allclose(
        vector(message.angular_velocity),
        (spin[2, 1], spin[0, 2], spin[1, 0]),
        atol=1e-8,
    )
    np.testing.assert_allclose(vector(message.linear_acceleration), force, atol=1e-6)
    part = message.orientation
    np.testing.assert_allclose(
        rotation_matrix((part.x, part.y, part.z, part.w)), middle, atol=1e-15
    )
    assert not any(message.orientation_covariance)  # without noise


def test_at_rest_the_imu_reads_the_support_against_gravity(motion):
    """REP 145: an axis that points up reads +g."""
    scene, states = motion
    still = states[0]._replace(body_rate=(0.0,) * 3, body_acceleration=(0.0,) * 3)
    message = filled("imu", {"imu": True, "imu_position": POINT}, scene, still)
    inertial = rotation_matrix(still.quaternion) @ vector(message.linear_acceleration)
    np.testing.assert_allclose(-inertial, scene.gravity.acceleration, atol=1e-12)


def test_noise_has_its_covariance_and_begins_anew_with_a_run(motion):
    scene, states = motion
    noise = {"angle_noise": 1e-3, "rate_noise": 0.02, "acceleration_noise": 0.3}
    settings = SimulatorParameters(scene=SCENE, imu=True, measurement_seed=5, **noise)
    (message,) = sensor_messages(scene, settings).values()
    rows = []
    for _ in range(2000):
        read = message.fill(time_of(7), states[3])
        part = read.orientation
        error = rotation_matrix(states[3].quaternion).T @ rotation_matrix(
            (part.x, part.y, part.z, part.w)
        )
        rows.append((
            *(error[2, 1], error[0, 2], error[1, 0]),
            *vector(read.angular_velocity),
            *vector(read.linear_acceleration),
        ))  # fmt: skip
    deviations = np.std(rows, axis=0)
    # Known to 1 / sqrt(2 n) = 1.6 %.
    np.testing.assert_allclose(deviations, np.repeat([*noise.values()], 3), rtol=0.07)
    for covariance, deviation in (
        (read.orientation_covariance, noise["angle_noise"]),
        (read.angular_velocity_covariance, noise["rate_noise"]),
        (read.linear_acceleration_covariance, noise["acceleration_noise"]),
    ):
        matrix = np.reshape(covariance, (3, 3))
        np.testing.assert_array_equal(matrix, deviation**2 * np.eye(3))
    message.restart()
    again = message.fill(time_of(7), states[3])
    assert (*vector(again.angular_velocity),) == rows[0][3:6]


def test_what_the_imu_reads_is_late_by_the_delay_of_the_channel(motion):
    scene, states = motion
    settings = SimulatorParameters(scene=SCENE, imu=True, measurement_delay=2)
    (message,) = sensor_messages(scene, settings).values()
    read = [
        (*vector(message.fill(time_of(7), one).angular_velocity),) for one in states
    ]
    rates = [one.body_rate for one in states]
    assert read == [rates[0], rates[0], *rates[:-2]]


@pytest.mark.parametrize("joint", REACTION_JOINTS)
def test_a_reaction_is_that_of_the_motion(motion, joint):
    scene, states = motion
    at = states[3]
    free = replace(scene, moment=None)
    still = at._replace(body_acceleration=accelerate(free, at))
    kind, leg = joint[:-2], int(joint[-1]) - 1
    whole = reactions_of(
        free,
        np.zeros(1),
        np.array([at.quaternion]),
        np.array([at.body_rate]),
        np.array([at.torque]),
    )
    loads = getattr(whole, kind)
    message = filled("reaction", {"reaction": joint}, scene, still)
    frame = "actuated" if kind == "actuated" else "intermediate"
    assert message.header.frame_id == f"{frame}_{leg + 1}"
    for measured, expected in (
        (message.wrench.force, loads.force),
        (message.wrench.torque, loads.moment),
    ):
        np.testing.assert_allclose(vector(measured), expected[0, leg], atol=1e-10)


def accelerate(scene, at):
    """Angular acceleration of the star without a moment from the topic."""
    from sst_ros.dynamics.traced_dynamics import Dynamics

    return Dynamics.of(scene).derivative(*at.quaternion, *at.body_rate, *at.torque)[4:7]


def test_the_legs_carry_the_star_and_its_payload(motion):
    """Newton and Euler for the star, whose momentum is differentiated numerically."""
    scene, states = motion
    star, payload = scene.star, scene.payload
    tensor = np.array(star.tensor, dtype=float)
    xx, yy, zz, xy, xz, yz = payload.entries
    tensor = tensor + np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    mass = star.mass + payload.mass
    weighed = star.mass * np.array(star.centre) + payload.mass * np.array(
        payload.centre
    )
    rotations = np.array([rotation_matrix(one.quaternion) for one in states])
    spins = np.array([one.body_rate for one in states])
    momentum = np.einsum("nij,jk,nk->ni", rotations, tensor, spins)
    weight = mass * np.array(scene.gravity.acceleration)
    middle = rotations[3]
    force = np.tensordot(SECOND, rotations @ weighed, 1) - weight
    moment = np.tensordot(FIRST, momentum, 1)
    moment -= np.cross(middle @ weighed, scene.gravity.acceleration) + np.array(MOMENT)
    at = states[3]
    frames = reactions_of(
        scene,
        np.zeros(1),
        np.array([at.quaternion]),
        np.array([at.body_rate]),
        np.array([at.torque]),
    ).intermediate_frames[0]
    carried = np.zeros((2, 3))
    for leg in range(3):
        settings = {"reaction": f"{LINK_JOINTS[-1]}_{leg + 1}"}
        wrench = filled("reaction", settings, scene, at).wrench
        carried[0] += frames[leg] @ vector(wrench.force)
        carried[1] += frames[leg] @ vector(wrench.torque)
    assert np.linalg.norm(force) > 1.0 and np.linalg.norm(moment) > 0.1
    np.testing.assert_allclose(carried[0], force, atol=1e-5)
    np.testing.assert_allclose(carried[1], moment, atol=1e-6)


def test_what_is_asked_for_is_published_with_the_samples_stamps(nodes, observer):
    point = "[0.02,-0.05,0.11]"
    topics = {
        "orientation": QuaternionStamped, "imu": Imu, "reaction": WrenchStamped,
    }  # fmt: skip
    heard = {
        name: observer.listen(kind, f"{NODE}/{name}") for name, kind in topics.items()
    }
    described = observer.listen(String, "/robot_description", latched=True)
    process = nodes.run(
        "simulator", scene=SCENE, imu=True, imu_position=point, reaction="revolute_2",
        imu_frame="left/imu", base_frame="left/base_link", duration=0.2, rate=1000,
        publish_rate=1000, real_time_factor=0.0,
        wait_for_subscribers=f"[{','.join(f'{NODE}/{name}' for name in topics)}]",
    )  # fmt: skip
    observer.until(lambda: process.poll() is not None, "the end")
    observer.until(lambda: len(heard["reaction"]) >= 201, "all samples")
    samples = [one for one in heard["orientation"] if nanoseconds(one.header.stamp)]
    stamps = [nanoseconds(one.header.stamp) for one in samples]
    assert [nanoseconds(one.header.stamp) for one in heard["imu"]] == stamps
    assert [nanoseconds(one.header.stamp) for one in heard["reaction"]] == stamps
    assert {one.header.frame_id for one in heard["reaction"]} == {"left/intermediate_2"}
    assert {one.header.frame_id for one in heard["imu"]} == {"left/imu"}
    rotations = np.array([
        rotation_matrix((q.x, q.y, q.z, q.w))
        for q in (one.quaternion for one in samples)
    ])  # fmt: skip
    gravity = np.array(load_scene(SCENE).gravity.acceleration)
    for k in range(100, 104):
        near = rotations[k - 3 : k + 4]
        acceleration = np.tensordot(SECOND, near @ np.array(POINT), 1)
        force = rotations[k].T @ (acceleration - gravity)
        measured = vector(heard["imu"][k].linear_acceleration)
        np.testing.assert_allclose(measured, force, atol=1e-4)
    (joint,) = (
        one
        for one in ET.fromstring(described[-1].data).iter("joint")
        if one.find("child").get("link") == "left/imu"
    )
    assert joint.get("type") == "fixed"
    assert joint.find("parent").get("link") == "star"
    position = map(float, joint.find("origin").get("xyz").split())
    assert tuple(position) == POINT
