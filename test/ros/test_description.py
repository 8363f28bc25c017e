# SPDX-License-Identifier: Apache-2.0
"""What the simulator shows of itself on request: robot_description and markers."""

import dataclasses

import numpy as np
import pytest
from rclpy.serialization import deserialize_message
from std_msgs.msg import String
from visualization_msgs.msg import Marker, MarkerArray

from sst_ros.description.urdf import urdf
from sst_ros.mechanism.frames import rotation_matrix
from sst_ros.mechanism.geometry import Geometry
from sst_ros.nodes.robot_description import Markers
from sst_ros.scene import yaml_document
from sst_ros.scene.scene import Markers as Wanted
from sst_ros.scene.scene import load
from sst_ros.simulation import Simulation

pytestmark = pytest.mark.ros
STEP_NS = 10_000_000


def marked(**given):
    return dataclasses.replace(load("example2"), markers=Wanted(**given))


def test_the_description_is_latched(nodes, observer):
    nodes.run("simulator", scene="general", publish_description=True)
    observer.told("phase", lambda phase: phase in ("running", "fault"))
    heard = observer.listen(String, "/robot_description", latched=True)
    observer.until(lambda: heard, "robot_description")
    assert heard[-1].data == urdf(load("general"))


def test_nothing_is_shown_that_was_not_asked_for(nodes, observer):
    nodes.run("simulator")
    observer.told("phase", "running")
    topics = dict(observer.node.get_topic_names_and_types())
    assert "/robot_description" not in topics
    assert "/sst_simulator/markers" not in topics


def test_markers_of_a_scene_move(nodes, observer, tmp_path):
    path = tmp_path / "marked.yaml"
    path.write_text(yaml_document.dump(dataclasses.replace(marked(), **moving())), encoding="utf-8")
    nodes.run("simulator", scene=path)
    heard = observer.listen(MarkerArray, "/sst_simulator/markers")
    observer.until(lambda: len(heard) > 4, "markers")
    first, last = (by_name(message)["s"][0] for message in (heard[1], heard[-1]))
    assert first.points[0] != last.points[0]
    assert {marker.header.frame_id for marker in heard[-1].markers} == {"base"}


def moving():
    return {"initial": load("swing").initial, "springs": load("swing").springs}


def by_name(message):
    found = {}
    for marker in message.markers:
        found.setdefault(marker.ns, []).append(marker)
    return found


def test_markers_are_where_the_manipulator_is():
    scene = marked(trace=0.5, torque_scale=0.1)
    simulation, markers = Simulation(scene), Markers(scene, scene.markers)
    torque, path = (1.0, -2.0, 0.0), []
    for _ in range(12):
        state = simulation.step(torque, STEP_NS)
        message = deserialize_message(markers.of(state), MarkerArray)
        path.append(scene.star.radius * rotation_matrix(state.quaternion)[:, 2])
    found = by_name(message)
    assert len({marker.id for marker in message.markers}) == len(message.markers)

    # Points of a link's marker, turned by its pose: E, and the carriages.
    star = found["star"][0]
    assert placed(star)[0] == pytest.approx(path[-1])
    geometry, gamma = Geometry.of(scene), state.joints.gamma
    for k in range(3):
        box = next(one for one in found[f"intermediate_{k + 1}"] if one.type == Marker.CUBE)
        w, v = geometry.w[k], geometry.v[k]
        r = np.cos(gamma[k]) * v + np.sin(gamma[k]) * np.cross(w, v)
        at = box.pose.position
        assert [at.x, at.y, at.z] == pytest.approx(scene.star.radius * r)

    points = placed(found["path"][0])
    assert len(points) == 10  # 0.5 s at 20 Hz
    assert points == pytest.approx(np.array(path[-10:]))
    assert placed(found["s"][0])[0] == pytest.approx(path[-1])
    lengths = [
        (p[1] - p[0]) @ w for p, w in zip(map(placed, found["torque"]), geometry.w, strict=True)
    ]
    assert lengths[:2] == pytest.approx([0.1, -0.2])
    assert abs(lengths[2]) < 2e-3

    again = deserialize_message(markers.of(simulation.reset()), MarkerArray)
    start = scene.star.radius * rotation_matrix(simulation.state.quaternion)[:, 2]
    assert placed(by_name(again)["path"][0]) == pytest.approx(np.tile(start, (10, 1)))


def placed(marker):
    """Points of a marker in its frame, base."""
    q = marker.pose.orientation
    turn = rotation_matrix([q.x, q.y, q.z, q.w])
    return np.array([[p.x, p.y, p.z] for p in marker.points]) @ turn.T
