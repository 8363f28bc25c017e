# SPDX-License-Identifier: Apache-2.0
"""The way of a scene's state through one control period: steps, limits, impacts, rest at ends."""

from __future__ import annotations

from functools import cache, partial
from typing import TYPE_CHECKING, Any, NamedTuple

from sst_ros.dynamics.limits import Limit, limits_of, ranges_of
from sst_ros.dynamics.traced_dynamics import Dynamics
from sst_ros.errors import ImpactsAccumulate
from sst_ros.integration import coarse_solution, step_loops
from sst_ros.integration.adaptive_stepper import CannotStep, Change, Leg, Mark, Walk
from sst_ros.integration.applied_torque import Driven
from sst_ros.integration.contact_events import clear_of, just_beyond, may_touch, touches_of
from sst_ros.integration.events import first_met, meetings
from sst_ros.integration.methods import METHODS, Rosenbrock
from sst_ros.integration.ode import working
from sst_ros.integration.rigid_stops import Ends
from sst_ros.mechanism.geometry import Geometry
from sst_ros.scene.scene import Scene

if TYPE_CHECKING:
    from sst_ros.simulation import State, Torque, Triple

_IMPACTS_PER_PERIOD = 1000
_ENDS_PER_PERIOD = 100_000

Book = tuple[tuple[Limit, ...], float, int, Mark, Mark]


class Point(NamedTuple):
    """State y, its companion z by a method of that order, joints: nine angles, nine rates."""

    y: list[float]
    z: list[float]
    joints: tuple[float, ...]
    order: int


class Journey:
    """Travels through control periods; between them it keeps what rests against an end."""

    def __init__(
        self,
        scene: Scene,
        geometry: Geometry,
        dynamics: Dynamics,
        integrator: str,
        tolerance: float,
        *,
        compiled: bool,
    ) -> None:
        self._scene = scene
        self._dynamics = dynamics
        self._system = working(dynamics)
        self._limits = tuple(limits_of(scene, geometry))
        self._kinks = tuple(touches_of(scene, geometry))
        self._ranges = ranges_of([*self._limits, *clear_of(self._kinks)])
        self._ends = Ends(dynamics, scene.stroke.restitution or 0.0)
        limit = scene.actuators.torque_limit if scene.actuators else None
        self._driven = Driven(self._system, limit)
        self._walk = Walk(
            self._system, integrator, tolerance, compiled=compiled, ranges=self._ranges
        )
        explicit = integrator if not isinstance(METHODS.get(integrator), Rosenbrock) else "auto"
        # Torques that are functions, and ends that hold: the slope is put together in Python.
        self._slow = Walk(self._system, explicit, tolerance, compiled=False, slope=self._slope)
        self._legs, self._lost = 0, 0.0
        self._first = self._book = self._mark()

    def reset(self) -> None:
        """Forget what has happened."""
        self._go_back(self._first)
        self._book = self._first

    def _mark(self) -> Book:
        """All that the next steps depend on beside the point at which they begin."""
        return self._ends.resting, self._lost, self._legs, self._walk.mark(), self._slow.mark()

    def _go_back(self, mark: Book) -> None:
        self._ends.resting, self._lost, self._legs, fast, slow = mark
        self._walk.go_back(fast)
        self._slow.go_back(slow)

    @property
    def method(self) -> str:
        """Name of the method in use."""
        return self._walk.method.name

    @property
    def changes(self) -> list[Change]:
        """Changes of method."""
        return self._walk.history

    def begin(self, y: list[float]) -> Point:
        """Complete quaternion and body rate to a state; no torque yet, no work done."""
        full = [*y, *(0.0,) * (len(self._system.state) - 7)]
        return Point(full, list(full), self._dynamics.joints(*full[:7]), self._walk.method.order)

    def limited(self, torque: Triple) -> Triple:
        """Clamp torques to the limit of the actuators."""
        return self._driven.limited(torque)

    def errors(self, at: Point) -> tuple[float, float]:
        """Estimated global errors of orientation [rad] and body rate [rad/s]."""
        return coarse_solution.errors(at.y, at.z, at.order, self._legs)

    def work(self, at: Point) -> float:
        """Work done on the manipulator, less what friction and impacts have taken [J]."""
        return at.y[-1] - self._lost

    def glide(
        self, at: Point, h: float, count: int, torque: Torque, more: tuple[float, ...]
    ) -> tuple[Point, int]:
        """Do what `travel` does for up to `count` periods of h [s], as long as that is only steps.

        Returns where the last period ended that was done, and how many were.
        """
        if self._ends.resting or callable(torque):
            return at, 0
        book, drive = self._mark(), (*self.limited(torque), *more)
        done, (y, z, joints) = self._walk.glide(h, count, (at.y, at.z, at.joints), drive, at.order)
        if done == 0:
            return at, 0
        self._book = book
        self._legs += done
        return Point(y, z, joints, self._walk.method.order), done

    def travel(
        self,
        at: Point,
        start: float,
        h: float,
        torque: Torque,
        more: tuple[float, ...],
        state: State,
    ) -> Point:
        """Go on from `at` by h [s]; impacts on the way are part of it, other limits its end.

        Raises:
            RunStopped: a limit was met; it carries `state`, and nothing has changed.
            CannotStep: no step resolves the motion.

        """
        kept = self._book = self._mark()
        self._walk.origin = start
        drive = (*self._driven.begin(torque, start), *more)
        try:
            x, impacts = 0.0, 0
            if self._ends.resting:
                free = self._driven.free(drive)
                at = self._point(*self._ends.settled(x, at.y, at.z, free), at.order)
            for _ in range(_ENDS_PER_PERIOD):
                at, x, hit = self._until_met(at, x, h, drive)
                if hit is not None and hit.error is not None:
                    raise hit.error(hit.reason, start + x, state)
                if hit is None or hit in self._ends.resting:
                    at = self._let_go(at, hit)
                elif hit not in self._kinks:
                    impacts += 1
                    if impacts > _IMPACTS_PER_PERIOD:
                        raise ImpactsAccumulate(hit.reason, start + x, state)
                    at = self._strike(at, hit, x, drive)
                if x >= h:
                    return at
            raise CannotStep(f"ends are met or left {_ENDS_PER_PERIOD} times in one period")
        except Exception:
            self._go_back(kept)
            raise

    def revisited(self, *way: Any) -> Point:
        """`travel` a part of the last way again, and leave everything as it is now."""
        now, began = self._mark(), self._book
        history = list(self._walk.history)
        self._go_back(began)
        try:
            return self.travel(*way)
        finally:
            self._walk.history[:] = history
            self._go_back(now)
            self._book = began

    def _until_met(
        self, at: Point, x: float, h: float, drive: tuple[float, ...]
    ) -> tuple[Point, float, Limit | None]:
        """Go on from x to h, or to the first limit, kink or release before."""
        slow = self._driven.by_function or bool(self._ends.resting)
        walk, free = self._slow if slow else self._walk, self._driven.free(drive)
        for leg in walk.legs(x, h, at.y, at.z, drive, at.order):
            self._legs += 1
            end = self._point(leg.y, leg.z, leg.order)
            far = step_loops.all_far(self._ranges, at.joints, end.joints, leg.h)  # type: ignore[no-untyped-call]
            if far and not self._ends.resting:
                at = end
                continue
            again = cache(partial(self._part, walk, leg, at, end, drive))
            signals = meetings(self._near(at, end), lambda x: again(x).joints)  # noqa: B023
            signals += self._ends.releases(leg.t, leg.h, lambda x: again(x).y, free)  # noqa: B023
            met = first_met(signals, leg.h)
            if met is not None:
                x, limit = met
                if limit in self._kinks:
                    x = just_beyond(limit, x, again(x).joints, leg.h)
                return again(x), leg.t + x, limit
            at = end
        return at, h, None

    def _near(self, at: Point, end: Point) -> list[Limit]:
        """Limits and kinks that may be met on a leg."""
        still = [limit.joint for limit in self._ends.resting]
        near = [
            limit
            for limit in self._limits
            if limit.joint not in still and limit.may_be_crossed(at.joints, end.joints)
        ]
        return near + [kink for kink in self._kinks if may_touch(kink, at.joints, end.joints)]

    def _part(
        self, walk: Walk, leg: Leg, at: Point, end: Point, drive: tuple[float, ...], x: float
    ) -> Point:
        """Go again from `at`, where a leg began that led to `end`, a part x [s] of it."""
        if x == leg.h:
            return end
        return self._point(*walk.retake(leg.t, x, at.y, at.z, drive, at.order))

    def _point(self, y: list[float], z: list[float], order: int) -> Point:
        return Point(y, z, self._dynamics.joints(*y[:7]), order)

    def _strike(self, at: Point, limit: Limit, x: float, drive: tuple[float, ...]) -> Point:
        """Bounce off a limit or come to rest there, and count the energy that is lost."""
        before = self._kinetic(at.y)
        y, z = self._ends.strike(x, at.y, at.z, limit, self._driven.free(drive))
        self._lost += before - self._kinetic(y)
        return self._point(y, z, at.order)

    def _let_go(self, at: Point, limit: Limit | None) -> Point:
        """Let go of an end, or of none; what rests is put exactly where it does."""
        if not self._ends.resting:
            return at
        leaving = () if limit is None else (limit,)
        return self._point(*self._ends.let_go(at.y, at.z, leaving), at.order)

    def _slope(self, t: float, *inputs: Any) -> tuple[float, ...]:
        """Differentiate the state under torques that are a function, or held by ends."""
        free = self._driven.slope(t, *inputs)
        return self._ends.slope(inputs[: len(self._system.state)], free)

    def _kinetic(self, y: list[float]) -> float:
        size = len(self._dynamics.state)
        return self._dynamics.energies(*y[:size], *(0.0,) * len(self._dynamics.drive))[0]
