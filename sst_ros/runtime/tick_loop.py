# SPDX-License-Identifier: Apache-2.0
"""Ticks of a run, at absolute deadlines, from one published sample to the next.

`TickLoop.to_next_sample` is the loop; before it stand its deadlines, its counters, and
the estimate of what it costs that torques are held. Late ticks are counted, never made
up for. All is owned by the thread of the run.
"""

from __future__ import annotations

import contextlib
import math
import threading
import time
from collections.abc import Callable
from typing import Any, NamedTuple, TypeAlias

from sst_ros.errors import RunStopped, SstError
from sst_ros.mechanism.generic_math import add, axpy
from sst_ros.runtime.torque_input import RunSettings, TorqueInput
from sst_ros.scene.torque_profile import SineTorque
from sst_ros.simulation.simulation import Simulation
from sst_ros.state import NANOSECONDS, STAR_RATE, ZERO, State, Vector3

_LONGEST_SLEEP_S = 0.05
"""Longest sleep between two looks at what may interrupt a wait."""
_TOGETHER_NS = 2_000_000
"""Bounds the ticks that one sleep ends in, so that few commands wait."""
_POLL_S = 0.001
"""Longest sleep between two looks for an answer in lockstep."""
IDLE_PERIOD_S = 0.1
"""Period in which the state of a run that does not advance is shown."""
_LOAD_S = 0.02
"""To load code once more takes less; then no state is shown."""
_STEP_ANSWER_S = 0.4
"""Longest wait for the answer in a step of a paused run.

Services are answered within 0.5 s.
"""
_TICKS_AT_ONCE = 64
"""Most ticks of one call of `Simulation.advance`, after which requests are served."""
_AT_ONCE_S = 0.1
"""Longest time of one call, for the same reason."""
_LONGEST_WAIT_S = 0.1
"""Longest time that requests wait for the next sample.

Deadlines may be far, and a followed clock may stand.
"""

RunOutput: TypeAlias = Any
"""Where a run publishes: has the methods of `nodes.publications.SimulatorTopics`."""


class SteadyTime:
    """The clock that deadlines are measured by: the monotonic clock of the machine."""

    def now_ns(self) -> int:
        """Return the time [ns]."""
        return time.monotonic_ns()

    def sleep(self, seconds: float) -> None:
        """Wait for about this time [s].

        A clock that derives from this one may return early.
        """
        time.sleep(seconds)


class Pacer:
    """Deadlines anchor + k period / speed.

    After an overrun the whole periods in it are dropped.

    Lateness up to `tolerance_ns` is made up for: the step of a followed clock. With the
    speed 0, the real-time factor, deadlines have always come.
    """

    def __init__(
        self, period_ns: int, speed: float, source: SteadyTime, tolerance_ns: int = 0
    ) -> None:
        self._period_ns = period_ns
        self._source = source
        self._tolerance_ns = tolerance_ns
        self._anchor = 0  # from which the deadlines are counted [ns]
        self._count = 0  # periods from there to the next deadline
        self._last_seen_ns = 0  # time of the clock when it was read last
        self._set(speed)
        self.missed = 0  # ticks dropped
        self.overruns = 0  # times that some were
        self.jumps = 0  # of the clock, back
        self.late_ns = 0  # of the start of the last tick

    def start(self) -> None:
        """Begin now; the first deadline is one period away."""
        self._anchor = self._last_seen_ns = self._source.now_ns()
        self._count = 1

    def change(self, speed: float) -> None:
        """Go on at another speed, without a burst."""
        self._set(speed)
        self.start()

    def _set(self, speed: float) -> None:
        self.speed = speed
        self._interval = self._period_ns / speed if speed else 0.0
        self.interval_ns = round(self._interval)  # between deadlines; 0 without any
        # Ticks that one sleep may end in; a clock that is followed does not give the
        # next deadline.
        several = speed > 0.0 and self._tolerance_ns == 0
        self.together = max(1, int(_TOGETHER_NS // self._interval)) if several else 1

    def excuse(self, ticks: int) -> None:
        """Put the deadlines off if the last of the next ticks is past: no overrun."""
        if self.speed > 0.0:
            self._anchor += max(0, self._source.now_ns() - self._due(ticks))

    def _due(self, ticks: int) -> int:
        """Return the deadline of the last of the next ticks [ns]."""
        return self._anchor + round((self._count + ticks - 1) * self._interval)

    def wait(self, interrupted: Callable[[], bool], ticks: int = 1) -> bool:
        """Wait for the next deadline, or the last of several.

        Return False if `interrupted` says so before; it is called after each sleep, the
        longest of which is 50 ms.
        """
        if self.speed == 0.0:
            self.late_ns = 0
            return not interrupted()
        due = self._due(ticks)
        slept = False
        while True:
            now_ns = self._source.now_ns()
            if now_ns < self._last_seen_ns:
                self.jumps += 1
                self.start()
                now_ns = self._anchor
                due = self._due(ticks)
            self._last_seen_ns = now_ns
            late = now_ns - due
            if late >= 0:
                break
            if slept and interrupted():
                return False
            self._source.sleep(min(-late / NANOSECONDS, _LONGEST_SLEEP_S))
            slept = True
        if late >= self._interval and late >= self._tolerance_ns:
            dropped = int(late // self._interval)
            self.missed += dropped
            self.overruns += 1
            self._count += dropped
        self._count += ticks
        self.late_ns = late
        return True


class Counters:
    """Counters of a run, times of its steps, and how late they begin."""

    def __init__(self) -> None:
        self.ticks = 0
        self.published = 0  # samples
        self.resets = 0
        self.states_set = 0
        self._step_total_s = 0.0
        self.step_max_s = 0.0  # mean of the call whose mean is the longest
        # Ticks that one call may take: one as long as none has been measured.
        self.ticks_at_once = 1
        self._late_total = self._late_max = 0.0  # [us]
        self._late_square = 0.0  # sum of squares [us^2]
        self._wall_s = 0.0
        self._resumed: float | None = None

    def resume(self) -> None:
        """Count running time from now on."""
        self.hold()
        self._resumed = time.monotonic()

    def hold(self) -> None:
        """Stop to count running time."""
        if self._resumed is not None:
            self._wall_s += time.monotonic() - self._resumed
            self._resumed = None

    def count(self, took_s: float, late_ns: int, ticks: int = 1) -> None:
        """Count steps of one call: their time [s] and how late they start [ns]."""
        self.ticks += ticks
        self._step_total_s += took_s
        if took_s > self.step_max_s * ticks:
            self.step_max_s = took_s / ticks
            within_time = max(1.0, _AT_ONCE_S / self.step_max_s)
            self.ticks_at_once = int(min(within_time, _TICKS_AT_ONCE))
        late = 1e-3 * late_ns
        self._late_total += late * ticks
        self._late_square += late * late * ticks
        if late > self._late_max:
            self._late_max = late

    @property
    def wall_s(self) -> float:
        """Time spent running [s]."""
        resumed = self._resumed  # the thread of the run may hold meanwhile
        if resumed is None:
            return self._wall_s
        return self._wall_s + (time.monotonic() - resumed)

    @property
    def step_mean_s(self) -> float:
        """Mean time of a step [s]."""
        return self._step_total_s / max(self.ticks, 1)

    @property
    def lateness_us(self) -> tuple[float, float, float]:
        """Mean, standard deviation and largest lateness of the ticks [us]."""
        ticks = max(self.ticks, 1)
        mean = self._late_total / ticks
        square = self._late_square / ticks
        return mean, math.sqrt(max(square - mean * mean, 0.0)), self._late_max


class HeldTorques:
    """Error of the orientation from holding torques, estimated from their change.

    A torque tau(t_k) held over a period T acts, on average, T / 2 late: the angular
    acceleration lacks A tau' T / 2, where A turns torques into body accelerations.
    Integrated twice with the present A, the orientation is off by A (T / 2) times the
    integral of tau - tau(0). Of the torque of the middle of the hold the second order
    is left: the rate lacks T^2 tau'' / 24 a period, and the orientation moves T^3 tau'
    / 12 too little in each of 1 / T periods, together A (T^2 / 24) (tau - tau(0) + t
    tau'(0)). Both leave out that A changes and that the motion responds to its own
    error: they are estimates of the size.
    """

    def __init__(self) -> None:
        self.clear()

    def clear(self) -> None:
        """Forget the torques."""
        self._first: Vector3 | None = None
        self._second: Vector3 | None = None  # the first that is another one
        self._last = ZERO
        self._impulse = ZERO
        self._seconds = 0.0
        self._changes = 0

    def add(self, torque: Vector3 | SineTorque, seconds: float) -> None:
        """Add torques [N m] that were held for some time [s]; a sine is not held."""
        if isinstance(torque, SineTorque):
            return
        if self._first is None:
            self._first = torque
            self._changes = 1
        elif torque != self._last:
            self._second = self._second or torque
            self._changes += 1
        self._last = torque
        self._seconds += seconds
        impulse_1, impulse_2, impulse_3 = self._impulse
        torque_1, torque_2, torque_3 = torque
        self._impulse = (
            impulse_1 + seconds * torque_1,
            impulse_2 + seconds * torque_2,
            impulse_3 + seconds * torque_3,
        )

    def errors(self, simulation: Simulation) -> tuple[float, float] | None:
        """Return estimated errors of the orientation [rad].

        The first is of torques of the start, the second of torques of the middle. None
        is returned where fewer than two torques were held, or where the torques of the
        actuators lag.
        """
        first = self._first
        second = self._second
        if first is None or second is None or simulation.scene.lags:
            return None
        period = self._seconds / self._changes
        late = axpy(1.0, self._impulse, -self._seconds, first)
        drift = axpy(self._changes, second, -self._changes, first)
        lost = add(axpy(1.0, self._last, -1.0, first), drift)
        # How much the body acceleration changes by a change of the torques.
        state = simulation.state
        dynamics = simulation.dynamics
        y = (*state.quaternion, *state.body_rate)
        other_inputs = (0.0,) * (len(dynamics.drive) - len(ZERO))
        without, by_late, by_lost = (
            dynamics.derivative(*y, *torque, *other_inputs)[STAR_RATE]
            for torque in (ZERO, late, lost)
        )
        of_start = 0.5 * period * math.dist(by_late, without)
        of_middle = period**2 / 24.0 * math.dist(by_lost, without)
        return of_start, of_middle


class NoAnswer(SstError):
    """No command answered a sample in lockstep, or no subscriber came."""


class RunParts(NamedTuple):
    """What a run works with, beside its simulation."""

    run: RunSettings
    torque_input: TorqueInput
    pacer: Pacer
    output: RunOutput


class TickLoop:
    """Ticks and samples of one simulation."""

    def __init__(self, simulation: Simulation, parts: RunParts) -> None:
        self.simulation = simulation  # its `state` may be read by any thread
        self.begun = False  # the first sample has been published
        self.loading = False  # code is loaded, and no request is served meanwhile
        self.counters = Counters()
        self.held = HeldTorques()
        # Set by others to interrupt a wait, or to end.
        self.requested = threading.Event()
        self.stopped = threading.Event()
        self.parts = parts
        run, self._input, self._pacer, self._output = parts
        self._run = run
        self._lockstep = run.lockstep
        self._last_tick = run.last_tick
        self._period_ns = run.period_ns
        self._ticks_per_sample = run.ticks_per_sample
        self._control_ns = run.period_ns * run.ticks_per_sample
        self._idle_step_ns = self._control_ns if run.lockstep and run.own_clock else 0
        self._tick = 0  # ticks done
        self._start_ns = 0  # stamp of the first sample
        self._stamp_ns = 0  # stamp of the last sample
        self._idle_ns = 0  # stamp of the last state that was shown
        # in lockstep, an answer whose deadline has not come
        self._kept: Vector3 | None = None
        self._awaited_since = time.monotonic()  # an answer to the last sample
        self._waits_since = time.monotonic()  # the next sample

    def warm_up(self) -> None:
        """Load the code of every method, take the first step and go back.

        Later steps take no longer, also where they change the method. To load the code
        takes a second, and twenty on a machine with many busy processes. Meanwhile the
        state is shown: who waits for joint_states would take the silence for the end of
        the simulator.
        """
        failures: list[BaseException] = []

        def load() -> None:
            try:
                self.simulation.load_code()
            except BaseException as error:
                failures.append(error)

        loader = threading.Thread(target=load, name="load code", daemon=True)
        loader.start()
        self.loading = True
        try:
            loader.join(_LOAD_S)
            while loader.is_alive():
                if self.stopped.is_set():
                    return
                self.show(fault=False, waits=True)
                loader.join(IDLE_PERIOD_S)
        finally:
            self.loading = False
        if failures:
            raise failures[0]
        with contextlib.suppress(RunStopped):
            self.simulation.step(ZERO, self._period_ns)
        self.simulation.reset()

    def restart(self, simulation: Simulation) -> None:
        """Take another simulation, or the same at its start, and show it.

        Stamps go on.
        """
        self.simulation = simulation
        self.begun = False
        self._tick = 0
        self._kept = None
        self._input.clear()
        self.held.clear()
        self.show(fault=False)

    def begin(self) -> bool:
        """Publish the first sample; False as long as a followed clock has no time."""
        now_ns = self._output.now_ns()
        if now_ns == 0:
            return False
        sample = self._stamp_ns + self._control_ns
        self._start_ns = max(now_ns + self._idle_step_ns, sample, self._idle_ns + 1)
        self.begun = True
        self._publish()
        return True

    def refresh(self) -> None:
        """Count the age of the command and the wait for an answer from now on."""
        self._awaited_since = time.monotonic()
        self._input.refresh()

    def resume(self) -> None:
        """Count time and deadlines from now on."""
        self.refresh()
        self.counters.resume()
        self._pacer.start()

    def stamp_ns(self, state: State) -> int:
        """ROS time at which a state of the run holds [ns].

        Before the run, that of the last idle state.
        """
        return self._start_ns + state.time_ns if self.begun else self._idle_ns

    @property
    def complete(self) -> bool:
        """Whether the run has reached its duration."""
        return self._tick >= self._last_tick

    def to_next_sample(self, *, paced: bool) -> bool:
        """Tick to the next sample and publish it; False if it was interrupted before.

        Ticks between which nothing changes are one call. With deadlines ticks are done
        together at the deadline of the last of them, at most 2 ms later than its own; a
        command acts from the tick on that begins after its arrival. Without deadlines
        samples that nothing receives are passed over, up to 64 ticks.

        Raises:
            RunStopped: the run ends before; the ticks before it are done and logged.
            NoAnswer: in lockstep no answer came within lockstep_timeout, or within 0.4
                s where a paused run is stepped.

        """
        if self._lockstep:
            self._kept = self._kept or self._answer(paced)
            if self._kept is None:
                return False
        interval_ns = self._pacer.interval_ns if paced and not self._lockstep else 0
        self._waits_since = time.monotonic()
        while True:
            ticks = self._ticks_left()
            passed_over = 0  # samples that nothing receives
            if interval_ns:
                ticks = min(ticks, self._pacer.together)
            elif paced and not self._lockstep and self._output.unread:
                passed_over = self._samples_behind(ticks)
                ticks += passed_over * self._ticks_per_sample
            if paced and not self._pacer.wait(self._is_interrupted, ticks):
                return False
            self._do_ticks(ticks, interval_ns)
            self.counters.published += passed_over
            if self._tick % self._ticks_per_sample == 0 or self.complete:
                self._kept = None
                self._publish()
                return True
            if paced and self._is_interrupted():
                return False

    def _samples_behind(self, ticks: int) -> int:
        """Return how many more samples the ticks of one call can pass.

        They are those behind the sample that some ticks lead to, if they lead to one.
        """
        if (self._tick + ticks) % self._ticks_per_sample != 0:
            return 0
        most = min(self._last_tick - self._tick, self.counters.ticks_at_once)
        return (most - ticks) // self._ticks_per_sample

    def _do_ticks(self, ticks: int, interval_ns: int) -> None:
        """Do ticks of which the last begins now, each under the torques at its begin.

        Those between which no torque changes are one call.
        """
        now_ns = time.monotonic_ns()
        while ticks:
            begins_ns = now_ns - (ticks - 1) * interval_ns
            torque = self._kept or self._input.torque(self.simulation, begins_ns)
            equal = ticks if self._kept or self._input.constant(now_ns) else 1
            self._advance(torque, equal)
            ticks -= equal

    def _is_interrupted(self) -> bool:
        late = (
            self.requested.is_set()
            and time.monotonic() - self._waits_since > _LONGEST_WAIT_S
        )
        return late or self.stopped.is_set()

    def publish_rest(self) -> None:
        """Publish what has been done since the last sample, if anything."""
        if (
            self.begun
            and self._start_ns + self._tick * self._period_ns != self._stamp_ns
        ):
            with contextlib.suppress(Exception):  # publishing may be what failed
                self._publish()
        with contextlib.suppress(Exception):
            self._output.flush()

    def show(self, *, fault: bool, waits: bool = False) -> None:
        """Publish the state of a run that does not advance, marked as idle.

        In lockstep our /clock moves by a control period where the run waits:
        controllers that are updated by it can become active, and the run begins one
        update after what a command answers.
        """
        moves = waits and self._idle_step_ns > 0
        stamp_ns = self._next_idle_stamp_ns(fault=fault, moves=moves)
        self._output.idle(self.simulation.state, stamp_ns, at_rest=fault, moves=moves)
        self._idle_ns = stamp_ns
        self._input.accept_idle(stamp_ns, alone=moves)

    def _next_idle_stamp_ns(self, *, fault: bool, moves: bool) -> int:
        """Return the ROS time at which a state that is shown now holds [ns].

        It is that of the last sample where samples will follow it, else the present
        time; 0 before the first time of a followed clock. Stamps never go back or
        repeat; where time stands still they differ by 1 ns, because tf2 warns of
        transforms that have the stamp of the one before.
        """
        later_ns = max(self._stamp_ns, self._idle_ns) + 1
        if self.begun and not fault:  # samples follow
            return min(later_ns, self._stamp_ns + self._period_ns - 1)
        now_ns: int = self._output.now_ns()
        if moves:
            now_ns += self._idle_step_ns
        has_shown_time = self._stamp_ns > 0 or self._idle_ns > 0
        if now_ns > 0 or has_shown_time:
            return max(now_ns, later_ns)
        return 0

    def _ticks_left(self) -> int:
        left = self._ticks_per_sample - self._tick % self._ticks_per_sample
        return min(left, self._last_tick - self._tick, self.counters.ticks_at_once)

    def _advance(self, torque: Vector3, ticks: int) -> None:
        simulation = self.simulation
        moment = self._input.moment
        before = simulation.time_ns
        began = time.perf_counter()
        try:
            simulation.advance(torque, self._period_ns, ticks, moment)
        finally:
            took = time.perf_counter() - began
            ticks_done = (simulation.time_ns - before) // self._period_ns
            if ticks_done:
                self.counters.count(took, self._pacer.late_ns, ticks_done)
                self._output.ticks(torque, moment, ticks_done)
                self.held.add(torque, 1e-9 * ticks_done * self._period_ns)
                self._tick += ticks_done

    def _answer(self, paced: bool) -> Vector3 | None:
        """Torques that answer the last sample; None if interrupted before."""
        while (answer := self._input.answer(self._stamp_ns)) is None:
            if self.stopped.is_set() or (paced and self.requested.is_set()):
                return None
            waited = time.monotonic() - self._awaited_since
            timeout = self._run.lockstep_timeout or math.inf
            if not paced:
                timeout = min(timeout, _STEP_ANSWER_S)
            if waited > timeout:
                sample = f"the sample of {self._stamp_ns} ns"
                raise NoAnswer(f"no command answered {sample} within {timeout:g} s")
            time.sleep(min(max(waited / 10, 2e-5), _POLL_S))
        self._pacer.excuse(self._ticks_left())  # to wait for an answer is no overrun
        return answer

    def _publish(self) -> None:
        self._stamp_ns = self._start_ns + self._tick * self._period_ns
        self._output.sample(self.simulation, self._stamp_ns)
        if self._lockstep:
            self._awaited_since = time.monotonic()
        self.counters.published += 1
