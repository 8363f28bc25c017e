# SPDX-License-Identifier: Apache-2.0
"""The way of a scene's state through one control period: steps, limits, impacts, rest at ends."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple

from sst_ros.errors import ImpactsAccumulate
from sst_ros.integration import companion, loops
from sst_ros.integration.events import first_met
from sst_ros.integration.system import System
from sst_ros.integration.tableaux import METHODS, Rosenbrock
from sst_ros.integration.touches import BESIDE, just_beyond, may_touch, touches_of
from sst_ros.integration.walk import CannotStep, Change, Leg, Mark, Walk
from sst_ros.limits import Limit, limits_of, ranges_of
from sst_ros.mechanism.compiled import Dynamics
from sst_ros.mechanism.compiled import compiled as plain
from sst_ros.mechanism.contacts import RigidEnds
from sst_ros.mechanism.geometry import Geometry
from sst_ros.scene import Scene

if TYPE_CHECKING:
    from sst_ros.simulation import State, Torque, Triple

_IMPACTS_PER_PERIOD = 1000
_ENDS_PER_PERIOD = 100_000
_RESTING_RATE = 1e-7

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
        self._system = System(dynamics, work=True)
        self._limits = tuple(limits_of(scene, geometry))
        self._kinks = tuple(touches_of(scene, geometry))
        self._ranges = ranges_of([*self._limits, *map(_clear_of, filter(_is_inner, self._kinks))])
        self._ends = RigidEnds(dynamics)
        self._limit = scene.actuators.torque_limit if scene.actuators else None
        self._walk = Walk(
            self._system, integrator, tolerance, compiled=compiled, ranges=self._ranges
        )
        explicit = integrator if not isinstance(METHODS.get(integrator), Rosenbrock) else "auto"
        # Torques that are functions, and ends that hold: the slope is put together in Python.
        self._slow = Walk(self._system, explicit, tolerance, compiled=False, slope=self._slope)
        self._rhs: Callable[..., tuple[float, ...]] | None = None
        self._torque: Callable[[float], Triple] | None = None
        self._start = 0.0
        self._resting: tuple[Limit, ...] = ()
        self._legs, self._lost = 0, 0.0
        self._first = self._book = self._mark()

    def reset(self) -> None:
        """Forget what has happened."""
        self._go_back(self._first)
        self._book = self._first

    def _mark(self) -> Book:
        """All that the next steps depend on beside the point at which they begin."""
        return self._resting, self._lost, self._legs, self._walk.mark(), self._slow.mark()

    def _go_back(self, mark: Book) -> None:
        self._resting, self._lost, self._legs, fast, slow = mark
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
        if self._limit is None:
            return torque
        limit, (first, second, third) = self._limit, torque
        return (
            min(max(first, -limit), limit),
            min(max(second, -limit), limit),
            min(max(third, -limit), limit),
        )

    def errors(self, at: Point) -> tuple[float, float]:
        """Estimated global errors of orientation [rad] and body rate [rad/s]."""
        return companion.errors(at.y, at.z, at.order, self._legs)

    def work(self, at: Point) -> float:
        """Work done on the manipulator, less what friction and impacts have taken [J]."""
        return at.y[-1] - self._lost

    def glide(
        self, at: Point, h: float, count: int, torque: Torque, more: tuple[float, ...]
    ) -> tuple[Point, int]:
        """Do what `travel` does for up to `count` periods of h [s], as long as that is only steps.

        Returns where the last period ended that was done, and how many were.
        """
        if self._resting or callable(torque):
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
        self._start = self._walk.origin = start
        self._torque = torque if callable(torque) else None
        drive = (*((0.0,) * 3 if callable(torque) else self.limited(torque)), *more)
        try:
            x, impacts = 0.0, 0
            for _ in range(_ENDS_PER_PERIOD):
                at, x, hit = self._until_limit(at, x, h, drive)
                if hit is None:
                    self._release(at, h, drive)
                    return at
                if hit in self._kinks:
                    continue
                if hit.error is not None:
                    raise hit.error(hit.reason, start + x, state)
                impacts += 1
                if impacts > _IMPACTS_PER_PERIOD:
                    raise ImpactsAccumulate(hit.reason, start + x, state)
                at = self._strike(at, hit, x, drive)
            raise CannotStep(f"elastic ends are met {_ENDS_PER_PERIOD} times in one period")
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

    def _until_limit(
        self, at: Point, x: float, h: float, drive: tuple[float, ...]
    ) -> tuple[Point, float, Limit | None]:
        """Go on from x to h, or to the first limit that is met before."""
        slow = self._torque is not None or bool(self._resting)
        walk = self._slow if slow else self._walk
        for leg in walk.legs(x, h, at.y, at.z, drive, at.order):
            self._legs += 1
            joints = self._dynamics.joints(*leg.y[:7])
            if loops.all_far(self._ranges, at.joints, joints):  # type: ignore[no-untyped-call]
                at = Point(leg.y, leg.z, joints, leg.order)
                continue
            near = [
                limit
                for limit in self._limits
                if limit.may_be_crossed(at.joints, joints) and limit not in self._resting
            ]
            near += [kink for kink in self._kinks if may_touch(kink, at.joints, joints)]
            again = partial(self._part, walk, leg, at, drive)
            met = first_met(near, lambda x: again(x).joints, leg.h) if near else None  # noqa: B023
            if met is not None:
                x, limit = met
                if limit in self._kinks:
                    x = just_beyond(limit, x, again(x).joints, leg.h)
                return again(x), leg.t + x, limit
            at = Point(leg.y, leg.z, joints, leg.order)
        return at, h, None

    def _part(self, walk: Walk, leg: Leg, at: Point, drive: tuple[float, ...], x: float) -> Point:
        """Go again from `at`, where a leg began, a part x [s] of it."""
        y, z, order = walk.retake(leg.t, x, at.y, at.z, drive, at.order)
        return Point(y, z, self._dynamics.joints(*y[:7]), order)

    def _strike(self, at: Point, limit: Limit, x: float, drive: tuple[float, ...]) -> Point:
        """Bounce off a limit, or come to rest where the bounce is not worth the name."""
        # The companion comes to the end a little earlier or later: go there, bounce, come back.
        z = at.z
        late = companion.time_to(limit, self._dynamics.joints(*z[:7]))
        z = companion.moved(z, self._slope(x, *z, *drive), late)
        restitution = self._scene.stroke.restitution or 0.0
        if abs(limit.slope(at.joints)) * restitution < _RESTING_RATE:
            restitution = 0.0
            self._resting = (*self._resting, limit)
        before = self._kinetic(at.y)
        y = list(self._ends.after_impact(tuple(at.y), limit.leg, restitution))
        z = list(self._ends.after_impact(tuple(z), limit.leg, restitution))
        z = companion.moved(z, self._slope(x, *z, *drive), -late)
        self._lost += before - self._kinetic(y)
        return Point(y, z, self._dynamics.joints(*y[:7]), at.order)

    def _release(self, at: Point, h: float, drive: tuple[float, ...]) -> None:
        """Let go of ends that would have to pull."""
        if self._resting:
            legs = [limit.leg for limit in self._resting]
            slope = self._free_slope(h, *at.y, *drive)
            torques = self._ends.held(tuple(at.y), slope, legs)[1]
            pushing = zip(self._resting, torques, strict=True)
            self._resting = tuple(limit for limit, torque in pushing if limit.sign * torque > 0.0)

    def _slope(self, t: float, *inputs: Any) -> tuple[float, ...]:
        """Differentiate the state under torques that are a function, or held by ends."""
        slope = self._free_slope(t, *inputs)
        if not self._resting:
            return slope
        legs = [limit.leg for limit in self._resting]
        return self._ends.held(inputs[: len(self._system.state)], slope, legs)[0]

    def _free_slope(self, t: float, *inputs: Any) -> tuple[float, ...]:
        if self._rhs is None:
            self._rhs = plain(self._system.program)
        if self._torque is not None:
            size = len(self._system.state)
            torque = self.limited(self._torque(self._start + t))
            inputs = (*inputs[:size], *torque, *inputs[size + 3 :])
        return self._rhs(t, *inputs)

    def _kinetic(self, y: list[float]) -> float:
        size = len(self._dynamics.state)
        return self._dynamics.energies(*y[:size], *(0.0,) * len(self._dynamics.drive))[0]


def _is_inner(kink: Limit) -> bool:
    """Whether an elastic end is met by going through this kink."""
    return (kink.end == 0.0) == (kink.sign > 0.0)


def _clear_of(kink: Limit) -> Limit:
    """Return a limit before which the kink is surely not touched."""
    return kink._replace(end=kink.end + 4.0 * BESIDE * kink.sign)
