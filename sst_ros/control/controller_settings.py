# SPDX-License-Identifier: Apache-2.0
"""Settings of a controller: scheme and gains."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from sst_ros.errors import Problem
from sst_ros.scene.bodies import Vector
from sst_ros.scene.schema import Section, choice, number

MODES = ("feedforward", "feedforward_pd", "computed_torque", "pd", "gravity_pd")
SPACES = ("gamma", "so3")
INSTANTS = ("start", "middle")


@dataclass(frozen=True)
class ControllerSettings(Section):
    """Mode and gains.

    Gains are of a joint, tau_k = stiffness_k e_k + damping_k e_dot_k with e = desired - measured.
    By bandwidth they are those of the inertia M_kk that joint k has at the start of the motion:
    stiffness M_kk bandwidth^2, damping 2 damping_ratio M_kk bandwidth; so pd, gravity_pd and
    feedforward_pd have equal gains. computed_torque takes them over M_kk, as accelerations.
    """

    mode: str = choice(
        "feedforward: torque of the desired motion; feedforward_pd: and feedback; computed_torque: "
        "the model at the measured state, and feedback; pd: feedback alone; gravity_pd: and the "
        "weight at the measured position",
        MODES,
        default="feedforward",
    )
    space: str = choice(
        "where computed_torque is linear: the actuator angles, or the orientation",
        SPACES,
        default="gamma",
    )
    bandwidth: float = number(
        "natural frequency of the error", "rad/s", default=30.0, above=0.0, most=1e6
    )
    damping_ratio: float = number(
        "damping ratio of the error", "1", default=1.0, above=0.0, most=1e3
    )
    stiffness: Vector = number(
        "stiffness of the feedback, in place of bandwidth; zeros for that of bandwidth",
        "N m/rad",
        shape=(3,),
        default=(0.0, 0.0, 0.0),
        least=0.0,
        most=1e9,
    )
    damping: Vector = number(
        "damping of the feedback, in place of damping_ratio; zeros for that of bandwidth",
        "N m s/rad",
        shape=(3,),
        default=(0.0, 0.0, 0.0),
        least=0.0,
        most=1e9,
    )
    integral_rate: float = number(
        "integral action: stiffness times this is the torque per sum of errors; 0 for none",
        "1/s",
        default=0.0,
        least=0.0,
        most=1e6,
    )
    torque_limit: float = number(
        "largest torque that is commanded, beside that of the scene's actuators; 0 for none",
        "N m",
        default=0.0,
        least=0.0,
        most=1e9,
    )
    feedforward_at: str = choice(
        "instant of a control period whose feedforward is held over it",
        INSTANTS,
        default="start",
    )

    def check(self) -> Iterator[Problem]:
        """Refuse gains of a joint where there is none."""
        if self.direct and self.mode == "computed_torque" and self.space == "so3":
            allowed = "is a joint's: on so3 give bandwidth and damping_ratio"
            yield Problem("stiffness", self.stiffness, allowed)
        if self.direct and not any(self.stiffness) and self.integral_rate:
            yield Problem("integral_rate", self.integral_rate, "acts on stiffness: give it")

    @property
    def direct(self) -> bool:
        """Whether the gains are given as such, and not by bandwidth."""
        return any(self.stiffness) or any(self.damping)
