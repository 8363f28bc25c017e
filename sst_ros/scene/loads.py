# SPDX-License-Identifier: Apache-2.0
"""What a scene may have beside its mechanism: loads, actuators, start, motion.

A term that a scene does not name has no operation in its dynamics. Every desired motion
begins at rest and ends at rest, except a recorded one, which begins and ends as the
recording does. A motion that names no start begins in the initial pose of the scene.
"""

from __future__ import annotations

import math
from functools import partial
from itertools import pairwise

import numpy as np

from sst_ros.scene.schema import Rules, Section, amount, angles, coefficient, entry
from sst_ros.state import ZERO, Quaternion, Vector3


def _name_joints(angle: str) -> tuple[str, ...]:
    return tuple(f"{angle}_{leg}" for leg in (1, 2, 3))


ACTUATED_JOINTS = _name_joints("gamma")
PASSIVE_JOINTS = (*_name_joints("mu"), *_name_joints("beta"))
JOINTS = (*ACTUATED_JOINTS, *PASSIVE_JOINTS)
MOMENTS = ("moment_x", "moment_y", "moment_z")  # beside the torques of a tick
NANOSECOND = 1e-9  # resolution of time [s]
_duration = partial(entry, "time that it takes", "s", least=NANOSECOND)


class Gravity(Section):
    """A uniform field."""

    EFFECTS = ("acceleration",)

    acceleration: Vector3 = entry("acceleration of free fall in {B}", "m/s^2")


class Moment(Section):
    """An external moment on the star: constant, or received on a topic.

    The topic is ~/external_moment.
    """

    ONE_OF = "value", "topic"

    value: Vector3 | None = entry("constant moment in {B}", "N m")
    topic: bool = entry("take it from the topic ~/external_moment", default=False)


class Friction(Section):
    """Friction torque of a joint against its rate v.

    viscous v + (coulomb + (static - coulomb) exp(-(v / stribeck)^2)) tanh(v /
    smoothing)
    """

    EFFECTS = "viscous", "coulomb", "static"

    viscous: float = coefficient("viscous coefficient", "N m s/rad")
    coulomb: float = coefficient("Coulomb torque", "N m")
    smoothing: float = amount(
        "rate over which its sign changes",
        "rad/s",
        default=1e-2,
        acts_on=("coulomb", "static"),
    )
    static: float = coefficient("breakaway torque (Stribeck); 0 for none", "N m")
    stribeck: float = amount(
        "rate at which that has faded", "rad/s", default=0.1, acts_on=("static",)
    )

    def rules(self) -> Rules:
        """Refuse a breakaway torque below the Coulomb torque."""
        below = np.not_equal(self.static, 0.0) & np.less(self.static, self.coulomb)
        yield below, "static", self.static, f"must be >= coulomb = {self.coulomb} N m"


class JointFriction(Section):
    """Friction by kind of joint, the same in all legs."""

    EFFECTS = "gamma", "mu", "beta"

    gamma: Friction | None = entry("actuated revolute joints")
    mu: Friction | None = entry("passive revolute joints")
    beta: Friction | None = entry("passive curved prismatic joints")


class Spring(Section):
    """A torsional spring at one joint: torque -stiffness (angle - rest)."""

    EFFECTS = ("stiffness",)

    joint: str = entry("joint", choices=JOINTS)
    stiffness: float = amount("stiffness", "N m/rad")
    rest: float = entry("angle without torque", "rad")


class Actuators(Section):
    """What stands between a command and the torque of a joint; the same in all legs.

    Commands and limits are torques at the joint, behind the gear. A command is limited
    first, then it lags.
    """

    EFFECTS = (
        "rotor_inertia", "torque_limit", "time_constant", "idle_damping",
        "velocity_limit", "acceleration_limit",
    )  # fmt: skip

    rotor_inertia: float = coefficient("inertia of the motor's rotor", "kg m^2")
    gear_ratio: float = amount(
        "motor turns per joint turn", "1", default=1.0, acts_on=("rotor_inertia",)
    )
    torque_limit: float | None = amount("largest torque", "N m")
    time_constant: float | None = amount(
        "time constant of a first-order lag of the torque", "s"
    )
    idle_damping: float = coefficient(
        "torque -idle_damping gamma_dot in place of a command that is too old",
        "N m s/rad",
    )
    velocity_limit: float | None = amount(
        "largest rate of a desired motion; a simulation does not hold it", "rad/s"
    )
    acceleration_limit: float | None = amount(
        "largest acceleration of a desired motion; a simulation does not hold it",
        "rad/s^2",
    )


class Initial(Section):
    """The state at t = 0."""

    gamma: Vector3 = angles("actuator angles at t = 0")
    gamma_dot: Vector3 = entry("actuator rates at t = 0", "rad/s", default=ZERO)
    orientation: Quaternion | None = entry(
        "quaternion (x, y, z, w) of {E} in {B}, within 0.1 rad, that selects the"
        " assembly mode where gamma has several admissible ones",
        "1",
        nonzero=True,
    )


# Desired motions, which `control.reference_motions` makes reference motions.


class ToAngles(Section):
    """The actuators go straight from their initial angles to others.

    The motion has minimum jerk.
    """

    gamma: Vector3 = angles("actuator angles at the end")
    duration: float = _duration()


class ToOrientation(Section):
    """The star turns about one axis from its initial orientation to another.

    The motion has minimum jerk.
    """

    orientation: Quaternion = entry(
        "quaternion (x, y, z, w) of {E} in {B} at the end, of any length",
        "1",
        nonzero=True,
    )
    duration: float = _duration()


class Sweep(Section):
    """Sines of the actuators, gamma_k = centre_k + fading amplitude_k sin(angle_k).

    The angle grows with the frequency, which goes evenly from its first to its last
    value (a linear chirp). The fading grows from 0 to 1 over `fade` at the beginning,
    with minimum jerk, and back at the end.
    """

    amplitude: Vector3 = angles("amplitudes")
    frequency: Vector3 = entry("angular frequencies at the beginning", "rad/s")
    last_frequency: Vector3 | None = entry(
        "angular frequencies at the end; by default those at the beginning", "rad/s"
    )
    centre: Vector3 | None = angles("centres; by default the initial angles")
    fade: float = entry("time to grow and to fade", "s", least=NANOSECOND)
    duration: float = _duration()

    def rules(self) -> Rules:
        """Refuse to fade for longer than there is time."""
        most = 0.5 * self.duration
        requirement = f"must not exceed half the duration, {most} s"
        yield np.greater(self.fade, most), "fade", self.fade, requirement


class Spiral(Section):
    """E winds outwards from where it is, by three angles.

    These are the tilt phi, its direction theta, and psi about E. R = R(0) Rz(theta)
    Ry(phi) Rz(psi - theta). All three grow from zero by one minimum jerk.
    """

    phi: float = entry("tilt at the end", "rad", least=0.0, most=math.pi)
    theta: float = entry("how far the direction of the tilt turns", "rad")
    psi: float = entry("turn about E at the end", "rad", default=0.0)
    duration: float = _duration()


class Waypoint(Section):
    """Where the actuators are at a time.

    What is not given is chosen for minimum jerk.
    """

    time: float = entry("time since the beginning", "s", least=0.0)
    gamma: Vector3 = angles("actuator angles")
    gamma_dot: Vector3 | None = entry("actuator rates", "rad/s")
    gamma_ddot: Vector3 | None = entry("actuator accelerations", "rad/s^2")


class Recorded(Section):
    """What the actuators did in a recorded run."""

    bag: str = entry("folder of the bag, as seen from where the program runs")
    namespace: str | None = entry(
        "namespace of the simulator, where the bag has several runs"
    )


class DesiredMotion(Section):
    """What the manipulator is to do, for a controller and for `plan`; give one kind."""

    ONE_OF = "to_angles", "to_orientation", "sweep", "spiral", "waypoints", "recorded"

    to_angles: ToAngles | None = entry("actuators from point to point")
    to_orientation: ToOrientation | None = entry("star from point to point")
    sweep: Sweep | None = entry("sines of the actuators")
    spiral: Spiral | None = entry("spiral of E")
    waypoints: tuple[Waypoint, ...] = entry(
        "points of the actuators in time, quintic between them", default=()
    )
    recorded: Recorded | None = entry("motion of a recorded run")

    @property
    def kind(self) -> str:
        """Name of the kind that is given."""
        return next(name for name in self.ONE_OF if getattr(self, name))

    def rules(self) -> Rules:
        """Refuse points whose times do not rise."""
        for index, (before, point) in enumerate(pairwise(self.waypoints), start=1):
            early = np.less(point.time, before.time + NANOSECOND)
            earliest = f"must be > {before.time} s, that of the point before, by 1e-9 s"
            yield early, f"waypoints[{index}].time", point.time, earliest
