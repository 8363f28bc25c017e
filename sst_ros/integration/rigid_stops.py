# SPDX-License-Identifier: Apache-2.0
"""What happens at rigid ends of the stroke: impact, rest, and the release of what rests there."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from sst_ros.dynamics.contacts import RigidEnds
from sst_ros.dynamics.limits import Limit
from sst_ros.dynamics.traced_dynamics import Dynamics
from sst_ros.integration import coarse_solution
from sst_ros.integration.applied_torque import Free, Vector
from sst_ros.integration.events import Meeting

_RESTING_RATE = 1e-7
_ASIDE = 1e-6
"""Part of a step over which the rate of a push is taken."""


class Ends:
    """The ends of one scene; between steps it keeps which of them hold an actuator.

    Every state comes with its companion, which goes the same way.

    Attributes:
        resting: the ends that hold.

    """

    def __init__(self, dynamics: Dynamics, restitution: float) -> None:
        self._rigid = RigidEnds(dynamics)
        self._joints = dynamics.joints
        self._restitution = restitution
        self.resting: tuple[Limit, ...] = ()

    def slope(self, y: Vector, free: Vector) -> tuple[float, ...]:
        """Differentiate the state y where the ends hold; `free` is its derivative without ends."""
        if not self.resting:
            return tuple(free)
        return self._rigid.held(tuple(y), tuple(free), _legs(self.resting))[0]

    def strike(
        self, t: float, y: Vector, z: Vector, limit: Limit, free: Free
    ) -> tuple[list[float], list[float]]:
        """Bounce off an end, or come to rest where the bounce is not worth the name."""
        # The companion comes to the end a little earlier or later: go there, bounce, come back.
        late = coarse_solution.time_to(limit, self._joints(*z[:7]))
        z = coarse_solution.moved(z, self.slope(z, free(t, z)), late)
        y, z = self._turned(y, (limit, *self.resting)), self._turned(z, (limit, *self.resting))
        restitution = self._restitution
        if abs(limit.slope(self._joints(*y[:7]))) * restitution < _RESTING_RATE:
            restitution = 0.0
        self._kick(y, limit, restitution)
        held = _legs(self.resting)
        y = self._rigid.after_impact(tuple(y), limit.leg, restitution, held)
        z = self._rigid.after_impact(tuple(z), limit.leg, restitution, held)
        if restitution == 0.0:
            self.resting = (*self.resting, limit)
        y, z = self.settled(t, y, z, free)
        return y, coarse_solution.moved(z, self.slope(z, free(t, z)), -late)

    def settled(
        self, t: float, y: Vector, z: Vector, free: Free
    ) -> tuple[list[float], list[float]]:
        """Let go of all that the ends would have to pull: the torque may have jumped."""
        if not self.resting:
            return list(y), list(z)
        held = self._rigid.holding(tuple(y), tuple(free(t, y)), _inward(self.resting))
        leaving = [end for end in self.resting if end.leg not in held]
        return self.let_go(y, z, leaving) if leaving else (list(y), list(z))

    def let_go(
        self, y: Vector, z: Vector, leaving: Sequence[Limit]
    ) -> tuple[list[float], list[float]]:
        """Let go of some ends; what rests is put exactly where it rests, for steps drift."""
        y, z = self._placed(y, leaving), self._placed(z, leaving)
        self.resting = tuple(end for end in self.resting if end not in leaving)
        return y, z

    def releases(
        self, t: float, h: float, state: Callable[[float], Vector], free: Free
    ) -> list[Meeting]:
        """Torques by which ends push, of those that may become negative in a step of h from t [s].

        Args:
            t: when the step begins.
            h: its length.
            state: at a time since then.
            free: derivative of the state without ends.

        """
        if not self.resting:
            return []

        def push(end: Limit, x: float) -> float:
            return self._push(end, t + x, state(x), free)

        def rate(end: Limit, x: float) -> float:
            aside, y = (_ASIDE * h if x < 0.5 * h else -_ASIDE * h), state(x)
            beside = coarse_solution.moved(y, self.slope(y, free(t + x, y)), aside)
            return (self._push(end, t + x + aside, beside, free) - push(end, x)) / aside

        def may_end(end: Limit) -> bool:
            first, last = push(end, 0.0), push(end, h)
            if last < 0.0:
                return True
            falls, rises = -h * rate(end, 0.0), h * rate(end, h)
            return falls > 0.0 < rises and min(first, last) < max(falls, rises)

        def meeting(end: Limit) -> Meeting:
            scale = max(abs(push(end, 0.0)), abs(push(end, h)), 1e-300)
            return end, lambda x: push(end, x) / scale, lambda x: rate(end, x)

        return [meeting(end) for end in self.resting if may_end(end)]

    def _push(self, end: Limit, t: float, y: Vector, free: Free) -> float:
        """Torque away from an end [N m]; one that would have to pull has a negative one."""
        torques = self._rigid.held(tuple(y), tuple(free(t, y)), _legs(self.resting))[1]
        return end.sign * torques[self.resting.index(end)]

    def _kick(self, y: Vector, limit: Limit, restitution: float) -> None:
        """Forget the ends that an impact at another one tears their actuators from."""
        if self.resting:
            kicked = self._rigid.kicked(tuple(y), limit.leg, _inward((limit, *self.resting)))
            held = [leg for leg in _legs(self.resting) if leg in kicked]
            after = self._rigid.after_impact(tuple(y), limit.leg, restitution, held)
            joints = self._joints(*after[:7])
            self.resting = tuple(end for end in self.resting if end.slope(joints) < _RESTING_RATE)

    def _turned(self, y: Vector, ends: Sequence[Limit]) -> tuple[float, ...]:
        return self._rigid.with_angles(tuple(y), {end.leg: end.end for end in ends})

    def _placed(self, y: Vector, leaving: Sequence[Limit]) -> list[float]:
        """Put what rests at its end, still; what leaves just so fast that it is seen to leave."""
        at = self._turned(y, self.resting)
        rates = dict.fromkeys(_legs(self.resting), 0.0)
        for end in leaving:
            rates[end.leg] = end.sign * self._rigid.rounding(at, end.leg)
        return list(self._rigid.with_rates(at, rates))


def _legs(ends: Sequence[Limit]) -> list[int]:
    return [end.leg for end in ends]


def _inward(ends: Sequence[Limit]) -> dict[int, float]:
    return {end.leg: end.sign for end in ends}
