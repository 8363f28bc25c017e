# SPDX-License-Identifier: Apache-2.0
"""Torque commands: validated, limited, held (zero-order hold), dropped if too old."""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

from sst_ros.scene.loads import ACTUATED_JOINTS, Actuators
from sst_ros.simulation.simulation import Simulation
from sst_ros.state import (
    BASE_FRAME,
    NANOSECONDS,
    ZERO,
    Vector3,
    clamp,
    finite_vector,
    nanoseconds,
)

_SHOWN_NAMES = 6  # entries of a list in the reason of a refusal

MOST_WAITING = 50
"""Commands that wait for the next tick, which takes them all and uses the last: a
process that is held up for 50 ms loses none at 1 kHz, and what a flood costs a tick is
bounded.
"""


Arrivals: TypeAlias = Any
"""Messages of a topic: what has `waiting` and `read` as `nodes.topics.Reader`."""


class MessageRefused(Exception):
    """A message is not used.

    `kind` is the reason in a word or two, the text the whole reason.
    """

    def __init__(self, kind: str, reason: str) -> None:
        self.kind = kind
        super().__init__(reason)


@dataclass
class RunSettings:
    """Numbers of a run, of a node or not; the times may change between two ticks."""

    period_ns: int  # of a tick
    # from one published sample to the next: the control period
    ticks_per_sample: int = 1
    last_tick: int = sys.maxsize  # after which the run ends, if at all
    lockstep: bool = False  # each sample is answered before the next tick
    waits: bool = False  # a command starts the run
    # /clock is ours, and in lockstep goes on before the run, too
    own_clock: bool = False
    partial_commands: bool = False  # an effort that is nan means zero torque
    base_frame: str = BASE_FRAME  # {B}, in which external moments are given
    # age at which a command is no longer held; 0 for never
    command_timeout_ns: float = 0.0
    # longest wait for the answer to a sample [s]; 0 for no end
    lockstep_timeout: float = 0.0
    subscriber_timeout: float = 0.0  # longest wait for subscribers [s]


class TorqueInput:
    """Torque commands of a run. Owned by the thread of the run.

    Others read the counters.
    """

    def __init__(
        self,
        run: RunSettings,
        actuators: Actuators | None,
        commands: Arrivals,
        stamped: Arrivals,
        moments: Arrivals | None = None,
    ) -> None:
        self._run = run
        self._limit = actuators.torque_limit if actuators else None
        self._damping = actuators.idle_damping if actuators else 0.0
        self._commands = commands
        self._stamped = stamped
        self._moments = moments
        self._arrivals = [commands, stamped]
        if moments is not None:
            self._arrivals.append(moments)
        self.received = 0
        self.dropped = 0
        self.clamped = 0
        self.timeouts = 0  # times that the command became too old
        self.reasons: dict[str, int] = {}  # of dropped messages, with counts
        self._forget()

    def clear(self) -> None:
        """Forget the command and all arrivals: zero torque until the next command."""
        for arrivals in self._arrivals:
            arrivals.read(math.inf)
        self._forget()

    def _forget(self) -> None:
        self._torque = ZERO  # of the last command [N m]
        self.moment = ZERO  # external, in {B} [N m]
        self.begun = False  # a command has come since the start
        self.stale = False  # the last one is older than command_timeout and not used
        self.last_refusal = ""
        # first and last stamp of the states shown whose answers are accepted
        self._first_idle_ns = 0
        self._last_idle_ns = 0
        self.refresh()

    def refresh(self) -> None:
        """Count the age of the command from now on: a pause does not make it older."""
        self._since = self._moment_since = time.monotonic_ns()

    @property
    def age(self) -> float | None:
        """Time since the last valid command [s], or None."""
        return (time.monotonic_ns() - self._since) / NANOSECONDS if self.begun else None

    def constant(self, until_ns: int) -> bool:
        """Whether torque and moment of the last tick act until this time.

        The time is monotonic [ns].
        """
        if self.stale and self._damping > 0.0:  # the torque depends on the state
            return False
        if any(arrivals.waiting for arrivals in self._arrivals):
            return False
        if self.begun and not self.stale and self._is_old(self._since, until_ns):
            return False
        return self.moment == ZERO or not self._is_old(self._moment_since, until_ns)

    def accept_idle(self, stamp_ns: int, *, alone: bool = False) -> None:
        """Accept answers to a state shown with this stamp before the run.

        With `alone`, answers to no other state are accepted.
        """
        if alone or self._first_idle_ns == 0:
            self._first_idle_ns = stamp_ns
        self._last_idle_ns = stamp_ns

    def starts_run(self) -> bool:
        """Take the messages that arrived before the run.

        Return whether a command starts it.
        """
        if self._run.lockstep:
            self.answer(None)
        else:
            self._take(time.monotonic_ns())
        return self.begun

    def torque(self, simulation: Simulation, now_ns: int) -> Vector3:
        """Return torques [N m] of the tick that begins at this monotonic time [ns]."""
        self._take(now_ns)
        old = self.begun and self._is_old(self._since, now_ns)
        if old and not self.stale:
            self.timeouts += 1
        self.stale = old
        if not old:
            return self._torque
        if not self._damping:
            return ZERO
        first, second, third = simulation.state.joints.gamma_dot
        damping = -self._damping
        return clamp((damping * first, damping * second, damping * third), self._limit)

    def answer(self, stamp_ns: int | None) -> Vector3 | None:
        """Return the torques [N m] that answer the sample of this stamp.

        Without an answer None is returned. With the stamp None an answer to a state
        shown before the run is looked for. In a run such answers are ignored, because
        they may arrive late. In a pause the state of the sample is shown again.
        """
        torque: Vector3 | None = None
        for _ in self._commands.read(math.inf):
            self._drop(
                MessageRefused("no stamp", "in lockstep only commands_stamped is used")
            )
        now_ns = time.monotonic_ns()
        for message in self._read_stamped(math.inf):
            answered_ns = nanoseconds(message.header.stamp)
            to_idle = answered_ns == 0 or (
                self._first_idle_ns <= answered_ns <= self._last_idle_ns
            )
            if stamp_ns is None:
                fits = to_idle
            else:
                fits = 0 <= answered_ns - stamp_ns < self._run.period_ns
            if torque is None and fits:
                torque = self._accept(torque_by_name, message, now_ns)
            elif not to_idle:
                reason = f"stamp {answered_ns} ns answers no sample that waits"
                self._drop(MessageRefused("stamp", reason))
        self._take_moments(now_ns)
        return torque

    def _take(self, now_ns: int) -> None:
        for message in self._commands.read(now_ns):
            self._accept(three_numbers, message.data, now_ns)
        for message in self._read_stamped(now_ns):
            self._accept(torque_by_name, message, now_ns)
        self._take_moments(now_ns)

    def _read_stamped(self, until_ns: float) -> Iterable[Any]:
        """Read stamped commands.

        With partial_commands nan is zero torque, all nan no command.
        """
        received: Sequence[Any] = self._stamped.read(until_ns)
        if not self._run.partial_commands:
            return received
        commands = [
            command
            for command in received
            if not (command.effort and all(map(math.isnan, command.effort)))
        ]
        for message in commands:
            message.effort = [
                0.0 if math.isnan(torque) else torque for torque in message.effort
            ]
        return commands

    def _take_moments(self, now_ns: int) -> None:
        if self._moments is None:
            return
        for message in self._moments.read(math.inf if self._run.lockstep else now_ns):
            try:
                self.moment = self._read_moment(message)
                self._moment_since = now_ns
            except MessageRefused as refused:
                self._drop(refused)
        if not self._run.lockstep and self._is_old(self._moment_since, now_ns):
            self.moment = ZERO

    def _read_moment(self, message: Any) -> Vector3:
        """Return the moment in {B} [N m].

        Without a frame_id it is taken to be in {B}.
        """
        frame_id = message.header.frame_id
        base_frame = self._run.base_frame
        if frame_id not in ("", base_frame):
            reason = (
                f"external_moment has frame_id {frame_id!r}, must be {base_frame!r} or"
                " empty"
            )
            raise MessageRefused("frame", reason)
        vector = message.wrench.torque
        return three_numbers((vector.x, vector.y, vector.z), "moments [N m]")

    def _accept(
        self, check: Callable[[Any], Vector3], content: Any, now_ns: int
    ) -> Vector3 | None:
        """Hold the torques of a command; drop one that the check refuses."""
        try:
            torque = check(content)
        except MessageRefused as refused:
            self._drop(refused)
            return None
        self._torque = clamp(torque, self._limit)
        if self._torque != torque:
            self.clamped += 1
        self.received += 1
        self._since = now_ns
        self.begun = True
        return self._torque

    def _drop(self, refused: MessageRefused) -> None:
        self.dropped += 1
        self.reasons[refused.kind] = self.reasons.get(refused.kind, 0) + 1
        self.last_refusal = str(refused)

    def _is_old(self, since_ns: int, now_ns: int) -> bool:
        return 0.0 < self._run.command_timeout_ns < now_ns - since_ns


def three_numbers(data: Sequence[float], quantity: str = "torques [N m]") -> Vector3:
    """Return three finite numbers, or raise MessageRefused."""
    vector = finite_vector(data)
    if vector is not None:
        return vector
    reason_key = "not finite" if len(data) == 3 else "wrong size"
    raise MessageRefused(reason_key, f"{_shorten(data)} must be 3 finite {quantity}")


def torque_by_name(message: Any) -> Vector3:
    """Return the efforts of a JointState [N m]."""
    return by_name(message.name, message.effort, "torques [N m] in effort")


def by_name(names: Sequence[str], values: Sequence[float], quantity: str) -> Vector3:
    """Return a value for each actuator, gamma_1 to gamma_3, given in any order."""
    if sorted(names) != list(ACTUATED_JOINTS):
        joint_names = ", ".join(ACTUATED_JOINTS)
        reason = f"names {_shorten(names)} must be {joint_names}, each once"
        raise MessageRefused("wrong names", reason)
    if len(values) == 3:
        value_of = dict(zip(names, values, strict=True))
        values = [value_of[name] for name in ACTUATED_JOINTS]
    return three_numbers(values, quantity)


def _shorten(values: Sequence[Any]) -> str:
    """Write a list as it is, or its beginning and its length."""
    if len(values) <= _SHOWN_NAMES:
        return str(list(values))
    beginning = ", ".join(repr(value) for value in values[:_SHOWN_NAMES])
    return f"[{beginning}, ...] ({len(values)} in all)"
