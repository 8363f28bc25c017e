# SPDX-License-Identifier: Apache-2.0
"""Commands: checked whole, limited, held, and let go of when they are too old. No ROS types."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from typing import Any, Protocol

from sst_ros.runtime.settings import SimulatorParameters
from sst_ros.scene.scene import Actuators
from sst_ros.simulation import NANOSECONDS, State, Triple

ZERO: Triple = (0.0, 0.0, 0.0)
ACTUATORS = ("gamma_1", "gamma_2", "gamma_3")
_A_TURN = 10

Take = Callable[[], Any]
"""Gives the next message that has arrived, or None."""


class Settings(Protocol):
    """Where the parameters are; they may change between two ticks."""

    parameters: SimulatorParameters


class Moving(Protocol):
    """What is run."""

    @property
    def state(self) -> State:
        """Its state now; put together when it is asked for."""


class Refused(Exception):
    """A message that is not used; `kind` is the reason in a word or two, the text all of it."""

    def __init__(self, kind: str, said: str) -> None:
        self.kind = kind
        super().__init__(said)


class CommandBoard:
    """What the actuators are told. Owned by the run's thread; others read the counters.

    Messages are taken by the run's thread at its ticks, at most ten of a topic at a time: a flood
    of them costs a bounded part of a tick and no memory.

    Attributes:
        received, dropped, clamped, timeouts: counters.
        reasons: why messages were dropped, with counts.
        last_refusal: what was wrong with the last dropped message.
        begun: a command has come since the start.
        stale: the last command is too old, and is not used.
        moment: external moment in {B} [N m].

    """

    def __init__(
        self,
        settings: Settings,
        actuators: Actuators | None,
        commands: Take,
        stamped: Take,
        moments: Take | None = None,
    ) -> None:
        self._settings = settings
        self._limit = actuators.torque_limit if actuators else None
        self._damping = actuators.idle_damping if actuators else 0.0
        self._commands, self._stamped, self._moments = commands, stamped, moments
        self._lockstep = settings.parameters.sync == "lockstep"
        self.received = self.dropped = self.clamped = self.timeouts = 0
        self.reasons: dict[str, int] = {}
        self._forget()

    def clear(self) -> None:
        """Forget the command and what has arrived: no torque until there is another."""
        for take in (self._commands, self._stamped, self._moments or (lambda: None)):
            for _ in self._all(take):
                pass
        self._forget()

    def _forget(self) -> None:
        self._held, self.moment = ZERO, ZERO
        self._since = self._moment_since = time.monotonic()
        self.begun = self.stale = False
        self.last_refusal = ""

    def refresh(self) -> None:
        """Count the command's age from now on; a pause does not make it older."""
        self._since = self._moment_since = time.monotonic()

    @property
    def age(self) -> float | None:
        """Time since the last good command [s], or None."""
        return time.monotonic() - self._since if self.begun else None

    def look(self) -> bool:
        """Take what has come before the run; tell whether a command begins it."""
        if self._lockstep:
            return self.answer(0) is not None
        self._take()
        return self.begun

    @property
    def brakes(self) -> bool:
        """Whether torques now depend on the state: they are those of one tick only."""
        return self.stale and self._damping > 0.0

    def torque(self, moving: Moving) -> Triple:
        """Torques of the tick that begins now [N m]."""
        self._take()
        return self._held if not self._too_old() else self._braking(moving)

    def answer(self, stamp_ns: int) -> Triple | None:
        """Torques that answer the sample of this stamp [N m], or None as long as there are none."""
        found: Triple | None = None
        for _ in self._all(self._commands):
            self._drop(Refused("no stamp", "in lockstep only commands_stamped is used"))
        for message in self._all(self._stamped):
            stamp = message.header.stamp.sec * NANOSECONDS + message.header.stamp.nanosec
            try:
                if found is not None or stamp != stamp_ns:
                    if stamp == 0:
                        continue  # answers to samples that were shown before the run
                    raise Refused("stamp", f"stamp {stamp} ns answers no sample that waits")
                found = self._accept(by_name(message))
            except Refused as refused:
                self._drop(refused)
        if self._moments is not None:
            self._take_moments(self._moments)
        return found

    def _take(self) -> None:
        for message in self._all(self._commands):
            self._use(three, message.data)
        for message in self._all(self._stamped):
            self._use(by_name, message)
        if self._moments is not None:
            self._take_moments(self._moments)

    def _take_moments(self, moments: Take) -> None:
        for message in self._all(moments):
            vector = message.wrench.torque
            try:
                self.moment = three((vector.x, vector.y, vector.z), "moments [N m]")
                self._moment_since = time.monotonic()
            except Refused as refused:
                self._drop(refused)
        timeout = self._settings.parameters.command_timeout
        if timeout and not self._lockstep and time.monotonic() - self._moment_since > timeout:
            self.moment = ZERO

    def _use(self, check: Callable[[Any], Triple], content: Any) -> None:
        try:
            self._accept(check(content))
        except Refused as refused:
            self._drop(refused)

    def _accept(self, torque: Triple) -> Triple:
        limited = self._limited(torque)
        self.clamped += limited != torque
        torque = limited
        self.received += 1
        self._held, self._since, self.begun = torque, time.monotonic(), True
        return torque

    def _drop(self, refused: Refused) -> None:
        self.dropped += 1
        self.reasons[refused.kind] = self.reasons.get(refused.kind, 0) + 1
        self.last_refusal = str(refused)

    def _too_old(self) -> bool:
        timeout = self._settings.parameters.command_timeout
        old = self.begun and 0.0 < timeout < time.monotonic() - self._since
        if old and not self.stale:
            self.timeouts += 1
        self.stale = old
        return old

    def _braking(self, moving: Moving) -> Triple:
        if not self._damping:
            return ZERO
        first, second, third = moving.state.joints.gamma_dot
        return self._limited(
            (-self._damping * first, -self._damping * second, -self._damping * third)
        )

    def _limited(self, torque: Triple) -> Triple:
        limit = self._limit or math.inf
        first, second, third = (min(max(tau, -limit), limit) for tau in torque)
        return (first, second, third)

    def _all(self, take: Take) -> Sequence[Any]:
        """Take what has arrived, within bounds; mostly nothing has, and then this costs nothing."""
        message = take()
        if message is None:
            return ()
        found = [message]
        while len(found) < _A_TURN and (message := take()) is not None:
            found.append(message)
        return found


def three(data: Sequence[float], what: str = "torques [N m]") -> Triple:
    """Check three finite numbers."""
    whole = len(data) == 3
    if not whole or not all(map(math.isfinite, data)):
        kind = "not finite" if whole else "wrong size"
        raise Refused(kind, f"{list(data)[:6]} must be 3 finite {what}")
    return (float(data[0]), float(data[1]), float(data[2]))


def by_name(message: Any) -> Triple:
    """Check a JointState of efforts; the joints may come in any order."""
    return named(message.name, message.effort, "torques [N m] in effort")


def named(names: Sequence[str], values: Sequence[float], what: str) -> Triple:
    """Sort one value for each actuator."""
    if sorted(names) != list(ACTUATORS):
        wanted = ", ".join(ACTUATORS)
        raise Refused("wrong names", f"names {list(names)[:6]} must be {wanted}, each once")
    if len(values) != 3:
        raise Refused("wrong size", f"{list(values)[:6]} must be 3 finite {what}")
    at = dict(zip(names, values, strict=True))
    return three([at[name] for name in ACTUATORS], what)
