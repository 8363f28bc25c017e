# SPDX-License-Identifier: Apache-2.0
"""Messages of the simulator: the layout is made once, afterwards only numbers are written.

They are bytes, which `Publisher.publish` takes: CDR, little-endian (OMG DDS-XTypes, XCDR1). To
convert a message object each time costs three times as much as the rest of publishing it
(docs/nodes.md has the figures).
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable, Iterable, Sequence
from functools import partial

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue

from sst_ros.errors import SstError
from sst_ros.runtime.torque_input import ACTUATORS
from sst_ros.scene.loads import JOINTS
from sst_ros.simulation.simulation import NANOSECONDS
from sst_ros.state import BASE_FRAME

_ENCAPSULATION = b"\x00\x01\x00\x00"
_STAMP = struct.Struct("<iI")
MOMENTS = ("moment_x", "moment_y", "moment_z")
_PASSIVE = (0.0,) * (len(JOINTS) - len(ACTUATORS))


Write = Callable[..., None]
"""Writes numbers into their place in the message."""


class CdrMessage:
    """Bytes of a message; the methods append its fields in the order of its definition.

    Alignment counts from the end of the encapsulation header: numbers lie at multiples of their
    size.
    """

    def __init__(self) -> None:
        self._data = bytearray(_ENCAPSULATION)

    def header(self, frame_id: str) -> None:
        """Append a std_msgs/Header, whose stamp `stamped` writes."""
        self.time(0)
        self.string(frame_id)

    def time(self, nanoseconds: int) -> None:
        """Append a builtin_interfaces Time or Duration."""
        self._align(4)
        self._data += stamp(nanoseconds)

    def length(self, count: int) -> None:
        """Append the length of a sequence."""
        self._align(4)
        self._data += struct.pack("<I", count)

    def string(self, text: str) -> None:
        """Append a string: its length with the closing zero, the characters, zero."""
        encoded = text.encode() + b"\x00"
        self.length(len(encoded))
        self._data += encoded

    def strings(self, texts: Iterable[str]) -> None:
        """Append a sequence of strings."""
        listed = [*texts]
        self.length(len(listed))
        for text in listed:
            self.string(text)

    def double_sequence(self, count: int) -> Write:
        """Append a sequence of `count` doubles, zero; the function writes their values."""
        self.length(count)
        if count == 0:
            return _nothing
        self._align(8)
        place = len(self._data)
        self._data += bytes(8 * count)
        return partial(struct.Struct(f"<{count}d").pack_into, self._data, place)

    def stamped(self, stamp: bytes) -> bytes:
        """Return the message with this stamp in the header that it begins with."""
        self._data[4:12] = stamp
        return bytes(self._data)

    def behind_stamp(self) -> bytes:
        """Return what stands between the stamp of the header and doubles that follow."""
        self._align(8)
        return bytes(self._data[12:])

    def _align(self, size: int) -> None:
        self._data += bytes(-(len(self._data) - len(_ENCAPSULATION)) % size)


def _nothing() -> None:
    """Write no value."""


def stamp(nanoseconds: int) -> bytes:
    """Return the bytes of a builtin_interfaces Time or Duration."""
    return _STAMP.pack(*divmod(nanoseconds, NANOSECONDS))


class NotFinite(SstError):
    """A state has a number that is not finite; it is not published."""


Numbers = tuple[Sequence[float], Sequence[float], Sequence[float]]
"""Of a state: quaternion (x, y, z, w); nine angles [rad], then nine rates [rad/s], by kind and leg;
torques of the actuators [N m]."""


def finite(y: Sequence[float], joints: Sequence[float], torque: Sequence[float]) -> Numbers:
    """Return the numbers of a state, for numbers y that begin with the quaternion.

    Raises:
        NotFinite: one of them is not finite.

    """
    quaternion = y[:4]
    # One number that is not finite makes the sum so.
    if not math.isfinite(sum(joints) + sum(quaternion) + sum(torque)):
        raise NotFinite(f"not finite, so not published: {quaternion}, {joints}, {torque}")
    return quaternion, joints, torque


class StateMessages:
    """Bytes of joint_states, orientation and euler_zyz, for the bytes of a stamp and the numbers.

    Each is one call of a struct: field by field takes 1.7 times as long.

    Args:
        frame_id: of joint_states; the others are in base_link.

    """

    def __init__(self, frame_id: str = "") -> None:
        joints, star = CdrMessage(), CdrMessage()
        joints.header(frame_id)
        joints.strings(JOINTS)
        joints.length(len(JOINTS))
        star.header(BASE_FRAME)
        self._names, self._base = joints.behind_stamp(), star.behind_stamp()
        stamped, count = f"<{len(_ENCAPSULATION)}s{_STAMP.size}s", len(JOINTS)
        more = f"I4x{count}d"  # a sequence: its length, padding, the numbers
        self._joints = struct.Struct(f"{stamped}{len(self._names)}s{count}d{more}{more}").pack
        self._quaternion, self._angles = (
            struct.Struct(f"{stamped}{len(self._base)}s{numbers}d").pack for numbers in (4, 3)
        )

    def joint_states(self, at: bytes, numbers: Numbers) -> bytes:
        """Return a JointState; the effort is the torque over the step that ended."""
        _, joints, torque = numbers
        angles, rates, count = joints[:9], joints[9:], len(JOINTS)
        return self._joints(
            _ENCAPSULATION, at, self._names, *angles, count, *rates, count, *torque, *_PASSIVE
        )

    def orientation(self, at: bytes, numbers: Numbers) -> bytes:
        """Return a QuaternionStamped."""
        return self._quaternion(_ENCAPSULATION, at, self._base, *numbers[0])

    def euler_zyz(self, at: bytes, numbers: Numbers) -> bytes:
        """Return a Vector3Stamped of the ZYZ angles theta, phi, psi [rad]."""
        return self._angles(_ENCAPSULATION, at, self._base, *zyz_angles(numbers[0]))


def zyz_angles(quaternion: Sequence[float]) -> tuple[float, float, float]:
    """ZYZ angles theta, phi, psi [rad] of a quaternion (x, y, z, w), as `frames.zyz_angles`.

    z / w is tan((theta + psi) / 2), -x / y is tan((theta - psi) / 2).
    """
    x, y, z, w = quaternion
    sine, cosine = math.hypot(x, y), math.hypot(z, w)
    total = math.atan2(z, w) if cosine else 0.0
    difference = math.atan2(-x, y) if sine else 0.0
    if sine and cosine:
        theta, psi = total + difference, total - difference
    else:
        theta, psi = 0.0, 2.0 * (total - difference)
    # In (-pi, pi], as atan2 gives it.
    if not -math.pi < theta <= math.pi:
        theta -= math.copysign(2.0 * math.pi, theta)
    if not -math.pi < psi <= math.pi:
        psi -= math.copysign(2.0 * math.pi, psi)
    return theta, 2.0 * math.atan2(sine, cosine), psi


class TorqueLog:
    """applied_torques: torque and moment of every tick since the last publication.

    Point i holds over tick i; its time is the end of that tick, relative to the header's stamp.
    """

    def __init__(self, usual: int, period_ns: int, *, moments: bool = False) -> None:
        self._names = (*ACTUATORS, *(MOMENTS if moments else ()))
        self._period_ns, self._moments = period_ns, moments
        self._rows: list[tuple[float, ...]] = []
        # Allocated for the usual number of ticks, and for none, where there is no run.
        self._layouts = {count: self._layout(count) for count in (0, usual)}

    def __len__(self) -> int:
        return len(self._rows)

    def clear(self) -> None:
        """Forget the rows."""
        self._rows.clear()

    def append(self, torque: Sequence[float], moment: Sequence[float], ticks: int = 1) -> None:
        """Log the torque [N m] and the moment [N m] of some ticks."""
        row = (*torque, *moment) if self._moments else tuple(torque)
        self._rows.extend([row] * ticks)

    def take(self, stamp_ns: int) -> bytes:
        """Return the message of the ticks logged since stamp_ns and clear the log."""
        count = len(self._rows)
        message, writes = self._layouts.get(count) or self._layout(count)
        for write, row in zip(writes, self._rows, strict=True):
            write(*row)
        self._rows.clear()
        return message.stamped(stamp(stamp_ns))

    def _layout(self, count: int) -> tuple[CdrMessage, list[Write]]:
        message, writes = CdrMessage(), []
        message.header(BASE_FRAME)
        message.strings(self._names)
        message.length(count)
        for point in range(count):
            for _ in ("positions", "velocities", "accelerations"):
                message.length(0)
            writes.append(message.double_sequence(len(self._names)))
            message.time((point + 1) * self._period_ns)
        return message, writes


def clock_message() -> CdrMessage:
    """Allocate a rosgraph_msgs/Clock."""
    message = CdrMessage()
    message.time(0)
    return message


def diagnostics(
    name: str, stamp_ns: int, level: bytes, text: str, values: dict[str, object]
) -> DiagnosticArray:
    """Build a DiagnosticArray of one status."""
    pairs = [KeyValue(key=key, value=str(value)) for key, value in values.items()]
    status = DiagnosticStatus(level=level, name=name, message=text, hardware_id="", values=pairs)
    message = DiagnosticArray(status=[status])
    message.header.stamp.sec, message.header.stamp.nanosec = divmod(stamp_ns, NANOSECONDS)
    return message
