# SPDX-License-Identifier: Apache-2.0
"""What the simulator shows of itself on request: its URDF, and markers for RViz.

Markers go out in the node's thread, not in the run's: a tick never waits for them, and a late one
is of no matter.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable
from itertools import chain

import numpy as np
from geometry_msgs.msg import Point
from rclpy.node import Node
from std_msgs.msg import ColorRGBA, String
from visualization_msgs.msg import Marker, MarkerArray

from sst_ros.description.shapes import (
    LEG_COLOURS,
    STAR_COLOUR,
    Ball,
    Box,
    Colour,
    Shape,
    end_point,
    shapes,
)
from sst_ros.description.tree import STAR, rotations, tree
from sst_ros.description.urdf import urdf
from sst_ros.mechanism.frames import quaternion_of
from sst_ros.mechanism.geometry import Geometry
from sst_ros.nodes import topics
from sst_ros.nodes.clocks import STEADY
from sst_ros.nodes.messages import BASE_FRAME
from sst_ros.nodes.raw_messages import Outlet, Template, marks
from sst_ros.runtime.settings import SimulatorParameters
from sst_ros.scene.loads import JOINTS
from sst_ros.scene.loads import Markers as Wanted
from sst_ros.scene.scene import Scene
from sst_ros.simulation import State

PATH_COLOUR: Colour = (0.60, 0.10, 0.55)
_LEAST = 1e-3
"""Length of an arrow without torque [m]: RViz complains of arrows without length."""


def offer(node: Node, scene: Scene, given: SimulatorParameters, state: Callable[[], State]) -> None:
    """Publish the URDF where it is asked for, and markers of `state` where the scene has some."""
    if given.publish_description:
        topics.ROBOT_DESCRIPTION.publisher(node).publish(String(data=urdf(scene)))
    if scene.markers is not None:
        markers = Markers(scene, scene.markers)
        outlet = Outlet(topics.MARKERS.publisher(node))

        def show() -> None:
            if outlet.readers():
                outlet.send(markers.of(state()))

        node.create_timer(1.0 / scene.markers.rate, show, clock=STEADY)


class Markers:
    """The markers of one scene, as bytes in which only numbers change."""

    def __init__(self, scene: Scene, wanted: Wanted) -> None:
        self._scene, self._geometry = scene, Geometry.of(scene)
        self._joints, self._scale = tree(self._geometry), wanted.torque_scale
        self._array, self._marked = MarkerArray(), 0
        poses = []
        for link, drawn in shapes(scene).items():
            for shape in drawn:
                at = shape.centre if isinstance(shape, (Ball, Box)) else np.zeros(3)
                poses.append((link, at, self._posed(self._add(link, _shape(shape)))))
        size, length = scene.star.radius, max(2, round(wanted.trace * wanted.rate))
        path = self._pointed(self._add("path", _lines(0.012 * size, PATH_COLOUR)), length)
        s = self._pointed(self._add("s", _arrow(0.02 * size, STAR_COLOUR)), 2)
        torques = [
            self._pointed(self._add("torque", _arrow(0.03 * size, colour)), 2)
            for colour in LEG_COLOURS
        ]
        self._bytes = Template(self._array)
        place = self._bytes.place
        self._poses = [(link, at, place(marked)) for link, at, marked in poses]
        self._path, self._s, self._torques = place(path), place(s), [*map(place, torques)]
        self._points: deque[tuple[float, ...]] = deque(maxlen=length)
        self._length, self._time_ns = length, 0

    def of(self, state: State) -> bytes:
        """Give the serialised MarkerArray of a state."""
        angles = (*state.joints.gamma, *state.joints.mu, *state.joints.beta)
        found = rotations(self._joints, dict(zip(JOINTS, angles, strict=True)))
        quaternions = quaternion_of(np.stack([*found.values()])).tolist()
        turns = dict(zip(found, quaternions, strict=True))
        for link, at, write in self._poses:
            write(*(found[link] @ at).tolist(), *turns[link])
        end = end_point(self._scene, found[STAR])
        if state.time_ns < self._time_ns:  # the run began anew
            self._points.clear()
        self._time_ns = state.time_ns
        self._points.append(tuple(end.tolist()))
        missing = self._length - len(self._points)
        self._path(*chain.from_iterable([self._points[0]] * missing), *chain(*self._points))
        self._s(*end.tolist(), *(1.28 * end).tolist())
        foot = 1.17 * self._scene.base.radius
        for write, torque, w in zip(self._torques, state.torque, self._geometry.w, strict=True):
            reach = max(self._scale * abs(torque), _LEAST)
            ends = (foot * w).tolist(), ((foot + reach) * w).tolist()
            write(*chain(*(ends if torque > 0.0 else ends[::-1])))
        return bytes(self._bytes)

    def _add(self, namespace: str, marker: Marker) -> Marker:
        marker.header.frame_id, marker.ns = BASE_FRAME, namespace
        marker.id = len(self._array.markers)
        self._array.markers.append(marker)
        return marker

    def _marks(self, count: int) -> list[float]:
        given = marks(count, self._marked)
        self._marked += count
        return given

    def _posed(self, marker: Marker) -> list[float]:
        """Mark the seven numbers of a pose."""
        given = self._marks(7)
        at, turn = marker.pose.position, marker.pose.orientation
        at.x, at.y, at.z, turn.x, turn.y, turn.z, turn.w = given
        return given

    def _pointed(self, marker: Marker, count: int) -> list[float]:
        """Mark the coordinates of points."""
        given = self._marks(3 * count)
        marker.points = [Point(x=x, y=y, z=z) for x, y, z in np.reshape(given, (-1, 3)).tolist()]
        return given


def _shape(shape: Shape) -> Marker:
    if isinstance(shape, Ball):
        return _solid(Marker.SPHERE, [2.0 * shape.radius] * 3, shape.colour, shape.opacity)
    if isinstance(shape, Box):
        return _solid(Marker.CUBE, shape.size, shape.colour)
    marker = _lines(2.0 * shape.radius, shape.colour)
    marker.points = [Point(x=x, y=y, z=z) for x, y, z in shape.points.tolist()]
    return marker


def _solid(kind: int, size: Iterable[float], colour: Colour, opacity: float = 1.0) -> Marker:
    red, green, blue = colour
    marker = Marker(type=kind, color=ColorRGBA(r=red, g=green, b=blue, a=opacity))
    marker.scale.x, marker.scale.y, marker.scale.z = (float(x) for x in size)
    return marker


def _lines(width: float, colour: Colour) -> Marker:
    return _solid(Marker.LINE_STRIP, (width, 0.0, 0.0), colour)


def _arrow(width: float, colour: Colour) -> Marker:
    """Make an arrow between two points; its numbers are thick shaft, thick head, long head."""
    return _solid(Marker.ARROW, (width, 2.5 * width, 4.0 * width), colour)
