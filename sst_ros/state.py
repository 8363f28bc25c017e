# SPDX-License-Identifier: Apache-2.0
"""Plain data that every room uses: joints, states, torques and assembly modes."""

from __future__ import annotations

import html
import math
import textwrap
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

NANOSECONDS = 1_000_000_000  # of a second: time is integer nanoseconds

Array: TypeAlias = NDArray[np.float64]
Vector3: TypeAlias = tuple[float, float, float]
ZERO: Vector3 = (0.0, 0.0, 0.0)
Quaternion: TypeAlias = tuple[float, float, float, float]  # (x, y, z, w)
TorqueFunction: TypeAlias = Callable[[float], Vector3]
"""Actuator torques [N m] at a simulated time [s]."""


def clamp(torque: Vector3, limit: float | None) -> Vector3:
    """Clamp torques [N m] to the limit of the actuators, where they have one."""
    if limit is None:
        return torque
    first, second, third = (min(max(each, -limit), limit) for each in torque)
    return first, second, third


def finite_vector(value: Any) -> Vector3 | None:
    """Return three finite numbers as floats; None where `value` is something else."""
    if isinstance(value, (str, bytes)):
        return None
    try:
        first, second, third = value
        floats = type(first) is type(second) is type(third) is float  # as in each step of a run
        if not floats and any(isinstance(x, np.complexfloating) for x in (first, second, third)):
            return None  # of which `math` takes the real part
        finite = math.isfinite(first) and math.isfinite(second) and math.isfinite(third)
    except (TypeError, ValueError, OverflowError):
        return None
    return (float(first), float(second), float(third)) if finite else None


class Explained:
    """An object that says what it is in at most ten lines, and as a table in a notebook."""

    def _facts(self) -> dict[str, object]:
        """Return what to say of the object: at most nine names, with units, and their values."""
        raise NotImplementedError

    def __repr__(self) -> str:
        said = {name: _say(value) for name, value in self._facts().items()}
        width = max(map(len, said))
        lines = (f"  {name:<{width}}  {text}" for name, text in said.items())
        return "\n".join([type(self).__name__, *lines])

    def _repr_html_(self) -> str:
        rows = "".join(
            f"<tr><th style='text-align:left'>{html.escape(name)}</th>"
            f"<td style='text-align:left'>{html.escape(_say(value))}</td></tr>"
            for name, value in self._facts().items()
        )
        return f"<table><caption>{type(self).__name__}</caption>{rows}</table>"


def _say(value: object) -> str:
    """Write a value on one line: numbers with six digits, several in brackets, "none" for none."""
    if isinstance(value, float):
        return f"{value:.6g}"
    if isinstance(value, (tuple, list, np.ndarray)):
        texts = [_say(each) for each in value]
        return f"({', '.join(texts)})" if isinstance(value[0], float) else ", ".join(texts)
    return textwrap.shorten(str(value), 200, placeholder=" ...")


class Joints(NamedTuple):
    """Angles [rad] and rates [rad/s] of all nine joints, by kind and leg."""

    gamma: Vector3
    mu: Vector3
    beta: Vector3
    gamma_dot: Vector3
    mu_dot: Vector3
    beta_dot: Vector3


@dataclass(frozen=True, repr=False)
class State(Explained):
    """The manipulator at one instant.

    Attributes:
        time_ns: simulated time since the start [ns].
        quaternion: orientation of {E} in {B}, (x, y, z, w).
        body_rate: angular velocity of the star in {E} [rad/s].
        joints: angles and rates of all nine joints.
        torque: torques that the actuators give at this instant [N m]; zero before the first step.

    """

    time_ns: int
    quaternion: Quaternion
    body_rate: Vector3
    joints: Joints
    torque: Vector3

    @classmethod
    def of(
        cls, time_ns: int, y: Sequence[float], joints: Sequence[float], torque: Vector3
    ) -> State:
        """Collect a state: quaternion and body rate begin y, 18 angles and rates are the joints."""
        j: Any = joints if type(joints) is tuple else tuple(joints)
        by_kind = Joints(j[0:3], j[3:6], j[6:9], j[9:12], j[12:15], j[15:18])
        return cls(time_ns, (y[0], y[1], y[2], y[3]), (y[4], y[5], y[6]), by_kind, torque)

    def _facts(self) -> dict[str, object]:
        return {
            "time [s]": self.time_ns / NANOSECONDS,
            "quaternion": self.quaternion,
            "body_rate [rad/s]": self.body_rate,
            **{f"{kind} [rad]": getattr(self.joints, kind) for kind in ("gamma", "mu", "beta")},
            "gamma_dot [rad/s]": self.joints.gamma_dot,
            "torque [N m]": self.torque,
        }


@dataclass(frozen=True)
class Assembly:
    """One assembly mode at given actuator angles: a root of the direct kinematics.

    Arrays are read-only.

    Attributes:
        rotation: R of {E} in {B}, shape (3, 3).
        mu: angles of the passive revolute joints in (-pi, pi] [rad], shape (3,).
        beta: angles of the passive curved prismatic joints in (-pi, pi] [rad], shape (3,).
        det_j2: determinant of J2, zero at a parallel singularity.
        admissible: E lies on the base triangle (Eq. 4) with 0 < beta_k <= beta_max for all legs.

    """

    rotation: NDArray[np.float64]
    mu: NDArray[np.float64]
    beta: NDArray[np.float64]
    det_j2: float
    admissible: bool


QUANTITIES = {
    "quaternion": ("1", "part"),
    "body_rate": ("rad/s", "axis"),
    "torque": ("N m", "leg"),
    **dict.fromkeys(("gamma", "mu", "beta"), ("rad", "leg")),
    **dict.fromkeys(("gamma_dot", "mu_dot", "beta_dot"), ("rad/s", "leg")),
    "euler_zyz": ("rad", "angle"),
}
"""Unit and dimension of each array of a motion with more than one column."""

DIMENSIONS: dict[str, list[str] | list[int]] = {
    "part": ["x", "y", "z", "w"],
    "axis": ["x", "y", "z"],
    "leg": [1, 2, 3],
    "angle": ["theta", "phi", "psi"],
}

UNITS = {"t": "s"}
"""Unit of each column of a table of states: of one motion, or of many at their end."""

for _name, (_unit, _dimension) in QUANTITIES.items():
    UNITS |= {f"{_name}_{_part}": _unit for _part in DIMENSIONS[_dimension]}
UNITS["energy"] = "J"


BASE_FRAME = "base_link"  # root of the robot (REP 105): frame {B} of the paper
IDLE_FRAME_ID = "idle"  # of joint_states that show a state before the run, in a pause or in a fault


def is_idle(stamp_ns: int, frame_id: str) -> bool:
    """Return whether a joint_states message shows a state and is not a sample of a run.

    Recordings of version 0.1 mark such messages by the stamp zero.
    """
    return stamp_ns == 0 or frame_id == IDLE_FRAME_ID


def nanoseconds(stamp: Any) -> int:
    """Return a Time or Duration as one number [ns]."""
    return int(stamp.sec) * NANOSECONDS + int(stamp.nanosec)
